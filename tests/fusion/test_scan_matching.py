"""Scan matching in the plane: laws in a made building."""

import math

import numpy as np
from cases import refused
from numpy.typing import NDArray

from ogm.fusion import match_scans
from ogm.pose import inverse, pose

WALLS = np.array(  # from, to: a hall with two pillars and an alcove [m]
    [
        [[0, 0], [12, 0]], [[12, 0], [12, 8]], [[12, 8], [7, 8]], [[7, 8], [7, 9.5]], [[7, 9.5], [4, 9.5]],
        [[4, 9.5], [4, 8]], [[4, 8], [0, 8]], [[0, 8], [0, 0]],
        *([[x, y], [x + a, y + b]] for x, y in ((3, 3), (8.5, 4.5)) for a, b in ((0.6, 0), (0, 0.6))),
    ]
)  # fmt: skip
AZIMUTH = np.radians(np.arange(-90, 90.5, 1.5))


def cast(T: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float32]:
    """Return the echoes of a planar laser at a pose, (N, 3), with range noise of 10 mm."""
    yaw = math.atan2(T[1, 0], T[0, 0])
    d = np.stack([np.cos(AZIMUTH + yaw), np.sin(AZIMUTH + yaw)], axis=1)[:, None]
    start, along = WALLS[:, 0] - T[:2, 3], WALLS[:, 1] - WALLS[:, 0]
    cross = d[..., 0] * along[:, 1] - d[..., 1] * along[:, 0]
    reach = (start[:, 0] * along[:, 1] - start[:, 1] * along[:, 0]) / cross
    at = (start[:, 0] * d[..., 1] - start[:, 1] * d[..., 0]) / cross
    reach = np.where((reach > 0) & (at >= 0) & (at <= 1), reach, np.inf).min(axis=1)
    reach += rng.normal(0, 0.01, len(reach))
    return np.stack([reach * np.cos(AZIMUTH), reach * np.sin(AZIMUTH), 0 * reach], axis=1).astype(np.float32)


def drive(count: int) -> NDArray[np.float64]:
    """Return poses on an ellipse around the pillars, (K, 4, 4), in a tilted map frame's height of 0.3 m."""
    a = np.linspace(0, 1.8 * np.pi, count)
    heading = np.arctan2(2.2 * np.cos(a), -4.2 * np.sin(a))
    return np.array(
        [pose(6 + 4.2 * np.cos(t), 4 + 2.2 * np.sin(t), 0.3, yaw=h) for t, h in zip(a, heading, strict=True)]
    )


def noisy(poses: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the poses of an odometry whose noise is 5 % of the distance and 2 degrees per metre."""
    found = [poses[0]]
    for before, after in zip(poses[:-1], poses[1:], strict=True):
        step = inverse(before) @ after
        d = math.hypot(step[0, 3], step[1, 3])
        x, y, yaw = rng.normal(0, (0.05 * d, 0.05 * d, math.radians(2) * d))
        found.append(found[-1] @ step @ pose(x, y, yaw=yaw))
    return np.array(found)


def error(found: NDArray[np.float64], true: NDArray[np.float64]) -> float:
    """Return the mean distance from the true positions [m]."""
    return float(np.hypot(*(found[:, :2, 3] - true[:, :2, 3]).T).mean())


def test_matching_leaves_a_fifth_of_the_drift_of_odometry() -> None:
    true = drive(60)
    for seed in range(3):
        rng = np.random.default_rng(seed)
        odometry, scans = noisy(true, rng), [cast(T, rng) for T in true]
        found, matched = zip(*match_scans(scans, odometry), strict=True)
        assert matched == (False, *[True] * 59)
        assert error(np.array(found), true) < min(0.2 * error(odometry, true), 0.05)
        np.testing.assert_allclose(np.array(found)[:, 2, 3], 0.3)


def test_a_known_shift_is_found_to_a_centimetre() -> None:
    rng, T = np.random.default_rng(0), pose(6, 2, yaw=0.4)
    moved = pose(0.21, -0.13, yaw=math.radians(5)) @ T  # about the origin of the map
    (_, first), (found, matched) = match_scans([cast(T, rng), cast(moved, rng)], [T, T @ pose(0.05, 0.1)])
    assert (first, matched) == (False, True)
    assert np.hypot(*(found - moved)[:2, 3]) < 0.02
    assert abs(math.atan2(*(inverse(moved) @ found)[[1, 0], 0])) < math.radians(0.3)


def test_odometry_is_kept_where_scans_do_not_tell() -> None:
    rng, poses = np.random.default_rng(1), drive(30)[:4]
    scans = [cast(T, rng) for T in poses]
    scans[1] = np.full((40, 3), np.nan, np.float32)
    scans[2] = scans[2][:10]
    scans[3] = scans[3] * np.float32(2.5)  # of another place
    found, matched = zip(*match_scans(scans, poses), strict=True)
    assert matched == (False,) * 4
    np.testing.assert_allclose(np.array(found), poses, atol=1e-12)
    refused("shorter", list, match_scans(scans, poses[:2]))
