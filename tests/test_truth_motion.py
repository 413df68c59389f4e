"""True motion of cells: rigid bodies, tracks, and what crops and mirrors make of it."""

import math
import pickle
from collections.abc import Callable

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given, settings
from hypothesis import strategies as st

from ogm import GridSpec, Motion, Truth
from ogm.pose import pose
from ogm.scan import Boxes
from ogm.state import LazyTruth
from ogm.truth import motion_of_boxes
from ogm.truth.motion import track_motion
from ogm.truth.scans import ignore_cells

SPEC = GridSpec(0.2, (60, 50), (-6.0, -5.0))
STAMPS = [0.1 * k for k in range(10)]


def car(x: float = 0.0, y: float = 0.0, yaw: float = 0.0, velocity: tuple[float, float] = (0.0, 0.0), **names) -> Boxes:
    """Return one box of 4 m x 2 m."""
    return Boxes(np.array([x, y, 1.0]), np.array([4.0, 2.0, 1.5]), np.array([yaw]), np.array([velocity]), **names)


def both(*parts: Boxes) -> Boxes:
    """Return the boxes of several as one."""
    columns = {name: np.concatenate([getattr(one, name) for one in parts]) for name in ("center", "size", "yaw")}
    return Boxes(**columns, velocity=np.concatenate([one.velocity for one in parts]))


def truth_of(motion: Motion | None) -> Truth:
    return Truth(SPEC, np.zeros(SPEC.shape, np.uint8), None, motion)


# --- Cells under boxes -------------------------------------------------------------------------------


@given(
    st.tuples(st.floats(-4, 4), st.floats(-3, 3), st.floats(-4, 4)),
    st.tuples(st.floats(-15, 15), st.floats(-15, 15)),
    st.floats(-1, 1),
)
@settings(max_examples=8, deadline=None)
def test_cells_move_as_points_of_a_rigid_body(place: tuple, velocity: tuple, turn: float) -> None:
    """Each cell, one by one: moved on with its box for 1 ms, its middle has covered the velocity's way."""
    motion, dt = motion_of_boxes(car(*place, velocity), [turn], SPEC, margin=0.15), 1e-3
    x, y, yaw = place
    T_box_map = np.linalg.inv(pose(x, y, yaw=yaw))
    T = pose(x + velocity[0] * dt, y + velocity[1] * dt, yaw=yaw + turn * dt) @ T_box_map
    for i, j in np.ndindex(*SPEC.shape):
        p = np.array([-6.0 + 0.2 * (i + 0.5), -5.0 + 0.2 * (j + 0.5), 0.0, 1.0])
        u, v = np.abs((T_box_map @ p)[:2])
        if (motion.box[i, j] == 0) != (u <= 2.15 and v <= 1.15):
            assert min(abs(u - 2.15), abs(v - 1.15)) < 1e-9  # on the edge
        if motion.box[i, j] == 0:
            assert motion.velocity[i, j] == pytest.approx(((T @ p - p) / dt)[:2], abs=3e-3)
        else:
            assert motion.box[i, j] == -1
            assert not motion.velocity[i, j].any()


def test_a_parked_car_has_cells_and_no_velocity() -> None:
    motion = motion_of_boxes(car(1.0, 1.0, 0.3), [0.0], SPEC)
    assert np.count_nonzero(motion.box == 0) == pytest.approx(4.3 * 2.3 / 0.04, rel=0.05)
    assert (motion.velocity == 0).all()
    assert motion.known.all()


def test_without_boxes_all_stands_still() -> None:
    motion = motion_of_boxes(Boxes.empty(), [], SPEC)
    assert (motion.speed == 0).all()
    assert (motion.box == -1).all()


def test_a_body_smaller_than_a_cell_has_the_cell_of_its_center() -> None:
    small = Boxes(np.array([0.01, 0.01, 0.0]), np.array([0.05, 0.05, 1.0]), np.zeros(1), np.array([[1.0, 0.0]]))
    assert np.argwhere(motion_of_boxes(small, [0.0], SPEC, margin=0).box == 0).tolist() == [[30, 25]]


@each("order", [(0, 1), (1, 0)])
def test_where_margins_overlap_a_cell_belongs_to_the_box_that_it_lies_in(order: tuple[int, int]) -> None:
    """A car drives past a parked one, 0.2 m beside it: no row of either's cells is the other's."""
    parts = [car(0, -1.1), car(0, 1.1, velocity=(5.0, 0.0))]
    motion = motion_of_boxes(both(*[parts[k] for k in order]), [0.0, 0.0], SPEC, margin=0.15)
    y = np.broadcast_to(SPEC.cell_centers[1], SPEC.shape)
    moving = motion.speed == 5.0
    assert (y[moving] > 0).all()
    assert (y[(motion.box >= 0) & ~moving] < 0).all()
    assert np.count_nonzero(moving) == np.count_nonzero((motion.box >= 0) & ~moving)


