"""Sensor models of radars by name, with field of view and errors of known sensors."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from ogm.grid import EvidentialGrid, GridSpec
from ogm.scan import InverseSensorModel, Mount, Scan
from ogm.simulation.radars import RADARS
from ogm.storage.files import OgmError

if TYPE_CHECKING:
    from ogm.deep import RadarNoise


RADAR, DEEP_RADAR = "radar", "deep-radar"
RADAR_MODELS = {  # name: description
    RADAR: "Detections of a radar: occupied ellipses, free sectors (RadarISM).",
    DEEP_RADAR: "The shipped network for radars (DeepRadarISM), trained on simulated sweeps.",
}
_NOISE = 0.2, math.radians(0.5)  # [m, rad] of unknown radars
_REACH = {"corner": {"reach": 35.0}}  # [m] with few occupied cells cleared in training towns; others: default


def load_radar_model(name: str, spec: GridSpec, mount: Mount | None = None) -> "RadarBySensor":
    """Return a sensor model of radars by name.

    Sensors named after one of `RADARS`, such as ``ars548-front``, have its numbers. `RadarISM` keeps moving objects:
    measurement grids contain them, and maps over time forget them.

    Parameters
    ----------
    name : str
        A name in `RADAR_MODELS`.
    spec : GridSpec
        Cells of the grids.
    mount : Mount, optional
        Mount of the sensor; by default `Scan.mount`.

    Raises
    ------
    OgmError
        If the name is unknown.
    ImportError
        If a package for the network is missing.
    """
    if name not in RADAR_MODELS:
        raise OgmError(f"a sensor model of radars must be one of {', '.join(RADAR_MODELS)}, got {name!r}")
    engine = None
    if name == DEEP_RADAR:
        from ogm.deep import DeepRadarISM

        engine = DeepRadarISM.load().engine
    return RadarBySensor(spec, mount, engine)


@dataclass(frozen=True)
class RadarBySensor:
    """Sensor model of radars with the numbers of each radar, by the name of its sensor.

    Parameters
    ----------
    spec : GridSpec
        Cells of the grids.
    mount : Mount, optional
        Mount of the sensor; by default `Scan.mount`.
    engine : RadarOnnxEngine, optional
        Engine of `DeepRadarISM`; `RadarISM` is used without it.
    """

    spec: GridSpec
    mount: Mount | None = None
    engine: Any = None

    def part(self, scan: Scan) -> InverseSensorModel:
        """Return the model for the sensor of a scan."""
        return _model(self, scan.sensor)

    def __call__(self, scan: Scan) -> EvidentialGrid:
        """Return the grid of a scan."""
        return self.part(scan)(scan)


@lru_cache(maxsize=16)
def _model(radar: RadarBySensor, sensor: str) -> InverseSensorModel:
    numbers = radar_numbers(sensor)
    if radar.engine is None:
        from ogm.geometric import RadarISM

        return RadarISM(radar.spec, radar.mount, keep_moving=True, **numbers)
    from ogm.deep import DeepRadarISM

    return DeepRadarISM(radar.engine, radar.spec, radar.mount, radar_noise(sensor))


def radar_numbers(sensor: str) -> dict[str, float]:
    """Return arguments of `RadarISM` for a sensor named after one of `RADARS`, such as ``ars548-front``."""
    kind = sensor.partition("-")[0]
    if kind not in RADARS:
        return {"half_width": math.radians(60), "range_noise": _NOISE[0], "azimuth_noise": _NOISE[1]}
    widest = RADARS[kind].widest
    along, across = widest.noise
    return {"half_width": widest.half_width, "range_noise": along, "azimuth_noise": across} | _REACH.get(kind, {})


def radar_noise(sensor: str) -> "RadarNoise":
    """Return field of view and errors of a radar for `DeepRadarISM` and its training, see `radar_numbers`."""
    from ogm.deep import RadarNoise

    numbers = radar_numbers(sensor)
    return RadarNoise(numbers["half_width"], azimuth_noise=numbers["azimuth_noise"])
