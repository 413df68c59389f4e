"""What all maps share: how their window and last scan are read, and the view along the vehicle's axes.

`EvidentialMapper`, `BinaryBayesMapper` and `DynamicMapper` take these as their own properties and methods. All of them
have the map's `lock` while they run.
"""

from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.doppler import RadialVelocities
from ogm.fusion.map_lock import locked
from ogm.fusion.resample import ResampleMethod, view_layers
from ogm.grid import EvidentialGrid, GridSpec

__all__ = ["Forget", "T_map_vehicle", "reset", "scans", "spec", "stamp", "update", "view"]

Forget = Literal["everywhere", "observed"]


@property  # type: ignore[misc]
@locked
def spec(self: Any) -> GridSpec:
    """The window's cells now, in map coordinates."""
    spec: GridSpec = self._window.spec
    return spec


@property  # type: ignore[misc]
@locked
def stamp(self: Any) -> float | None:
    """Time of the map [s]: that of the newest scan."""
    stamp: float | None = self._gate.stamp
    return stamp


@property  # type: ignore[misc]
@locked
def T_map_vehicle(self: Any) -> NDArray[np.float64] | None:  # noqa: N802
    """Where the vehicle was at that time, (4, 4)."""
    T: NDArray[np.float64] | None = self._gate.T_map_vehicle
    return T


@property  # type: ignore[misc]
@locked
def scans(self: Any) -> int:
    """Number of scans in the map."""
    scans: int = self._gate.scans
    return scans


@locked
def update(
    self: Any,
    grid: EvidentialGrid,
    T_map_sensor: ArrayLike,  # noqa: N803
    *,
    stamp: float | None = None,
    T_vehicle_sensor: ArrayLike | None = None,  # noqa: N803
    reliability: float = 1.0,
    radial: RadialVelocities | None = None,
) -> None:
    """Age the map to a new scan's time and fuse its measurement grid.

    Parameters
    ----------
    grid : EvidentialGrid
        The measurement grid of a scan, in the frame that the next argument takes to the map. Its extent and
        resolution are free: cells of the map take the masses at their centre, or, if the scan's cells are finer,
        the mean over the cell.
    T_map_sensor : (4, 4) array
        Takes the grid's frame to the map [m].
    stamp : float
        When the scan was taken [s].
    T_vehicle_sensor : (4, 4) array, optional
        Where that frame sits on the vehicle, of which there is one for all sensors: the window and the check for
        jumps follow the vehicle. By default the frame is the vehicle's.
    reliability : float
        Of this sensor, [0, 1]: its masses are discounted by it.
    radial : RadialVelocities, optional
        What Doppler measured of things that move, in the frame of `grid`: see `ogm.doppler.radial_velocities`. Only
        `DynamicMapper` makes use of it, and not of a late scan's. Also without rows it marks a scan of sparse
        detections, whose cells are matched with none.

    Raises
    ------
    TypeError
        If `grid` is no EvidentialGrid, or `radial` no RadialVelocities.
    PoseJump
        If the pose is further from the last one than `max_speed` allows.
    ValueError
        If a pose is not rigid, leans by more than 45 degrees or holds NaN, a stamp breaks the rules of the mapper, or
        the grid and the window have no cell in common; or if the columns of `radial` do not fit together.
    """
    scan = self._gate.check(self._window, grid, T_map_sensor, stamp, T_vehicle_sensor, reliability)
    if radial is not None:
        if not isinstance(radial, RadialVelocities):
            raise TypeError(f"radial must be RadialVelocities, got {type(radial).__name__}; see ogm.doppler")
        scan = scan._replace(radial=radial.checked().moved(np.asarray(T_map_sensor, np.float64)))
    self._fuse(grid, scan, reliability)
    self._gate.accept(scan)


@locked
def reset(self: Any) -> None:
    """Forget everything: the next scan begins a new map."""
    for layer in self._layers:
        layer[:] = 0
    self._window.corner = (0, 0)
    self._gate.clear()


@locked
def view(
    self: Any,
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
    grid, cells = self.grid, spec or self._window.around
    T = self._gate.T_map_vehicle if T_map_vehicle is None else T_map_vehicle
    return EvidentialGrid.trusted(cells, view_layers(grid.mass, grid.spec, cells, T, method))
