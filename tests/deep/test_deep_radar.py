"""The learned sensor model of radar: features, places, laws of the model, training, export."""

import json
import math
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import pytest
import torch
from cases import each, refused
from scipy.ndimage import map_coordinates

from ogm import Frame, GridSpec, Mount, Scan
from ogm.deep import DeepRadarISM, RadarNoise
from ogm.deep.checkpoint import load_network, load_radar_network
from ogm.deep.data import PLAIN
from ogm.deep.export import export_onnx
from ogm.deep.onnx_file import read_metadata, weights_sum
from ogm.deep.polar import BEAM, CHANNELS, RadarGrid, polar_features, polar_places, view_of, write_masses
from ogm.deep.radar_data import STEP, RadarBatch, RadarDataset
from ogm.deep.radar_network import RadarConfig, RadarNetwork
from ogm.deep.radar_onnx import FORMAT
from ogm.deep.recipe import LITE_RECIPE, RADAR_RECIPE, Recipe
from ogm.evidence import check_mass
from ogm.fusion import EvidentialMapper
from ogm.geometric import moving_detections, sensor_velocity
from ogm.pose import pose
from ogm.state import CellState, Truth
from ogm.storage.files import OgmError

SPEC = GridSpec.centered()
BODY = (-1.0, 3.9, -1.0, 1.0)
FRONT = Mount(0.6, pose(3.7, 0.0, 0.6), ego_footprint=BODY)
CORNER = Mount(0.5, pose(3.4, 0.8, 0.5, yaw=0.9), ego_footprint=BODY)
SMALL = RadarGrid((32, 32), 1.5, math.radians(5.625))


def sweep(seed: int, count: int = 60, half_width: float = 1.0) -> Scan:
    """Detections of a sensor at 8 m/s, a quarter of them of moving things."""
    rng = np.random.default_rng(seed)
    r, a = rng.uniform(3, 45, count), rng.uniform(-half_width, half_width, count)
    points = np.zeros((count, 4), np.float32)
    points[:, 0], points[:, 1], points[:, 2] = r * np.cos(a), r * np.sin(a), rng.uniform(-0.5, 2, count)
    doppler = -8 * np.cos(a) + np.where(rng.random(count) < 0.25, 5.0, 0.0) + 0.03 * rng.standard_normal(count)
    return Scan(points, doppler=doppler, rcs=rng.uniform(-20, 20, count))


@pytest.fixture(scope="module")
def network() -> RadarNetwork:
    torch.manual_seed(3)
    return RadarConfig(((8, 1), (8, 1))).build(SMALL).eval()


# ------------------------------------------------------------------------------------------------------- features


def by_definition(scan: Scan, mount: Mount, noise: RadarNoise, polar: RadarGrid) -> np.ndarray:
    """Features detection by detection and cell by cell; the mount is level."""
    result = np.zeros((len(CHANNELS), *polar.shape))
    moving, velocity = moving_detections(scan, noise.doppler_noise, noise.azimuth_noise), sensor_velocity(scan)
    seen = []
    for n in range(len(scan)):
        x, y, z = scan.points[n, :3].astype(float)
        vx, vy, _, _ = mount.T_vehicle_sensor @ [x, y, z, 1]
        if BODY[0] < vx < BODY[1] and BODY[2] < vy < BODY[3]:
            continue
        r, a = math.hypot(x, y), math.atan2(y, x)
        own = float(scan.doppler[n]) + math.cos(a) * velocity[0] + math.sin(a) * velocity[1]
        seen.append((float(scan.rcs[n]), r, a, bool(moving[n]), own, z + mount.sensor_height))
    for i in range(polar.shape[0]):
        for j in range(polar.shape[1]):
            r0, a0 = i * polar.range_step, j * polar.azimuth_step - polar.edge
            here = [
                one for one in seen if 0 <= one[1] - r0 < polar.range_step and 0 <= one[2] - a0 < polar.azimuth_step
            ]
            columns = math.ceil(BEAM / polar.azimuth_step - 1e-9)
            beside = [
                one for one in seen
                if abs(math.floor((one[2] + polar.edge) / polar.azimuth_step) - j) <= columns
                and one[1] < polar.reach
            ]  # fmt: skip
            before = sum(one[1] < r0 for one in beside)
            result[0, i, j] = math.log(1 + sum(not one[3] for one in here))
            result[1, i, j] = math.log(1 + sum(one[3] for one in here))
            if here:
                rcs, r, a, _, own, height = max(here)
                inside = (r - r0) / polar.range_step - 0.5, (a - a0) / polar.azimuth_step - 0.5
                result[2:7, i, j] = (rcs + 10) / 20, own / 10, *inside, height / 3
            result[7, i, j], result[8, i, j] = math.log(1 + before), before == 0 and len(beside) > 0
            middle = abs(a0 + polar.azimuth_step / 2)
            row = (r0 + polar.range_step / 2) / 40, middle / (math.pi / 2), middle <= noise.half_width
            result[9:, i, j] = *row, noise.azimuth_noise / 0.02
    return result


