"""Files that earlier versions wrote stay readable, with the same content.

``files_v0`` was written before the first release and has no checksums: the grid by commit 6f621a8, the data set of
format ogm.samples/2 by 1c81d52, the rest by 6d90c29. ``files_v0_1`` is of release 0.1. They are never written again. A
version that changes a format adds a folder, which ``python tests/test_old_files.py FOLDER`` fills.
"""

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ogm import DynamicGrid, EvidentialGrid, GridSpec, LayeredGrid, Mount
from ogm.io import GridLog, PlacedGrid, read_placed_grid, read_poses, write_grid
from ogm.pose import Trajectory, pose

HERE = Path(__file__).parent
FOLDERS = sorted(path.name for path in HERE.glob("files_v*"))
EVERY = pytest.mark.parametrize("folder", FOLDERS)


def every(pattern: str) -> pytest.MarkDecorator:
    """Run a test for each file of this name in all folders."""
    paths = sorted(HERE.glob(f"files_v*/{pattern}"))
    return pytest.mark.parametrize("path", paths, ids=[f"{path.parent.name}/{path.name}" for path in paths])


SPEC = GridSpec(0.25, (4, 3), (-1.0, 2.5))
GRID = EvidentialGrid(SPEC, (np.arange(24) % 5 / 10).reshape(4, 3, 2).astype(np.float32))
STEP = np.arange(12, dtype=np.float32).reshape(4, 3)
MASS = (np.arange(36) % 4 / 12).reshape(4, 3, 3).astype(np.float32)
MOVES = MASS[..., 2, None] > 0
VELOCITY = np.where(MOVES, np.float32([1.5, -0.5]), np.float32(np.nan))
COVARIANCE = np.where(MOVES[..., None], np.float32([[0.25, 0.1], [0.1, 0.5]]), np.float32(np.nan))
PLACED = PlacedGrid(GRID, pose(10.0, 20.0, 0.5), "utm", 12.5)
TRAJECTORY = Trajectory(np.array([0.5, 0.75]), np.array([np.eye(4), pose(1.0, 2.0, yaw=0.5)]))
NET = GridSpec(0.5, (8, 4), (-2.0, -1.0))


def dynamic() -> DynamicGrid:
    return DynamicGrid(SPEC, MASS, VELOCITY, COVARIANCE)


def layered() -> LayeredGrid:
    return LayeredGrid(SPEC, {"height": np.where(STEP > 0, STEP / 4, np.float32(np.nan)), "ä": -STEP})


@EVERY
def test_grids(folder: str) -> None:
    assert EvidentialGrid.load(HERE / folder / "grid.npz") == GRID
    assert DynamicGrid.load(HERE / folder / "dynamic.npz") == dynamic()
    assert LayeredGrid.load(HERE / folder / "layers.npz") == layered()


@every("map.*")
def test_placed_grids(path: Path) -> None:
    for package in {".nc": ("xarray", "netCDF4"), ".zarr": ("xarray", "zarr"), ".mcap": ("rosbags", "mcap")}[
        path.suffix
    ]:
        pytest.importorskip(package)
    found = read_placed_grid(path)
    assert (found.frame_id, found.stamp) == ("utm", 12.5)
    placed = found.upright.grid
    assert placed.spec.shape == (4, 3)
    assert placed.spec.origin == pytest.approx((9.0, 22.5), abs=1e-9)
    np.testing.assert_array_equal(placed.mass, GRID.mass)
    assert found.T_frame_grid[2, 3] == 0.5


@every("poses.csv")
def test_poses(path: Path) -> None:
    found = read_poses(path)
    assert found.format == "ogm.poses/1"
    np.testing.assert_array_equal(found.stamps, [0.5, 0.75])
    np.testing.assert_allclose(found.poses, TRAJECTORY.poses, atol=1e-12)


@every("ray.json")
def test_calibrations(path: Path) -> None:
    from ogm.models import Calibration

    calibration = Calibration.load(path)
    assert (calibration.model, calibration.parameters) == ("ray", {"p_miss": 0.3, "obstacle_height": 0.15})
    assert calibration.errors == {"p_miss": 0.01, "obstacle_height": None}


def sample(index: int, **changes: Any) -> Any:
    """Return a sample of numbers that a sine makes."""
    from ogm.simulation.sample import OBJECT_DTYPE, Beams, SimulatedSample, Weather
    from ogm.state import Truth
    from ogm.truth import TRUTH_SPEC

    beams = Beams("tiny", (-0.2, 0.1), (0.0, 0.01), 0.5, 12, 10.0, ((0.0, 0.0, 0.0), (0.0, 0.0, 0.1)))
    state = np.zeros(TRUTH_SPEC.shape, np.uint8)
    state[100:200, 50:90], state[300, 300 + index : 400], state[10:20] = 1, 2, 3
    objects = np.zeros(1, OBJECT_DTYPE)
    objects["label"], objects["x"], objects["length"], objects["track"], objects["returns"] = 1, 5.5, 4.25, 7 + index, 3
    steps = (np.arange(24).reshape(2, 12) * 97 + index).astype(np.uint16)
    heights = {"height_cm": ((state == 2) * 35).astype(np.uint8)} if changes.pop("heights", True) else {}
    return SimulatedSample(
        beams=beams,
        steps=steps,
        intensities=(np.arange(24).reshape(2, 12) * (steps > 0)).astype(np.uint8),
        truth=Truth(TRUTH_SPEC, state, **heights),
        objects=objects,
        T_world_sensor=pose(1.0 + index, 2.0, 0.5, yaw=0.25),
        T_vehicle_sensor=pose(0.0, 0.0, 1.75),
        velocity=np.array([5.0, 0.25, 0.0]),
        yaw_rate=0.125,
        stamp=20.0 + index,
        split="training",
        index=index,
        scenario=3,
        weather=Weather(rain=1.5),
        **changes,
    )


