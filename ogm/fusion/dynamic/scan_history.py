"""The occupied cells of the last scans, in map coordinates, and the grids that they were measured on."""

import math
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Corner = tuple[int, int]


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


class EarlierScan(NamedTuple):
    """A scan, aligned with a later window: its occupied cells (nx, ny), its age [s], and its measurement grids."""

    occupied: NDArray[np.bool_]
    age: float
    extents: tuple[Extent, ...]


class ScanHistory:
    """Which cells of a scrolling window the last scans measured as occupied.

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
        self._scans: deque[tuple[float, Corner, NDArray[np.bool_], tuple[Extent, ...]]] = deque()
        self._grids: deque[tuple[float, Corner, Extent]] = deque()  # of all scans, also of those without shapes

    def clear(self) -> None:
        """Forget all scans."""
        self._scans.clear()
        self._grids.clear()

    def add(self, stamp: float, corner: Corner, occupied: NDArray[np.bool_], extent: Extent) -> None:
        """Keep a scan's occupied cells (nx, ny), with the lattice index of the first; those of one stamp are merged."""
        while self._scans and self._scans[0][0] < stamp - self.seconds:
            self._scans.popleft()
        if self._scans:
            newest, where, mask, extents = self._scans[-1]
            if newest == stamp:
                both = occupied | _shifted(mask, where, corner)
                self._scans[-1] = stamp, corner, both, (*_moved(extents, where, corner), extent)
                return
            if stamp - newest < self.spacing:
                return
        self._scans.append((stamp, corner, occupied, (extent,)))

    def add_grid(self, stamp: float, corner: Corner, extent: Extent) -> None:
        """Keep where a scan's measurement grid lies in the window."""
        while self._grids and self._grids[0][0] < stamp - self.seconds:
            self._grids.popleft()
        self._grids.append((stamp, corner, extent))

    def reached(self, corner: Corner, cells: NDArray[np.intp], margin: float) -> NDArray[np.bool_]:
        """Return which cells (2, n) of a window lie in the grid of a kept scan, with a margin [cells] inside."""
        found = np.zeros(cells.shape[1], bool)
        for _, where, extent in self._grids:
            found |= _moved([extent], where, corner)[0].holds(cells, margin)
        return found

    def earlier(self, stamp: float, corner: Corner, ages: Sequence[float]) -> list[EarlierScan]:
        """Return the scans whose ages are closest to some ages, aligned with a window.

        Cells that were outside the window of a scan are not occupied. None of the scans is newer than half the least
        of `ages`.
        """
        past = [scan for scan in self._scans if stamp - scan[0] >= min(ages) / 2]
        chosen = {min(range(len(past)), key=lambda k: math.fabs(stamp - past[k][0] - age)) for age in ages if past}
        return [
            EarlierScan(_shifted(mask, where, corner), stamp - then, _moved(extents, where, corner))
            for then, where, mask, extents in (past[k] for k in sorted(chosen))
        ]


def _moved(extents: Sequence[Extent], at: Corner, corner: Corner) -> tuple[Extent, ...]:
    """Return measurement grids that lie in a window with some corner as they lie in another window."""
    step = np.subtract(corner, at)
    return tuple(
        Extent(np.column_stack([affine[:, :2], affine[:, 2] + affine[:, :2] @ step]), shape)
        for affine, shape in extents
    )


def _shifted(mask: NDArray[np.bool_], at: Corner, corner: Corner) -> NDArray[np.bool_]:
    """Return the cells of a window with some corner; what the old one did not hold is False."""
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