@each("mount", [FRONT, CORNER])
def test_features_are_those_of_the_definition(mount: Mount) -> None:
    scan, noise = sweep(1), RadarNoise()
    wanted = by_definition(scan, mount, noise, SMALL)
    np.testing.assert_allclose(polar_features(scan, mount, noise, SMALL), wanted, atol=2e-4)
    assert (wanted[:9].reshape(9, -1) != 0).any(axis=1).all()


def test_features_do_not_depend_on_the_mounting() -> None:
    """Wherever the sensor is, and in whichever frame its points are, the network sees the same."""
    scan, noise, polar = sweep(2), RadarNoise(), RadarGrid()
    wanted = polar_features(scan, FRONT, noise, polar)
    for yaw in (0.0, 0.9, -2.5):
        T = pose(1.0, 30.0, 0.6, yaw=yaw)
        np.testing.assert_allclose(polar_features(scan, Mount(0.6, T), noise, polar), wanted, atol=1e-3)
        points = np.c_[scan.points[:, :3] @ T[:3, :3].T + T[:3, 3], scan.points[:, 3]].astype(np.float32)
        moved = Scan(points, doppler=scan.doppler, rcs=scan.rcs)
        got = polar_features(moved, Mount(0.6, T, points_in="vehicle"), noise, polar)
        np.testing.assert_allclose(got, wanted, atol=1e-3)


def test_what_is_not_finite_or_not_measured_is_left_out() -> None:
    scan, noise, polar = sweep(3), RadarNoise(), RadarGrid()
    broken = scan.points.copy()
    broken[::7, 0], broken[3::7, 2] = np.nan, np.inf
    kept = np.isfinite(broken).all(axis=1)
    got = polar_features(Scan(broken, doppler=scan.doppler, rcs=scan.rcs), FRONT, noise, polar)
    np.testing.assert_array_equal(got, polar_features(scan.select(kept), FRONT, noise, polar))
    plain = polar_features(Scan(scan.points), FRONT, noise, polar)
    assert not plain[1:4].any()  # nothing moves, no cross section, no Doppler
    rcs = scan.rcs.copy()
    rcs[:] = np.nan
    assert np.isfinite(polar_features(Scan(scan.points, doppler=scan.doppler, rcs=rcs), FRONT, noise, polar)).all()


# --------------------------------------------------------------------------------------------- places and resampling


@each("mount", [FRONT, CORNER])
def test_masses_of_cells_are_interpolated_between_polar_cells(mount: Mount) -> None:
    noise = RadarNoise(math.radians(75))
    evidence = np.random.default_rng(4).uniform(0, 5, (2, *SMALL.shape)).astype(np.float32)
    mass = np.zeros((*SPEC.shape, 2), np.float32)
    write_masses(evidence.reshape(2, -1), SMALL.shape[1], view_of(SPEC, mount, noise, SMALL), mass.reshape(-1, 2))
    x, y = np.broadcast_arrays(*SPEC.cell_centers)
    local = np.linalg.inv(mount.T_vehicle_sensor) @ np.stack([x, y, 0 * x + 0.6, 0 * x + 1]).reshape(4, -1)
    r, a = np.hypot(*local[:2]), np.arctan2(local[1], local[0])
    place = [r / SMALL.range_step - 0.5, (a + SMALL.edge) / SMALL.azimuth_step - 0.5]
    found = np.stack([map_coordinates(one.astype(float), place, order=1, mode="nearest") for one in evidence], axis=-1)
    wanted = found / (found.sum(-1, keepdims=True) + 2)
    inside = (BODY[0] < x) & (x < BODY[1]) & (BODY[2] < y) & (y < BODY[3])
    wanted[(np.abs(a) > noise.half_width) | (r >= SMALL.reach) | inside.ravel()] = 0
    np.testing.assert_allclose(mass.reshape(-1, 2), wanted, atol=1e-5)
    assert (wanted > 0).mean() > 0.3


