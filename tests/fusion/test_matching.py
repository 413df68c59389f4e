"""Laws of `ogm.fusion.dynamic.matching`: velocities from groups of occupied cells."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from cases import each, refused
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy import ndimage

from ogm.fusion.dynamic.groups import LEVELS, capped_distance, find_groups
from ogm.fusion.dynamic.matching import MatchSettings, match_velocities
from ogm.fusion.dynamic.scan_history import ScanCells

SHAPE, SIDE = (120, 100), 0.16
L_SHAPE = np.array([(i, 0) for i in range(12)] + [(0, j) for j in range(1, 7)])
PEDESTRIAN = np.array([(0, 0), (0, 1), (1, 0), (1, 1), (2, 1), (1, 2)])


def painted(cells, shift=(0, 0), shape=SHAPE):
    mask = np.zeros(shape, bool)
    i, j = np.round(np.asarray(cells) + shift).astype(int).T
    inside = (i >= 0) & (i < shape[0]) & (j >= 0) & (j < shape[1])
    mask[i[inside], j[inside]] = True
    return mask


def seen(mask, age=0.0, hidden=None):
    """Return a scan that shows a mask, and all else but hidden cells as clear."""
    return ScanCells(mask, np.zeros(mask.shape, bool) if hidden is None else hidden, age)


def moved(cells, at, per_second, ages=(0.2, 0.4)):
    """Return the mask now and the earlier ones of cells that move by whole cells."""
    velocity = np.array(per_second)
    return painted(cells, at), [seen(painted(cells, at - velocity * age), age) for age in ages]


def matched(now, earlier, **kwargs):
    return match_velocities(seen(now), now, earlier, SIDE, MatchSettings(**kwargs))


@given(st.integers(0, 2**32 - 1), st.floats(1, 11))
@settings(max_examples=25, deadline=None)
def test_capped_distance_is_the_euclidean_one_up_to_the_cap(seed, cap):
    rng = np.random.default_rng(seed)
    mask = rng.random((40, 37)) < rng.choice([0, 0.003, 0.05])
    out = np.empty(mask.shape, np.uint8)
    capped_distance(mask.view(np.uint8), cap, out)
    exact = ndimage.distance_transform_edt(~mask) if mask.any() else np.full(mask.shape, np.inf)
    np.testing.assert_allclose(out * (cap / LEVELS), np.minimum(exact, cap), atol=cap / LEVELS / 2 + 1e-6)


@given(st.integers(0, 2**32 - 1), st.integers(0, 2))
@settings(max_examples=25, deadline=None)
def test_groups_are_those_of_dilating_and_labelling(seed, dilation):
    rng = np.random.default_rng(seed)
    mask = rng.random((40, 37)) < 0.03
    candidates = mask & (rng.random(mask.shape) < 0.2)
    groups = find_groups(mask.view(np.uint8), candidates.view(np.uint8), 2 * dilation + 1, 1)
    wide = ndimage.binary_dilation(mask, np.ones((2 * dilation + 1,) * 2))
    label = ndimage.label(wide, np.ones((3, 3)))[0] * mask
    kept = np.unique(label[candidates])
    assert len(groups.start) == len(kept) + 1
    pairs = np.unique(np.stack([label.ravel(), groups.label.ravel()]), axis=1)
    assert len(pairs[0]) == len(np.unique(pairs[0]))  # each label of one has one label of the other
    assert set(pairs[0][pairs[1] > 0]) == set(kept)
    np.testing.assert_array_equal(np.diff(groups.start), np.bincount(groups.label.ravel(), minlength=len(kept) + 1)[1:])
    np.testing.assert_array_equal(
        groups.label[groups.x, groups.y], np.repeat(np.arange(len(kept)) + 1, np.diff(groups.start))
    )


@given(st.integers(-20, 20), st.integers(-20, 20))
@settings(max_examples=30, deadline=None)
def test_whole_cells_are_recovered_exactly(a, b):
    assume(2 <= np.hypot(a, b) <= 24)
    per_second = np.array([a, b]) * 5.0  # whole cells in 0.2 s
    now, earlier = moved(L_SHAPE, (60, 50), per_second)
    sharp = matched(now, earlier, spread=1e-4)
    np.testing.assert_allclose(sharp.velocity, [per_second * SIDE], atol=1e-6)
    np.testing.assert_allclose(sharp.residual, 0, atol=1e-6)
    match = matched(now, earlier)
    assert match.valid.all()
    np.testing.assert_allclose(match.velocity, [per_second * SIDE], atol=0.1)


def brute_force(now, earlier, numbers):
    """The plain formula, in numpy, for one group."""
    cells = np.argwhere(now)
    oldest = max(scan.age for scan in earlier)
    reach = int(numbers.max_speed * oldest / SIDE + 1e-6)
    costs = {}
    for a in range(-reach, reach + 1):
        for b in range(-reach, reach + 1):
            v = np.array([a, b]) * SIDE / oldest
            if np.hypot(*v) > numbers.max_speed + 1e-6:
                continue
            total = numbers.speed_cost * np.hypot(*v)
            for mask, _, age in earlier:
                distance = ndimage.distance_transform_edt(np.pad(~mask, 20, constant_values=True))
                distance = np.minimum(distance * SIDE, numbers.cap)
                at = cells - v * age / SIDE + 20
                total += ndimage.map_coordinates(distance, at.T, order=1).mean() / len(earlier)
            costs[a, b] = total
    return min(costs.values()), costs, SIDE / oldest


@pytest.mark.parametrize("seed", range(3))
def test_no_velocity_costs_less_by_the_plain_formula(seed):
    rng = np.random.default_rng(seed)
    numbers = MatchSettings(max_speed=4.0, spread=1e-4)
    now, earlier = moved(L_SHAPE, (50, 45), rng.integers(-12, 12, 2), (0.13, 0.4, 0.3)[: 2 + seed % 2])
    earlier = [seen(mask & (rng.random(SHAPE) < 0.8), age) for mask, _, age in earlier]
    match = match_velocities(seen(now), now, earlier, SIDE, numbers)
    least, costs, step = brute_force(now, earlier, numbers)
    assert costs[tuple(np.round(match.velocity[0] / step).astype(int))] <= least + 0.002
    np.testing.assert_allclose(match.residual[0] + numbers.speed_cost * np.hypot(*match.velocity[0]), least, atol=0.002)
    np.testing.assert_allclose(match.residual[0] + match.gain[0], costs[0, 0], atol=0.002)


def test_moving_everything_changes_nothing():
    now, earlier = moved(L_SHAPE, (50, 45), (20, -10))
    there = [seen(np.roll(mask, (13, -9), (0, 1)), age) for mask, _, age in earlier]
    one, other = matched(now, earlier), matched(np.roll(now, (13, -9), (0, 1)), there)
    np.testing.assert_array_equal(one.velocity, other.velocity)
    np.testing.assert_array_equal(one.covariance, other.covariance)


def test_swapping_the_axes_swaps_the_velocity():
    now, earlier = moved(L_SHAPE, (50, 45), (20, -10))
    one, other = matched(now, earlier), matched(now.T.copy(), [seen(mask.T.copy(), age) for mask, _, age in earlier])
    np.testing.assert_allclose(other.velocity, one.velocity[:, ::-1])
    np.testing.assert_allclose(other.covariance, one.covariance[:, ::-1, ::-1], rtol=1e-5)


def test_threads_do_not_change_a_bit():
    rng = np.random.default_rng(3)
    now, earlier = flickering(rng, outline(28, 11), (60, 50), (5, 3))
    with ThreadPoolExecutor(4) as pool:
        matches = list(pool.map(lambda _: matched(now, earlier), range(8)))
    for match in matches[1:]:
        np.testing.assert_array_equal(match.velocity, matches[0].velocity)
        np.testing.assert_array_equal(match.covariance, matches[0].covariance)


def test_small_groups_and_groups_without_candidates_are_left_out():
    now, earlier = moved(PEDESTRIAN[:4], (50, 45), (10, 0))
    assert len(matched(now, earlier).valid) == 0
    now, earlier = moved(L_SHAPE, (50, 45), (10, 0))
    assert len(match_velocities(seen(now), np.zeros(SHAPE, bool), earlier, SIDE).valid) == 0


def test_nothing_is_valid_without_earlier_cells():
    now = painted(L_SHAPE, (50, 45))
    nothing = np.zeros(SHAPE, bool)
    for earlier in ([], [seen(nothing, 0.2), seen(nothing, 0.4)]):
        match = matched(now, earlier)
        assert len(match.valid) == 1
        assert not match.valid.any()


def test_a_wall_that_slides_along_itself_is_uncertain_along_itself():
    wall = np.array([(i, 0) for i in range(60)])
    match = matched(*moved(wall, (30, 45), (0, 15)))
    np.testing.assert_allclose(match.velocity, [[0, 15 * SIDE]], atol=0.05)
    along, across = match.covariance[0, 0, 0], match.covariance[0, 1, 1]
    assert along > 4 * across


def test_a_prior_that_is_sure_decides_between_two_matches():
    now = painted(PEDESTRIAN, (50, 45))
    earlier = [
        seen(painted(PEDESTRIAN, (50 - 4 * k, 45)) | painted(PEDESTRIAN, (50, 45 + 10 * k)), 0.2 * k) for k in (1, 2)
    ]
    free = matched(now, earlier)
    np.testing.assert_allclose(free.velocity, [[4 * SIDE * 5, 0]], atol=0.01)
    prior = np.full((*SHAPE, 2), np.nan)
    prior[now] = 0, -7
    gated = match_velocities(seen(now), now, earlier, SIDE, prior=prior)
    np.testing.assert_allclose(gated.velocity, [[0, -10 * SIDE * 5]], atol=0.01)
    prior[now] += np.random.default_rng(0).normal(0, 4, (now.sum(), 2))  # not sure at all
    np.testing.assert_allclose(match_velocities(seen(now), now, earlier, SIDE, prior=prior).velocity, free.velocity)


def test_what_stands_still_is_no_match():
    here, there = painted(PEDESTRIAN, (50, 45)), painted(PEDESTRIAN, (50, 60))
    ages = (0.1, 0.2, 0.3, 0.4)
    left = matched(here, [seen(painted(PEDESTRIAN, (50, 45 + round(150 * age / 4))), age) for age in ages])
    assert left.valid.all()
    appeared = match_velocities(seen(here | there), here, [seen(there, age) for age in ages], SIDE)
    assert len(appeared.valid) == 1
    assert not appeared.valid.any()


def test_what_stands_rests_also_where_an_edge_reveals_it_and_what_moves_does_not():
    wall, ages = np.array([(i, j) for i in range(30) for j in (0, 1)] + [(0, j) for j in range(12)]), (0.1, 0.2, 0.3)
    now, revealed = painted(wall, (40, 45)), []
    for age in ages:
        hidden = np.zeros(SHAPE, bool)
        hidden[70 - round(30 * age) :] = True
        revealed.append(seen(now & ~hidden, age, hidden))
    match = matched(now, revealed)
    assert match.resting.all()
    assert not match.valid.any()
    for cells, speed in ((wall, 20), (PEDESTRIAN, 8)):  # 3.2 and 1.3 m/s
        match = matched(*moved(cells, (40, 45), (0, speed), ages))
        assert match.valid.all()
        assert not match.resting.any()


def test_what_comes_out_of_a_shadow_or_hides_its_own_way_is_matched():
    ages, car = (0.1, 0.2, 0.3), np.array([(i, 0) for i in range(28)] + [(27, j) for j in range(12)])
    hidden = np.zeros(SHAPE, bool)
    hidden[:50] = True
    out = [seen(painted(car, (40 - 60 * age, 45)) & ~hidden, age, hidden) for age in ages]
    match = matched(painted(car, (40, 45)) & ~hidden, out)
    assert match.valid.all()
    np.testing.assert_allclose(match.velocity, [[60 * SIDE, 0]], atol=0.7)
    rear, recedes = np.array([(0, j) for j in range(12)]), []
    for age in ages:
        hidden = np.zeros(SHAPE, bool)
        hidden[51 - round(30 * age) :, 45:57] = True
        recedes.append(seen(painted(rear, (50 - 30 * age, 45)), age, hidden))
    match = matched(painted(rear, (50, 45)), recedes)
    assert match.valid.all()
    np.testing.assert_allclose(match.velocity, [[30 * SIDE, 0]], atol=0.2)


AGES = (0.1, 0.2, 0.3, 0.4)


def outline(length, width, visible=1.0):
    """Return points of the near sides of a box around (0, 0): its front, and the visible share of one side [cells]."""
    front = [(length / 2, y) for y in np.arange(-width / 2, width / 2, 0.5)]
    side = [(length / 2 - x, -width / 2) for x in np.arange(0, length * visible, 0.5)]
    return np.array(front + side)


def flickering(rng, points, at, velocity, visible=None):
    """Return scans, newest first, of a box that moves by sub-cell steps while a fifth of its cells is dropped."""
    masks = []
    for age in (0.0, *AGES):
        shape = points if visible is None else outline(28, 11, visible(age))
        masks.append(painted(shape, np.asarray(at) - np.array(velocity) * age / SIDE) & (rng.random(SHAPE) < 0.8))
    return masks[0], [seen(mask, age) for mask, age in zip(masks[1:], AGES, strict=True)]


@each("visible", [None, lambda age: 0.9 - 1.5 * age])
def test_flicker_and_a_growing_view_cost_little(visible):
    rng = np.random.default_rng(7)
    errors, inside, found = [], [], 0
    for _ in range(40):
        speed, heading = rng.uniform(2, 12), rng.uniform(-np.pi, np.pi)
        velocity = speed * np.array([np.cos(heading), np.sin(heading)])
        match = matched(*flickering(rng, outline(28, 11), (60, 50) + rng.random(2), velocity, visible))
        best = np.argmax(np.bincount(match.label[match.label > 0])) - 1
        found += match.valid[best]
        error = match.velocity[best] - velocity
        errors.append(np.hypot(*error))
        inside.append(error @ np.linalg.inv(match.covariance[best]) @ error < 5.99)
    assert found >= 38
    assert np.median(errors) < 0.35
    assert np.max(errors) < 1.0
    assert np.mean(inside) > 0.8


def test_standing_shapes_that_flicker_get_no_velocity():
    rng = np.random.default_rng(8)
    walls = np.array([(i, 0) for i in range(40)])
    bush = np.array([(i, j) for i in range(6) for j in range(6)])
    matches = [matched(*flickering(rng, shape, (45, 50), (0, 0))) for shape in [walls, bush, L_SHAPE] * 40]
    valid = np.concatenate([match.valid for match in matches])
    assert len(valid) >= 120
    assert valid.sum() <= 1


def test_settings_and_masks_that_do_not_fit_are_refused():
    for change, message in (
        ({"max_speed": 0}, "max_speed"),
        ({"cap": np.nan}, "cap"),
        ({"max_cells": 1000}, "max_cells <= 655"),
    ):
        refused(message, MatchSettings, **change)
    now, earlier = moved(L_SHAPE, (50, 45), (10, 0))
    mask, scan = earlier[0].occupied, seen(now)
    refused("an earlier mask must be bool", match_velocities, scan, now, [seen(mask[1:], 0.2)], SIDE)
    refused("above 0 s", match_velocities, scan, now, [seen(mask)], SIDE)
    refused("resolution", match_velocities, scan, now, earlier, 0.0)
    refused("prior must have shape", match_velocities, scan, now, earlier, SIDE, prior=np.zeros((*SHAPE, 3)))
