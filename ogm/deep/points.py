"""Points to pillars by compiled kernels, without torch: what a network is given, from one scan.

A pillar is the column of space above a cell of the grid, with the points in it (Lang et al. 2019, Sec. 2.1). Points are
sorted by cell, and every pillar has the points it has: nothing is padded, nothing is cut off.
"""

import logging
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.grid import GridSpec
from ogm.jit import kernel, vector
from ogm.pose import check_pose
from ogm.scan import Mount, as_scan

_log = logging.getLogger(__name__)

FEATURES = 9  # x, y, z, intensity; offsets in x, y, z from the pillar's mean; offsets in x, y from the cell's center
Rectangle = tuple[float, float, float, float]  # x_min, x_max, y_min, y_max [m]
EMPTY: Rectangle = (0.0, 0.0, 0.0, 0.0)


class SortedPoints(NamedTuple):
    """The points of one scan, sorted by cell.

    Attributes
    ----------
    features : (N, 9) float32
        Of each point: x, y, z [m] (z above the ground), intensity [0, 1]; x, y, z less the mean of the pillar's
        points [m]; x, y less the center of the cell [m].
    lengths : (P,) int64
        Number of points of each pillar, at least one.
    cells : (P,) int64
        The cell of each pillar, ascending: ``ix * ny + iy``.
    """

    features: NDArray[np.float32]
    lengths: NDArray[np.int64]
    cells: NDArray[np.int64]


def to_ground_frame(mount: Mount) -> tuple[NDArray[np.float64], Rectangle]:
    """Return how points come to the frame of pillars, whose origin is on the ground below the sensor.

    Returns
    -------
    T : (4, 4) float64
        Takes points, as they come, to the ground frame; its axes are parallel to the vehicle's.
    ego_footprint : (x_min, x_max, y_min, y_max)
        The ego vehicle in the ground frame [m].
    """
    x, y, z = (float(value) for value in mount.origin)
    T = mount.T_vehicle_points.copy()
    T[:3, 3] += (-x, -y, mount.sensor_height - z)
    x_min, x_max, y_min, y_max = mount.ego_footprint
    return T, (x_min - x, x_max - x, y_min - y, y_max - y)


def sort_points(
    points: NDArray[np.floating[Any]],
    spec: GridSpec,
    z_range: tuple[float, float] = (-3.0, 8.0),
    ego_footprint: Rectangle = EMPTY,
    T: NDArray[np.floating[Any]] | None = None,
) -> SortedPoints:
    """Sort the points of a scan into pillars.

    Parameters
    ----------
    points : (N, 4) or (N, 3) float array
        x, y, z [m], intensity [0, 1]; without a fourth column the intensity is 0. Points that are NaN or infinite
        are left out, and logged.
    spec : GridSpec
        The cells; points outside are left out.
    z_range : (float, float)
        Heights that are kept, after `T` [m].
    ego_footprint : (x_min, x_max, y_min, y_max)
        Points in this rectangle, after `T`, are left out [m].
    T : (4, 4) array, optional
        Takes the points to the frame of `spec` with z = 0 on the ground.

    Returns
    -------
    SortedPoints

    Raises
    ------
    TypeError, ValueError
        If `points` is not a float array of three or four columns, or `T` is not rigid.
    """
    with np.errstate(over="ignore"):  # what is too far away for float32 becomes infinite, and is left out
        rows = np.ascontiguousarray(as_scan(points).points)
    matrix = np.eye(4) if T is None else check_pose(T, "T")
    grid = spec.resolution, spec.shape, spec.origin
    limits = tuple(map(float, z_range)), tuple(map(float, ego_footprint))
    xyz, cell, invalid = _find_cells(rows, matrix[:3].astype(np.float32), *grid, *limits)
    if invalid:
        _log.warning("dropped %d of %d points that are NaN or infinite", invalid, len(rows))
    features, lengths, cells = _sort_by_cell(xyz, rows[:, 3], cell, spec.shape)
    _add_offsets(features, lengths, cells, *grid)
    return SortedPoints(features, lengths, cells)


