"""The base class of maps: a window that moves with the vehicle, a gate for scans, a lock, and views of the map.

`Mapper.update` is the same for all maps; each has its own `_fuse`.
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
    """A lock that its owner may take again, for ``with``.

    A copy of it, by `copy`, `pickle` or a spawned process, is a lock of its own, which is free. A process forks only
    while no other thread has a lock of a map, so that the maps of the child are whole and their locks free; it waits
    for that for at most `_PATIENCE`.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        with _registry:
            _all_locks.add(self)

    def __enter__(self) -> "MapLock":
        self._lock.acquire()
        return self

    def acquire(self, timeout: float) -> bool:
        """Take the lock; return whether it was free within some time [s]."""
        return self._lock.acquire(timeout=timeout)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._lock.release()

    def __reduce__(self) -> tuple[type["MapLock"], tuple[()]]:
        return MapLock, ()


_PATIENCE = 10.0  # [s] that a fork waits for a lock: longer than any update, and two threads may wait for each other
_all_locks: "weakref.WeakSet[MapLock]" = weakref.WeakSet()
_registry = threading.Lock()  # of the set; held for so short a time that nothing waits within
_at_fork: list[MapLock] = []


def locked(method: Callable[Concatenate[Any, P], R]) -> Callable[Concatenate[Any, P], R]:
    """Return a method that has the lock of its map while it runs."""

    @functools.wraps(method)
    def with_lock(self: Any, /, *args: P.args, **kwargs: P.kwargs) -> R:
        with self.lock:
            return method(self, *args, **kwargs)

    return with_lock


