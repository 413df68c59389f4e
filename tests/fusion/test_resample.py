"""Laws of resampling: masses stay masses, and mixtures are exact."""

import math

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given, settings
from hypothesis import strategies as st

from ogm.fusion import resample_to, warp
from ogm.grid import EvidentialGrid, GridSpec
from ogm.pose import inverse, pose

SPEC = GridSpec.centered(length=8, width=6, resolution=0.25)  # 32 x 24
WIDE = GridSpec.centered(length=16, width=16, resolution=0.25)
METHODS = ("area", "nearest", "cautious", "worst")


def noise(spec: GridSpec = SPEC, seed: int = 0) -> EvidentialGrid:
    rng = np.random.default_rng(seed)
    mass = rng.dirichlet([0.6, 0.6, 0.6], size=spec.shape)[..., :2]
    return EvidentialGrid(spec, mass.astype(np.float32))


def total(grid: EvidentialGrid) -> np.ndarray:
    """Return free and occupied, summed over the area [m^2]."""
    return grid.mass.sum(axis=(0, 1), dtype=np.float64) * grid.spec.resolution**2


poses = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-math.pi, math.pi)).map(
    lambda p: pose(p[0], p[1], yaw=p[2])
)


@settings(max_examples=30, deadline=None)
@given(poses, st.sampled_from(METHODS), st.sampled_from([0.1, 0.25, 0.4]))
def test_masses_stay_masses(T, method, resolution):
    spec = GridSpec.centered(length=8, width=8, resolution=resolution)
    mass = warp(noise(), spec, T, method).mass
    EvidentialGrid(spec, mass)  # checks
    assert mass.dtype == np.float32


@settings(max_examples=30, deadline=None)
@given(poses, st.sampled_from([0.1, 0.25, 0.4, 1.0]))
def test_area_weights_keep_the_total_mass(T, resolution):
    spec = GridSpec.centered(length=16, width=16, resolution=resolution)
    np.testing.assert_allclose(total(warp(noise(), spec, T, "area")), total(noise()), rtol=2e-5)


def test_areas_are_those_of_polygons():
    """Against shapely: every weight of a turned, shifted, coarser cell."""
    shapely = pytest.importorskip("shapely", reason="the oracle for areas comes with the extra [sim]")
    source = GridSpec(0.25, (6, 5), (-0.7, -0.6))
    spec = GridSpec(0.4, (5, 6), (-1.0, -1.2))
    T = pose(0.13, -0.08, yaw=0.55)
    cells = {}
    for index in np.ndindex(source.shape):
        x, y = (source.origin[a] + 0.25 * index[a] for a in (0, 1))
        corners = np.array([[x, y], [x + 0.25, y], [x + 0.25, y + 0.25], [x, y + 0.25]])
        cells[index] = shapely.Polygon(corners @ T[:2, :2].T + T[:2, 3])
    grid = noise(source)
    found = warp(grid, spec, T, "area")
    for index in np.ndindex(spec.shape):
        x, y = (spec.origin[a] + 0.4 * index[a] for a in (0, 1))
        cell = shapely.box(x, y, x + 0.4, y + 0.4)
        expected = sum(cell.intersection(p).area * grid.mass[k].astype(float) for k, p in cells.items()) / 0.16
        np.testing.assert_allclose(found.mass[index], expected, atol=1e-6)


def test_a_shift_by_a_part_of_a_cell_is_bilinear():
    grid = noise(WIDE)
    found = warp(grid, SPEC, pose(0.25 * 0.3, 0.25 * -0.4), "area").mass
    m = grid.mass[16 - 1 : 16 + 33, 20 - 1 : 20 + 25]  # SPEC's cells, and one around
    expected = 0.7 * (0.6 * m[1:-1, 1:-1] + 0.4 * m[1:-1, 2:]) + 0.3 * (0.6 * m[:-2, 1:-1] + 0.4 * m[:-2, 2:])
    np.testing.assert_allclose(found, expected, atol=1e-6)


@each("method", METHODS)
def test_the_identity_changes_nothing(method):
    np.testing.assert_allclose(warp(noise(), SPEC, np.eye(4), method).mass, noise().mass, atol=1e-6)


@each("method", METHODS)
def test_quarter_turns_move_cells_and_whole(method):
    square = GridSpec.centered(length=6, width=6, resolution=0.25)
    grid = noise(square)
    turned = warp(grid, square, pose(yaw=math.pi / 2), method)
    x, y = 1.6, -0.9
    there, here = turned.at(x=-y, y=x), grid.at(x=x, y=y)  # x forward becomes y left
    assert there.free == pytest.approx(here.free, abs=1e-5)
    assert there.occupied == pytest.approx(here.occupied, abs=1e-5)
    back = warp(turned, square, inverse(pose(yaw=math.pi / 2)), method)
    np.testing.assert_allclose(back.mass, grid.mass, atol=1e-5)


