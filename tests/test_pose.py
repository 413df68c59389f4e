"""Rigid transforms."""

import math

import numpy as np
from cases import refused
from hypothesis import given, settings
from hypothesis import strategies as st

from ogm import EvidentialGrid, GridSpec, Scan
from ogm.fusion import EvidentialMapper
from ogm.io import PlacedGrid
from ogm.pose import MAX_STAMP, Trajectory, check_pose, check_stamp, inverse, pose, transform_points

angles = st.floats(-1.5, 1.5)
lengths = st.floats(-100, 100)


@settings(deadline=None)
@given(lengths, lengths, lengths, angles, angles, angles)
def test_inverse_undoes(x: float, y: float, z: float, roll: float, pitch: float, yaw: float) -> None:
    T = pose(x, y, z, roll=roll, pitch=pitch, yaw=yaw)
    np.testing.assert_allclose(inverse(T) @ T, np.eye(4), atol=1e-9)


def test_yaw_turns_left_and_pitch_looks_down() -> None:
    forward = np.array([[1.0, 0.0, 0.0, 0.5]])
    np.testing.assert_allclose(transform_points(pose(yaw=math.pi / 2), forward), [[0, 1, 0, 0.5]], atol=1e-12)
    np.testing.assert_allclose(transform_points(pose(pitch=math.pi / 2), forward), [[0, 0, -1, 0.5]], atol=1e-12)


def test_transform_keeps_dtype_and_intensity() -> None:
    points = np.array([[1, 2, 3, 0.25]], np.float32)
    moved = transform_points(pose(1, 1, 1), points)
    assert moved.dtype == np.float32
    np.testing.assert_allclose(moved, [[2, 3, 4, 0.25]])


def test_what_is_not_rigid_is_refused() -> None:
    for bad, message in (
        (np.eye(3), "4x4"),
        (np.full((4, 4), np.nan), "NaN"),
        (np.diag([2.0, 2, 2, 1]), "rigid"),
        (np.diag([1.0, 1, 1 + 1e-4, 1]), "rigid"),
        (np.diag([-1.0, 1, 1, 1]), "mirror"),
        (np.diag([1.0, 1, 1, 2]), "last row"),
        (np.diag([1.0, 1, 1, 0.5]), "last row"),
        (np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1e-7, 1]]), "last row"),
        (np.diag([0.5, 0.5, 0.5, 1]), "rigid"),
        (np.diag([1e200, 1e200, 1e200, 1]), "rigid"),
        (np.diag([1.0, 1, np.nan, 1]), "NaN"),
        (np.diag([1.0, 1, np.inf, 1]), "must be finite"),
        *((np.eye(4).astype(kind), "must be a 4x4 array of real numbers") for kind in (complex, str, object, bool)),
    ):
        refused(message, check_pose, bad)
    assert check_pose(np.eye(4, dtype=int)).dtype == np.float64


def test_stamps_are_numbers_of_seconds() -> None:
    for stamp in (0, -3, 1.5e9, np.float32(2), np.int64(7), MAX_STAMP):
        assert type(check_stamp(stamp)) is float
        assert check_stamp(stamp) == stamp
    grid = EvidentialGrid.vacuous(GridSpec(0.5, (8, 6), (0.0, 0.0)))
    for stamp in ("5", b"5", True, np.True_, 1 + 0j, [5.0], np.array([5.0]), np.nan, np.inf, 1e18, -1e12, 10**400):
        refused("stamp must be", check_stamp, stamp)
        refused("stamp must be", Scan, np.zeros((1, 4), np.float32), stamp=stamp)
        refused("stamp must be", PlacedGrid, grid, stamp=stamp)
        refused("stamp must be", EvidentialMapper(grid.spec).update, grid, np.eye(4), stamp=stamp)


def test_a_pose_of_four_decimals_is_rigid() -> None:
    check_pose(pose(1, 2, 3, roll=0.1, pitch=0.2, yaw=0.3).round(4))


