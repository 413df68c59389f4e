"""De-skewing: static points become static again."""

import numpy as np
import pytest
from cases import each, refused

from ogm.fusion import deskew
from ogm.fusion.ego.deskewing import extrapolate
from ogm.pose import Trajectory, inverse, pose, transform_points

STAMP = 735.25


def drive(count: int = 8, start: float = STAMP - 0.2) -> Trajectory:
    """Give poses at uneven times, with all six degrees of freedom, far from the map's origin."""
    t = np.cumsum([0.0, 0.1, 0.05, 0.12, 0.1, 0.08, 0.1, 0.1])[:count]
    poses = [pose(4e5 + 15 * s, 5e6 + 8 * s * s, 0.3 * s, roll=0.2 * s, pitch=-0.3 * s, yaw=2.5 * s) for s in t]
    return Trajectory(start + t, poses)


def cloud(count: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Give points with intensities, and when they were measured, in no order."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-80, 80, (count, 2)), rng.uniform(-2, 5, count), rng.random(count)])
    return points.astype(np.float32), rng.uniform(-0.15, 0.4, count)


def slow(points: np.ndarray, time: np.ndarray, trajectory: Trajectory, stamp: float) -> np.ndarray:
    """Move every point by itself: the slow reference."""
    result = points.astype(np.float64)
    for n, (point, t) in enumerate(zip(points, time, strict=True)):
        T = inverse(trajectory.at(stamp)) @ trajectory.at(stamp + t)
        result[n] = transform_points(T, point[None].astype(np.float64))[0]
    return result


def test_the_kernel_agrees_with_the_pose_of_every_point() -> None:
    points, time = cloud(300)
    moved = deskew(points, time, drive(), STAMP)
    assert moved.dtype == np.float32
    np.testing.assert_allclose(moved, slow(points, time, drive(), STAMP), atol=1e-5)


def test_a_clock_that_counts_from_1970_costs_no_more_than_its_rounding() -> None:
    points, time = cloud(300)
    year, trajectory = 1317617000.0, drive()
    late = Trajectory(trajectory.stamps + year, trajectory.poses)
    moved = deskew(points, time, late, STAMP + year)
    # float64 knows such stamps to 0.24 us, in which these points move by 0.05 mm
    np.testing.assert_allclose(moved, deskew(points, time, trajectory, STAMP), atol=1e-4)


def test_a_wall_seen_in_a_turn_is_straight_again() -> None:
    # A sensor at 10 m/s that turns at 0.5 rad/s; sees the wall x = 20 of the map once per 1.8 degrees of its turn.
    t = np.linspace(-0.05, 0.05, 201)
    circle = Trajectory(
        np.linspace(-0.06, 0.06, 25),
        [pose(20 * np.sin(0.5 * s), 20 * (1 - np.cos(0.5 * s)), yaw=0.5 * s) for s in np.linspace(-0.06, 0.06, 25)],
    )
    wall = np.column_stack([np.full(201, 20.0), np.linspace(-15, 15, 201), np.zeros(201)])
    measured = np.array([transform_points(inverse(circle.at(s)), p[None])[0] for s, p in zip(t, wall, strict=True)])
    assert np.ptp(measured[:, 0]) > 1.0
    straight = deskew(measured.astype(np.float32), t, circle, 0.0)
    np.testing.assert_allclose(straight, wall, atol=1e-4)


def test_where_the_map_has_its_origin_does_not_matter() -> None:
    points, time = cloud(200)
    elsewhere = Trajectory(drive().stamps, pose(-4e5, -5e6, 7, yaw=2) @ drive().poses)
    np.testing.assert_allclose(deskew(points, time, elsewhere, STAMP), deskew(points, time, drive(), STAMP), atol=1e-5)


def test_moving_the_stamp_moves_the_cloud_as_one() -> None:
    points, time = cloud(200)
    later = deskew(points, time - 0.1, drive(), STAMP + 0.1)
    T = inverse(drive().at(STAMP)) @ drive().at(STAMP + 0.1)
    np.testing.assert_allclose(transform_points(T, later), deskew(points, time, drive(), STAMP), atol=2e-5)


def test_intensities_and_order_and_the_input_are_kept() -> None:
    points, time = cloud(100)
    before = points.copy()
    moved = deskew(points, time, drive(), STAMP)
    np.testing.assert_array_equal(moved[:, 3], points[:, 3])
    np.testing.assert_array_equal(points, before)
    order = np.argsort(time)
    np.testing.assert_allclose(deskew(points[order], time[order], drive(), STAMP), moved[order], atol=1e-5)


def test_missing_points_stay_missing_and_no_points_are_fine() -> None:
    points, time = cloud(3)
    points[1, 0] = np.nan
    moved = deskew(points, time, drive(), STAMP)
    assert np.isnan(moved[1, :3]).any()
    assert np.isfinite(moved[[0, 2]]).all()
    assert deskew(np.zeros((0, 4)), np.zeros(0), drive(), STAMP).shape == (0, 4)


def test_the_ends_of_the_trajectory_are_inside() -> None:
    trajectory = drive()
    time = trajectory.stamps[[0, -1]] - STAMP
    points, _ = cloud(2)
    np.testing.assert_allclose(
        deskew(points, time, trajectory, STAMP), slow(points, time, trajectory, STAMP), atol=1e-5
    )
    # A stamp on the last pose: all points were measured before; on the first: all after, or just then.
    for stamp, time in ((-1, [-0.05, 0.0]), (0, [0.05, 0.0]), (-1, [0.0, 0.0]), (0, [0.0, 0.0]), (3, [0.0, 0.0])):
        at = float(trajectory.stamps[stamp])
        np.testing.assert_allclose(
            deskew(points, np.array(time), trajectory, at), slow(points, np.array(time), trajectory, at), atol=1e-5
        )
    # Rounded stamps may lie a hair outside.
    first = float(trajectory.stamps[0])
    np.testing.assert_allclose(deskew(points, np.zeros(2), trajectory, first - 5e-7), points, atol=1e-4)


def test_times_outside_the_trajectory_and_other_shapes_are_refused() -> None:
    points = np.zeros((2, 4), np.float32)
    for time, stamp, message in (
        ([0.0, 0.6], STAMP, "extrapolate"),
        ([-0.25, 0.0], STAMP, "extrapolate"),
        ([0.0, 0.0], STAMP + 10, "extrapolate"),
        ([0.0, np.nan], STAMP, r"time\[1\] is not"),
        ([0.0], STAMP, "one per point"),
        ([0.0, 0.0], np.nan, "covers"),
    ):
        refused(message, deskew, points, time, drive(), stamp)
    refused("N, 3 or more", deskew, np.zeros((4, 2)), np.zeros(4), drive(), STAMP)


def test_one_pose_serves_one_time() -> None:
    points, _ = cloud(4)
    one = Trajectory([STAMP], [pose(1, 2, 3, yaw=1)])
    np.testing.assert_array_equal(deskew(points, np.zeros(4), one, STAMP), points)
    refused("trajectory", deskew, points, np.full(4, 0.01), one, STAMP)


def on_circle(stamps: np.ndarray) -> Trajectory:
    """Give a drive on a circle of 20 m at 10 m/s, climbing and tilted."""
    start = pose(5, -3, 2, roll=0.1, pitch=-0.2, yaw=0.7)
    turns = [pose(20 * np.sin(0.5 * s), 20 * (1 - np.cos(0.5 * s)), 0.4 * s, yaw=0.5 * s) for s in stamps]
    return Trajectory(stamps, start @ np.array(turns))


@each("seconds", [0.03, 0.1, 0.25])
def test_a_trajectory_goes_on_along_its_circle(seconds: float) -> None:
    longer = extrapolate(on_circle(np.linspace(0, 1, 11)), seconds)
    assert longer.stamps[0] == pytest.approx(-seconds)
    assert longer.stamps[-1] == pytest.approx(1 + seconds)
    assert np.diff(longer.stamps).max() < 0.1 + 1e-9
    np.testing.assert_allclose(longer.poses, on_circle(longer.stamps).poses, atol=1e-9)


def test_a_trajectory_goes_on_straight_and_keeps_what_it_knew() -> None:
    known = Trajectory([0.0, 0.1], [pose(), pose(1, 0.5)])
    longer = extrapolate(known, 0.05)
    np.testing.assert_allclose(longer.poses[[0, -1], :3, 3], [[-0.5, -0.25, 0], [1.5, 0.75, 0]], atol=1e-12)
    np.testing.assert_array_equal(longer.poses[1:-1], known.poses)
    np.testing.assert_array_equal(extrapolate(known, 0.0).stamps, known.stamps)


def test_what_cannot_be_extended_is_refused() -> None:
    for count, seconds, message in ((1, 0.1, "two poses"), (3, -1, "0 or more"), (3, np.inf, "0")):
        refused(message, extrapolate, drive(count), seconds)


def test_nearly_equal_stamps_do_not_extend_a_trajectory_without_end() -> None:
    close = Trajectory(np.array([0.0, 1e-9]), np.array([pose(), pose(1e-9)]))
    longer = extrapolate(close, 0.1)
    assert len(longer) <= 202
    assert longer.stamps[-1] == pytest.approx(0.1, abs=1e-6)
    assert longer.poses[-1][0, 3] == pytest.approx(0.1, rel=1e-3)