@each("method", METHODS)
def test_outside_all_is_unknown(method):
    grid = EvidentialGrid(SPEC, np.full((*SPEC.shape, 2), (0.6, 0.2), np.float32))
    found = warp(grid, WIDE, np.eye(4), method)
    x, y = WIDE.cell_centers
    outside = (np.abs(x) > 4) | (np.abs(y) > 3)
    assert not found.mass[outside].any()
    np.testing.assert_allclose(found.mass[~outside], np.broadcast_to((0.6, 0.2), ((~outside).sum(), 2)), atol=1e-6)


def test_nearest_mixes_nothing():
    values = noise().mass.reshape(-1, 2)
    found = warp(noise(), SPEC, pose(0.3, 0.1, yaw=0.8), "nearest").mass.reshape(-1, 2)
    known = found[found.any(axis=1)]
    assert len(known) > 300
    assert (np.abs(known[:, None] - values[None]).sum(axis=-1).min(axis=1) == 0).all()


def test_cautious_turns_mixed_beliefs_into_unknown_and_nothing_else():
    mass = np.zeros((*SPEC.shape, 2), np.float32)
    mass[:16], mass[16:] = (0.9, 0.0), (0.0, 0.9)
    edge = EvidentialGrid(SPEC, mass)
    half = pose(0.125)  # the edge falls into the middle of cells
    mixed, cautious = (warp(edge, SPEC, half, method) for method in ("area", "cautious"))
    np.testing.assert_allclose(mixed.mass[16], np.broadcast_to((0.45, 0.45), (24, 2)), atol=1e-6)
    np.testing.assert_allclose(cautious.unknown[16], 1.0, atol=1e-6)
    np.testing.assert_allclose(cautious.mass[2:16], mixed.mass[2:16], atol=1e-6)
    torn = EvidentialGrid(SPEC, np.full((*SPEC.shape, 2), 0.4, np.float32))  # dissonance of the cells' own
    np.testing.assert_allclose(warp(torn, SPEC, half, "cautious").mass[1:], 0.4, atol=1e-5)


@settings(max_examples=20, deadline=None)
@given(poses, st.sampled_from([0.1, 0.25, 0.4, 0.9]), st.integers(0, 2**31))
def test_the_worst_never_enlarges_free_nor_loses_occupied(T, resolution, seed):
    """At any point, also beyond the grid."""
    n = round(9 / resolution)
    spec = GridSpec(resolution, (n, n), (-4.5, -4.5))
    found = warp(noise(), spec, T, "worst")
    points = np.random.default_rng(seed).uniform(-4.5, 4.2, (2000, 2))
    back = (points - T[:2, 3]) @ T[:2, :2]
    known, new = SPEC.contains(*back.T), found.at(*points.T)
    old = np.zeros_like(new)
    old[known] = noise().at(*back[known].T)
    assert (new[:, 0] <= old[:, 0]).all()
    assert (new[:, 1] >= old[:, 1]).all()


@each("resolution, shift", [(0.5, 0.0), (0.4, 0.05), (0.25, 0.1), (0.1, 0.02), (1.7, -0.3)])
def test_the_worst_is_of_the_cells_that_are_covered(resolution, shift):
    spec = GridSpec(resolution, (3, 2), (-1.0 + shift, -1.5))
    found, grid = resample_to(noise(), spec), noise()
    for i, j in np.ndindex(spec.shape):
        low, high = (np.array(spec.origin) + resolution * (np.array((i, j)) + k) - SPEC.origin for k in (0, 1))
        a, b = np.floor(low / 0.25 + 1e-9).astype(int), np.ceil(high / 0.25 - 1e-9).astype(int)
        cells = grid.mass[a[0] : b[0], a[1] : b[1]]
        occupied = cells[..., 1].max()
        assert found.mass[i, j] == pytest.approx((min(cells[..., 0].min(), 1 - occupied), occupied), abs=1e-6)


def test_cells_of_one_lattice_and_parts_of_cells_copy():
    fine = resample_to(noise(), SPEC.refined(3))
    assert fine.spec.shape == (96, 72)
    np.testing.assert_array_equal(fine.mass[::3, 1::3], noise().mass)
    np.testing.assert_array_equal(resample_to(fine, SPEC).mass, noise().mass)
    around = resample_to(noise(), WIDE)
    np.testing.assert_array_equal(around.mass[16:48, 20:44], noise().mass)
    assert not around.mass[:16].any()
    same = noise()
    assert resample_to(same, SPEC) is same


def test_other_cells_are_refused_where_none_may_be_made():
    for spec in (SPEC.refined(2), WIDE, GridSpec(0.4, (20, 15), SPEC.origin)):
        if spec != SPEC.refined(2):
            refused("give a resampling method", resample_to, noise(), spec, None)
    spec = GridSpec(0.4, (20, 15), SPEC.origin)
    expected = warp(noise(), spec, np.eye(4), "area").mass
    np.testing.assert_array_equal(resample_to(noise(), spec, "area").mass, expected)


def test_bad_arguments_are_named():
    grid, same = noise(), np.eye(4)
    refused("method must be one of area, nearest, cautious, worst, got 'bilinear'", warp, grid, SPEC, same, "bilinear")
    refused("T_to_from must be rigid", warp, grid, SPEC, np.diag([2.0, 2.0, 2.0, 1.0]))
    refused("is tilted by 90 degrees", warp, grid, SPEC, pose(roll=math.pi / 2))
