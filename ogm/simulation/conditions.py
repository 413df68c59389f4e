"""Conditions of a single scan drawn from a recipe: weather, motion, and missing beams."""

import math
from typing import NamedTuple

import numpy as np
from numpy.random import Generator

from ogm.simulation.mesh import Floats, Mask
from ogm.simulation.mounts import FULL_TURN
from ogm.simulation.recipe import Crowds, DataRecipe, Faults, Skies
from ogm.simulation.sample import Beams, Weather
from ogm.simulation.traffic.departure import Density

DUST_REACH = 40.0  # [m] largest distance of dust clouds from the sensor
FAST = 3.0  # [m/s] speed above which vehicles raise dust


class Conditions(NamedTuple):
    """Conditions of a scan.

    Attributes
    ----------
    weather : Weather
    in_motion, intensity : bool
        Whether the ego motion distorts the scan, and whether it has intensities.
    measured : (layers, columns) bool
        Beams that were fired and reported: each gives a point or is a beam without echo.
    hidden : (layers, columns) bool
        Blocked beams, without echo if they are measured.
    dust : (P, 5) float64
        Balls of dust: x, y, z in the sensor's frame [m], radius [m], extinction coefficient in the middle [1/m], which
        falls to zero at the surface.
    """

    weather: Weather
    in_motion: bool
    intensity: bool
    measured: Mask
    hidden: Mask
    dust: Floats

    @property
    def active(self) -> Mask:
        """Beams that are measured and not blocked."""
        return self.measured & ~self.hidden


