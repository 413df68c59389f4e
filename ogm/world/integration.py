"""A measurement grid into the tiles of a map."""

import math

import numpy as np
from numpy.typing import ArrayLike

from ogm.fusion.lookup import ScanLookup
from ogm.fusion.window import affine_between, samples_per_axis
from ogm.grid import EvidentialGrid
from ogm.pose import check_pose, check_stamp
from ogm.world.cache import TileCache
from ogm.world.kernels import integrate
from ogm.world.layout import WORLD_RULES, corners

_LATEST = 2**32 - 2  # [s] that the layers of the last stamp can hold


def integrate_grid(
    cache: TileCache,
    grid: EvidentialGrid,
    T_map_sensor: ArrayLike,  # noqa: N803
    *,
    stamp: float | None = None,
    reliability: float = 1.0,
) -> int:
    """Combine a measurement grid with tiles; see `WorldMap.integrate`."""
    if not isinstance(grid, EvidentialGrid):
        raise TypeError(f"a map is updated with an EvidentialGrid, got {type(grid).__name__}")
    if not 0 <= reliability <= 1:
        raise ValueError(f"reliability must be in [0, 1], got {reliability}")
    when, layout = _second(stamp), cache.tiles.layout
    T = check_pose(T_map_sensor, "T_map_sensor")
    box = layout.around(corners(grid.spec, T))
    layout.check_box(box)
    base = affine_between(layout.spec(box), grid.spec, T)
    mass, samples = np.ascontiguousarray(grid.mass, np.float32), samples_per_axis(layout.spec(box), grid.spec)
    rule, most, total = WORLD_RULES[layout.rule], 1 - layout.min_unknown, 0
    for index in layout.tiles_of(box):
        affine, at = base.copy(), layout.box_of(index)
        affine[:, 2] += base[:, :2] @ (at[0] - box[0], at[2] - box[2])
        scan, tile = ScanLookup(mass, affine, samples), cache.get(index)
        if changed := integrate(tile, scan, reliability, rule, most, when):
            cache.mark_changed(index)
            total += changed
    return total


def _second(stamp: float | None) -> int:
    """Return a stamp as it is stored: its whole second plus 1, 0 if unknown."""
    if stamp is None:
        return 0
    time = check_stamp(stamp)
    if not 0 <= time <= _LATEST:
        raise ValueError(f"stamp must be 0 to {_LATEST} s, got {time}")
    return math.floor(time) + 1
