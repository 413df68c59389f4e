"""Sensor models of radars by name, with field of view and errors by the name of the sensor."""

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
    RADAR: "Detections of a radar: ellipses that mark, sectors that clear (RadarISM).",
    DEEP_RADAR: "The network of radar that ogm ships (DeepRadarISM), trained on simulated sweeps.",
}
_NOISE = 0.2, math.radians(0.5)  # [m, rad] of radars that are not known
_REACH = {"corner": {"reach": 35.0}}  # [m] for which few occupied cells are cleared in training towns; others: default


def load_radar_model(name: str, spec: GridSpec, mount: Mount | None = None) -> "RadarBySensor":
    """Return a sensor model of radars by its name.

    A sensor whose name begins as one of `RADARS`, such as ``ars548-front``, has its numbers. `RadarISM` keeps what
    moves: the map of a moment holds it, and maps over time forget.

    Parameters
    ----------
    name : str
        In `RADAR_MODELS`.
    spec : GridSpec
        The grid to fill.
    mount : Mount, optional
        By default each scan's own.

    Raises
    ------
    OgmError
        If there is no such model.
    ImportError
        If a package for the network is missing.
    """
    if name not in RADAR_MODELS:
        raise OgmError(f"there is no sensor model of radars {name!r}; there are {', '.join(RADAR_MODELS)}")
    engine = None
    if name == DEEP_RADAR:
        from ogm.deep import DeepRadarISM

        engine = DeepRadarISM.load().engine
    return RadarBySensor(spec, mount, engine)


@dataclass(frozen=True)
class RadarBySensor:
    """A sensor model of radars that takes the numbers of each radar by the name of its sensor.

    Parameters
    ----------
    spec : GridSpec
        The grid to fill.
    mount : Mount, optional
        By default each scan's own.
    engine : RadarOnnxEngine, optional
        For `DeepRadarISM`; `RadarISM` without.
    """

    spec: GridSpec
    mount: Mount | None = None
    engine: Any = None

    def part(self, scan: Scan) -> InverseSensorModel:
        """Return the model for the sensor of a scan."""
        return _model(self, scan.sensor)

    def __call__(self, scan: Scan) -> EvidentialGrid:
        """Map one scan."""
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
    """Return arguments of `RadarISM` for a sensor whose name begins as one of `RADARS`, such as ``ars548-front``."""
    kind = sensor.partition("-")[0]
    if kind not in RADARS:
        return {"half_width": math.radians(60), "range_noise": _NOISE[0], "azimuth_noise": _NOISE[1]}
    widest = RADARS[kind].widest
    along, across = widest.noise
    return {"half_width": widest.half_width, "range_noise": along, "azimuth_noise": across} | _REACH.get(kind, {})


def radar_noise(sensor: str) -> "RadarNoise":
    """Return field of view and errors of a radar for `DeepRadarISM` and its training; see `radar_numbers`."""
    from ogm.deep import RadarNoise

    numbers = radar_numbers(sensor)
    return RadarNoise(numbers["half_width"], azimuth_noise=numbers["azimuth_noise"])
