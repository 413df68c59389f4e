"""Returns in the outermost cells, on the edges of the grid, and beyond all limits."""

import logging

import numpy as np
import pytest
from cases import each

from ogm import GridSpec, Mount
from ogm.geometric import HeightBandISM, RayISM, flat_ground

SPEC = GridSpec(0.5, (9, 6), (-2.0, -1.25))  # x -2 to 2.5 m, y -1.25 to 1.75 m
MOUNT = Mount(1.5, ego_footprint=(0.0, 0.0, 0.0, 0.0))
EXACT = RayISM(SPEC, MOUNT, ground=flat_ground, range_noise=0.0)
NOISY = RayISM(SPEC, MOUNT, ground=flat_ground)
CELLS = [(ix, iy) for ix in range(9) for iy in range(6)]
BORDER = [(ix, iy) for ix, iy in CELLS if ix in (0, 8) or iy in (0, 5)]


def marked(ism: RayISM, x: float, y: float) -> dict[tuple[int, int], float]:
    """Return the cells that one return from an obstacle marks, and their masses of occupied."""
    occupied = ism(np.array([[x, y, -0.5, 0.5]], np.float32)).occupied
    return {(int(ix), int(iy)): float(occupied[ix, iy]) for ix, iy in np.argwhere(occupied)}


@each("ism", [EXACT, NOISY])
@each(("ix", "iy"), BORDER)
def test_a_return_in_a_border_cell_marks_it_and_no_other(ism: RayISM, ix: int, iy: int) -> None:
    x, y = -2.0 + 0.5 * (ix + 0.5), -1.25 + 0.5 * (iy + 0.5)
    assert marked(ism, x, y) == {(ix, iy): pytest.approx(0.95)}


@each(("ix", "iy"), [(ix, iy) for ix, iy in CELLS[::2] if abs(ix - 4) > 1 or abs(iy - 2) > 1])
def test_the_lower_edges_belong_to_a_cell(ix: int, iy: int) -> None:
    """But for cells that touch that of the sensor: what is straight below it is no ray."""
    x, y = -2.0 + 0.5 * ix, -1.25 + 0.5 * iy
    assert list(marked(EXACT, x, y + 0.25)) == [(ix, iy)]
    assert list(marked(EXACT, x + 0.25, y)) == [(ix, iy)]
    assert list(marked(EXACT, x, y)) == [(ix, iy)]


def test_the_far_edges_are_outside() -> None:
    just = np.float32(1e-4)
    for y in np.arange(-1.25, 1.75, 0.25):
        assert not marked(EXACT, 2.5, y)
        assert not marked(EXACT, -2.0 - just, y)
        assert marked(EXACT, 2.5 - just, y)
    for x in np.arange(-2.0, 2.5, 0.25):
        assert not marked(EXACT, x, 1.75)
        assert not marked(EXACT, x, -1.25 - just)
        assert marked(EXACT, x, 1.75 - just)


@each(("x", "y"), [(-1.99, 0.0), (2.49, 0.0), (0.0, -1.24), (0.0, 1.74)])
def test_a_return_at_the_outer_edge_may_come_from_beyond_it(x: float, y: float) -> None:
    """The part of it that range noise takes out of the grid marks nothing."""
    ((cell, mass),) = marked(NOISY, x, y).items()
    assert cell == tuple(int(i) for i in SPEC.index(x, y))
    assert 0.1 < mass < 0.9


@each("ism", [NOISY, HeightBandISM(SPEC, MOUNT)])
@each("axis", [0, 1, 2])
@each("bad", [np.nan, np.inf, -np.inf, 1e6, -1e6])
def test_a_coordinate_beyond_all_limits_drops_its_point(
    ism: RayISM | HeightBandISM, axis: int, bad: float, caplog: pytest.LogCaptureFixture
) -> None:
    points = np.array([[2.0, 1.0, -0.5, 0.0], [1.0, -0.9, -0.5, 0.0]], np.float32)
    points[0, axis] = bad
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        grid = ism(points)
    assert grid == ism(points[1:])
    assert "dropped 1 of 2 points" in caplog.text


def test_the_ego_footprint_is_left_out_up_to_its_edges() -> None:
    mount = Mount(1.5, ego_footprint=(-1.0, 1.5, -0.5, 0.75))
    ism = RayISM(SPEC, mount, ground=flat_ground, range_noise=0.0)
    for x, y, inside in (
        *((-0.99, 0.0, True), (1.49, 0.0, True), (0.3, -0.49, True), (0.3, 0.74, True), (1.6, 0.0, False)),
        *((-1.1, 0.0, False), (0.3, -0.6, False), (0.3, 0.8, False), (1.6, 0.8, False)),
    ):
        points = np.array([[x, y, -0.5, 0.5]], np.float32)
        assert (ism(points).mass == 0).all() == inside, (x, y)


@each(
    ("height", "clears", "marks"),
    [(-0.32, False, False), (-0.28, True, False), (0.14, True, False), (0.16, True, True), (1.98, True, True)]
    + [(2.02, True, False)],
)
def test_up_to_which_height_a_return_is_ground_and_an_obstacle(height: float, clears: bool, marks: bool) -> None:
    grid = NOISY(np.array([[2.25, 0.1, height - 1.5, 0.5]], np.float32))
    assert grid.free.any() == clears
    assert grid.occupied.any() == marks


@each(("height", "marks"), [(0.25, False), (0.2500001, True), (1.9999998, True), (2.0, False)])
def test_obstacles_lie_in_an_open_interval_of_heights(height: float, marks: bool) -> None:
    """These heights, less those of the sensor, are float32 numbers: no rounding moves them over a limit."""
    ism = RayISM(SPEC, MOUNT, ground=flat_ground, obstacle_height=0.25, clearance=2.0)
    assert ism(np.array([[2.25, 0.1, height - 1.5, 0.5]], np.float32)).occupied.any() == marks


def test_a_return_nearer_than_a_cell_takes_nothing_from_the_others() -> None:
    others = np.array([[1.7, 0.1, -1.5, 0.5], [2.2, 0.13, -1.5, 0.5], [2.3, 0.14, -0.5, 0.5]], np.float32)
    near = np.array([[0.2, 0.012, -1.0, 0.5]], np.float32)  # in their sector, below them
    assert NOISY(np.concatenate([near, others])) == NOISY(others)
    assert NOISY(others).free.any()


def test_the_default_numbers_are_those_that_results_are_given_for() -> None:
    ism = RayISM(SPEC, MOUNT)
    assert (ism.p_miss, ism.p_false_alarm, ism.free_reliability_at_hits, ism.max_mass) == (0.5, 0.05, 0.2, 0.98)
    assert (ism.range_noise, ism.max_range, ism.no_return_weight) == (0.03, 100.0, 0.25)
    assert (ism.hidden_height, ism.hidden_depth, ism.ground_cell) == (0.5, 10.0, 1.0)
    assert ism.azimuth_step == pytest.approx(np.radians(0.3515625))
    band = HeightBandISM(SPEC, MOUNT)
    assert (band.z_min, band.z_max, band.evidence, band.min_range, band.supersampling) == (0.5, 2.0, 10.0, 0.0, 1)
