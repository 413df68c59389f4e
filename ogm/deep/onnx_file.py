"""Exported networks as files, which are checked before an engine runs them.

An ONNX file is a program. A file is accepted only if `ogm.deep.export` could have written it: it has the right format,
contains only operations of networks, and does not refer to other files. No ONNX package is needed: this module reads
the first two levels of protocol buffers (https://protobuf.dev/programming-guides/encoding, fields of onnx/onnx.proto).
"""

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.deep.description import check_description, grid_of
from ogm.deep.points import FEATURES
from ogm.grid import GridSpec
from ogm.storage.files import OgmError, update_hint

FORMAT = "ogm.network.onnx/2"
OPERATIONS = frozenset({
    "Abs", "Add", "Conv", "ConvTranspose", "DepthToSpace", "DequantizeLinear", "Div", "Exp", "Gather", "Log", "Neg",
    "QuantizeLinear", "Relu", "Resize", "Split", "Transpose",
})  # fmt: skip
_MAX_SIZE = 2**28  # [bytes]
_MAX_CHANNELS = 4096
_GRAPH, _FUNCTIONS, _METADATA = 7, 25, 14  # fields of a model
_NODE, _INITIALIZER, _SPARSE = 1, 5, 15  # fields of a graph
_OPERATION, _ATTRIBUTE, _DOMAIN = 4, 5, 7  # fields of a node
_LARGE = frozenset({5, 6, 10, 11, 22, 23})  # fields of an attribute: tensors and graphs, which may refer to other files
_SEAL = 76  # [bytes] size of the entry that `sealed` adds
_DATA_LOCATION = 14  # field of an initializer: 1 if its numbers are in another file


@dataclass(frozen=True, eq=False)
class OnnxFile:
    """Content of a file with an exported network.

    Attributes
    ----------
    data : bytes
        Bytes of the file.
    description : dict
        Description of the weights, the content of their JSON file.
    spec : GridSpec
        Grid of the training, around the sensor.
    z_range : (float, float)
        Heights above the ground of the points to keep [m].
    multiple : int
        Number of cells of which both sides of a grid must be multiples.
    rays : bool
        Whether the last two channels of the feature map are the masses of `ogm.geometric.RayISM`.
    weight, bias : (9, C), (C,) float32
        Parameters of the pillars' linear layer.
    weights_sum : str
        SHA-256 of the exported weights; empty for an export from a network in memory.
    precision : "float32" or "int8"
        Number format of the convolutions.
    """

    data: bytes = field(repr=False)
    description: dict[str, Any] = field(repr=False)
    spec: GridSpec
    z_range: tuple[float, float]
    multiple: int
    rays: bool
    weight: NDArray[np.float32] = field(repr=False)
    bias: NDArray[np.float32] = field(repr=False)
    weights_sum: str
    precision: str


def read_onnx(path: str | os.PathLike[str]) -> OnnxFile:
    """Read and check a network that `ogm.deep.export.export_onnx` wrote.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If the file is damaged, of another kind, or has content that no export writes.
    """
    data, metadata = _read_metadata(path)
    try:
        numbers = {name: json.loads(metadata[name]) for name in ("description", "input")}
        facts = metadata.get("weights", ""), metadata.get("precision", "float32")
        return _checked(data, numbers["description"], numbers["input"], *facts)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise OgmError(f"{path} describes no valid network: {error!r}; export the weights again") from error


def _read_metadata(path: str | os.PathLike[str]) -> tuple[bytes, dict[str, str]]:
    """Return the bytes and the metadata of an exported network; for errors see `read_onnx`."""
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no {path}: `ogm export` writes exported networks")
    if path.stat().st_size > _MAX_SIZE:
        raise OgmError(f"{path} has {path.stat().st_size} bytes, wanted a network of at most {_MAX_SIZE}")
    data = path.read_bytes()
    try:
        metadata = _read_model(data)
    except (IndexError, ValueError, KeyError, TypeError) as error:
        raise OgmError(f"{path} is no complete ONNX file of `ogm export`: {error}") from error
    if (found := metadata.get("format")) != FORMAT:
        kind = FORMAT.rpartition("/")[0] + "/"
        way = update_hint(found, FORMAT) or ("; export the weights again" if str(found).startswith(kind) else "")
        raise OgmError(f"{path} has the format {found!r}, this version of ogm runs {FORMAT}{way}")
    if "sha256" in metadata and sealed(data[:-_SEAL]) != data:
        raise OgmError(f"{path} is damaged: its SHA-256 differs from its metadata; restore it or export again")
    return data, metadata


