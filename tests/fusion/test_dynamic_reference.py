"""The dynamic map against its slow reference in numpy, step by step on random scenes."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ogm.fusion import DynamicMapper
from ogm.fusion.dynamic.hashed_noise import scan_key
from ogm.fusion.dynamic.settings import DynamicSettings
from ogm.fusion.dynamic.velocity_evidence import group_velocities
from ogm.grid import EvidentialGrid, GridSpec
from ogm.pose import pose

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from _dynamic_reference import MeasuredGroups, NumpyFilter

SPEC = GridSpec.centered(length=6.4, width=4.8, resolution=0.2)
GROUPS = MeasuredGroups(
    np.kron(np.arange(6).reshape(2, 3), np.ones((16, 8), np.int32)).astype(np.int32),
    np.array([[2.0, -1.0], [0.0, 3.0], [0.0, 0.0], [0.1, 0.0], [0.0, 0.2]]),
    np.array([[[4.0, 1.0], [1.0, 2.0]], [[1.0, 0.0], [0.0, 0.0]], np.zeros((2, 2)), 25 * np.eye(2), 9 * np.eye(2)]),
    np.array([False, False, False, True, False]),
)


def random_scan(rng: np.random.Generator) -> EvidentialGrid:
    mass = rng.dirichlet([1, 0.6, 1], size=SPEC.shape)[..., :2]
    mass[rng.random(SPEC.shape) < 0.2] = 0
    return EvidentialGrid(SPEC, mass.astype(np.float32))


def copy_state(mapper: DynamicMapper, plain: NumpyFilter) -> None:
    """Give the reference the map's state, so that rounding does not add up."""
    cells, p = mapper._cells, mapper._particles
    plain.free, plain.static = cells.free.astype(float), cells.static.astype(float)
    plain.to_occupied, plain.to_free = cells.to_occupied.astype(float), cells.to_free.astype(float)
    plain.state, plain.mass = np.stack([p.x, p.y, p.vx, p.vy])[:, : p.start[-1]].copy(), mapper._particle_mass


def check_step(mapper: DynamicMapper, plain: NumpyFilter) -> None:
    grid = mapper.dynamic_grid
    for name in ("free", "static", "dynamic"):
        np.testing.assert_allclose(getattr(grid, name), getattr(plain, name), atol=2e-6, err_msg=name)
    np.testing.assert_allclose(mapper.conflict.layers["free_to_occupied"], plain.to_occupied, atol=2e-6)
    np.testing.assert_allclose(mapper.conflict.layers["occupied_to_free"], plain.to_free, atol=2e-6)
    some = grid.dynamic > 0
    np.testing.assert_allclose(grid.velocity[some], plain.mean[some], atol=3e-3)
    flat = grid.covariance.reshape(*SPEC.shape, 4)[..., [0, 1, 3]]
    np.testing.assert_allclose(flat[some], plain.covariance[some], rtol=2e-3, atol=2e-2)
    p = mapper._particles
    n = p.start[-1]
    assert abs(n - plain.state.shape[1]) <= 1
    n = min(n, plain.state.shape[1])
    same = np.isclose(np.stack([p.x, p.y, p.vx, p.vy])[:, :n], plain.state[:, :n], atol=1e-5).all(axis=0)
    assert same.sum() >= 0.99 * n  # rounding moves some particles over the edges of cells and of copies


def reached_from(places: list[np.ndarray], window: GridSpec) -> np.ndarray:
    """Return which cells of a window are at least a cell inside the grid of a scan at one of some places."""
    x, y = np.broadcast_arrays(*window.cell_centers)
    half = np.array([SPEC.length, SPEC.width]) / 2 - SPEC.resolution
    return np.any(
        [(abs(x - at[0]) < half[0]) & (abs(y - at[1]) < half[1]) for at in [np.full(2, np.inf), *places]], axis=0
    )


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    filter=st.sampled_from(["hybrid", "nuss"]),
    particles=st.sampled_from([1, 300, 5000]),
    speed=st.floats(-20, 20),
    measured=st.booleans(),
)
def test_map_equals_its_slow_reference(seed, filter, particles, speed, measured):
    rng = np.random.default_rng(seed)
    mapper = DynamicMapper(SPEC, particles, filter=filter, matching=False, seed=seed)
    plain = NumpyFilter(SPEC.shape, SPEC.resolution, particles, mapper.settings)
    if measured:
        slot = group_velocities(
            GROUPS.label, GROUPS.velocity, GROUPS.information, GROUPS.resting, 6.0, 0.95, mapper.settings.motion_odds
        )
        mapper._measured_velocities = lambda scan, states, cells: slot
    corner, places = np.zeros(2, int), []
    for k, seconds in enumerate([0.0, 0.1, 0.25, 0.0, 0.1]):
        copy_state(mapper, plain)
        stamp = seconds + (mapper.stamp or 0.0)
        T = pose(speed * stamp, -speed * stamp)
        mapper.update(random_scan(rng), T, stamp=stamp)
        new = np.round((np.array(mapper.spec.origin) - SPEC.origin) / SPEC.resolution).astype(int)
        z = mapper._measured.reshape(*SPEC.shape, 2)
        groups = GROUPS if measured else None
        plain.update(z, seconds, scan_key(seed, k), tuple(new - corner), groups, reached_from(places, mapper.spec))
        corner = new
        places.append(T[:2, 3])
        check_step(mapper, plain)


@pytest.mark.parametrize(
    ("before", "scan", "wanted"),
    [  # evidence of the literature: (occupied, free) before; the scan's (occupied, free); occupied, free, born
        ((0.4, 0.3), (0.7, 0.0), (0.776572, 0.099877, 0.022988)),
        ((0.0, 0.8), (0.9, 0.0), (0.715909, 0.204545, 0.715909)),
        ((0.8, 0.0), (0.0, 0.7), (0.533214, 0.326750, 0.002786)),
        ((0.5, 0.4), (0.0, 0.0), (0.495, 0.36, 0.009898)),
    ],
)
def test_update_of_a_cell_in_nuss_filter(before, scan, wanted):
    """p_S 0.99, p_B 0.02, alpha 0.9 per step of 0.1 s."""
    step = np.log(2) * 0.1
    numbers = DynamicSettings(
        free_half_life=-step / np.log(0.9),
        dynamic_half_life=-step / np.log(0.99),
        birth_rate=-np.log(0.98) / 0.1,
        position_noise=0,
        velocity_noise=0,
        birth_speed=0,
        min_unknown=0,
    )
    mapper = DynamicMapper(SPEC, 76800, filter="nuss", matching=False, settings=numbers)
    cell = [EvidentialGrid(SPEC, np.full((*SPEC.shape, 2), one[::-1], np.float32)) for one in (before, scan)]
    mapper.update(cell[0], np.eye(4), stamp=0.0)
    mapper.update(cell[1], np.eye(4), stamp=0.1)
    grid = mapper.dynamic_grid
    for found, value in zip((grid.dynamic, grid.free, mapper._cells.born), wanted, strict=True):
        assert np.median(found) == pytest.approx(value, abs=2e-5)  # not all cells have the same number of particles
