"""Checks of the pose and time of a scan before it changes a map."""

import logging
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.fusion.window import Window, affine_between, overlaps, samples_per_axis
from ogm.geometric.doppler import RadialVelocities
from ogm.grid import CombinedGrid, EvidentialGrid, GridSpec, PartialGrid
from ogm.pose import check_pose, check_stamp, inverse

SLACK = 1.0  # [m] added to the distance that a vehicle may travel between two scans
TURN_RATE, TURN_SLACK = 2 * math.pi, 0.3  # greatest turn between two scans: [rad/s] of the time, plus [rad]
LONG_GAP = 60.0  # [s] a longer time without a scan logs a warning
MAX_GAP = 86_400.0  # [s] between two scans, beyond which stamps are refused

TOLERANCE = 1e-5  # of masses: rounding errors of sensor models
_ONE = np.float32(1).view(np.uint32)

_log = logging.getLogger(__name__)


class PoseJump(ValueError):
    """Pose beyond the reach of the vehicle since the last scan: a glitch of GNSS, or a closed loop."""


class StampJump(ValueError):
    """Stamp far before or after the time of the map: a wrong stamp, or a clock that was set."""


class CheckedScan(NamedTuple):
    """Scan that has passed the checks.

    Attributes
    ----------
    T_map_vehicle : (4, 4) float64
    elapsed : float
        Time since the last scan [s]; negative for a late scan.
    stamp : float or None
    corner : (int, int)
        Lattice index of the window's first cell, after the window has moved.
    affine : (2, 3) float64
        Takes cells of the window to cells of the grid.
    samples : int
        Sampling points per cell and axis.
    radial : RadialVelocities or None
        Radial velocities measured with the scan, in map coordinates.
    """

    T_map_vehicle: NDArray[np.float64]
    elapsed: float
    stamp: float | None
    corner: tuple[int, int]
    affine: NDArray[np.float64]
    samples: int
    radial: RadialVelocities | None = None


def check_measurement(grid: EvidentialGrid, reliability: float) -> None:
    """Raise an error unless a grid holds masses up to rounding and the reliability is in [0, 1].

    Grids of `EvidentialGrid.trusted`, and grids whose array was changed, have not been checked before.
    """
    if not isinstance(grid, EvidentialGrid):
        raise TypeError(
            f"a map is updated with an EvidentialGrid, got {type(grid).__name__}: first call a sensor model on the scan"
        )
    if isinstance(grid, PartialGrid):
        _check_masses(grid.known[1], grid.known[1].shape[:2])
    else:
        for mass in (grid.mass, *grid.parts) if isinstance(grid, CombinedGrid) else (grid.mass,):
            _check_masses(mass, grid.spec.shape)
    if not (isinstance(reliability, int | float | np.number) and 0 <= reliability <= 1):
        raise ValueError(f"reliability must be a number in [0, 1], got {reliability!r}")


def _check_masses(mass: NDArray[np.float32], shape: tuple[int, ...]) -> None:
    if mass.shape != (*shape, 2) or mass.dtype != np.float32:
        raise ValueError(f"the masses of the grid are {mass.dtype} {mass.shape}, wanted float32 {(*shape, 2)}")
    # As whole numbers, floats above 1, below 0 and NaN are all greater than 1: one pass, half the time of two.
    if mass.view(np.uint32).max() > _ONE and not (mass.min() >= -TOLERANCE and mass.max() <= 1 + TOLERANCE):
        raise ValueError(f"the masses of the grid must be in [0, 1], got {mass.min()} to {mass.max()}")
    flat = mass.reshape(-1)
    sums = flat[:-1] + flat[1:]  # even places hold free + occupied of a cell: four times faster than a strided sum
    above = np.flatnonzero(sums > 1 + TOLERANCE)
    cells = above[above & 1 == 0]
    if cells.size:
        raise ValueError(f"free and occupied of a cell must add up to 1 at most, got {sums[cells].max()}")