def test_poses_between_lie_on_the_straight_line_and_the_shortest_arc() -> None:
    poses = [pose(0, 0, 0, yaw=math.radians(170)), pose(2, 4, 6, yaw=math.radians(-170))]
    np.testing.assert_allclose(Trajectory([1.0, 2.0], poses).at(1.5), pose(1, 2, 3, yaw=math.pi), atol=1e-12)
    assert Trajectory([1.0, 2.0], poses).at([1.0, 1.2, 2.0]).shape == (3, 4, 4)


def test_transform_points_takes_rows_of_three_numbers_or_more() -> None:
    for wrong in (np.zeros((3, 2)), np.zeros(3), np.zeros((2, 3, 3))):
        refused("N, 3 or more", transform_points, np.eye(4), wrong)
    np.testing.assert_array_equal(transform_points(pose(1, 2, 3), np.zeros((2, 3))), [[1, 2, 3]] * 2)


def test_a_trajectory_returns_its_poses_and_those_between() -> None:
    trajectory = Trajectory([1, 2, 4], [pose(0), pose(2, yaw=1), pose(4, yaw=1)])
    assert len(trajectory) == 3
    np.testing.assert_allclose(trajectory.at(trajectory.stamps), trajectory.poses, atol=1e-12)
    np.testing.assert_allclose(trajectory.at(1.5), pose(1, yaw=0.5), atol=1e-12)
    assert trajectory.at([1.5, 3.0]).shape == (2, 4, 4)
    for stamp, one in zip(trajectory.stamps, trajectory.poses, strict=True):
        np.testing.assert_allclose(trajectory.at(stamp), one, atol=1e-12)
    assert trajectory.at([]).shape == (0, 4, 4)
    for outside in (4.1, 0.9, [0.9, 2.0], [2.0, 4.1], np.nan):
        refused("not extrapolated", trajectory.at, outside)


def test_a_trajectory_keeps_its_own_copy() -> None:
    stamps, poses = np.array([0.0, 1.0]), np.array([pose(0), pose(1)])
    trajectory = Trajectory(stamps, poses)
    stamps[0], poses[0] = -5, np.nan
    assert trajectory.stamps[0] == 0
    np.testing.assert_array_equal(trajectory.poses[0], np.eye(4))


def test_a_trajectory_of_one_pose_has_one_time() -> None:
    trajectory = Trajectory([3.0], [pose(1, 2)])
    np.testing.assert_array_equal(trajectory.at(3.0), pose(1, 2))
    np.testing.assert_array_equal(trajectory.at([3.0, 3.0]), [pose(1, 2)] * 2)
    refused("the one time", trajectory.at, [3.0, 3.1])


def test_what_is_no_trajectory_is_refused() -> None:
    for stamps, poses, message in (
        ([], np.zeros((0, 4, 4)), "at least 1"),
        ([0.0, 1.0], [np.eye(4)], "agree"),
        ([0.0, np.nan], [np.eye(4)] * 2, r"stamps\[1\] is not"),
        ([[0.0, 1.0]], [np.eye(4)], "agree"),
        ([0.0, 1.0], [np.eye(3)] * 2, "agree"),
        ([0.0, 1.0], [np.eye(4)[:3]] * 2, "agree"),
        ([0.0, 0.0], [np.eye(4)] * 2, "increase"),
        ([0.0, 1.0, 0.5, 2.0], [np.eye(4)] * 4, r"increase, but stamps\[1\]=1.0 is followed by 0.5"),
        ([0.0, 1.0], [np.eye(4), np.diag([2.0, 2, 2, 1])], r"poses\[1\] must be rigid"),
        ([0.0], [np.full((4, 4), np.nan)], "NaN"),
        ([1.3e18, 1.4e18], [np.eye(4)] * 2, "divide nanoseconds by 1e9"),
        *(([0.0], np.eye(4).astype(kind)[None], "poses must be real numbers") for kind in (complex, str, object, bool)),
    ):
        refused(message, Trajectory, stamps, poses)
