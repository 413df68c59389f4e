"""Planar odometry: poses refined by matching each planar scan with the previous scans.

Correlative scan matching (Olson, "Real-time correlative scan matching", ICRA 2009): poses around the odometry's pose
are scored by the likelihood of the echoes, in a field around the echoes of the last scans. The best pose is refined by
Gauss-Newton steps on the same field (Kohlbrecher et al., SSRR 2011).
"""

import math
from collections import deque
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from ogm.jit import kernel
from ogm.pose import inverse

SIDE = 0.05  # [m] side of a cell of the field
REACH = 20.0  # [m] from the sensor that the field covers
SIGMA = 0.05  # [m] deviation of echoes from previous echoes: range noise, errors of earlier poses, half a cell
SPACING, MAX_GAP = 0.05, 0.3  # [m] spacing of points on a surface; gap of echoes that one surface may bridge
MEMORY = 30  # scans in the field
SHIFT = 6  # [cells] greatest error of the odometry's position between two scans, along x and y
TURN, TURN_STEP = math.radians(8), math.radians(0.5)  # greatest error of the heading between two scans, search step
MIN_ECHOES = 20
MIN_SCORE = 0.2  # mean likelihood of the echoes below which the odometry is kept
_STAMP = 4  # [cells] radius of the field around an echo
_STEPS = 20  # Gauss-Newton steps


def match_scans(
    scans: Iterable[NDArray[np.float32]], odometry: Iterable[NDArray[np.float64]]
) -> Iterator[tuple[NDArray[np.float64], bool]]:
    """Yield the refined pose of each planar scan, and whether it was matched.

    The odometry's motion between scans is corrected by up to 0.3 m along each axis and 8 degrees. Position and heading
    in the plane are refined, height and tilt are kept. Loops are not closed.

    Parameters
    ----------
    scans : iterable of (N, 3 or more) float
        x, y, z of the echoes in the sensor's frame [m]. Non-finite rows are ignored.
    odometry : iterable of (4, 4) float64
        ``T_map_sensor`` of each scan, from odometry.

    Yields
    ------
    T_map_sensor : (4, 4) float64
        Refined pose; the first is the odometry's pose.
    matched : bool
        False if the motion of the odometry is kept: for the first scan, for scans with fewer than 20 echoes within
        20 m, and for scans that do not match the previous ones.
    """
    last: deque[NDArray[np.float64]] = deque(maxlen=MEMORY)
    cells = 2 * round(REACH / SIDE)
    field = np.zeros((cells, cells), np.float32)
    before, pose = np.eye(4), np.eye(4)
    for points, T in zip(scans, odometry, strict=True):
        guess = pose @ inverse(before) @ T if last else T
        offset = (points[:, :3].astype(np.float64) @ guess[:3, :3].T)[:, :2]  # from the sensor, along the map's axes
        offset = np.ascontiguousarray(offset[np.hypot(*offset.T) < REACH])  # false for NaN
        before, pose, matched = T, guess, False
        if last and len(offset) >= MIN_ECHOES:
            around = np.concatenate(last) - guess[:2, 3]
            fill_field(field, np.ascontiguousarray(around), SIDE, SIGMA)
            found = np.zeros(3)
            score = search_pose(field, offset, SIDE, SHIFT, (round(TURN / TURN_STEP), TURN_STEP), found)
            if score >= MIN_SCORE * len(offset):
                refine_pose(field, offset, SIDE, found)
                pose, matched = _moved(guess, found), True
        offset = offset @ _rotation(math.atan2(pose[1, 0], pose[0, 0]) - math.atan2(guess[1, 0], guess[0, 0])).T
        last.append(_surfaces(offset) + pose[:2, 3])
        yield pose, matched


