"""Laws of the maps: the effect of driving, waiting and measuring."""

import math
import os
import pickle
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from cases import each, refused
from hypothesis import example, given, settings
from hypothesis import strategies as st
from random_grids import layers, noise, uniform

from ogm.evidence import (
    averaging,
    cautious,
    close_world,
    conflict_direction,
    conjunctive,
    contextual_discount,
    cumulative,
    dempster,
    discount,
    discount_evidence,
    pcr5,
    revise,
    smooth,
    weighted,
    yager,
)
from ogm.fusion import BinaryBayesMapper, EvidentialMapper
from ogm.grid import CombinedGrid, EvidentialGrid, GridSpec, PartialGrid
from ogm.pose import pose

SPEC = GridSpec.centered(length=12.8, width=9.6, resolution=0.2)  # 64 x 48
FOREVER = math.inf
COMPILED = {
    "dempster": dempster,
    "yager": yager,
    "cumulative": cumulative,
    "cautious": cautious,
    "revise": revise,
    "smooth": smooth,
}


def cut(grid: EvidentialGrid, spec: GridSpec) -> np.ndarray:
    """Return the masses that a larger grid of the same lattice has on the cells of `spec`; vacuous outside it."""
    di = round((spec.origin[0] - grid.spec.origin[0]) / spec.resolution)
    dj = round((spec.origin[1] - grid.spec.origin[1]) / spec.resolution)
    out = np.zeros((*spec.shape, 2), np.float32)
    i, j = np.indices(spec.shape)
    a, b = i + di, j + dj
    inside = (a >= 0) & (b >= 0) & (a < grid.spec.shape[0]) & (b < grid.spec.shape[1])
    out[inside] = grid.mass[a[inside], b[inside]]
    return out


@each("name", COMPILED)
@each(("forget", "discounting", "yaw"), [
    ("everywhere", discount, 0.4), ("observed", discount_evidence, 2.0),
    ("everywhere", discount_evidence, math.pi / 2), ("observed", discount, 0.0),
])  # fmt: skip
def test_the_compiled_pass_equals_its_slow_reference(name, forget, discounting, yaw):
    rule = COMPILED[name]
    options = {"half_life": (0.7, 1.5), "moving_half_life": 0.3, "forget": forget, "discounting": discounting}
    fast = EvidentialMapper(SPEC, rule, **options)
    slow = EvidentialMapper(SPEC, lambda a, b: rule(a, b), **options)
    for k in range(5):
        for mapper in (fast, slow):
            T = pose(1.37 * k, -0.91 * k, yaw=yaw + 0.1 * k)
            mapper.update(noise(SPEC, k), T, stamp=0.4 * k, reliability=0.9)
    assert fast.spec == slow.spec
    np.testing.assert_allclose(fast.grid.mass, slow.grid.mass, atol=1e-5)
    np.testing.assert_allclose(layers(fast), layers(slow), atol=1e-5)


@each("rule, discounting, half_life", [(revise, discount, 2.0), (cumulative, discount_evidence, (0.7, 1.5))])
def test_a_scan_that_reaches_few_cells_gives_the_map_of_its_whole_grid(rule, discounting, half_life):
    """Cells that no scan reaches age when they are read; with the rule as a plain function all cells age each time."""
    spec, rng = GridSpec.centered(length=6.0, width=30.0, resolution=0.2), np.random.default_rng(4)  # three blocks
    options = {"half_life": half_life, "moving_half_life": 0.3, "discounting": discounting}
    fast, whole = (EvidentialMapper(spec, rule, **options) for _ in range(2))
    slow = EvidentialMapper(spec, lambda a, b: rule(a, b), **options)
    for k in range(12):
        corner, mass = tuple(rng.integers(0, (18, 141)).tolist()), noise(spec, k).mass[:12, :9]
        grid = PartialGrid.of(spec, corner, mass)
        assert (grid.mass[corner[0] : corner[0] + 12, corner[1] : corner[1] + 9] == mass).all()
        stamp = 0.3 * k - (0.4 if k == 7 else 0.0)  # one comes late
        for mapper, scan in ((fast, grid), (whole, EvidentialGrid(spec, grid.mass)), (slow, grid)):
            mapper.update(scan, pose(0.4 * k, -0.3 * k, yaw=0.2 * k), stamp=stamp, reliability=0.9)
    for other in (whole, slow):
        np.testing.assert_allclose(fast.grid.mass, other.grid.mass, atol=1e-4)
        np.testing.assert_allclose(layers(fast), layers(other), atol=1e-4)
    refused("exceeds the grid", PartialGrid.of, spec, (spec.shape[0] - 3, 0), noise(spec).mass[:4, :4])


