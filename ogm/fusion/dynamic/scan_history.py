"""The measured cells of the last scans, in map coordinates, and the grids that they were measured on."""

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Corner = tuple[int, int]
KNOWN = 0.5  # mass of free and occupied above which a scan measures a cell, and mass of an occupied one
HIDDEN, CLEAR, OCCUPIED = range(3)  # states of a cell in one scan: not measured, measured as not occupied, occupied


class Extent(NamedTuple):
    """A measurement grid that lies in a window.

    Attributes
    ----------
    affine : (2, 3) float64
        From the window's cells to those of the grid, as `ogm.fusion.window.affine_between` gives it.
    shape : (int, int)
        Cells of the grid.
    """

    affine: NDArray[np.float64]
    shape: tuple[int, int]

    def holds(self, cells: NDArray[np.intp], margin: float) -> NDArray[np.bool_]:
        """Return whether cells (2, n) of the window lie in the grid, and at least a margin [window cells] inside."""
        A, shift = self.affine[:, :2], self.affine[:, 2:]
        inner = A @ (cells + 0.5) + shift
        edge = margin * np.hypot(*A[:, 0])
        size = np.array(self.shape)[:, np.newaxis]
        inside: NDArray[np.bool_] = np.all((inner >= edge) & (inner <= size - edge), axis=0)
        return inside


class ScanCells(NamedTuple):
    """Cells (nx, ny) that a scan measures as occupied, those that it does not measure, and its age [s]."""

    occupied: NDArray[np.bool_]
    hidden: NDArray[np.bool_]
    age: float


def scan_states(measured: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the states of cells (nx, ny) by the masses (free, occupied) of a scan, (nx, 2 ny)."""
    free, occupied = measured[:, ::2], measured[:, 1::2]
    return (HIDDEN + (free + occupied > KNOWN).astype(np.uint8) + (occupied > KNOWN)).astype(np.uint8)


def scan_cells(states: NDArray[np.uint8], age: float) -> ScanCells:
    """Return the cells of a scan by their states."""
    return ScanCells(states == OCCUPIED, states == HIDDEN, age)


class ScanHistory:
    """The cells of a scrolling window that the last scans measured.

    Parameters
    ----------
    seconds : float
        How long a scan is kept [s].
    spacing : float
        Least time between two scans that are kept [s], so that sensors of any rate cost the same.
    """

    seconds: float
    spacing: float

    def __init__(self, seconds: float, spacing: float) -> None:
        self.seconds, self.spacing = seconds, spacing
        self._scans: deque[tuple[float, Corner, NDArray[np.uint8]]] = deque()
        self._grids: deque[tuple[float, Corner, Extent]] = deque()  # of all scans, also of those without shapes

    def clear(self) -> None:
        """Forget all scans."""
        self._scans.clear()
        self._grids.clear()

    def add(self, stamp: float, corner: Corner, cells: NDArray[np.uint8]) -> None:
        """Keep the cells of a scan; those of one stamp are merged.

        Parameters
        ----------
        stamp : float
            [s]
        corner : (int, int)
            Lattice index of the first cell.
        cells : (nx, ny) uint8
            `HIDDEN`, `CLEAR` or `OCCUPIED`.
        """
        while self._scans and self._scans[0][0] < stamp - self.seconds:
            self._scans.popleft()
        if self._scans:
            newest, where, others = self._scans[-1]
            if newest == stamp:
                self._scans[-1] = stamp, corner, np.maximum(cells, _shifted(others, where, corner))
                return
            if stamp - newest < self.spacing:
                return
        self._scans.append((stamp, corner, cells))

    def add_grid(self, stamp: float, corner: Corner, extent: Extent) -> None:
        """Keep where a scan's measurement grid lies in the window."""
        while self._grids and self._grids[0][0] < stamp - self.seconds:
            self._grids.popleft()
        self._grids.append((stamp, corner, extent))

    def reached(self, corner: Corner, cells: NDArray[np.intp], margin: float) -> NDArray[np.bool_]:
        """Return which cells (2, n) of a window lie in the grid of a kept scan, with a margin [cells] inside."""
        found = np.zeros(cells.shape[1], bool)
        for _, where, extent in self._grids:
            step = np.subtract(corner, where)
            affine = np.column_stack([extent.affine[:, :2], extent.affine[:, 2] + extent.affine[:, :2] @ step])
            found |= Extent(affine, extent.shape).holds(cells, margin)
        return found

    def earlier(self, stamp: float, corner: Corner, ages: Sequence[float]) -> list[ScanCells]:
        """Return the scans whose ages are closest to some ages, aligned with a window.

        Cells that were outside the window of a scan are hidden. None of the scans is newer than half the least
        of `ages`.
        """
        past = [scan for scan in self._scans if stamp - scan[0] >= min(ages) / 2]
        chosen = {min(range(len(past)), key=lambda k: math.fabs(stamp - past[k][0] - age)) for age in ages if past}
        return [
            scan_cells(_shifted(states, where, corner), stamp - then)
            for then, where, states in (past[k] for k in sorted(chosen))
        ]


def _shifted(mask: NDArray[np.uint8], at: Corner, corner: Corner) -> NDArray[np.uint8]:
    """Return the cells of a window with some corner; what the old one did not hold is `HIDDEN`."""
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
