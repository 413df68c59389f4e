"""Exported networks from elsewhere: files that are damaged, foreign or hostile are refused before they are run."""

import json
from collections.abc import Callable
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import each, refused
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ogm.deep.onnx_engine import OnnxEngine
from ogm.deep.onnx_file import FORMAT, read_onnx
from ogm.storage.files import OgmError

onnx = pytest.importorskip("onnx")


@pytest.fixture(scope="module")
def shipped() -> bytes:
    with as_file(files("ogm") / "data" / "lite.onnx") as path:
        return path.read_bytes()


def written(folder: Path, data: bytes) -> Path:
    (folder / "some.onnx").write_bytes(data)
    return folder / "some.onnx"


@pytest.fixture
def path(tmp_path: Path, shipped: bytes) -> Path:
    return written(tmp_path, shipped)


def of_key(model: Any, key: str) -> Any:
    """Return an entry of a model's metadata."""
    (entry,) = (one for one in model.metadata_props if one.key == key)
    return entry


def change(path: Path, how: Callable[[Any], Any]) -> None:
    """Change a model by ONNX's own package, and leave the checksum out."""
    model = onnx.load(path)
    for entry in [one for one in model.metadata_props if one.key == "sha256"]:
        model.metadata_props.remove(entry)
    how(model)
    path.write_bytes(model.SerializeToString())


def change_input(path: Path, **numbers: Any) -> None:
    def how(model: Any) -> None:
        entry = of_key(model, "input")
        entry.value = json.dumps(json.loads(entry.value) | numbers)

    change(path, how)


def test_it_reads_what_onnx_reads(path: Path) -> None:
    model, file = onnx.load(path), read_onnx(path)
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    assert metadata["format"] == FORMAT
    assert file.description == json.loads(metadata["description"])
    assert file.weights_sum == metadata["weights"]
    np.testing.assert_array_equal(file.weight, np.float32(json.loads(metadata["input"])["weight"]))


def test_a_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    refused("ogm export", read_onnx, tmp_path / "no.onnx", error=FileNotFoundError)


@each("size", [0, 1, 100, 5000, 10**6, -1])
def test_a_file_that_is_cut_off_is_refused(path: Path, shipped: bytes, size: int) -> None:
    path.write_bytes(shipped[:size])
    refused(r"some\.onnx", read_onnx, path, error=OgmError)


@each("data", [b"not a model", b"\x80\x04K\x01.", b"\xff" * 100, b"\x08\x07", b"{}"])
def test_other_files_are_refused(path: Path, data: bytes) -> None:
    path.write_bytes(data)
    refused("no complete ONNX file", read_onnx, path, error=OgmError)


@settings(deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.integers(0, 40_000), byte=st.integers(0, 255), from_end=st.booleans())
def test_damage_is_refused_or_harmless(path: Path, shipped: bytes, at: int, byte: int, from_end: bool) -> None:
    """One wrong byte in what describes the network: an OgmError, or a description as before."""
    data = bytearray(shipped)
    data[-1 - at if from_end else at] = byte
    path.write_bytes(data)
    try:
        file = read_onnx(path)
    except OgmError:
        return
    assert np.isfinite(file.weight).all()


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=300))
def test_noise_is_refused(path: Path, data: bytes) -> None:
    path.write_bytes(data)
    with pytest.raises(OgmError):
        read_onnx(path)


def test_a_huge_file_is_refused_unread(path: Path) -> None:
    with path.open("r+b") as file:
        file.truncate(2**28 + 1)  # sparse
    refused("bytes", read_onnx, path, error=OgmError)


def other_function(model: Any) -> None:
    node = onnx.helper.make_node("Relu", ["x"], ["y"])
    model.functions.append(onnx.helper.make_function("own", "Relu", ["x"], ["y"], [node], []))


def other_file(model: Any) -> None:
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = onnx.TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="/etc/passwd")


