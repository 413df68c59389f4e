"""Ground plane of a scan, and height of the sensor above it."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.io.scan_table import rotation_to_flu
from ogm.pose import levelling, rotate
from ogm.storage.files import OgmError

PLAUSIBLE_HEIGHTS = (0.5, 5.0)  # [m] of a sensor above ground: from a small robot to a truck or a mast
MAX_INCLINE = 0.15  # [rad] of the ground in the sensor's axes; beyond, the axes are not level
LEVEL = math.radians(2)  # tilt that no pose needs to undo
LEVEL_MARGIN = math.radians(1)  # least gain in level by dropping the tilt of the poses
SIDES = {"+x,-y,-z": "above", "+x,-z,+y": "right of", "+x,+z,-y": "left of", "-z,+y,+x": "behind", "+z,+y,-x": "before"}
"""Axes that point forward, left and up, by the side of the sensor on which the ground would lie instead of below."""

_REACHES = ((10.0, 30), (20.0, 60), (40.0, 60))  # [m], and least number of squares that must agree
_STEEPEST = math.radians(50)
_TRIALS = 200  # planes through three squares each
_BELOW, _DESCENT = 0.5, 0.05  # [m], and per metre of distance: lower ground farther out rejects a plane


class GroundPlane(NamedTuple):
    """Ground plane in the frame of some points.

    Attributes
    ----------
    height : float
        Distance from the plane to the origin along z [m], positive for a plane below the origin.
    normal : (3,) float64
        Unit vector, upwards.
    reach : float
        Radius of the points used for the fit [m].
    """

    height: float
    normal: NDArray[np.float64]
    reach: float

    @property
    def distance(self) -> float:
        """Perpendicular distance from the plane to the origin [m]."""
        return self.height * float(self.normal[2])

    @property
    def levelling(self) -> NDArray[np.float64]:
        """Rotation of the points to axes with z perpendicular to the plane, (3, 3)."""
        T = np.eye(4)
        T[2, :3] = self.normal
        return levelling(T)

    @property
    def incline(self) -> float:
        """Angle between the plane and the xy plane [rad]."""
        return math.acos(min(float(self.normal[2]), 1.0))


def plausible_sensor_height(height: float, where: object = "the scan", side: float = 1.0) -> float:
    """Return an estimated sensor height if it is plausible: 0.5 m to 5 m above ground.

    The origin of clouds in the vehicle frame lies near the ground (about 0.3 m above it in Argoverse 2). A model
    that mistakes it for the sensor's height starts its rays at the wrong point.

    Parameters
    ----------
    height : float
        From `estimate_sensor_height` [m].
    where : path or str
        Name of the scans, for the error.
    side : float
        See `ground_plane`; scales the lowest plausible height.

    Raises
    ------
    OgmError
        If the height lies outside of `PLAUSIBLE_HEIGHTS`.
    """
    low, high = PLAUSIBLE_HEIGHTS[0] * side, PLAUSIBLE_HEIGHTS[1]
    if not low <= height <= high:
        raise OgmError(
            f"the sensor height of {where}, estimated from points, is {height:.2f} m, which is not plausible "
            f"({low:g} to {high:g} m): for points in the vehicle frame give `sensor_position`, else give "
            "`sensor_height` and check `axes`"
        )
    return height


def estimate_sensor_height(points: NDArray[np.floating], side: float = 1.0) -> float | None:
    """Estimate the height of the points' origin above the ground.

    See `ground_plane`. On the project's real test scans, the result lies within 5 cm of the known height. It is a hint,
    not a calibration.

    Parameters
    ----------
    points : (N, 4) float
        x, y, z [m], intensity.
    side : float
        See `ground_plane`.

    Returns
    -------
    height : float or None
        [m], positive for ground below the origin. None without a plane, or if it is inclined by more than
        `MAX_INCLINE`: then the axes of the points are not level.
    """
    plane = ground_plane(points, side)
    return None if plane is None or plane.incline > MAX_INCLINE else plane.height


def ground_plane(points: NDArray[np.floating], side: float = 1.0) -> GroundPlane | None:
    """Return the ground plane around a sensor, up to an incline of 50 degrees.

    The plane is fitted to the lowest point of every square metre within 10 m. With too few squares, or lower ground
    farther out, the radius becomes 20 m, then 40 m.

    Parameters
    ----------
    points : (N, 3 or more) float
        x, y, z [m].
    side : float
        Side of the squares [m], which scales all lengths here: 0.25 is for level ground within 2.5 m of a depth
        camera.

    Returns
    -------
    GroundPlane or None
        None if fewer than 30 squares (60 beyond 10 m), or less than half of them, agree on a plane.
    """
    if side != 1:
        plane = ground_plane(points[:, :3] / side)
        return plane and plane._replace(height=plane.height * side, reach=plane.reach * side)
    distance = np.hypot(points[:, 0], points[:, 1])
    for reach, fewest in _REACHES:
        lowest = _lowest(points[distance < reach])
        fit = _fit(lowest, fewest)
        if fit is None:
            continue
        around = _lowest(points[(distance >= reach) & (distance < 2 * reach)])
        depth = around[:, :2] @ fit[:2] + fit[2] - around[:, 2]
        deep = depth > _BELOW + (_DESCENT + math.hypot(*fit[:2])) * np.hypot(around[:, 0], around[:, 1])
        if len(around) >= fewest and np.count_nonzero(deep) > len(around) / 2:
            continue  # a roof, a table or a hedge
        normal = np.array([-fit[0], -fit[1], 1.0]) / math.sqrt(fit[0] ** 2 + fit[1] ** 2 + 1)
        if reach == _REACHES[0][0] or math.acos(normal[2]) < MAX_INCLINE:
            return GroundPlane(float(-fit[2]), normal, reach)
    return None


def levelling_gain(points: NDArray[np.floating], R: NDArray[np.float64]) -> float:
    """Return the reduction of the ground's incline by a rotation [rad], below 0 for an increase.

    Parameters
    ----------
    points : (N, 3 or more) float
        x, y, z [m].
    R : (3, 3) float64
        Rotation of the points. Without a plane, before or after it, the incline counts as pi.
    """
    turned = rotate(R, points[:, :3].T).T
    before, after = (math.pi if (plane := ground_plane(xyz)) is None else plane.incline for xyz in (points, turned))
    return before - after


def ground_side(points: NDArray[np.floating]) -> str | None:
    """Return the axes in `SIDES` by which level ground lies below the sensor; None if there are none."""
    for axes in SIDES:
        height = estimate_sensor_height(points[:, :3] @ rotation_to_flu(axes.split(",")).T)
        if height is not None and PLAUSIBLE_HEIGHTS[0] <= height <= PLAUSIBLE_HEIGHTS[1]:
            return axes
    return None


def _lowest(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the lowest point of every square metre with points, (K, 3)."""
    near = points[:, :3].astype(np.float64)
    column = np.floor(near[:, :2]).astype(np.int64) @ np.array([1000, 1])
    order = np.lexsort((near[:, 2], column))
    lowest: NDArray[np.float64] = near[order][np.unique(column[order], return_index=True)[1]]
    return lowest


