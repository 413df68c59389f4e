"""ONNX Runtime and OpenVINO, which run exported networks without torch."""

import os
import threading
from collections.abc import Callable, Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.extras import import_extra

Inputs = Mapping[str, NDArray[np.float32]]
Run = Callable[[Inputs], NDArray[np.float32]]
OUTPUT = "mass"  # name of the network's output


def default_threads() -> int:
    """Return the default number of threads: ``OMP_NUM_THREADS``, or the number of cores of the process."""
    given = os.environ.get("OMP_NUM_THREADS", "").split(",")[0]
    if given.isdecimal() and int(given) > 0:
        return int(given)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def has_amx() -> bool:
    """Return whether the processor multiplies matrices of bfloat16 (Intel AMX), as Linux states it."""
    try:
        return " amx_bf16 " in Path("/proc/cpuinfo").read_text()
    except OSError:  # other systems
        return False


def prefers_openvino() -> bool:
    """Return whether OpenVINO in bfloat16 is the fastest engine here: with AMX, if it is installed."""
    return has_amx() and find_spec("openvino") is not None


def open_onnxruntime(data: bytes, threads: int) -> tuple[Run, set[str]]:
    """Return the network of an ONNX file in ONNX Runtime, and the names of its inputs."""
    runtime = import_extra("onnxruntime", "deep")
    options = runtime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.log_severity_level = 3  # only errors
    # Waiting threads sleep: spinning, the default, takes the cores from other programs on the vehicle.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    session = runtime.InferenceSession(data, options, providers=["CPUExecutionProvider"])

    def run(inputs: Inputs) -> NDArray[np.float32]:
        result: NDArray[np.float32] = session.run([OUTPUT], inputs)[0]
        return result

    return run, {node.name for node in session.get_inputs()}


def open_openvino(data: bytes, precision: str, threads: int) -> tuple[Run, set[str]]:
    """Return the network of an ONNX file in OpenVINO, and the names of its inputs."""
    openvino = import_extra("openvino", "openvino")
    core = openvino.Core()
    options = {
        "INFERENCE_PRECISION_HINT": {"float32": "f32", "bfloat16": "bf16"}[precision],
        "INFERENCE_NUM_THREADS": threads,
        "PERFORMANCE_HINT": "LATENCY",
        "ENABLE_CPU_PINNING": False,
    }
    model = core.read_model(data, b"")
    _join_softplus(model, import_extra("openvino.opset8", "openvino"))
    compiled = core.compile_model(model, "CPU", options)
    request, lock = compiled.create_infer_request(), threading.Lock()

    def run(inputs: Inputs) -> NDArray[np.float32]:
        with lock:  # a request serves one thread at a time
            result: NDArray[np.float32] = request.infer(dict(inputs), share_inputs=True)[OUTPUT].copy()
            return result

    return run, {node.any_name for node in compiled.inputs}


_SOFTPLUS = ["Abs", "Negative", "Exp", "Add", "Log", "Add", "Relu"]  # max(x, 0) + ln(1 + exp(-|x|)), as exported


def _join_softplus(model: Any, operations: Any) -> None:
    """Replace the steps of an exported softplus by one operation: with AMX they take a fifth of the network's time."""
    for first in model.get_ordered_ops():
        chain, following = [first], first.output(0).get_target_inputs() if first.get_type_name() == "Abs" else ()
        while len(following) == 1 and len(chain) < len(_SOFTPLUS):
            chain.append(next(iter(following)).get_node())
            following = chain[-1].output(0).get_target_inputs()
        if [node.get_type_name() for node in chain] == _SOFTPLUS:
            joined = operations.relu(operations.softplus(first.input_value(0)))  # relu: softplus may be -1e-6
            chain[-1].output(0).replace(joined.output(0))