@each("rule", [pcr5, averaging, weighted, lambda a, b: close_world(conjunctive(a, b))])
def test_any_rule_of_two_masses_works(rule):
    mapper = EvidentialMapper(SPEC, rule, half_life=FOREVER, min_unknown=0)
    for k in range(3):
        mapper.update(noise(SPEC, k), np.eye(4))
    expected = rule(
        rule(rule(np.zeros_like(noise(SPEC).mass), noise(SPEC, 0).mass), noise(SPEC, 1).mass), noise(SPEC, 2).mass
    )
    np.testing.assert_allclose(mapper.grid.mass, expected, atol=1e-5)


def test_update_ages_then_combines_and_keeps_conflict_by_direction():
    a, b = noise(SPEC, 1), noise(SPEC, 2)
    mapper = EvidentialMapper(
        SPEC, dempster, (1.0, 3.0), moving_half_life=FOREVER, min_unknown=0, conflict_half_life=0.5
    )
    mapper.update(a, np.eye(4), stamp=0)
    mapper.update(b, np.eye(4), 0.5)  # the stamp, by its place
    # belief in free halves in 1 s: the source is unreliable if the cell is occupied
    aged = contextual_discount(a.mass, 0.5 ** (0.5 / 3), 0.5**0.5)
    np.testing.assert_allclose(mapper.grid.mass, dempster(aged, b.mass), atol=1e-6)
    expected = conflict_direction(aged, b.mass)
    np.testing.assert_allclose(layers(mapper), expected, atol=1e-6)
    mapper.update(EvidentialGrid.vacuous(SPEC), np.eye(4), stamp=1.5)  # two half-lives of the conflict
    np.testing.assert_allclose(layers(mapper), expected / 4, atol=1e-6)


@each("mapper_of", [lambda: EvidentialMapper(SPEC, half_life=FOREVER), lambda: BinaryBayesMapper(SPEC)])
def test_driving_a_thousand_steps_changes_nothing_that_is_still_in_view(mapper_of):
    """No diffusion: contents are moved by whole cells, and a vacuous scan adds nothing."""
    mapper = mapper_of()
    mapper.update(noise(SPEC), np.eye(4), stamp=0)
    first = mapper.grid
    rng = np.random.default_rng(0)
    x = y = yaw = 0.0
    nothing = EvidentialGrid.vacuous(SPEC)
    lowest, highest = np.zeros(2), np.zeros(2)
    for k in range(1, 1001):
        x, y = 1.3 * math.sin(0.0137 * k), 0.9 * math.sin(0.0211 * k)  # steps of millimetres to centimetres
        yaw += rng.normal(0, 0.02)
        mapper.update(nothing, pose(x, y, yaw=yaw), stamp=0.1 * k)
        lowest, highest = np.minimum(lowest, (x, y)), np.maximum(highest, (x, y))
    kept = cut(first, mapper.spec)
    margin = np.ceil((highest - lowest) / SPEC.resolution).astype(int) + 1  # rows and columns that left the view
    inside = (slice(margin[0], -margin[0]), slice(margin[1], -margin[1]))
    np.testing.assert_allclose(mapper.grid.mass[inside], kept[inside], atol=1e-5)