def _before_fork() -> None:
    with _registry:
        locks = list(_all_locks)
    _at_fork.extend(lock for lock in locks if lock.acquire(_PATIENCE))
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
    """A map that fuses the measurement grids of a moving vehicle, scan after scan.

    Parameters
    ----------
    window : Window
        The part of the world that the map holds.
    gate : UpdateGate
        Decides which scans are fused.

    Notes
    -----
    One thread may update the map while any number of others read it: each property and method returns a whole state,
    that before or after an update. Several values of one state are read with ``with mapper.lock:``.
    """

    lock: MapLock
    half_life: float | tuple[float, float]  # in which belief halves [s]; a pair is for free and for occupied

    def __init__(self, window: Window, gate: UpdateGate) -> None:
        self.lock, self._window, self._gate = MapLock(), window, gate

    @property
    @abstractmethod
    def grid(self) -> EvidentialGrid:
        """The map as masses (a copy), in map coordinates."""

    @property
    @abstractmethod
    def _layers(self) -> Sequence[NDArray[np.generic]]:
        """Arrays that are 0 in an empty map."""

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
        """Time of the map [s]: that of the newest scan."""
        return self._gate.stamp

    @property
    @locked
    def T_map_vehicle(self) -> NDArray[np.float64] | None:  # noqa: N802
        """Pose of the vehicle at that time, (4, 4)."""
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
            The measurement grid of a scan. Its extent and resolution are free: cells of the map take the masses at
            their centre, or, if the scan's cells are finer, the mean over the cell.
        T_map_sensor : (4, 4) array
            Takes the frame of `grid` to the map [m].
        stamp : float
            Time of the scan [s].
        T_vehicle_sensor : (4, 4) array, optional
            Pose of the frame of `grid` in the vehicle frame, of which there is one for all sensors: the window and the
            check for jumps follow the vehicle. By default both frames are the same.
        reliability : float
            Reliability of the sensor, [0, 1]: its masses are discounted by it.
        radial : RadialVelocities, optional
            Radial velocities of moving objects by Doppler, in the frame of `grid`, see
            `ogm.geometric.doppler.radial_velocities`. Only `DynamicMapper` uses them, except those of a late scan.
            Even without rows they mark a scan of sparse detections, whose cells are not matched.

        Raises
        ------
        TypeError
            If `grid` is no EvidentialGrid, or `radial` no RadialVelocities.
        PoseJump
            If the pose is further from the last one than `max_speed` allows.
        StampJump
            If the stamp is more than `max_delay` older than the map, or more than a day newer.
        ValueError
            If a pose is not rigid, leans by more than 45 degrees or holds NaN, a stamp breaks the rules of the mapper,
            the grid and the window have no cell in common, or the columns of `radial` do not fit together.
        """
        # Check masses, pose, stamp and the distance travelled; an error leaves the map as it was
        check_measurement(grid, reliability)
        scan = self._gate.check(self._window, grid.spec, T_map_sensor, stamp, T_vehicle_sensor)

        # Doppler in the axes of the map
        if radial is not None:
            if not isinstance(radial, RadialVelocities):
                raise TypeError(f"radial must be RadialVelocities, got {type(radial).__name__}")
            scan = scan._replace(radial=radial.checked().moved(np.asarray(T_map_sensor, np.float64)))

        # Scroll to the vehicle, age by the time since the last scan, combine, bound the certainty, note the conflict
        self._fuse(grid, scan, reliability)

        # The next scan is compared with this one
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
            The cells, in the vehicle's frame; by default as many as the window has, around the vehicle. To see all of
            them at any yaw the window must be a square as wide as their diagonal: `ogm.fusion.rolling_window`.
        T_map_vehicle : (4, 4) array, optional
            By default that of the newest scan.
        method : {"nearest", "area", "cautious"}
        """
        grid, (cells, T) = self.grid, self._around(spec, T_map_vehicle)
        return EvidentialGrid.trusted(cells, view_layers(grid.mass, grid.spec, cells, T, method))

    def opinion_at(self, points: ArrayLike, method: Sampling = "nearest") -> Opinion | NDArray[np.float32]:
        """Return the opinion of the map at any points of the map's frame; see `EvidentialGrid.opinion_at`."""
        return self.grid.opinion_at(np.asarray(points), method)

    @property
    @locked
    def conflict(self) -> LayeredGrid:
        """Recent contradictions between map and scans, [0, 1], on the cells of `grid`.

        The layer ``free_to_occupied`` is where the map was free and a scan occupied, ``occupied_to_free`` the reverse:
        the greatest conflict mass, which fades with time. `BinaryBayesMapper` has none.
        """
        return _conflict_grid(self.spec, self._conflict_layers())

    @locked
    def conflict_view(
        self,
        spec: GridSpec | None = None,
        T_map_vehicle: ArrayLike | None = None,  # noqa: N803
    ) -> LayeredGrid:
        """Return `conflict` in the vehicle's axes, by nearest cells. Arguments: see `view`."""
        cells, T = self._around(spec, T_map_vehicle)
        return _conflict_grid(cells, view_layers(self._conflict_layers(), self.spec, cells, T))

    def _conflict_layers(self) -> NDArray[np.float32]:
        """Return conflict free to occupied and occupied to free, (nx, ny, 2), in the order of the window's cells."""
        raise AttributeError(f"{type(self).__name__} keeps no conflict")

    def _around(
        self,
        spec: GridSpec | None,
        T_map_vehicle: ArrayLike | None,  # noqa: N803
    ) -> tuple[GridSpec, ArrayLike]:
        """Return cells and pose of a view: by default those around the vehicle of the newest scan."""
        T = self._gate.T_map_vehicle if T_map_vehicle is None else T_map_vehicle
        if T is None:
            raise ValueError("the map has no scan yet, and so no pose for a view; give T_map_vehicle")
        return spec or self._window.around, T


def _conflict_grid(spec: GridSpec, layers: NDArray[np.float32]) -> LayeredGrid:
    """Return conflict (nx, ny, 2) as named layers."""
    return LayeredGrid(spec, dict(zip(CONFLICT_LAYERS, np.moveaxis(layers, -1, 0), strict=True)))
