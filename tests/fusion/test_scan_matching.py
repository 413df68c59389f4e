"""Scan matching in the plane: laws in a made building."""

import math

import numpy as np
import pytest
from cases import refused
from hall import cast, drive, noisy
from numpy.typing import NDArray

from ogm.fusion import match_scans
from ogm.pose import inverse, pose


def error(found: NDArray[np.float64], true: NDArray[np.float64]) -> float:
    """Return the mean distance from the true positions [m]."""
    return float(np.hypot(*(found[:, :2, 3] - true[:, :2, 3]).T).mean())


@pytest.mark.slow
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
