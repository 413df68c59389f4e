"""Recipes of datasets: named, frozen sets of parameters.

The default of `DatasetPlan` is the paper's recipe: clear weather and intact sensors. ``gen2`` adds conditions that a
sensor model must handle: other lidars and mounts, calibration errors, sectors, blocked views, lost packets, dead
layers, fog, rain and dust, and country roads between banks, ditches, high grass and woods. ``gen3`` has more traffic,
and sensors of which few layers work.

>>> from ogm.simulation.recipe import RECIPES
>>> RECIPES["gen2"].samples, len({mount.lidar for mount in RECIPES["gen2"].mounts})
(4800, 14)
"""

import math
from dataclasses import dataclass, replace

from ogm.simulation.mounts import LidarMount

__all__ = ["GEN2", "GEN3", "RECIPES", "Country", "Crowds", "DataRecipe", "Faults", "LayerErrors", "Skies"]


_DEGREE = math.pi / 180


@dataclass(frozen=True)
class LayerErrors:
    """Calibration errors of a lidar's layers, constant over all scans of a unit.

    Parameters
    ----------
    elevation : float
        Standard deviation of each layer's elevation error [rad], truncated at twice this value.
    offset : float
        Largest common elevation error of all layers [rad].
    range : float
        Standard deviation of each layer's range error [m], truncated at twice this value.
    """

    elevation: float
    offset: float
    range: float


@dataclass(frozen=True)
class Country:
    """Country in and around a town; pairs are lower and upper bounds.

    Parameters
    ----------
    share
        Share of the areas between streets that are country.
    slope
        Slope of banks and of the sides of ditches, height over run.
    bank, ditch
        Height of banks and depth of ditches [m].
    shoulder
        Width of the level ground along the road [m].
    """

    share: tuple[float, float] = (0.1, 0.7)
    slope: tuple[float, float] = (0.2, 1.0)
    bank: tuple[float, float] = (0.6, 3.0)
    ditch: tuple[float, float] = (0.4, 1.4)
    shoulder: tuple[float, float] = (0.3, 2.0)


@dataclass(frozen=True)
class Faults:
    """Shares of scans with missing beams, and the extent of the gaps; pairs are lower and upper bounds.

    Parameters
    ----------
    sector, sector_width
        Share of scans in which only a sector is fired or reported; its width [rad].
    blocked, blocked_views, blocked_width
        Share of scans with blocked views; their largest number; the width of each [rad]. Half of them block all
        elevations, the others the lower ones. In half of these scans the driver omits the blocked beams, in the others
        they are beams without echo.
    lost, lost_packets, packet
        Share of scans with lost packets; the share of packets lost; columns per packet.
    dead, dead_layers
        Share of scans with dead layers; the share of layers that are dead.
    """

    sector: float = 0.25
    sector_width: tuple[float, float] = (60 * _DEGREE, 270 * _DEGREE)
    blocked: float = 0.15
    blocked_views: int = 3
    blocked_width: tuple[float, float] = (5 * _DEGREE, 60 * _DEGREE)
    lost: float = 0.15
    lost_packets: tuple[float, float] = (0.005, 0.25)
    packet: tuple[int, int] = (1, 16)
    dead: float = 0.12
    dead_layers: tuple[float, float] = (0.02, 0.2)


@dataclass(frozen=True)
class Skies:
    """Shares of scans in bad weather, and its strength, drawn log-uniformly; pairs are lower and upper bounds.

    Parameters
    ----------
    fog, visibility
        Share of scans in fog; meteorological visibility [m].
    rain, rate
        Share of scans in rain, on wet roads; rain rate [mm/h].
    wet
        Share of scans on wet roads without rain.
    dust, dust_extinction, dust_clouds, dust_radius
        Share of scans in dust; extinction coefficient [1/m]; largest number of clouds; their radius [m].
    """

    fog: float = 0.07
    visibility: tuple[float, float] = (12.0, 400.0)
    rain: float = 0.06
    rate: tuple[float, float] = (0.5, 60.0)
    wet: float = 0.05
    dust: float = 0.06
    dust_extinction: tuple[float, float] = (0.02, 0.8)
    dust_clouds: int = 8
    dust_radius: tuple[float, float] = (0.8, 6.0)


@dataclass(frozen=True)
class Crowds:
    """Density of each drive's traffic, see `ogm.simulation.traffic.departure.Density`, drawn log-uniformly.

    Parameters
    ----------
    vehicles, people, bicycles
        Lower and upper bounds of the factors.
    """

    vehicles: tuple[float, float] = (1.0, 1.0)
    people: tuple[float, float] = (1.0, 1.0)
    bicycles: tuple[float, float] = (1.0, 1.0)


