"""Tracks: numbers that stay with their objects, filtered velocities and turn rates."""

import math
import sys
from dataclasses import replace

import numpy as np
import pytest
from cases import each, needs, refused
from dynamic_scenes import SPEC, Block, scene

from ogm.fusion.dynamic.object_tracker import ObjectTracker, TrackerSettings
from ogm.fusion.dynamic.objects import Objects, find_objects
from ogm.scan import Boxes

needs("filterpy")


def objects(*states: tuple[float, float, float, float], deviation: float = 0.3) -> Objects:
    """Return objects without cells, of (x, y, vx, vy)."""
    z = np.array(states, float).reshape(-1, 4)
    center, size = np.column_stack([z[:, :2], np.full(len(z), 0.75)]), np.tile([4.0, 2.0, 1.5], (len(z), 1))
    boxes = Boxes(center, size, np.arctan2(z[:, 3], z[:, 2]), z[:, 2:])
    covariance = np.tile(np.eye(2) * deviation**2, (len(z), 1, 1))
    return Objects(boxes, covariance, np.zeros(len(z)), np.ones(len(z)), np.zeros((1, 1), np.int32))


def numbers(tracker: ObjectTracker, scans: list[Objects], dt: float = 0.1) -> list[tuple[str, ...]]:
    return [tuple(tracker.update(found, dt * k).boxes.track) for k, found in enumerate(scans)]


def turning(t: float, turn: float = 0.5, speed: float = 6.0) -> tuple[float, float, float, float]:
    block = Block(0, 0, speed, 0, turn).at(t)
    return block.x, block.y, block.vx, block.vy


def test_a_track_is_confirmed_once_its_object_was_found_often_enough() -> None:
    found = numbers(ObjectTracker(), [objects((0.5 * k, 0, 5, 0)) for k in range(6)])
    assert found == [("",)] * 2 + [("1",)] * 4
    scans = [objects((0.5 * k, 0, 5, 0)) if k in (0, 2, 5, 6) else objects() for k in range(7)]
    assert [names for names in numbers(ObjectTracker(), scans) if names] == [("",), ("",), ("",), ("1",)]


def test_crossing_objects_keep_their_numbers() -> None:
    scans = [objects((-10 + 0.5 * k, 0, 5, 0), (0, -10 + 0.5 * k, 0, 5)) for k in range(40)]
    assert set(numbers(ObjectTracker(), scans)[2:]) == {("1", "2")}
    shuffled = [one if k % 3 else one.select([1, 0]) for k, one in enumerate(scans)]
    found = numbers(ObjectTracker(), shuffled)[2:]
    assert {frozenset(names) for names in found} == {frozenset("12")}
    assert {names if (k + 2) % 3 else names[::-1] for k, names in enumerate(found)} == {found[0]}


def test_objects_that_pass_each_other_keep_their_numbers() -> None:
    scans = [objects((-8 + 0.4 * k, 0, 4, 0), (8 - 0.4 * k, 1.0, -4, 0)) for k in range(40)]
    assert set(numbers(ObjectTracker(), scans)[2:]) == {("1", "2")}


def test_missed_scans_do_not_end_a_track_but_many_do() -> None:
    scans = [objects(turning(0.1 * k)) if not 10 <= k < 15 else objects() for k in range(30)]
    assert set(numbers(ObjectTracker(), scans)[15:]) == {("1",)}
    tracker = ObjectTracker(TrackerSettings(max_missed=4))
    assert set(numbers(tracker, scans)[18:]) == {("2",)}, "a number is never given twice"
    numbers_left = ObjectTracker()
    numbers(numbers_left, scans[:10] + [objects()] * 6)
    assert len(numbers_left._tracks) == 0


def test_a_static_scene_has_no_tracks() -> None:
    tracker = ObjectTracker()
    for k in range(10):
        assert len(tracker.update(find_objects(scene()), 0.1 * k)) == 0
    assert len(tracker._tracks) == 0


def test_what_flickers_in_place_with_random_velocities_gets_no_number() -> None:
    """A static thing whose cells are taken for moving: its position shows that it does not move."""
    rng = np.random.default_rng(0)
    counted = 0
    for _ in range(20):
        angles = rng.uniform(-np.pi, np.pi, 30)
        scans = [objects((3, 4, 2 * math.cos(a), 2 * math.sin(a)), deviation=1.0) for a in angles]
        counted += any(name for names in numbers(ObjectTracker(), scans) for name in names)
    assert counted <= 8


