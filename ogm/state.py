"""States of cells: what the truth holds, and what a belief predicts."""

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.grid import EvidentialGrid, GridSpec

__all__ = ["PARTICIPANT", "CellState", "StateShares", "Truth", "predict_state"]

PARTICIPANT = 255  # in `Truth.height_cm`: the cell belongs to the box of a traffic participant
EPS_CELL = 1e-9  # [cells] added so that rounding does not decide where the edges of two grids coincide


class CellState(IntEnum):
    """The state of a cell, kept as uint8. Losses and metrics leave cells of state `IGNORE` out."""

    UNKNOWN = 0
    FREE = 1
    OCCUPIED = 2
    IGNORE = 3


class StateShares(NamedTuple):
    """Shares of a grid's cells by state, each in [0, 1]; they sum to one."""

    free: float
    occupied: float
    unknown: float
    ignore: float


def predict_state(mass: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return the state that each cell's masses predict: the greatest of free, occupied and unknown.

    A tie with unknown is unknown, a tie of free and occupied is occupied. Sums are taken in float64, so that
    rounding of float32 decides nothing.

    Parameters
    ----------
    mass : (..., 2) float array
        Masses of free and occupied.

    Returns
    -------
    (...) uint8
        `CellState.UNKNOWN`, `FREE` or `OCCUPIED`.
    """
    free, occupied = mass[..., 0].astype(np.float64), mass[..., 1].astype(np.float64)
    unknown = 1 - free - occupied
    is_free, is_occupied = (free > unknown) & (free > occupied), (occupied > unknown) & (occupied >= free)
    return is_free * np.uint8(CellState.FREE) + is_occupied * np.uint8(CellState.OCCUPIED)


@dataclass(frozen=True, eq=False)
class Truth:
    """The true state of every cell, as far as it could be observed.

    Parameters
    ----------
    spec : GridSpec
    state : (nx, ny) uint8
        Values of `CellState`. Not copied.
    height_cm : (nx, ny) uint8, optional
        Height above ground of the highest obstacle that was hit in each occupied cell [cm], up to the clearance;
        `PARTICIPANT` in all cells of a traffic participant's box; without meaning in other cells. None where heights
        are not known.

    Raises
    ------
    TypeError
        If `state` or `height_cm` is not uint8.
    ValueError
        If their shape does not fit `spec`, or a value is no `CellState`.
    """

    spec: GridSpec
    state: NDArray[np.uint8]
    height_cm: NDArray[np.uint8] | None = None

    def __post_init__(self) -> None:
        for name, array in (("state", self.state), ("height_cm", self.height_cm)):
            if name == "height_cm" and array is None:
                continue
            if not isinstance(array, np.ndarray) or array.dtype != np.uint8:
                got = getattr(array, "dtype", type(array).__name__)
                raise TypeError(f"{name} must be a uint8 array, got {got}; convert it with .astype('uint8')")
            if array.shape != self.spec.shape:
                raise ValueError(f"{name} has shape {array.shape}, but the spec has {self.spec.shape} cells")
        if self.state.size and self.state.max() > CellState.IGNORE:
            raise ValueError(f"a state must be 0 unknown, 1 free, 2 occupied or 3 ignore, got {int(self.state.max())}")

    @property
    def known(self) -> NDArray[np.bool_]:
        """Cells that are free or occupied, (nx, ny)."""
        return (self.state == CellState.FREE) | (self.state == CellState.OCCUPIED)

    @property
    def ignored(self) -> NDArray[np.bool_]:
        """Cells about which the truth makes no statement, (nx, ny): losses and metrics leave them out."""
        return self.state == CellState.IGNORE

    @cached_property
    def grid(self) -> EvidentialGrid:
        """The truth as belief masses: all on free or on occupied, none where unknown or ignored."""
        mass = np.stack([self.state == CellState.FREE, self.state == CellState.OCCUPIED], axis=-1)
        return EvidentialGrid.trusted(self.spec, mass.astype(np.float32))

    def shares(self) -> StateShares:
        """Return how many of all cells are in each state.

        Published label statistics have no ignored cells: add `ignore` to `unknown` to compare.
        """
        unknown, free, occupied, ignore = np.bincount(self.state.ravel(), minlength=4) / self.state.size
        return StateShares(float(free), float(occupied), float(unknown), float(ignore))

    def crop(self, spec: GridSpec, yaw: float = 0.0, dx: float = 0.0, dy: float = 0.0) -> "Truth":
        """Cut out a grid after turning and moving the scene, as one augments a sample.

        The scene turns about the sensor by `yaw`, then moves by (`dx`, `dy`): points move with it by
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
            are `IGNORE`. `ogm.truth.TRUTH_SPEC` covers the 81.92 m x 56.32 m grid at any yaw.

        Raises
        ------
        ValueError
            If a number is not finite.
        """
        if not np.isfinite([yaw, dx, dy]).all():
            raise ValueError(f"yaw, dx and dy must be finite, got {yaw}, {dx}, {dy}")
        c, s = float(np.cos(yaw)), float(np.sin(yaw))
        (nx, ny), (x0, y0) = spec.shape, spec.origin
        x = (x0 + (np.arange(nx) + 0.5) * spec.resolution - dx)[:, None]
        y = (y0 + (np.arange(ny) + 0.5) * spec.resolution - dy)[None, :]
        ix = _cells(c * x + s * y, self.spec.origin[0], self.spec.resolution)
        iy = _cells(c * y - s * x, self.spec.origin[1], self.spec.resolution)
        inside = (ix >= 0) & (iy >= 0) & (ix < self.spec.shape[0]) & (iy < self.spec.shape[1])
        at = ix[inside].astype(np.intp), iy[inside].astype(np.intp)
        state = np.full(spec.shape, np.uint8(CellState.IGNORE))
        state[inside] = self.state[at]
        if self.height_cm is None:
            return Truth(spec, state)
        height = np.zeros(spec.shape, np.uint8)
        height[inside] = self.height_cm[at]
        return Truth(spec, state, height)

    def mirrored(self) -> "Truth":
        """Return the scene with left and right exchanged: y becomes -y."""
        x, y = self.spec.origin
        spec = GridSpec(self.spec.resolution, self.spec.shape, (x, -(y + self.spec.width)))
        height = None if self.height_cm is None else np.ascontiguousarray(self.height_cm[:, ::-1])
        return Truth(spec, np.ascontiguousarray(self.state[:, ::-1]), height)


def _cells(x: NDArray[np.float64], x0: float, resolution: float) -> NDArray[np.float64]:
    """Return the cells that hold some coordinates; `EPS_CELL` decides where edges of two grids coincide."""
    x -= x0
    x /= resolution
    x += EPS_CELL
    return np.floor(x, out=x)