def _fit(lowest: NDArray[np.float64], fewest: int) -> NDArray[np.float64] | None:
    """Return a, b, c of the plane z = a x + b y + c that most squares agree on; None if too few agree."""
    fewest = max(fewest, math.ceil(len(lowest) / 2))
    if len(lowest) < fewest:
        return None
    # Begin with the most common height, in steps of 0.1 m.
    layer = np.floor(lowest[:, 2] / 0.1).astype(np.int64)
    count = np.bincount(layer - layer.min())
    level = np.array([0.0, 0.0, (layer.min() + np.argmax(np.convolve(count, [1, 1, 1], "same")) + 0.5) * 0.1])
    fit = _refined(level, lowest, fewest)
    return fit if fit is not None else _refined(_commonest_plane(lowest), lowest, fewest)


def _refined(plane: NDArray[np.float64], lowest: NDArray[np.float64], fewest: int) -> NDArray[np.float64] | None:
    """Fit a plane repeatedly, dropping squares off it with a decreasing tolerance; None if too few are left."""
    place = np.column_stack([lowest[:, :2], np.ones(len(lowest))])
    for tolerance in (0.3, 0.25, 0.2, 0.15, 0.15):  # [m]
        on_plane = np.abs(lowest[:, 2] - place @ plane) < tolerance
        if np.count_nonzero(on_plane) < fewest:
            return None
        plane = np.linalg.lstsq(place[on_plane], lowest[on_plane, 2], rcond=None)[0]
    return plane


def _commonest_plane(lowest: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the plane through three squares that fits most others (RANSAC, Fischler and Bolles 1981)."""
    rng = np.random.default_rng(0)
    p, q, r = lowest[rng.integers(len(lowest), size=(3, _TRIALS))]
    normals = np.cross(q - p, r - p)
    normals *= np.where(normals[:, 2:] < 0, -1, 1) / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    steep = normals[:, 2] < math.cos(_STEEPEST)
    distance = np.abs(lowest @ normals.T - (p * normals).sum(axis=1))
    best = np.argmax(np.where(steep, -1, np.count_nonzero(distance < 0.15, axis=0)))
    if steep[best]:
        return np.zeros(3)
    a, b, c = normals[best]
    return np.array([-a / c, -b / c, normals[best] @ p[best] / c])
