"""The occupied cells of the last scans, in map coordinates."""

import math
from collections import deque
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Corner = tuple[int, int]


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
        self._scans: deque[tuple[float, Corner, NDArray[np.bool_]]] = deque()

    def clear(self) -> None:
        """Forget all scans."""
        self._scans.clear()

    def add(self, stamp: float, corner: Corner, occupied: NDArray[np.bool_]) -> None:
        """Keep a scan's occupied cells (nx, ny), with the lattice index of the first; those of one stamp are merged."""
        while self._scans and self._scans[0][0] < stamp - self.seconds:
            self._scans.popleft()
        if self._scans:
            newest, where, mask = self._scans[-1]
            if newest == stamp:
                self._scans[-1] = stamp, corner, occupied | _shifted(mask, where, corner)
                return
            if stamp - newest < self.spacing:
                return
        self._scans.append((stamp, corner, occupied))

    def earlier(self, stamp: float, corner: Corner, ages: Sequence[float]) -> list[tuple[NDArray[np.bool_], float]]:
        """Return the scans whose ages are closest to some ages, aligned with a window, and their ages [s].

        Cells that were outside the window of a scan are not occupied. None of the scans is newer than half the least
        of `ages`.
        """
        past = [scan for scan in self._scans if stamp - scan[0] >= min(ages) / 2]
        chosen = {min(range(len(past)), key=lambda k: math.fabs(stamp - past[k][0] - age)) for age in ages if past}
        return [(_shifted(past[k][2], past[k][1], corner), stamp - past[k][0]) for k in sorted(chosen)]


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
