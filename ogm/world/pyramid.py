"""Export of a world map: tiled pictures for web pages, and an `xarray.Dataset` backed by Dask."""

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ogm.io.reading import optional
from ogm.plot.colours import colours
from ogm.storage.files import atomic_write
from ogm.world.world_map import WorldMap

if TYPE_CHECKING:
    from xarray import Dataset


def write_pyramid(world: WorldMap, folder: str | os.PathLike[str]) -> int:
    """Write a picture of each tile of every level, ``z/x/y.png``; return the number of pictures.

    Level z = 0 is the coarsest. x counts along the map's x, to the right, and y against its y, downwards. Both start
    from the same corner at all levels; ``tiles.json`` states this corner and the sides of the cells. Free and occupied
    have the colours of `ogm.plot.colours`; unknown is transparent. Unseen tiles have no picture.

    Parameters
    ----------
    world : WorldMap
        Map with overviews, see `WorldMap.build_overviews`.
    folder : path
        New or empty.

    Raises
    ------
    ValueError
        If the folder contains files, or the map is empty or has no overviews.
    """
    from PIL import Image

    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ValueError(f"{folder} contains files already: give a new or empty folder")
    levels = world.levels
    if levels < 2:
        raise ValueError(f"{world.url} has no overviews: make them by WorldMap.build_overviews or `ogm world build`")
    coarsest = world.store.tiles(levels - 1)
    if not coarsest:
        raise ValueError(f"{world.url} is empty: integrate grids or build drives into it")
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
    """Return red, green, blue and opacity for masses (nx, ny, 2), greatest y first."""
    known = mass.sum(axis=-1)
    share = mass / np.maximum(known, 1e-6)[..., None]
    shades = np.concatenate([colours().mix(share), known[..., None]], axis=-1)
    return np.ascontiguousarray(np.rint(255 * shades).astype(np.uint8)[:, ::-1].swapaxes(0, 1))


class _Part:
    """Part of an array of layers: Dask lists all chunks of an array, and the lattice of a map has 10¹³."""

    ndim = 3

    def __init__(self, array: Any, first: tuple[int, int], shape: tuple[int, int]) -> None:
        self._array, self._first, self.dtype, self.shape = array, first, array.dtype, (array.shape[0], *shape)

    def __getitem__(self, index: tuple[slice, slice, slice]) -> Any:
        layers, *axes = index
        moved = [slice(part.start + low, part.stop + low) for part, low in zip(axes, self._first, strict=True)]
        return self._array[layers, *moved]


def world_to_xarray(world: WorldMap, level: int = 0) -> "Dataset":
    """Return all tiles of a map as variables of Dask arrays, read when they are computed.

    Parameters
    ----------
    world : WorldMap
        The map; unflushed changes are not included.
    level : int
        Level of the overviews.

    Returns
    -------
    xarray.Dataset
        ``free`` and ``occupied`` with dims (y, x), float32 in [0, 1], in chunks of a tile; at level 0 also ``count``.
        Coordinates ``x`` and ``y`` of the cells' centres [m], increasing. Attributes ``resolution`` [m] and, if known,
        ``crs``.

    Raises
    ------
    ValueError
        If the map is empty.
    ImportError
        If xarray or Dask is missing.
    """
    from pathlib import Path

    xarray = optional("xarray", Path("an xarray.Dataset"), "geo", "made")
    import dask.array

    spec, layout = world.cells(level=level), world.layout
    box, offset, tile = layout.aligned(spec, level), layout.cells >> (level + 1), layout.tile
    assert box is not None
    part = _Part(world.store.array(level), (box[0] + offset, box[2] + offset), spec.shape)
    from_array: Any = dask.array.from_array  # untyped
    cells = from_array(part, chunks=(1, tile, tile), asarray=True)
    step = np.float32(layout.steps["mass"])
    described: dict[str, Any] = {}
    for k, name in enumerate(("free", "occupied")):
        mass = (cells[k].T * step).astype(np.float32)
        described[name] = (("y", "x"), mass, {"units": "1", "long_name": f"belief mass of {name}"})
    if level == 0:
        described["count"] = (("y", "x"), cells[4].T.astype(np.float32), {"units": "1", "long_name": "number of scans"})
    axes = {}
    for axis, centres in zip("yx", spec.cell_centers[::-1], strict=True):
        of_axis = {"units": "m", "axis": axis.upper(), "standard_name": f"projection_{axis}_coordinate"}
        axes[axis] = (axis, centres.ravel(), of_axis)
    facts: dict[str, Any] = {"Conventions": "CF-1.11", "title": "Evidential world map", "resolution": spec.resolution}
    dataset: Dataset = xarray.Dataset(described, axes, facts | ({"crs": world.crs} if world.crs else {}))
    return dataset