def test_training_and_inference_see_the_same_evidence(network: RadarNetwork) -> None:
    """The evidence that the loss is taken of is that of the grid's cells."""
    noise, truth = RadarNoise(), Truth(SPEC, np.zeros(SPEC.shape, np.uint8))
    (batch,) = RadarDataset([Frame(sweep(5), CORNER, None, truth)], SMALL)
    with torch.no_grad():
        evidence = network(batch.inputs(torch.device("cpu")))[0].numpy()
    mass = DeepRadarISM(network, SPEC, CORNER, noise)(sweep(5)).mass
    x, y = (axis.ravel()[1::STEP] for axis in SPEC.cell_centers)
    *_, seen = polar_places(*np.meshgrid(x, y, indexing="ij"), CORNER, noise, SMALL)
    wanted = evidence / (evidence.sum(-1, keepdims=True) + 2)
    np.testing.assert_allclose(mass[1::STEP, 1::STEP][seen], wanted, atol=1e-5)


# --------------------------------------------------------------------------------------------------- the sensor model


@each("mount", [FRONT, CORNER])
def test_cells_that_the_radar_does_not_see_are_unknown(network: RadarNetwork, mount: Mount) -> None:
    model = DeepRadarISM(network, SPEC, mount)
    grid = model(sweep(6))
    check_mass(grid.mass)
    x, y = np.broadcast_arrays(*SPEC.cell_centers)
    heading = math.atan2(mount.T_vehicle_sensor[1, 0], mount.T_vehicle_sensor[0, 0])
    off = np.abs(np.angle(np.exp(1j * (np.arctan2(y - mount.origin[1], x - mount.origin[0]) - heading))))
    ego = (BODY[0] < x) & (x < BODY[1]) & (BODY[2] < y) & (y < BODY[3])
    assert not grid.mass[(off > math.radians(60)) | ego].any()
    assert grid.mass[off < 0.5].sum(-1).max() > 0.1


def test_a_sweep_without_detections_is_unknown(network: RadarNetwork) -> None:
    model = DeepRadarISM(network, SPEC, FRONT)
    assert not model(np.zeros((0, 4), np.float32)).mass.any()
    assert not model(np.full((3, 4), np.nan, np.float32)).mass.any()


def test_the_grid_moves_with_the_mounting(network: RadarNetwork) -> None:
    """A sensor two metres further ahead, and a quarter turn to the left, gives the same grid, moved."""
    spec = GridSpec(0.5, (160, 160), (-40.0, -40.0))
    none = (0.0, 0.0, 0.0, 0.0)
    scan = sweep(7)
    first = DeepRadarISM(network, spec, Mount(0.6, pose(0, 0, 0.6), ego_footprint=none))(scan).mass
    ahead = DeepRadarISM(network, spec, Mount(0.6, pose(2, 0, 0.6), ego_footprint=none))(scan).mass
    np.testing.assert_allclose(ahead[4:], first[:-4], atol=1e-5)
    left = DeepRadarISM(network, spec, Mount(0.6, pose(0, 0, 0.6, yaw=math.pi / 2), ego_footprint=none))(scan).mass
    turned = np.rot90(first, k=1)
    assert (np.abs(left - turned).max(axis=-1) > 1e-3).mean() < 0.005  # cells on the edge of the field of view


@each("change", [{"half_width": 0.0}, {"azimuth_noise": math.nan}, {"doppler_noise": -1.0}])
def test_impossible_numbers_are_refused(network: RadarNetwork, change: dict[str, float]) -> None:
    refused(next(iter(change)), DeepRadarISM, network, SPEC, FRONT, RadarNoise()._replace(**change))


