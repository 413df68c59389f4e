"""The panel of a dynamic grid: what moves by its heading, an arrow for each moving group."""

import numpy as np
from numpy.typing import NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.plot.colours import colours
from ogm.plot.panels import Panel, cells_panel, heading_colours, heading_legend
from ogm.scan import Boxes

BOX = (1.0, 1.0, 1.0)
SLOWEST = 0.5  # [m/s] of a group that has an arrow
FEWEST = 3  # cells of a group that has an arrow
_NEIGHBOURS = ((1, 0), (0, 1), (1, 1), (1, -1))  # each pair once
_HOLE = 0.45  # of the radius of a wheel


def dynamic_panel(grid: DynamicGrid, title: str = "", seconds: float = 1.0, boxes: Boxes | None = None) -> Panel:
    """Show what stands and what moves: free, occupied and unknown as in `mass_panel`, the heading of what moves.

    The colours of a cell are mixed by its masses. Each group of moving cells has an arrow as long as its way in some
    seconds (`moving_arrows`), and the panel a wheel with the colours of the headings.

    Parameters
    ----------
    grid : DynamicGrid
    title : str
    seconds : float
        Way of the arrows [s]; 0 for none.
    boxes : Boxes, optional
        Moving objects in the grid's frame, with velocities: these are outlined and have the arrows, not the groups.

    Raises
    ------
    ValueError
        If `seconds` is negative or not finite, or the numbers of the grid are no masses.
    """
    grid.check()
    chosen, heading = colours(), heading_colours(np.nan_to_num(grid.heading))
    moves = np.isfinite(grid.heading)[..., None]
    cells = chosen.mix(np.stack([grid.free, grid.static], axis=-1))
    cells = cells + grid.dynamic[..., None] * np.where(moves, heading, chosen.occupied)
    legend = {"free": chosen.free, "static": chosen.occupied, "unknown": chosen.unknown}
    legend |= {f"moves {axis}": colour for axis, colour in heading_legend().items()}
    arrows = moving_arrows(grid, seconds) if boxes is None else _box_arrows(boxes, seconds)
    title = title or "heading of what moves" + (f", arrows: {seconds:g} s" if seconds and len(arrows) else "")
    if boxes is not None and len(boxes):
        legend["box: object"] = BOX
    panel = cells_panel(cells, grid.spec, title, legend)
    outlines = _corners(Boxes.empty() if boxes is None else boxes)
    return panel._replace(arrows=arrows, outlines=outlines, wheel=True)


def moving_groups(grid: DynamicGrid) -> NDArray[np.int32]:
    """Return the number of the moving group of each cell, (nx, ny), from 1 on; 0 where nothing moves.

    A cell moves where the mass of occupied is above 1/2, and most of it that of dynamic. Cells that touch, also at a
    corner, belong together if their velocities differ by at most half of the faster one, or 1 m/s: two vehicles side by
    side that drive in opposite directions are two groups.
    """
    moving = (grid.occupied > 0.5) & (grid.dynamic > grid.static) & np.isfinite(grid.speed)
    count = int(np.count_nonzero(moving))
    number = np.full(grid.spec.shape, -1)
    number[moving] = np.arange(count)
    pairs = []
    for dx, dy in _NEIGHBOURS:
        (of_x, to_x), (of_y, to_y) = _shifted(dx), _shifted(dy)
        both = moving[of_x, of_y] & moving[to_x, to_y]
        apart = grid.velocity[of_x, of_y][both] - grid.velocity[to_x, to_y][both]
        faster = np.maximum(grid.speed[of_x, of_y][both], grid.speed[to_x, to_y][both])
        alike = np.hypot(*apart.T) <= np.maximum(1.0, 0.5 * faster)
        pairs.append(np.stack([number[of_x, of_y][both][alike], number[to_x, to_y][both][alike]]))
    groups = np.zeros(grid.spec.shape, np.int32)
    groups[moving] = 1 + _components(count, *np.concatenate(pairs, axis=1))
    return groups


def _components(count: int, of: NDArray[np.intp], to: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the number of the connected component of each of some nodes, by pairs of nodes that are connected."""
    label = np.arange(count)
    while (apart := label[of] != label[to]).any():
        low, high = np.minimum(label[of], label[to])[apart], np.maximum(label[of], label[to])[apart]
        np.minimum.at(label, high, low)
        while (label != label[label]).any():  # each node to the lowest of its component so far
            label = label[label]
    return np.unique(label, return_inverse=True)[1]


def moving_arrows(grid: DynamicGrid, seconds: float = 1.0) -> NDArray[np.float64]:
    """Return where each moving group is, and how far it comes: x, y, dx, dy [m] along the grid's axes, (A, 4).

    Parameters
    ----------
    grid : DynamicGrid
    seconds : float
        For which its mean velocity is kept [s]. Means are weighted by the mass of dynamic.
    """
    if not (np.isfinite(seconds) and seconds >= 0):
        raise ValueError(f"seconds of the arrows must be 0 or more, got {seconds}")
    groups = moving_groups(grid)
    at = np.nonzero(groups)
    label, mass = groups[at], grid.dynamic[at].astype(np.float64)
    x, y = (np.broadcast_to(one, grid.spec.shape)[at] for one in grid.spec.cell_centers)
    vx, vy = grid.velocity[at].astype(np.float64).T
    total = np.bincount(label, mass)
    mean = np.stack([np.bincount(label, mass * one) for one in (x, y, vx, vy)], axis=-1)
    kept = np.bincount(label) >= FEWEST
    arrows: NDArray[np.float64] = mean[kept] / total[kept, None]
    arrows = arrows[np.hypot(arrows[:, 2], arrows[:, 3]) >= SLOWEST]
    arrows[:, 2:] *= seconds
    return arrows


def _box_arrows(boxes: Boxes, seconds: float) -> NDArray[np.float64]:
    """Return x, y, dx, dy [m] of the boxes that have a velocity, (A, 4)."""
    velocity = np.full((len(boxes), 2), np.nan) if boxes.velocity is None else boxes.velocity
    arrows = np.hstack([boxes.center[:, :2], velocity * seconds])
    return arrows[np.isfinite(arrows).all(axis=1)]


def _corners(boxes: Boxes) -> NDArray[np.float64]:
    """Return the corners of boxes from above, (B, 4, 2) [m], the front first."""
    half = boxes.size[:, None, :2] / 2 * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    c, s = np.cos(boxes.yaw)[:, None], np.sin(boxes.yaw)[:, None]
    turned = np.stack([c * half[..., 0] - s * half[..., 1], s * half[..., 0] + c * half[..., 1]], axis=-1)
    corners: NDArray[np.float64] = boxes.center[:, None, :2] + turned
    return corners


def heading_wheel(size: int) -> NDArray[np.uint8]:
    """Return a ring with the colour of each heading, forward up, (size, size, 4): red, green, blue, opacity."""
    right, down = np.meshgrid(*2 * [(np.arange(size) + 0.5) / (size / 2) - 1])
    radius = np.hypot(right, down)
    ring = np.clip((1 - radius) * size / 2, 0, 1) * np.clip((radius - _HOLE) * size / 2, 0, 1)
    colours = heading_colours(np.arctan2(-right, -down))
    return np.round(255 * np.dstack([colours, ring])).astype(np.uint8)


def _shifted(step: int) -> tuple[slice, slice]:
    """Return the cells that have a neighbour some cells further, and those neighbours, along an axis."""
    if step < 0:
        return slice(-step, None), slice(None, step)
    return (slice(None, -step), slice(step, None)) if step else (slice(None), slice(None))
