"""Resampling of grids: through poses, to coarser and to finer cells.

All results are masses. The methods differ in the masses of a cell that covers several others.
"""

import math
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.fusion.lookup import EPS_CELL, ScanLookup, gather
from ogm.fusion.window import affine_between, cell_transform, check_choice, planar_transform
from ogm.grid import EvidentialGrid, GridSpec
from ogm.jit import kernel
from ogm.pose import check_pose

ResampleMethod = Literal["area", "nearest", "cautious", "worst"]
_MODES = {"area": 0, "cautious": 1, "worst": 2}  # modes of `_overlap`
_TOUCHED = 1e-6  # [cells] overlap in area below which two cells only touch, by rounding
_SAME_LATTICE = 1e-3  # [cells] largest shift that rounding of origins can cause


def warp(grid: EvidentialGrid, spec: GridSpec, T_to_from: ArrayLike, method: ResampleMethod = "area") -> EvidentialGrid:
    """Return a grid in another frame, resampled once.

    Parameters
    ----------
    grid : EvidentialGrid
        In the "from" frame.
    spec : GridSpec
        Cells of the result, in the "to" frame.
    T_to_from : (4, 4) array
        Its x, y part is used, projected along the vertical.
    method : {"area", "nearest", "cautious", "worst"}
        "area": mean of the covered cells, weighted by the exact area of overlap. It is a mixture, correct if it is
        uncertain which cell is meant. Sums of mass times area are kept, except for tilted poses, which shrink areas.
        "nearest": the cell that holds the centre. Nothing is mixed, but some cells are lost if the new cells are
        coarser. "cautious": as "area", but dissonance from mixing free with occupied cells becomes unknown. "worst":
        least free and greatest occupied of all cells that are covered at least in part, so free is never enlarged and
        nothing occupied is lost. Outside `grid` all is unknown.

    Returns
    -------
    EvidentialGrid

    Notes
    -----
    "cautious": with m = min(F, O) of the mixture minus the mixture of min(F, O) of the cells, F and O lose m each, and
    unknown gains 2 m. Repeated warping blurs: always warp from the original.
    """
    affine = affine_between(spec, grid.spec, check_pose(T_to_from, "T_to_from"))
    return EvidentialGrid.trusted(spec, _resampled(grid.mass, spec, affine, method))


def resample_to(grid: EvidentialGrid, spec: GridSpec, method: ResampleMethod | None = "worst") -> EvidentialGrid:
    """Return a grid on the cells of `spec`, in the same frame.

    New cells that coincide with cells of the grid, or are whole parts of one, copy its masses with every method. For
    grids with layers use `ogm.fusion.resampled`.

    Parameters
    ----------
    grid : EvidentialGrid
    spec : GridSpec
    method : {"worst", "area", "nearest", "cautious"} or None
        Method for all other cells, see `warp`. By default a cell takes the least free and the greatest occupied of the
        cells that it covers. None refuses such cells.

    Raises
    ------
    ValueError
        If the cells of `spec` are not whole parts of the grid's cells over the same area, and `method` is None.
    """
    if grid.spec == spec:
        return grid
    factor = round(grid.spec.resolution / spec.resolution)
    if factor >= 1 and (
        (grid.spec.shape[0] * factor, grid.spec.shape[1] * factor) == spec.shape
        and np.allclose(grid.spec.extent, spec.extent, rtol=0, atol=1e-3 * spec.resolution)
    ):
        return EvidentialGrid.trusted(spec, grid.mass.repeat(factor, axis=0).repeat(factor, axis=1))
    if method is None:
        raise ValueError(
            f"the grid has {grid.spec}, wanted {spec}: make the model with this spec, or with whole multiples of its "
            "cells over the same area, or give a resampling method"
        )
    if lattice_offset(grid.spec, spec) is not None:
        return EvidentialGrid.trusted(spec, cells_at(grid.mass, grid.spec, spec))
    return warp(grid, spec, np.eye(4), method)


