"""Bad clouds and impossible models: a clear error, or a documented result."""

import logging
import math
import time

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ogm import EvidentialGrid, GridSpec, Mount, Scan
from ogm.geometric import HeightBandISM, RayISM, flat_ground
from ogm.pose import pose

SPEC = GridSpec.centered(20.0, 20.0, 0.5)
MOUNT, NO_POINTS = Mount(1.7), np.empty((0, 4), np.float32)
MODELS = [HeightBandISM(SPEC, MOUNT), RayISM(SPEC, MOUNT), HeightBandISM.as_released(SPEC)]
both = pytest.mark.parametrize("ism", MODELS, ids=["height-band", "ray", "released"])


@both
def test_an_empty_cloud_gives_the_vacuous_grid(ism) -> None:
    assert (ism(np.empty((0, 4), np.float32)).unknown == 1).all()


@both
def test_rows_that_are_not_finite_are_dropped_and_counted(ism, caplog: pytest.LogCaptureFixture) -> None:
    good = np.array([[5, 1, -0.9, 0], [4, -3, -1.7, 0]], np.float32)
    bad = np.array([[np.nan, 1, 1, 0], [np.inf, 0, 0, 0], [3, 3, -np.inf, 0], [1e30, 0, 0, 0]], np.float32)
    with caplog.at_level(logging.WARNING):
        grid = ism(np.concatenate([bad, good]))
    np.testing.assert_array_equal(grid.mass, ism(good).mass)
    assert "dropped 4 of 6 points" in caplog.text
    assert (ism(bad).unknown == 1).all()


@both
@given(hnp.arrays(np.float32, st.tuples(st.integers(0, 30), st.just(4)), elements=st.floats(width=32)))
@settings(max_examples=60, deadline=None)
def test_any_floats_give_masses(ism, points: np.ndarray) -> None:
    logging.disable(logging.WARNING)
    grid = ism(points)
    logging.disable(logging.NOTSET)
    EvidentialGrid(grid.spec, grid.mass)  # checks


@both
@pytest.mark.parametrize("point", [(0, 0, 0), (0, 0, -1.7), (1e-20, 0, -1), (9.999999, 9.999999, -1), (-10, -10, -1)])
def test_one_point_anywhere(ism, point: tuple) -> None:
    grid = ism(np.array([[*point, 0.0]], np.float32))
    EvidentialGrid(grid.spec, grid.mass)


class Tensor:
    """Has the method by which a torch tensor is recognised, without torch."""

    def detach(self) -> None: ...


