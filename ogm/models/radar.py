"""Sensor models of radars by name, with field of view and errors by the name of the sensor."""

import math
from collections.abc import Callable

from ogm.grid import GridSpec
from ogm.scan import InverseSensorModel, Mount
from ogm.simulation.radars import RADARS
from ogm.storage.files import OgmError

__all__ = ["DEEP_RADAR", "RADAR", "RADAR_MODELS", "radar_factory", "radar_numbers"]

RADAR, DEEP_RADAR = "radar", "deep-radar"
RADAR_MODELS = {  # name: description
    RADAR: "Detections of a radar: ellipses that mark, sectors that clear (RadarISM).",
    DEEP_RADAR: "The network of radar that ogm ships (DeepRadarISM), trained on simulated sweeps.",
}
_NOISE = 0.2, math.radians(0.5)  # [m, rad] of radars that are not known
_REACH = {"corner": {"reach": 35.0}}  # [m] for which few occupied cells are cleared in training towns; others: default


def radar_factory(name: str, spec: GridSpec) -> Callable[[Mount, str], InverseSensorModel]:
    """Return a function ``(mount, sensor) -> model`` for `ogm.scan.PerMount`; weights are read once.

    A sensor whose name begins as one of `RADARS`, such as ``ars548-front``, has its numbers. `RadarISM` keeps what
    moves: the map of a moment holds it, and maps over time forget.

    Parameters
    ----------
    name : str
        In `RADAR_MODELS`.
    spec : GridSpec
        The grid to fill.

    Raises
    ------
    OgmError
        If there is no such model.
    ImportError
        If a package for the network is missing.
    """
    if name == RADAR:
        from ogm.geometric import RadarISM

        def geometric(mount: Mount, sensor: str = "") -> InverseSensorModel:
            return RadarISM(spec, mount, keep_moving=True, **radar_numbers(sensor))

        return geometric
    if name != DEEP_RADAR:
        raise OgmError(f"there is no sensor model of radars {name!r}; there are {', '.join(RADAR_MODELS)}")
    from ogm.deep import DeepRadarISM, RadarNoise

    engine = DeepRadarISM.load().engine

    def learned(mount: Mount, sensor: str = "") -> InverseSensorModel:
        numbers = radar_numbers(sensor)
        noise = RadarNoise(numbers["half_width"], azimuth_noise=numbers["azimuth_noise"])
        return DeepRadarISM(engine, spec, mount, noise)

    return learned


def radar_numbers(sensor: str) -> dict[str, float]:
    """Return arguments of `RadarISM` for a sensor whose name begins as one of `RADARS`, such as ``ars548-front``."""
    kind = sensor.partition("-")[0]
    if kind not in RADARS:
        return {"half_width": math.radians(60), "range_noise": _NOISE[0], "azimuth_noise": _NOISE[1]}
    widest = RADARS[kind].widest
    along, across = widest.noise
    return {"half_width": widest.half_width, "range_noise": along, "azimuth_noise": across} | _REACH.get(kind, {})
