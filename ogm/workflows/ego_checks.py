"""The ego vehicle in the scans of a drive: cells with returns that move with the sensor."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.frames import Footprint
from ogm.workflows.findings import Finding, counted

_SIDE = 0.2  # [m] of a cell
_REACH = 6.0  # [m] around the sensor
_WAY = 2.0  # [m] that the vehicle must move before anything is known
_OFTEN, _SELDOM = 0.9, 0.5  # of the scans
_PASSING = 0.4  # of the scans, at most, in a cell that an obstacle passes through
_FALL = 1.5  # cells of a group at `_SELDOM` for one at `_OFTEN`
_LOW = 0.15  # [m] above ground, from which on returns are of things
_MARGIN = 0.1  # [m] around the cells of the vehicle
_FEWEST = 3  # scans; and cells of an obstacle
_CAR = 1.0  # [m] height of sensors from which on they are those of cars


class EgoChecks:
    """Cells around the sensor that hold returns, counted over scans of a drive."""

    def __init__(self) -> None:
        self.cells = round(2 * _REACH / _SIDE)
        self.scans = np.zeros((self.cells, self.cells), np.int64)
        self.masks: list[NDArray[np.bool_]] = []
        self.height = math.nan  # [m]
        self.places: list[NDArray[np.float64]] = []

    def add(self, points: NDArray[np.floating], height: float, place: NDArray[np.float64] | None) -> None:
        """Add a scan.

        Parameters
        ----------
        points : (N, 3 or more) float
            In level axes around the sensor [m].
        height : float
            Of the sensor above ground [m].
        place : (2,) float64 or None
            Position of the sensor on the map [m].
        """
        near = (np.abs(points[:, :2]) < _REACH).all(axis=1) & (points[:, 2] > _LOW - height)
        near &= points[:, 2] < max(1.0, height)
        cell = ((points[near, :2] + _REACH) / _SIDE).astype(np.int64)
        mask = np.zeros((self.cells, self.cells), np.bool_)
        mask[cell[:, 0], cell[:, 1]] = True
        self.scans += mask
        self.masks.append(mask)
        self.height = height
        self.places += [] if place is None else [place]

    @property
    def moved(self) -> bool:
        """Whether the vehicle moved far enough to tell its own returns."""
        return len(self.places) == len(self.masks) >= _FEWEST and float(np.ptp(self.places, axis=0).max()) >= _WAY

    def _ego(self) -> NDArray[np.bool_]:
        """Return the cells that move with the vehicle.

        What stands still and fills a cell in most scans is longer than the way: it reaches the border of the area
        that the way crosses, or the share of scans falls off along it.
        """
        reach = min(_REACH, float(np.ptp(self.places, axis=0).max()) / 2)
        half = round(min(reach, _REACH) / _SIDE)
        area = np.s_[self.cells // 2 - half : self.cells // 2 + half, self.cells // 2 - half : self.cells // 2 + half]
        scans = self.scans[area]
        often, seldom = (scans >= math.ceil(share * len(self.masks)) for share in (_OFTEN, _SELDOM))
        ego, left = np.zeros_like(self.scans, np.bool_), {(int(i), int(j)) for i, j in np.argwhere(seldom)}
        while left:
            group = [left.pop()]
            waiting = list(group)
            while waiting:
                i, j = waiting.pop()
                around = {(i + a, j + b) for a in (-1, 0, 1) for b in (-1, 0, 1)} & left
                left -= around
                group += around
                waiting += around
            kept = [cell for cell in group if often[cell]]
            at_border = any(not 0 < index < 2 * half - 1 for cell in group for index in cell)
            if not at_border and len(group) <= _FALL * len(kept) + 2:
                for i, j in kept:
                    ego[area][i, j] = True
        return ego

    def footprint(self) -> Footprint | None:
        """Return the rectangle of the cells that move with the vehicle [m]; None if unknown, 0 0 0 0 without such."""
        if not self.moved:
            return None
        rows, columns = np.nonzero(self._ego())
        if not len(rows):
            return 0.0, 0.0, 0.0, 0.0
        x, y = rows * _SIDE - _REACH, columns * _SIDE - _REACH
        box = x.min() - _MARGIN, x.max() + _SIDE + _MARGIN, y.min() - _MARGIN, y.max() + _SIDE + _MARGIN
        return tuple(round(float(edge), 2) for edge in box)  # type: ignore[return-value]

    def findings(self, used: Footprint, also: Footprint | None = None) -> Iterator[Finding]:
        """Yield what the footprint that is used misses, and what it hides.

        Parameters
        ----------
        used : (x_min, x_max, y_min, y_max)
            Around the sensor [m].
        also : (x_min, x_max, y_min, y_max), optional
            Returns in it are dropped, too.
        """
        box, inside = self.footprint(), self._inside(used)
        size = f"the footprint of {used[1] - used[0]:.1f} m x {used[3] - used[2]:.1f} m"
        if box is None:
            if not self.masks:
                return
            why = f"it moves less than {_WAY:g} m" if len(self.places) == len(self.masks) else "the scans have no poses"
            why = why if len(self.masks) >= _FEWEST else "too few scans show the ground"
            yield Finding(
                "note", "ego footprint", f"{why}, so that returns of the vehicle and obstacles are not distinguished"
            )
            if (dropped := int(np.count_nonzero(self.masks[-1] & inside))) > 1:
                text = f"returns in {dropped} cells within {size} are dropped as those of the vehicle"
                severity = "wrong map" if self.height < _CAR else "note"
                yield Finding(severity, "ego footprint", text, "--ego-footprint X_MIN X_MAX Y_MIN Y_MAX")
            return
        way, ego = "--ego-footprint {:g} {:g} {:g} {:g}".format(*box), self._ego()
        unused = inside if also is None else inside | self._inside(also)
        if outside := np.count_nonzero(ego & ~unused):
            text = f"{outside} cells with returns outside of the footprint move with the vehicle"
            yield Finding("wrong map", "ego returns", text, way)
        often = self.scans > _PASSING * len(self.masks)  # as of parts of the vehicle that are not always hit
        others = inside & ~_grown(_grown(ego) | often)
        hidden = sum(int(np.count_nonzero(mask & others)) >= _FEWEST for mask in self.masks)
        if hidden > 1:
            text = f"obstacles within {size} are dropped in {counted(hidden, len(self.masks))}"
            yield Finding("wrong map", "ego footprint", text, way)
        if not outside and hidden <= 1:
            seen = f"x {box[0]:g} to {box[1]:g}, y {box[2]:g} to {box[3]:g} m" if ego.any() else "no cell"
            yield Finding("note", "ego footprint", f"returns that move with the vehicle fill {seen}, within {size}")

    def _inside(self, box: Footprint) -> NDArray[np.bool_]:
        middle = (np.arange(self.cells) + 0.5) * _SIDE - _REACH
        along, across = (middle > box[0]) & (middle < box[1]), (middle > box[2]) & (middle < box[3])
        return along[:, None] & across[None, :]


def _grown(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return cells with their eight neighbours."""
    padded = np.pad(cells, 1)
    n, m = cells.shape
    grown: NDArray[np.bool_] = np.logical_or.reduce([padded[i : i + n, j : j + m] for i in range(3) for j in range(3)])
    return grown
