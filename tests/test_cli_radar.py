"""Commands on data sets with radars."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
from cases import needs, refused
from commands import completed, refused_command
from samples import flat_sample, flat_steps

from ogm import EvidentialGrid, GridSpec, Mount, Scan
from ogm.geometric import RadarISM, RayISM
from ogm.models.named import load_model, with_radar
from ogm.pose import pose
from ogm.scan import Frame, run_model
from ogm.simulation.mounts import radars_at
from ogm.simulation.plan import DatasetPlan
from ogm.simulation.radars import RADARS
from ogm.simulation.sample import Beams, PlacedSweep, RadarSweep, SimulatedSample
from ogm.simulation.store import Store
from ogm.state import CellState

needs("zarr")
SPEC = GridSpec.centered()
BEAMS = Beams(
    "flat", tuple(np.linspace(-0.4, 0.1, 12)), (0.0,) * 12, -2 * np.pi / 180, 180, 10.0, ((0.0, 0.0, 0.0),) * 12
)
RADAR = radars_at(["ars548"])


def sample(index: int, split: str = "sequences") -> SimulatedSample:
    """Flat ground, and a wall 20 m ahead that the lidar's low layers do not reach and the radar detects."""
    xyz = np.column_stack([np.full(41, 20.0 - RADAR[0].x), np.linspace(-8, 8, 41), np.zeros(41)]).astype(np.float32)
    nothing, stamp = np.zeros(41, np.float32), 20 + 0.1 * index
    echoes = (nothing, nothing, nothing, nothing + 20, nothing.astype(np.uint8), np.full(41, -1, np.int32))
    sweep = PlacedSweep(0, stamp, pose(RADAR[0].x, 0, RADAR[0].z), np.zeros(3), RadarSweep(xyz, *echoes))
    places = {"T_world_sensor": pose(0, 0, 1.9), "T_vehicle_sensor": pose(0, 0, 1.9)}
    facts = {"beams": BEAMS, "stamp": stamp, "sweeps": (sweep,), **places}
    return flat_sample(split, index, flat_steps(BEAMS, reach=15), CellState.FREE, **facts)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("radar") / "data"
    plan = asdict(DatasetPlan(samples=0, validation=0, test=0, sequences=1, radars=RADAR))
    made = Store.create(folder, plan, {"sequences": 10}, [BEAMS], {"ogm": "0"})
    made.write("sequences", 0, [sample(k) for k in range(10)])
    return folder


def run(*words: object) -> str:
    """Return what a command that succeeds prints."""
    result = completed(*words)
    return result.output


def test_fuse_maps_lidar_and_radar_into_one_map(data: Path, tmp_path: Path) -> None:
    both, alone = tmp_path / "both.npz", tmp_path / "alone.npz"
    assert "20 mapped" in run("fuse", data, "--ism", "ray", "--sensor", "lidar", "--sensor", "radar", "--out", both)
    assert "10 mapped" in run("fuse", data, "--ism", "ray", "--out", alone)
    maps = [EvidentialGrid.load(path) for path in (both, alone)]
    with_radar, without = (one.occupied[one.spec.index(20.05, 0.0)] for one in maps)
    assert with_radar > 0.05
    assert without == 0
    run("fuse", data, "--ism", "ray", "--sensor", "lidar", "--sensor", "radar", "--radar-reliability", 1, "--out", both)
    trusted = EvidentialGrid.load(both)
    assert trusted.occupied[trusted.spec.index(20.05, 0.0)] > 3 * with_radar


@pytest.mark.slow
def test_evaluate_and_map_take_the_frames_of_one_radar(data: Path, tmp_path: Path) -> None:
    words = ["--ism", "radar", "--frames", 1, "--out", tmp_path / "report"]
    run("evaluate", data, "--sensor", "ars548-front", *words)
    assert (tmp_path / "report" / "report.html").exists()
    run("map", data, "--sensor", "radar", "--ism", "radar", "--out", tmp_path / "grids")
    assert len(list((tmp_path / "grids").glob("*.npz"))) == 10


def test_a_sensor_that_is_not_there_is_refused_by_name(data: Path, tmp_path: Path) -> None:
    refused_command("no sensor 'sonar'", "fuse", data, "--sensor", "sonar", "--out", tmp_path / "m.npz")


def test_scans_with_cross_sections_go_to_the_model_of_radars() -> None:
    models = load_model(with_radar("ray"), SPEC)
    mount = Mount(0.6, pose(2.0, 0, 0.6))
    points = np.array([[20.0, 0, 0, 0]], np.float32)
    echo = np.zeros(1, np.float32)
    of_radar, of_lidar = Scan(points, rcs=echo, doppler=echo, sensor="corner-front-left"), Scan(points)
    radar, lidar = (Frame(one, mount, None, None) for one in (of_radar, of_lidar))
    corner = RADARS["corner"].modes[0]
    noise = {"range_noise": corner.range_resolution / 3, "azimuth_noise": corner.azimuth_resolution / 3}
    expected = RadarISM(SPEC, mount, half_width=corner.half_width, reach=35.0, keep_moving=True, **noise)
    np.testing.assert_array_equal(run_model(models, radar).mass, expected(radar.scan).mass)
    np.testing.assert_array_equal(run_model(models, lidar).mass, RayISM(SPEC, mount)(lidar.scan).mass)
    # without a model of their own, radars are mapped as all others
    plain = load_model("ray", SPEC)
    np.testing.assert_array_equal(run_model(plain, radar).mass, RayISM(SPEC, mount)(radar.scan).mass)
    # one name for all scans, and names that are none
    only = load_model("radar", SPEC)
    np.testing.assert_array_equal(run_model(only, radar).mass, expected(radar.scan).mass)
    refused(r"a model after \+ must be one of .*, got 'ray'", load_model, "ray+ray", SPEC)
