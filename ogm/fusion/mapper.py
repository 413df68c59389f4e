"""Base class of maps: a window that moves with the vehicle, a gate for scans, a lock, and views of the map.

All maps share `Mapper.update`; each implements `_fuse`.
"""

import functools
import os
import threading
import weakref
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Concatenate, Literal, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.evidence import Opinion
from ogm.fusion.resample import ResampleMethod, view_layers
from ogm.fusion.update_gate import CheckedScan, UpdateGate, check_measurement
from ogm.fusion.window import Window
from ogm.geometric.doppler import RadialVelocities
from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid, Sampling

P = ParamSpec("P")
R = TypeVar("R")


class MapLock:
    """Reentrant lock of a map, for ``with``.

    A copy, by `copy`, `pickle` or a spawned process, is a new, free lock. A process forks only while no other thread
    holds the lock of a map, so that the maps of the child are consistent and their locks free. A fork waits at most
    `_FORK_TIMEOUT` for this.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        with _registry:
            _all_locks.add(self)

    def __enter__(self) -> "MapLock":
        self._lock.acquire()
        return self

    def acquire(self, timeout: float) -> bool:
        """Acquire the lock; return whether it became free within `timeout` [s]."""
        return self._lock.acquire(timeout=timeout)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._lock.release()

    def __reduce__(self) -> tuple[type["MapLock"], tuple[()]]:
        return MapLock, ()


_FORK_TIMEOUT = 10.0  # [s] a fork waits for a lock: longer than any update, but bounded in case of a deadlock
_all_locks: "weakref.WeakSet[MapLock]" = weakref.WeakSet()
_registry = threading.Lock()  # guards `_all_locks`; nothing waits while it is held
_at_fork: list[MapLock] = []


def locked(method: Callable[Concatenate[Any, P], R]) -> Callable[Concatenate[Any, P], R]:
    """Return a method that holds the lock of its map while it runs."""

    @functools.wraps(method)
    def with_lock(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> R:
        with self.lock:
            return method(self, *args, **kwargs)

    return with_lock


def _before_fork() -> None:
    with _registry:
        locks = list(_all_locks)
    _at_fork.extend(lock for lock in locks if lock.acquire(_FORK_TIMEOUT))
    _registry.acquire()


def _after_fork() -> None:
    _registry.release()
    while _at_fork:
        _at_fork.pop().__exit__(None, None, None)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_before_fork, after_in_parent=_after_fork, after_in_child=_after_fork)


Forget = Literal["everywhere", "observed"]
CONFLICT_LAYERS = ("free_to_occupied", "occupied_to_free")


class Mapper(ABC):
    """Map that fuses the measurement grids of a moving vehicle, scan after scan.

    Parameters
    ----------
    window : Window
        Part of the world that the map covers.
    gate : UpdateGate
        Check of scans before they are fused.

    Notes
    -----
    One thread may update the map while other threads read it. Each property and method returns a consistent state,
    from before or after an update. To read several values of the same state use ``with mapper.lock:``.
    """

    lock: MapLock
    half_life: float | tuple[float, float]  # [s] of belief; a pair is (free, occupied)

    def __init__(self, window: Window, gate: UpdateGate) -> None:
        self.lock, self._window, self._gate = MapLock(), window, gate

    @property
    @abstractmethod
    def grid(self) -> EvidentialGrid:
        """The map as masses (a copy), in map coordinates."""

    @property
    @abstractmethod
    def _layers(self) -> Sequence[NDArray[np.generic]]:
        """Arrays of the map; 0 in an empty map."""

    @abstractmethod
    def _fuse(self, grid: EvidentialGrid, scan: CheckedScan, reliability: float) -> None:
        """Scroll the window, age the map by ``scan.elapsed``, and combine it with a measurement grid."""

    @property
    @locked
    def spec(self) -> GridSpec:
        """The window's cells now, in map coordinates."""
        return self._window.spec

    @property
    @locked
    def stamp(self) -> float | None:
        """Time of the newest scan [s]."""
        return self._gate.stamp

    @property
    @locked
    def T_map_vehicle(self) -> NDArray[np.float64] | None:  # noqa: N802
        """Pose of the vehicle at the newest scan, (4, 4)."""
        return self._gate.T_map_vehicle

    @property
    @locked
    def scans(self) -> int:
        """Number of scans in the map."""
        return self._gate.scans

    @locked
    def update(
        self,
        grid: EvidentialGrid,
        T_map_sensor: ArrayLike,  # noqa: N803
        stamp: float | None = None,
        *,
        T_vehicle_sensor: ArrayLike | None = None,  # noqa: N803
        reliability: float = 1.0,
        radial: RadialVelocities | None = None,
    ) -> None:
        """Age the map to a new scan's time and fuse its measurement grid.

        Parameters
        ----------
        grid : EvidentialGrid
            Measurement grid of a scan, of any extent and resolution. A cell of the map takes the masses at its centre,
            or the mean over the cell if the cells of the scan are finer.
        T_map_sensor : (4, 4) array
            Takes the frame of `grid` to the map [m].
        stamp : float
            Time of the scan [s].
        T_vehicle_sensor : (4, 4) array, optional
            Pose of the frame of `grid` in the vehicle frame, which all sensors share. The window and the check for
            jumps follow the vehicle. By default both frames are the same.
        reliability : float
            Reliability of the sensor, [0, 1], by which masses are discounted.
        radial : RadialVelocities, optional
            Radial velocities of moving objects by Doppler, in the frame of `grid`, see
            `ogm.geometric.doppler.radial_velocities`. Only `DynamicMapper` uses them, except in late scans. Even
            without rows they mark a scan of sparse detections, which is not matched with other scans.

        Raises
        ------
        TypeError
            If `grid` is no EvidentialGrid, or `radial` no RadialVelocities.
        PoseJump
            If the pose is further from the last one than `max_speed` allows.
        StampJump
            If the stamp is more than `max_delay` older than the map, or more than a day newer.
        ValueError
            If a pose is not rigid, is tilted by more than 45 degrees or contains NaN, a stamp breaks the rules of the
            mapper, the grid and the window have no cell in common, or the columns of `radial` differ in length.
        """
        # Check masses, pose, stamp and the distance travelled; an error leaves the map as it was
        check_measurement(grid, reliability)
        scan = self._gate.check(self._window, grid.spec, T_map_sensor, stamp, T_vehicle_sensor)

        # Transform Doppler velocities to the axes of the map
        if radial is not None:
            if not isinstance(radial, RadialVelocities):
                raise TypeError(f"radial must be RadialVelocities, got {type(radial).__name__}")
            scan = scan._replace(radial=radial.checked().moved(np.asarray(T_map_sensor, np.float64)))

        # Scroll to the vehicle, age by the elapsed time, combine, bound the known mass, record the conflict
        self._fuse(grid, scan, reliability)

        # Keep the scan for the checks of the next one
        self._gate.accept(scan)

    @locked
    def reset(self) -> None:
        """Forget everything: the next scan begins a new map."""
        for layer in self._layers:
            layer[:] = 0
        self._window.corner = (0, 0)
        self._gate.clear()

    @locked
    def view(
        self,
        spec: GridSpec | None = None,
        T_map_vehicle: ArrayLike | None = None,  # noqa: N803
        *,
        method: ResampleMethod = "nearest",
    ) -> EvidentialGrid:
        """Return the map in the vehicle's axes, resampled once, by one of the methods of `ogm.fusion.warp`.

        Parameters
        ----------
        spec : GridSpec, optional
            Cells in the vehicle's frame; by default as many as the window has, around the vehicle. To cover all of them
            at any yaw, the window must be a square as wide as their diagonal: `ogm.fusion.rolling_window`.
        T_map_vehicle : (4, 4) array, optional
            Pose of the vehicle; by default that at the newest scan.
        method : {"nearest", "area", "cautious"}
        """
        grid, (cells, T) = self.grid, self._around(spec, T_map_vehicle)
        return EvidentialGrid.trusted(cells, view_layers(grid.mass, grid.spec, cells, T, method))

    def opinion_at(self, points: ArrayLike, method: Sampling = "nearest") -> Opinion | NDArray[np.float32]:
        """Return the opinion of the map at points in its frame, see `EvidentialGrid.opinion_at`."""
        return self.grid.opinion_at(np.asarray(points), method)

    @property
    @locked
    def conflict(self) -> LayeredGrid:
        """Recent contradictions between map and scans, [0, 1], on the cells of `grid`.

        Layer ``free_to_occupied``: the map was free and a scan occupied; ``occupied_to_free``: the reverse. Values are
        the greatest conflict mass, which fades with time. `BinaryBayesMapper` has no conflict.
        """
        return _conflict_grid(self.spec, self._conflict_layers())

    @locked
    def conflict_view(
        self,
        spec: GridSpec | None = None,
        T_map_vehicle: ArrayLike | None = None,  # noqa: N803
    ) -> LayeredGrid:
        """Return `conflict` in the vehicle's axes, by nearest cells. For the arguments see `view`."""
        cells, T = self._around(spec, T_map_vehicle)
        return _conflict_grid(cells, view_layers(self._conflict_layers(), self.spec, cells, T))

    def _conflict_layers(self) -> NDArray[np.float32]:
        """Return the conflict (free -> occupied, occupied -> free), (nx, ny, 2), in the order of the window's cells."""
        raise AttributeError(f"{type(self).__name__} keeps no conflict")

    def _around(
        self,
        spec: GridSpec | None,
        T_map_vehicle: ArrayLike | None,  # noqa: N803
    ) -> tuple[GridSpec, ArrayLike]:
        """Return cells and pose of a view, by default around the vehicle at the newest scan."""
        T = self._gate.T_map_vehicle if T_map_vehicle is None else T_map_vehicle
        if T is None:
            raise ValueError("the map has no scan yet, so a view has no default pose: give T_map_vehicle")
        return spec or self._window.around, T


def _conflict_grid(spec: GridSpec, layers: NDArray[np.float32]) -> LayeredGrid:
    """Return conflict (nx, ny, 2) as named layers."""
    return LayeredGrid(spec, dict(zip(CONFLICT_LAYERS, np.moveaxis(layers, -1, 0), strict=True)))
