"""Where a map lies in the world: cells that scroll by whole numbers, and grids that are looked up through poses."""

import math
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ogm.grid import GridSpec

__all__ = ["Kind", "Window", "affine_between", "cells_through", "flat", "meet", "samples_per_axis"]

Kind = Literal["rolling", "fixed"]
_MOST_TILT = 45.0  # [deg]
_MOST_SAMPLES = 8  # per cell and axis, for scans with much finer cells than the map


def flat(T: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the (2, 2) matrix and the (2,) shift that a rigid transform means for points of the grid's plane.

    The plane is projected along the vertical of the "to" frame: a grid in a tilted sensor's x and y shrinks by the
    cosine of the tilt, as the road under it does. The height of the ground below the frame is neglected.

    Raises
    ------
    ValueError
        If the z axis of `T` leans by more than 45 degrees: a grid seen from the side is no map.
    """
    if T[2, 2] < np.cos(np.radians(_MOST_TILT)):
        lean = np.degrees(np.arccos(np.clip(T[2, 2], -1, 1)))
        raise ValueError(
            f"a pose leans by {lean:.0f} degrees, at most {_MOST_TILT:g} are allowed; grids lie in x forward, y left "
            "with z up (REP 103): poses of a camera must be taken to such axes first"
        )
    return T[:2, :2], T[:2, 3]


def affine_between(spec: GridSpec, source: GridSpec, T_to_from: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what takes cell coordinates of `spec` ("to" frame) to those of `source` ("from" frame), (2, 3)."""
    A, b = flat(T_to_from)
    (p, q), (r, t) = A.tolist()
    det = p * t - q * r
    back = np.array([[t / det, -q / det], [-r / det, p / det]])
    return cells_through(spec, source, back, -back @ b)


def cells_through(
    spec: GridSpec, source: GridSpec, A: NDArray[np.float64], b: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the same, (2, 3), for points of `spec` that lie at ``A p + b`` in the frame of `source`."""
    shift = (A @ np.array(spec.origin) + b - np.array(source.origin)) / source.resolution
    return np.column_stack([A * (spec.resolution / source.resolution), shift])


def samples_per_axis(spec: GridSpec, source: GridSpec) -> int:
    """Return at how many points per cell and axis a grid of other cells is looked up: 1 unless its cells are finer."""
    return min(max(math.ceil(spec.resolution / source.resolution - 1e-6), 1), _MOST_SAMPLES)


def meet(affine: NDArray[np.float64], spec: GridSpec, source: GridSpec) -> bool:
    """Tell whether two grids overlap, given what `affine_between` them returned."""
    (a, b, c), (d, e, f) = affine.tolist()
    det = a * e - b * d
    back = (e / det, -b / det, (b * f - e * c) / det), (-d / det, a / det, (d * c - a * f) / det)
    # Two parallelograms meet unless one lies beyond a side of the other (separating axes).
    for rows, (nx, ny), sizes in (
        (((a, b, c), (d, e, f)), spec.shape, source.shape),
        (back, source.shape, spec.shape),
    ):
        for (i, j, k), size in zip(rows, sizes, strict=True):
            if k + min(i * nx, 0) + min(j * ny, 0) >= size or k + max(i * nx, 0) + max(j * ny, 0) <= 0:
                return False
    return True


class Window:
    """The part of the world that a map holds: a lattice of cells, and a ring buffer that moves over it.

    The lattice runs through the corner of `spec`, so a vehicle at the identity pose has exactly the cells of `spec`.
    A rolling window keeps the middle of `spec`, taken along with the vehicle, within half a cell of its own
    middle; a fixed one never moves. Contents are never resampled.

    Parameters
    ----------
    spec : GridSpec
        Cells and extent; its origin is relative to the vehicle if rolling, in map coordinates if fixed.
    kind : {"rolling", "fixed"}
    """

    def __init__(self, spec: GridSpec, kind: Kind) -> None:
        if kind not in get_args(Kind):
            raise ValueError(f"window must be one of {', '.join(get_args(Kind))}, got {kind!r}")
        self.given, self.kind = spec, kind
        self.corner = (0, 0)  # lattice index of the first cell

    @property
    def spec(self) -> GridSpec:
        """The cells now, in map coordinates."""
        return self.spec_at(self.corner)

    @property
    def around(self) -> GridSpec:
        """As many cells as the window has, in the vehicle's frame: those of a view if nobody says others."""
        if self.kind == "rolling":
            return self.given
        (nx, ny), side = self.given.shape, self.given.resolution
        return GridSpec(side, self.given.shape, (-nx * side / 2, -ny * side / 2))

    def spec_at(self, corner: tuple[int, int]) -> GridSpec:
        """Return the cells of a window with some corner, in map coordinates."""
        x, y = self.given.origin
        resolution = self.given.resolution
        i, j = corner
        return GridSpec(resolution, self.given.shape, (x + i * resolution, y + j * resolution))

    @property
    def ring(self) -> tuple[int, int]:
        """Row and cell of the buffer at which the window's cell (0, 0) stands."""
        return self.corner[0] % self.given.shape[0], self.corner[1] % self.given.shape[1]

    def corner_around(self, T_map_vehicle: NDArray[np.float64]) -> tuple[int, int]:
        """Return the corner that a window around a vehicle has."""
        if self.kind == "fixed":
            return self.corner
        A, b = flat(T_map_vehicle)
        ((p, q), (r, t)), (u, v) = A.tolist(), b.tolist()
        given = self.given
        x, y = given.origin[0] + given.length / 2, given.origin[1] + given.width / 2
        cells = (p * x + q * y + u - x) / given.resolution, (r * x + t * y + v - y) / given.resolution
        if max(abs(cells[0]), abs(cells[1])) > 2**52:
            raise ValueError(
                f"the vehicle at {b} m is too far from the map's origin for cells to be told apart"
            )
        return math.floor(cells[0] + 0.5), math.floor(cells[1] + 0.5)

    def move_to(self, corner: tuple[int, int], *arrays: NDArray[np.float32]) -> None:
        """Scroll, and clear the rows and columns of (nx, ny, ...) arrays that come into view."""
        for axis, size in enumerate(self.given.shape):
            step = corner[axis] - self.corner[axis]
            if step == 0:
                continue
            start = (self.corner[axis] + size if step > 0 else corner[axis]) % size
            stop = start + min(abs(step), size)
            for array in arrays:
                along = array if axis == 0 else array.swapaxes(0, 1)
                along[start:stop] = 0
                along[: max(stop - size, 0)] = 0
        self.corner = corner

    def unrolled(self, array: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return a copy of a buffer (nx, ny, ...) in the order of the window's cells."""
        row, column = self.ring
        return np.roll(array, (-row, -column), axis=(0, 1))
