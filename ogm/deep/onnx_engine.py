"""An exported network, run by ONNX Runtime or by OpenVINO: inference without torch."""

import copy
import hashlib
import importlib
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from types import ModuleType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ogm.deep.network_grid import check_resolution, check_sides, sensor_coords
from ogm.deep.onnx_file import OnnxFile, read_onnx
from ogm.deep.points import Rectangle, SortedPoints, pillar_maxima, sort_points
from ogm.grid import GridSpec
from ogm.storage.files import OgmError

__all__ = ["OnnxEngine", "default_threads", "onnxruntime_session"]

Inputs = Mapping[str, NDArray[np.float32]]
Session = Callable[[Inputs], NDArray[np.float32]]


class OnnxEngine:
    """An exported network that is ready to run, on one grid.

    Parameters
    ----------
    path : path
        Of a file that `ogm.deep.export.export_onnx` wrote.
    runtime : "onnxruntime" or "openvino"
        What computes.
    precision : "float32" or "bfloat16"
        The numbers that the convolutions are computed in. ONNX Runtime knows float32 alone.
    threads : int, optional
        That one scan is computed by. By default `default_threads`.

    Attributes
    ----------
    spec : GridSpec
        The grid around the sensor; at first that of the training.
    rays : bool
        Whether the network takes the masses of `ogm.geometric.RayISM` too.
    description : dict
        Of the weights.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If the file is damaged or of another kind.
    ValueError
        If the runtime lacks the precision.
    ImportError
        If the runtime is not installed; the message holds the pip command that adds it.

    Notes
    -----
    Threads may share an engine. The same scan gives the same masses, bit by bit, on the same machine with the same
    number of threads.
    """

    description: dict[str, Any]
    rays: bool
    spec: GridSpec

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        runtime: str = "onnxruntime",
        precision: str = "float32",
        threads: int | None = None,
    ) -> None:
        if precision not in ("float32", "bfloat16"):
            raise ValueError(f"the precision is float32 or bfloat16, got {precision!r}")
        if runtime == "onnxruntime" and precision != "float32":
            raise ValueError(f"ONNX Runtime computes in float32, got {precision!r}; openvino and torch know it")
        threads = default_threads() if threads is None else threads
        if threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        self._file = file = read_onnx(path)
        self._options = os.path.abspath(path), runtime, precision, threads
        try:
            if runtime == "openvino":
                self._session, names = _openvino(file.data, precision, threads)
            else:
                self._session, names = onnxruntime_session(file.data, threads)
        except ImportError:
            raise
        except Exception as error:  # those of the runtimes have no other parent
            raise OgmError(f"{path} cannot be run by {runtime}: {error}") from error
        if names not in ({"feature_map"}, {"feature_map", "sensor_coords"}):
            raise OgmError(f"{path} takes {sorted(names)}, wanted feature_map and, for some networks, sensor_coords")
        self._bearings = "sensor_coords" in names
        self._path = os.fspath(path)
        self.sha256 = hashlib.sha256(file.data).hexdigest()
        self.description, self.rays = file.description, file.rays
        self.spec = file.spec
        check_sides(self.spec, file.multiple)
        self._coords = self._fixed_inputs()

    def on(self, spec: GridSpec) -> Self:
        """Return the same network for another grid of the same resolution.

        Raises
        ------
        ValueError
            If the resolution differs, or the cells cannot be halved as often as the network does.
        """
        check_resolution(spec, self.spec)
        check_sides(spec, self._file.multiple)
        other = copy.copy(self)
        other.spec = spec
        other._coords = other._fixed_inputs()
        return other

    def __repr__(self) -> str:
        return f"OnnxEngine({self.sha256[:16]}, {', '.join(map(str, self._options[1:3]))})"

    def __reduce__(self) -> tuple[Any, ...]:
        return _reopened, (*self._options, self.spec)

    def __copy__(self) -> Self:  # not by `__reduce__`: it shares the session
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        return other

    def pillars(
        self, points: NDArray[np.float32], ego_footprint: Rectangle, T: NDArray[np.floating[Any]]
    ) -> SortedPoints:
        """Sort the points of a scan into the pillars of the grid; see `ogm.deep.points.sort_points`."""
        return sort_points(points, self.spec, self._file.z_range, ego_footprint, T)

    def masses(
        self, scans: Sequence[SortedPoints], rays: Sequence[NDArray[np.float32]] | None = None
    ) -> NDArray[np.float32]:
        """Return belief masses (scans, nx, ny, 2): free, occupied.

        Parameters
        ----------
        scans : sequence of SortedPoints
        rays : sequence of (nx, ny, 2) float32 arrays, optional
            Of each scan the masses of `ogm.geometric.RayISM`, if the network takes them.

        Raises
        ------
        OgmError
            If the network in the file gives something else.
        """
        return np.stack([self._one(scan, None if rays is None else rays[k]) for k, scan in enumerate(scans)])

    def _one(self, scan: SortedPoints, rays: NDArray[np.float32] | None) -> NDArray[np.float32]:
        file: OnnxFile = self._file
        channels = len(file.bias) + 2 * file.rays
        feature_map = pillar_maxima(scan, file.weight, file.bias, self.spec.shape, channels)
        if file.rays:
            feature_map[0, ..., -2:] = rays
        try:
            mass = self._session({"feature_map": feature_map, **self._coords})
        except Exception as error:  # those of the runtimes have no other parent
            raise OgmError(f"{self._path} does not fit the input that it describes: {error}") from error
        if mass.shape != (*self.spec.shape, 2) or mass.dtype != np.float32:
            raise OgmError(f"{self._path} gives {mass.dtype} {mass.shape} on a grid of {self.spec.shape} cells")
        return mass

    def _fixed_inputs(self) -> dict[str, NDArray[np.float32]]:
        return {"sensor_coords": np.ascontiguousarray(sensor_coords(self.spec))} if self._bearings else {}


