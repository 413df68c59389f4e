"""`TransformBuffer`: chains, interpolation and errors in words."""

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ogm.io.transforms import (
    ExtrapolationError,
    NotConnectedError,
    StampedTransform,
    TransformBuffer,
    TransformError,
    UnknownFrameError,
)
from ogm.pose import Trajectory, inverse, pose
from ogm.storage.files import OgmError

angle = st.floats(-3.0, 3.0)
metre = st.floats(-50.0, 50.0)
poses = st.builds(lambda x, y, z, a, b, c: pose(x, y, z, roll=a, pitch=b / 2, yaw=c), metre, metre, metre, *[angle] * 3)


def tree() -> tuple[TransformBuffer, Trajectory, Trajectory]:
    """map -> odom (every second) -> base (every 0.1 s) -> lidar, camera (static)."""
    rng = np.random.default_rng(1)
    slow = Trajectory(np.arange(6.0), np.array([pose(*rng.normal(size=3), yaw=rng.normal()) for _ in range(6)]))
    fast = Trajectory(np.arange(51) / 10, np.array([pose(k / 5, 0, 0, yaw=k / 20) for k in range(51)]))
    buffer = TransformBuffer()
    for stamp, T in zip(slow.stamps, slow.poses, strict=True):
        buffer.add(StampedTransform("map", "odom", stamp, T))
    for k in rng.permutation(51):  # the order does not matter
        buffer.add(StampedTransform("odom", "base", fast.stamps[k], fast.poses[k]))
    buffer.add(StampedTransform("base", "lidar", 0.0, pose(1, 0, 1.8, pitch=0.05)), static=True)
    buffer.add(StampedTransform("base", "camera", 99.0, pose(1.5, 0, 1.2, roll=-np.pi / 2)), static=True)
    return buffer, slow, fast


def test_a_chain_is_the_product_of_what_was_interpolated():
    buffer, slow, fast = tree()
    for stamp in (0.0, 0.1, 2.345, 5.0):
        expected = slow.at(stamp) @ fast.at(stamp) @ pose(1, 0, 1.8, pitch=0.05)
        np.testing.assert_allclose(buffer.lookup("map", "lidar", stamp), expected, atol=1e-12)
        np.testing.assert_allclose(buffer.lookup("lidar", "map", stamp), inverse(expected), atol=1e-12)
    siblings = inverse(pose(1.5, 0, 1.2, roll=-np.pi / 2)) @ pose(1, 0, 1.8, pitch=0.05)
    np.testing.assert_allclose(buffer.lookup("camera", "lidar", 1e9), siblings, atol=1e-12)


def test_many_times_at_once_are_as_one_by_one():
    buffer, _, _ = tree()
    times = np.array([4.99, 0.0, 1.234, 1.234, 3.0])
    for target, source in (("map", "lidar"), ("lidar", "map")):
        many = buffer.lookup(target, source, times)
        single = [buffer.lookup(target, source, t) for t in times]
        np.testing.assert_allclose(many, single, atol=1e-12)
    assert buffer.lookup("map", "lidar", []).shape == (0, 4, 4)
    assert np.array_equal(buffer.lookup("odom", "odom", times), np.broadcast_to(np.eye(4), (5, 4, 4)))


