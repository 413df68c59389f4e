"""Motion of labelled objects in recordings: their tracks, followed over the poses of the frames."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cases import each

from ogm.datasets import open_dataset
from ogm.datasets.frames import FrameRef, RawFrame
from ogm.datasets.recording import Recording
from ogm.datasets.truth import MotionReader
from ogm.pose import inverse, pose
from ogm.scan import Boxes
from ogm.truth import TRUTH_SPEC


def on_map(t: float) -> np.ndarray:
    """Return T_map_sensor of an ego vehicle that drives a curve."""
    return pose(20 + 5 * t, -3 + t * t, 2.0, yaw=0.7 + 0.2 * t)


def turning_car(n: int) -> Boxes:
    """Return a car that drives (6, -2) m/s on the map and turns by 0.3 rad/s, and one without a track, at frame n."""
    t = 0.1 * n
    center = np.array([[30 + 6 * t, 5 - 2 * t, 2.0], [25.0, 0.0, 2.0]])
    boxes = Boxes(center, np.tile([4.0, 2.0, 1.5], (2, 1)), np.array([3.0 + 0.3 * t, 0.0]), track=["a", ""])
    return boxes.moved(inverse(on_map(t)))


class Turning(Recording):
    """Frames around the car."""

    format = "by hand"
    labelled = ("boxes",)

    def read(self, n: int) -> RawFrame:
        pytest.fail("no scan is read")

    def read_boxes(self, n: int) -> Boxes:
        return turning_car(n)


def motions(posed: Callable[[int], bool] = lambda n: True, view_angle: float | None = None) -> MotionReader:
    """Return the motion of 12 frames at 10 Hz."""
    frames = [FrameRef(str(n), "drive", 0.1 * n, on_map(0.1 * n) if posed(n) else None) for n in range(12)]
    recording = Turning(Path("by hand"), frames)
    recording.view_angle = view_angle
    return MotionReader(recording)


def test_velocities_of_tracks_are_over_ground_along_the_sensors_axes() -> None:
    read = motions()
    for n in range(3, 9):
        velocity = read.boxes(n).velocity
        np.testing.assert_allclose(velocity[0], on_map(0.1 * n)[:2, :2].T @ [6.0, -2.0], atol=1e-6)
        assert np.isnan(velocity[1]).all()
        motion = read.cells(n, TRUTH_SPEC)
        x, y = TRUTH_SPEC.cell_centers
        r = np.stack(np.broadcast_arrays(x, y), axis=-1)[motion.box == 0] - read.boxes(n).center[0, :2]
        want = velocity[0] + 0.3 * np.stack([-r[:, 1], r[:, 0]], axis=1)
        np.testing.assert_allclose(motion.velocity[motion.box == 0], want, atol=1e-4)
        assert not motion.known[motion.box == 1].any()


@each("n", [0, 2, 9, 11])
def test_nothing_is_known_of_the_first_and_last_frames_of_a_track(n: int) -> None:
    motion = motions().cells(n, TRUTH_SPEC)
    assert np.isnan(motions().boxes(n).velocity).all()
    assert not motion.known[motion.box >= 0].any()
    assert motion.known[TRUTH_SPEC.index(-10.0, 20.0)]


def test_frames_without_a_pose_have_no_motion_and_count_for_none() -> None:
    read = motions(lambda n: n != 5)
    assert read.boxes(5).velocity is None
    assert read.cells(5, TRUTH_SPEC) is None
    assert np.isfinite(read.boxes(6).velocity[0]).all()
    assert motions(lambda n: False).cells(6, TRUTH_SPEC) is None


def test_outside_of_the_labelled_view_and_under_the_ego_vehicle_nothing_is_known() -> None:
    motion = motions(view_angle=np.radians(40)).cells(6, TRUTH_SPEC)
    x, y = np.broadcast_arrays(*TRUTH_SPEC.cell_centers)
    away = np.abs(np.arctan2(y, x))
    empty = motion.box < 0
    assert not motion.known[empty & (away > np.radians(40.01))].any()
    assert motion.known[empty & (away < np.radians(39.99)) & (x > 2.6)].all()
    assert not motion.known[TRUTH_SPEC.index(2.0, 0.0)]


def test_recordings_hold_the_motion_of_their_tracks(written: Callable[[str], Path]) -> None:
    """The made-up street is 0.4 s long: its boxes have tracks, but no frame has enough of them on both sides."""
    for name in ("kitti raw", "kitti tracking"):
        frame = open_dataset(written(name))[2]
        assert np.isnan(frame.boxes.velocity).all()
        motion = frame.truth.motion
        assert set(np.unique(motion.box)) == {-1, 0, 1}
        ahead, aside = TRUTH_SPEC.index(20.0, 10.0), TRUTH_SPEC.index(10.0, 20.0)
        assert motion.known[ahead]
        assert not motion.known[aside]
    for name in ("kitti object", "semantic kitti"):  # no tracks; no boxes
        assert open_dataset(written(name))[2].truth.motion is None


def test_the_van_and_the_cyclist_of_kitti_move_and_the_parked_van_does_not(real: Callable[[str], Path]) -> None:
    dataset = open_dataset(real("kitti_raw_0005"), truth="boxes")
    speeds: dict[str, list[float]] = {}
    for frame in dataset[9:21]:
        for track, velocity in zip(frame.boxes.track, frame.boxes.velocity, strict=True):
            speeds.setdefault(track, []).append(float(np.hypot(*velocity)))
    van, cyclist, parked = (np.array(speeds[track]) for track in ("0", "1", "3"))
    assert np.median(van) == pytest.approx(6.9, abs=0.3)
    assert np.median(cyclist) == pytest.approx(4.9, abs=0.3)
    assert parked.max() < 0.3
    assert np.isnan(dataset[2].boxes.velocity).all()
    assert np.isnan(dataset[21].boxes.velocity).all()
    frame = dataset[10]
    motion = frame.truth.motion
    moving = motion.box[motion.speed > 1]
    assert {frame.boxes.label[k] for k in np.unique(moving)} == {"Van", "Cyclist"}
    assert np.count_nonzero(motion.box == 2) > 100  # the van that is parked