def lattice_offset(source: GridSpec, spec: GridSpec) -> tuple[int, int] | None:
    """Return the index in `source` of the first cell of `spec`; None if their cells are not of the same lattice."""
    shift = (np.array(spec.origin) - source.origin) / source.resolution
    if not math.isclose(spec.resolution, source.resolution) or np.abs(shift - np.rint(shift)).max() > _SAME_LATTICE:
        return None
    i, j = np.rint(shift).astype(int).tolist()
    return i, j


def cells_at(array: NDArray[Any], source: GridSpec, spec: GridSpec, outside: float = 0.0) -> NDArray[Any]:
    """Return values of cells, (nx, ny, ...), at other cells of the same lattice.

    Parameters
    ----------
    array : (mx, my, ...) array
        Values at the cells of `source`.
    source, spec : GridSpec
        See `lattice_offset`.
    outside : float
        Value of cells outside of `source`.
    """
    offset = lattice_offset(source, spec)
    assert offset is not None
    made = np.full((*spec.shape, *array.shape[2:]), outside, array.dtype)
    low = [max(-k, 0) for k in offset]
    high = [min(m - k, n) for k, m, n in zip(offset, source.shape, spec.shape, strict=True)]
    if all(a < b for a, b in zip(low, high, strict=True)):
        overlap = tuple(slice(a + k, b + k) for a, b, k in zip(low, high, offset, strict=True))
        made[low[0] : high[0], low[1] : high[1]] = array[overlap]
    return made