@every("samples*")
def test_data_sets(path: Path) -> None:
    pytest.importorskip("zarr")
    from ogm.simulation.store import Store

    store = Store.open(path)
    assert store.format == f"ogm.samples/{path.name[-1]}"
    assert store["training"].finished.tolist() == [0, 1]
    assert not [*store["training"].damage()]
    for index, found in enumerate(store["training"]):
        wanted = sample(index)
        for name in ("steps", "intensities", "objects", "velocity"):
            np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name), err_msg=name)
        for name in ("T_world_sensor", "T_vehicle_sensor"):  # computed anew here: the last digit may differ
            np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), rtol=0, atol=3e-16, err_msg=name)
        for name in ("beams", "yaw_rate", "stamp", "split", "index", "scenario", "weather"):
            assert getattr(found, name) == getattr(wanted, name), name
        np.testing.assert_array_equal(found.truth.state, wanted.truth.state)
        if store.format == "ogm.samples/2":
            assert found.truth.height_cm is None
        else:
            np.testing.assert_array_equal(found.truth.height_cm, wanted.truth.height_cm)
        assert (found.measured is not None) == (store.format == "ogm.samples/4")


def network() -> Any:
    """Return a small network whose weights are numbers that a sine makes."""
    import torch

    from ogm.deep.network import NetworkConfig, PillarNetwork

    made = PillarNetwork(NetworkConfig(pillar=4, blocks=((4, 1), (4, 1)), join="add"), NET)
    for k, value in enumerate(made.state_dict().values()):
        numbers = torch.sin(torch.arange(value.numel(), dtype=torch.float64) + k).reshape(value.shape)
        value.copy_((numbers + 1.5 if value.ndim < 2 else numbers).to(value.dtype))
    return made.eval()


MOUNT = Mount(1.9, ego_footprint=(0.0, 0.0, 0.0, 0.0))
SCAN = np.float32([[1.1, 0.3, 0.2, 0.5], [-0.9, 0.6, 0.1, 0.25], [1.2, 0.2, 0.4, 0.75]])
MASSES = {(0, 0): (0.45652, 0.54053), (2, 3): (0.0, 0.0), (6, 2): (0.56476, 0.43348), (7, 3): (0.38276, 0.61513)}


@EVERY
def test_weights(folder: str) -> None:
    pytest.importorskip("torch")
    from ogm.deep.checkpoint import load_network

    found, description = load_network(HERE / folder / "net.safetensors")
    assert description["seen"] == {"points": [0, 100]}
    assert found.spec == NET
    wanted = network().state_dict()
    for name, value in found.state_dict().items():
        np.testing.assert_allclose(value.numpy(), wanted[name].numpy(), rtol=1e-6, err_msg=name)


@every("net.*[sx]")
def test_networks_compute_the_same(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ogm.deep.ism.shows_ground", lambda *_: True)  # as its points do not, the network is not asked
    engine = "onnxruntime" if path.suffix == ".onnx" else "torch"
    pytest.importorskip(engine)
    from ogm.deep import DeepISM

    grid = DeepISM.load(path, engine=engine, mount=MOUNT)(SCAN)
    for cell, wanted in MASSES.items():
        assert grid.mass[cell] == pytest.approx(wanted, abs=2e-5)


def test_the_page_of_formats_has_every_format() -> None:
    root = HERE.parent
    page = (root / "docs" / "formats.md").read_text(encoding="utf-8")
    code = "".join(path.read_text(encoding="utf-8") for path in (root / "ogm").rglob("*.py"))
    stated = set(re.findall(r'"ogm\.([A-Za-z.]+/[0-9]+)"', code))
    assert len(stated) >= 11
    for one in stated:
        assert f"`ogm.{one}`" in page, one


def write(folder: Path) -> None:
    """Write all files by the code at hand."""
    from ogm.deep.checkpoint import load_network, save_network
    from ogm.deep.export import export_onnx
    from ogm.io import write_poses
    from ogm.models import Calibration
    from ogm.simulation.store import Store

    folder.mkdir(parents=True)
    for name, grid in {"grid": GRID, "dynamic": dynamic(), "layers": layered()}.items():
        grid.save(folder / f"{name}.npz")
    write_grid(folder / "map.nc", PLACED)
    write_grid(folder / "map.zarr", PLACED)
    with GridLog(folder / "map.mcap", "grid-map") as log:
        log.write(PLACED)
    write_poses(folder / "poses.csv", TRAJECTORY)
    Calibration("ray", {"p_miss": 0.3, "obstacle_height": 0.15}, errors={"p_miss": 0.01, "obstacle_height": None}).save(
        folder / "ray.json"
    )
    for number, plan in (("3", {}), ("4", {"recipe": "gen2"})):
        gaps = {"measured": np.ones((2, 12), bool)} if plan else {}
        samples = [sample(index, **gaps) for index in range(2)]
        store = Store.create(folder / f"samples{number}", plan, {"training": 2}, [samples[0].beams], {"ogm": "0"})
        store.write("training", 0, samples)
    save_network(folder / "net.safetensors", network(), {"seen": {"points": [0, 100]}})
    export_onnx(*load_network(folder / "net.safetensors")[:1], folder / "net.onnx")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
