"""Points to pillars: the columns of space above the cells of a grid, and what a network is told of the points in them.

Lang et al. 2019, Sec. 2.1, without its padding: points are sorted by cell, and every pillar has the points it has.
Nothing is cut off unless asked for. `pillarize` is a numba kernel, `pillarize_torch` its slow twin for any device.
"""

import logging
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray

from ogm.grid import GridSpec

__all__ = [
    "FEATURES",
    "EGO_FOOTPRINT",
    "Box",
    "Pillars",
    "collate",
    "cap_pillars",
    "pillarize",
    "pillarize_torch",
]

_log = logging.getLogger(__name__)

FEATURES = (
    9  # x, y, z, intensity; offsets in x, y, z from the pillar's mean; offsets in x, y from the cell's middle
)
Box = tuple[float, float, float, float]  # x_min, x_max, y_min, y_max [m]
EGO_FOOTPRINT: Box = (
    -2.5,
    2.5,
    -1.1,
    1.1,
)  # [m] around the sensor: the own vehicle, in training and by default
_NOWHERE: Box = (0.0, 0.0, 0.0, 0.0)


class Pillars(NamedTuple):
    """The points of one scan, or of a batch of scans, sorted by the cell they stand in.

    Attributes
    ----------
    features : (N, 9) float32
        Of each point: x, y, z [m] (z above the ground), intensity [0, 1]; x, y, z less the mean of the pillar's
        points [m]; x, y less the middle of the cell [m].
    lengths : (P,) int64
        How many points each pillar has, at least one.
    cells : (P,) int64
        The cell of each pillar, ascending: ``(scan * nx + ix) * ny + iy``.
    batch : int
        Scans.
    """

    features: torch.Tensor
    lengths: torch.Tensor
    cells: torch.Tensor
    batch: int = 1

    def to(self, device: torch.device | str) -> "Pillars":
        """Return the same on another device."""
        return Pillars(
            self.features.to(device, non_blocking=True),
            self.lengths.to(device, non_blocking=True),
            self.cells.to(device, non_blocking=True),
            self.batch,
        )


def pillarize(
    points: NDArray[np.floating[Any]],
    spec: GridSpec,
    z_range: tuple[float, float] = (-3.0, 8.0),
    ego_footprint: Box = _NOWHERE,
    T: NDArray[np.floating[Any]] | None = None,
) -> Pillars:
    """Sort the points of a scan into pillars.

    Parameters
    ----------
    points : (N, 4) or (N, 3) float array
        x, y, z [m], intensity [0, 1]; without a fourth column the intensity is 0.
    spec : GridSpec
        The cells; points outside are left out.
    z_range : (float, float)
        Heights that are kept, after `T` [m].
    own_box : (x_min, x_max, y_min, y_max)
        Points in this rectangle are left out [m]: the own vehicle.
    T : (4, 4) or (3, 4), optional
        Takes the points to the frame of `spec` with z = 0 on the ground.

    Returns
    -------
    Pillars
        On the CPU; without any point where none is left.

    Raises
    ------
    TypeError, ValueError
        If `points` is not a float array of three columns or more. Points that are NaN or infinite are left out,
        and logged.
    """
    points = _checked(points)
    matrix = np.eye(4, dtype=np.float32) if T is None else np.asarray(T, np.float32)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"T must be a transform of shape (4, 4) or (3, 4), got {matrix.shape}")
    features, lengths, cells, invalid = _pillars(
        points,
        np.ascontiguousarray(matrix[:3]),
        *(spec.resolution, *spec.shape, *spec.origin),
        *map(float, z_range),
        *map(float, ego_footprint),
    )
    if invalid:
        _log.warning("dropped %d of %d points that are NaN or infinite", invalid, len(points))
    return Pillars(torch.from_numpy(features), torch.from_numpy(lengths), torch.from_numpy(cells))


