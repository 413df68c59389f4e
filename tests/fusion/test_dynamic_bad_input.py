"""What the dynamic map refuses, and what it does with scans out of order; see `test_mapper_bad_input.py`, too."""

import math

import numpy as np
from cases import each, refused

from ogm.fusion import DynamicMapper
from ogm.fusion.dynamic.scan_history import CLEAR, HIDDEN, OCCUPIED, ScanHistory
from ogm.fusion.dynamic.settings import DynamicSettings
from ogm.grid import EvidentialGrid, GridSpec
from ogm.pose import pose

SPEC = GridSpec.centered(length=12.8, width=9.6, resolution=0.2)


def scan(free: float = 0.6, occupied: float = 0.02, block: int | None = None) -> EvidentialGrid:
    """Return a uniform scan, with a block of occupied cells from some row on."""
    mass = np.full((*SPEC.shape, 2), (free, occupied), np.float32)
    if block is not None:
        mass[block : block + 10, 20:28] = (0.05, 0.8)
    return EvidentialGrid(SPEC, mass)


def arrays(mapper: DynamicMapper) -> list[np.ndarray]:
    p, grid = mapper._particles, mapper.dynamic_grid
    return [grid.mass, grid.velocity, grid.covariance, *(one[: p.start[-1]].copy() for one in p[:4]), p.start.copy()]


def test_arguments_and_settings_out_of_range_are_refused():
    for particles in (0, -5, 2**25 + 1, 10**15, 1.5, math.nan, math.inf):  # before memory is taken
        refused("particles must be a whole number from 1 to 33554432", DynamicMapper, SPEC, particles)
    for name, value, words in (
        ("filter", "sorted", "filter must be one of hybrid, nuss, got 'sorted'"),
        ("window", "sliding", "window must be one of rolling, fixed"),
        ("threads", 0, "threads must be a whole number of at least 1, got 0"),
        ("max_speed", -1.0, "max_speed"),
        ("max_delay", -1.0, "max_delay"),
    ):
        refused(words, DynamicMapper, SPEC, 10, **{name: value})
    for name, value, words in (
        ("free_half_life", 0.0, "greater than 0 s"),
        ("static_half_life", math.nan, "greater than 0 s"),
        ("dynamic_half_life", -1.0, "greater than 0 s"),
        ("birth_rate", -0.1, "0 or more and finite"),
        ("to_dynamic_rate", math.inf, "0 or more and finite"),
        ("velocity_noise", math.nan, "0 or more and finite"),
        ("static_share", 1.1, r"in \[0, 1\]"),
        ("association", -0.1, r"in \[0, 1\]"),
        ("min_unknown", 1.0, r"in \[0, 1\)"),
        ("conflict_half_life", -1.0, "0 s or more"),
        ("renewal_likelihood", 0.0, "greater than 0"),
        ("hiding_width", -1.0, "0 or more and finite"),
    ):
        refused(f"{name} must be {words}", DynamicSettings, **{name: value})


def test_an_error_in_the_middle_of_an_update_changes_nothing():
    mapper = DynamicMapper(SPEC, 2000)
    for k in range(4):
        mapper.update(scan(block=10 + k), pose(0.1 * k), stamp=0.1 * k)
    before, spec, history = arrays(mapper), mapper.spec, len(mapper._history._scans)
    slot = mapper._measured_velocities

    def fail(*_):
        raise RuntimeError("no velocities")

    mapper._measured_velocities = fail
    refused("no velocities", mapper.update, scan(block=14), pose(0.7), error=RuntimeError, stamp=0.4)
    for a, b in zip(before, arrays(mapper), strict=True):
        np.testing.assert_array_equal(a, b)
    assert (mapper.spec, mapper.scans, len(mapper._history._scans)) == (spec, 4, history)
    mapper._measured_velocities = slot
    untouched = DynamicMapper(SPEC, 2000)
    for k in range(4):
        untouched.update(scan(block=10 + k), pose(0.1 * k), stamp=0.1 * k)
    for one in (mapper, untouched):
        one.update(scan(block=14), pose(0.7), stamp=0.4)
    for a, b in zip(arrays(untouched), arrays(mapper), strict=True):
        np.testing.assert_array_equal(a, b)


