"""What surfaces are made of, as a lidar at 905 nm sees it, and as the truth grid judges it."""

from enum import IntEnum
from typing import NamedTuple

import numpy as np

__all__ = ["GROUND", "MATERIALS", "Material", "Optics", "table"]


class Material(IntEnum):
    """Materials by number; a mesh carries one per triangle."""

    ASPHALT = 0
    WORN_ASPHALT = 1
    WET_ASPHALT = 2
    COBBLES = 3
    PAVING = 4  # slabs of a sidewalk or square
    GRAVEL = 5
    GRASS = 6
    SOIL = 7
    MARKING = 8  # road paint with glass beads
    KERB = 9  # the upright face of a kerb stone
    PLASTER_LIGHT = 10
    PLASTER_DARK = 11
    BRICK = 12
    CONCRETE = 13
    STONE = 14
    WOOD = 15
    ROOF = 16
    WINDOW = 17  # pane of a house: little comes back, nothing beyond it is modelled
    METAL_SHEET = 18
    METAL_POLE = 19
    FOLIAGE = 20
    BARK = 21
    PAINT_LIGHT = 22
    PAINT_MEDIUM = 23
    PAINT_DARK = 24
    PAINT_BLACK = 25
    TYRE = 26
    CAR_GLASS = 27
    PLASTIC_DARK = 28
    PLATE = 29  # licence plate: retroreflective
    LAMP = 30  # reflectors in head and tail lamps
    SIGN = 31  # retroreflective sheeting
    CLOTH_LIGHT = 32
    CLOTH_DARK = 33
    SKIN = 34
    HIGH_VIS = 35  # vests and reflector strips
    TARPAULIN = 36
    OWN_VEHICLE = 37


class Optics(NamedTuple):
    """How a material answers a beam at 905 nm.

    Attributes
    ----------
    reflectivity : float
        Diffuse reflectivity [0, 1]: the share a matt white target would return, times this.
    spread : float
        Standard deviation of its logarithm from one patch to the next.
    retro : float
        Extra return of retroreflective sheeting, in multiples of a matt white target seen head-on.
    specular : float
        Share [0, 1] that leaves as from a mirror: it comes back at normal incidence only.
    transmission : float
        Share [0, 1] of the rays that pass through and go on.
    """

    reflectivity: float
    spread: float = 0.2
    retro: float = 0.0
    specular: float = 0.0
    transmission: float = 0.0


M = Material
# Effective values at 905 nm, ours: began from typical ones, then darkened until the spread of intensities lay between
# those of real Velodyne scans (benchmarks/realism.py): dirt, gloss and partly filled beams are in them.
MATERIALS: dict[Material, Optics] = {
    M.ASPHALT: Optics(0.11, 0.35),
    M.WORN_ASPHALT: Optics(0.20, 0.25),
    M.WET_ASPHALT: Optics(0.05, 0.4, specular=0.5),
    M.COBBLES: Optics(0.22, 0.3),
    M.PAVING: Optics(0.22, 0.35),
    M.GRAVEL: Optics(0.28, 0.3),
    M.GRASS: Optics(0.30, 0.35),
    M.SOIL: Optics(0.25, 0.3),
    M.MARKING: Optics(0.55, 0.3, retro=0.6),
    M.KERB: Optics(0.30, 0.2),
    M.PLASTER_LIGHT: Optics(0.45, 0.4),
    M.PLASTER_DARK: Optics(0.12, 0.4),
    M.BRICK: Optics(0.13, 0.4),
    M.CONCRETE: Optics(0.16, 0.4),
    M.STONE: Optics(0.14, 0.4),
    M.WOOD: Optics(0.16, 0.4),
    M.ROOF: Optics(0.12, 0.3),
    M.WINDOW: Optics(0.06, 0.4, specular=0.6),
    M.METAL_SHEET: Optics(0.15, 0.4, specular=0.3),
    M.METAL_POLE: Optics(0.15, 0.4, specular=0.2),
    M.FOLIAGE: Optics(0.25, 0.5),
    M.BARK: Optics(0.12, 0.4),
    M.PAINT_LIGHT: Optics(0.45, 0.2, specular=0.1),
    M.PAINT_MEDIUM: Optics(0.12, 0.4, specular=0.15),
    M.PAINT_DARK: Optics(0.04, 0.3, specular=0.2),
    M.PAINT_BLACK: Optics(0.015, 0.3, specular=0.25),
    M.TYRE: Optics(0.06, 0.2),
    M.CAR_GLASS: Optics(0.04, 0.3, specular=0.3, transmission=0.8),
    M.PLASTIC_DARK: Optics(0.08, 0.2),
    M.PLATE: Optics(0.60, 0.1, retro=8.0),
    M.LAMP: Optics(0.25, 0.2, retro=3.0, specular=0.2),
    M.SIGN: Optics(0.50, 0.1, retro=12.0),
    M.CLOTH_LIGHT: Optics(0.55, 0.3),
    M.CLOTH_DARK: Optics(0.25, 0.4),
    M.SKIN: Optics(0.50, 0.1),
    M.HIGH_VIS: Optics(0.70, 0.1, retro=6.0),
    M.TARPAULIN: Optics(0.50, 0.2),
    M.OWN_VEHICLE: Optics(0.35, 0.2, specular=0.15),
}

# What a vehicle may drive over: hits on these make a cell free, hits on all others make it occupied.
GROUND = frozenset(
    {M.ASPHALT, M.WORN_ASPHALT, M.WET_ASPHALT, M.COBBLES, M.PAVING, M.GRAVEL, M.GRASS, M.SOIL, M.MARKING}
)


def table() -> np.ndarray:
    """Return the optics as an array that kernels can index.

    Returns
    -------
    (materials, 5) float32
        Row m: reflectivity, spread, retro, specular, transmission of `Material` m.
    """
    return np.array([MATERIALS[Material(m)] for m in range(len(Material))], np.float32)