@settings(max_examples=25, deadline=None)
@example([(0.0, 1.5, 0.0)])
@given(st.lists(st.tuples(st.floats(-4, 4), st.floats(-4, 4), st.floats(-0.25, 0.25)), min_size=1, max_size=8))
def test_the_ring_buffer_equals_a_map_of_the_whole_world(steps):
    """A rolling window holds what a fixed map large enough for the drive does, as far as it never left the view."""
    world = GridSpec(0.2, (512, 512), (SPEC.origin[0] - 224 * 0.2, SPEC.origin[1] - 232 * 0.2))
    rolling = EvidentialMapper(SPEC, max_speed=FOREVER)
    fixed = EvidentialMapper(world, window="fixed", max_speed=FOREVER)
    seen = np.zeros(world.shape, bool)  # cells of the world that have been in view without a break
    x = y = yaw = 0.0
    for k, (dx, dy, turn) in enumerate(steps):
        x, y, yaw = x + dx, y + dy, yaw + turn
        for mapper in (rolling, fixed):
            mapper.update(noise(SPEC, k), pose(x, y, yaw=yaw), stamp=0.1 * k)
        i, j = (round((a - b) / 0.2) for a, b in zip(rolling.spec.origin, world.origin, strict=True))
        view = np.zeros(world.shape, bool)
        view[i : i + SPEC.shape[0], j : j + SPEC.shape[1]] = True
        seen = view if k == 0 else seen & view
    mask = seen[i : i + SPEC.shape[0], j : j + SPEC.shape[1]]
    np.testing.assert_allclose(rolling.grid.mass[mask], cut(fixed.grid, rolling.spec)[mask], atol=4e-6)


@each("rate", [5, 20])
@each("discounting", [discount, discount_evidence])
def test_forgetting_does_not_depend_on_the_rate(rate, discounting):
    mapper = EvidentialMapper(SPEC, half_life=(2.0, 1.0), discounting=discounting, min_unknown=0)
    mapper.update(uniform(SPEC, 0.5, 0.3), np.eye(4), stamp=0)
    for k in range(1, 2 * rate + 1):
        mapper.update(EvidentialGrid.vacuous(SPEC), np.eye(4), stamp=k / rate)
    free, occupied = mapper.grid.mass[3, 4]
    if discounting is discount:
        assert free == pytest.approx(0.25, abs=1e-5)
        assert occupied == pytest.approx(0.075, abs=1e-5)
    else:  # evidence 5 and 3, of which a half and a quarter are left
        total = 2 + 2.5 + 0.75
        assert (free, occupied) == (pytest.approx(2.5 / total, abs=1e-5), pytest.approx(0.75 / total, abs=1e-5))


@each("name", COMPILED)
def test_a_vacuous_scan_only_ages_the_map(name):
    mapper = EvidentialMapper(SPEC, COMPILED[name], half_life=2.0, min_unknown=0)
    mapper.update(noise(SPEC), np.eye(4), stamp=0)
    before = mapper.grid.mass
    mapper.update(EvidentialGrid.vacuous(SPEC), pose(0.05, 0.03, yaw=0.7), stamp=1.0)
    np.testing.assert_allclose(mapper.grid.mass, discount(before, 0.5**0.5), atol=1e-6)


def test_with_forget_observed_only_observed_cells_are_forgotten():
    mapper = EvidentialMapper(SPEC, dempster, 1.0, forget="observed", min_unknown=0)
    mapper.update(uniform(SPEC, 0.4, 0.4), np.eye(4), stamp=0)
    half = np.zeros((*SPEC.shape, 2), np.float32)
    half[:32] = 0.1, 0.0
    mapper.update(EvidentialGrid(SPEC, half), np.eye(4), stamp=1)
    np.testing.assert_allclose(mapper.grid.mass[32:], 0.4, atol=1e-6)
    expected = dempster(np.array([0.2, 0.2]), np.array([0.1, 0.0]))
    np.testing.assert_allclose(mapper.grid.mass[:32], np.broadcast_to(expected, (32, 48, 2)), atol=1e-6)


