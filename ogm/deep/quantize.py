"""Quantised networks: convolutions in 8-bit integers, about twice as fast on a processor.

ONNX Runtime quantises statically. Activations become unsigned 8-bit integers, with ranges measured on scans. Weights
have 7 bits: sums then fit into 16 bits, and the result does not depend on the processor's instructions.

First, the channels are balanced in each chain of a convolution, a ReLU and a convolution. A positive factor per channel
moves between the two convolutions without a change of the result (SmoothQuant, Xiao et al. 2023, with the exponent
0.4). A few large channels then do not use up the resolution of all channels. The first two convolutions, with the
largest error, stay in float32, as does everything from the last convolution on: rounded terms of evidence would not sum
to masses.

>>> from ogm.datasets import open_dataset
>>> from ogm.deep.quantize import quantize_onnx
>>> quantize_onnx("lite.onnx", "lite.int8.onnx", open_dataset("data", split="train"))      # doctest: +SKIP
"""

import io
import logging
import os
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.deep.ism import DeepISM
from ogm.deep.onnx_engine import OnnxEngine
from ogm.deep.onnx_file import OPERATIONS, read_onnx, sealed
from ogm.deep.runtimes import Inputs
from ogm.extras import import_extra
from ogm.scan import Frame
from ogm.storage.files import OgmError, atomic_write

__all__ = ["quantize_onnx"]

SCANS = 32  # default number of frames
EXPONENT = 0.4  # share of the activations in the balance; the weights have the rest
PERCENTILE = 99.999  # percentile of the activations that the range of 8 bits contains


def quantize_onnx(
    source: str | os.PathLike[str], path: str | os.PathLike[str], frames: Iterable[Frame], *, scans: int = SCANS
) -> dict[str, str]:
    """Write an exported lidar network with convolutions in 8-bit integers.

    Parameters
    ----------
    source : path
        File from `ogm.deep.export.export_onnx`.
    path : path
        File to write, with the suffix ``.int8.onnx``, in one step.
    frames : iterable of Frame
        Scans similar to the training scans, which set the ranges of the activations. No truth is read.
    scans : int
        Largest number of frames to use.

    Returns
    -------
    dict
        Description of the file to print, with the key ``int8``.

    Raises
    ------
    ValueError
        If `path` has another suffix, or `frames` is empty.
    OgmError
        If `source` is damaged, of another kind, or already quantised.
    ImportError
        If the packages for the export are missing. The message has the pip command.
    """
    path = Path(path)
    if not path.name.endswith(".int8.onnx"):
        raise ValueError(f"the file name of a quantised network must end in .int8.onnx, got {path}")
    onnx = import_extra("onnx", "train")
    tools = import_extra("onnxruntime.quantization", "train")
    file = read_onnx(source)
    if file.precision != "float32":
        raise OgmError(f"{source} is already quantised: give the export in float32")
    samples = _recorded(source, islice(frames, scans))
    model = onnx.load_from_string(file.data)
    metadata = {entry.key: entry.value for entry in model.metadata_props} | {"precision": "int8"}
    metadata.pop("sha256", None)
    _balance(model, samples)
    convolutions = [k for k, node in enumerate(model.graph.node) if node.op_type == "Conv"]
    exact = [*convolutions[:2], *range(convolutions[-1], len(model.graph.node))]
    with tempfile.TemporaryDirectory() as folder, _quiet():
        balanced, small = (str(Path(folder) / f"{name}.onnx") for name in ("balanced", "small"))
        onnx.save(model, balanced)
        tools.quantize_static(
            balanced,
            small,
            _reader(tools, samples),
            quant_format=tools.QuantFormat.QDQ,
            activation_type=tools.QuantType.QUInt8,
            weight_type=tools.QuantType.QInt8,
            per_channel=True,
            reduce_range=True,
            op_types_to_quantize=["Conv", "Add", "Relu"],
            nodes_to_exclude=[model.graph.node[k].name for k in exact],
            calibrate_method=tools.CalibrationMethod.Percentile,
            extra_options={"CalibPercentile": PERCENTILE},
        )
        result = onnx.load(small)
    del result.metadata_props[:]
    onnx.helper.set_model_props(result, metadata)
    if unsupported := {node.op_type for node in result.graph.node} - OPERATIONS:
        raise RuntimeError(f"this version of onnxruntime wrote operations that ogm cannot run: {sorted(unsupported)}")
    with atomic_write(path) as target:
        size = target.write(sealed(result.SerializeToString(deterministic=True)))
    return {"int8": f"{path}, {size / 1e6:.1f} MB, ranges of {len(samples)} scans"}


