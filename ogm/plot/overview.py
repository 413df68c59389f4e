"""Overviews of large grids: numbers as bytes, and levels of half the resolution that keep occupied cells.

Each level is made from the previous level. A block of 2 x 2 cells has

* the masses of its most occupied cell, if that cell is predicted occupied (`ogm.state.predict_state`), else the mean
  masses. An occupied cell is thus occupied at every level;
* the other numbers of the cell furthest from zero, which for a velocity is the fastest cell; no value only if all four
  cells have no value;
* the code of its first cell.

>>> import numpy as np
>>> from ogm.plot.overview import halve_mass, mass_to_bytes
>>> free = np.full((2, 2, 2), (0.8, 0.0), np.float32)
>>> free[0, 0] = 0.0, 0.9                                                   # one of four cells is occupied
>>> halve_mass(mass_to_bytes(free))[0, 0].tolist()
[0, 230]
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["FULL_MASS", "Steps", "halve_codes", "halve_mass", "halve_numbers", "mass_to_bytes"]

FULL_MASS = 255  # the byte of a mass of 1


def mass_to_bytes(mass: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return masses in steps of 1/255; errors are at most half a step for free and occupied, one step for unknown.

    Parameters
    ----------
    mass : (..., 2) float array
        Masses of free and occupied.

    Returns
    -------
    (..., 2) uint8
        Their sum is at most 255.
    """
    steps: NDArray[np.uint8] = np.rint(mass * np.float32(FULL_MASS)).astype(np.uint8)
    free, occupied = steps[..., 0], steps[..., 1]
    np.minimum(free, FULL_MASS - occupied, out=free)  # both of (0.5, 0.5) are rounded up
    return steps


def halve_mass(mass: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return masses at half the resolution; a block with a cell predicted occupied is occupied.

    Parameters
    ----------
    mass : (rows, columns, 2) uint8
        Masses of `mass_to_bytes`. At a far border of odd length, blocks have fewer cells.

    Returns
    -------
    (rows / 2, columns / 2, 2) uint8
        Rounded up.
    """
    cells = _blocks(mass)
    total = np.zeros((*cells[0].shape[:2], 2), np.uint16)
    greatest = np.zeros((*cells[0].shape[:2], 2), np.uint8)  # of cells predicted occupied
    for cell in cells:
        total += cell
        free, occupied = cell[..., 0], cell[..., 1]
        rest = FULL_MASS - occupied  # free and unknown, without overflow of bytes
        better = (occupied >= free) & (occupied > rest - free) & (occupied > greatest[..., 1])
        np.copyto(greatest, cell, where=better[..., None])
    mean = (total >> 2).astype(np.uint8)
    np.copyto(mean, greatest, where=greatest[..., 1:] > 0)
    return mean


class Steps(NamedTuple):
    """Numbers as bytes: 0 for no value (NaN), 1 to 255 in equal steps from `low` to `high`."""

    low: float
    high: float

    @classmethod
    def of(cls, *layers: NDArray[np.floating], symmetric: bool = False) -> "Steps":
        """Return steps for all finite numbers of layers; infinite numbers become the ends."""
        low, high = np.inf, -np.inf
        for layer in layers:
            for strip in np.array_split(layer, max(1, layer.size >> 22)):
                finite = strip[np.isfinite(strip)]
                low, high = (min(low, finite.min(initial=np.inf)), max(high, finite.max(initial=-np.inf)))
        if low > high:
            low = high = 0.0
        if symmetric:
            high = max(-low, high)
            low = -high
        return cls(float(low), float(high))

    @property
    def step(self) -> float:
        """Difference between neighbouring bytes; the error of a number is at most half of it."""
        return (self.high - self.low) / 254

    def to_bytes(self, numbers: NDArray[np.floating]) -> NDArray[np.uint8]:
        """Return numbers as bytes."""
        steps = (np.clip(numbers, self.low, self.high, dtype=np.float64) - self.low) / (self.step or 1.0)
        return np.where(np.isnan(steps), 0, 1 + np.rint(np.nan_to_num(steps))).astype(np.uint8)

    @property
    def numbers(self) -> NDArray[np.float64]:
        """Numbers of the 256 bytes; NaN first."""
        return np.concatenate([[np.nan], self.low + self.step * np.arange(255)])


def halve_numbers(values: NDArray[np.uint8], steps: Steps) -> NDArray[np.uint8]:
    """Return numbers at half the resolution, from the cell of each block that is furthest from zero.

    Parameters
    ----------
    values : (rows, columns, K) uint8
        K related numbers of each cell, such as the components of a velocity.
    steps : Steps
        Meaning of the bytes.

    Returns
    -------
    (rows / 2, columns / 2, K) uint8
        Rounded up.
    """
    size = np.nan_to_num(steps.numbers, nan=-1.0) ** 2  # of each byte
    size[0] = -1.0
    cells = _blocks(values)
    furthest, best = cells[0].copy(), size[cells[0]].sum(axis=-1)
    for cell in cells[1:]:
        distance = size[cell].sum(axis=-1)
        better = distance > best
        np.copyto(furthest, cell, where=better[..., None])
        np.copyto(best, distance, where=better)
    return furthest


def halve_codes(values: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return every second cell of every second row, as codes, such as causes of unknown cells, have no mean."""
    return values[::2, ::2]


def _blocks(cells: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], ...]:
    """Return the four cells of blocks of 2 x 2, each (rows / 2, columns / 2, ...); an odd far border is repeated."""
    odd = [(0, size % 2) for size in cells.shape[:2]]
    if any(more for _, more in odd):
        cells = np.pad(cells, [*odd, (0, 0)], mode="edge")
    return cells[::2, ::2], cells[::2, 1::2], cells[1::2, ::2], cells[1::2, 1::2]
