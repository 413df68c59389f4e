"""Detection of the ego vehicle in the scans of a drive: cells with returns that move with the sensor."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.frames import Footprint
from ogm.workflows.findings import Finding, counted

_SIDE = 0.2  # [m] of a cell
_RADIUS = 6.0  # [m] around the sensor
_MIN_PATH = 2.0  # [m] of the vehicle, for a result
_HIGH_SHARE, _LOW_SHARE = 0.9, 0.5  # of the scans
_PASSING_SHARE = 0.4  # greatest share of scans with returns in a cell that an obstacle passes through
_SIZE_RATIO = 1.5  # cells of a group at `_LOW_SHARE` per cell at `_HIGH_SHARE`
_MIN_HEIGHT = 0.15  # [m] above ground of returns of objects
_MARGIN = 0.1  # [m] around the cells of the vehicle
_MIN_COUNT = 3  # scans; and cells of an obstacle
_CAR = 1.0  # [m] least height of sensors on cars


class EgoChecks:
    """Counts of scans with returns in each cell around the sensor, over a drive."""

    def __init__(self) -> None:
        self.cells = round(2 * _RADIUS / _SIDE)
        self.scans = np.zeros((self.cells, self.cells), np.int64)
        self.masks: list[NDArray[np.bool_]] = []
        self.height = math.nan  # [m]
        self.positions: list[NDArray[np.float64]] = []

    def add(self, points: NDArray[np.floating], height: float, position: NDArray[np.float64] | None) -> None:
        """Add a scan.

        Parameters
        ----------
        points : (N, 3 or more) float
            Points in level axes around the sensor [m].
        height : float
            Height of the sensor above ground [m].
        position : (2,) float64 or None
            Position of the sensor on the map [m].
        """
        near = (np.abs(points[:, :2]) < _RADIUS).all(axis=1) & (points[:, 2] > _MIN_HEIGHT - height)
        near &= points[:, 2] < max(1.0, height)
        cell = ((points[near, :2] + _RADIUS) / _SIDE).astype(np.int64)
        mask = np.zeros((self.cells, self.cells), np.bool_)
        mask[cell[:, 0], cell[:, 1]] = True
        self.scans += mask
        self.masks.append(mask)
        self.height = height
        self.positions += [] if position is None else [position]

    @property
    def moved(self) -> bool:
        """Whether the vehicle moved far enough to recognise returns from itself."""
        if not len(self.positions) == len(self.masks) >= _MIN_COUNT:
            return False
        return float(np.ptp(self.positions, axis=0).max()) >= _MIN_PATH

    def _ego(self) -> NDArray[np.bool_]:
        """Return the cells that move with the vehicle.

        A static object that fills a cell in most scans is longer than the path. Its cells reach the border of the
        area that the path crosses, or the share of scans decreases along it.
        """
        half = round(min(_RADIUS, float(np.ptp(self.positions, axis=0).max()) / 2) / _SIDE)
        area = np.s_[self.cells // 2 - half : self.cells // 2 + half, self.cells // 2 - half : self.cells // 2 + half]
        scans = self.scans[area]
        frequent, occasional = (scans >= math.ceil(share * len(self.masks)) for share in (_HIGH_SHARE, _LOW_SHARE))
        ego, left = np.zeros_like(self.scans, np.bool_), {(int(i), int(j)) for i, j in np.argwhere(occasional)}
        while left:
            group = [left.pop()]
            waiting = list(group)
            while waiting:
                i, j = waiting.pop()
                around = {(i + a, j + b) for a in (-1, 0, 1) for b in (-1, 0, 1)} & left
                left -= around
                group += around
                waiting += around
            kept = [cell for cell in group if frequent[cell]]
            at_border = any(not 0 < index < 2 * half - 1 for cell in group for index in cell)
            if not at_border and len(group) <= _SIZE_RATIO * len(kept) + 2:
                for i, j in kept:
                    ego[area][i, j] = True
        return ego

    def footprint(self) -> Footprint | None:
        """Return the rectangle of the cells that move with the vehicle [m]; None if unknown, zeros without cells."""
        if not self.moved:
            return None
        rows, columns = np.nonzero(self._ego())
        if not len(rows):
            return 0.0, 0.0, 0.0, 0.0
        x, y = rows * _SIDE - _RADIUS, columns * _SIDE - _RADIUS
        box = x.min() - _MARGIN, x.max() + _SIDE + _MARGIN, y.min() - _MARGIN, y.max() + _SIDE + _MARGIN
        return tuple(round(float(edge), 2) for edge in box)  # type: ignore[return-value]

    def findings(self, used: Footprint, also: Footprint | None = None) -> Iterator[Finding]:
        """Yield findings about returns of the vehicle outside the footprint, and about obstacles within it.

        Parameters
        ----------
        used : (x_min, x_max, y_min, y_max)
            Footprint in use, around the sensor [m].
        also : (x_min, x_max, y_min, y_max), optional
            Second rectangle in which returns are dropped [m].
        """
        box, inside = self.footprint(), self._inside(used)
        size = f"the footprint of {used[1] - used[0]:.1f} m x {used[3] - used[2]:.1f} m"
        if box is None:
            if not self.masks:
                return
            posed = len(self.positions) == len(self.masks)
            reason = f"the vehicle moves less than {_MIN_PATH:g} m" if posed else "the scans have no poses"
            reason = reason if len(self.masks) >= _MIN_COUNT else "too few scans show the ground"
            text = f"{reason}, so that returns of the vehicle and obstacles are not distinguished"
            yield Finding("note", "ego footprint", text)
            if (dropped := int(np.count_nonzero(self.masks[-1] & inside))) > 1:
                text = f"returns in {dropped} cells within {size} are dropped as returns of the vehicle"
                severity = "wrong map" if self.height < _CAR else "note"
                yield Finding(severity, "ego footprint", text, "--ego-footprint X_MIN X_MAX Y_MIN Y_MAX")
            return
        way, ego = "--ego-footprint {:g} {:g} {:g} {:g}".format(*box), self._ego()
        unused = inside if also is None else inside | self._inside(also)
        if outside := np.count_nonzero(ego & ~unused):
            text = f"{outside} cells with returns outside the footprint move with the vehicle"
            yield Finding("wrong map", "ego returns", text, way)
        frequent = self.scans > _PASSING_SHARE * len(self.masks)  # such as parts of the vehicle that are not always hit
        others = inside & ~_grown(_grown(ego) | frequent)
        hidden = sum(int(np.count_nonzero(mask & others)) >= _MIN_COUNT for mask in self.masks)
        if hidden > 1:
            text = f"obstacles within {size} are dropped in {counted(hidden, len(self.masks))}"
            yield Finding("wrong map", "ego footprint", text, way)
        if not outside and hidden <= 1:
            area = f"x {box[0]:g} to {box[1]:g}, y {box[2]:g} to {box[3]:g} m" if ego.any() else "no cell"
            yield Finding("note", "ego footprint", f"returns that move with the vehicle fill {area}, within {size}")

    def _inside(self, box: Footprint) -> NDArray[np.bool_]:
        middle = (np.arange(self.cells) + 0.5) * _SIDE - _RADIUS
        along, across = (middle > box[0]) & (middle < box[1]), (middle > box[2]) & (middle < box[3])
        return along[:, None] & across[None, :]


def _grown(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the cells and their eight neighbours."""
    padded = np.pad(cells, 1)
    n, m = cells.shape
    grown: NDArray[np.bool_] = np.logical_or.reduce([padded[i : i + n, j : j + m] for i in range(3) for j in range(3)])
    return grown
