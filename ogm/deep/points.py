"""Sorting of the points of a scan into pillars, the input of a network, by compiled kernels without torch.

A pillar is the column of space above a cell of the grid, with the points in it (Lang et al. 2019, Sec. 2.1). Points are
sorted by cell. Pillars have variable numbers of points, without padding or truncation.
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

FEATURES = 9  # x, y, z, intensity; x, y, z relative to the pillar's mean; x, y relative to the cell's center
Rectangle = tuple[float, float, float, float]  # x_min, x_max, y_min, y_max [m]
EMPTY: Rectangle = (0.0, 0.0, 0.0, 0.0)


class SortedPoints(NamedTuple):
    """Points of a scan, sorted by cell.

    Attributes
    ----------
    features : (N, 9) float32
        Features of each point: x, y, z [m] (z above the ground), intensity [0, 1]; x, y, z relative to the mean of the
        pillar's points [m]; x, y relative to the center of the cell [m].
    lengths : (P,) int64
        Number of points of each pillar, at least 1.
    cells : (P,) int64
        Cell of each pillar, ascending: ``ix * ny + iy``.
    """

    features: NDArray[np.float32]
    lengths: NDArray[np.int64]
    cells: NDArray[np.int64]


def to_ground_frame(mount: Mount) -> tuple[NDArray[np.float64], Rectangle]:
    """Return the transform to the ground frame of pillars and the ego footprint in that frame.

    The origin of the ground frame is on the ground below the sensor; its axes are parallel to the vehicle's.

    Returns
    -------
    T : (4, 4) float64
        Transform from the frame of the scan's points to the ground frame.
    ego_footprint : (x_min, x_max, y_min, y_max)
        Ego vehicle in the ground frame [m].
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
        x, y, z [m], intensity [0, 1]; without a fourth column the intensity is 0. NaN and infinite points are dropped
        with a warning in the log.
    spec : GridSpec
        Grid of the pillars; points outside are dropped.
    z_range : (float, float)
        Heights of the points to keep, after `T` [m].
    ego_footprint : (x_min, x_max, y_min, y_max)
        Rectangle in which points are dropped, after `T` [m].
    T : (4, 4) array, optional
        Transform of the points to the frame of `spec`, with z = 0 on the ground.

    Returns
    -------
    SortedPoints

    Raises
    ------
    TypeError, ValueError
        If `points` is not a float array of three or four columns, or `T` is not rigid.
    """
    with np.errstate(over="ignore"):  # points too far away for float32 become infinite and are dropped
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
    """Return the feature map: for each pillar the maximum of ``relu(features @ weight + bias)`` over its points.

    Parameters
    ----------
    points : SortedPoints
        Points of a scan.
    weight : (9, C) float32
        Transposed weight of the linear layer.
    bias : (C,) float32
        Bias of the linear layer.
    shape : (nx, ny)
        Numbers of cells of the grid.
    channels : int
        Number of channels of the feature map, at least C. Further channels are 0.

    Returns
    -------
    (1, nx, ny, channels) float32 array
        Feature map, 0 in cells without points.
    """
    feature_map = np.zeros((1, *shape, channels), np.float32)
    _fill_maxima(points.features, points.lengths, points.cells, weight, bias, feature_map.reshape(-1, channels))
    return feature_map


@kernel
def _find_cells(points: Any, T: Any, size: float, shape: Any, origin: Any, z_range: Any, ego_footprint: Any) -> Any:
    """Return the transformed points (N, 3), their cells (N,) or -1, and the number of non-finite points."""
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
    """Return features with the first four columns filled, and the lengths and cells of the pillars.

    This is a stable counting sort, which keeps the order of points within a cell.
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
            count[c], start = start, start + count[c]  # now the row of the next point of this cell
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
    """Fill the last five columns: offsets from the pillar's mean and from the cell's center."""
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
    """Fill the rows of cells with points."""
    first, w = 0, weight
    for p in range(len(lengths)):
        row = rows[cells[p]]
        for i in range(first, first + lengths[p]):
            f = features[i]
            x, y, z, intensity, dx, dy, dz, cx, cy = f[0], f[1], f[2], f[3], f[4], f[5], f[6], f[7], f[8]
            for c in range(len(bias)):  # one expression keeps the sum in registers
                total = bias[c] + x * w[0, c] + y * w[1, c] + z * w[2, c] + intensity * w[3, c] + dx * w[4, c]
                total += dy * w[5, c] + dz * w[6, c] + cx * w[7, c] + cy * w[8, c]
                row[c] = max(row[c], total)  # starts at 0, like the ReLU
        first += lengths[p]
