"""ONNX: the exported network is the network, the file explains itself, and bad files and paths are refused."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ogm.deep.export import FORMAT, export_onnx, onnx_inputs, run_onnx
from ogm.deep.network import LITE, PAPER, NetworkConfig, PillarNetwork, fused
from ogm.deep.pillars import Pillars, collate, pillarize
from ogm.grid import GridSpec

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript")

SPEC = GridSpec.centered(length=10.24, width=5.12, resolution=0.16)
NETWORKS = {
    "small": replace(LITE, blocks=((8, 1), (12, 2), (16, 1), (16, 1))),
    "paper": replace(PAPER, evidence="relu"),  # as published
}


def trained(config: NetworkConfig) -> PillarNetwork:
    """Make a network whose normalisation is not the identity, as after training."""
    torch.manual_seed(1)
    network = PillarNetwork(config, SPEC).eval()
    for module in network.modules():
        if isinstance(module, torch.nn.modules.batchnorm._BatchNorm):
            torch.nn.init.normal_(module.running_mean, 0, 0.1)
            torch.nn.init.uniform_(module.running_var, 0.5, 2)
            torch.nn.init.uniform_(module.weight, 0.5, 2)
            torch.nn.init.normal_(module.bias, 0, 0.3)
    return network


def scan(n: int) -> np.ndarray:
    rng = np.random.default_rng(n)
    low, high = (-6, -3, -0.5, 0), (6, 3, 2.5, 1)
    return rng.uniform(low, high, (n, 4)).astype(np.float32)


def mass_of(network: PillarNetwork, pillars: Pillars) -> np.ndarray:
    with torch.inference_mode():
        evidence = network(pillars)[0]
    return (evidence / (evidence.sum(-1, keepdim=True) + 2)).numpy()


@pytest.fixture(scope="module", params=NETWORKS)
def exported(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[PillarNetwork, Path]:
    network = trained(NETWORKS[request.param])
    path = tmp_path_factory.mktemp("onnx") / f"{request.param}.onnx"
    facts = export_onnx(network, path)
    assert all(isinstance(value, str) for value in facts.values())
    return network, path


@pytest.mark.parametrize("points", [scan(3000), scan(0), np.float32([[1, 0.5, 0.2, 0.4]])], ids=len)
def test_onnx_runtime_gives_the_networks_masses(exported: tuple[PillarNetwork, Path], points: np.ndarray) -> None:
    network, path = exported
    pillars = pillarize(points, SPEC, network.config.z_range)
    wanted = mass_of(network, pillars)
    mass = run_onnx(path, pillars)
    assert mass.shape == (*SPEC.shape, 2)
    assert mass.dtype == np.float32
    np.testing.assert_allclose(mass, wanted, atol=1e-4)
    assert wanted.max() - wanted.min() > 0.1  # it is no constant that was compared


def test_the_order_of_points_does_not_matter(exported: tuple[PillarNetwork, Path]) -> None:
    network, path = exported
    pillars = pillarize(scan(3000), SPEC, network.config.z_range)
    inputs = onnx_inputs(pillars)
    shuffled = np.random.default_rng(0).permutation(len(inputs["cells"]))
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    (mass,) = session.run(["mass"], {name: values[shuffled] for name, values in inputs.items()})
    np.testing.assert_allclose(mass, run_onnx(path, pillars), atol=1e-5)


def test_the_file_explains_itself(exported: tuple[PillarNetwork, Path]) -> None:
    network, path = exported
    model = onnx.load(path)
    onnx.checker.check_model(model, full_check=True)
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    assert metadata["format"] == FORMAT
    place = json.loads(metadata["spec"])
    assert GridSpec(place["resolution"], tuple(place["shape"]), tuple(place["origin"])) == SPEC
    assert tuple(json.loads(metadata["z_range"])) == network.config.z_range
    assert NetworkConfig.from_dict(json.loads(metadata["network"])) == network.config
    for value in (*model.graph.input, *model.graph.output):
        assert value.doc_string == metadata[value.name]
    assert [value.name for value in model.graph.input] == ["features", "cells"]
    assert [value.name for value in model.graph.output] == ["mass"]


def test_the_rule_for_cells_in_the_file_is_true(exported: tuple[PillarNetwork, Path]) -> None:
    network, _ = exported
    pillars = pillarize(scan(3000), SPEC, network.config.z_range)
    inputs = onnx_inputs(pillars)
    x, y = inputs["features"][:, 0], inputs["features"][:, 1]
    ix, iy = (np.floor((v - o) / SPEC.resolution) for v, o in zip((x, y), SPEC.origin, strict=True))
    np.testing.assert_array_equal(inputs["cells"], ix * SPEC.shape[1] + iy)


def test_the_file_names_no_folder_of_the_machine(exported: tuple[PillarNetwork, Path]) -> None:
    _, path = exported
    data = path.read_bytes()
    assert str(Path(__file__).parents[2]).encode() not in data
    assert b".py" not in data


def test_a_cell_off_the_grid_is_refused(exported: tuple[PillarNetwork, Path]) -> None:
    _, path = exported
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    inputs = {"features": np.zeros((1, 9), np.float32), "cells": np.array([SPEC.shape[0] * SPEC.shape[1]])}
    with pytest.raises(Exception, match="out of (data )?bounds|indices"):
        session.run(["mass"], inputs)


def test_only_names_that_end_in_onnx_are_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"named \.onnx"):
        export_onnx(trained(NETWORKS["small"]), tmp_path / "lite.pt")
    assert not list(tmp_path.iterdir())


def test_a_fused_network_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="load_network"):
        export_onnx(fused(trained(NETWORKS["small"])), tmp_path / "lite.onnx")
    assert not list(tmp_path.iterdir())


def test_a_missing_folder_is_refused_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="create it first"):
        export_onnx(None, tmp_path / "no" / "lite.onnx")  # type: ignore[arg-type]


def test_a_failed_export_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "lite.onnx"
    path.write_bytes(b"before")

    def fail(network: PillarNetwork) -> None:
        raise RuntimeError("no")

    monkeypatch.setattr("ogm.deep.export._model", fail)
    with pytest.raises(RuntimeError, match="no"):
        export_onnx(trained(NETWORKS["small"]), path)
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("package", ["onnx", "onnxscript"])
def test_a_missing_package_is_answered_with_the_pip_command(
    package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(ImportError, match=r'pip install "ogm-toolkit\[onnx\]"'):
        export_onnx(trained(NETWORKS["small"]), tmp_path / "lite.onnx")
    assert not list(tmp_path.iterdir())


def test_a_missing_runtime_is_answered_with_the_pip_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ImportError, match=r'pip install "ogm-toolkit\[onnx\]"'):
        run_onnx("lite.onnx", pillarize(scan(0), SPEC))


def test_damaged_foreign_and_missing_files_are_refused(exported: tuple[PillarNetwork, Path], tmp_path: Path) -> None:
    _, whole = exported
    pillars = pillarize(scan(10), SPEC)
    path = tmp_path / "some.onnx"
    with pytest.raises(FileNotFoundError, match="ogm export"):
        run_onnx(path, pillars)
    for data in (b"", b"not a model", whole.read_bytes()[:5000]):
        path.write_bytes(data)
        with pytest.raises(ValueError, match="no whole ONNX file"):
            run_onnx(path, pillars)
    model = onnx.load(whole)
    del model.metadata_props[:]
    onnx.save(model, path)
    with pytest.raises(ValueError, match="has the format None"):
        run_onnx(path, pillars)


def test_more_than_one_scan_is_refused() -> None:
    pillars = pillarize(scan(10), SPEC)
    with pytest.raises(ValueError, match="one scan at a time"):
        onnx_inputs(collate([pillars, pillars], SPEC.shape[0] * SPEC.shape[1]))
