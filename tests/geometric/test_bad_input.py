"""Bad clouds and impossible models: a clear error, or a documented result."""

import logging
import math
import time

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ogm import EvidentialGrid, GridSpec, Mount, Scan
from ogm.geometric import HeightBandISM, RayISM, flat_ground
from ogm.pose import pose

SPEC = GridSpec.centered(20.0, 20.0, 0.5)
MOUNT, NO_POINTS = Mount(1.7), np.empty((0, 4), np.float32)
MODELS = [HeightBandISM(SPEC, MOUNT), RayISM(SPEC, MOUNT), HeightBandISM.as_released(SPEC)]
both = each("ism", MODELS)


@both
def test_rows_that_are_not_finite_are_dropped_and_counted(ism, caplog: pytest.LogCaptureFixture) -> None:
    assert (ism(NO_POINTS).unknown == 1).all()
    good = np.array([[5, 1, -0.9, 0], [4, -3, -1.7, 0]], np.float32)
    bad = np.array([[np.nan, 1, 1, 0], [np.inf, 0, 0, 0], [3, 3, -np.inf, 0], [1e30, 0, 0, 0]], np.float32)
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        grid = ism(np.concatenate([bad, good]))
    np.testing.assert_array_equal(grid.mass, ism(good).mass)
    assert "dropped 4 of 6 points" in caplog.text
    assert (ism(bad).unknown == 1).all()


@settings(max_examples=60, deadline=None)
@given(hnp.arrays(np.float32, st.tuples(st.integers(0, 30), st.just(4)), elements=st.floats(width=32)))
@both
def test_any_floats_give_masses(points: np.ndarray, ism) -> None:
    logging.disable(logging.WARNING)
    grid = ism(points)
    logging.disable(logging.NOTSET)
    EvidentialGrid(grid.spec, grid.mass)  # checks


@both
@each("point", [(0, 0, 0), (0, 0, -1.7), (1e-20, 0, -1), (9.999999, 9.999999, -1), (-10, -10, -1)])
def test_one_point_anywhere(ism, point: tuple) -> None:
    grid = ism(np.array([[*point, 0.0]], np.float32))
    EvidentialGrid(grid.spec, grid.mass)


class Tensor:
    """Has the method by which a torch tensor is recognised, without torch."""

    def detach(self) -> None: ...


@both
def test_what_is_no_cloud_is_refused_with_the_fix(ism) -> None:
    for shape, message in (
        ((5, 2), r"\(N, 4\).*got \(5, 2\)$"),
        ((5, 6), r"got \(5, 6\); give points\[:, :4\]$"),
        ((3, 50), r"got \(3, 50\); give points\.T$"),
        ((4, 50), r"got \(4, 50\); give points\.T$"),
        ((4,), r"got \(4,\)$"),
        ((2, 5, 4), r"got \(2, 5, 4\)$"),
    ):
        refused(message, ism, np.zeros(shape, np.float32))
    for points, message in (
        (np.zeros((5, 4), np.int32), r"int32; give points\.astype\(np\.float32\), in metres$"),
        (np.zeros((5, 4), complex), r"complex128; give points\.astype"),
        ([[1.0, 2.0, 3.0, 4.0]], r"got list; give np\.asarray\(points, np\.float32\)$"),
        (Tensor(), r"torch tensor; give points\.detach\(\)\.cpu\(\)\.numpy\(\)$"),
        (None, "got NoneType"),
    ):
        refused(message, ism, points, error=TypeError)


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


@pytest.mark.slow
def test_ten_million_points(caplog: pytest.LogCaptureFixture) -> None:
    points = np.random.default_rng(0).uniform(-30, 30, (10_000_000, 4)).astype(np.float32)
    for ism in MODELS[:2]:
        grid = ism(points)
        EvidentialGrid(grid.spec, grid.mass)
        assert grid.occupied.mean() > 0.5


@each("model", [HeightBandISM, RayISM])
def test_a_mount_outside_the_grid_or_that_is_none_is_refused(model: type) -> None:
    refused(r"sensor at x=15, y=0 m lies outside the grid.*move or enlarge", model, SPEC, Mount(1.7, pose(15, 0, 0)))
    refused(r"ogm\.Mount, got 1\.7; give Mount\(sensor_height=\.\.\.\)", model, SPEC, 1.7, error=TypeError)


def test_impossible_numbers_are_refused() -> None:
    refused("z_min must lie below", HeightBandISM, SPEC, MOUNT, z_min=2.0)
    refused("factor", HeightBandISM, SPEC, MOUNT, supersampling=0)
    for name, value in (("evidence", 0.0), ("evidence", math.nan), ("min_range", -1.0)):
        refused(name, HeightBandISM, SPEC, MOUNT, **{name: value})
    refused("below clearance", RayISM, SPEC, MOUNT, obstacle_height=3.0)
    refused("p_miss must lie between 0 and 1", RayISM, SPEC, MOUNT, p_miss=1.0)
    for name, *values in (
        *(("p_false_alarm", 0.0), ("max_mass", 1.5), ("range_noise", -0.1, 10.0), ("free_reliability_at_hits", 2.0)),
        *(("no_return_weight", -1.0, 1.01), ("azimuth_step", 0.0, math.pi / 2, 2 * math.pi / 2**15)),
        *(("below_ground", math.nan), ("max_range", 1e300), ("hidden_height", 0.0), ("hidden_depth", -1.0)),
        *(("ground_cell", math.inf), ("obstacle_height", 0.0), ("clearance", math.inf)),
    ):
        for value in values:
            refused(name, RayISM, SPEC, MOUNT, **{name: value})


@each(
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


def test_a_ground_estimate_that_returns_nonsense_is_refused() -> None:
    for height in (np.zeros((3, 3), np.float32), np.full((20, 20), np.nan), [0.0], np.zeros((20, 20, 1))):
        ism = RayISM(SPEC, MOUNT, ground=lambda xyz, spec, ground_point, height=height: height)
        refused(r"ground estimate must return \(20, 20\) finite heights", ism, np.zeros((1, 4), np.float32))


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