@given(poses, poses, st.floats(0, 1))
def test_between_two_poses_it_is_slerp_and_a_straight_line(first, second, share):
    buffer = TransformBuffer()
    buffer.add(StampedTransform("a", "b", 1.7e9, first))
    buffer.add(StampedTransform("a", "b", 1.7e9 + 1, second))
    share = float(1.7e9 + share) - 1.7e9  # as the clock has it
    turn = Rotation.from_matrix(first[:3, :3].T @ second[:3, :3]).as_rotvec()
    expected = np.eye(4)
    expected[:3, :3] = first[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    expected[:3, 3] = (1 - share) * first[:3, 3] + share * second[:3, 3]
    result = buffer.lookup("a", "b", 1.7e9 + share)
    np.testing.assert_allclose(result[:3, 3], expected[:3, 3], atol=1e-9)
    if np.linalg.norm(turn) < 3.1:  # at a half turn, both ways are shortest
        np.testing.assert_allclose(result, expected, atol=1e-6)


@given(st.lists(poses, min_size=3, max_size=6), st.floats(0, 1))
def test_there_and_back_is_the_identity_and_chains_can_be_cut(placed, stamp):
    buffer = TransformBuffer()
    names = [f"f{k}" for k in range(len(placed))]
    for k, T in enumerate(placed[1:]):
        parent, child = (names[k], names[k + 1]) if k % 2 else (names[k + 1], names[k])
        buffer.add(StampedTransform(parent, child, 0.0, T), static=k % 3 == 0)
        buffer.add(StampedTransform(parent, child, 1.0, placed[0] @ T))
    whole = buffer.lookup(names[0], names[-1], stamp)
    np.testing.assert_allclose(whole @ buffer.lookup(names[-1], names[0], stamp), np.eye(4), atol=1e-9)
    cut = buffer.lookup(names[0], names[1], stamp) @ buffer.lookup(names[1], names[-1], stamp)
    np.testing.assert_allclose(whole, cut, atol=1e-9)


def test_errors_name_what_there_is():
    buffer, _, _ = tree()
    buffer.add(StampedTransform("gnss", "antenna", 0.0, np.eye(4)), static=True)
    with pytest.raises(
        UnknownFrameError, match=r"no frame 'velodyne'; known frames are map, odom, base, lidar, camera, gnss"
    ):
        buffer.lookup("map", "velodyne", 1.0)
    with pytest.raises(NotConnectedError, match=r"map and antenna are not connected: map is connected to base, camera"):
        buffer.lookup("map", "antenna", 1.0)
    with pytest.raises(
        ExtrapolationError, match=r"extrapolation by 0.3 s: requested at 5.300000 s, known from"
    ) as caught:
        buffer.lookup("odom", "lidar", 5.3)
    assert caught.value.seconds == pytest.approx(0.3)
    with pytest.raises(ExtrapolationError, match=r"from base to odom needs extrapolation by 0.1 s") as caught:
        buffer.lookup("lidar", "odom", [0.0, -0.1])
    assert caught.value.seconds == pytest.approx(-0.1)
    with pytest.raises(UnknownFrameError, match="none: no transform was added"):
        TransformBuffer().lookup("map", "base", 0.0)
    refused("finite", buffer.lookup, "map", "lidar", np.nan)
    assert issubclass(TransformError, OgmError)


def test_gaps_are_not_interpolated():
    buffer = TransformBuffer()
    for stamp in (0.0, 1.0, 9.0, 10.0):
        buffer.add(StampedTransform("map", "base", stamp, pose(stamp)))
    assert buffer.lookup("map", "base", 0.5)[0, 3] == pytest.approx(0.5)
    assert buffer.lookup("map", "base", [1.0, 9.0])[:, 0, 3].tolist() == [1.0, 9.0]
    with pytest.raises(ExtrapolationError, match=r"gap of 8 s, from 1.000000 to 9.000000 s, allowed are 2 s") as caught:
        buffer.lookup("map", "base", 4.0)
    assert caught.value.seconds == 0
    refused("gap of 8 s", buffer.lookup, "map", "base", [0.5, 4.0, 9.5], error=ExtrapolationError)
    wide = TransformBuffer(max_gap=8.0)
    for stamp in (1.0, 9.0):
        wide.add(StampedTransform("map", "base", stamp, pose(stamp)))
    assert wide.lookup("map", "base", 4.0)[0, 3] == pytest.approx(4.0)


def test_which_of_several_transforms_counts(caplog):
    buffer = TransformBuffer()
    for x in (1.0, 2.0):
        buffer.add(StampedTransform("map", "base", 5.0, pose(x)))
    assert buffer.lookup("map", "base", 5.0)[0, 3] == 1.0
    for x in (3.0, 4.0):
        buffer.add(StampedTransform("map", "base", 7.0, pose(x)), static=True)
    assert buffer.lookup("map", "base", 123.0)[0, 3] == 4.0
    assert buffer.pairs == {("map", "base"): True}
    buffer.add(StampedTransform("map", "odom", 0.0, pose(10)), static=True)
    assert not caplog.records
    buffer.add(StampedTransform("odom", "base", 0.0, pose(20)), static=True)
    assert "base has several parents, ['map', 'odom']" in caplog.text
    assert buffer.lookup("map", "base", 0.0)[0, 3] == 4.0  # the shorter chain


def test_covers():
    buffer, _, _ = tree()
    assert buffer.covers("map", "lidar") == (0.0, 5.0)
    assert buffer.covers("camera", "lidar") == (-np.inf, np.inf)
    assert buffer.covers("map", "map") == (-np.inf, np.inf)
    buffer.add(StampedTransform("map", "odom", 7.0, np.eye(4)))
    assert buffer.covers("odom", "map") == (0.0, 7.0)
    assert buffer.covers("map", "base") == (0.0, 5.0)


def test_a_live_buffer_forgets():
    buffer = TransformBuffer(keep=1.0)
    for k in range(100):
        buffer.add(StampedTransform("map", "base", k / 10, pose(k)))
    first, last = buffer.covers("map", "base")
    assert last == 9.9
    assert first == pytest.approx(8.9)


@each("wrong", [
        StampedTransform("", "b", 0.0, np.eye(4)), StampedTransform("a", "", 0.0, np.eye(4)),
        StampedTransform("a", "a", 0.0, np.eye(4)), StampedTransform("a", "b", np.nan, np.eye(4)),
        StampedTransform("a", "b", 0.0, 2 * np.eye(4)), StampedTransform("a", "b", 0.0, np.eye(3)),
    ])  # fmt: skip
def test_transforms_that_are_none_are_refused(wrong):
    buffer = TransformBuffer()
    refused("the transform from", buffer.add, wrong, error=OgmError)
    assert buffer.frames == ()


def test_results_are_copies():
    buffer, _, _ = tree()
    before = buffer.lookup("base", "lidar", 0.0)
    buffer.lookup("base", "lidar", 0.0)[:] = 0
    buffer.lookup("base", "base", 0.0)[:] = 0
    assert np.array_equal(buffer.lookup("base", "lidar", 0.0), before)