def trail(**options) -> EvidentialMapper:
    """Let a car drive through a free street, and hide its cells once it has passed the middle."""
    mapper = EvidentialMapper(SPEC, **options)
    street = np.full((*SPEC.shape, 2), (0.7, 0.0), np.float32)
    street[:, 40:] = 0.0, 0.8  # a wall
    for k in range(12):
        scan = street.copy()
        scan[4 * k : 4 * k + 12, 20:26] = 0.0, 0.8
        if k > 7:
            scan[:, :30] = 0  # hidden behind another object
        mapper.update(EvidentialGrid(SPEC, scan), np.eye(4), stamp=0.1 * k)
    return mapper


@each("name", COMPILED)
def test_trails_of_moving_objects_decay_and_static_cells_stay(name):
    hidden = slice(30, 38), slice(20, 26)  # where the car was last seen
    with_trail = trail(rule=COMPILED[name], moving_half_life=FOREVER)
    without = trail(rule=COMPILED[name], moving_half_life=0.04)
    assert with_trail.grid.occupied[hidden].max() > 0.35
    assert without.grid.occupied[hidden].max() < 0.05
    assert without.grid.occupied[:, 41:].min() > 0.7


@each("rate", [5, 20])
@each("conflict_half_life", [0.3, 2.0])
def test_dynamic_decay_does_not_depend_on_the_rate(rate, conflict_half_life):
    """Over t seconds occupied falls by 2^-(excess h_c / ln 2 (1 - 2^(-t / h_c)) (1 / h_m - 1 / h)) beside the usual."""
    options = {"half_life": 2.0, "moving_half_life": 0.5, "conflict_half_life": conflict_half_life}
    mapper = EvidentialMapper(SPEC, dempster, min_unknown=0, **options)
    mapper.update(uniform(SPEC, 0.6, 0.0), np.eye(4), stamp=0)
    mapper.update(uniform(SPEC, 0.0, 0.9), np.eye(4), stamp=0)
    excess, before = float(mapper.conflict["free_to_occupied"][0, 0]), float(mapper.grid.occupied[0, 0])
    assert excess == pytest.approx(0.54, abs=1e-6)
    for k in range(1, rate + 1):
        mapper.update(EvidentialGrid.vacuous(SPEC), np.eye(4), stamp=k / rate)
    lasting = conflict_half_life / math.log(2) * (1 - 0.5 ** (1 / conflict_half_life))
    expected = before * 0.5**0.5 * 0.5 ** (excess * lasting * (1 / 0.5 - 1 / 2.0))
    assert mapper.grid.occupied[0, 0] == pytest.approx(expected, rel=1e-4)


def test_flickering_cells_do_not_decay_as_dynamic_ones():
    """Free, occupied, free, occupied: as much conflict one way as the other, so nothing fades faster."""
    kept = []
    for moving in (0.04, FOREVER):
        mapper = EvidentialMapper(SPEC, moving_half_life=moving, conflict_half_life=FOREVER)
        for k in range(8):
            mapper.update(uniform(SPEC, *((0.7, 0.0) if k % 2 else (0.0, 0.7))), np.eye(4), stamp=0.01 * k)
        for k in range(8, 20):
            mapper.update(EvidentialGrid.vacuous(SPEC), np.eye(4), stamp=0.01 * k)
        kept.append(float(mapper.grid.occupied[0, 0]))
    assert kept[0] == pytest.approx(kept[1], rel=0.25)


@each("name", COMPILED)
def test_certainty_is_bounded_and_new_scans_reverse_the_map(name):
    mapper = EvidentialMapper(SPEC, COMPILED[name], FOREVER, min_unknown=0.02)
    for _ in range(500):
        mapper.update(uniform(SPEC, 0, 0.7), np.eye(4))
    assert mapper.grid.unknown.min() >= 0.02 - 1e-6
    scans = 0
    while (mapper.grid.probability > 0.5).any():
        mapper.update(uniform(SPEC, 0.7, 0), np.eye(4))
        scans += 1
        assert scans < 60
    if name == "dempster":  # P(occupied) falls below 1/2 once (1 - 0.7)^n < about 0.02
        assert scans == math.ceil(math.log(0.02) / math.log(0.3))