def test_nothing_is_known_of_boxes_without_velocity_or_yaw_rate() -> None:
    boxes = both(car(-3, 0), car(3, -3, velocity=(math.nan, math.nan)), car(3, 3, velocity=(2.0, 0.0)))
    motion = motion_of_boxes(boxes, [0.0, 0.0, math.nan], SPEC)
    assert not motion.known[motion.box > 0].any()
    assert motion.known[motion.box < 1].all()
    unstated = Boxes(boxes.center, boxes.size, boxes.yaw)
    np.testing.assert_array_equal(motion_of_boxes(unstated, np.zeros(3), SPEC).known, motion.box < 0)


def test_nothing_is_known_of_unknown_cells_but_where_a_box_is() -> None:
    behind = np.broadcast_to(SPEC.cell_centers[0] < 0, SPEC.shape)
    motion = motion_of_boxes(car(0, 0, velocity=(1.0, 0.0)), [0.1], SPEC, unknown=behind)
    np.testing.assert_array_equal(motion.known, ~behind | (motion.box == 0))


def test_boxes_outside_of_the_grid_have_no_cells() -> None:
    far = both(car(100.0, 0.0), car(-100.0, -100.0), car(7.0, 0.0, velocity=(1.0, 0.0)))
    assert set(np.unique(motion_of_boxes(far, np.zeros(3), SPEC).box)) == {-1, 2}


# --- Crops and mirrors --------------------------------------------------------------------------------


def scene() -> tuple[Boxes, np.ndarray]:
    boxes = both(
        car(1.0, 2.0, 0.4, (3.0, 1.0)), car(-2.0, -1.5, 2.0, (-1.0, 4.0)), car(3.0, -3.0, 1.0, (math.nan,) * 2)
    )
    return boxes, np.array([0.5, -0.3, 0.0])


@given(st.floats(-4, 4), st.floats(-2, 2), st.floats(-2, 2))
@settings(max_examples=30, deadline=None)
def test_a_crop_is_the_motion_of_the_turned_boxes(yaw: float, dx: float, dy: float) -> None:
    """Up to the half cell between a cell's middle and that of the cell that it comes from."""
    boxes, turn = scene()
    cut = truth_of(motion_of_boxes(boxes, turn, SPEC)).crop(SPEC, yaw, dx, dy).motion
    want = motion_of_boxes(boxes.moved(pose(dx, dy, yaw=yaw)), turn, SPEC)
    same = (cut.box == want.box) & (cut.box >= 0)
    assert np.count_nonzero(same) > 0.8 * np.count_nonzero((cut.box >= 0) & (want.box >= 0))
    np.testing.assert_allclose(cut.velocity[same], want.velocity[same], atol=0.5 * 0.2 * 0.71 + 1e-5)
    outside = truth_of(None).crop(SPEC, yaw, dx, dy).ignored
    assert not cut.known[outside].any()
    assert (cut.box[outside] == -1).all()


def test_a_crop_that_does_not_move_keeps_the_motion_exactly() -> None:
    motion = motion_of_boxes(*scene(), SPEC)
    cut = truth_of(motion).crop(SPEC).motion
    np.testing.assert_array_equal(cut.velocity, motion.velocity)
    np.testing.assert_array_equal(cut.box, motion.box)


def test_a_mirrored_truth_has_the_motion_of_the_mirrored_boxes() -> None:
    boxes, turn = scene()
    flip = np.array([1.0, -1.0])
    other = Boxes(boxes.center * [1, -1, 1], boxes.size, -boxes.yaw, boxes.velocity * flip)
    spec = GridSpec(SPEC.resolution, SPEC.shape, (-6.0, -5.0))
    got, want = truth_of(motion_of_boxes(boxes, turn, SPEC)).mirrored(), motion_of_boxes(other, -turn, spec)
    assert got.spec.extent == pytest.approx(spec.extent)
    np.testing.assert_array_equal(got.motion.box, want.box)
    np.testing.assert_allclose(got.motion.velocity, want.velocity, atol=1e-5)


def test_ignored_cells_keep_their_motion() -> None:
    truth = truth_of(motion_of_boxes(*scene(), SPEC))
    assert ignore_cells(truth, np.ones(SPEC.shape, bool)).motion is truth.motion


def test_motion_is_found_when_it_is_asked_for_and_once() -> None:
    asked: list[int] = []

    def find() -> Motion:
        asked.append(1)
        return motion_of_boxes(*scene(), SPEC)

    truth = LazyTruth(SPEC, np.zeros(SPEC.shape, np.uint8), None, find)
    cut = truth.crop(SPEC, 0.3).mirrored()
    assert repr(cut).startswith("Truth(60 x 50 cells")
    assert not asked
    assert cut.motion.known.any()
    assert truth.motion is truth.motion
    assert len(asked) == 1


def test_where_no_motion_is_known_crops_and_mirrors_have_none() -> None:
    for truth in (truth_of(None), LazyTruth(SPEC, np.zeros(SPEC.shape, np.uint8), None, lambda: None)):
        assert truth.motion is truth.crop(SPEC, 0.1).motion is truth.mirrored().motion is None


