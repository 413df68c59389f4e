"""The states of cells, and grids of them."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from ogm.grid import EvidentialGrid, GridSpec

__all__ = ["CANVAS", "FREE", "IGNORE", "OCCUPIED", "UNKNOWN", "Shares", "Truth"]

UNKNOWN, FREE, OCCUPIED, IGNORE = 0, 1, 2, 3  # states of a cell, uint8

CANVAS = GridSpec.centered(
    length=99.84, width=99.84, resolution=0.16
)  # 624 x 624: any rotation of the paper's grid fits


class Shares(NamedTuple):
    """Shares of a grid's cells by state, each in [0, 1]; they sum to one."""

    free: float
    occupied: float
    unknown: float
    ignore: float


@dataclass(frozen=True, eq=False)
class Truth:
    """The true state of every cell, as far as it could be seen.

    Parameters
    ----------
    spec : GridSpec
    state : (nx, ny) uint8
        `UNKNOWN`, `FREE`, `OCCUPIED` or `IGNORE`. Not copied.

    Raises
    ------
    TypeError
        If `state` is not uint8.
    ValueError
        If its shape does not fit `spec`, or a value is none of the four.
    """

    spec: GridSpec
    state: NDArray[np.uint8]

    def __post_init__(self) -> None:
        if not isinstance(self.state, np.ndarray) or self.state.dtype != np.uint8:
            got = getattr(self.state, "dtype", type(self.state).__name__)
            raise TypeError(f"state must be a uint8 array, got {got}; convert it with .astype('uint8')")
        if self.state.shape != self.spec.shape:
            raise ValueError(f"state has shape {self.state.shape}, but the spec has {self.spec.shape} cells")
        if self.state.size and self.state.max() > IGNORE:
            raise ValueError(
                f"a state must be 0 unknown, 1 free, 2 occupied or 3 ignore, got {int(self.state.max())}"
            )

    @property
    def known(self) -> NDArray[np.bool_]:
        """Cells that are free or occupied, (nx, ny)."""
        return (self.state == FREE) | (self.state == OCCUPIED)

    @property
    def ignored(self) -> NDArray[np.bool_]:
        """Cells about which the truth makes no statement, (nx, ny): losses and metrics leave them out."""
        return self.state == IGNORE

    @cached_property
    def grid(self) -> EvidentialGrid:
        """The truth as belief masses: all on free or on occupied, none where unknown or ignored."""
        mass = np.stack([self.state == FREE, self.state == OCCUPIED], axis=-1).astype(np.float32)
        return EvidentialGrid.trusted(self.spec, mass)

    def shares(self) -> Shares:
        """Return how many of all cells are in each state.

        Published label statistics know no ignored cells: add `ignore` to `unknown` to compare.
        """
        counts = np.bincount(self.state.ravel(), minlength=4) / self.state.size
        return Shares(
            free=float(counts[FREE]),
            occupied=float(counts[OCCUPIED]),
            unknown=float(counts[UNKNOWN]),
            ignore=float(counts[IGNORE]),
        )

    def crop(self, spec: GridSpec, yaw: float = 0.0, dx: float = 0.0, dy: float = 0.0) -> "Truth":
        """Cut out a grid after turning and moving the scene, as one augments a sample.

        The scene turns about the sensor by `yaw`, then moves by (`dx`, `dy`): points are taken along with
        ``x' = cos(yaw) x - sin(yaw) y + dx`` and ``y' = sin(yaw) x + cos(yaw) y + dy``.

        Parameters
        ----------
        spec : GridSpec
            The grid to fill.
        yaw : float
            Counter-clockwise turn of the scene [rad].
        dx, dy : float
            Shift of the scene [m].

        Returns
        -------
        Truth
            Each cell has the state of the cell here that its middle comes from. Cells that come from outside
            are `IGNORE`: nobody looked there. `CANVAS` covers the 81.92 m x 56.32 m grid at any yaw.

        Raises
        ------
        ValueError
            If a number is not finite.
        """
        if not np.isfinite([yaw, dx, dy]).all():
            raise ValueError(f"yaw, dx and dy must be finite, got {yaw}, {dx}, {dy}")
        state = np.empty(spec.shape, np.uint8)
        _crop(
            state,
            np.ascontiguousarray(self.state),
            *(spec.resolution, *spec.origin),
            *(self.spec.resolution, *self.spec.origin),
            *(float(np.cos(yaw)), float(np.sin(yaw)), float(dx), float(dy)),
        )
        return Truth(spec, state)

    def mirrored(self) -> "Truth":
        """Return the scene seen in a mirror, left and right exchanged: y becomes -y."""
        x, y = self.spec.origin
        spec = GridSpec(self.spec.resolution, self.spec.shape, (x, -(y + self.spec.width)))
        return Truth(spec, np.ascontiguousarray(self.state[:, ::-1]))


@njit(cache=True, nogil=True)
def _crop(
    out: Any,
    state: Any,
    resolution: float,
    x0: float,
    y0: float,
    from_resolution: float,
    from_x0: float,
    from_y0: float,
    c: float,
    s: float,
    dx: float,
    dy: float,
) -> None:
    for ix in range(out.shape[0]):
        x = x0 + (ix + 0.5) * resolution - dx
        for iy in range(out.shape[1]):
            y = y0 + (iy + 0.5) * resolution - dy
            # A hair of a cell is added so that rounding does not decide where both grids' edges coincide
            u = np.floor((c * x + s * y - from_x0) / from_resolution + 1e-9)
            v = np.floor((c * y - s * x - from_y0) / from_resolution + 1e-9)
            inside = u >= 0 and v >= 0 and u < state.shape[0] and v < state.shape[1]
            out[ix, iy] = state[int(u), int(v)] if inside else 3