def test_what_is_repeated_from_one_place_does_not_accumulate(network: RadarNetwork) -> None:
    """Bauer et al. 2020: twenty guesses of a network are not twenty measurements; the cautious rule holds that."""
    model = DeepRadarISM(network, SPEC, FRONT)
    mapper = EvidentialMapper(SPEC, half_life=math.inf)
    once = model(sweep(8))
    for _ in range(20):
        mapper.update(once, np.eye(4))
    fused = mapper.view().mass
    assert once.mass.max() > 0.1
    assert (fused <= once.mass + 1e-4).all()


# ------------------------------------------------------------------------------------------------ training and export


def frames(count: int) -> list[Frame]:
    """All up to the nearest detection is free, the rest is unknown."""
    spec, result = GridSpec(1.0, (96, 96), (-48.0, -48.0)), []
    x, y = np.broadcast_arrays(*spec.cell_centers)
    for seed in range(count):
        scan = sweep(seed, 12)
        near = np.hypot(*scan.points[:, :2].T).min() + 10
        state = np.where(np.hypot(x - 3.7, y) < near, np.uint8(CellState.FREE), np.uint8(CellState.UNKNOWN))
        result.append(Frame(scan, FRONT, None, Truth(spec, state), name=str(seed)))
    return result


@pytest.fixture(scope="module")
def recipe() -> Recipe:
    return Recipe(RadarConfig(((8, 1), (8, 1))), epochs=6, batch=4, warmup=2, learning_rate=1e-2, average=0.5)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, recipe: Recipe) -> Path:
    from ogm.deep.training import train

    out = tmp_path_factory.mktemp("run")
    options = {"accelerator": "cpu", "workers": 0, "progress": False, "precision": "32-true"}
    train(frames(16), frames(4), SMALL, out, recipe, facts={"data": "made up"}, **options)
    return out


@pytest.mark.slow
def test_training_learns_and_states_where_the_weights_come_from(run: Path) -> None:
    rows = [[float(v) for v in row.split(",")[2:4]] for row in (run / "log.csv").read_text().splitlines()[1:]]
    assert rows[-1][0] < 0.8 * rows[0][0]  # the training loss
    network, description = load_radar_network(run / "best.safetensors")
    assert network.spec == SMALL
    assert description["data"] == "made up"