def _surfaces(ends: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return echoes, and interpolated points between neighbours that may lie on one surface, (M, 2)."""
    step = np.diff(ends, axis=0)
    count = np.ceil(np.hypot(*step.T) / SPACING).astype(int)
    count[count > MAX_GAP / SPACING] = 1
    first = np.repeat(np.arange(len(step)), count)
    share = (np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count)) / count[first]
    between: NDArray[np.float64] = ends[first] + share[:, None] * step[first]
    return np.concatenate([between, ends[-1:]])


def _rotation(angle: float) -> NDArray[np.float64]:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


def _moved(T: NDArray[np.float64], change: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a pose shifted by x, y [m] and turned about its own position [rad]."""
    moved = T.copy()
    moved[:2, 3] += change[:2]
    moved[:2, :3] = _rotation(change[2]) @ T[:2, :3]
    return moved


@kernel
def fill_field(field: np.ndarray, points: np.ndarray, side: float, sigma: float) -> None:
    """Fill a field with the likelihood of echoes, relative to the likelihood at the nearest of the points.

    Parameters
    ----------
    field : (n, n) float32
        Square cells around the origin; filled with max exp(-d**2 / (2 sigma**2)), d from the middle of the cell.
    points : (N, 2) float64
        Echoes [m].
    side, sigma : float
        Side of a cell, and standard deviation of echoes [m].
    """
    field[:] = 0
    size, width = field.shape[0], 2 * _STAMP + 1
    along_x, along_y = np.empty(width), np.empty(width)
    for n in range(len(points)):
        u, v = points[n, 0] / side + size // 2, points[n, 1] / side + size // 2
        i, j = int(math.floor(u)), int(math.floor(v))
        if i < _STAMP or j < _STAMP or i >= size - _STAMP or j >= size - _STAMP:
            continue
        for k in range(width):
            dx, dy = (i + k - _STAMP + 0.5 - u) * side, (j + k - _STAMP + 0.5 - v) * side
            along_x[k], along_y[k] = math.exp(-0.5 * (dx / sigma) ** 2), math.exp(-0.5 * (dy / sigma) ** 2)
        for a in range(width):
            for b in range(width):
                value = np.float32(along_x[a] * along_y[b])
                if value > field[i + a - _STAMP, j + b - _STAMP]:
                    field[i + a - _STAMP, j + b - _STAMP] = value


@kernel
def search_pose(
    field: np.ndarray, offset: np.ndarray, side: float, shift: int, turns: tuple[int, float], found: np.ndarray
) -> float:
    """Score all shifts by whole cells and all turns; return the greatest sum of likelihoods.

    Parameters
    ----------
    field : (n, n) float32
    offset : (N, 2) float64
        Echoes from the sensor, along the axes of the field [m].
    side : float
        Side of a cell [m].
    shift : int
        Greatest shift along each axis [cells].
    turns : (int, float)
        Number of turns to each side, and the step [rad].
    found : (3,) float64
        Set to the best shift x, y [m] and turn [rad].
    """
    size, width, best = field.shape[0], 2 * shift + 1, -1.0
    sums = np.empty((width, width), np.float32)
    for turn in range(-turns[0], turns[0] + 1):
        c, s = math.cos(turn * turns[1]), math.sin(turn * turns[1])
        sums[:] = 0
        for n in range(len(offset)):
            i = int(math.floor((c * offset[n, 0] - s * offset[n, 1]) / side)) + size // 2 - shift
            j = int(math.floor((s * offset[n, 0] + c * offset[n, 1]) / side)) + size // 2 - shift
            if i < 0 or j < 0 or i + width > size or j + width > size:
                continue
            for a in range(width):
                for b in range(width):
                    sums[a, b] += field[i + a, j + b]
        for a in range(width):
            for b in range(width):
                if sums[a, b] > best:
                    best = float(sums[a, b])
                    found[0], found[1], found[2] = (a - shift) * side, (b - shift) * side, turn * turns[1]
    return best


@kernel
def refine_pose(field: np.ndarray, offset: np.ndarray, side: float, found: np.ndarray) -> None:
    """Refine a pose by Gauss-Newton steps that raise the likelihood of the echoes to 1.

    Parameters
    ----------
    field, offset, side
        See `search_pose`.
    found : (3,) float64
        Shift x, y [m] and turn [rad], changed in place.
    """
    half = field.shape[0] // 2
    for _ in range(_STEPS):
        c, s = math.cos(found[2]), math.sin(found[2])
        hessian, slope = np.eye(3), np.zeros(3)
        jacobian = np.empty(3)
        for n in range(len(offset)):
            x, y = c * offset[n, 0] - s * offset[n, 1], s * offset[n, 0] + c * offset[n, 1]
            u, v = (found[0] + x) / side + half - 0.5, (found[1] + y) / side + half - 0.5
            i, j = int(math.floor(u)), int(math.floor(v))
            if i < 0 or j < 0 or i + 1 >= len(field) or j + 1 >= len(field):
                continue
            p, q = u - i, v - j
            a, b, d, e = field[i, j], field[i + 1, j], field[i, j + 1], field[i + 1, j + 1]
            likelihood = (a * (1 - p) + b * p) * (1 - q) + (d * (1 - p) + e * p) * q
            jacobian[0] = ((b - a) * (1 - q) + (e - d) * q) / side
            jacobian[1] = ((d - a) * (1 - p) + (e - b) * p) / side
            jacobian[2] = -jacobian[0] * y + jacobian[1] * x
            for k in range(3):
                slope[k] += jacobian[k] * (1 - likelihood)
                for m in range(3):
                    hessian[k, m] += jacobian[k] * jacobian[m]
        step = np.linalg.solve(hessian, slope)
        step *= min(1.0, side / max(abs(step[0]), abs(step[1]), 1e-12))
        found += step
        if abs(step[0]) + abs(step[1]) < 1e-4 and abs(step[2]) < 1e-5:
            break
