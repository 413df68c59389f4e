"""Surface materials: reflection of a lidar beam at 905 nm, and colours in pictures.

>>> from ogm.simulation.materials import GROUND, Material
>>> Material.ASPHALT in GROUND, Material.ASPHALT.optics.retro
(True, 0.0)
"""

from enum import IntEnum
from typing import NamedTuple, Self

import numpy as np

__all__ = ["GROUND", "Material", "Optics", "table"]


class Optics(NamedTuple):
    """Optical properties of a material at 905 nm.

    Attributes
    ----------
    reflectivity : float
        Diffuse reflectivity [0, 1], relative to a matt white target.
    spread : float
        Standard deviation of the logarithm of the reflectivity between patches.
    retro : float
        Additional return of retroreflective sheeting, in multiples of a matt white target hit head-on.
    specular : float
        Share [0, 1] of mirror-like reflection, which returns to the sensor at normal incidence only.
    transmission : float
        Share [0, 1] of the rays that pass through.
    """

    reflectivity: float
    spread: float = 0.2
    retro: float = 0.0
    specular: float = 0.0
    transmission: float = 0.0


class Material(IntEnum):
    """Materials of mesh triangles by number, with optics, and RGB colours for pictures."""

    optics: Optics
    colour: tuple[float, float, float]

    def __new__(cls, number: int, optics: Optics, colour: tuple[float, float, float]) -> Self:
        """Make a material number with attributes."""
        material = int.__new__(cls, number)
        material._value_, material.optics, material.colour = number, optics, colour
        return material

    # Effective values at 905 nm, which include dirt, gloss and partly filled beams. Estimates: typical values, darkened
    # until the spread of intensities was within that of real Velodyne scans (benchmarks/realism.py).
    ASPHALT = 0, Optics(0.11, 0.35), (0.30, 0.30, 0.32)
    WORN_ASPHALT = 1, Optics(0.20, 0.25), (0.38, 0.38, 0.38)
    WET_ASPHALT = 2, Optics(0.05, 0.4, specular=0.5), (0.18, 0.20, 0.24)
    COBBLES = 3, Optics(0.22, 0.3), (0.45, 0.42, 0.40)
    PAVING = 4, Optics(0.22, 0.35), (0.62, 0.58, 0.54)  # slabs of a sidewalk or square
    GRAVEL = 5, Optics(0.28, 0.3), (0.66, 0.61, 0.50)
    GRASS = 6, Optics(0.30, 0.35), (0.40, 0.55, 0.25)
    SOIL = 7, Optics(0.25, 0.3), (0.47, 0.37, 0.26)
    MARKING = 8, Optics(0.55, 0.3, retro=0.6), (0.95, 0.95, 0.95)  # road paint with glass beads
    KERB = 9, Optics(0.30, 0.2), (0.75, 0.73, 0.70)  # the upright face of a kerb stone
    PLASTER_LIGHT = 10, Optics(0.45, 0.4), (0.90, 0.86, 0.76)
    PLASTER_DARK = 11, Optics(0.12, 0.4), (0.70, 0.60, 0.50)
    BRICK = 12, Optics(0.13, 0.4), (0.62, 0.33, 0.26)
    CONCRETE = 13, Optics(0.16, 0.4), (0.66, 0.66, 0.64)
    STONE = 14, Optics(0.14, 0.4), (0.60, 0.57, 0.50)
    WOOD = 15, Optics(0.16, 0.4), (0.55, 0.40, 0.25)
    ROOF = 16, Optics(0.12, 0.3), (0.52, 0.25, 0.20)
    WINDOW = 17, Optics(0.06, 0.4, specular=0.6), (0.25, 0.33, 0.42)  # opaque: the interior is not modelled
    METAL_SHEET = 18, Optics(0.15, 0.4, specular=0.3), (0.62, 0.65, 0.70)
    METAL_POLE = 19, Optics(0.15, 0.4, specular=0.2), (0.45, 0.47, 0.50)
    FOLIAGE = 20, Optics(0.25, 0.5), (0.20, 0.42, 0.16)
    BARK = 21, Optics(0.12, 0.4), (0.36, 0.27, 0.20)
    PAINT_LIGHT = 22, Optics(0.45, 0.2, specular=0.1), (0.90, 0.90, 0.92)
    PAINT_MEDIUM = 23, Optics(0.12, 0.4, specular=0.15), (0.35, 0.50, 0.75)
    PAINT_DARK = 24, Optics(0.04, 0.3, specular=0.2), (0.45, 0.10, 0.12)
    PAINT_BLACK = 25, Optics(0.015, 0.3, specular=0.25), (0.10, 0.10, 0.11)
    TYRE = 26, Optics(0.06, 0.2), (0.08, 0.08, 0.08)
    CAR_GLASS = 27, Optics(0.04, 0.3, specular=0.3, transmission=0.8), (0.30, 0.38, 0.42)
    PLASTIC_DARK = 28, Optics(0.08, 0.2), (0.15, 0.15, 0.16)
    PLATE = 29, Optics(0.60, 0.1, retro=8.0), (0.95, 0.95, 0.70)  # licence plate
    LAMP = (30, Optics(0.25, 0.2, retro=3.0, specular=0.2), (1.00, 0.75, 0.55))  # head and tail lamps
    SIGN = 31, Optics(0.50, 0.1, retro=12.0), (0.85, 0.15, 0.15)  # retroreflective sheeting
    CLOTH_LIGHT = 32, Optics(0.55, 0.3), (0.80, 0.70, 0.55)
    CLOTH_DARK = 33, Optics(0.25, 0.4), (0.22, 0.24, 0.38)
    SKIN = 34, Optics(0.50, 0.1), (0.85, 0.65, 0.55)
    HIGH_VIS = 35, Optics(0.70, 0.1, retro=6.0), (0.95, 0.85, 0.10)  # vests and reflector strips
    TARPAULIN = 36, Optics(0.50, 0.2), (0.30, 0.55, 0.60)
    EGO_VEHICLE = 37, Optics(0.35, 0.2, specular=0.15), (0.95, 0.55, 0.10)


M = Material
# Materials that a vehicle may drive over: hits on them make a cell free, hits on others make it occupied.
GROUND = frozenset(
    {M.ASPHALT, M.WORN_ASPHALT, M.WET_ASPHALT, M.COBBLES, M.PAVING, M.GRAVEL, M.GRASS, M.SOIL, M.MARKING}
)


def table() -> np.ndarray:
    """Return the optics of all materials as an array for kernels.

    Returns
    -------
    (materials, 5) float32
        Row m: reflectivity, spread, retro, specular, transmission of `Material` m.
    """
    return np.array([material.optics for material in sorted(Material)], np.float32)