class UpdateGate:
    """Last scan that a map accepted, and the conditions for the next one.

    Parameters
    ----------
    max_speed : float
        Greatest speed of the vehicle [m/s].
    max_delay : float
        Greatest age of a scan relative to the map [s].
    needs_stamps : bool
        Whether the map forgets over time, so that scans without a stamp are refused.
    """

    max_speed: float
    max_delay: float
    needs_stamps: bool
    scans: int

    def __init__(self, max_speed: float, max_delay: float, needs_stamps: bool) -> None:
        if not max_speed > 0:
            raise ValueError(f"max_speed must be greater than 0 m/s, got {max_speed}; infinity allows every jump")
        if not (max_delay >= 0 and math.isfinite(max_delay)):
            raise ValueError(f"max_delay must be 0 s or more and finite, got {max_delay}")
        self.max_speed, self.max_delay, self.needs_stamps = float(max_speed), float(max_delay), needs_stamps
        self.clear()

    def clear(self) -> None:
        """Forget all scans."""
        self.stamp: float | None = None
        self.T_map_vehicle: NDArray[np.float64] | None = None
        self.scans = 0
        self._refused: tuple[float, NDArray[np.float64]] | None = None  # stamp and pose of the last jump

    def check(
        self,
        window: Window,
        grid: GridSpec,
        T_map_sensor: ArrayLike,
        stamp: float | None,
        T_vehicle_sensor: ArrayLike | None,
    ) -> CheckedScan:
        """Return the data for fusing a scan, or raise an error if it cannot be fused; the pose of a jump is kept."""
        T = vehicle = check_pose(T_map_sensor, "T_map_sensor").copy()  # the caller may change its array
        if T_vehicle_sensor is not None:
            vehicle = T @ inverse(check_pose(T_vehicle_sensor, "T_vehicle_sensor"))
        time = self._time(stamp)
        elapsed = 0.0 if time is None or self.stamp is None else time - self.stamp
        if elapsed < -self.max_delay:
            raise StampJump(
                f"stamp {time} s is {-elapsed:.6g} s older than the map ({self.stamp} s), at most "
                f"{self.max_delay:g} s are allowed: sort the scans by stamp; after a clock reset, begin a new map"
            )
        if elapsed > MAX_GAP:
            raise StampJump(
                f"stamp {time} s follows {self.stamp} s after a gap of {elapsed:.4g} s, at most {MAX_GAP:g} s are "
                "allowed: give stamps in seconds, and begin a new map for a new drive"
            )
        if time is not None:
            self._check_jump(vehicle, time)
        if elapsed > LONG_GAP:
            _log.warning("no scan for %.1f s: the map has aged by as much", elapsed)
        corner = window.corner_around(vehicle) if elapsed >= 0 else window.corner
        spec = window.spec_at(corner)
        affine = affine_between(spec, grid, T)
        if not overlaps(affine, spec, grid):
            x0, x1, y0, y1 = grid.extent
            raise ValueError(
                f"the grid, x {x0:g} to {x1:g} m and y {y0:g} to {y1:g} m around a sensor at "
                f"({T[0, 3]:g}, {T[1, 3]:g}) m, has no cell in the map's window: give T_map_sensor as the pose of the "
                "grid's own frame"
            )
        return CheckedScan(vehicle, elapsed, time, corner, affine, samples_per_axis(spec, grid))

    def accept(self, scan: CheckedScan) -> None:
        """Keep a scan for the check of the next, unless it is late."""
        self.scans += 1
        if scan.elapsed >= 0:
            self.stamp, self.T_map_vehicle = scan.stamp, scan.T_map_vehicle

    def _time(self, stamp: float | None) -> float | None:
        if stamp is None:
            if self.needs_stamps or self.stamp is not None:
                raise ValueError(
                    "the stamp is missing, but the map forgets over time: give stamp=... [s] with every scan, or make "
                    "the mapper with half_life=float('inf') and give no stamps at all"
                )
            return None
        return check_stamp(stamp)

    def _check_jump(self, vehicle: NDArray[np.float64], time: float) -> None:
        if self.T_map_vehicle is None or self.stamp is None or math.isinf(self.max_speed):
            return
        distance, turn = _between(self.T_map_vehicle, vehicle)
        seconds = abs(time - self.stamp)
        reachable = distance <= self.max_speed * seconds + SLACK and turn <= TURN_RATE * seconds + TURN_SLACK
        if reachable and self._refused is not None:
            # A refused jump comes within reach after some time. It remains a jump if the new pose is closer in motion
            # to the refused pose than to the accepted one.
            stamp, refused = self._refused
            distance_on, turn_on = _between(refused, vehicle)
            effort = (distance / self.max_speed + turn / TURN_RATE) / max(seconds, 1e-3)
            effort_on = (distance_on / self.max_speed + turn_on / TURN_RATE) / max(abs(time - stamp), 1e-3)
            reachable = effort <= effort_on
        if not reachable:
            self._refused = time, vehicle
            raise PoseJump(
                f"the pose jumps by {distance:.3g} m and {math.degrees(turn):.3g} degrees from the last accepted scan, "
                f"{seconds:.3g} s before (allowed: {self.max_speed:g} m/s): leave the scan out if it is a glitch; "
                "begin a new map after a closed loop"
            )
        self._refused = None


def _between(T: NDArray[np.float64], other: NDArray[np.float64]) -> tuple[float, float]:
    """Return the distance of two poses in the plane [m] and the angle between them [rad]."""
    trace = float((T[:3, :3] * other[:3, :3]).sum())  # of the rotation between the poses
    turn = math.acos(min(max((trace - 1) / 2, -1.0), 1.0))
    return math.dist(T[:2, 3].tolist(), other[:2, 3].tolist()), turn