@both
@pytest.mark.parametrize(
    ("points", "error", "message"),
    [
        (np.zeros((5, 2), np.float32), ValueError, r"\(N, 4\).*got \(5, 2\)$"),
        (np.zeros((5, 6), np.float32), ValueError, r"got \(5, 6\); give points\[:, :4\]$"),
        (np.zeros((3, 50), np.float32), ValueError, r"got \(3, 50\); give points\.T$"),
        (np.zeros((4, 50), np.float32), ValueError, r"got \(4, 50\); give points\.T$"),
        (np.zeros(4, np.float32), ValueError, r"got \(4,\)$"),
        (np.zeros((2, 5, 4), np.float32), ValueError, r"got \(2, 5, 4\)$"),
        (np.zeros((5, 4), np.int32), TypeError, r"int32; give points\.astype\(np\.float32\), in metres$"),
        (np.zeros((5, 4), complex), TypeError, r"complex128; give points\.astype"),
        ([[1.0, 2.0, 3.0, 4.0]], TypeError, r"got list; give np\.asarray\(points, np\.float32\)$"),
        (Tensor(), TypeError, r"torch tensor; give points\.detach\(\)\.cpu\(\)\.numpy\(\)$"),
        (None, TypeError, "got NoneType"),
    ],
)
def test_what_is_no_cloud_is_refused_with_the_fix(ism, points, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        ism(points)


def test_a_torch_tensor_is_refused_and_the_fix_works() -> None:
    torch = pytest.importorskip("torch")
    points = torch.rand(30, 4)
    with pytest.raises(TypeError, match="give points.detach"):
        MODELS[1](points)
    np.testing.assert_array_equal(MODELS[1](points.detach().cpu().numpy()).mass, MODELS[1](points.numpy()).mass)


@both
def test_layout_and_precision_do_not_matter(ism) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((-9, -9, -1.7, 0), (9, 9, 1, 1), (200, 4)).astype(np.float32)
    wide = np.zeros((400, 6), np.float32)
    wide[::2, :4] = points
    for same in (points.astype(np.float64), np.asfortranarray(points), wide[::2, :4], points[:, :3]):
        np.testing.assert_array_equal(ism(same).mass, ism(points).mass)
    points.flags.writeable = False
    ism(points)


def test_ten_million_points(caplog: pytest.LogCaptureFixture) -> None:
    points = np.random.default_rng(0).uniform(-30, 30, (10_000_000, 4)).astype(np.float32)
    for ism in MODELS[:2]:
        grid = ism(points)
        EvidentialGrid(grid.spec, grid.mass)
        assert grid.occupied.mean() > 0.5


@pytest.mark.parametrize("model", [HeightBandISM, RayISM])
def test_a_sensor_outside_the_grid_is_refused(model: type) -> None:
    with pytest.raises(ValueError, match=r"sensor at x=15, y=0 m lies outside the grid.*move or enlarge"):
        model(SPEC, Mount(1.7, pose(15, 0, 0)))


@pytest.mark.parametrize("model", [HeightBandISM, RayISM])
def test_a_number_instead_of_a_mount_is_refused_with_the_fix(model: type) -> None:
    with pytest.raises(TypeError, match=r"ogm\.Mount, got 1\.7; give Mount\(sensor_height=\.\.\.\)"):
        model(SPEC, 1.7)


@pytest.mark.parametrize(
    ("model", "options", "message"),
    [
        (HeightBandISM, {"z_min": 2.0}, "z_min must lie below"),
        (HeightBandISM, {"evidence": 0.0}, "evidence"),
        (HeightBandISM, {"evidence": math.nan}, "evidence"),
        (HeightBandISM, {"min_range": -1.0}, "min_range"),
        (HeightBandISM, {"supersampling": 0}, "factor"),
        (RayISM, {"obstacle_height": 3.0}, "below clearance"),
        (RayISM, {"p_miss": 1.0}, "p_miss must lie between 0 and 1"),
        (RayISM, {"p_false_alarm": 0.0}, "p_false_alarm"),
        (RayISM, {"max_mass": 1.5}, "max_mass"),
        (RayISM, {"range_noise": -0.1}, "range_noise"),
        (RayISM, {"free_reliability_at_hits": 2.0}, "free_reliability_at_hits"),
        (RayISM, {"no_return_weight": -1.0}, "no_return_weight"),
        (RayISM, {"azimuth_step": 0.0}, "azimuth_step"),
        (RayISM, {"below_ground": math.nan}, "below_ground"),
        (RayISM, {"max_range": 1e300}, "max_range"),
        (RayISM, {"hidden_height": 0.0}, "hidden_height"),
        (RayISM, {"hidden_depth": -1.0}, "hidden_depth"),
        (RayISM, {"ground_cell": math.inf}, "ground_cell"),
        (RayISM, {"obstacle_height": 0.0}, "obstacle_height"),
        (RayISM, {"clearance": math.inf}, "clearance"),
        (RayISM, {"range_noise": 10.0}, "range_noise"),
        (RayISM, {"azimuth_step": math.pi / 2}, "azimuth_step"),
        (RayISM, {"azimuth_step": 2 * math.pi / 2**15}, "azimuth_step"),
        (RayISM, {"no_return_weight": 1.01}, "no_return_weight"),
    ],
)
def test_impossible_numbers_are_refused(model: type, options: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        model(SPEC, MOUNT, **options)


@pytest.mark.parametrize(
    "options",
    [
        {"range_noise": 0.0, "free_reliability_at_hits": 0.0, "no_return_weight": 0.0},
        {"range_noise": 9.9, "free_reliability_at_hits": 1.0, "no_return_weight": 1.0},
        {"p_miss": 1e-9, "p_false_alarm": 1e-9, "max_mass": 1e-9},
        {"p_miss": 1 - 1e-9, "p_false_alarm": 1 - 1e-9, "max_mass": 1 - 1e-9},
        {"azimuth_step": 1.57},
        {"azimuth_step": 2 * math.pi / 32000},
        {"hidden_height": 1e-3, "hidden_depth": 1e-3, "max_range": 1e-3, "ground_cell": 1e-3, "below_ground": 1e-3},
        {"hidden_height": 9e5, "hidden_depth": 9e5, "max_range": 9e5, "ground_cell": 9e5, "below_ground": 9e5},
    ],
    ids=lambda options: next(iter(options)),
)
def test_numbers_near_the_ends_of_their_ranges_give_masses(options: dict) -> None:
    points = np.random.default_rng(6).uniform((-3, -3, -1.7, 0), (3, 3, 1, 1), (60, 4)).astype(np.float32)
    mount = Mount(1.7, ego_footprint=(0.0, 0.0, 0.0, 0.0))
    grid = RayISM(GridSpec.centered(6.0, 6.0, 0.5), mount, **options)(Scan(points, no_returns=points[:20, :3]))
    EvidentialGrid(grid.spec, grid.mass)  # checks


def test_returns_from_the_ego_vehicle_are_counted_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    points = np.array([[0.5, 0.2, -0.9, 0], [1.0, -0.3, -0.9, 0], [5, 1, -0.9, 0]], np.float32)
    with caplog.at_level(logging.DEBUG, "ogm.geometric"):
        MODELS[1](points)
    assert "dropped 2 of 3 points as returns from the ego vehicle" in caplog.text


@pytest.mark.parametrize("shape", [(3,), (5, 4), (3, 5, 3)])
def test_no_returns_must_be_directions(shape: tuple) -> None:
    with pytest.raises(ValueError, match=r"no_returns must be directions of shape \(M, 3\), got"):
        MODELS[1](Scan(NO_POINTS, no_returns=np.zeros(shape, np.float32)))


def test_directions_that_are_none_clear_nothing() -> None:
    odd = np.array([[np.nan, 0, 0], [0, 0, 1], [np.inf, 1, 1], [0, 0, 0]], np.float32)
    assert (MODELS[1](Scan(NO_POINTS, no_returns=odd)).mass == 0).all()


def test_a_grid_of_one_cell() -> None:
    spec = GridSpec.centered(0.5, 0.5, 0.5)
    points = np.array([[0.1, 0.1, -0.5, 0], [5, 5, -1.7, 0]], np.float32)
    for model in (HeightBandISM, RayISM):
        assert model(spec, MOUNT)(points).mass.shape == (1, 1, 2)


def test_models_can_run_in_several_threads() -> None:
    from concurrent.futures import ThreadPoolExecutor

    rng = np.random.default_rng(1)
    clouds = [rng.uniform((-9, -9, -1.7, 0), (9, 9, 1, 1), (n, 4)).astype(np.float32) for n in (2000, 50, 900, 4000)]
    expected = [MODELS[1](cloud).mass for cloud in clouds]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(5):
            for got, want in zip(pool.map(MODELS[1], clouds), expected, strict=True):
                np.testing.assert_array_equal(got.mass, want)


def test_a_ground_function_may_keep_the_points_it_is_given() -> None:
    """The points of one scan are not overwritten by the next, and nothing of a grid is shared with another."""
    kept = []

    def keep(xyz: np.ndarray, spec: GridSpec, ground_point: tuple) -> np.ndarray:
        kept.append((xyz, xyz.copy()))
        return flat_ground(xyz, spec, ground_point)

    ism, rng = RayISM(SPEC, MOUNT, ground=keep), np.random.default_rng(2)
    clouds = rng.uniform((-9, -9, -1.7, 0), (9, 9, 1, 1), (4, 300, 4)).astype(np.float32)
    grids = [ism(cloud) for cloud in clouds]
    for xyz, before in kept:
        np.testing.assert_array_equal(xyz, before)
    for grid, cloud in zip(grids, clouds, strict=True):
        np.testing.assert_array_equal(grid.mass, ism(cloud).mass)


@pytest.mark.parametrize(
    "height", [np.zeros((3, 3), np.float32), np.full((20, 20), np.nan), [0.0], np.zeros((20, 20, 1))]
)
def test_a_ground_estimate_that_returns_nonsense_is_refused(height) -> None:
    ism = RayISM(SPEC, MOUNT, ground=lambda xyz, spec, ground_point: height)
    with pytest.raises(ValueError, match=r"ground estimate must return \(20, 20\) finite heights"):
        ism(np.zeros((1, 4), np.float32))


def test_a_grid_longer_than_the_kernels_count_is_refused() -> None:
    with pytest.raises(ValueError, match="use coarser cells or a smaller grid"):
        RayISM(GridSpec(0.1, (2**17, 1), (0.0, 0.0)), MOUNT)(np.zeros((1, 4), np.float32))


def test_the_cost_follows_the_number_of_cells_and_not_their_size() -> None:
    """10 km x 10 km of 100 m cells: as many as 1 km x 1 km of 10 m cells, and as fast."""
    unit = np.random.default_rng(4).uniform((-0.3, -0.3, -1.7, 0), (0.3, 0.3, 1, 1), (5000, 4))

    def seconds(length: float) -> float:
        ism = RayISM(GridSpec.centered(length, length, length / 100), MOUNT)
        points = (unit * [length, length, 1, 1]).astype(np.float32)
        assert ism(points).occupied.any()  # compiles
        began = time.process_time()
        for _ in range(3):
            ism(points)
        return time.process_time() - began

    assert seconds(10_000.0) < 3 * seconds(1000.0) + 0.1