def pillar_maxima(
    points: SortedPoints, weight: NDArray[np.float32], bias: NDArray[np.float32], shape: tuple[int, int], channels: int
) -> NDArray[np.float32]:
    """Return the feature map of a scan: of each pillar the largest ``relu(weight @ features + bias)`` of its points.

    Parameters
    ----------
    points : SortedPoints
    weight : (9, C) float32
        Of the linear layer, transposed.
    bias : (C,) float32
    shape : (nx, ny)
        Cells of the grid.
    channels : int
        Channels of the map, C or more. Those after C are 0.

    Returns
    -------
    (1, nx, ny, channels) float32 array
        0 where no point is.
    """
    feature_map = np.zeros((1, *shape, channels), np.float32)
    _fill_maxima(points.features, points.lengths, points.cells, weight, bias, feature_map.reshape(-1, channels))
    return feature_map


@kernel
def _find_cells(points: Any, T: Any, size: float, shape: Any, origin: Any, z_range: Any, ego_footprint: Any) -> Any:
    """Return the transformed points (N, 3), the cell of each (N,) or -1, and how many are not finite."""
    cell = np.empty(len(points), np.int32)
    xyz = np.empty((len(points), 3), np.float32)
    invalid = 0
    x_min, x_max, y_min, y_max = ego_footprint
    for i in range(len(points)):
        cell[i] = -1
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        if not (np.isfinite(px) and np.isfinite(py) and np.isfinite(pz) and np.isfinite(points[i, 3])):
            invalid += 1
            continue
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        if not z_range[0] <= z < z_range[1] or (x_min < x < x_max and y_min < y < y_max):
            continue
        u, v = np.floor((x - origin[0]) / size), np.floor((y - origin[1]) / size)
        if u >= 0 and v >= 0 and u < shape[0] and v < shape[1]:
            cell[i] = int(u) * shape[1] + int(v)
            xyz[i, 0], xyz[i, 1], xyz[i, 2] = x, y, z
    return xyz, cell, invalid


@kernel
def _sort_by_cell(xyz: Any, intensity: Any, cell: Any, shape: Any) -> Any:
    """Return features with their first four columns filled, the pillars' lengths and their cells.

    A counting sort: the order of points within a cell is kept.
    """
    count = np.zeros(shape[0] * shape[1], np.int32)
    pillars = 0
    for i in range(len(cell)):
        if cell[i] >= 0:
            pillars += count[cell[i]] == 0
            count[cell[i]] += 1
    lengths, cells = np.empty(pillars, np.int64), np.empty(pillars, np.int64)
    start, p = 0, 0
    for c in range(len(count)):
        if count[c] > 0:
            lengths[p], cells[p] = count[c], c
            p += 1
            count[c], start = start, start + count[c]  # from here on: where the next point of this cell goes
    features = np.empty((start, 9), np.float32)
    for i in range(len(cell)):
        if cell[i] >= 0:
            row = count[cell[i]]
            count[cell[i]] += 1
            features[row, 0], features[row, 1], features[row, 2] = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            features[row, 3] = intensity[i]
    return features, lengths, cells


@kernel
def _add_offsets(features: Any, lengths: Any, cells: Any, size: float, shape: Any, origin: Any) -> None:
    """Fill the other five columns: offsets from the pillar's mean, and from the cell's center."""
    first = 0
    for p in range(len(lengths)):
        last = first + lengths[p]
        x = origin[0] + (cells[p] // shape[1] + 0.5) * size
        y = origin[1] + (cells[p] % shape[1] + 0.5) * size
        for k in range(3):
            total = 0.0
            for row in range(first, last):
                total += features[row, k]
            for row in range(first, last):
                features[row, 4 + k] = features[row, k] - total / lengths[p]
        for row in range(first, last):
            features[row, 7], features[row, 8] = features[row, 0] - x, features[row, 1] - y
        first = last


@vector
def _fill_maxima(features: Any, lengths: Any, cells: Any, weight: Any, bias: Any, rows: Any) -> None:
    """Fill the rows of the cells that have points."""
    first, channels = 0, len(bias)
    sums = np.empty(channels, np.float32)
    for p in range(len(lengths)):
        row = rows[cells[p]]
        for i in range(first, first + lengths[p]):
            for c in range(channels):
                sums[c] = bias[c]
            for k in range(9):
                value = features[i, k]
                for c in range(channels):
                    sums[c] += value * weight[k, c]
            for c in range(channels):
                row[c] = max(row[c], sums[c])  # it starts at 0, as the ReLU does
        first += lengths[p]