def test_thousands_of_scans_stay_masses():
    mapper = EvidentialMapper(SPEC, half_life=1.0)
    grids = [noise(SPEC, k) for k in range(7)]
    for k in range(2000):
        mapper.update(grids[k % 7], pose(0.31 * k, -0.17 * k, yaw=0.01 * k), stamp=0.1 * k)
    mass = mapper.grid.mass
    assert np.isfinite(mass).all()
    assert mass.min() >= 0
    assert mass.sum(axis=-1).max() <= 0.98 + 1e-6
    assert mapper.scans == 2000


@each("discounting", [discount, discount_evidence])
def test_forgotten_beliefs_do_not_become_denormal_numbers(discounting):
    """Numbers below 1e-38 are handled a hundred times as slowly: a parked car must not produce them."""
    mapper = EvidentialMapper(SPEC, half_life=0.1, discounting=discounting)
    mapper.update(noise(SPEC), np.eye(4), stamp=0)
    mapper.update(noise(SPEC, 1), np.eye(4), stamp=0.1)
    nothing = EvidentialGrid.vacuous(SPEC)
    for k in range(1, 300):
        mapper.update(nothing, np.eye(4), stamp=0.1 + 0.05 * k)
        for numbers in (mapper.grid.mass, layers(mapper)):
            assert not ((numbers > 0) & (numbers < np.finfo(np.float32).tiny)).any()
    assert mapper.grid.mass.max() < 1e-12


def test_a_late_scan_counts_as_much_as_ageing_would_have_left_of_it():
    a, b = noise(SPEC, 1), noise(SPEC, 2)
    mapper = EvidentialMapper(SPEC, dempster, 1.0, min_unknown=0)
    mapper.update(a, np.eye(4), stamp=10.0)
    mapper.update(b, np.eye(4), stamp=9.6)
    assert mapper.stamp == 10.0
    np.testing.assert_allclose(mapper.grid.mass, dempster(a.mass, discount(b.mass, 0.5**0.4)), atol=1e-6)


def test_a_late_scan_does_not_scroll_the_window_back():
    mapper = EvidentialMapper(SPEC)
    mapper.update(noise(SPEC, 1), pose(5.0), stamp=10.0)
    origin = mapper.spec.origin
    mapper.update(noise(SPEC, 2), pose(3.0), stamp=9.9)
    assert mapper.spec.origin == origin
    np.testing.assert_array_equal(mapper.T_map_vehicle, pose(5.0))


def test_two_sensors_in_opposite_directions_make_one_map():
    """A sensor on the roof and one at the tail, turned round, at the same moment: nothing ages, no jump."""
    front = GridSpec(0.2, (30, 40), (0.0, -4.0))
    tail = pose(-1.5, 0.2, yaw=math.pi)
    T_map_vehicle = pose(7.3, -2.2, yaw=0.6)
    mapper = EvidentialMapper(SPEC)
    mapper.update(uniform(front, 0.8, 0), T_map_vehicle, stamp=3)
    mapper.update(uniform(front, 0, 0.8), T_map_vehicle @ tail, stamp=3, T_vehicle_sensor=tail)
    view = mapper.view()
    assert view.at(x=3.0, y=1.0).free == pytest.approx(0.8, abs=1e-5)
    assert view.at(x=-4.0, y=1.0).occupied == pytest.approx(0.8, abs=1e-5)
    np.testing.assert_allclose(mapper.T_map_vehicle, T_map_vehicle, atol=1e-12)


