"""Cropping, resampling and merging of saved maps, with their conflict and other layers.

>>> import numpy as np
>>> from ogm import EvidentialGrid, GridSpec
>>> from ogm.fusion import crop, merge, resampled
>>> from ogm.pose import pose
>>> spec = GridSpec(0.5, (4, 4), (0.0, 0.0))
>>> grid = EvidentialGrid(spec, np.full((4, 4, 2), (0.6, 0.1), np.float32))
>>> crop(grid, (0.0, 1.0, 0.5, 2.0)).grid.spec.shape
(2, 3)
>>> resampled(grid, GridSpec(1.0, (2, 2), (0.0, 0.0))).grid.at(0.5, 0.5)
Opinion(free=0.60, occupied=0.10, unknown=0.30)
>>> merge(grid, grid, pose(1.0)).grid.spec.shape
(6, 4)
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.evidence import cautious
from ogm.fusion.mapper import CONFLICT_LAYERS
from ogm.fusion.resample import ResampleMethod, cells_at, lattice_offset, resample_to, values_at_centres, warp
from ogm.fusion.window import affine_between, planar_transform
from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid
from ogm.io.grids.placed import PlacedGrid
from ogm.io.messages.grids import AnyGrid
from ogm.pose import check_pose, inverse

_ROUNDING = 1e-6  # [cells]


def crop(grid: AnyGrid | PlacedGrid, extent: Sequence[float]) -> PlacedGrid:
    """Return the cells of a map that an area touches, with all layers.

    Parameters
    ----------
    grid : PlacedGrid, EvidentialGrid, DynamicGrid or LayeredGrid
    extent : (x_min, x_max, y_min, y_max)
        Area in the grid's own coordinates [m]; its part beyond the map is ignored.

    Raises
    ------
    ValueError
        If the area is empty, or touches no cell.
    """
    placed, (x0, x1, y0, y1) = PlacedGrid.of(grid), map(float, extent)
    source = placed.grid.spec
    low, high = [], []
    for start, stop, edge, n in zip((x0, y0), (x1, y1), source.origin, source.shape, strict=True):
        low.append(max(math.floor((start - edge) / source.resolution + _ROUNDING), 0))
        high.append(min(math.ceil((stop - edge) / source.resolution - _ROUNDING), n))
    if not (x0 < x1 and y0 < y1) or min(b - a for a, b in zip(low, high, strict=True)) < 1:
        raise ValueError(
            f"the area x {x0:g} to {x1:g} m, y {y0:g} to {y1:g} m touches no cell of the map, which has {source}"
        )
    (i, j), (k, m) = low, high
    corner = source.origin[0] + i * source.resolution, source.origin[1] + j * source.resolution
    spec = GridSpec(source.resolution, (k - i, m - j), corner)

    def cut(grid: Any) -> Any:
        if isinstance(grid, LayeredGrid):
            return LayeredGrid(spec, {name: layer[i:k, j:m] for name, layer in grid.layers.items()})
        if isinstance(grid, DynamicGrid):
            parts = (array[i:k, j:m] for array in (grid.mass, grid.velocity, grid.covariance))
            return DynamicGrid.trusted(spec, *parts)
        return EvidentialGrid.trusted(spec, grid.mass[i:k, j:m])

    return replace(placed, grid=cut(placed.grid), layers=placed.layers and cut(placed.layers))


def resampled(grid: AnyGrid | PlacedGrid, spec: GridSpec | float, method: ResampleMethod = "worst") -> PlacedGrid:
    """Return a map on other cells, in its own coordinates.

    Parameters
    ----------
    grid : PlacedGrid, EvidentialGrid or LayeredGrid
        For a dynamic map, give the masses of `DynamicGrid.to_evidential`.
    spec : GridSpec or float
        The new cells, or their side [m], with the same corner.
    method : {"worst", "area", "nearest", "cautious"}
        Method for masses, see `ogm.fusion.resample_to`: the default never enlarges free. A new cell takes the greatest
        conflict of the cells that it covers; other layers take the value at its centre. Layers of several models are
        dropped, unless both grids have cells of the same lattice.

    Raises
    ------
    TypeError
        If the map is dynamic.
    """
    placed = PlacedGrid.of(grid)
    source = placed.grid.spec
    if not isinstance(spec, GridSpec):
        nx, ny = (math.ceil(n * source.resolution / spec - _ROUNDING) for n in source.shape)
        spec = GridSpec(spec, (nx, ny), source.origin)
    if source == spec:
        return placed
    return _moved(placed, spec, np.eye(4), method)


def merge(
    first: AnyGrid | PlacedGrid,
    second: AnyGrid | PlacedGrid,
    T_first_second: ArrayLike | None = None,  # noqa: N803
    *,
    rule: Callable[[Any, Any], Any] = cautious,
    method: ResampleMethod = "worst",
) -> PlacedGrid:
    """Merge two maps, on the cells of the first, extended to cover the second.

    Parameters
    ----------
    first, second : PlacedGrid, EvidentialGrid or LayeredGrid
    T_first_second : (4, 4) array, optional
        Transform from the frame of the second to the frame of the first; identity by default.
    rule : function
        Combines the masses, ``rule(first, second)``. The default treats the maps as dependent: the stronger evidence
        counts. `ogm.evidence.dempster` treats them as independent; with `ogm.evidence.revise` the second may contradict
        the first.
    method : {"worst", "area", "nearest", "cautious"}
        Method for cells of the second that do not coincide with cells of the first, see `resampled`.

    Returns
    -------
    PlacedGrid
        Placed as the first. It has the greater conflict; other layers have the values of the first, and where these are
        missing the values of the second. Its stamp is the later of both.

    Raises
    ------
    TypeError
        If a map is dynamic.
    ValueError
        If one map has masses and the other only layers, or coordinate reference systems differ.
    """
    first, second = (PlacedGrid.of(grid).without_models() for grid in (first, second))
    if first.crs and second.crs and first.crs != second.crs:
        raise ValueError(
            f"the maps have different coordinate reference systems, {first.crs} and {second.crs}: transform one of them"
        )
    if isinstance(first.grid, LayeredGrid) != isinstance(second.grid, LayeredGrid):
        raise ValueError("one map has masses of free and occupied, the other only layers: merge maps of one kind")
    T = np.eye(4) if T_first_second is None else check_pose(T_first_second, "T_first_second")
    T = inverse(first.T_frame_grid) @ T @ second.T_frame_grid  # from cells of the second to cells of the first
    spec = extended(first.grid.spec, second.grid.spec, T)
    a, b = _moved(first, spec, np.eye(4), method), _moved(second, spec, T, method)
    grid: AnyGrid
    if isinstance(a.grid, LayeredGrid) and isinstance(b.grid, LayeredGrid):
        grid, layers = LayeredGrid(spec, _joined(a.grid, b.grid)), None
    else:
        grid = EvidentialGrid(spec, np.asarray(rule(a.evidential.mass, b.evidential.mass), np.float32))
        joined = _joined(a.layers, b.layers)
        layers = LayeredGrid(spec, joined) if joined else None
    stamps = [placed.stamp for placed in (first, second) if placed.stamp is not None]
    return replace(first, grid=grid, layers=layers, stamp=max(stamps, default=None), crs=first.crs or second.crs)


def _joined(first: LayeredGrid | None, second: LayeredGrid | None) -> dict[str, NDArray[np.float32]]:
    """Return the layers of two grids: the greater conflict, else values of the first, and where NaN of the second."""
    joined = dict(first.layers) if first else {}
    for name, layer in second.layers.items() if second else ():
        own = joined.get(name, layer)
        joined[name] = np.fmax(own, layer) if name in CONFLICT_LAYERS else np.where(np.isnan(own), layer, own)
    return joined


def extended(spec: GridSpec, other: GridSpec, T: ArrayLike | None = None) -> GridSpec:
    """Return the cells of a grid, extended to cover another; `T` (4, 4) takes the other to the first's frame."""
    A, b = planar_transform(np.eye(4) if T is None else np.asarray(T, np.float64))
    x0, x1, y0, y1 = other.extent
    corners = np.array([(x, y) for x in (x0, x1) for y in (y0, y1)]) @ A.T + b
    places = (corners - spec.origin) / spec.resolution
    low = np.minimum(np.floor(places.min(axis=0) + _ROUNDING), 0).astype(int)
    high = np.maximum(np.ceil(places.max(axis=0) - _ROUNDING), spec.shape).astype(int)
    if not low.any():
        return replace(spec, shape=tuple((high - low).tolist()))
    origin = np.array(spec.origin) + low * spec.resolution
    return GridSpec(spec.resolution, tuple((high - low).tolist()), tuple(origin.tolist()))


