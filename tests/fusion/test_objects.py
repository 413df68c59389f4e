"""Objects: groups of moving cells, as boxes."""

from dataclasses import replace

import numpy as np
import pytest
from cases import each, refused
from dynamic_scenes import SPEC, Block, scene
from hypothesis import given, settings
from hypothesis import strategies as st

from ogm.dynamic_grid import DynamicGrid
from ogm.fusion.dynamic.objects import Objects, ObjectSettings, find_objects
from ogm.grid import GridSpec
from ogm.scan import Boxes


def random_grid(seed: int, share: float = 0.3, shape: tuple[int, int] = (24, 20)) -> DynamicGrid:
    """Return cells that move in a few directions, at random."""
    rng = np.random.default_rng(seed)
    spec = GridSpec(0.2, shape, (-3.0, 7.0))
    mass = rng.dirichlet([1, 1, 1, 1], shape)[..., :3].astype(np.float32)
    mass[..., 2] *= rng.random(shape) < share
    angle = rng.choice([0.0, 1.5, 3.0], shape) + rng.normal(0, 0.1, shape)
    velocity = rng.uniform(0.2, 6, (*shape, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    covariance = np.broadcast_to(np.eye(2) * 0.3, (*shape, 2, 2)).copy()
    velocity[mass[..., 2] == 0], covariance[mass[..., 2] == 0] = np.nan, np.nan
    return DynamicGrid(spec, mass, velocity.astype(np.float32), covariance.astype(np.float32))


def slow_groups(grid: DynamicGrid, chosen: ObjectSettings) -> list[frozenset[tuple[int, int]]]:
    """Join cells by flooding: the slow reference."""
    dynamic, static, v = grid.dynamic.astype(float), grid.static.astype(float), grid.velocity.astype(float)
    moving = {
        (i, j)
        for i, j in np.ndindex(grid.spec.shape)
        if dynamic[i, j] >= chosen.min_dynamic
        and dynamic[i, j] >= chosen.min_share * (dynamic[i, j] + static[i, j])
        and np.hypot(*v[i, j]) >= chosen.min_speed
    }
    reach, groups = max(int(chosen.reach / grid.spec.resolution + 1e-6), 1), []
    while moving:
        found, edge = set(), [min(moving)]
        moving.remove(edge[0])
        while edge:
            a = edge.pop()
            found.add(a)
            for b in list(moving):
                near = max(abs(a[0] - b[0]), abs(a[1] - b[1])) <= reach
                faster = max(np.hypot(*v[a]), np.hypot(*v[b]))
                alike = np.hypot(*(v[a] - v[b])) <= chosen.max_difference + chosen.relative_difference * faster
                if near and alike:
                    moving.remove(b)
                    edge.append(b)
        groups.append(frozenset(found))
    return groups


@each(("vx", "vy"), [(5.0, 0.0), (-3.0, 3.0), (0.5, -2.0)])
def test_a_block_is_one_object_with_its_velocity_and_its_box(vx: float, vy: float) -> None:
    block = Block(2.0, -3.0, vx, vy)
    grid = scene(block)
    found = find_objects(grid)
    assert len(found) == 1
    np.testing.assert_allclose(found.velocity, [[vx, vy]], atol=1e-5)
    np.testing.assert_allclose(found.boxes.center[0, :2], [2.0, -3.0], atol=0.11)
    np.testing.assert_allclose(found.boxes.size[0, :2], [4.0, 2.0], atol=0.25)
    assert found.boxes.yaw[0] == pytest.approx(np.arctan2(vy, vx), abs=1e-5)
    assert found.boxes.bottom[0] == pytest.approx(0.0)
    np.testing.assert_array_equal(found.label > 0, block.cells(SPEC))
    assert found.mass[0] == pytest.approx(grid.dynamic.sum(), rel=1e-5)
    assert found.boxes.track == ("",)
    assert found.turn_rate[0] == 0


def test_the_velocity_is_the_mean_weighted_by_dynamic_mass() -> None:
    grid = scene(Block(0.1, 0.1, 4.0, 0.0))
    mass, velocity = grid.mass.copy(), grid.velocity.copy()
    right = (grid.dynamic > 0) & (np.arange(SPEC.shape[1]) * SPEC.resolution + SPEC.origin[1] >= 0)
    mass[right, 2], velocity[right, 0] = 0.4, 5.0
    found = find_objects(replace(grid, mass=mass, velocity=velocity))
    weight = mass[..., 2][grid.dynamic > 0]
    assert found.velocity[0, 0] == pytest.approx(np.average(velocity[grid.dynamic > 0][:, 0], weights=weight), rel=1e-5)


@each(("other", "count"), [((5.0, 0.5), 1), ((-5.0, 0.0), 2), ((0.0, 4.0), 2), ((12.0, 0.0), 2)])
def test_touching_groups_are_one_object_if_their_velocities_agree(other: tuple[float, float], count: int) -> None:
    grid = scene(Block(0, 0, 5, 0, yaw=0), Block(0, 2.0, *other, yaw=0))
    assert len(find_objects(grid)) == count


@each(("gap", "count"), [(0.2, 1), (0.6, 2)])
def test_small_gaps_are_bridged(gap: float, count: int) -> None:
    grid = scene(Block(-2.0, 0, 5, 0), Block(2.0 + gap, 0, 5, 0))
    assert len(find_objects(grid, ObjectSettings(reach=0.4))) == count


def test_what_stands_is_slow_small_or_of_uncertain_velocity_is_no_object() -> None:
    assert len(find_objects(scene())) == 0
    assert len(find_objects(scene(Block(0, 0, 0.3, 0)))) == 0
    assert len(find_objects(scene(Block(0, 0, 5, 0, length=0.2, width=0.2)))) == 0
    assert len(find_objects(scene(Block(0, 0, 5, 0), dynamic=0.05))) == 0
    assert len(find_objects(scene(Block(0, 0, 5, 0), variance=100.0))) == 0
    unclear = scene(Block(0, 0, 5, 0))
    assert len(find_objects(replace(unclear, velocity=np.full_like(unclear.velocity, np.nan)))) == 0


@given(st.integers(0, 2**32), st.floats(0.05, 0.6), st.sampled_from([0.2, 0.45]), st.sampled_from([1, 3]))
@settings(max_examples=25, deadline=None)
def test_groups_are_those_of_flooding(seed: int, share: float, reach: float, least: int) -> None:
    grid, chosen = (
        random_grid(seed, share),
        ObjectSettings(reach=reach, min_cells=least, min_speed=0.5, max_deviation=100.0),
    )
    found = find_objects(grid, chosen)
    groups = [group for group in slow_groups(grid, chosen) if len(group) >= least]
    groups = [group for group in groups if np.hypot(*_mean(grid, group)) >= chosen.min_speed]
    assert [frozenset(zip(*np.nonzero(found.label == k + 1), strict=True)) for k in range(len(found))] == groups
    for velocity, group in zip(found.velocity, groups, strict=True):
        np.testing.assert_allclose(velocity, _mean(grid, group), atol=1e-5)


def _mean(grid: DynamicGrid, group: frozenset[tuple[int, int]]) -> np.ndarray:
    at = tuple(np.array(sorted(group)).T)
    return np.average(grid.velocity[at].astype(float), axis=0, weights=grid.dynamic[at].astype(float))


@given(st.integers(0, 2**32), st.sampled_from([0.0, 1.0, 100.0]))
@settings(max_examples=25, deadline=None)
def test_boxes_hold_their_cells_and_covariances_are_covariances(seed: int, heading_speed: float) -> None:
    chosen = ObjectSettings(min_cells=1, heading_speed=heading_speed, max_deviation=100.0)
    grid = random_grid(seed)
    found = find_objects(grid, chosen)
    for k, (center, size, yaw) in enumerate(zip(found.boxes.center, found.boxes.size, found.boxes.yaw, strict=True)):
        xy = np.argwhere(found.label == k + 1) * 0.2 + 0.1 + grid.spec.origin - center[:2]
        along = xy @ np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
        np.testing.assert_allclose(abs(along).max(axis=0), (size[:2] - 0.2) / 2, atol=1e-6)
        assert np.linalg.eigvalsh(found.covariance[k]).min() >= chosen.min_deviation**2 * 0.999


def test_a_slow_object_has_the_box_of_least_area() -> None:
    grid = scene(Block(0, 0, 0.6, 0.0, length=6.0, width=1.0, yaw=0.7))
    found = find_objects(grid, ObjectSettings(heading_speed=1.0))
    assert found.boxes.yaw[0] % np.pi == pytest.approx(0.7, abs=0.1)
    np.testing.assert_allclose(found.boxes.size[0, :2], [6.0, 1.0], atol=0.4)


def test_a_map_that_is_turned_turns_the_objects() -> None:
    grid = random_grid(4)
    back = np.array([[0, 1], [-1, 0]])  # a quarter clockwise: what lay along x lies along -y
    covariance = back @ np.rot90(grid.covariance, -1) @ back.T
    spec = replace(grid.spec, shape=grid.spec.shape[::-1])
    turned = DynamicGrid(
        spec,
        np.rot90(grid.mass, -1).copy(),
        (np.rot90(grid.velocity, -1) @ back.T).astype(np.float32),
        covariance.astype(np.float32),
    )
    chosen = ObjectSettings(max_deviation=100.0)
    one, other = find_objects(grid, chosen), find_objects(turned, chosen)
    assert len(one) > 0
    order, same = np.lexsort(np.round(one.velocity.T, 3)), np.lexsort(np.round((other.velocity @ back).T, 3))
    np.testing.assert_allclose(one.velocity[order], (other.velocity @ back)[same], atol=1e-5)
    np.testing.assert_allclose(one.boxes.size[order], other.boxes.size[same], atol=1e-5)
    np.testing.assert_allclose(one.covariance[order], (back.T @ other.covariance @ back)[same], atol=1e-5)


def test_some_objects_keep_their_cells() -> None:
    found = find_objects(scene(Block(-8, 0, 5, 0), Block(0, 0, 4, 0), Block(8, 0, 3, 0)))
    named = replace(found, boxes=replace(found.boxes, track=("7", "", "9")))
    kept = named.confirmed
    assert kept.boxes.track == ("7", "9")
    assert repr(named) == "Objects(3, 2 with a track number)"
    np.testing.assert_array_equal(kept.label == 2, found.label == 3)
    np.testing.assert_array_equal(kept.label == 0, (found.label == 0) | (found.label == 2))
    assert len(named.select(np.zeros(3, bool))) == 0
    assert not named.select(np.zeros(3, bool)).label.any()


def test_objects_whose_columns_differ_are_refused() -> None:
    label = np.zeros((2, 2), np.int32)
    refused("velocity", Objects, Boxes.empty(), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0), label)
    boxes = Boxes(np.zeros((1, 3)), np.ones((1, 3)), np.zeros(1), np.zeros((1, 2)))
    refused("turn_rate", Objects, boxes, np.zeros((1, 2, 2)), np.zeros(2), np.zeros(1), label)
