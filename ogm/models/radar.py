"""Sensor model of radars, with field of view and errors of known sensors."""

import math
from dataclasses import dataclass
from functools import lru_cache

from ogm.geometric import RadarISM
from ogm.grid import EvidentialGrid, GridSpec
from ogm.scan import Mount, Scan
from ogm.simulation.radars import RADARS

RADAR = "radar"
_NOISE = 0.2, math.radians(0.5)  # [m, rad] of unknown radars
_REACH = {"corner": {"reach": 35.0}}  # [m] with few occupied cells cleared in training towns; others: default


@dataclass(frozen=True)
class RadarBySensor:
    """`RadarISM` with the numbers of each radar, by the name of its sensor.

    Sensors named after one of `RADARS`, such as ``ars548-front``, have its numbers. Moving objects are kept:
    measurement grids contain them, and maps over time forget them.

    Parameters
    ----------
    spec : GridSpec
        Cells of the grids.
    mount : Mount, optional
        Mount of the sensor; by default `Scan.mount`.
    """

    spec: GridSpec
    mount: Mount | None = None

    def part(self, scan: Scan) -> RadarISM:
        """Return the model for the sensor of a scan."""
        return _model(self, scan.sensor)

    def __call__(self, scan: Scan) -> EvidentialGrid:
        """Return the grid of a scan."""
        return self.part(scan)(scan)


@lru_cache(maxsize=16)
def _model(radar: RadarBySensor, sensor: str) -> RadarISM:
    return RadarISM(radar.spec, radar.mount, keep_moving=True, **radar_numbers(sensor))


def radar_numbers(sensor: str) -> dict[str, float]:
    """Return arguments of `RadarISM` for a sensor named after one of `RADARS`, such as ``ars548-front``."""
    kind = sensor.partition("-")[0]
    if kind not in RADARS:
        return {"half_width": math.radians(60), "range_noise": _NOISE[0], "azimuth_noise": _NOISE[1]}
    widest = RADARS[kind].widest
    along, across = widest.noise
    return {"half_width": widest.half_width, "range_noise": along, "azimuth_noise": across} | _REACH.get(kind, {})
