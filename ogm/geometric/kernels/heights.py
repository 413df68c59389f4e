"""Heights of the cells of a scan: see `ogm.geometric.heights.height_layers`."""

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.kernels.arguments import Cells, HeightSpace, Surface
from ogm.geometric.kernels.height_sums import (
    COUNT,
    HANG,
    NO_SURFACE,
    SUM,
    TOP,
    add_row,
    find_bulges,
    finish_blocks,
    ground_cells,
    mended_surface,
)
from ogm.geometric.kernels.steps import (
    BOTTOM_SURFACE,
    HIGH,
    LOW,
    RISE,
    TOP_SURFACE,
    WIDTH,
    rises,
    slopes_of_row,
    steps_of_row,
    widen,
)
from ogm.jit import kernel

__all__ = ["PARTS", "WIDTH", "height_cells"]

GROUND, VARIANCE, SLOPE, STEP, ROUGHNESS, OBSTACLE, CLEARANCE = 0, 1, 2, 3, 4, 5, 6  # layers
BASE, SHIFT, MEAN, SPREAD, GAP, COUNTS, SUMS, TOPS, HANGS, FREE, USED, ROOF, PARTS = (WIDTH * k for k in range(6, 19))
BLOCK = 0.64  # [m] side of the blocks of cells for roughness and for filled gaps
SLOPE_REACH, STEP_REACH = 0.5, 0.35  # [m] on either side of a cell
MAX_FOOT_HEIGHT = np.float32(0.5)  # [m] largest height of the lowest return of an obstacle that stands on the ground
BULGE_REACH = 5.0  # [m] on either side of a possible roof
MAX_GAP = np.float32(3.0)  # [m] largest distance of known ground from a block with ground
MIN_FREE = np.float32(0.1)  # smallest mass of free of a cell in a gap with known ground
MIN_VARIANCE = np.float32(0.005**2)  # [m2] smallest variance of a height
MIN_NOISE = np.float32(0.01**2)  # [m2] smallest variance of a return
CELL_SHARE = np.float32(0.3)  # share of a block's variance within a cell
BEND = np.float32(0.04)  # largest change of the rise over run of ground in a gap


