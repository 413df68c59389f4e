"""What surfaces do at 77 GHz: how much of a radar's power comes back, and how much goes on as from a mirror."""

import math

import numpy as np
from numpy.typing import NDArray

from ogm.simulation.arrays import Floats, Floats32
from ogm.simulation.materials import GROUND, Material

FLASH = math.radians(4.0)  # width of specular reflection: facades and panels are not flat
GRAZING = math.radians(6.0)  # at which the ground ceases to be a mirror

# Of each material: diffuse echo per area across the beam [dB], extra echo of a mirror that faces the sensor [dB],
# share of the power that a mirror sends on. Effective values, ours: chosen for published cross sections of whole
# things (cars 10, lorries 20, people -8 dBsm) and for weak ground; corners and wheels of metal are in those of paint.
_WALL, _METAL, _BODY, _SOFT = (-14, 14, 0.2), (0, 18, 0.6), (5, 15, 0.5), (-12, 0, 0.0)
_GROUNDS = {Material.GRASS: -24, Material.SOIL: -25, Material.GRAVEL: -23, Material.COBBLES: -24, Material.PAVING: -30}
_ECHO: dict[Material, tuple[float, float, float]] = {
    **{one: (-30, 0, 0.5) for one in GROUND},
    **{one: (level, 0, 0.2) for one, level in _GROUNDS.items()},
    **{one: _WALL for one in (Material.PLASTER_LIGHT, Material.PLASTER_DARK, Material.BRICK, Material.CONCRETE)},
    **{one: _WALL for one in (Material.STONE, Material.ROOF, Material.KERB)},
    Material.WINDOW: (-20, 14, 0.3),
    Material.CAR_GLASS: (-10, 10, 0.2),
    **{one: _METAL for one in (Material.METAL_SHEET, Material.METAL_POLE, Material.SIGN)},
    **{one: _BODY for one in (Material.PAINT_LIGHT, Material.PAINT_MEDIUM, Material.PAINT_DARK, Material.PAINT_BLACK)},
    **{one: _BODY for one in (Material.PLATE, Material.LAMP, Material.TYRE, Material.EGO_VEHICLE)},
    Material.TARPAULIN: (3, 10, 0.2),
    Material.PLASTIC_DARK: (-8, 0, 0.0),
    Material.WOOD: (-14, 4, 0.05),
    Material.BARK: (-10, 0, 0.0),
    Material.FOLIAGE: (-15, 0, 0.0),
    **{one: (-6, 0, 0.0) for one in (Material.CLOTH_LIGHT, Material.CLOTH_DARK, Material.SKIN, Material.HIGH_VIS)},
}
_TABLE = np.zeros((256, 3))
for _material in Material:
    _diffuse, _flash, _share = _ECHO.get(_material, _SOFT)
    _TABLE[_material] = 10 ** (_diffuse / 10), 10 ** (_flash / 10) if _flash else 0.0, _share
IS_GROUND = np.zeros(256, np.bool_)
IS_GROUND[list(GROUND)] = True


def cross_section(material: NDArray[np.uint8], cosine: Floats32) -> Floats:
    """Return the radar cross section per area across the beam."""
    angle = np.arccos(np.clip(cosine, 0.0, 1.0)).astype(np.float64)
    return np.asarray(_TABLE[material, 0] + _TABLE[material, 1] * np.exp(-((angle / FLASH) ** 2)))


def mirror_share(material: NDArray[np.uint8], cosine: Floats32) -> Floats:
    """Return the share of the power that goes on as from a mirror; of the ground only at a grazing angle."""
    grazing = np.arcsin(np.clip(cosine, 0.0, 1.0)).astype(np.float64)
    return np.asarray(_TABLE[material, 2] * np.where(IS_GROUND[material], np.exp(-((grazing / GRAZING) ** 2)), 1.0))
