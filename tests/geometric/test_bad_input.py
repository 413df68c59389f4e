"""Bad clouds and impossible models: a clear error, or a documented result."""

import logging
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ogm import EvidentialGrid, GridSpec
from ogm.geometric import HeightBandISM, RayISM
from ogm.pose import pose

SPEC = GridSpec.centered(20.0, 20.0, 0.5)
MODELS = [HeightBandISM(SPEC, 1.7), RayISM(SPEC, 1.7), HeightBandISM.as_released(SPEC)]
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
@pytest.mark.parametrize(
    "point", [(0, 0, 0), (0, 0, -1.7), (1e-20, 0, -1), (9.999999, 9.999999, -1), (-10, -10, -1)]
)
def test_one_point_anywhere(ism, point: tuple) -> None:
    grid = ism(np.array([[*point, 0.0]], np.float32))
    EvidentialGrid(grid.spec, grid.mass)


@both
@pytest.mark.parametrize(
    ("points", "error", "says"),
    [
        (np.zeros((5, 2), np.float32), ValueError, r"\(N, 4\).*got \(5, 2\)"),
        (np.zeros(4, np.float32), ValueError, r"got \(4,\)"),
        (np.zeros((2, 5, 4), np.float32), ValueError, "got"),
        (np.zeros((5, 4), np.int32), TypeError, "float array.*int32"),
        ([[1.0, 2.0, 3.0, 4.0]], TypeError, "list"),
        (np.zeros((5, 4), complex), TypeError, "complex"),
    ],
)
def test_what_is_no_cloud_is_refused(ism, points, error: type, says: str) -> None:
    with pytest.raises(error, match=says):
        ism(points)


@both
def test_layout_and_precision_do_not_matter(ism) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((-9, -9, -1.7, 0), (9, 9, 1, 1), (200, 4)).astype(np.float32)
    wide = np.zeros((400, 6), np.float32)
    wide[::2, :4] = points
    for same in (points.astype(np.float64), np.asfortranarray(points), wide[::2], points[:, :3]):
        np.testing.assert_array_equal(ism(same).mass, ism(points).mass)
    points.flags.writeable = False
    ism(points)