@each("filter", ["hybrid", "nuss"])
def test_a_late_scan_moves_no_particle_and_no_dynamic_mass(filter):
    mapper = DynamicMapper(SPEC, 5000, filter=filter)
    for k in range(12):
        mapper.update(scan(block=10 + 3 * k), np.eye(4), stamp=0.1 * k)
    before, particles = mapper.dynamic_grid, arrays(mapper)[3:]
    late = np.zeros((*SPEC.shape, 2), np.float32)
    late[:, 40:] = (0.1, 0.8)  # occupied where there was nothing
    late[:, 20:28] = (0.9, 0.0)  # free where something drives
    mapper.update(EvidentialGrid(SPEC, late), np.eye(4), stamp=1.0)
    after = mapper.dynamic_grid
    np.testing.assert_array_equal(after.dynamic, before.dynamic)
    for a, b in zip(particles, arrays(mapper)[3:], strict=True):
        np.testing.assert_array_equal(a, b)
    moving = before.dynamic > np.maximum(before.static, before.free)
    assert moving.sum() > 20
    np.testing.assert_array_equal(after.mass[moving], before.mass[moving])
    assert after.mass.sum(axis=-1).max() <= 0.98 + 1e-6
    empty = (slice(None), slice(41, None))
    assert (after.static[empty] > before.static[empty]).all() == (filter == "hybrid")
    assert (after.free[empty] < before.free[empty]).all()
    assert mapper.stamp == 1.1
    mapper.update(scan(block=46), np.eye(4), stamp=1.2)


def test_scans_without_anything_occupied_give_a_map_without_particles():
    mapper = DynamicMapper(SPEC, 1000)
    for k in range(3):
        mapper.update(scan(0.6, 0.0), pose(0.1 * k), stamp=0.1 * k)
    assert mapper._particles.start[-1] == 0
    assert np.isnan(mapper.dynamic_grid.velocity).all()
    mapper.update(scan(block=10), pose(0.3), stamp=0.3)
    assert abs(mapper._particles.start[-1] - 1000) <= 1


def test_particles_that_leave_the_window_die_and_new_cells_are_unknown():
    mapper = DynamicMapper(SPEC, 1000, max_speed=math.inf)
    mapper.update(scan(block=10), np.eye(4), stamp=0.0)
    mapper.update(EvidentialGrid.vacuous(SPEC), pose(100.0), stamp=0.1)
    assert mapper._predicted.start[-1] == 0
    assert mapper.dynamic_grid.unknown.min() == 1


def test_positions_keep_their_precision_far_from_the_origin():
    results = []
    for far in (0.0, 1e7 * 0.2):
        mapper = DynamicMapper(SPEC, 2000)
        for k in range(6):
            mapper.update(scan(block=10 + k), pose(far + 0.4 * k), stamp=0.1 * k)
        results.append(arrays(mapper))
    for a, b in zip(*results, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)


def test_earlier_scans_are_aligned_and_chosen_by_age():
    history = ScanHistory(0.6, 0.04)
    for k in range(8):
        cells = np.full((6, 4), CLEAR, np.uint8)
        cells[5 - k % 4, 2], cells[5 - k % 4, 3] = OCCUPIED, HIDDEN  # stay in their place while the window moves on
        history.add(0.1 * k, (k % 4, 0), cells)
    found = history.earlier(0.8, (2, 1), (0.2, 0.4))
    assert [round(scan.age, 6) for scan in found] == [0.4, 0.2]
    for one in found:
        np.testing.assert_array_equal(np.argwhere(one.occupied), [[3, 1]])
        first = 2 - int(round((0.8 - one.age) / 0.1)) % 4  # of the window's rows beyond the first of the scan's window
        x, y = np.meshgrid(np.arange(6) + first, np.arange(4) + 1, indexing="ij")
        outside = (x < 0) | (x >= 6) | (y >= 4)
        outside[3, 2] = True
        np.testing.assert_array_equal(one.hidden, outside)
    assert history.earlier(0.0, (0, 0), (0.2, 0.4)) == []
    assert not history.earlier(0.8, (50, 0), (0.2,))[0][0].any()