def test_velocities_are_filtered_and_their_covariances_fit() -> None:
    rng = np.random.default_rng(1)
    errors, distances = [], []
    for _ in range(30):
        tracker = ObjectTracker(TrackerSettings(position_deviation=0.3, relative_deviation=0.0, acceleration=0.3))
        for k in range(20):
            noise = rng.normal(0, [0.3, 0.3, 0.5, 0.5])
            found = tracker.update(objects(np.array([0.5 * k, 0.2 * k, 5, 2]) + noise, deviation=0.5), 0.1 * k)
        away = found.velocity[0] - [5, 2]
        errors.append(np.hypot(*away))
        distances.append(away @ np.linalg.solve(found.covariance[0], away))
    assert np.mean(errors) < 0.7 * 0.5 * math.sqrt(math.pi / 2)  # the mean length of a single measurement's error
    assert np.mean(distances) < 2.0  # the object does not accelerate, as the filter assumes that it may


@each("turn", [-0.8, 0.0, 0.4])
def test_a_turn_rate_is_found(turn: float) -> None:
    tracker = ObjectTracker()
    for k in range(40):  # the heading passes pi
        found = tracker.update(objects(turning(0.1 * k, turn), deviation=0.1), 0.1 * k)
    assert found.turn_rate[0] == pytest.approx(turn, abs=0.1)
    np.testing.assert_allclose(found.velocity[0], turning(3.9, turn)[2:], atol=0.25)


def test_a_map_that_is_moved_changes_nothing() -> None:
    drift = np.random.default_rng(2).normal(0, 0.2, (30, 4))
    scans = [objects((0.5 * k, 0, 5, 0), (0, 3 + 0.1 * k, 0, 1) + d) for k, d in enumerate(drift)]
    far = [replace(s, boxes=replace(s.boxes, center=s.boxes.center + [4e5, 5e6, 0])) for s in scans]
    here, there = ObjectTracker(), ObjectTracker()
    for k, (one, other) in enumerate(zip(scans, far, strict=True)):
        a, b = here.update(one, 0.1 * k), there.update(other, 0.1 * k)
        assert a.boxes.track == b.boxes.track
        np.testing.assert_allclose(a.velocity, b.velocity, atol=1e-6)
        np.testing.assert_allclose(a.turn_rate, b.turn_rate, atol=1e-6)


def test_the_order_of_the_objects_does_not_matter_to_confirmed_tracks() -> None:
    scans = [objects((0.5 * k, 0, 5, 0), (0.4 * k, 3, 4, 0), (9 - 0.3 * k, -4, -3, 0)) for k in range(20)]
    tracker, other = ObjectTracker(), ObjectTracker()
    for k, found in enumerate(scans):
        a = tracker.update(found, 0.1 * k)
        b = other.update(found if k < 5 else found.select([2, 0, 1]), 0.1 * k)
        if k >= 5:
            assert a.select([2, 0, 1]).boxes.track == b.boxes.track


def test_objects_of_grids_keep_cells_boxes_and_masses() -> None:
    tracker, block = ObjectTracker(), Block(-8, 0, 5, 1)
    for k in range(5):
        found = find_objects(scene(block.at(0.1 * k)))
        tracked = tracker.update(found, 0.1 * k)
    np.testing.assert_array_equal(tracked.label, found.label)
    np.testing.assert_array_equal(tracked.boxes.center, found.boxes.center)
    np.testing.assert_array_equal(tracked.mass, found.mass)
    assert tracked.boxes.track == ("1",)
    assert tracked.label.shape == SPEC.shape


def test_memory_is_bounded_and_clutter_is_rarely_confirmed() -> None:
    rng, tracker, named = np.random.default_rng(3), ObjectTracker(), 0
    for k in range(50):
        clutter = np.column_stack([rng.uniform(-40, 40, (20, 2)), rng.uniform(-8, 8, (20, 2))])
        named += sum(map(bool, tracker.update(objects(*clutter), 0.1 * k).boxes.track))
        assert len(tracker._tracks) <= 7 * 20
    assert named < 50
    crowd = np.column_stack([rng.uniform(-4000, 4000, (1200, 2)), np.ones((1200, 2))])
    tracker.reset()
    tracker.update(objects(*crowd), 0.0)
    assert len(tracker._tracks) == 1000


def test_stamps_and_reset() -> None:
    tracker = ObjectTracker()
    for k in range(4):
        tracker.update(objects((0.5 * k, 0, 5, 0)), 0.1 * k)
    same = tracker.update(objects((1.5, 0, 5, 0)), 0.3)  # a second sensor
    assert same.boxes.track == ("1",)
    tracker.update(objects(), 0.2995)  # a clock's jitter
    assert repr(tracker) == "ObjectTracker(1 confirmed of 1 tracks)"
    for stamp in (0.2, math.nan, math.inf):
        refused("stamp", tracker.update, objects(), stamp)
    tracker.reset()
    assert len(tracker._tracks) == 0
    assert numbers(tracker, [objects((0.5 * k, 0, 5, 0)) for k in range(3)])[-1] == ("1",)


def test_a_missing_package_is_named_with_its_install_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "filterpy.kalman", None)
    refused("pip install .*\\[track\\]", ObjectTracker, error=ImportError)