@pytest.mark.slow
def test_training_goes_on_exactly(run: Path, recipe: Recipe, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from ogm.deep.training import train
    from ogm.deep.training_run import TrainingRun

    options = {"accelerator": "cpu", "workers": 0, "progress": False, "precision": "32-true"}
    save = TrainingRun.save

    def stop_later(this: TrainingRun) -> float:
        saved = save(this)
        if this.epoch == 3:
            raise KeyboardInterrupt
        return saved

    monkeypatch.setattr(TrainingRun, "save", stop_later)
    with pytest.raises(KeyboardInterrupt):
        train(frames(16), frames(4), SMALL, tmp_path, recipe, **options)
    monkeypatch.setattr(TrainingRun, "save", save)
    train(frames(16), frames(4), SMALL, tmp_path, recipe, resume=True, **options)
    found, wanted = (load_radar_network(path / "best.safetensors")[0].state_dict() for path in (tmp_path, run))
    for name, value in wanted.items():
        torch.testing.assert_close(found[name], value, rtol=0, atol=0)


def test_a_recipe_of_radar_is_not_for_lidars(tmp_path: Path) -> None:
    from ogm.deep.training import train

    refused("a RadarGrid for radar networks", train, [], frames(1), SPEC, tmp_path, RADAR_RECIPE)
    refused("a GridSpec for lidar networks", train, [], frames(1), SMALL, tmp_path, LITE_RECIPE)


@pytest.mark.slow
def test_weights_of_radar_and_of_lidar_are_not_mixed_up(run: Path) -> None:
    refused("describes no valid network", load_network, run / "best.safetensors", error=OgmError)
    from ogm.deep.engines import weights_of

    with weights_of("lite") as path, pytest.raises(OgmError, match="describes no valid network"):
        load_radar_network(path)


@pytest.fixture(scope="module")
def exported(run: Path) -> Path:
    network, description = load_radar_network(run / "best.safetensors")
    export_onnx(network, run / "radar.onnx", description=description, weights=run / "best.safetensors")
    return run / "radar.onnx"


@pytest.mark.slow
def test_the_exported_network_gives_the_grid_of_torch(run: Path, exported: Path) -> None:
    model = DeepRadarISM.load(exported, spec=SPEC, mount=CORNER)
    wanted = DeepRadarISM.load(run, spec=SPEC, mount=CORNER)(sweep(9)).mass
    np.testing.assert_allclose(model(sweep(9)).mass, wanted, atol=1e-5)
    assert wanted.max() > 0.1
    assert model.engine.description["data"] == "made up"


@pytest.mark.slow
def test_damaged_exports_are_refused(exported: Path, tmp_path: Path) -> None:
    path, data = tmp_path / "radar.onnx", exported.read_bytes()
    flipped = bytearray(data)
    flipped[len(data) // 2] ^= 1
    for damaged in (data[: len(data) // 2], bytes(flipped)):
        path.write_bytes(damaged)
        with pytest.raises(OgmError):
            DeepRadarISM.load(path)
    with pytest.raises(FileNotFoundError):
        DeepRadarISM.load(tmp_path / "none.onnx")
    with as_file(files("ogm") / "data" / "lite.onnx") as lidar, pytest.raises(OgmError, match="has the format"):
        DeepRadarISM.load(lidar)


def test_mirrored_sweeps_have_mirrored_places() -> None:
    """Exchanging left and right before the features are made is the same as the augmentation."""
    scan, noise = sweep(10), RadarNoise()
    state = np.random.default_rng(1).integers(0, 3, SPEC.shape).astype(np.uint8)
    frame = Frame(scan, FRONT, None, Truth(SPEC, state))
    from dataclasses import replace

    (got,) = RadarDataset([frame], SMALL, augmentation=replace(PLAIN, mirror=1.0))
    points = scan.points * np.array([1, -1, 1, 1], np.float32)
    other = Scan(points, doppler=scan.doppler, rcs=scan.rcs)
    np.testing.assert_allclose(got.features[0].numpy(), polar_features(other, FRONT, noise, SMALL), atol=1e-3)
    (plain,) = RadarDataset([frame], SMALL)
    np.testing.assert_allclose(got.places[0].numpy() * [-1, 1], plain.places[0].numpy(), atol=1e-6)
    joined = RadarBatch.joined([got, plain])
    assert joined.features.shape[0] == joined.state.shape[0] == 2
    assert json.dumps(joined.numbers) == "[0, 0]"


# ------------------------------------------------------------------------------------------------------ the weights


def test_the_shipped_files_belong_together_and_are_small() -> None:
    with as_file(files("ogm") / "data") as data:
        network, description = load_radar_network(data / "radar.safetensors")
        _, metadata = read_metadata(data / "radar.onnx", FORMAT)
        assert metadata["weights"] == weights_sum(data / "radar.safetensors")
        assert sum((data / f"radar{end}").stat().st_size for end in (".safetensors", ".onnx", ".json")) < 2e6
    assert description["data"]["training"]["seed"] not in (1, 3)  # the fit of RadarISM, and the test
    model = DeepRadarISM.load("radar", spec=SPEC, mount=FRONT)
    wanted = DeepRadarISM(network, SPEC, FRONT)(sweep(11)).mass
    np.testing.assert_allclose(model(sweep(11)).mass, wanted, atol=1e-5)


def test_the_shipped_model_clears_up_to_a_wall_and_not_behind_it() -> None:
    y = np.linspace(-12, 12, 25)
    points = np.c_[np.full(25, 18.0), y, np.zeros((25, 2))].astype(np.float32)
    r = np.hypot(points[:, 0], points[:, 1])
    scan = Scan(points, doppler=-5 * points[:, 0] / r, rcs=np.full(25, 5.0))
    mass = DeepRadarISM.load("radar", spec=SPEC, mount=FRONT, noise=RadarNoise(azimuth_noise=math.radians(0.4)))(
        scan
    ).mass
    ix, iy = SPEC.index(np.array([12.0, 21.7, 30.0]), np.zeros(3))
    (before, _), (_, on), (behind, _) = mass[ix, iy]
    assert before > 0.5 > behind
    assert on > 5 * mass[ix[0], iy[0], 1]