@lru_cache(2)
def _opened(path: str, runtime: str, precision: str, threads: int) -> OnnxEngine:
    return OnnxEngine(path, runtime=runtime, precision=precision, threads=threads)


def _reopened(path: str, runtime: str, precision: str, threads: int, spec: GridSpec) -> OnnxEngine:
    """Return a pickled engine in another process, which opens its file once."""
    return _opened(path, runtime, precision, threads).on(spec)


def default_threads() -> int:
    """Return how many threads compute a scan: ``OMP_NUM_THREADS``, as for torch, or the cores of the process."""
    given = os.environ.get("OMP_NUM_THREADS", "").split(",")[0]
    if given.isdecimal() and int(given) > 0:
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def onnxruntime_session(data: bytes, threads: int, output: str = "mass") -> tuple[Session, set[str]]:
    """Return what computes an output of an exported network from its inputs, and their names."""
    runtime = _package("onnxruntime", "deep")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3  # errors; they are raised as well
    # Threads that wait sleep: spinning, the default, takes the cores from whatever else runs on the vehicle.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    session = runtime.InferenceSession(data, options, providers=["CPUExecutionProvider"])

    def run(inputs: Inputs) -> NDArray[np.float32]:
        result: NDArray[np.float32] = session.run([output], inputs)[0]
        return result

    return run, {one.name for one in session.get_inputs()}


def _openvino(data: bytes, precision: str, threads: int) -> tuple[Session, set[str]]:
    openvino = _package("openvino", "openvino")
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
            result: NDArray[np.float32] = request.infer(dict(inputs), share_inputs=True)["mass"].copy()
            return result

    return run, {one.any_name for one in compiled.inputs}


def _package(name: str, extra: str) -> ModuleType:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        pip = f'pip install "ogm-toolkit[{extra}]"'
        raise ImportError(f"the engine {name} needs its package, which is missing ({error}): {pip}") from error