def test_a_truth_goes_to_another_process_with_its_motion() -> None:
    truth = LazyTruth(SPEC, np.zeros(SPEC.shape, np.uint8), None, lambda: motion_of_boxes(*scene(), SPEC))
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(truth)).motion.velocity, truth.motion.velocity)


def test_what_does_not_fit_is_refused() -> None:
    velocity, box = np.zeros((3, 2, 2), np.float32), np.zeros((3, 2), np.int16)
    refused("velocity must be a float32 array, got float64", Motion, velocity.astype(float), box, error=TypeError)
    refused("box must be a int16 array, got int64", Motion, velocity, box.astype(int), error=TypeError)
    refused("box must be a int16 array, got list", Motion, velocity, [[0]], error=TypeError)
    refused(r"got \(3, 2\) and \(3, 2\)", Motion, velocity[..., 0], box)
    refused(r"got \(2, 3, 2\) and \(3, 2\)", Motion, np.zeros((2, 3, 2), np.float32), box)
    motion = motion_of_boxes(Boxes.empty(), [], GridSpec.centered(2.0, 2.0, 0.2))
    refused(r"motion has shape \(10, 10\), but the spec has \(60, 50\) cells", truth_of, motion)
    message = r"yaw_rate must have shape \(1,\), one per box, got \(2,\)"
    refused(message, motion_of_boxes, car(), [0.0, 0.0], SPEC)
    refused("one stamp per frame, got 10 stamps and 1 frames", track_motion, 0, STAMPS, [Boxes.empty()])


# --- Tracks -------------------------------------------------------------------------------------------


def track(place: Callable[[float], tuple[float, float, float]]) -> list[Boxes]:
    """Return the box of a track at all stamps, at x, y, yaw."""
    return [car(*place(t), track=["a"]) for t in STAMPS]


@given(st.floats(-20, 20), st.floats(-20, 20), st.floats(-2, 2), st.floats(-4, 4), st.floats(-3, 3))
@settings(max_examples=50, deadline=None)
def test_slopes_of_tracks_are_exact_at_constant_acceleration(
    vx: float, vy: float, turn: float, yaw: float, push: float
) -> None:
    frames = track(lambda t: (vx * t + push * t * t / 2, 5 + vy * t, yaw + turn * t))
    for n in range(3, 7):
        found = track_motion(n, STAMPS, frames)
        np.testing.assert_allclose(found.velocity, [[vx + push * STAMPS[n], vy]], atol=1e-9)
        np.testing.assert_allclose(found.yaw_rate, [turn], atol=1e-9)


def test_the_first_and_last_frames_of_a_track_have_no_slope_of_both_sides() -> None:
    frames = track(lambda t: (3 * t, 0.0, 0.1 * t))
    known = [bool(np.isfinite(track_motion(n, STAMPS, frames).velocity).all()) for n in range(10)]
    assert known == [False] * 3 + [True] * 4 + [False] * 3
    for n in (0, 9):
        found = track_motion(n, STAMPS, frames, needed=0)
        np.testing.assert_allclose([*found.velocity[0], *found.yaw_rate], [3.0, 0.0, 0.1], atol=1e-9)


def test_a_yaw_that_jumps_by_a_whole_or_half_turn_does_not_turn() -> None:
    frames = track(
        lambda t: (0.0, 0.0, 0.2 * t + (math.pi if 0.35 < t < 0.55 else 0.0) - (2 * math.pi if t > 0.6 else 0))
    )
    np.testing.assert_allclose(track_motion(4, STAMPS, frames).yaw_rate, [0.2], atol=1e-9)


def test_frames_may_come_in_any_order_and_some_be_missing() -> None:
    frames = track(lambda t: (3 * t, t * t, 0.0))
    want, order = track_motion(4, STAMPS, frames), [7, 4, 1, 2, 5, 3, 6]
    found = track_motion(1, [STAMPS[k] for k in order], [frames[k] for k in order])
    np.testing.assert_allclose(found.velocity, want.velocity, atol=1e-9)
    fewer = [1, 2, 4, 7]
    found = track_motion(2, [STAMPS[k] for k in fewer], [frames[k] for k in fewer])
    np.testing.assert_allclose(found.velocity[0, 0], 3.0, atol=1e-9)


def test_boxes_without_a_track_or_that_were_seen_once_have_no_motion() -> None:
    def frame(k: int) -> Boxes:
        names = ["a", "", "b"] if k == 4 else ["", "a", "c"]
        boxes = both(car(0.0, 0.0), car(1.0, 0.0), car(2.0, 0.0))
        return Boxes(boxes.center, boxes.size, boxes.yaw, track=names)

    found = track_motion(4, STAMPS, [frame(k) for k in range(10)], needed=0)
    assert np.isfinite(found.yaw_rate).tolist() == [True, False, False]
    assert np.isfinite(found.velocity).all(axis=1).tolist() == [True, False, False]
    nothing = track_motion(0, [0.0], [Boxes.empty()])
    assert (nothing.velocity.shape, nothing.yaw_rate.shape) == ((0, 2), (0,))