def pillarize_torch(
    points: torch.Tensor,
    spec: GridSpec,
    z_range: tuple[float, float] = (-3.0, 8.0),
    ego_footprint: Box = _NOWHERE,
    T: torch.Tensor | None = None,
) -> Pillars:
    """Do as `pillarize` does, with torch operations on the device of `points`, an (N, 4) float32 tensor."""
    points = points[torch.isfinite(points).all(dim=1)]
    xyz, intensity = points[:, :3], points[:, 3:]
    if T is not None:
        xyz = xyz @ T[:3, :3].T + T[:3, 3]
    nx, ny = spec.shape
    ix, iy = (
        torch.floor((xyz[:, axis].double() - spec.origin[axis]) / spec.resolution).long() for axis in (0, 1)
    )
    x, y, z = xyz.double().unbind(1)  # the limits are compared as the kernel does
    keep = (ix >= 0) & (ix < nx) & (iy >= 0) & (iy < ny) & (z >= z_range[0]) & (z < z_range[1])
    keep &= ~(
        (x > ego_footprint[0]) & (x < ego_footprint[1]) & (y > ego_footprint[2]) & (y < ego_footprint[3])
    )
    cell, order = torch.sort((ix * ny + iy)[keep], stable=True)
    xyz, intensity = xyz[keep][order], intensity[keep][order]
    cells, pillar, lengths = torch.unique_consecutive(cell, return_inverse=True, return_counts=True)
    sums = torch.zeros(len(cells), 3, device=xyz.device).index_add_(0, pillar, xyz)
    mean = (sums / lengths[:, None])[pillar]
    middle = torch.stack(
        [
            (cell // ny + 0.5) * spec.resolution + spec.origin[0],
            (cell % ny + 0.5) * spec.resolution + spec.origin[1],
        ],
        dim=1,
    ).float()
    return Pillars(torch.cat([xyz, intensity, xyz - mean, xyz[:, :2] - middle], dim=1), lengths, cells)


def collate(scans: Sequence[Pillars], cells: int) -> Pillars:
    """Join the pillars of some scans into a batch.

    Parameters
    ----------
    scans : sequence of Pillars
        Of one scan each.
    cells : int
        Cells of the grid, nx * ny.
    """
    return Pillars(
        torch.cat([scan.features for scan in scans]),
        torch.cat([scan.lengths for scan in scans]),
        torch.cat([scan.cells + cells * number for number, scan in enumerate(scans)]),
        len(scans),
    )


def cap_pillars(
    pillars: Pillars, rng: np.random.Generator, most_pillars: int = 10_000, most_points: int = 100
) -> Pillars:
    """Keep at most so many pillars, and points of each, chosen at random: the limits of van Kempen et al. 2021.

    The offsets from the pillar's mean stay those from the mean of all its points, as in the paper's code.
    """
    lengths = pillars.lengths.numpy()
    kept = np.ones(len(lengths), bool)
    if len(lengths) > most_pillars:
        kept[:] = False
        kept[rng.choice(len(lengths), most_pillars, replace=False)] = True
    pillar = np.repeat(np.arange(len(lengths)), lengths)
    shuffled = np.lexsort((rng.random(len(pillar)), pillar))
    rank = np.arange(len(pillar)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    rows = np.sort(shuffled[(rank < most_points) & kept[pillar]])
    return Pillars(
        pillars.features[torch.from_numpy(rows)],
        torch.from_numpy(np.minimum(lengths, most_points)[kept]),
        pillars.cells[torch.from_numpy(kept)],
        pillars.batch,
    )


def _checked(points: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    if not isinstance(points, np.ndarray) or points.dtype.kind != "f":
        got = getattr(points, "dtype", type(points).__name__)
        raise TypeError(f"points must be a float array of shape (N, 4) [x, y, z, intensity], got {got}")
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(
            f"points must have shape (N, 4) [x, y, z, intensity] (or at least 3 columns), got {points.shape}"
        )
    with np.errstate(over="ignore"):  # what is too far away for float32 becomes infinite, and is left out
        return np.ascontiguousarray(points, np.float32)


@njit(cache=True, nogil=True)
def _pillars(
    points: Any,
    T: Any,
    resolution: float,
    nx: int,
    ny: int,
    x0: float,
    y0: float,
    z_min: float,
    z_max: float,
    own_x0: float,
    own_x1: float,
    own_y0: float,
    own_y1: float,
) -> Any:
    """Sort the points by cell, by counting, then work out the features; the order within a cell is kept."""
    n, intensities = points.shape[0], points.shape[1] > 3
    cell = np.empty(n, np.int32)
    xyz = np.empty((n, 3), np.float32)
    count = np.zeros(nx * ny, np.int32)
    invalid = 0
    kept = 0
    for i in range(n):
        cell[i] = -1
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        finite = np.isfinite(px) and np.isfinite(py) and np.isfinite(pz)
        if intensities:
            finite = finite and np.isfinite(points[i, 3])
        if not finite:
            invalid += 1
            continue
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        if not (z >= z_min and z < z_max) or (x > own_x0 and x < own_x1 and y > own_y0 and y < own_y1):
            continue
        u, v = np.floor((x - x0) / resolution), np.floor((y - y0) / resolution)
        if not (u >= 0 and v >= 0 and u < nx and v < ny):
            continue
        cell[i] = int(u) * ny + int(v)
        xyz[i, 0], xyz[i, 1], xyz[i, 2] = x, y, z
        count[cell[i]] += 1
        kept += 1
    pillars = 0
    for c in range(nx * ny):
        pillars += count[c] > 0
    lengths = np.empty(pillars, np.int64)
    cells = np.empty(pillars, np.int64)
    start = 0
    p = 0
    for c in range(nx * ny):
        if count[c] > 0:
            lengths[p] = count[c]
            cells[p] = c
            p += 1
            here = count[c]
            count[c] = start  # from now on: where the next point of this cell goes
            start += here
    features = np.empty((kept, 9), np.float32)
    for i in range(n):
        if cell[i] < 0:
            continue
        row = count[cell[i]]
        count[cell[i]] += 1
        features[row, 0] = xyz[i, 0]
        features[row, 1] = xyz[i, 1]
        features[row, 2] = xyz[i, 2]
        features[row, 3] = points[i, 3] if intensities else np.float32(0)
    first = 0
    for p in range(pillars):
        last = first + lengths[p]
        mx, my, mz = 0.0, 0.0, 0.0
        for row in range(first, last):
            mx += features[row, 0]
            my += features[row, 1]
            mz += features[row, 2]
        mx, my, mz = mx / lengths[p], my / lengths[p], mz / lengths[p]
        middle_x = x0 + (cells[p] // ny + 0.5) * resolution
        middle_y = y0 + (cells[p] % ny + 0.5) * resolution
        for row in range(first, last):
            features[row, 4] = features[row, 0] - mx
            features[row, 5] = features[row, 1] - my
            features[row, 6] = features[row, 2] - mz
            features[row, 7] = features[row, 0] - middle_x
            features[row, 8] = features[row, 1] - middle_y
        first = last
    return features, lengths, cells, invalid