def sealed(data: bytes) -> bytes:
    """Return an ONNX file with a further metadata entry at the end, the SHA-256 of all bytes before it."""
    entry = b"\x0a\x06sha256\x12\x40" + hashlib.sha256(data).hexdigest().encode()  # key (field 1), value (field 2)
    return data + bytes([_METADATA << 3 | 2, len(entry)]) + entry


def weights_sum(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 of a file of weights."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def exported_from(path: Path, weights: Path) -> bool:
    """Return whether a network was exported from a file of weights."""
    return read_onnx(path).weights_sum == weights_sum(weights)


def _checked(data: bytes, description: Any, given: Mapping[str, Any], of_weights: str, precision: str) -> OnnxFile:
    check_description(description)
    weight, bias = (np.array(given[name], np.float32) for name in ("weight", "bias"))
    low, high = map(float, given["z_range"])
    rays, multiple = given["rays"], given["multiple"]
    good = (
        bias.ndim == 1
        and weight.shape == (FEATURES, len(bias))
        and np.isfinite(weight).all()
        and np.isfinite(bias).all()
        and -np.inf < low < high < np.inf
        and len(bias) <= _MAX_CHANNELS
        and type(rays) is bool
        and type(multiple) is int
        and 2 <= multiple <= 256
        and precision in ("float32", "int8")
    )
    if not good:
        raise ValueError("a size or a number of its input is out of range")
    return OnnxFile(
        data, description, grid_of(description), (low, high), multiple, rays, weight, bias, of_weights, precision
    )


def _read_model(data: bytes) -> dict[str, str]:
    """Return the metadata of a model; raise ValueError for parts that an export does not write."""
    metadata = {}
    graphs = 0
    for number, value in _fields(memoryview(data)):
        if number == _FUNCTIONS:
            raise ValueError("it defines functions")
        if number == _GRAPH:
            graphs += 1
            _check_graph(value)
        if number == _METADATA:
            entry = dict(_fields(value))
            metadata[_text(entry[1])] = _text(entry[2])
    if graphs != 1:
        raise ValueError(f"it has {graphs} graphs, wanted one")
    return metadata


def _check_graph(graph: memoryview) -> None:
    for number, value in _fields(graph):
        if number == _NODE:
            node = dict(_fields(value))
            name, domain = _text(node[_OPERATION]), _text(node.get(_DOMAIN, b""))
            if name not in OPERATIONS or domain not in ("", "ai.onnx"):
                raise ValueError(f"its operation {domain}.{name} is not used by networks")
            attributes = (attribute for field_number, attribute in _fields(value) if field_number == _ATTRIBUTE)
            if any(part in _LARGE for attribute in attributes for part, _ in _fields(attribute)):
                raise ValueError(f"an attribute of its operation {name} is a tensor or a graph, wanted a number")
        if number == _SPARSE:
            raise ValueError("it has sparse tensors, which networks do not use")
        if number == _INITIALIZER and dict(_fields(value)).get(_DATA_LOCATION, 0) != 0:
            raise ValueError("it keeps numbers in another file")


def _fields(data: memoryview) -> Iterator[tuple[int, Any]]:
    """Yield number and value of every field of a message; the value is an integer or bytes."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        number, kind = key >> 3, key & 7
        if kind == 0:
            value, at = _varint(data, at)
            yield number, value
            continue
        size, at = _varint(data, at) if kind == 2 else ({1: 8, 5: 4}.get(kind, -1), at)
        if number == 0 or not 0 <= size <= len(data) - at:
            raise ValueError(f"no field of a message begins at byte {at}")
        yield number, data[at : at + size]
        at += size


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    """Return the integer at an offset, with 7 bits per byte, and the offset after it."""
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at
        if shift > 63:
            raise ValueError(f"no number ends at byte {at}")


def _text(data: Any) -> str:
    if isinstance(data, int):  # `bytes` would make this number of zeros
        raise ValueError(f"it has the number {data} instead of a text")
    return bytes(data).decode()
