"""Odometry: scans without poses get those that they were taken from."""

import functools
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from cases import refused

from ogm.fusion import odometry
from ogm.fusion.ego.registration import METHODS
from ogm.io import read_points, read_poses
from ogm.pose import Trajectory, inverse, pose, transform_points

methods = pytest.mark.parametrize("method", METHODS)


@pytest.fixture(autouse=True)
def _packages(request: pytest.FixtureRequest) -> None:
    method = getattr(request.node, "callspec", None) and request.node.callspec.params.get("method")
    if method in METHODS:
        pytest.importorskip(method.replace("-", "_"), reason=f"no {method}: pip install ogm-toolkit[track]")


@functools.cache
def town() -> np.ndarray:
    """Give the points of a street with buildings and posts, in the map."""
    rng = np.random.default_rng(5)
    ground = np.column_stack([rng.uniform(-60, 60, (12000, 2)), np.full(12000, -1.8)])
    parts = [ground]
    for x in range(-60, 60, 12):
        for side in (-1, 1):
            y = side * rng.uniform(8, 14)
            wall = np.column_stack([rng.uniform(x, x + 8, 900), np.full(900, y), rng.uniform(-1.8, 5, 900)])
            flank = np.column_stack(
                [np.full(500, x + 8.0), side * rng.uniform(abs(y), 25, 500), rng.uniform(-1.8, 5, 500)]
            )
            parts += [wall, flank]
    return np.concatenate(parts)


def circle(stamps: np.ndarray) -> Trajectory:
    """Give a drive at 8 m/s that turns left at 0.3 rad/s and begins at the map's origin."""
    return Trajectory(
        stamps,
        np.array([pose(8 / 0.3 * np.sin(0.3 * t), 8 / 0.3 * (1 - np.cos(0.3 * t)), yaw=0.3 * t) for t in stamps]),
    )


def scan(T: np.ndarray, seed: int) -> np.ndarray:
    """Give what a sensor sees from one pose: points of the town with 1 cm of noise, not always the same."""
    rng = np.random.default_rng(seed)
    seen = transform_points(inverse(T), town()[rng.random(len(town())) < 0.7])
    return (seen + rng.normal(0, 0.01, seen.shape)).astype(np.float32)


def departure(T: np.ndarray, U: np.ndarray) -> tuple[float, float]:
    """Return how far [m] and how much [degree] two poses lie apart."""
    D = inverse(T) @ U
    return float(np.linalg.norm(D[:3, 3])), float(np.degrees(np.arccos(np.clip((np.trace(D[:3, :3]) - 1) / 2, -1, 1))))


STAMPS = 100 + 0.1 * np.arange(6)


def drive() -> tuple[list[np.ndarray], Trajectory]:
    truth = Trajectory(STAMPS, circle(STAMPS - STAMPS[0]).poses)
    return [scan(T, k) for k, T in enumerate(truth.poses)], truth


@methods
def test_a_drive_through_a_street_is_found(method: str) -> None:
    scans, truth = drive()
    found = odometry(iter(scans), STAMPS, method)
    np.testing.assert_array_equal(found.stamps, STAMPS)
    np.testing.assert_allclose(found.poses[0], np.eye(4), atol=1e-12)
    away, turned = departure(truth.poses[-1], found.poses[-1])
    assert away < 0.05
    assert turned < 0.3


@methods
def test_a_missing_scan_is_bridged(method: str) -> None:
    scans, truth = drive()
    kept = [0, 1, 2, 4, 5]
    found = odometry([scans[k] for k in kept], STAMPS[kept], method)
    assert departure(truth.poses[-1], found.poses[-1])[0] < 0.05


@pytest.mark.slow
@methods
def test_motion_distorted_scans_are_deskewed_by_their_times(method: str) -> None:
    distorted, times = [], []
    for k, t in enumerate(STAMPS - STAMPS[0]):
        straight = scan(circle(np.array([t])).poses[0], k).astype(np.float64)
        # a turn of the lidar in twelve pieces
        piece = np.arctan2(straight[:, 1], straight[:, 0])
        time = np.floor((piece + np.pi) / (2 * np.pi) * 12).clip(0, 11) / 12 * 0.1 - 0.05
        world = transform_points(circle(np.array([t])).poses[0], straight)
        for moment in np.unique(time):
            world[time == moment] = transform_points(
                inverse(circle(np.array([t + moment])).poses[0]), world[time == moment]
            )
        distorted.append(world.astype(np.float32))
        times.append(time)
    truth = circle(STAMPS - STAMPS[0])
    with_times = odometry(distorted, STAMPS, method, times)
    without = odometry(distorted, STAMPS, method, [None] * len(distorted))
    end = [departure(truth.poses[-1], found.poses[-1])[0] for found in (with_times, without)]
    assert end[0] < 0.08, end
    assert end[0] < end[1]


@methods
def test_the_ego_vehicle_and_missing_points_do_not_bias_the_poses(method: str) -> None:
    scans, truth = drive()
    rng = np.random.default_rng(8)
    roof = rng.uniform([-2, -0.9, -0.5], [2, 0.9, -0.3], (4000, 3)).astype(np.float32)
    roof = roof[np.linalg.norm(roof, axis=1) < 2.4]
    scans = [np.concatenate([one, roof, np.full((50, 3), np.nan, np.float32)]) for one in scans[:4]]
    assert departure(truth.poses[3], odometry(scans, STAMPS[:4], method).poses[3])[0] < 0.05


@methods
def test_scans_that_cannot_be_registered_are_refused(method: str) -> None:
    far = np.ones((500, 3)) * 10
    for scans, stamps, message in (
        ([], [], "no scan"),
        ([np.zeros((0, 4))], [0.0], "scan 0 has 0 points"),
        ([np.ones((5, 4)) * 10], [0.0], "scan 0 has 5 points .* leave it out"),
        ([np.full((500, 4), np.nan)], [0.0], "scan 0 has 0 points"),
        ([np.ones((500, 2))], [0.0], "N, 3 or more"),
        ([far] * 2, [0.0, 0.0], "stamps must increase"),
        ([far] * 2, [0.0], "stamps ended after 1"),
        ([far], [0.0, 1.0], "scans ended after 1"),
    ):
        refused(message, odometry, scans, stamps, method)


def test_impossible_settings_are_refused_before_the_first_scan() -> None:
    def never() -> Iterator[np.ndarray]:
        pytest.fail("a scan was taken")
        yield

    refused("kiss-icp or small-gicp", odometry, never(), [0.0], "icp")
    refused("below range_max", odometry, never(), [0.0], range_min=100)


@pytest.mark.parametrize("name", METHODS)
def test_a_missing_package_is_named_with_its_install_command(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("kiss_icp.config.parser", "small_gicp"):
        monkeypatch.setitem(sys.modules, module, None)
    refused("pip install .*\\[track\\]", odometry, [], [], name, error=ImportError)


@methods
def test_real_scans_move_as_they_were_registered_elsewhere(real: Callable[[str], Path], method: str) -> None:
    folder = real("kitti_odometry_00")
    known = read_poses(folder / "derived" / "poses_lidar_gicp.txt")
    truth = inverse(known.poses[0]) @ known.poses
    scans = (read_points(path) for path in sorted(folder.glob("0*.bin*")))
    found = odometry(scans, known.trajectory(rate=10).stamps, method)
    for k in range(len(found) - 1):
        step = inverse(found.poses[k]) @ found.poses[k + 1]
        away, turned = departure(inverse(truth[k]) @ truth[k + 1], step)
        assert away < 0.06
        assert turned < 0.15
    assert departure(truth[-1], found.poses[-1])[0] < 0.05
