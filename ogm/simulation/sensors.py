"""Lidars by their numbers: where the beams point, how far and how exactly they measure.

>>> from ogm.simulation.sensors import LIDARS
>>> LIDARS["vlp-32c"].shape, LIDARS["vlp-32c"].directions().shape           # layers and columns of a turn
((32, 1800), (32, 1800, 3))
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from ogm.simulation.arrays import Floats, Floats32
from ogm.simulation.patterns import PATTERNS
from ogm.simulation.sample import Beams

__all__ = ["LIDARS", "LidarSpec", "beams_of", "hd_directions"]

_BOUNDS: dict[str, tuple[float, float]] = {  # lowest and highest value of a `LidarSpec`
    "azimuth_step": (1e-4, 0.2), "rate": (0.1, 200), "range_min": (0, 50), "reach": (1, 5000), "range_noise": (0, 1),
    "range_bias": (0, 1), "gain_spread": (0, 2), "range_step": (1e-5, 1), "divergence": (0, 0.1), "height": (0.05, 20),
}  # fmt: skip


@dataclass(frozen=True)
class LidarSpec:
    """A spinning lidar.

    It turns clockwise, seen from above, as Velodyne's and Ouster's do. A turn begins straight behind, so that
    the sensor faces ahead in the middle of it.

    Parameters
    ----------
    name : str
    elevations : tuple of float
        Of each layer above the sensor's xy plane [rad], ascending (equal ones may follow each other).
    azimuth_offsets : tuple of float
        How far each layer points to the left of the column's azimuth [rad].
    azimuth_step : float
        Between columns [rad]; a whole number of them makes a turn.
    rate : float
        Turns per second [Hz].
    range_min, range_max : float
        What is nearer or farther gives no return [m].
    reach : float
        Where half the returns of a matt white target seen head-on are lost [m]. What reflects a share R of
        that is lost at reach * sqrt(R).
    range_noise : float
        Standard deviation of the range of a strong return from shot to shot [m].
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
        Where the beams of each layer start in the sensor frame [m]; empty for (0, 0, 0).
    unit : int
        Which sensor of this kind: another one has other fixed errors and gains.
    elevation_errors : tuple of float
        How much higher than `elevations` each layer really points [rad], while its points are reported there; empty
        for not at all.
    range_errors : tuple of float
        Fixed error of each layer's range [m], instead of one drawn by `range_bias` and `unit`; empty for that.

    Raises
    ------
    TypeError
        If elevations, offsets or origins are no tuples.
    ValueError
        If the numbers describe no lidar that could exist.
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

    def __post_init__(self) -> None:
        layers = len(self.elevations)
        for name in ("elevations", "azimuth_offsets", "origins", "elevation_errors", "range_errors"):
            values = getattr(self, name)
            if not isinstance(values, tuple):
                raise TypeError(
                    f"{self.name}: {name} must be a tuple, one entry per layer, got {type(values).__name__}"
                )
            if len(values) != layers and (values or name in ("elevations", "azimuth_offsets")):
                raise ValueError(f"{self.name}: {len(values)} {name} for {layers} layers")
            if not np.isfinite(np.hstack((0.0, *values))).all():
                raise ValueError(f"{self.name}: {name} hold NaN or inf: {values}")
        if not layers:
            raise ValueError(f"{self.name}: elevations are empty; a lidar has at least one layer")
        if any(len(one) != 3 for one in self.origins):
            raise ValueError(f"{self.name}: origins must be empty or one (x, y, z) per layer")
        if max(map(abs, self.elevations)) > math.pi / 2:
            raise ValueError(
                f"{self.name}: elevations must lie in -pi/2 ... pi/2 rad, got {self.elevations} (degrees?)"
            )
        if sorted(self.elevations) != list(self.elevations):
            raise ValueError(f"{self.name}: elevations must ascend from the lowest layer; sort them and their offsets")
        if isinstance(self.unit, bool) or not isinstance(self.unit, (int, np.integer)) or self.unit < 0:
            raise ValueError(f"{self.name}: unit must be a whole number >= 0, got {self.unit!r}")
        for name, (low, high) in (_BOUNDS | {"range_max": (self.range_min, 2000)}).items():
            if not low <= getattr(self, name) <= high:  # NaN fails too
                raise ValueError(f"{self.name}: {name} must lie in {low:g} ... {high:g}, got {getattr(self, name)}")
        columns = 2 * math.pi / self.azimuth_step
        if abs(columns - round(columns)) > 1e-6 * columns:
            way = f"take 2 * pi / {round(columns)}"
            raise ValueError(f"{self.name}: azimuth_step must divide a full turn, got it / {columns:.6g}; {way}")

    @property
    def layers(self) -> int:
        """Beams above each other."""
        return len(self.elevations)

    @property
    def azimuths(self) -> int:
        """Columns: firings of each layer in a turn."""
        return round(2 * math.pi / self.azimuth_step)

    @property
    def shape(self) -> tuple[int, int]:
        """Layers and columns of a range image."""
        return self.layers, self.azimuths

    @cached_property
    def times(self) -> Floats:
        """When each column fires [s], (azimuths,); 0 is the middle of the turn."""
        return ((np.arange(self.azimuths) + 0.5) / self.azimuths - 0.5) / self.rate

    @cached_property
    def errors(self) -> tuple[Floats, Floats]:
        """Fixed range error [m] and gain of each layer of this unit, (layers,) each."""
        draws = np.random.default_rng([self.unit, self.layers]).standard_normal((2, self.layers))
        bias = np.array(self.range_errors) if self.range_errors else self.range_bias * draws[0]
        return bias, np.exp(self.gain_spread * draws[1])

    def directions(self) -> Floats32:
        """Return unit vectors in the sensor frame (layers, azimuths, 3); shared, hence read-only."""
        return _shared_rays(self.elevations, self.azimuth_offsets, self.azimuth_step)

    def aims(self) -> Floats32:
        """Return where the beams really point: `directions` but for `elevation_errors`; read-only too."""
        errors = self.elevation_errors or (0.0,) * self.layers
        real = tuple(a + b for a, b in zip(self.elevations, errors, strict=True))
        return _shared_rays(real, self.azimuth_offsets, self.azimuth_step)


