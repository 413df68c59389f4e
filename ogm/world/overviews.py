"""Levels of half the resolution each: a city on one screen, in which walls and poles stay visible."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.resample import coarsen
from ogm.grid import EvidentialGrid, GridSpec
from ogm.world.kernels import MASS_STEPS
from ogm.world.layout import WorldLayout
from ogm.world.packing import mass_of
from ogm.world.tiles import TileStore


def make_overviews(store: TileStore) -> int:
    """Make all levels above 0 anew, tile by tile, until four tiles hold all; return the number of levels."""
    layout, level, tiles = store.layout, 0, store.tiles()
    n = layout.tile
    for above in reversed(range(1, store.levels)):
        store.remove_level(above)
    while level == 0 or (tiles and np.ptp(tiles, axis=0).max() > 1):
        level += 1
        there, tiles = set(tiles), sorted({(i >> 1, j >> 1) for i, j in tiles})
        store.make_level(level)
        for index in tiles:
            made = layout.empty_tile(2)
            for di, dj in ((0, 0), (0, 1), (1, 0), (1, 1)):
                below = 2 * index[0] + di, 2 * index[1] + dj
                if below in there:
                    stored = store.read(layout.box_of(below), level - 1, slice(0, 2))
                    rows, columns = slice(di * n // 2, (di + 1) * n // 2), slice(dj * n // 2, (dj + 1) * n // 2)
                    made[:, rows, columns] = _halved(stored, layout)
            store.write_tile(index, made, level)
    return level + 1


def _halved(stored: NDArray[Any], layout: WorldLayout) -> NDArray[Any]:
    """Return stored masses (2, n, n) at half the resolution, stored again."""
    n = stored.shape[1]
    grid = EvidentialGrid.trusted(GridSpec(1.0, (n, n), (0.0, 0.0)), mass_of(stored, layout))
    half: NDArray[Any] = coarsen(grid, 2, "occupied").mass
    if layout.dtype == "float32":
        return half.transpose(2, 0, 1)
    steps: NDArray[Any] = np.rint(half * np.float32(MASS_STEPS)).astype(np.uint16)
    steps[..., 0] = np.minimum(steps[..., 0], MASS_STEPS - steps[..., 1])
    return steps.transpose(2, 0, 1)
