"""History of the measured cells of recent scans in map coordinates, and of their measurement grids."""

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Corner = tuple[int, int]
KNOWN = 0.5  # least free + occupied of a measured cell, and least occupied of an occupied cell
HIDDEN, CLEAR, OCCUPIED = range(3)  # states of a cell in one scan: not measured, measured but not occupied, occupied


class Extent(NamedTuple):
    """Position of a measurement grid in a window.

    Attributes
    ----------
    affine : (2, 3) float64
        Affine map from the window's cells to the grid's cells, see `ogm.fusion.window.affine_between`.
    shape : (int, int)
        Number of cells of the grid.
    """

    affine: NDArray[np.float64]
    shape: tuple[int, int]

    def holds(self, cells: NDArray[np.intp], margin: float) -> NDArray[np.bool_]:
        """Return whether cells (2, n) of the window lie in the grid, at least a margin [window cells] from its edge."""
        A, shift = self.affine[:, :2], self.affine[:, 2:]
        inner = A @ (cells + 0.5) + shift
        edge = margin * np.hypot(*A[:, 0])
        size = np.array(self.shape)[:, np.newaxis]
        inside: NDArray[np.bool_] = np.all((inner >= edge) & (inner <= size - edge), axis=0)
        return inside


class ScanCells(NamedTuple):
    """Occupied cells of a scan, (nx, ny), its cells that were not measured, and its age [s]."""

    occupied: NDArray[np.bool_]
    hidden: NDArray[np.bool_]
    age: float


def scan_states(measured: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the states of cells (nx, ny) from masses (free, occupied) of a scan, (nx, 2 ny)."""
    free, occupied = measured[:, ::2], measured[:, 1::2]
    return (HIDDEN + (free + occupied > KNOWN).astype(np.uint8) + (occupied > KNOWN)).astype(np.uint8)


def scan_cells(states: NDArray[np.uint8], age: float) -> ScanCells:
    """Return the cells of a scan from their states."""
    return ScanCells(states == OCCUPIED, states == HIDDEN, age)


class ScanHistory:
    """Measured cells of recent scans in a scrolling window.

    Parameters
    ----------
    seconds : float
        Time for which a scan is kept [s].
    spacing : float
        Least time between two kept scans [s], so that the cost does not depend on the sensor's rate.
    """

    seconds: float
    spacing: float

    def __init__(self, seconds: float, spacing: float) -> None:
        self.seconds, self.spacing = seconds, spacing
        self._scans: deque[tuple[float, Corner, NDArray[np.uint8]]] = deque()
        self._grids: deque[tuple[float, Corner, Extent]] = deque()  # of all scans, with and without shapes

    def clear(self) -> None:
        """Forget all scans."""
        self._scans.clear()
        self._grids.clear()

    def add(self, stamp: float, corner: Corner, cells: NDArray[np.uint8]) -> None:
        """Keep the cells of a scan; scans with the same stamp are merged.

        Parameters
        ----------
        stamp : float
            Time of the scan [s].
        corner : (int, int)
            Lattice index of the first cell.
        cells : (nx, ny) uint8
            `HIDDEN`, `CLEAR` or `OCCUPIED`.
        """
        while self._scans and self._scans[0][0] < stamp - self.seconds:
            self._scans.popleft()
        if self._scans:
            newest, old_corner, others = self._scans[-1]
            if newest == stamp:
                self._scans[-1] = stamp, corner, np.maximum(cells, _shifted(others, old_corner, corner))
                return
            if stamp - newest < self.spacing:
                return
        self._scans.append((stamp, corner, cells))

    def add_grid(self, stamp: float, corner: Corner, extent: Extent) -> None:
        """Keep the position of a scan's measurement grid in the window."""
        while self._grids and self._grids[0][0] < stamp - self.seconds:
            self._grids.popleft()
        self._grids.append((stamp, corner, extent))

    def reached(self, corner: Corner, cells: NDArray[np.intp], margin: float) -> NDArray[np.bool_]:
        """Return which cells (2, n) of a window lie in the grid of a kept scan, at least `margin` [cells] inside."""
        found = np.zeros(cells.shape[1], bool)
        for _, old_corner, extent in self._grids:
            step = np.subtract(corner, old_corner)
            affine = np.column_stack([extent.affine[:, :2], extent.affine[:, 2] + extent.affine[:, :2] @ step])
            found |= Extent(affine, extent.shape).holds(cells, margin)
        return found

    def earlier(self, stamp: float, corner: Corner, ages: Sequence[float]) -> list[ScanCells]:
        """Return the scans with ages closest to the given ages [s], aligned with a window.

        Cells outside the window of a scan are hidden. All scans are at least half as old as the least of `ages`.
        """
        past = [scan for scan in self._scans if stamp - scan[0] >= min(ages) / 2]
        chosen = {min(range(len(past)), key=lambda k: math.fabs(stamp - past[k][0] - age)) for age in ages if past}
        return [
            scan_cells(_shifted(states, old_corner, corner), stamp - then)
            for then, old_corner, states in (past[k] for k in sorted(chosen))
        ]


def _shifted(mask: NDArray[np.uint8], at: Corner, corner: Corner) -> NDArray[np.uint8]:
    """Return cells shifted from one window corner to another; cells outside the old window are `HIDDEN`."""
    if at == corner:
        return mask
    out = np.zeros_like(mask)
    source, target = [], []
    for size, old, new in zip(mask.shape, at, corner, strict=True):
        step = new - old
        source.append(slice(max(step, 0), max(min(size + step, size), 0)))
        target.append(slice(max(-step, 0), max(min(size - step, size), 0)))
    part = mask[tuple(source)]
    if part.size:
        out[tuple(target)] = part
    return out
