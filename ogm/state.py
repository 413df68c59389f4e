"""States of cells: true states and predicted states.

>>> import numpy as np
>>> from ogm.state import CellState, predict_state
>>> [CellState(state).name for state in predict_state(np.array([[0.7, 0.1], [0.1, 0.7], [0.2, 0.2]]))]
['FREE', 'OCCUPIED', 'UNKNOWN']
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.grid import EvidentialGrid, GridSpec

__all__ = ["PARTICIPANT", "CellState", "LazyTruth", "Motion", "StateShares", "Truth", "predict_state"]

KERB = 15  # [cm] largest height of a kerb
PARTICIPANT = 255  # in `Truth.height_cm`: the cell belongs to the box of a traffic participant
EPS_CELL = 1e-9  # [cells] added so that rounding does not decide where the edges of two grids coincide


class CellState(IntEnum):
    """The state of a cell, kept as uint8. Losses and metrics leave cells of state `IGNORE` out."""

    UNKNOWN = 0
    FREE = 1
    OCCUPIED = 2
    IGNORE = 3


def kerb_state(state: CellState | str) -> CellState:
    """Return a state of kerbs by name, see `Truth.with_kerbs`; raise ValueError if there is no such state."""
    name = state.name if isinstance(state, CellState) else str(state).upper()
    if name not in CellState.__members__:
        known = ", ".join(member.lower() for member in CellState.__members__)
        raise ValueError(f"the state of kerbs must be one of {known}, got {state!r}")
    return CellState[name]


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
class Motion:
    """The true motion of every cell.

    Parameters
    ----------
    velocity : (nx, ny, 2) float32
        Velocity over ground of the object in the cell, ``v + ω × r``, along the grid's x and y [m/s]; 0 in cells
        without an object, NaN in cells of unknown motion.
    box : (nx, ny) int16
        Row of the object in `Frame.boxes`, which has its class; -1 in cells without an object.

    Raises
    ------
    TypeError
        If an array has another type.
    ValueError
        If the shapes do not agree.
    """

    velocity: NDArray[np.float32]
    box: NDArray[np.int16]

    def __post_init__(self) -> None:
        for name, array, dtype in (("velocity", self.velocity, np.float32), ("box", self.box, np.int16)):
            if not isinstance(array, np.ndarray) or array.dtype != dtype:
                got, wanted = getattr(array, "dtype", type(array).__name__), np.dtype(dtype).name
                raise TypeError(f"{name} must be a {wanted} array, got {got}; convert it with .astype('{wanted}')")
        if self.box.ndim != 2 or self.velocity.shape != (*self.box.shape, 2):
            raise ValueError(
                f"velocity must have shape (nx, ny, 2) and box (nx, ny), got {self.velocity.shape} and {self.box.shape}"
            )

    @property
    def known(self) -> NDArray[np.bool_]:
        """Cells with a known velocity, (nx, ny)."""
        return np.asarray(~np.isnan(self.velocity).any(axis=-1))

    @property
    def speed(self) -> NDArray[np.float32]:
        """Speed of every cell over ground [m/s], (nx, ny) float32; NaN where unknown."""
        return np.asarray(np.hypot(self.velocity[..., 0], self.velocity[..., 1]))


@dataclass(frozen=True, eq=False)
class Truth:
    """The true state of every cell, as far as it could be observed.

    Parameters
    ----------
    spec : GridSpec
    state : (nx, ny) uint8
        Values of `CellState`. Not copied.
    height_cm : (nx, ny) uint8, optional
        Height above ground of the highest obstacle hit in each cell [cm], up to the clearance; `PARTICIPANT` in all
        cells of a traffic participant's box; 0 in other cells. None if heights are unknown.
    motion : Motion, optional
        None if the motion of objects is unknown.

    Raises
    ------
    TypeError
        If `state` or `height_cm` is not uint8.
    ValueError
        If a shape does not fit `spec`, or a value is no `CellState`.
    """

    spec: GridSpec
    state: NDArray[np.uint8]
    height_cm: NDArray[np.uint8] | None = None
    motion: Motion | None = None

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
        motion = self.__dict__.get("motion")  # a LazyTruth finds its motion later
        if motion is not None and motion.box.shape != self.spec.shape:
            raise ValueError(f"motion has shape {motion.box.shape}, but the spec has {self.spec.shape} cells")

    def __repr__(self) -> str:
        shares = ", ".join(f"{name} {share:.1%}" for name, share in self.shares()._asdict().items())
        return f"Truth({self.spec}: {shares})"

    def __reduce__(self) -> tuple[Any, ...]:
        return Truth, (self.spec, self.state, self.height_cm, self.motion)  # motion as arrays, never as a function

    @property
    def known(self) -> NDArray[np.bool_]:
        """Cells that are free or occupied, (nx, ny)."""
        known: NDArray[np.bool_] = (self.state == CellState.FREE) | (self.state == CellState.OCCUPIED)
        return known

    @property
    def ignored(self) -> NDArray[np.bool_]:
        """Cells of state `IGNORE`, (nx, ny): losses and metrics leave them out."""
        ignored: NDArray[np.bool_] = self.state == CellState.IGNORE
        return ignored

    @property
    def kerbs(self) -> NDArray[np.bool_]:
        """Cells whose obstacle is at most 0.15 m high, as kerbs are, whatever their state, (nx, ny) bool.

        False everywhere if heights are unknown.
        """
        if self.height_cm is None:
            return np.zeros(self.spec.shape, np.bool_)
        kerbs: NDArray[np.bool_] = (self.height_cm > 0) & (self.height_cm <= KERB)
        return kerbs

    def with_kerbs(self, state: "CellState | str") -> "Truth":
        """Return the truth with another state in the cells of `kerbs`.

        A car can drive over a kerb, but should not: it is an edge of the road, neither free nor an obstacle.

        Parameters
        ----------
        state : CellState or str
            ``"occupied"``, as it is observed; ``"ignore"``, left out of losses and metrics; ``"unknown"``; ``"free"``.

        Raises
        ------
        ValueError
            If there is no such state.
        """
        wanted = kerb_state(state)
        if self.height_cm is None:
            return self
        changed = np.where(self.kerbs, np.uint8(wanted), self.state)
        return LazyTruth(self.spec, changed, self.height_cm, lambda: self.motion)

    @cached_property
    def grid(self) -> EvidentialGrid:
        """The truth as belief masses: 1 on free or on occupied, 0 on both in unknown and ignored cells."""
        mass = np.stack([self.state == CellState.FREE, self.state == CellState.OCCUPIED], axis=-1)
        return EvidentialGrid.trusted(self.spec, mass.astype(np.float32))

    def shares(self) -> StateShares:
        """Return the share of cells in each state.

        Published label statistics have no ignored cells: add `ignore` to `unknown` to compare.
        """
        unknown, free, occupied, ignore = np.bincount(self.state.ravel(), minlength=4) / self.state.size
        return StateShares(float(free), float(occupied), float(unknown), float(ignore))

    def crop(self, spec: GridSpec, yaw: float = 0.0, dx: float = 0.0, dy: float = 0.0) -> "Truth":
        """Cut out a grid after turning and moving the scene, as in data augmentation.

        The scene turns about the sensor by `yaw`, then moves by (`dx`, `dy`): points move with it by
        ``x' = cos(yaw) x - sin(yaw) y + dx`` and ``y' = sin(yaw) x + cos(yaw) y + dy``.

        Parameters
        ----------
        spec : GridSpec
            Cells of the result.
        yaw : float
            Counter-clockwise turn of the scene [rad].
        dx, dy : float
            Shift of the scene [m].

        Returns
        -------
        Truth
            Each cell has the state and motion of the original cell at its moved centre; velocities turn with the scene.
            Cells from outside the original grid are `IGNORE`, with unknown motion. `ogm.truth.TRUTH_SPEC` covers the
            81.92 m x 56.32 m grid at any yaw.

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
        cell = np.where(inside, ix * self.spec.shape[1] + iy, -1).astype(np.intp)

        def taken(values: NDArray[Any], outside: Any) -> NDArray[Any]:
            """Return the values (cells, ...) of the original cells."""
            rows = values.reshape(self.state.size, *values.shape[2:])
            return np.concatenate([rows, np.full_like(rows[:1], outside)])[cell]

        def cut(motion: Motion) -> Motion:
            vx, vy = np.moveaxis(taken(motion.velocity, np.nan), -1, 0)
            # no matrix product: BLAS would wait for its threads
            velocity = np.stack([c * vx - s * vy, s * vx + c * vy], axis=-1)
            return Motion(velocity, taken(motion.box, -1))

        state = taken(self.state, CellState.IGNORE)
        height = None if self.height_cm is None else taken(self.height_cm, 0)
        return self._changed(spec, state, height, cut)

    def mirrored(self) -> "Truth":
        """Return the scene with left and right exchanged: y becomes -y, also in velocities."""
        x, y = self.spec.origin
        spec = GridSpec(self.spec.resolution, self.spec.shape, (x, -(y + self.spec.width)))
        height = None if self.height_cm is None else np.ascontiguousarray(self.height_cm[:, ::-1])

        def mirror(motion: Motion) -> Motion:
            velocity = motion.velocity[:, ::-1] * np.array([1, -1], np.float32)
            return Motion(velocity, np.ascontiguousarray(motion.box[:, ::-1]))

        return self._changed(spec, np.ascontiguousarray(self.state[:, ::-1]), height, mirror)

    def _changed(
        self,
        spec: GridSpec,
        state: NDArray[np.uint8],
        height_cm: NDArray[np.uint8] | None,
        change: Callable[[Motion], Motion],
    ) -> "Truth":
        """Return a changed truth; its motion is changed at the first access."""
        return LazyTruth(spec, state, height_cm, lambda: None if self.motion is None else change(self.motion))


class LazyTruth(Truth):
    """Truth with motion that is computed at the first access and kept. Pickled, it becomes a `Truth`.

    Parameters
    ----------
    spec, state, height_cm
        See `Truth`.
    motion : function
        Takes no arguments and returns the motion or None.
    """

    def __init__(
        self,
        spec: GridSpec,
        state: NDArray[np.uint8],
        height_cm: NDArray[np.uint8] | None,
        motion: Callable[[], Motion | None],
    ) -> None:
        self.__dict__.update(spec=spec, state=state, height_cm=height_cm, _motion=motion)
        self.__post_init__()

    @cached_property
    def motion(self) -> Motion | None:
        """The true motion of every cell."""
        motion: Motion | None = self.__dict__["_motion"]()
        return motion


def _cells(x: NDArray[np.float64], x0: float, resolution: float) -> NDArray[np.float64]:
    """Return the cells at the coordinates `x`, which are overwritten; see `EPS_CELL`."""
    x -= x0
    x /= resolution
    x += EPS_CELL
    return np.floor(x, out=x)