def values_at_centres(array: NDArray[np.float32], spec: GridSpec, affine: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return the values of the cells that hold the centres of the cells of `spec`, (nx, ny); NaN outside.

    Parameters
    ----------
    array : (mx, my) float32
    spec : GridSpec
    affine : (2, 3) float64
        See `ogm.fusion.window.affine_between`.
    """
    i, j = (np.arange(n) + 0.5 for n in spec.shape)
    u, v = (np.floor(np.add.outer(row[0] * i, row[1] * j) + row[2] + EPS_CELL).astype(np.int64) for row in affine)
    inside = (u >= 0) & (u < array.shape[0]) & (v >= 0) & (v < array.shape[1])
    values = np.full(spec.shape, np.nan, np.float32)
    values[inside] = array[u[inside], v[inside]]
    return values


def view_layers(
    layers: NDArray[np.float32],
    source: GridSpec,
    spec: GridSpec,
    T_map_vehicle: ArrayLike,
    method: ResampleMethod = "nearest",
) -> NDArray[np.float32]:
    """Return pairs of layers of a map in the vehicle's axes.

    The centre of each cell, in the vehicle's plane, is projected onto the map along the map's vertical, as in the
    fusion of scans. `warp` by the inverse pose differs: it projects along the vehicle's own vertical.

    Parameters
    ----------
    layers : (mx, my, 2) float32
    source, spec : GridSpec
        Cells of the map, in its frame, and cells of the view, in the vehicle's frame.
    T_map_vehicle : (4, 4) array
    method : {"nearest", "area", "cautious", "worst"}

    Returns
    -------
    (nx, ny, 2) float32
    """
    A, b = planar_transform(check_pose(T_map_vehicle, "T_map_vehicle"))
    return _resampled(layers, spec, cell_transform(spec, source, A, b), method)


def _resampled(
    layers: NDArray[np.float32], spec: GridSpec, affine: NDArray[np.float64], method: ResampleMethod
) -> NDArray[np.float32]:
    out = np.empty((*spec.shape, 2), np.float32)
    source = np.ascontiguousarray(layers)
    if check_choice("method", method, ResampleMethod) == "nearest":
        gather(ScanLookup(source, affine, 1), (0, 0), out.reshape(spec.shape[0], -1))
    else:
        _overlap(source, affine, _MODES[method], out)
    return out


@kernel
def _overlap(source: np.ndarray, affine: np.ndarray, mode: int, out: np.ndarray) -> None:
    """Fill each cell with the mean of `source` over its parallelogram, weighted by exact areas, or its extremes."""
    nx, ny = out.shape[0], out.shape[1]
    mx, my = source.shape[0], source.shape[1]
    a00, a01, a10, a11 = affine[0, 0], affine[0, 1], affine[1, 0], affine[1, 1]
    whole = abs(a00 * a11 - a01 * a10)
    reach_u, reach_v = 0.5 * (abs(a00) + abs(a01)), 0.5 * (abs(a10) + abs(a11))
    corners = np.empty((4, 2))
    work = np.empty((2, 12, 2))
    for i in range(nx):
        for j in range(ny):
            u = a00 * (i + 0.5) + a01 * (j + 0.5) + affine[0, 2]
            v = a10 * (i + 0.5) + a11 * (j + 0.5) + affine[1, 2]
            free = occupied = own = 0.0
            if mode == 2 and min(u - reach_u, v - reach_v, mx - u - reach_u, my - v - reach_v) > -EPS_CELL:
                free = 1.0  # initial value of the minimum; it stays 0 if a part of the cell lies outside
            first, last = max(int(np.floor(u - reach_u)), 0), min(int(np.ceil(u + reach_u)), mx)
            left, right = max(int(np.floor(v - reach_v)), 0), min(int(np.ceil(v + reach_v)), my)
            for k in range(4):
                p = 0.5 if k == 0 or k == 3 else -0.5
                q = 0.5 if k < 2 else -0.5
                corners[k, 0] = u + p * a00 + q * a01
                corners[k, 1] = v + p * a10 + q * a11
            for a in range(first, last):
                for b in range(left, right):
                    f, o = source[a, b, 0], source[a, b, 1]
                    if (f >= free and o <= occupied) if mode == 2 else (f == 0 and o == 0):
                        continue  # no change
                    area = _clipped_area(corners, a, b, work)
                    if mode == 2:
                        if area > _TOUCHED * min(whole, 1.0):
                            free, occupied = min(free, f), max(occupied, o)
                        continue
                    share = area / whole
                    free += share * f
                    occupied += share * o
                    own += share * min(f, o)
            if mode == 1:
                mixed = max(min(free, occupied) - own, 0.0)
                free -= mixed
                occupied -= mixed
            known = free + occupied
            if mode == 2:
                free = min(free, 1.0 - occupied)
            elif known > 1:  # rounding of areas
                free, occupied = free / known, occupied / known
            out[i, j, 0], out[i, j, 1] = free, occupied


@kernel
def _clipped_area(corners: Any, a: int, b: int, work: Any) -> float:
    """Return the area common to a quadrilateral and the cell (a, b) (Sutherland and Hodgman, 1974)."""
    count = 4
    polygon, other = work[0], work[1]
    polygon[:4] = corners
    for side in range(4):
        axis = side // 2
        sign = 1.0 if side % 2 == 0 else -1.0
        edge = float(a if axis == 0 else b) + (0.0 if side % 2 == 0 else 1.0)
        n = 0
        for k in range(count):
            m = k + 1 if k + 1 < count else 0
            start, end = sign * (polygon[k, axis] - edge), sign * (polygon[m, axis] - edge)
            if start >= 0:
                other[n] = polygon[k]
                n += 1
            if (start > 0 > end) or (start < 0 < end):
                t = start / (start - end)
                other[n, 0] = polygon[k, 0] + t * (polygon[m, 0] - polygon[k, 0])
                other[n, 1] = polygon[k, 1] + t * (polygon[m, 1] - polygon[k, 1])
                n += 1
        polygon, other = other, polygon
        count = n
        if count == 0:
            return 0.0
    area = 0.0
    for k in range(count):
        m = k + 1 if k + 1 < count else 0
        area += (polygon[k, 0] - a) * (polygon[m, 1] - b) - (polygon[m, 0] - a) * (polygon[k, 1] - b)
    return abs(area) / 2
