"""The detections of a radar's sweeps, and where they were taken. Needs numpy only, as `ogm.simulation.sample` does."""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.scan import Scan
from ogm.simulation.arrays import Floats, Floats32

# columns of a detection in a data set, in this order; the first three are x, y, z in the sensor's frame
DETECTION = ("x", "y", "z", "doppler", "compensated", "rcs", "snr", "origin", "object")


class Origin(IntEnum):
    """What a detection is of."""

    OBJECT = 0  # anything that stands or moves where it is reported
    GROUND = 1
    GHOST = 2  # a real thing in a wrong place, by way of a mirror
    CLUTTER = 3  # noise


class RadarSweep(NamedTuple):
    """The detections of one sweep, in the sensor's frame.

    Attributes
    ----------
    xyz : (N, 3) float32
        [m]; z is 0 for a radar without elevation.
    doppler : (N,) float32
        Radial velocity against the sensor, positive away from it, folded into the unambiguous interval [m/s].
    compensated : (N,) float32
        The same over ground: of what stands still it is 0 but for noise, and for ghosts.
    rcs : (N,) float32
        Radar cross section [dBsm].
    snr : (N,) float32
        Signal-to-noise ratio [dB].
    origin : (N,) uint8
        `Origin`.
    object : (N,) int32
        Number of the moving thing in the list given to `Scene.place`; -1 for none.
    """

    xyz: Floats32
    doppler: Floats32
    compensated: Floats32
    rcs: Floats32
    snr: Floats32
    origin: NDArray[np.uint8]
    object: NDArray[np.int32]

    def scan(self, stamp: float | None = None, sensor: str = "", doppler_interval: float | None = None) -> Scan:
        """Return what a real radar gives: points with Doppler, against the sensor, and cross sections."""
        points = np.zeros((len(self.xyz), 4), np.float32)
        points[:, :3] = self.xyz
        return Scan(
            points, stamp=stamp, doppler=self.doppler, rcs=self.rcs, sensor=sensor, doppler_interval=doppler_interval
        )

    @property
    def table(self) -> Floats32:
        """The columns `DETECTION`, (N, 9)."""
        return np.column_stack([self.xyz, *self[1:]]).astype(np.float32)

    @classmethod
    def of_table(cls, table: Floats32) -> "RadarSweep":
        """Make from what `table` returned."""
        doppler, compensated, rcs, snr, origin, number = table[:, 3:].T
        return cls(table[:, :3], doppler, compensated, rcs, snr, origin.astype(np.uint8), number.astype(np.int32))


class PlacedSweep(NamedTuple):
    """A sweep of a data set.

    Attributes
    ----------
    radar : int
        Number of the radar in the plan.
    stamp : float
        [s]
    T_world_sensor : (4, 4) float64
    velocity : (3,) float64
        Of the sensor in the world's axes [m/s].
    detections : RadarSweep
        Its `object` are the tracks of the sample's objects; -1 for none.
    """

    radar: int
    stamp: float
    T_world_sensor: Floats
    velocity: Floats
    detections: RadarSweep