class _Recorder(OnnxEngine):
    """Engine that keeps its inputs."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__(path)
        self.samples: list[Inputs] = []

    def _run(self, inputs: Inputs, shape: tuple[int, ...]) -> NDArray[np.float32]:
        self.samples.append(inputs)
        return np.zeros(shape, np.float32)


def _recorded(source: str | os.PathLike[str], frames: Iterable[Frame]) -> list[Inputs]:
    """Return the inputs of a network for the scans of frames."""
    engine = _Recorder(source)
    for frame in frames:
        DeepISM(engine, mount=frame.mount)(frame.scan)
    if not engine.samples:
        raise ValueError("no frames: give scans similar to the training scans, for the ranges of the activations")
    return engine.samples


def _balance(model: Any, samples: list[Inputs]) -> None:
    """Balance the channels of a model in place, without a change of its result."""
    from onnx import TensorProto
    from onnx.numpy_helper import from_array, to_array

    chains = _chains(model)
    largest = _largest(model, samples, [*chains])
    stored = {array.name: array for array in model.graph.initializer if array.data_type == TensorProto.FLOAT}
    weights = {name: to_array(array).astype(np.float64) for name, array in stored.items()}
    for name, (before, after) in chains.items():
        factors = _factors(largest[name], weights[after.input[1]])
        weights[before.input[1]] /= factors[:, None, None, None]
        for bias in before.input[2:]:
            weights[bias] /= factors
        weights[after.input[1]] *= factors[:, None, None]
    for name, array in stored.items():
        array.CopyFrom(from_array(weights[name].astype(np.float32), name))


def _chains(model: Any) -> dict[str, tuple[Any, Any]]:
    """Return the convolutions before and after each ReLU without other neighbours, by the name of the ReLU's result."""
    nodes = list(model.graph.node)
    maker = {name: node for node in nodes for name in node.output}
    users: dict[str, list[Any]] = {}
    for node in nodes:
        for name in node.input:
            users.setdefault(name, []).append(node)
    chains = {}
    for node in nodes:
        if node.op_type == "Relu":
            before, after = maker[node.input[0]], users[node.output[0]]
            if before.op_type == "Conv" and [user.op_type for user in after] == ["Conv"]:
                chains[node.output[0]] = before, after[0]
    return chains


def _largest(model: Any, samples: list[Inputs], names: list[str]) -> Mapping[str, NDArray[np.floating[Any]]]:
    """Return the largest value of each channel (C,) of tensors inside a model."""
    from onnx import ModelProto, TensorProto
    from onnx.helper import make_tensor_value_info

    watched = ModelProto()
    watched.CopyFrom(model)
    watched.graph.output.extend(make_tensor_value_info(name, TensorProto.FLOAT, None) for name in names)
    session = import_extra("onnxruntime", "deep").InferenceSession(
        watched.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    found = [[values.max(axis=(0, 2, 3)) for values in session.run(names, sample)] for sample in samples]
    return {name: np.max(values, axis=0) for name, values in zip(names, zip(*found, strict=True), strict=True)}


def _factors(activations: NDArray[np.floating[Any]], weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the factors (C,) that balance the largest activations (C,) and the next weights (., C, ., .)."""
    min_value = 1e-6  # smallest value, for channels that are always 0
    largest = np.maximum(abs(weight).max(axis=(0, 2, 3)), min_value)
    factors = np.maximum(activations, min_value) ** EXPONENT / largest ** (1 - EXPONENT)
    balanced: NDArray[np.float64] = factors / np.exp(np.log(factors).mean())
    return balanced


def _reader(tools: Any, samples: list[Inputs]) -> Any:
    """Return a calibration reader of ONNX Runtime over samples."""

    class Reader(tools.CalibrationDataReader):  # type: ignore[misc]
        def __init__(self) -> None:
            self.left = iter(samples)

        def get_next(self) -> Inputs | None:
            return next(self.left, None)

    return Reader()


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the advice that ONNX Runtime prints and logs to the root logger."""
    logging.disable(logging.WARNING)
    try:
        with redirect_stdout(io.StringIO()):
            yield
    finally:
        logging.disable(logging.NOTSET)
