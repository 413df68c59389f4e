"""Saved maps cut, on other cells, and merged, with their conflict and other layers.

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
    """Return the cells of a map that an area touches, with all that they hold.

    Parameters
    ----------
    grid : PlacedGrid, EvidentialGrid, DynamicGrid or LayeredGrid
    extent : (x_min, x_max, y_min, y_max)
        In the grid's own coordinates [m]; cells beyond the map are left out.

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
            f"the area x {x0:g} to {x1:g} m, y {y0:g} to {y1:g} m has no cell of the map, which has {source}"
        )
    (i, j), (k, m) = low, high
    corner = source.origin[0] + i * source.resolution, source.origin[1] + j * source.resolution
    spec = GridSpec(source.resolution, (k - i, m - j), corner)

    def cut(grid: Any) -> Any:
        if isinstance(grid, LayeredGrid):
            return LayeredGrid(spec, {name: layer[i:k, j:m] for name, layer in grid.layers.items()})
        if isinstance(grid, DynamicGrid):
            parts = (one[i:k, j:m] for one in (grid.mass, grid.velocity, grid.covariance))
            return DynamicGrid.trusted(spec, *parts)
        return EvidentialGrid.trusted(spec, grid.mass[i:k, j:m])

    return replace(placed, grid=cut(placed.grid), layers=placed.layers and cut(placed.layers))


def resampled(grid: AnyGrid | PlacedGrid, spec: GridSpec | float, method: ResampleMethod = "worst") -> PlacedGrid:
    """Return a map on other cells, in its own coordinates.

    Parameters
    ----------
    grid : PlacedGrid, EvidentialGrid or LayeredGrid
        `DynamicGrid.to_evidential` gives the masses of a dynamic map.
    spec : GridSpec or float
        The cells, or their side [m], from the same corner on.
    method : {"worst", "area", "nearest", "cautious"}
        Of masses, see `ogm.fusion.resample_to`: by default free is never enlarged. Of conflict counts the greatest of
        the cells that a new cell covers, of other layers that at its centre. The maps of several models that a map was
        combined from are left out, unless the cells are of one lattice.

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
    """Return two maps as one, on the cells of the first and as many more as the second needs.

    Parameters
    ----------
    first, second : PlacedGrid, EvidentialGrid or LayeredGrid
    T_first_second : (4, 4) array, optional
        Takes the frame of the second to that of the first; identity by default.
    rule : function
        Combines the masses, ``rule(first, second)``. The default treats the maps as dependent: of evidence that both
        have, the stronger counts. `ogm.evidence.dempster` takes them for independent, `ogm.evidence.revise` lets the
        second contradict the first.
    method : {"worst", "area", "nearest", "cautious"}
        For cells of the second that are turned, or lie between those of the first, see `resampled`.

    Returns
    -------
    PlacedGrid
        In the place of the first. Of conflict it has the greater, of other layers the values of the first, and those of
        the second where the first has none; its stamp is the later one.

    Raises
    ------
    TypeError
        If a map is dynamic.
    ValueError
        If one has masses and the other layers alone, or coordinate reference systems differ.
    """
    first, second = (PlacedGrid.of(one).without_models() for one in (first, second))
    if first.crs and second.crs and first.crs != second.crs:
        raise ValueError(f"the maps have different coordinate reference systems, {first.crs} and {second.crs}")
    if isinstance(first.grid, LayeredGrid) != isinstance(second.grid, LayeredGrid):
        raise ValueError("one map has masses of free and occupied, the other layers alone: merge maps of one kind")
    T = np.eye(4) if T_first_second is None else check_pose(T_first_second, "T_first_second")
    T = inverse(first.T_frame_grid) @ T @ second.T_frame_grid  # from the cells of one to those of the other
    spec = extended(first.grid.spec, second.grid.spec, T)
    a, b = _moved(first, spec, np.eye(4), method), _moved(second, spec, T, method)
    grid: AnyGrid
    if isinstance(a.grid, LayeredGrid) and isinstance(b.grid, LayeredGrid):
        grid, layers = LayeredGrid(spec, _joined(a.grid, b.grid)), None
    else:
        grid = EvidentialGrid(spec, np.asarray(rule(a.evidential.mass, b.evidential.mass), np.float32))
        joined = _joined(a.layers, b.layers)
        layers = LayeredGrid(spec, joined) if joined else None
    stamps = [one.stamp for one in (first, second) if one.stamp is not None]
    return replace(first, grid=grid, layers=layers, stamp=max(stamps, default=None), crs=first.crs or second.crs)


def _joined(first: LayeredGrid | None, second: LayeredGrid | None) -> dict[str, NDArray[np.float32]]:
    """Return the layers of two grids: the greater conflict, else the values of the first where it has one."""
    joined = dict(first.layers) if first else {}
    for name, layer in second.layers.items() if second else ():
        own = joined.get(name, layer)
        joined[name] = np.fmax(own, layer) if name in CONFLICT_LAYERS else np.where(np.isnan(own), layer, own)
    return joined


def extended(spec: GridSpec, other: GridSpec, T: ArrayLike | None = None) -> GridSpec:
    """Return the cells of one grid and as many more as another needs, which `T`, (4, 4), takes to its coordinates."""
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
    """Return a map and its layers on other cells, whose coordinates `T` takes its own to."""
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