@kernel
def height_cells(
    mass: NDArray[np.float32],
    ground: Surface,
    ground_point: tuple[float, float, float],
    cells: Cells,
    work: HeightSpace,
) -> None:
    """Fill in the layers of `ogm.geometric.heights.height_layers`, in their order.

    Parameters
    ----------
    mass : (nx, ny, 2) float32
    ground : Surface
        Reference surface of the heights.
    ground_point : (x, y, z)
        Ground under the sensor [m].
    cells : Cells
    work : HeightSpace
    """
    out, wide, part = work
    nx, ny, side, valid = out.shape[1], out.shape[2], cells.resolution, ground_cells(out)

    # The surface without obstacles and roofs, and the difference to the ground
    per_metre, x0, y0 = float(ground.per_metre), float(ground.x0), float(ground.y0)
    scale, x, y = side * per_metre, (cells.x0 - x0) * per_metre, (cells.y0 - y0) * per_metre
    place = (ground_point[0] - x0) * per_metre, (ground_point[1] - y0) * per_metre
    under, bulges = np.float32(ground_point[2]), np.zeros(ground.height.shape, np.float32)
    mended = mended_surface(ground.height, valid, bulges, (x, y), scale, place, under)
    bulges = find_bulges(mended, max(int(BULGE_REACH * per_metre + 0.5), 1))
    mended = mended_surface(ground.height, valid, bulges, (x, y), scale, place, under)
    away = ground.height - mended
    base, shift = _stretched(mended, y, scale, ny), _stretched(away, y, scale, ny)

    # Means and variances of the returns about this surface in blocks, and the distance to the nearest block
    size = max(int(BLOCK / side + 0.5), 1)
    blocks = np.zeros((5, max((nx + size - 1) // size, 2), max((ny + size - 1) // size, 2)), np.float32)
    for i in range(nx):
        _interpolate(shift, (i + 0.5) * scale + x, part, SHIFT)
        add_row(out, valid, i, part, SHIFT, size, blocks)
    finish_blocks(blocks, np.float32(size * side))
    means, spreads = _stretched(blocks[0], 0.0, 1.0 / size, ny), _stretched(blocks[1], 0.0, 1.0 / size, ny)
    gaps = _stretched(blocks[2], 0.0, 1.0 / size, ny)

    # Layers of each row, and the highest and lowest surface along it
    along = _stretched(rises(mended, np.float32(scale)), y, scale, ny)
    across = _stretched(rises(mended.T.copy(), np.float32(scale)).T.copy(), y, scale, ny)
    roofs = _stretched(bulges, y, scale, ny)
    near, reach = np.float32(0.75 * size * side), max(int(STEP_REACH / side + 0.5), 1)
    for i in range(nx):
        _interpolate(base, (i + 0.5) * scale + x, part, BASE)
        _interpolate(shift, (i + 0.5) * scale + x, part, SHIFT)
        _interpolate(means, (i + 0.5) / size, part, MEAN)
        _interpolate(spreads, (i + 0.5) / size, part, SPREAD)
        _interpolate(gaps, (i + 0.5) / size, part, GAP)
        _interpolate(across, (i + 0.5) * scale + x, part, RISE)
        _interpolate(roofs, (i + 0.5) * scale + x, part, ROOF)
        for j in range(ny & 0x7FFF):
            part[COUNTS + j], part[SUMS + j] = out[COUNT, i, j], out[SUM, i, j]
            part[TOPS + j], part[HANGS + j] = out[TOP, i, j], out[HANG, i, j]
        for j in range(ny & 0x7FFF):
            part[FREE + j] = mass[i, j, 0]
            part[USED + j] = out[COUNT, i, j] if valid[i, j] else np.float32(0.0)
        _fill_row(part, ny, near)
        for j in range(ny & 0x7FFF):
            out[GROUND, i, j], out[VARIANCE, i, j] = part[BASE + j], part[GAP + j]
        for j in range(ny & 0x7FFF):
            out[ROUGHNESS, i, j], out[OBSTACLE, i, j] = part[SPREAD + j], part[TOPS + j]
            out[CLEARANCE, i, j] = part[HANGS + j]
        widen(part, ny, reach)
        for j in range(ny & 0x7FFF):
            wide[0, i, j], wide[1, i, j] = part[TOP_SURFACE + j], part[BOTTOM_SURFACE + j]

    # Steps and slopes, and NaN for unknown ground
    bound = max(int(SLOPE_REACH / side + 0.5), 1)
    for i in range(nx):
        _interpolate(along, (i + 0.5) * scale + x, part, RISE)
        steps_of_row(wide, i, reach, part, out[STEP])
        slopes_of_row(out[GROUND], i, bound, np.float32(side), part, out[SLOPE])
    _hide_unknown(out)


@kernel
def _hide_unknown(out: NDArray[np.float32]) -> None:
    """Set ground, variance and slope to NaN in cells with the variance `NO_SURFACE`."""
    nan = np.float32(np.nan)
    for i in range(out.shape[1]):
        for layer in (GROUND, SLOPE, VARIANCE):
            for j in range(out.shape[2]):
                out[layer, i, j] = out[layer, i, j] if out[VARIANCE, i, j] < NO_SURFACE else nan


@kernel
def _fill_row(part: NDArray[np.float32], count: int, near: np.float32) -> None:
    """Replace sums and ground of a row by its layers, and fill in the highest and lowest surface of its cells."""
    one, half, zero, nan = np.float32(1.0), np.float32(0.5), np.float32(0.0), np.float32(np.nan)
    for j in range(count & 0x7FFF):
        number, top, hang, used = part[COUNTS + j], part[TOPS + j], part[HANGS + j], part[USED + j]
        base, shift, mean = part[BASE + j], part[SHIFT + j], part[MEAN + j]
        spread, gap, free = part[SPREAD + j], part[GAP + j], part[FREE + j]
        own = part[SUMS + j] / (number if number > one else one) + shift
        prior, noise = spread + MIN_NOISE, spread if spread > MIN_NOISE else MIN_NOISE
        weight = used * prior / (used * prior + noise)
        within = CELL_SHARE * spread if used > zero else zero
        known = ((gap <= near) | ((gap <= MAX_GAP) & (free > MIN_FREE))) & (part[ROOF + j] < half)
        variance = (one - weight) * prior + within + MIN_VARIANCE + BEND * BEND * gap * gap
        highest = top + shift if top > zero else zero
        is_standing, surface = (top > zero) & (hang < MAX_FOOT_HEIGHT), base + own
        part[HIGH + j] = base + highest if is_standing else surface if number > zero else -NO_SURFACE
        part[LOW + j] = surface if number > zero else base + highest if is_standing else NO_SURFACE
        part[BASE + j] = base + mean + weight * (own - mean)
        part[GAP + j] = variance if known else NO_SURFACE
        part[SPREAD + j] = np.sqrt(spread) if known else nan
        part[TOPS + j] = highest if known | (top > zero) else nan
        part[HANGS + j] = hang + shift if hang > zero else nan


@kernel
def _stretched(values: NDArray[np.float32], corner: float, scale: float, count: int) -> NDArray[np.float32]:
    """Interpolate coarse values along each row at the middles of cells, like `kernels.surface.sample`."""
    mx, my = values.shape
    first, share = np.empty(count, np.int32), np.empty(count, np.float32)
    for j in range(count):
        v = min(max((j + 0.5) * scale + corner - 0.5, 0.0), my - 1.0)
        first[j] = min(int(v), my - 2)
        share[j] = v - first[j]
    result = np.empty((mx, count), np.float32)
    for k in range(mx):
        for j in range(count):
            l = first[j] & 0x7FFFFFFF  # noqa: E741
            result[k, j] = values[k, l] + (values[k, l + 1] - values[k, l]) * share[j]
    return result


@kernel
def _interpolate(rows: NDArray[np.float32], at: float, part: NDArray[np.float32], start: int) -> None:
    """Interpolate a row of cells between two rows of `_stretched`, in place."""
    u = min(max(at - 0.5, 0.0), rows.shape[0] - 1.0)
    k, start = min(int(u), rows.shape[0] - 2) & 0xFFFF, start & 0x7FFFF
    share = np.float32(u - k)
    for j in range(rows.shape[1] & 0x7FFF):
        part[start + j] = rows[k, j] + (rows[k + 1, j] - rows[k, j]) * share