def layer_errors(recipe: DataRecipe, lidar: str, layers: int, unit: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the elevation errors [rad] and range errors [m] of the layers of one unit of a lidar."""
    size = recipe.calibration_of(lidar)
    rng = np.random.default_rng([unit, layers, 1])
    offset = rng.uniform(-size.offset, size.offset)
    elevation, distance = np.clip(rng.standard_normal((2, layers)), -2, 2)
    return tuple((offset + size.elevation * elevation).tolist()), tuple((size.range * distance).tolist())


def draw_weather(bad: float, rng: Generator) -> Weather:
    """Draw weather without a recipe: clear, or in a share `bad` of the scans rain, fog or a wet road."""
    drawn, kind, strength = rng.random(3)
    if drawn >= bad:
        return Weather()
    if kind < 0.4:
        return Weather(rain=float(1 + 24 * strength), wet=1.0)
    if kind < 0.7:
        return Weather(fog=float(40 * 10**strength))
    return Weather(wet=float(strength))


def draw_conditions(recipe: DataRecipe, beams: Beams, view: float, movers: Floats, rng: Generator) -> Conditions:
    """Draw the conditions of a scan from a recipe.

    Parameters
    ----------
    recipe : DataRecipe
    beams : Beams
        Beams of the lidar.
    view : float
        Width of the fired sector [rad], see `LidarMount.view`.
    movers : (K, 5) float64
        Moving objects nearby: x, y, z of the lowest point [m], velocity along x and y [m/s], in the sensor's frame.
    rng : Generator
    """
    in_motion, intensity = rng.random() < recipe.in_motion, rng.random() >= recipe.no_intensity
    weather, dust = _weather(recipe.skies, movers, rng)
    azimuth = np.array(beams.azimuth)[:, None] + beams.step * np.arange(beams.columns)
    measured = _sector(recipe.faults, azimuth, view, rng)
    hidden, left_out = _blocked(recipe.faults, azimuth, np.array(beams.elevation), rng)
    measured &= ~_lost(recipe.faults, beams.columns, rng)
    measured &= ~_dead(recipe.faults, len(beams.elevation), rng)[:, None]
    if left_out:
        measured &= ~hidden
    return Conditions(weather, bool(in_motion), bool(intensity), measured, hidden, dust)


def draw_density(crowds: Crowds, traffic: int) -> Density:
    """Draw the density of a drive's traffic, of the given seed."""
    rng = np.random.default_rng([traffic, 7])
    return Density(*(_log_uniform(pair, rng) for pair in (crowds.vehicles, crowds.people, crowds.bicycles)))


def _log_uniform(pair: tuple[float, float], rng: Generator) -> float:
    return float(np.exp(rng.uniform(*np.log(pair))))


def _weather(skies: Skies, movers: Floats, rng: Generator) -> tuple[Weather, Floats]:
    """Draw at most one kind of weather, and balls of dust (P, 5); half of the dust clouds follow fast objects."""
    kind = float(rng.random())
    ends = np.cumsum([skies.fog, skies.rain, skies.wet, skies.dust])
    clear, none = Weather(), np.zeros((0, 5))
    if kind < ends[0]:
        return clear._replace(fog=_log_uniform(skies.visibility, rng)), none
    if kind < ends[1]:
        return clear._replace(rain=_log_uniform(skies.rate, rng), wet=1.0), none
    if kind < ends[2]:
        return clear._replace(wet=float(rng.uniform(0.2, 1.0))), none
    if kind >= ends[3]:
        return clear, none
    extinction = _log_uniform(skies.dust_extinction, rng)
    count = int(rng.integers(1, skies.dust_clouds + 1))
    dust = []
    speed = np.hypot(*movers[:, 3:].T) if len(movers) else np.zeros(0)
    fast = movers[(speed > FAST) & (np.hypot(*movers[:, :2].T) < DUST_REACH)]
    ground = float(np.median(movers[:, 2])) if len(movers) else -2.0
    for _ in range(count):
        radius = _log_uniform(skies.dust_radius, rng)
        angle, away = rng.uniform(0, FULL_TURN), DUST_REACH * math.sqrt(rng.random())
        at = np.array([away * math.cos(angle), away * math.sin(angle), ground])
        if len(fast) and rng.random() < 0.5:
            mover = fast[int(rng.integers(len(fast)))]
            at = mover[:3] - np.append(mover[3:], 0.0) * rng.uniform(0.2, 1.5)
        balls = np.empty((int(rng.integers(4, 9)), 5))
        balls[:, :3] = at + radius * rng.normal(0.0, 1.0, (len(balls), 3)) * [0.6, 0.6, 0.3]
        balls[:, 3] = radius * rng.uniform(0.4, 0.9, len(balls))
        balls[:, 4] = extinction * rng.uniform(0.3, 1.0, len(balls))
        dust.append(balls)
    return clear._replace(dust=extinction), np.concatenate(dust)


def _within(azimuth: Floats, middle: float, width: float) -> Mask:
    """Return a mask of the azimuths in a sector [rad]."""
    return np.asarray(np.abs((azimuth - middle + math.pi) % FULL_TURN - math.pi) <= width / 2)


def _sector(faults: Faults, azimuth: Floats, view: float, rng: Generator) -> Mask:
    """Draw the beams within the fired sector; half of the sectors face ahead."""
    cut, ahead = rng.random() < faults.sector, rng.random() < 0.5
    width, middle = rng.uniform(*faults.sector_width), rng.uniform(-math.pi, math.pi)
    if view < FULL_TURN:
        return _within(azimuth, 0.0, view)
    return _within(azimuth, 0.0 if ahead else middle, width) if cut else np.ones(azimuth.shape, bool)


def _blocked(faults: Faults, azimuth: Floats, elevation: Floats, rng: Generator) -> tuple[Mask, bool]:
    """Draw the blocked beams, and whether the driver omits them."""
    hidden, left_out = np.zeros(azimuth.shape, bool), rng.random() < 0.5
    if rng.random() >= faults.blocked:
        return hidden, False
    for _ in range(int(rng.integers(1, faults.blocked_views + 1))):
        columns = _within(azimuth, rng.uniform(-math.pi, math.pi), _log_uniform(faults.blocked_width, rng))
        top = rng.uniform(elevation[0], min(elevation[-1], 0.1)) if rng.random() < 0.5 else math.inf
        hidden |= columns & (elevation <= top)[:, None]
    return hidden, bool(left_out)


def _lost(faults: Faults, columns: int, rng: Generator) -> Mask:
    """Draw the columns of lost packets, (columns,): scattered or consecutive."""
    if rng.random() >= faults.lost:
        return np.zeros(columns, bool)
    packet = int(rng.integers(faults.packet[0], faults.packet[1] + 1))
    return np.repeat(_selection(-(-columns // packet), faults.lost_packets, rng, wrap=True), packet)[:columns]


def _dead(faults: Faults, layers: int, rng: Generator) -> Mask:
    """Draw the dead layers, (layers,): scattered or adjacent."""
    if rng.random() >= faults.dead:
        return np.zeros(layers, bool)
    return _selection(layers, faults.dead_layers, rng, wrap=False)


def _selection(count: int, share: tuple[float, float], rng: Generator, *, wrap: bool) -> Mask:
    """Draw a share of `count` items, scattered or consecutive; with `wrap` the first follows the last."""
    chosen = np.zeros(count, bool)
    wanted = max(1, round(count * _log_uniform(share, rng)))
    if rng.random() < 0.5:
        chosen[rng.choice(count, wanted, replace=False)] = True
    else:
        chosen[(int(rng.integers(count if wrap else count - wanted + 1)) + np.arange(wanted)) % count] = True
    return chosen
