"""Position of a map in the world: a lattice that scrolls by whole cells, and affine maps between cells of two grids."""

import math
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ogm.grid import GridSpec

WindowMode = Literal["rolling", "fixed"]
_MAX_TILT = 45.0  # [deg]
_MAX_SAMPLES = 8  # per cell and axis, for scans with much finer cells than the map


def check_choice(name: str, value: Any, literal: Any) -> Any:
    """Return an argument that is one of the values of a Literal type, else raise ValueError."""
    if value not in get_args(literal):
        raise ValueError(f"{name} must be one of {', '.join(get_args(literal))}, got {value!r}")
    return value


def planar_transform(T: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the (2, 2) matrix and the (2,) shift of a rigid transform of points in a grid's plane.

    The plane is projected along the vertical of the "to" frame: a grid in the x and y of a tilted sensor shrinks by the
    cosine of the tilt, as the road below it does. The height of the ground below the frame is neglected.

    Raises
    ------
    ValueError
        If the z axis of `T` is tilted by more than 45 degrees.
    """
    if T[2, 2] < np.cos(np.radians(_MAX_TILT)):
        lean = np.degrees(np.arccos(np.clip(T[2, 2], -1, 1)))
        raise ValueError(
            f"a pose is tilted by {lean:.0f} degrees, at most {_MAX_TILT:g} are allowed: give poses of frames with x "
            "forward, y left, z up (REP 103); transform poses of a camera to such axes first"
        )
    return T[:2, :2], T[:2, 3]


def affine_between(spec: GridSpec, source: GridSpec, T_to_from: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the affine map from cells of `spec` ("to" frame) to cells of `source` ("from" frame), (2, 3)."""
    A, b = planar_transform(T_to_from)
    (p, q), (r, t) = A.tolist()
    det = p * t - q * r
    back = np.array([[t / det, -q / det], [-r / det, p / det]])
    return cell_transform(spec, source, back, -back @ b)


def cell_transform(
    spec: GridSpec, source: GridSpec, A: NDArray[np.float64], b: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the affine map, (2, 3), from cells of `spec` to cells of `source`, with ``A p + b`` between the frames."""
    shift = (A @ np.array(spec.origin) + b - np.array(source.origin)) / source.resolution
    return np.column_stack([A * (spec.resolution / source.resolution), shift])


def samples_per_axis(spec: GridSpec, source: GridSpec) -> int:
    """Return the number of sampling points per cell and axis in `source`: 1 unless its cells are finer."""
    return min(max(math.ceil(spec.resolution / source.resolution - 1e-6), 1), _MAX_SAMPLES)


def overlaps(affine: NDArray[np.float64], spec: GridSpec, source: GridSpec) -> bool:
    """Return whether two grids overlap, given the affine map between their cells."""
    (a, b, c), (d, e, f) = affine.tolist()
    det = a * e - b * d
    back = (e / det, -b / det, (b * f - e * c) / det), (-d / det, a / det, (d * c - a * f) / det)
    # Two parallelograms overlap unless one lies beyond a side of the other (separating axes).
    for rows, (nx, ny), sizes in ((((a, b, c), (d, e, f)), spec.shape, source.shape), (back, source.shape, spec.shape)):
        for (i, j, k), size in zip(rows, sizes, strict=True):
            if k + min(i * nx, 0) + min(j * ny, 0) >= size or k + max(i * nx, 0) + max(j * ny, 0) <= 0:
                return False
    return True


class Window:
    """Part of the world that a map covers: a lattice of cells, and a ring buffer that moves over it.

    The lattice passes through the corner of `spec`, so at the identity pose the window has exactly the cells of `spec`.
    A rolling window follows the vehicle: the middle of `spec`, moved with the vehicle, stays within half a cell of the
    middle of the window. A fixed window never moves. Contents are never resampled.

    Parameters
    ----------
    spec : GridSpec
        Cells and extent. The origin is relative to the vehicle if rolling, in map coordinates if fixed.
    mode : {"rolling", "fixed"}
    """

    spec0: GridSpec
    mode: WindowMode
    corner: tuple[int, int]

    def __init__(self, spec: GridSpec, mode: WindowMode) -> None:
        self.spec0, self.mode = spec, check_choice("window", mode, WindowMode)
        self.corner = (0, 0)  # lattice index of the first cell

    @property
    def spec(self) -> GridSpec:
        """The present cells, in map coordinates."""
        return self.spec_at(self.corner)

    @property
    def around(self) -> GridSpec:
        """Default cells of a view: as many as the window has, in the vehicle's frame."""
        if self.mode == "rolling":
            return self.spec0
        (nx, ny), side = self.spec0.shape, self.spec0.resolution
        return GridSpec(side, self.spec0.shape, (-nx * side / 2, -ny * side / 2))

    def spec_at(self, corner: tuple[int, int]) -> GridSpec:
        """Return the cells of the window at a corner, in map coordinates."""
        (x, y), side = self.spec0.origin, self.spec0.resolution
        return GridSpec(side, self.spec0.shape, (x + corner[0] * side, y + corner[1] * side))

    @property
    def ring(self) -> tuple[int, int]:
        """Row and column of the window's cell (0, 0) in the buffer."""
        return self.corner[0] % self.spec0.shape[0], self.corner[1] % self.spec0.shape[1]

    def corner_around(self, T_map_vehicle: NDArray[np.float64]) -> tuple[int, int]:
        """Return the corner of the window around a vehicle."""
        if self.mode == "fixed":
            return self.corner
        A, b = planar_transform(T_map_vehicle)
        ((p, q), (r, t)), (u, v) = A.tolist(), b.tolist()
        spec = self.spec0
        x, y = spec.origin[0] + spec.length / 2, spec.origin[1] + spec.width / 2
        cells = (p * x + q * y + u - x) / spec.resolution, (r * x + t * y + v - y) / spec.resolution
        if max(abs(cells[0]), abs(cells[1])) > 2**52:
            raise ValueError(
                f"the vehicle at {b} m is too far from the map's origin for float64 to number cells: give poses "
                "relative to a point near the drive"
            )
        return math.floor(cells[0] + 0.5), math.floor(cells[1] + 0.5)

    def move_to(self, corner: tuple[int, int], *arrays: NDArray[np.float32]) -> None:
        """Scroll to a corner, and clear the newly visible rows and columns of (nx, ny, ...) arrays."""
        for axis, size in enumerate(self.spec0.shape):
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
