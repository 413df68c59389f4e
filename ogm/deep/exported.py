"""Exported networks run by ONNX Runtime or OpenVINO, without torch."""

import hashlib
import os
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ogm.extras import import_extra
from ogm.storage.files import OgmError

Inputs = Mapping[str, NDArray[np.float32]]
Run = Callable[[Inputs], NDArray[np.float32]]


class ExportedNetwork(ABC):
    """Base class of `OnnxEngine` (lidar) and `RadarOnnxEngine`, which run an exported network.

    Parameters
    ----------
    path : path
        File of `ogm.deep.export.export_onnx`.
    runtime : "onnxruntime" or "openvino"
        Package that runs the network.
    precision : "float32" or "bfloat16"
        Number format of the convolutions of a network that was exported in float32. bfloat16 needs OpenVINO.
    threads : int, optional
        Number of threads for one scan. By default `default_threads`.

    Attributes
    ----------
    description : dict
        Description of the weights.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If the file is damaged or of another kind.
    ValueError
        If the runtime does not support the precision.
    ImportError
        If the runtime is not installed; the message holds the pip command to install it.

    Notes
    -----
    Networks are thread-safe and pickled by path. The same scan gives the same result bit by bit, on the same machine
    with the same number of threads.
    """

    description: dict[str, Any]
    precision: str = "float32"  # in which it was exported
    inputs: ClassVar[tuple[set[str], ...]]  # names of the inputs, one set for each kind of network
    output: ClassVar[str]

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        runtime: str = "onnxruntime",
        precision: str = "float32",
        threads: int | None = None,
    ) -> None:
        if precision not in ("float32", "bfloat16"):
            raise ValueError(f"precision must be float32 or bfloat16, got {precision!r}")
        if runtime == "onnxruntime" and precision != "float32":
            raise ValueError(f"ONNX Runtime computes in float32, got {precision!r}: use the engine openvino or torch")
        threads = default_threads() if threads is None else threads
        if threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        data = self._read(path)
        self._path, self._sha256 = os.fspath(path), hashlib.sha256(data).hexdigest()
        self._arguments = os.path.abspath(path), runtime, precision, threads
        try:
            if runtime == "openvino":
                self._session, self._names = _openvino(data, self.output, precision, threads)
            else:
                self._session, self._names = _onnxruntime(data, self.output, threads)
        except ImportError:
            raise
        except Exception as error:  # the runtimes' errors have no common class
            raise OgmError(f"{path} cannot be run by {runtime}: {error}") from error
        if self._names not in self.inputs:
            wanted = ", or ".join(" and ".join(sorted(names)) for names in self.inputs)
            raise OgmError(f"{path} takes {' and '.join(sorted(self._names))}, wanted {wanted}")

    @abstractmethod
    def _read(self, path: str | os.PathLike[str]) -> bytes:
        """Read and check the file, keep its description, and return its bytes."""

    def _run(self, inputs: Inputs, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """Return the output of the network; raise OgmError if it has another shape or type."""
        try:
            result = self._session(inputs)
        except Exception as error:  # the runtimes' errors have no common class
            raise OgmError(f"{self._path} does not accept the input that it describes: {error}") from error
        if result.shape != shape or result.dtype != np.float32:
            raise OgmError(f"{self._path} gives {result.dtype} {result.shape}, wanted float32 {shape}")
        return result

    def __repr__(self) -> str:
        _, runtime, computed, _ = self._arguments
        precision = computed if self.precision == "float32" else self.precision
        return f"{type(self).__name__}({self._sha256[:16]}, {runtime}, {precision})"

    def __reduce__(self) -> tuple[Any, ...]:
        return _reopened, (type(self), *self._arguments)


@lru_cache(4)
def _reopened(kind: type[ExportedNetwork], path: str, runtime: str, precision: str, threads: int) -> ExportedNetwork:
    """Return an unpickled network; each process opens its file once."""
    return kind(path, runtime=runtime, precision=precision, threads=threads)


def default_threads() -> int:
    """Return the default number of threads: ``OMP_NUM_THREADS``, or the number of cores of the process."""
    given = os.environ.get("OMP_NUM_THREADS", "").split(",")[0]
    if given.isdecimal() and int(given) > 0:
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _onnxruntime(data: bytes, output: str, threads: int) -> tuple[Run, set[str]]:
    runtime = import_extra("onnxruntime", "deep")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3  # only errors
    # Waiting threads sleep: spinning, the default, takes the cores from other programs on the vehicle.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    session = runtime.InferenceSession(data, options, providers=["CPUExecutionProvider"])

    def run(inputs: Inputs) -> NDArray[np.float32]:
        result: NDArray[np.float32] = session.run([output], inputs)[0]
        return result

    return run, {node.name for node in session.get_inputs()}


def _openvino(data: bytes, output: str, precision: str, threads: int) -> tuple[Run, set[str]]:
    openvino = import_extra("openvino", "openvino")
    core = openvino.Core()
    options = {
        "INFERENCE_PRECISION_HINT": {"float32": "f32", "bfloat16": "bf16"}[precision],
        "INFERENCE_NUM_THREADS": threads,
        "PERFORMANCE_HINT": "LATENCY",
        "ENABLE_CPU_PINNING": False,
    }
    compiled = core.compile_model(core.read_model(data, b""), "CPU", options)
    request, lock = compiled.create_infer_request(), threading.Lock()

    def run(inputs: Inputs) -> NDArray[np.float32]:
        with lock:  # a request serves one thread at a time
            result: NDArray[np.float32] = request.infer(dict(inputs), share_inputs=True)[output].copy()
            return result

    return run, {node.any_name for node in compiled.inputs}
