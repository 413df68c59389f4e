"""Pillars of a scan, or of a batch of scans, as torch tensors.

`pillarize` uses the compiled kernels of `ogm.deep.points`; `pillarize_torch` is their slow reference for any device.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ogm.deep.points import EMPTY, Rectangle, sort_points
from ogm.geometric import RayISM
from ogm.grid import GridSpec
from ogm.scan import Mount, Scan


class Pillars(NamedTuple):
    """Points of a scan, or of a batch of scans, sorted by cell.

    Attributes
    ----------
    features, lengths
        See `ogm.deep.points.SortedPoints`.
    cells : (P,) int64
        Cell of each pillar, ascending: ``(scan * nx + ix) * ny + iy``.
    batch : int
        Number of scans.
    rays : (batch, nx, ny, 2) float32, optional
        Masses of `ogm.geometric.RayISM` for free and occupied.
    """

    features: torch.Tensor
    lengths: torch.Tensor
    cells: torch.Tensor
    batch: int = 1
    rays: torch.Tensor | None = None

    def to(self, device: torch.device | str) -> "Pillars":
        """Return the pillars on another device."""
        features, lengths, cells = (array.to(device, non_blocking=True) for array in self[:3])
        rays = None if self.rays is None else self.rays.to(device, non_blocking=True)
        return Pillars(features, lengths, cells, self.batch, rays)


def pillarize(
    points: NDArray[np.floating[Any]],
    spec: GridSpec,
    z_range: tuple[float, float] = (-3.0, 8.0),
    ego_footprint: Rectangle = EMPTY,
    T: NDArray[np.floating[Any]] | None = None,
) -> Pillars:
    """Sort the points of a scan into pillars.

    For parameters and errors see `ogm.deep.points.sort_points`.

    Returns
    -------
    Pillars
        Tensors on the CPU.
    """
    features, lengths, cells = map(torch.from_numpy, sort_points(points, spec, z_range, ego_footprint, T))
    return Pillars(features, lengths, cells)


def pillarize_torch(
    points: torch.Tensor,
    spec: GridSpec,
    z_range: tuple[float, float] = (-3.0, 8.0),
    ego_footprint: Rectangle = EMPTY,
    T: torch.Tensor | None = None,
) -> Pillars:
    """Sort points (N, 4) float32 into pillars like `pillarize`, by torch operations on their device."""
    points = points[torch.isfinite(points).all(dim=1)]
    xyz, intensity = points[:, :3], points[:, 3:]
    if T is not None:
        xyz = xyz @ T[:3, :3].T + T[:3, 3]
    (nx, ny), (x0, y0), size = spec.shape, spec.origin, spec.resolution
    x, y, z = xyz.double().unbind(1)  # limits are compared in double precision, as in the kernel
    ix, iy = (torch.floor((a - a0) / size).long() for a, a0 in ((x, x0), (y, y0)))
    keep = (ix >= 0) & (ix < nx) & (iy >= 0) & (iy < ny) & (z >= z_range[0]) & (z < z_range[1])
    x_min, x_max, y_min, y_max = ego_footprint
    keep &= ~((x > x_min) & (x < x_max) & (y > y_min) & (y < y_max))
    cell, order = torch.sort((ix * ny + iy)[keep], stable=True)
    xyz, intensity = xyz[keep][order], intensity[keep][order]
    cells, pillar, lengths = torch.unique_consecutive(cell, return_inverse=True, return_counts=True)
    sums = torch.zeros(len(cells), 3, device=xyz.device).index_add_(0, pillar, xyz)
    mean = (sums / lengths[:, None])[pillar]
    center = torch.stack([(cell // ny + 0.5) * size + x0, (cell % ny + 0.5) * size + y0], dim=1)
    return Pillars(torch.cat([xyz, intensity, xyz - mean, xyz[:, :2] - center], dim=1), lengths, cells)


def collate(scans: Sequence[Pillars], cells: int) -> Pillars:
    """Join the pillars of several scans to a batch.

    Parameters
    ----------
    scans : sequence of Pillars
        Pillars of single scans.
    cells : int
        Number of cells of the grid, nx * ny.
    """
    rays = [scan.rays for scan in scans if scan.rays is not None]
    return Pillars(
        torch.cat([scan.features for scan in scans]),
        torch.cat([scan.lengths for scan in scans]),
        torch.cat([scan.cells + cells * number for number, scan in enumerate(scans)]),
        len(scans),
        torch.cat(rays) if rays else None,
    )


def ray_masses(scan: Scan, spec: GridSpec, height: float, ego_footprint: Rectangle) -> torch.Tensor:
    """Return the masses of `RayISM` for a scan in the ground frame, (1, nx, ny, 2) float32.

    Parameters
    ----------
    scan : Scan
        Scan in the frame of `to_ground_frame`, including beams without echo.
    spec : GridSpec
        Grid around the sensor.
    height : float
        Height of the sensor above the ground [m].
    ego_footprint : (x_min, x_max, y_min, y_max)
        Ego vehicle in the ground frame [m].
    """
    T = np.eye(4)
    T[2, 3] = height
    mount = Mount(height, T, ego_footprint, points_in="vehicle")
    return torch.from_numpy(RayISM(spec, mount)(scan).mass)[None]


def cap_pillars(pillars: Pillars, rng: np.random.Generator, most_pillars: int, most_points: int) -> Pillars:
    """Limit the number of pillars and of points per pillar by a random choice, as van Kempen et al. 2021.

    Offsets remain relative to the mean of all points of a pillar, as in the paper's code.
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
        pillars.rays,
    )
