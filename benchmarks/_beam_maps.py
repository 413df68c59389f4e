"""Maps of planar scans by others: OctoMap in one plane, and the log-odds grid of textbooks."""

import importlib
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ogm import EvidentialGrid, GridSpec
from ogm.jit import kernel
from ogm.scan import Frame

HIT, MISS = 0.7, 0.4  # probabilities that one beam gives the cell of its end, and those before: OctoMap's defaults
MARGIN = 1.0  # [m] around the ends of the beams


def ends_of(frame: Frame) -> NDArray[np.float64]:
    """Return the ends of the beams with echo in the map, (N, 3) [m]."""
    T = frame.T_map_sensor
    assert T is not None
    ends: NDArray[np.float64] = frame.scan.points[:, :3].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    return ends


def window(frames: Sequence[Frame], resolution: float) -> GridSpec:
    """Return the cells that hold the ends of all beams."""
    xy = np.concatenate([ends_of(frame)[:, :2] for frame in frames])
    low = np.floor((xy.min(axis=0) - MARGIN) / resolution)
    nx, ny = (np.ceil((xy.max(axis=0) + MARGIN) / resolution) - low).astype(int).tolist()
    return GridSpec(resolution, (nx, ny), tuple(low * resolution))


def as_masses(spec: GridSpec, p: NDArray[np.float64], seen: NDArray[np.bool_]) -> EvidentialGrid:
    """Return probabilities as masses without unknown; cells that were never seen are unknown."""
    mass = np.where(seen[..., None], np.stack([1 - p, p], axis=-1), 0.0).astype(np.float32)
    return EvidentialGrid(spec, mass)


class LogOddsGrid:
    """The occupancy grid of textbooks (Thrun, Burgard and Fox 2005, Table 9.1), without limits.

    The cell of an end gets log-odds of a hit, cells before those of a miss; a scan counts a cell once, as a hit if
    any of its beams ends there.
    """

    def __init__(self, resolution: float) -> None:
        self.resolution = resolution

    def __call__(self, frames: Sequence[Frame]) -> EvidentialGrid:
        spec = window(frames, self.resolution)
        log_odds = np.zeros(spec.shape)
        mark = np.full(spec.shape, -1, np.int32)  # twice the last scan that saw a cell, and 1 if a beam ended there
        for number, frame in enumerate(frames):
            assert frame.T_map_sensor is not None
            ends = (ends_of(frame)[:, :2] - spec.origin) / self.resolution
            start = (frame.T_map_sensor[:2, 3] - spec.origin) / self.resolution
            add_beams(np.ascontiguousarray(ends), start, 2 * number, mark, log_odds)
        return as_masses(spec, 1 / (1 + np.exp(-log_odds)), mark >= 0)


@kernel
def add_beams(ends: np.ndarray, start: np.ndarray, number: int, mark: np.ndarray, log_odds: np.ndarray) -> None:
    """Add the log-odds of one scan: of hits to the cells of ends, of misses to those that beams pass before."""
    for n in range(len(ends)):
        i, j = math.floor(ends[n, 0]), math.floor(ends[n, 1])
        if mark[i, j] != number + 1:
            mark[i, j] = number + 1
            log_odds[i, j] += math.log(HIT / (1 - HIT))
    for n in range(len(ends)):
        x, y = start[0], start[1]
        u, v = ends[n, 0] - x, ends[n, 1] - y
        i, j = math.floor(x), math.floor(y)
        last_i, last_j = math.floor(ends[n, 0]), math.floor(ends[n, 1])
        per_i, per_j = 1 / max(abs(u), 1e-12), 1 / max(abs(v), 1e-12)
        next_i = ((i + 1 - x) if u > 0 else (x - i)) * per_i
        next_j = ((j + 1 - y) if v > 0 else (y - j)) * per_j
        for _ in range(abs(last_i - i) + abs(last_j - j)):
            if mark[i, j] < number:
                mark[i, j] = number
                log_odds[i, j] += math.log(MISS / (1 - MISS))
            if next_i < next_j:
                i, next_i = i + (1 if u > 0 else -1), next_i + per_i
            else:
                j, next_j = j + (1 if v > 0 else -1), next_j + per_j


class OctoMapPlane:
    """OctoMap in one plane: its defaults, all points at one height.

    Parameters
    ----------
    resolution : float
        [m].
    """

    def __init__(self, resolution: float) -> None:
        self.resolution, self.tree_type = resolution, importlib.import_module("pyoctomap").OcTree

    def __call__(self, frames: Sequence[Frame]) -> EvidentialGrid:
        spec, tree, height = window(frames, self.resolution), self.tree_type(self.resolution), self.resolution / 2
        for frame in frames:
            assert frame.T_map_sensor is not None
            ends, origin = ends_of(frame), frame.T_map_sensor[:3, 3].copy()
            ends[:, 2] = origin[2] = height  # the middle of a layer of voxels
            tree.insertPointCloud(ends, origin, -1.0, True, False)
        tree.updateInnerOccupancy()
        rows = [
            (*leaf.getCoordinate(), leaf.getSize(), leaf.current_node.getOccupancy()) for leaf in tree.begin_leafs()
        ]
        x, y, z, size, occupancy = np.array(rows).T
        p, seen = np.zeros(spec.shape), np.zeros(spec.shape, bool)
        for cells in np.unique(np.rint(size / self.resolution).astype(int)).tolist():  # inner nodes hold equal leaves
            half = cells * self.resolution / 2
            chosen = (np.rint(size / self.resolution) == cells) & (np.abs(z - height) <= half)
            corner = np.stack([x[chosen], y[chosen]], axis=1) - half - spec.origin
            i, j = np.rint(corner / self.resolution).astype(int).T
            for di, dj in np.ndindex(cells, cells):
                inside = (i + di >= 0) & (i + di < spec.shape[0]) & (j + dj >= 0) & (j + dj < spec.shape[1])
                p[i[inside] + di, j[inside] + dj] = occupancy[chosen][inside]
                seen[i[inside] + di, j[inside] + dj] = True
        return as_masses(spec, p, seen)