def other_range(model: Any) -> None:
    """Impossible ranges of the training data."""
    entry = of_key(model, "description")
    entry.value = json.dumps(json.loads(entry.value) | {"seen": {"height": [2, 1]}})


@each("how, message", [
        (lambda model: setattr(of_key(model, "format"), "value", "ogm.network.onnx/1"), "export the weights again"),
        (lambda model: setattr(of_key(model, "format"), "value", "ogm.network.onnx/3"), "update ogm"),
        (lambda model: model.ClearField("metadata_props"), "has the format None"),
        (lambda model: setattr(model.graph.node[0], "op_type", "Loop"), "its operation .*Loop"),
        (lambda model: setattr(model.graph.node[0], "op_type", "ConstantOfShape"), "its operation .*ConstantOfShape"),
        (lambda model: setattr(model.graph.node[0], "op_type", "If"), "its operation .*If"),
        (lambda model: setattr(model.graph.node[0], "op_type", "Tile"), "its operation .*Tile"),
        (lambda model: setattr(model.graph.node[0], "domain", "com.microsoft"), r"com\.microsoft"),
        (other_function, "functions"),
        (other_file, "another file"),
        (other_range, "seen"),
    ])  # fmt: skip
def test_other_models_are_refused(tmp_path: Path, shipped: bytes, how: Callable[[Any], Any], message: str) -> None:
    path = written(tmp_path, shipped)
    change(path, how)
    refused(message, read_onnx, path, error=OgmError)


def test_other_places_for_numbers_are_refused(path: Path, shipped: bytes) -> None:
    """Sparse tensors, and attributes that are tensors or graphs, could name other files too."""

    def sparse(model: Any) -> None:
        tensor = model.graph.sparse_initializer.add()
        tensor.values.data_location = onnx.TensorProto.EXTERNAL
        tensor.values.external_data.add(key="location", value="/etc/passwd")

    change(path, sparse)
    refused("sparse tensors", read_onnx, path, error=OgmError)
    tensor = onnx.TensorProto(data_location=onnx.TensorProto.EXTERNAL)
    graph = onnx.GraphProto()
    for value in (tensor, graph, [tensor], [graph], onnx.SparseTensorProto(), [onnx.SparseTensorProto()]):
        path.write_bytes(shipped)
        change(
            path,
            lambda model, value=value: model.graph.node[0].attribute.append(onnx.helper.make_attribute("more", value)),
        )
        refused("is a tensor or a graph", read_onnx, path, error=OgmError)


@each("part, value", [
        ("weight", [[1.0]]), ("weight", "much"), ("weight", [[float("nan")] * 16] * 9), ("bias", [1.0] * 3),
        ("bias", [[1.0]] * 16), ("bias", 1.0), ("bias", [1e39] * 16), ("weight", [[1.0] * 5000] * 9), ("rays", 1),
        ("rays", None), ("z_range", [1.0]), ("z_range", [2.0, 1.0]), ("z_range", [float("nan"), 1.0]),
        ("multiple", 0), ("multiple", "16"),
    ])  # fmt: skip
@pytest.mark.filterwarnings("ignore:overflow encountered")
def test_an_input_that_cannot_be_is_refused(tmp_path: Path, shipped: bytes, part: str, value: Any) -> None:
    path = written(tmp_path, shipped)
    change_input(path, **{part: value})
    refused("describes no valid network", read_onnx, path, error=OgmError)


def test_an_input_that_does_not_fit_the_network_is_refused_when_it_runs(path: Path) -> None:
    change_input(path, weight=[[1.0] * 17] * 9, bias=[1.0] * 17)
    engine = OnnxEngine(path)
    scan = engine.pillars(np.ones((5, 4), np.float32), (0, 0, 0, 0), np.eye(4))
    refused("does not accept the input that it describes", engine.masses, [scan], error=OgmError)


def test_a_graph_that_does_not_hold_together_is_refused(path: Path) -> None:
    change(path, lambda model: model.graph.node.__delitem__(3))
    refused("cannot be run by onnxruntime", OnnxEngine, path, error=OgmError)