@each("resolution", [0.05, 0.1, 0.4, 0.8])
def test_scans_of_other_cells_fill_the_same_area(resolution):
    other = GridSpec.centered(length=6.4, width=4.8, resolution=resolution)
    mapper = EvidentialMapper(SPEC)
    mapper.update(uniform(other, 0.6, 0.1), np.eye(4), stamp=0)
    x, y = mapper.spec.cell_centers
    inside = (np.abs(x) < 3.2) & (np.abs(y) < 2.4)
    np.testing.assert_allclose(mapper.grid.mass[inside], np.broadcast_to((0.6, 0.1), (inside.sum(), 2)), atol=1e-6)
    assert not mapper.grid.mass[~inside].any()


def test_finer_scans_are_averaged_over_the_map_cell():
    fine = GridSpec(0.1, (128, 96), SPEC.origin)
    mass = np.zeros((*fine.shape, 2), np.float32)
    mass[::2, ::2] = 0.0, 0.8  # one of four
    mapper = EvidentialMapper(SPEC)
    mapper.update(EvidentialGrid(fine, mass), np.eye(4), stamp=0)
    np.testing.assert_allclose(mapper.grid.occupied, 0.2, atol=1e-6)


def test_an_unreliable_sensor_counts_for_less():
    a, b = noise(SPEC, 1), noise(SPEC, 2)
    mapper = EvidentialMapper(SPEC, dempster, FOREVER, min_unknown=0)
    mapper.update(a, np.eye(4))
    mapper.update(b, np.eye(4), reliability=0.3)
    np.testing.assert_allclose(mapper.grid.mass, dempster(a.mass, discount(b.mass, 0.3)), atol=1e-6)


@pytest.mark.slow
def test_memory_is_that_of_one_window_however_far_one_drives():
    mapper, grids = EvidentialMapper(SPEC), [noise(SPEC, k) for k in range(3)]
    mapper.update(grids[0], pose(), stamp=0.0)
    tracemalloc.start()
    try:
        for k in range(1, 2300):
            mapper.update(grids[k % 3], pose(10.0 * k), stamp=1.0 * k)
            if k == 2000:  # numba's table of argument types is full by then, at 50 kB
                before = tracemalloc.get_traced_memory()[0]
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert grown < SPEC.shape[0] * SPEC.shape[1]  # an eighth of one map


@each("method", ["nearest", "area"])
@each("T", [pose(3, -2, 100, pitch=0.17, yaw=0.4), pose(1, 5, -30, roll=-0.3, yaw=2.0)])
def test_a_view_is_the_inverse_of_an_update(T, method):
    """What lies 4 m ahead in the scan lies 4 m ahead in the view, also on slopes and far above the map's zero."""
    scan = np.zeros((*SPEC.shape, 2), np.float32)
    scan[48:56, 20:28] = 0.0, 0.9  # 3.2 to 4.8 m ahead, 0.8 m to both sides
    for mapper in (EvidentialMapper(SPEC), BinaryBayesMapper(SPEC)):
        mapper.update(EvidentialGrid(SPEC, scan), T, stamp=0)
        seen = mapper.view(SPEC, method=method).occupied > 0.4
        ix, iy = np.nonzero(seen)
        assert abs(ix.mean() - 51.5) < 0.5
        assert abs(iy.mean() - 23.5) < 0.5
        assert 50 < len(ix) < 80


def test_a_map_that_forgets_nothing_keeps_dynamic_cells():
    mapper = EvidentialMapper(SPEC, half_life=FOREVER)
    mapper.update(uniform(SPEC, 0.5, 0.0), np.eye(4), stamp=0)
    mapper.update(uniform(SPEC, 0.0, 0.9), np.eye(4), stamp=0.1)
    before = mapper.grid.mass
    mapper.update(EvidentialGrid.vacuous(SPEC), np.eye(4), stamp=100)
    np.testing.assert_allclose(mapper.grid.mass, before, atol=1e-6)


def test_a_late_scan_changes_no_conflict_layer():
    for rule in (cautious, lambda a, b: cautious(a, b)):
        mapper = EvidentialMapper(SPEC, rule)
        mapper.update(uniform(SPEC, 0.0, 0.8), np.eye(4), stamp=10.0)
        mapper.update(uniform(SPEC, 0.8, 0.0), np.eye(4), stamp=9.8)
        assert layers(mapper).max() == 0


