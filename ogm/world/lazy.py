"""A world map as an `xarray.Dataset` that is read when it is computed, by Dask."""

from typing import TYPE_CHECKING, Any

import numpy as np

from ogm.io.reading import optional
from ogm.world.world_map import WorldMap

if TYPE_CHECKING:
    from xarray import Dataset


class _Part:
    """Some cells of an array of layers: Dask lists all chunks of what it is given, and a map's lattice has 10¹³."""

    ndim = 3

    def __init__(self, array: Any, first: tuple[int, int], shape: tuple[int, int]) -> None:
        self._array, self._first, self.dtype, self.shape = array, first, array.dtype, (array.shape[0], *shape)

    def __getitem__(self, index: tuple[slice, slice, slice]) -> Any:
        layers, *axes = index
        moved = [slice(one.start + low, one.stop + low) for one, low in zip(axes, self._first, strict=True)]
        return self._array[layers, *moved]


def world_to_xarray(world: WorldMap, level: int = 0) -> "Dataset":
    """Return all tiles of a map as variables of Dask arrays; nothing is read before it is computed.

    Parameters
    ----------
    world : WorldMap
        What is not flushed is not in it.
    level : int
        Of overviews.

    Returns
    -------
    xarray.Dataset
        ``free`` and ``occupied`` of dims (y, x), float32 in [0, 1], in chunks of a tile; at level 0 also ``count``.
        Coordinates ``x`` and ``y`` of the cells' centres [m], increasing; attributes ``resolution`` [m] and, if known,
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
    from_array: Any = dask.array.from_array  # without types
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
