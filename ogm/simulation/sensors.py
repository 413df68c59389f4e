"""Specifications of lidars and other range sensors: beam directions, ranges and accuracy.

>>> from ogm.simulation.sensors import LIDARS
>>> LIDARS["vlp-32c"].shape, LIDARS["vlp-32c"].directions().shape           # layers and columns of a turn
((32, 1800), (32, 1800, 3))
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np

from ogm.simulation.mesh import Floats, Floats32
from ogm.simulation.sample import Beams, shown_share

__all__ = ["LIDARS", "LidarSpec", "beams_of", "hd_directions"]


def _evenly(low: float, high: float, layers: int) -> list[float]:
    steps: list[float] = np.linspace(low, high, layers).tolist()
    return steps


def _zigzag(layers: int, near: float, far: float) -> list[float]:
    """Return azimuth offsets [deg] of layers from four columns of lasers that fire in turn."""
    return ([near, far, -near, -far] * layers)[:layers]


# Velodyne VLP-32C user manual: denser layers around the horizon, four columns of lasers.
_VLP_32C = (
    *(-25.0, -15.639, -11.31, -8.843, -7.254, -6.148, -5.333, -4.667, -4.0, -3.667, -3.333, -3.0, -2.667),
    *(-2.333, -2.0, -1.667, -1.333, -1.0, -0.667, -0.333, 0.0, 0.333, 0.667, 1.0, 1.333, 1.667, 2.333),
    *(3.333, 4.667, 7.0, 10.333, 15.0),
)
_VLP_32C_OFFSETS = (
    *(-1.4, 1.4, -1.4, 1.4, -1.4, 1.4, -4.2, -1.4, 1.4, 4.2, -4.2, -1.4, 1.4, 4.2, -4.2, -1.4),
    *(1.4, 4.2, -4.2, -1.4, 1.4, 4.2, -4.2, -1.4, 1.4, 4.2, -1.4, 1.4, -1.4, 1.4, -1.4, 1.4),
)
# Two VLP-32C, the lower one 0.119 m below and upside down, as on the cars of Argoverse 2: its elevations and offsets
# change their signs. In order of elevation, the upper sensor first for equal elevations.
_UPPER = [(e, 0, a) for e, a in zip(_VLP_32C, _VLP_32C_OFFSETS, strict=True)]
_PAIR = sorted(_UPPER + [(-e, 1, -a) for e, _, a in _UPPER])
# Velodyne VLS-128 (Alpha Prime): 0.11 degrees between layers from -6.5 to +4.83.
_VLS_128 = (
    *(-25.0, -19.582, -16.042, -13.565, -11.742, -10.346, -9.244, -8.352, -7.65, -7.15, -6.85, -6.65, -6.5),
    *(round(-6.39 + 0.11 * k, 2) for k in range(103)),
    *(4.98, 5.18, 5.43, 5.73, 6.08, 6.48, 6.98, 7.58, 8.43, 9.7, 11.75, 15.0),
)

# Hesai Pandar40P and Pandar64, user manuals (rounded): denser layers from -6 to +2 degrees. Offsets are approximate.
_PANDAR_40P = (-25.0, -19.0, *range(-14, -6), *_evenly(-6, 2, 25), 3.0, 5.0, 8.0, 11.0, 15.0)
_PANDAR_64 = (-25.0, -19.0, *range(-14, -6), *_evenly(-6, 2, 49), 3.0, 5.0, 8.0, 11.0, 15.0)
# Hesai OT128 and QT128 as measured on a real unit of each for layers with returns, and evenly spaced elsewhere.
_OT_128 = (
    *(-24.7, -23.0, -21.6, -20.3, -19.67, -19.0, -18.33, -17.64),
    *(*_evenly(-17.29, -6.29, 31), *_evenly(-5.91, 1.97, 64), *_evenly(2.4, 15.1, 25)),
)
_QT_128 = (
    *(*_evenly(-52.6, -5.1, 50), *_evenly(-4.25, 18.76, 29)),
    *(*_evenly(19.19, 36.08, 36), *_evenly(37.14, 52.63, 13)),
)

# Elevations and azimuth offsets [deg], the step between columns [rad], and parameters that differ from the defaults.
PATTERNS: dict[str, tuple[Sequence[float], Sequence[float], float, dict[str, Any]]] = {
    "vlp-32c": (_VLP_32C, _VLP_32C_OFFSETS, math.radians(0.2), {}),
    "dual-vlp-32c": ([e for e, _, _ in _PAIR], [a for _, _, a in _PAIR], math.radians(0.2),
        {"origins": tuple((0.0, 0.0, -0.119 * lower) for _, lower, _ in _PAIR), "height": 2.0}),
    "hdl-32e": (_evenly(-30.67, 10.67, 32), [0.0] * 32, 2 * math.pi / 1085,
        {"rate": 20.0, "range_max": 100.0, "reach": 165.0, "range_noise": 0.004, "range_step": 0.002}),
    "hdl-64e": ([*_evenly(-24.33, -8.83, 32), *_evenly(-8.33, 2.0, 32)], [-3.5, 3.5] * 32, 2 * math.pi / 2083,
        {"range_min": 0.9, "range_max": 120.0, "reach": 180.0, "range_noise": 0.008, "range_step": 0.002,
         "divergence": 0.002, "height": 1.73}),
    "vls-128": (_VLS_128, [0.0] * 128, math.radians(0.2), {"range_max": 245.0, "reach": 305.0, "range_noise": 0.008}),
    "os1-64": (_evenly(-22.5, 22.5, 64), [3.16, 1.05, -1.05, -3.16] * 16, 2 * math.pi / 1024,
        {"range_max": 120.0, "reach": 165.0, "range_noise": 0.012, "range_step": 0.003, "divergence": 0.0023}),
    # Velodyne VLP-16: 2 degrees between layers.
    "vlp-16": (_evenly(-15, 15, 16), [0.0] * 16, math.radians(0.2), {"range_max": 100.0, "reach": 150.0}),
    # Hesai PandarXT-32: 1 degree between layers.
    "xt32": (_evenly(-16, 15, 32), [0.0] * 32, math.radians(0.18), {"range_min": 0.3, "range_max": 120.0,
        "reach": 200.0, "range_noise": 0.006}),
    "pandar40p": (_PANDAR_40P, _zigzag(40, 1.042, 3.257), math.radians(0.2), {"range_min": 0.5, "reach": 200.0,
        "range_noise": 0.01}),
    "pandar64": (_PANDAR_64, _zigzag(64, 1.042, 3.257), math.radians(0.2), {"range_min": 0.5, "reach": 200.0,
        "range_noise": 0.01}),
    "ot128": (_OT_128, [0.0] * 128, math.radians(0.2), {"range_min": 0.5, "range_max": 230.0, "reach": 250.0,
        "range_noise": 0.01}),
    "os1-128": (_evenly(-22.5, 22.5, 128), [4.23, 1.41, -1.41, -4.23] * 32, 2 * math.pi / 1024,
        {"range_max": 120.0, "reach": 165.0, "range_noise": 0.012, "range_step": 0.003, "divergence": 0.0023}),
    # Hesai QT128: a wide field of view for the blind zone around a vehicle; 20 m at 10 % reflectivity.
    "qt128": (_QT_128, [0.0] * 128, math.radians(0.4), {"range_min": 0.1, "range_max": 60.0,
        "reach": 70.0, "range_noise": 0.015, "divergence": 0.007}),
    # Hesai AT128, modelled as rotating: it fires 120 degrees (`LidarMount.view`), with 0.2 degrees between layers.
    "at128": (_evenly(-12.36, 13.04, 128), [0.0] * 128, math.radians(0.1), {"range_min": 0.5, "reach": 250.0,
        "range_noise": 0.012, "divergence": 0.0017, "height": 1.7}),
}  # fmt: skip


_BOUNDS: dict[str, tuple[float, float]] = {  # lowest and highest value of a `LidarSpec`
    "azimuth_step": (1e-4, 0.2), "rate": (0.1, 200), "range_min": (0, 50), "reach": (1, 5000), "range_noise": (0, 1),
    "range_bias": (0, 1), "gain_spread": (0, 2), "range_step": (1e-5, 1), "divergence": (0, 0.1), "height": (0.05, 20),
}  # fmt: skip


@dataclass(frozen=True)
class LidarSpec:
    """A spinning lidar, a planar laser or a depth camera.

    A lidar turns clockwise, seen from above, as Velodyne's and Ouster's do. A turn begins straight behind, so that
    the sensor faces ahead in the middle of it. Other sensors: see `ogm.simulation.robot_sensors`.

    Parameters
    ----------
    name : str
    elevations : tuple of float
        Elevation of each layer above the sensor's xy plane [rad], ascending; equal values may follow each other.
    azimuth_offsets : tuple of float
        Azimuth of each layer relative to its column, positive to the left [rad].
    azimuth_step : float
        Angle between columns [rad]; a whole number of columns makes a turn. For a depth camera the inverse focal length
        [1/pixel]: its columns are evenly spaced in the image.
    rate : float
        Rotation rate [Hz].
    range_min, range_max : float
        Limits of the range [m]; surfaces outside give no return.
    reach : float
        Range at which half the returns of a matt white target, hit head-on, are lost [m]. For a share R of its
        reflectivity this happens at reach * sqrt(R).
    range_noise : float
        Standard deviation of the range of a strong return between shots [m].
    range_bias : float
        Standard deviation of the fixed error of each layer [m]. A data sheet's "accuracy" holds both.
    gain_spread : float
        Standard deviation of the logarithm of each layer's fixed gain.
    range_step : float
        Ranges are whole multiples of this [m].
    divergence : float
        Full angle of the beam [rad].
    height : float
        Usual height of the sensor above the ground [m].
    origins : tuple of (x, y, z)
        Start of each layer's beams in the sensor frame [m]; empty for (0, 0, 0).
    unit : int
        Number of the unit, 0 or more, which seeds its fixed errors and gains.
    elevation_errors : tuple of float
        Elevation error of each layer's beams [rad], while points are reported at `elevations`; empty for no errors.
    range_errors : tuple of float
        Fixed range error of each layer [m]; empty to draw it by `range_bias` and `unit`.
    kind : {"", "planar", "depth"}
        See `ogm.scan.Scan.kind`; "" for lidars.
    columns : int
        Number of columns of a sensor that covers a sector, half of them on each side; 0 for a whole turn.
    noise_growth : float
        Standard deviation of depths over squared depth [1/m], for depth cameras.
    forward : float
        Usual position ahead of the middle of the vehicle [m].

    Raises
    ------
    TypeError
        If a parameter per layer is not a tuple.
    ValueError
        If a parameter is out of range or does not fit the number of layers.
    """

    name: str
    elevations: tuple[float, ...]
    azimuth_offsets: tuple[float, ...]
    azimuth_step: float
    rate: float = 10.0
    range_min: float = 0.7
    range_max: float = 200.0
    reach: float = 185.0
    range_noise: float = 0.005
    range_bias: float = 0.012
    gain_spread: float = 0.25
    range_step: float = 0.004
    divergence: float = 0.003
    height: float = 1.9
    origins: tuple[tuple[float, float, float], ...] = ()
    unit: int = 0
    elevation_errors: tuple[float, ...] = ()
    range_errors: tuple[float, ...] = ()
    kind: str = ""
    columns: int = 0
    noise_growth: float = 0.0
    forward: float = 0.0

    def __post_init__(self) -> None:
        layers = len(self.elevations)
        for name in ("elevations", "azimuth_offsets", "origins", "elevation_errors", "range_errors"):
            values = getattr(self, name)
            if not isinstance(values, tuple):
                raise TypeError(
                    f"{self.name}: {name} must be a tuple, one entry per layer, got {type(values).__name__}"
                )
            if len(values) != layers and (values or name in ("elevations", "azimuth_offsets")):
                raise ValueError(f"{self.name}: {name} must have one entry per layer, {layers}, got {len(values)}")
            if not np.isfinite(np.hstack((0.0, *values))).all():
                raise ValueError(f"{self.name}: {name} must be finite, got NaN or inf in {values}")
        if not layers:
            raise ValueError(f"{self.name}: elevations are empty, give at least one layer")
        if any(len(origin) != 3 for origin in self.origins):
            raise ValueError(f"{self.name}: origins must be empty or one (x, y, z) per layer, got {self.origins}")
        if max(map(abs, self.elevations)) > math.pi / 2:
            raise ValueError(
                f"{self.name}: elevations must be in -pi/2 ... pi/2 rad, got {self.elevations}; convert degrees"
            )
        if sorted(self.elevations) != list(self.elevations):
            raise ValueError(f"{self.name}: elevations must ascend from the lowest layer; sort them with their offsets")
        if isinstance(self.unit, bool) or not isinstance(self.unit, (int, np.integer)) or self.unit < 0:
            raise ValueError(f"{self.name}: unit must be a whole number >= 0, got {self.unit!r}")
        for name, (low, high) in (_BOUNDS | {"range_max": (self.range_min, 2000)}).items():
            if not low <= getattr(self, name) <= high:  # NaN fails too
                raise ValueError(f"{self.name}: {name} must be in {low:g} ... {high:g}, got {getattr(self, name)}")
        if self.kind not in ("", "planar", "depth"):
            raise ValueError(f'{self.name}: kind must be "", "planar" or "depth", got {self.kind!r}')
        columns = 2 * math.pi / self.azimuth_step
        if self.columns or self.kind == "depth":
            if not 2 <= self.columns <= (math.inf if self.kind == "depth" else columns + 1e-6):
                raise ValueError(f"{self.name}: columns must be at least 2 and fit in a turn, got {self.columns}")
        elif abs(columns - round(columns)) > 1e-6 * columns:
            raise ValueError(
                f"{self.name}: azimuth_step must divide a full turn, got 2 * pi / {columns:.6g}; use 2 * pi / "
                f"{round(columns)}"
            )

    @property
    def layers(self) -> int:
        """Number of layers."""
        return len(self.elevations)

    @property
    def azimuths(self) -> int:
        """Number of columns: firings of each layer in a turn or sector."""
        return self.columns or round(2 * math.pi / self.azimuth_step)

    @property
    def shape(self) -> tuple[int, int]:
        """Number of layers and columns of a range image."""
        return self.layers, self.azimuths

    @cached_property
    def times(self) -> Floats:
        """Firing time of each column [s], (azimuths,); 0 in the middle of the turn, and for all columns of an image."""
        times = ((np.arange(self.azimuths) + 0.5) / self.azimuths - 0.5) / self.rate
        return times if not self.columns else times * shown_share(self.kind, self.columns, self.azimuth_step)

    @cached_property
    def errors(self) -> tuple[Floats, Floats]:
        """Fixed range error [m] and gain of each layer of this unit, (layers,) each."""
        draws = np.random.default_rng([self.unit, self.layers]).standard_normal((2, self.layers))
        bias = np.array(self.range_errors) if self.range_errors else self.range_bias * draws[0]
        return bias, np.exp(self.gain_spread * draws[1])

    def directions(self) -> Floats32:
        """Return unit vectors in the sensor frame (layers, azimuths, 3), shared and read-only."""
        return self._rays_at(self.elevations)

    def aims(self) -> Floats32:
        """Return the true beam directions, `directions` with `elevation_errors`, shared and read-only."""
        errors = self.elevation_errors or (0.0,) * self.layers
        real = tuple(a + b for a, b in zip(self.elevations, errors, strict=True))
        return self._rays_at(real)

    def _rays_at(self, elevations: tuple[float, ...]) -> Floats32:
        if self.kind == "depth":
            return _image_rays(elevations, self.azimuth_step, self.columns)
        return _shared_rays(elevations, self.azimuth_offsets, self.azimuth_step, self.columns)


@lru_cache(maxsize=64)
def beams_of(spec: LidarSpec) -> Beams:
    """Return the beam directions of a lidar, which turn its range images into points without the simulator."""
    first = _first_azimuth(spec.azimuth_step, spec.columns)
    azimuth = tuple((math.atan(first) if spec.kind == "depth" else first) + offset for offset in spec.azimuth_offsets)
    origin = spec.origins or ((0.0, 0.0, 0.0),) * spec.layers
    limits = (spec.kind, spec.range_min, spec.range_max) if spec.kind else ()
    return Beams(spec.name, spec.elevations, azimuth, -spec.azimuth_step, spec.azimuths, spec.rate, origin, *limits)


@lru_cache(maxsize=2)
def hd_directions(spec: LidarSpec, layers: int = 3000) -> Floats32:
    """Return the rays of a lidar with many layers and the field of view and azimuths of another lidar.

    Parameters
    ----------
    spec : LidarSpec
    layers : int
        Number of layers, evenly spaced over the elevations of `spec`; at least 2.

    Returns
    -------
    (layers, azimuths, 3) float32
        Unit vectors in the sensor frame, shared and read-only.
    """
    if layers < 2:
        raise ValueError(f"layers must be at least 2, got {layers}")
    elevations = np.linspace(spec.elevations[0], spec.elevations[-1], layers)
    return _rays(tuple(elevations.tolist()), (0.0,) * layers, spec.azimuth_step)


def _rays(elevations: tuple[float, ...], offsets: tuple[float, ...], step: float, columns: int = 0) -> Floats32:
    elevation, offset = np.array(elevations)[:, None], np.array(offsets)[:, None]
    azimuth = _first_azimuth(step, columns) - step * np.arange(columns or round(2 * math.pi / step))
    # sums of angles, so that 5 million rays need few sines
    cosine = np.cos(azimuth) * np.cos(offset) - np.sin(azimuth) * np.sin(offset)
    sine = np.sin(azimuth) * np.cos(offset) + np.cos(azimuth) * np.sin(offset)
    rays = np.empty((*cosine.shape, 3), np.float32)
    rays[..., 0] = np.cos(elevation) * cosine
    rays[..., 1] = np.cos(elevation) * sine
    rays[..., 2] = np.sin(elevation)
    rays.flags.writeable = False
    return rays


def _first_azimuth(step: float, columns: int = 0) -> float:
    """Return the azimuth of column 0 without offset [rad]; column k is k * step further right."""
    return step * (columns - 1) / 2 if columns else math.pi - step / 2


@lru_cache(maxsize=4)
def _image_rays(elevations: tuple[float, ...], step: float, columns: int) -> Floats32:
    """Return the unit directions of image pixels: rows from lowest to highest, columns from left to right."""
    rays = np.ones((len(elevations), columns, 3))
    rays[..., 1] = _first_azimuth(step, columns) - step * np.arange(columns)
    rays[..., 2] = np.tan(elevations)[:, None]
    result: Floats32 = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)
    result.flags.writeable = False
    return result


_shared_rays = lru_cache(maxsize=16)(_rays)


def _radians(degrees: Sequence[float]) -> tuple[float, ...]:
    return tuple(map(math.radians, degrees))


# Lidars by name; the user may add own specifications.
LIDARS = {
    name: LidarSpec(name, _radians(elevations), _radians(offsets), step, **others)
    for name, (elevations, offsets, step, others) in PATTERNS.items()
}