def test_far_from_the_origin_the_map_is_the_same():
    """UTM coordinates: the map is the same near the origin and far from it."""
    near, far = EvidentialMapper(SPEC), EvidentialMapper(SPEC)
    for k in range(5):
        T = pose(0.33 * k, 0.17 * k, yaw=0.1 * k)
        near.update(noise(SPEC, k), T, stamp=0.1 * k)
        T[:2, 3] += 2_000_000 * 0.2, 25_000_000 * 0.2
        far.update(noise(SPEC, k), T, stamp=0.1 * k)
    assert np.mean(np.abs(near.grid.mass - far.grid.mass) > 1e-5) < 0.001  # cells whose middle lies on an edge


def test_the_map_keeps_its_own_copy_of_a_pose():
    T = pose(1.0)
    mapper = EvidentialMapper(SPEC)
    mapper.update(noise(SPEC), T, stamp=0)
    T[0, 3] = 100.0
    mapper.update(noise(SPEC), pose(1.1), stamp=0.1)
    assert mapper.T_map_vehicle[0, 3] == 1.1


def test_the_view_turns_with_the_vehicle_and_the_map_does_not():
    mapper = EvidentialMapper(GridSpec.centered(length=16, width=16, resolution=0.2), half_life=FOREVER)
    wall = np.zeros((*SPEC.shape, 2), np.float32)
    wall[55:58, :] = 0, 0.8  # across the road, 4.6 m ahead
    mapper.update(EvidentialGrid(SPEC, wall), np.eye(4), stamp=0)
    mapper.update(EvidentialGrid.vacuous(SPEC), pose(yaw=0.25), stamp=0.1)
    assert mapper.grid.at(x=4.9, y=0.1).occupied == pytest.approx(0.8, abs=1e-5)
    left, right = math.cos(0.25) * 4.9, -math.sin(0.25) * 4.9
    assert mapper.view().at(x=left, y=right).occupied == pytest.approx(0.8, abs=1e-5)
    assert mapper.view(SPEC).spec == SPEC


def test_conflict_shows_the_front_and_the_back_of_a_moving_object():
    mapper = EvidentialMapper(SPEC, dempster, moving_half_life=FOREVER, conflict_half_life=0.5)
    street = np.full((*SPEC.shape, 2), (0.7, 0.0), np.float32)
    for k in range(10):
        scan = street.copy()
        scan[4 * k : 4 * k + 8, 20:26] = 0.0, 0.7  # a car that drives forward
        mapper.update(EvidentialGrid(SPEC, scan), np.eye(4), stamp=0.1 * k)
    came, left = (mapper.conflict[name] for name in ("free_to_occupied", "occupied_to_free"))
    assert came[40:44, 20:26].min() > 0.5
    assert left[32:36, 20:26].min() > 0.2
    assert came[46:, :].max() == 0
    assert layers(mapper)[:, :18].max() == 0
    view = mapper.conflict_view(SPEC)
    assert view.spec == SPEC
    np.testing.assert_allclose(view["free_to_occupied"], came)


def test_a_fixed_window_stays_and_takes_the_part_of_a_scan_inside_it():
    yard = GridSpec(0.2, (40, 30), (3.1, -2.7))
    mapper = EvidentialMapper(yard, dempster, FOREVER, window="fixed")
    mapper.update(uniform(SPEC, 0.5, 0), pose(0, 0), stamp=0)
    mapper.update(uniform(SPEC, 0.5, 0), pose(3.0, 0), stamp=1)
    assert mapper.spec == yard
    assert mapper.grid.at(x=3.2, y=0.0).free == pytest.approx(0.75)
    assert mapper.grid.at(x=7.0, y=0.0).free == pytest.approx(0.5)
    assert mapper.grid.at(x=10.0, y=0.0).unknown == 1


