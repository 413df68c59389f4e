"""ONNX: the exported network is the network, and the file explains itself."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from cases import each, needs, refused
from networks import SPEC, trained

from ogm.deep.export import export_onnx
from ogm.deep.export_parts import _Masses
from ogm.deep.network import LITE, PAPER, NetworkConfig, PillarNetwork
from ogm.deep.onnx_engine import OnnxEngine
from ogm.deep.onnx_file import FORMAT, OPERATIONS
from ogm.deep.pillars import Pillars, pillarize
from ogm.deep.points import SortedPoints, sort_points
from ogm.deep.torch_engine import fused
from ogm.grid import GridSpec

needs("onnx", "onnxruntime", "onnxscript")
pytestmark = pytest.mark.slow  # exporting takes a quarter of a minute

OTHER = GridSpec(0.16, (96, 16), (-3.2, -2.0))  # its sides are multiples of both networks'
NETWORKS = {
    "small": replace(LITE, blocks=((8, 1), (12, 2), (16, 1), (16, 1))),
    "paper": replace(PAPER, blocks=((8, 2), (8, 1), (8, 1)), up=8, evidence="relu"),  # as published
}


def scan(n: int) -> np.ndarray:
    rng = np.random.default_rng(n)
    low, high = (-6, -3, -0.5, 0), (6, 3, 2.5, 1)
    return rng.uniform(low, high, (n, 4)).astype(np.float32)


def mass_of(network: PillarNetwork, pillars: Pillars) -> np.ndarray:
    with torch.inference_mode():
        evidence = network(pillars)[0]
    return (evidence / (evidence.sum(-1, keepdim=True) + 2)).numpy()


def metadata_of(path: Path) -> dict[str, str]:
    import onnx

    return {entry.key: entry.value for entry in onnx.load(path).metadata_props}


@pytest.fixture(scope="module", params=["small", pytest.param("paper", marks=pytest.mark.slow)])
def exported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[PillarNetwork, Path]:
    network = trained(NETWORKS[request.param])
    path = tmp_path_factory.mktemp("onnx") / f"{request.param}.onnx"
    facts = export_onnx(network, path, description={"seen": {"height": [1.7, 2.0]}})
    assert all(isinstance(value, str) for value in facts.values())
    return network, path


@each("spec", [SPEC, OTHER])
@each("points", [scan(3000), scan(0), np.float32([[1, 0.5, 0.2, 0.4]])])
def test_the_exported_network_gives_the_networks_masses(
    exported: tuple[PillarNetwork, Path], points: np.ndarray, spec: GridSpec
) -> None:
    network, path = exported
    z_range = network.config.z_range
    wanted = mass_of(network.on(spec), pillarize(points, spec, z_range))
    (mass,) = OnnxEngine(path).on(spec).masses([sort_points(points, spec, z_range)])
    assert mass.shape == (*spec.shape, 2)
    assert mass.dtype == np.float32
    np.testing.assert_allclose(mass, wanted, atol=1e-5)
    assert wanted.max() - wanted.min() > 0.1  # it is no constant that was compared


def test_evidence_of_any_size_is_exact() -> None:
    """The softplus as it is exported, far beyond its bend on both sides."""
    network = trained(NETWORKS["small"])
    with torch.no_grad():
        network.head.weight *= 1000
    pillars = pillarize(scan(3000), SPEC)
    with torch.inference_mode():
        mass = _Masses(network)(network.feature_map(pillars).permute(0, 2, 3, 1))
    wanted = mass_of(network, pillars)
    assert wanted.min() < 1e-12
    assert wanted.max() > 0.99
    np.testing.assert_allclose(mass, wanted, atol=1e-4)


def test_the_file_explains_itself(exported: tuple[PillarNetwork, Path]) -> None:
    import onnx

    network, path = exported
    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    metadata = metadata_of(path)
    assert metadata["format"] == FORMAT
    description = json.loads(metadata["description"])
    place = description["spec"]
    assert GridSpec(place["resolution"], tuple(place["shape"]), tuple(place["origin"])) == SPEC
    assert NetworkConfig.from_dict(description["network"]) == network.config
    assert description["seen"] == {"height": [1.7, 2.0]}
    given = json.loads(metadata["input"])
    assert tuple(given["z_range"]) == network.config.z_range
    for value in (*model.graph.input, *model.graph.output):
        assert value.doc_string == metadata[value.name]
    names = ["feature_map", "sensor_coords"] if network.config.bearings else ["feature_map"]
    assert [value.name for value in model.graph.input] == names
    assert [value.name for value in model.graph.output] == ["mass"]
    assert {node.op_type for node in model.graph.node} <= OPERATIONS


def test_the_rules_in_the_file_are_true(exported: tuple[PillarNetwork, Path]) -> None:
    """The feature map by the metadata's words: of the points in a cell the largest max(0, features @ weight + bias)."""
    network, path = exported
    given = json.loads(metadata_of(path)["input"])
    points: SortedPoints = sort_points(scan(3000), SPEC, given["z_range"])
    x, y = points.features[:, 0], points.features[:, 1]
    ix, iy = (np.floor((v - o) / SPEC.resolution).astype(int) for v, o in zip((x, y), SPEC.origin, strict=True))
    wanted = np.zeros((*SPEC.shape, len(given["bias"])))
    values = points.features @ np.array(given["weight"]) + given["bias"]
    np.maximum.at(wanted, (ix, iy), values)
    with torch.inference_mode():
        found = network.feature_map(pillarize(scan(3000), SPEC, given["z_range"]))[0].permute(1, 2, 0)
    np.testing.assert_allclose(found, wanted, atol=1e-4)
    assert (wanted > 0).mean() > 0.1


def test_the_file_names_no_folder_of_the_machine(exported: tuple[PillarNetwork, Path]) -> None:
    _, path = exported
    data = path.read_bytes()
    assert str(Path(__file__).parents[2]).encode() not in data
    assert b".py" not in data


@pytest.mark.slow
def test_the_same_weights_give_the_same_bytes(tmp_path: Path) -> None:
    network = PillarNetwork(NetworkConfig(2, ((2, 1),), join="concatenate", up=2), SPEC).eval()
    for name in ("one.onnx", "other.onnx"):
        export_onnx(network, tmp_path / name)
    assert (tmp_path / "one.onnx").read_bytes() == (tmp_path / "other.onnx").read_bytes()


def test_what_cannot_be_exported_is_refused_before_the_work(tmp_path: Path) -> None:
    network = trained(NETWORKS["small"])
    refused(r"end in \.onnx", export_onnx, network, tmp_path / "lite.pt")
    refused("load_network", export_onnx, fused(network), tmp_path / "lite.onnx")
    refused("create it first", export_onnx, network, tmp_path / "no" / "lite.onnx", error=FileNotFoundError)
    assert not list(tmp_path.iterdir())


def test_a_failed_export_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "lite.onnx"
    path.write_bytes(b"before")

    def fail(parts: object) -> None:
        raise RuntimeError("no")

    monkeypatch.setattr("ogm.deep.export._model", fail)
    refused("no", export_onnx, trained(NETWORKS["small"]), path, error=RuntimeError)
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


@each("package", ["onnx", "onnxscript"])
def test_a_missing_package_is_answered_with_the_pip_command(
    package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=r'pip install .*\[train\]"'):
        export_onnx(trained(NETWORKS["small"]), tmp_path / "lite.onnx")
    assert not list(tmp_path.iterdir())