def test_ten_million_points(caplog: pytest.LogCaptureFixture) -> None:
    points = np.random.default_rng(0).uniform(-30, 30, (10_000_000, 4)).astype(np.float32)
    for ism in MODELS[:2]:
        grid = ism(points)
        EvidentialGrid(grid.spec, grid.mass)
        assert grid.occupied.mean() > 0.5


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"sensor_height": 0.0}, "sensor_height"),
        ({"sensor_height": float("nan")}, "sensor_height"),
        ({"points_in": "map"}, "points_in"),
        ({"T_vehicle_sensor": np.eye(3)}, "T_vehicle_sensor must be a 4x4"),
        ({"T_vehicle_sensor": pose(15, 0, 0)}, "outside the grid.*move or enlarge"),
        ({"ego_footprint": (1, 0, 0, 1)}, "ego_footprint"),
        ({"ego_footprint": (0, math.inf, 0, 1)}, "ego_footprint"),
    ],
)
@pytest.mark.parametrize("model", [HeightBandISM, RayISM])
def test_impossible_mounts_are_refused(model: type, options: dict, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        model(SPEC, **{"sensor_height": 1.7, **options})


@pytest.mark.parametrize(
    ("model", "options", "says"),
    [
        (HeightBandISM, {"z_min": 2.0}, "z_min must lie below"),
        (HeightBandISM, {"evidence": 0.0}, "evidence"),
        (HeightBandISM, {"evidence": math.nan}, "evidence"),
        (HeightBandISM, {"min_range": -1.0}, "min_range"),
        (HeightBandISM, {"supersampling": 0}, "factor"),
        (RayISM, {"obstacle_height": 3.0}, "below clearance"),
        (RayISM, {"p_miss": 1.0}, "p_pass must lie between 0 and 1"),
        (RayISM, {"p_false_alarm": 0.0}, "p_false_alarm"),
        (RayISM, {"max_mass": 1.5}, "max_mass"),
        (RayISM, {"range_noise": -0.1}, "range_noise"),
        (RayISM, {"free_reliability_at_hits": 2.0}, "free_reliability_at_hits"),
        (RayISM, {"no_return_weight": -1.0}, "no_return_weight"),
        (RayISM, {"azimuth_step": 0.0}, "azimuth_step"),
        (RayISM, {"below_ground": math.nan}, "below_ground"),
        (RayISM, {"max_range": 1e300}, "max_range"),
    ],
)
def test_impossible_numbers_are_refused(model: type, options: dict, says: str) -> None:
    with pytest.raises(ValueError, match=says):
        model(SPEC, 1.7, **options)


@pytest.mark.parametrize("shape", [(3,), (5, 4)])
def test_missing_must_be_directions(shape: tuple) -> None:
    with pytest.raises(ValueError, match=r"shape \(M, 3\)"):
        MODELS[1](np.empty((0, 4), np.float32), np.zeros(shape, np.float32))


def test_missing_must_be_an_array() -> None:
    with pytest.raises(ValueError, match=r"shape \(M, 3\), got list"):
        MODELS[1](np.empty((0, 4), np.float32), [[1.0, 0.0, 0.0]])


def test_own_box_may_be_any_four_numbers() -> None:
    points = np.array([[0.5, 0.5, -0.9, 0]], np.float32)
    assert (RayISM(SPEC, 1.7, ego_footprint=[-1, 1, -1, 1])(points).mass == 0).all()


def test_directions_that_are_none_clear_nothing() -> None:
    odd = np.array([[np.nan, 0, 0], [0, 0, 1], [np.inf, 1, 1], [0, 0, 0]], np.float32)
    assert (MODELS[1](np.empty((0, 4), np.float32), odd).mass == 0).all()


def test_a_grid_of_one_cell() -> None:
    spec = GridSpec.centered(0.5, 0.5, 0.5)
    points = np.array([[0.1, 0.1, -0.5, 0], [5, 5, -1.7, 0]], np.float32)
    for model in (HeightBandISM, RayISM):
        assert model(spec, 1.7)(points).mass.shape == (1, 1, 2)


def test_models_can_run_in_several_threads() -> None:
    from concurrent.futures import ThreadPoolExecutor

    rng = np.random.default_rng(1)
    clouds = [
        rng.uniform((-9, -9, -1.7, 0), (9, 9, 1, 1), (n, 4)).astype(np.float32) for n in (2000, 50, 900, 4000)
    ]
    expected = [MODELS[1](cloud).mass for cloud in clouds]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(5):
            for got, want in zip(pool.map(MODELS[1], clouds), expected, strict=True):
                np.testing.assert_array_equal(got.mass, want)


@pytest.mark.parametrize(
    "height", [np.zeros((3, 3), np.float32), np.full((20, 20), np.nan), [0.0], np.zeros((20, 20, 1))]
)
def test_a_ground_estimate_that_returns_nonsense_is_refused(height) -> None:
    ism = RayISM(SPEC, 1.7, ground=lambda xyz, spec, ground_point: height)
    with pytest.raises(ValueError, match=r"ground estimate must return \(20, 20\) finite heights"):
        ism(np.zeros((1, 4), np.float32))


@pytest.mark.parametrize(
    "spec", [GridSpec(0.1, (2**17, 1), (0.0, 0.0)), GridSpec(50.0, (2000, 2), (0.0, 0.0))]
)
def test_a_grid_longer_than_the_kernels_count_is_refused(spec: GridSpec) -> None:
    with pytest.raises(ValueError, match="use coarser cells or a smaller grid"):
        RayISM(spec, 1.7)(np.zeros((1, 4), np.float32))
