"""Exported networks from elsewhere: files that are damaged, foreign or hostile are refused before they are run."""

import json
from collections.abc import Callable
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import each
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


@pytest.fixture
def path(tmp_path: Path, shipped: bytes) -> Path:
    file = tmp_path / "some.onnx"
    file.write_bytes(shipped)
    return file


def change(path: Path, how: Callable[[Any], Any]) -> None:
    """Change a model by ONNX's own package, and leave the checksum out."""
    model = onnx.load(path)
    for entry in [one for one in model.metadata_props if one.key == "sha256"]:
        model.metadata_props.remove(entry)
    how(model)
    path.write_bytes(model.SerializeToString())


def change_input(path: Path, **numbers: Any) -> None:
    def how(model: Any) -> None:
        (entry,) = (one for one in model.metadata_props if one.key == "input")
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
    with pytest.raises(FileNotFoundError, match="ogm export"):
        read_onnx(tmp_path / "no.onnx")


@each("size", [0, 1, 100, 5000, 10**6, -1])
def test_a_file_that_is_cut_off_is_refused(path: Path, shipped: bytes, size: int) -> None:
    path.write_bytes(shipped[:size])
    with pytest.raises(OgmError, match=r"some\.onnx"):
        read_onnx(path)


@each("data", [b"not a model", b"\x80\x04K\x01.", b"\xff" * 100, b"\x08\x07", b"{}"])
def test_other_files_are_refused(path: Path, data: bytes) -> None:
    path.write_bytes(data)
    with pytest.raises(OgmError, match="no whole ONNX file"):
        read_onnx(path)


@settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
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
    with pytest.raises(OgmError, match="bytes"):
        read_onnx(path)


@each("found, way", [("ogm.network.onnx/1", "export the weights again"), ("ogm.network.onnx/3", "update ogm")])
def test_another_version_says_what_to_do(path: Path, found: str, way: str) -> None:
    def how(model: Any) -> None:
        (entry,) = (one for one in model.metadata_props if one.key == "format")
        entry.value = found

    change(path, how)
    with pytest.raises(OgmError, match=way):
        read_onnx(path)


def test_another_model_is_refused(path: Path) -> None:
    change(path, lambda model: model.ClearField("metadata_props"))
    with pytest.raises(OgmError, match="has the format None"):
        read_onnx(path)


@each("name", ["Loop", "ConstantOfShape", "If", "Tile"])
def test_operations_that_no_network_has_are_refused(path: Path, name: str) -> None:
    change(path, lambda model: setattr(model.graph.node[0], "op_type", name))
    with pytest.raises(OgmError, match=f"its operation .*{name}"):
        read_onnx(path)


def test_operations_of_other_makers_are_refused(path: Path) -> None:
    change(path, lambda model: setattr(model.graph.node[0], "domain", "com.microsoft"))
    with pytest.raises(OgmError, match=r"com\.microsoft"):
        read_onnx(path)


def test_functions_are_refused(path: Path) -> None:
    function = onnx.helper.make_function("own", "Relu", ["x"], ["y"], [onnx.helper.make_node("Relu", ["x"], ["y"])], [])
    change(path, lambda model: model.functions.append(function))
    with pytest.raises(OgmError, match="functions"):
        read_onnx(path)


def test_numbers_in_other_files_are_refused(path: Path) -> None:
    def how(model: Any) -> None:
        tensor = model.graph.initializer[0]
        tensor.ClearField("raw_data")
        tensor.data_location = onnx.TensorProto.EXTERNAL
        tensor.external_data.add(key="location", value="/etc/passwd")

    change(path, how)
    with pytest.raises(OgmError, match="another file"):
        read_onnx(path)


def test_other_places_for_numbers_are_refused(path: Path, shipped: bytes) -> None:
    """Sparse tensors, and attributes that are tensors or graphs, could name other files too."""

    def sparse(model: Any) -> None:
        tensor = model.graph.sparse_initializer.add()
        tensor.values.data_location = onnx.TensorProto.EXTERNAL
        tensor.values.external_data.add(key="location", value="/etc/passwd")

    change(path, sparse)
    with pytest.raises(OgmError, match="sparse numbers"):
        read_onnx(path)
    tensor = onnx.TensorProto(data_location=onnx.TensorProto.EXTERNAL)
    graph = onnx.GraphProto()
    for value in (tensor, graph, [tensor], [graph], onnx.SparseTensorProto(), [onnx.SparseTensorProto()]):
        path.write_bytes(shipped)
        change(
            path,
            lambda model, value=value: model.graph.node[0].attribute.append(onnx.helper.make_attribute("more", value)),
        )
        with pytest.raises(OgmError, match="is a tensor or a graph"):
            read_onnx(path)


@each(
    "part, value",
    [
        ("weight", [[1.0]]),
        ("weight", "much"),
        ("weight", [[float("nan")] * 16] * 9),
        ("bias", [1.0] * 3),
        ("bias", [[1.0]] * 16),
        ("bias", 1.0),
        ("bias", [1e39] * 16),
        ("weight", [[1.0] * 5000] * 9),
        ("rays", 1),
        ("rays", None),
        ("z_range", [1.0]),
        ("z_range", [2.0, 1.0]),
        ("z_range", [float("nan"), 1.0]),
        ("multiple", 0),
        ("multiple", "16"),
    ],
)
@pytest.mark.filterwarnings("ignore:overflow encountered")
def test_an_input_that_cannot_be_is_refused(path: Path, part: str, value: Any) -> None:
    change_input(path, **{part: value})
    with pytest.raises(OgmError, match="describes no network that can be run"):
        read_onnx(path)


def test_impossible_ranges_of_the_training_data_are_refused(path: Path) -> None:
    def how(model: Any) -> None:
        (entry,) = (one for one in model.metadata_props if one.key == "description")
        entry.value = json.dumps(json.loads(entry.value) | {"seen": {"height": [2, 1]}})

    change(path, how)
    with pytest.raises(OgmError, match="seen"):
        read_onnx(path)


def test_an_input_that_does_not_fit_the_network_is_refused_when_it_runs(path: Path) -> None:
    change_input(path, weight=[[1.0] * 17] * 9, bias=[1.0] * 17)
    engine = OnnxEngine(path)
    scan = engine.pillars(np.ones((5, 4), np.float32), (0, 0, 0, 0), np.eye(4))
    with pytest.raises(OgmError, match="does not fit the input that it describes"):
        engine.masses([scan])


def test_a_graph_that_does_not_hold_together_is_refused(path: Path) -> None:
    change(path, lambda model: model.graph.node.__delitem__(3))
    with pytest.raises(OgmError, match="cannot be run by onnxruntime"):
        OnnxEngine(path)
