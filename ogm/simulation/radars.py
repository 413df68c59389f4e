"""Specifications of radars: field of view, resolution, reach.

>>> from ogm.simulation.radars import RADARS
>>> sorted(RADARS), max(mode.range_max for mode in RADARS["ars548"].modes)
(['ars408', 'ars548', 'corner'], 300.0)
"""

import math
from dataclasses import dataclass

__all__ = ["RADARS", "RadarMode", "RadarSpec"]


@dataclass(frozen=True)
class RadarMode:
    """A waveform of a radar, transmitted in turn with its other modes.

    Parameters
    ----------
    half_width : float
        Half the field of view in azimuth [rad], up to pi / 2.
    range_max : float
        Largest range [m].
    range_resolution, doppler_resolution, azimuth_resolution : float
        Resolution of range [m], radial velocity [m/s], and azimuth straight ahead [rad].
    reach : float
        Range at which a target of 0 dBsm straight ahead has a signal-to-noise ratio of 13 dB [m].
    range_min : float
        Smallest range [m].
    """

    half_width: float
    range_max: float
    range_resolution: float
    doppler_resolution: float
    azimuth_resolution: float
    reach: float
    range_min: float = 0.2

    def __post_init__(self) -> None:
        bounds = {"half_width": math.pi / 2, "range_max": 1000, "range_resolution": 20, "doppler_resolution": 20}
        for name, high in (bounds | {"azimuth_resolution": 1.0, "reach": 2000}).items():
            if not 0 < getattr(self, name) <= high:  # NaN fails too
                raise ValueError(f"{name} must be above 0 and at most {high:g}, got {getattr(self, name)}")
        if not 0 <= self.range_min < self.range_max:
            raise ValueError(f"range_min must be in 0 ... range_max, got {self.range_min}")

    @property
    def noise(self) -> tuple[float, float]:
        """Standard deviations of range [m] and azimuth [rad] for sensor models: a third of the resolution."""
        return max(self.range_resolution / 3, 0.1), self.azimuth_resolution / 3


@dataclass(frozen=True)
class RadarSpec:
    """An automotive radar; its x axis points ahead.

    Parameters
    ----------
    name : str
    modes : tuple of RadarMode
        Modes that together make one sweep.
    half_height : float
        Half the 3 dB width of the antenna in elevation [rad].
    elevation_resolution : float
        Resolution of elevation [rad]; 0 for a radar without elevation, which reports z = 0.
    velocity : (low, high)
        Interval of unambiguous radial velocities, positive away from the sensor [m/s]; others are folded into it.
    rate : float
        Sweeps per second [Hz].
    false_alarms : float
        Mean number of noise detections per sweep.
    max_detections : int
        Largest number of reported detections: the strongest are kept.
    min_rcs : float
        Smallest radar cross section of reported detections [dBsm].
    """

    name: str
    modes: tuple[RadarMode, ...]
    half_height: float
    elevation_resolution: float = 0.0
    velocity: tuple[float, float] = (-111.0, 55.0)
    rate: float = 13.0
    false_alarms: float = 4.0
    max_detections: int = 250
    min_rcs: float = -25.0

    def __post_init__(self) -> None:
        if not self.modes:
            raise ValueError(f"{self.name}: modes are empty, give at least one RadarMode")
        if not self.velocity[0] < 0 < self.velocity[1]:
            raise ValueError(f"{self.name}: velocity must be an interval around 0, got {self.velocity}")
        for name, low, high in (("half_height", 1e-3, 1.5), ("elevation_resolution", 0.0, 1.0), ("rate", 0.1, 1000.0)):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{self.name}: {name} must be in {low:g} ... {high:g}, got {getattr(self, name)}")
        if not 0 <= self.false_alarms <= 1e4 or self.max_detections < 1:
            raise ValueError(
                f"{self.name}: false_alarms must be in 0 ... 10000 and max_detections 1 or more, got "
                f"{self.false_alarms} and {self.max_detections}"
            )

    @property
    def widest(self) -> RadarMode:
        """The mode with the widest field of view, which represents the radar in sensor models."""
        return max(self.modes, key=lambda mode: mode.half_width)

    @property
    def doppler_interval(self) -> float:
        """Width of the interval of unambiguous radial velocities [m/s]."""
        return self.velocity[1] - self.velocity[0]


_DEGREE = math.pi / 180
_KMH = 1 / 3.6
# ARS408: fields of view, ranges, resolutions and velocities of the data sheet (near and far scan).
# ARS548: from descriptions and one recorded frame: standard deviations of 0.2 m, 0.25 m/s and 0.5 degrees, nothing
# below -20 dBsm, no ambiguity within 22.9 m/s, and a reach that fits its smallest cross sections, such as -10 dBsm at
# 120 m. Estimates: the other reaches, increased once until sweeps in training towns had the published numbers of
# detections; the false alarms; all parameters of the corner radar.
RADARS = {
    spec.name: spec
    for spec in (
        RadarSpec(
            "ars408",
            (
                RadarMode(9 * _DEGREE, 250.0, 1.79, 0.37 * _KMH, 1.6 * _DEGREE, 140.0),
                RadarMode(60 * _DEGREE, 70.0, 0.39, 0.43 * _KMH, 3.2 * _DEGREE, 50.0),
            ),
            half_height=9 * _DEGREE,
            velocity=(-400 * _KMH, 200 * _KMH),
            rate=13.0,
        ),
        RadarSpec(
            "ars548",
            (RadarMode(60 * _DEGREE, 300.0, 0.4, 0.2, 1.2 * _DEGREE, 180.0),),
            half_height=10 * _DEGREE,
            elevation_resolution=2.3 * _DEGREE,
            velocity=(-22.9, 22.9),
            rate=20.0,
            false_alarms=8.0,
            max_detections=800,
            min_rcs=-20.0,
        ),
        RadarSpec(
            "corner",
            (RadarMode(75 * _DEGREE, 80.0, 0.5, 0.2, 4 * _DEGREE, 40.0),),
            half_height=8 * _DEGREE,
            velocity=(-22.0, 22.0),
            rate=20.0,
            false_alarms=3.0,
        ),
    )
}