@lru_cache(maxsize=64)
def beams_of(spec: LidarSpec) -> Beams:
    """Return what turns a lidar's range images into points, without the simulator."""
    azimuth = tuple(_first_azimuth(spec.azimuth_step) + offset for offset in spec.azimuth_offsets)
    origin = spec.origins or ((0.0, 0.0, 0.0),) * spec.layers
    return Beams(spec.name, spec.elevations, azimuth, -spec.azimuth_step, spec.azimuths, spec.rate, origin)


@lru_cache(maxsize=2)
def hd_directions(spec: LidarSpec, layers: int = 3000) -> Floats32:
    """Return the rays of a lidar of many layers with another one's field of view and azimuths.

    Parameters
    ----------
    spec : LidarSpec
    layers : int
        Evenly from the lowest to the highest elevation of `spec`.

    Returns
    -------
    (layers, azimuths, 3) float32
        Unit vectors in the sensor frame; shared, hence read-only.
    """
    if layers < 2:
        raise ValueError(f"layers must be 2 or more, got {layers}")
    elevations = np.linspace(spec.elevations[0], spec.elevations[-1], layers)
    return _rays(tuple(elevations.tolist()), (0.0,) * layers, spec.azimuth_step)


def _rays(elevations: tuple[float, ...], offsets: tuple[float, ...], step: float) -> Floats32:
    elevation, offset = np.array(elevations)[:, None], np.array(offsets)[:, None]
    azimuth = _first_azimuth(step) - step * np.arange(round(2 * math.pi / step))
    # the sum of two angles, so that 5 million rays need few sines
    cosine = np.cos(azimuth) * np.cos(offset) - np.sin(azimuth) * np.sin(offset)
    sine = np.sin(azimuth) * np.cos(offset) + np.cos(azimuth) * np.sin(offset)
    rays = np.empty((*cosine.shape, 3), np.float32)
    rays[..., 0] = np.cos(elevation) * cosine
    rays[..., 1] = np.cos(elevation) * sine
    rays[..., 2] = np.sin(elevation)
    rays.flags.writeable = False
    return rays


def _first_azimuth(step: float) -> float:
    """Return the azimuth of column 0 for a layer without offset [rad]; column k is k * step further right."""
    return math.pi - step / 2


_shared_rays = lru_cache(maxsize=16)(_rays)


def _radians(degrees: Sequence[float]) -> tuple[float, ...]:
    return tuple(map(math.radians, degrees))


# Lidars by name; one of your own may be added
LIDARS = {
    name: LidarSpec(name, _radians(elevations), _radians(offsets), step, **others)
    for name, (elevations, offsets, step, others) in PATTERNS.items()
}
