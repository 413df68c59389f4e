"""Pictures of a world map in tiles, as maps on web pages have them."""

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.plot.colours import colours
from ogm.storage.files import atomic_write
from ogm.world.world_map import WorldMap


def write_pyramid(world: WorldMap, folder: str | os.PathLike[str]) -> int:
    """Write a picture per tile of every level, ``z/x/y.png``; return how many.

    Level z = 0 is the coarsest; x counts along the map's x, to the right, and y against its y, downwards, both from the
    same corner at all levels, which ``tiles.json`` states with the side of a cell. Free and occupied have the colours
    of `ogm.plot.colours`, and what is unknown is transparent. Tiles in which nothing was seen have no picture.

    Parameters
    ----------
    world : WorldMap
        With overviews, `WorldMap.build_overviews`.
    folder : path
        New or empty.

    Raises
    ------
    ValueError
        If the folder holds something, or the map is empty or has no overviews.
    """
    from PIL import Image

    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder} holds files already; give a new or empty folder")
    levels = world.levels
    if levels < 2:
        raise ValueError(f"{world.url} has no overviews: WorldMap.build_overviews makes them (`ogm world build` does)")
    coarsest = world.store.tiles(levels - 1)
    if not coarsest:
        raise ValueError(f"{world.url} is empty")
    left, top = min(i for i, _ in coarsest), max(j for _, j in coarsest) + 1  # at the coarsest level
    written = 0
    for z in range(levels):
        level, factor = levels - 1 - z, 2**z
        for i, j in world.store.tiles(level):
            grid = world.window(world.layout.spec(world.layout.box_of((i, j)), level), level=level)
            path = folder / str(z) / str(i - left * factor) / f"{top * factor - 1 - j}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(path) as file:
                Image.fromarray(_colours(grid.mass)).save(file, "PNG")
            written += 1
    side = world.layout.tile * world.layout.resolution * 2 ** (levels - 1)
    facts: dict[str, Any] = {
        "levels": levels,
        "tile": world.layout.tile,
        "resolution": [world.layout.resolution * 2 ** (levels - 1 - z) for z in range(levels)],
        "corner": [left * side, top * side],
        "crs": world.crs,
    }
    with atomic_write(folder / "tiles.json", "w") as file:
        json.dump(facts, file, indent=1)
    return written


def _colours(mass: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return red, green, blue and opacity of masses (nx, ny, 2), greatest y first."""
    known = mass.sum(axis=-1)
    share = mass / np.maximum(known, 1e-6)[..., None]
    shades = np.concatenate([colours().mix(share), known[..., None]], axis=-1)
    return np.ascontiguousarray(np.rint(255 * shades).astype(np.uint8)[:, ::-1].swapaxes(0, 1))