def _moved(placed: PlacedGrid, spec: GridSpec, T: NDArray[np.float64], method: ResampleMethod) -> PlacedGrid:
    """Return a map with its layers on other cells; `T` takes its coordinates to the coordinates of `spec`."""
    grid, still = placed.grid, np.array_equal(T, np.eye(4))
    if isinstance(grid, DynamicGrid):
        raise TypeError("wanted a map of masses or layers, got a DynamicGrid: use its to_evidential()")
    affine = affine_between(spec, grid.spec, T)

    one_lattice = still and lattice_offset(grid.spec, spec) is not None

    def layer_at(name: str, layer: NDArray[np.float32]) -> NDArray[np.float32]:
        if one_lattice:
            return cells_at(layer, grid.spec, spec, 0.0 if name in CONFLICT_LAYERS else np.nan)
        if name not in CONFLICT_LAYERS:
            return values_at_centres(layer, spec, affine)
        conflict = np.stack([np.zeros_like(layer), np.nan_to_num(layer)], axis=-1)
        return warp(EvidentialGrid.trusted(grid.spec, conflict), spec, T, "worst").occupied

    def layers_at(layers: LayeredGrid) -> LayeredGrid:
        return LayeredGrid(spec, {name: layer_at(name, layer) for name, layer in layers.layers.items()})

    if not one_lattice:
        placed = placed.without_models()

    made: AnyGrid
    if isinstance(grid, LayeredGrid):
        made = layers_at(grid)
    else:
        made = resample_to(grid, spec, method) if still else warp(grid, spec, T, method)
    return replace(placed, grid=made, layers=placed.layers and layers_at(placed.layers))