def test_a_tilted_vehicle_shortens_the_road_as_the_road_is_shortened():
    """On a slope of 10 degrees, what is 6 m ahead along the road is 6 cos(10 deg) m ahead on the map."""
    scan = np.zeros((*SPEC.shape, 2), np.float32)
    x, _ = SPEC.cell_centers
    scan[np.abs(x[:, 0] - 6.0) < 0.15] = 0, 0.8
    mapper = EvidentialMapper(SPEC)
    mapper.update(EvidentialGrid(SPEC, scan), pose(pitch=math.radians(10)), stamp=0)
    rows = np.flatnonzero(mapper.grid.occupied[:, 24] > 0.5)
    assert abs(mapper.spec.cell_centers[0][rows, 0].mean() - 6 * math.cos(math.radians(10))) < 0.1


@pytest.mark.slow
def test_the_kernels_do_the_same_without_the_compiler():
    """So that tools that read Python can follow them."""
    tests = [f"{__file__}::test_the_compiled_pass_equals_its_slow_reference"]
    tests += [f"{Path(__file__).parent / 'test_bayes_mapper.py'}::test_kernel_equals_its_slow_reference"]
    words = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", *tests]
    subprocess.run(words, check=True, env=os.environ | {"NUMBA_DISABLE_JIT": "1"})


# --- Several models ---------------------------------------------------------------------------------


def half_of_both(masses):
    return 0.5 * masses[0] + 0.5 * masses[1]


def parted(seed: int) -> CombinedGrid:
    a, b = (noise(SPEC, seed + k).mass for k in (0, 100))
    return CombinedGrid.of_parts(SPEC, [a, b], half_of_both)


def test_each_model_has_a_map_of_its_own_and_reading_combines_them():
    mapper, first, second = (EvidentialMapper(SPEC) for _ in range(3))
    for k in range(5):
        grid, T, stamp = parted(k), pose(0.3 * k, 0.1 * k, 0, yaw=0.1 * k), 0.1 * k
        mapper.update(grid, T, stamp=stamp)
        for one, part in ((first, grid.parts[0]), (second, grid.parts[1])):
            one.update(EvidentialGrid(SPEC, part), T, stamp=stamp)
    np.testing.assert_array_equal(mapper.grid.mass, half_of_both([first.grid.mass, second.grid.mass]))
    np.testing.assert_array_equal(mapper.view().mass, half_of_both([first.view().mass, second.view().mass]))
    for name in ("free_to_occupied", "occupied_to_free"):
        np.testing.assert_array_equal(mapper.conflict[name], np.maximum(first.conflict[name], second.conflict[name]))
    same = pickle.loads(pickle.dumps(mapper))
    assert same.grid == mapper.grid


def test_grids_of_one_model_are_a_part_beside_several():
    """A radar beside a lidar: each ages while the other measures, and both are in the map."""
    plain = noise(SPEC, 9)
    for rule in (revise, lambda a, b: revise(a, b)):
        mapper, lidar, radar = (EvidentialMapper(SPEC, rule) for _ in range(3))
        mapper.update(plain, np.eye(4), stamp=0.0, reliability=0.5)
        radar.update(plain, np.eye(4), stamp=0.0, reliability=0.5)
        mapper.update(parted(1), np.eye(4), stamp=1.0)
        lidar.update(parted(1), np.eye(4), stamp=1.0)
        radar.update(EvidentialGrid.vacuous(SPEC), np.eye(4), stamp=1.0)
        np.testing.assert_allclose(mapper.grid.mass, cautious(lidar.grid.mass, radar.grid.mass), atol=1e-6)
        before = mapper.grid
        three = CombinedGrid.of_parts(SPEC, [plain.mass] * 3, lambda masses: masses[0])
        refused("holds 2 models.*combined of 3; call reset", mapper.update, three, np.eye(4), stamp=1.1)
        assert mapper.grid == before
        mapper.reset()
        mapper.update(three, np.eye(4), stamp=0.0)
        assert mapper.scans == 1
