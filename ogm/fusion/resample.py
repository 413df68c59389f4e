"""Grids on other cells: through poses, coarser and finer.

All results are masses. The methods differ in the belief of a cell that covers several others.
"""

import math
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.fusion.lookup import ScanLookup, gather
from ogm.fusion.window import affine_between, cell_transform, check_choice, planar_transform
from ogm.grid import EvidentialGrid, GridSpec
from ogm.jit import kernel
from ogm.pose import check_pose

ResampleMethod = Literal["area", "nearest", "cautious"]
Reduce = Literal["mean", "occupied", "cautious"]


def warp(grid: EvidentialGrid, spec: GridSpec, T_to_from: ArrayLike, method: ResampleMethod = "area") -> EvidentialGrid:
    """Return a grid in another frame, resampled once.

    Parameters
    ----------
    grid : EvidentialGrid
        In the "from" frame.
    spec : GridSpec
        The cells to fill, in the "to" frame.
    T_to_from : (4, 4) array
        Its x, y part counts, projected along the vertical.
    method : {"area", "nearest", "cautious"}
        "area": the mean of the cells it covers, weighted by the exact area of overlap: a mixture, right where it is
        uncertain which cell is meant. Sums of mass times area are kept, but for tilted poses, which shrink areas.
        "nearest": the cell that holds its centre; nothing is mixed, but cells are lost where the new ones are coarser.
        "cautious": as "area", but the dissonance from mixing free cells with occupied ones becomes unknown.
        Outside `grid` all is unknown.

    Returns
    -------
    EvidentialGrid

    Notes
    -----
    "cautious": for m = min(F, O) of the mixture less the mixture of the cells' own min(F, O), F and O lose m each, and
    unknown gains 2 m. Repeated warping blurs: warp from the same original instead.
    """
    affine = affine_between(spec, grid.spec, check_pose(T_to_from, "T_to_from"))
    return EvidentialGrid.trusted(spec, _resampled(grid.mass, spec, affine, method))


def coarsen(grid: EvidentialGrid, factor: int, reduce: Reduce = "mean") -> EvidentialGrid:
    """Merge blocks of cells into one each.

    Parameters
    ----------
    grid : EvidentialGrid
    factor : int
        Cells per block along each axis; both counts must be multiples of it.
    reduce : {"mean", "occupied", "cautious"}
        "mean": the mixture, in which one occupied cell among free ones nearly vanishes. "occupied": the
        greatest occupied of the block, and the mean of free as far as the sum allows. "cautious": the greatest
        occupied and the least free.
    """
    check_choice("reduce", reduce, Reduce)
    if not (math.isfinite(factor) and factor == int(factor) and factor >= 1):
        raise ValueError(f"factor must be a positive whole number, got {factor}")
    n = int(factor)
    nx, ny = grid.spec.shape
    if nx % n or ny % n:
        raise ValueError(f"{nx} x {ny} cells are no whole blocks of {n} x {n}; choose a factor that divides both")
    blocks = grid.mass.reshape(nx // n, n, ny // n, n, 2)
    mass = blocks.mean(axis=(1, 3))
    if reduce != "mean":
        mass[..., 1] = blocks[..., 1].max(axis=(1, 3))
        free = mass[..., 0] if reduce == "occupied" else blocks[..., 0].min(axis=(1, 3))
        mass[..., 0] = np.minimum(free, 1 - mass[..., 1])
    spec = GridSpec(grid.spec.resolution * n, (nx // n, ny // n), grid.spec.origin)
    return EvidentialGrid.trusted(spec, mass)


def resample_to(grid: EvidentialGrid, spec: GridSpec, method: ResampleMethod | None = None) -> EvidentialGrid:
    """Return a grid on the cells of `spec`, in the same frame.

    Where each cell of `spec` is a cell of the grid or a whole part of one, over the same area, masses are repeated and
    nothing is interpolated.

    Parameters
    ----------
    grid : EvidentialGrid
    spec : GridSpec
    method : {"area", "nearest", "cautious"}, optional
        For all other cells, see `warp`; by default they are refused.

    Raises
    ------
    ValueError
        If `spec` covers another area, or its cells do not divide those of the grid, and no method is given.
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
            f"the grid has {grid.spec}, but wanted are {spec}; make the model with that spec, or with whole multiples "
            "of its cells over the same area, or give a resampling method"
        )
    return warp(grid, spec, np.eye(4), method)


def view_layers(
    layers: NDArray[np.float32],
    source: GridSpec,
    spec: GridSpec,
    T_map_vehicle: ArrayLike,
    method: ResampleMethod = "nearest",
) -> NDArray[np.float32]:
    """Return pairs of layers of a map in the vehicle's axes.

    The centre of every cell, in the vehicle's plane, is projected onto the map along the map's vertical, as scans are
    when they are fused. It is not `warp` by the inverse pose, which projects along the vehicle's own vertical.

    Parameters
    ----------
    layers : (mx, my, 2) float32
    source, spec : GridSpec
        Cells of the map, in its frame, and of the view, in the vehicle's.
    T_map_vehicle : (4, 4) array
    method : {"nearest", "area", "cautious"}

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
        _overlap(source, affine, method == "cautious", out)
    return out


@kernel
def _overlap(source: np.ndarray, affine: np.ndarray, cautious: bool, out: np.ndarray) -> None:
    """Fill each cell with the mean of `source` over its parallelogram, weighted by exact areas."""
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
                    if f == 0 and o == 0:
                        continue
                    share = _clipped_area(corners, a, b, work) / whole
                    free += share * f
                    occupied += share * o
                    own += share * min(f, o)
            if cautious:
                mixed = max(min(free, occupied) - own, 0.0)
                free -= mixed
                occupied -= mixed
            known = free + occupied
            if known > 1:  # rounding of areas
                free, occupied = free / known, occupied / known
            out[i, j, 0], out[i, j, 1] = free, occupied


@kernel
def _clipped_area(corners: Any, a: int, b: int, work: Any) -> float:
    """Return the area that a quadrilateral has in common with the cell (a, b) (Sutherland and Hodgman, 1974)."""
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
            here, there = sign * (polygon[k, axis] - edge), sign * (polygon[m, axis] - edge)
            if here >= 0:
                other[n] = polygon[k]
                n += 1
            if (here > 0 > there) or (here < 0 < there):
                t = here / (here - there)
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