_ROOF, _MIDDLE, _SLIGHT = (1.7, 2.4), (-0.4, 0.4), 0.04  # [m], [m], [rad]
_MOUNTS = (
    LidarMount("vlp-32c", 0.08, _ROOF, _MIDDLE, _SLIGHT),
    LidarMount("hdl-32e", 0.10, _ROOF, _MIDDLE, _SLIGHT),
    LidarMount("hdl-64e", 0.10, (1.65, 2.1), _MIDDLE, _SLIGHT),
    LidarMount("vls-128", 0.06, _ROOF, _MIDDLE, _SLIGHT),
    LidarMount("os1-64", 0.08, _ROOF, _MIDDLE, _SLIGHT),
    LidarMount("os1-128", 0.06, _ROOF, _MIDDLE, _SLIGHT),
    LidarMount("vlp-16", 0.06, _ROOF, _MIDDLE, _SLIGHT),
    LidarMount("xt32", 0.06, _ROOF, _MIDDLE, _SLIGHT),
    LidarMount("pandar40p", 0.07, _ROOF, _MIDDLE, _SLIGHT),
    LidarMount("pandar64", 0.05, _ROOF, _MIDDLE, _SLIGHT),
    LidarMount("ot128", 0.06, _ROOF, _MIDDLE, _SLIGHT),
    LidarMount("qt128", 0.04, (1.65, 2.2), _MIDDLE, _SLIGHT),
    LidarMount("dual-vlp-32c", 0.04, (1.8, 2.4), _MIDDLE, _SLIGHT),
    LidarMount("at128", 0.05, (1.6, 2.1), (0.2, 0.9), _SLIGHT, 120 * _DEGREE),
    LidarMount("at128", 0.01, (0.5, 1.0), (2.5, 2.7), _SLIGHT, 120 * _DEGREE),  # at the bumper
    # As high as on a truck or a bus, and tilted.
    LidarMount("vlp-32c", 0.02, (2.4, 3.4), (-1.0, 1.0), 0.08),
    LidarMount("os1-64", 0.02, (1.6, 3.0), (-1.0, 1.0), 0.08),
    LidarMount("vlp-16", 0.02, (1.6, 3.0), (-1.0, 1.0), 0.08),
    LidarMount("pandar64", 0.02, (2.4, 3.4), (-1.0, 1.0), 0.08),
)
_CALIBRATIONS = (
    ("hdl-64e", LayerErrors(elevation=0.1 * _DEGREE, offset=0.2 * _DEGREE, range=0.025)),
    ("hdl-32e", LayerErrors(elevation=0.04 * _DEGREE, offset=0.1 * _DEGREE, range=0.015)),
    ("os1-64", LayerErrors(elevation=0.04 * _DEGREE, offset=0.1 * _DEGREE, range=0.015)),
    ("pandar40p", LayerErrors(elevation=0.04 * _DEGREE, offset=0.15 * _DEGREE, range=0.015)),
)


@dataclass(frozen=True)
class DataRecipe:
    """All parameters from which the samples of a dataset are drawn, except the seed and the number of samples.

    Parameters
    ----------
    samples : int
        Default number of training samples. Validation and test use towns of their own.
    mounts : tuple of LidarMount
    country : Country
        Country in every town.
    town_size : float
        Side length of the towns [m].
    town_samples, town_others : int
        Samples per town, in training and in the other splits; multiples of ten.
    spacing : float
        Time between the samples of a drive [s]; a new drive begins every ten samples.
    faults : Faults
    skies : Skies
    in_motion : float
        Share of scans distorted by the ego motion.
    no_intensity : float
        Share of scans without intensities: all are 0.
    steepest : float
        Largest slope (height over run) of ground that is not an obstacle.
    plant : float
        Height below which plants are drivable [m].
    crowds : Crowds
    calibration : LayerErrors
        Calibration errors of lidars that `calibrations` does not name.
    calibrations : tuple of (name, LayerErrors)
        Calibration errors by lidar.
    """

    samples: int = 4800
    mounts: tuple[LidarMount, ...] = _MOUNTS
    country: Country = Country()
    town_size: float = 400.0
    town_samples: int = 70
    town_others: int = 40
    spacing: float = 8.0
    faults: Faults = Faults()
    skies: Skies = Skies()
    in_motion: float = 0.5
    no_intensity: float = 0.5
    steepest: float = 0.4
    plant: float = 0.25
    crowds: Crowds = Crowds()
    calibration: LayerErrors = LayerErrors(elevation=0.02 * _DEGREE, offset=0.05 * _DEGREE, range=0.01)
    calibrations: tuple[tuple[str, LayerErrors], ...] = _CALIBRATIONS

    def calibration_of(self, lidar: str) -> LayerErrors:
        """Return the calibration errors of a lidar model."""
        return dict(self.calibrations).get(lidar, self.calibration)


GEN2 = DataRecipe()  # further lidars and mounts, faults, bad weather, country roads: see docs/simulation.md
# More people, bicycles and queues, sensors of which few layers work, drivable plants up to 0.3 m
GEN3 = replace(
    GEN2,
    plant=0.3,
    crowds=Crowds(vehicles=(1.0, 3.0), people=(1.0, 6.0), bicycles=(1.0, 6.0)),
    faults=Faults(dead=0.2, dead_layers=(0.05, 0.95)),
)
RECIPES: dict[str, DataRecipe] = {"gen2": GEN2, "gen3": GEN3}
