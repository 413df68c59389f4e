"""Panel of a dynamic grid: moving cells coloured by heading, with an arrow for each moving group."""

import numpy as np
from numpy.typing import NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.plot.colours import colours
from ogm.plot.panels import Panel, cells_panel, heading_colours, heading_legend
from ogm.scan import Boxes

BOX = (1.0, 1.0, 1.0)
MIN_SPEED = 0.5  # [m/s] of a group with an arrow
MIN_CELLS = 3  # of a group with an arrow
_NEIGHBOURS = ((1, 0), (0, 1), (1, 1), (1, -1))  # each pair once
_HOLE = 0.45  # inner radius of a wheel, relative to its radius


def dynamic_panel(grid: DynamicGrid, title: str = "", seconds: float = 1.0, boxes: Boxes | None = None) -> Panel:
    """Draw a dynamic grid: static, free and unknown in the colours of `mass_panel`, dynamic coloured by heading.

    The colours of a cell are mixed by its masses. An arrow shows the motion of each moving group (`moving_arrows`), and
    a wheel explains the colours of headings.

    Parameters
    ----------
    grid : DynamicGrid
    title : str
    seconds : float
        Time of motion shown by arrows [s]; 0 for no arrows.
    boxes : Boxes, optional
        Moving objects in the grid's frame, with velocities. They are outlined, and their arrows replace the arrows of
        groups.

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
    title = title or "heading of moving cells" + (f", arrows: {seconds:g} s" if seconds and len(arrows) else "")
    if boxes is not None and len(boxes):
        legend["box: object"] = BOX
    panel = cells_panel(cells, grid.spec, title, legend)
    outlines = _corners(Boxes.empty() if boxes is None else boxes)
    return panel._replace(arrows=arrows, outlines=outlines, wheel=True)


def moving_groups(grid: DynamicGrid) -> NDArray[np.int32]:
    """Return the number of the moving group of each cell, (nx, ny), from 1 up; 0 in cells that do not move.

    A cell moves if the mass of occupied is above 1/2 and dynamic exceeds static. Touching cells, also at a corner, are
    in one group if their velocities differ by at most 1 m/s, or half of the greater speed. Two adjacent vehicles in
    opposite directions are thus two groups.
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
    """Return the connected component of each of `count` nodes, by pairs of connected nodes."""
    label = np.arange(count)
    while (apart := label[of] != label[to]).any():
        low, high = np.minimum(label[of], label[to])[apart], np.maximum(label[of], label[to])[apart]
        np.minimum.at(label, high, low)
        while (label != label[label]).any():  # each node to the lowest known node of its component
            label = label[label]
    return np.unique(label, return_inverse=True)[1]


def moving_arrows(grid: DynamicGrid, seconds: float = 1.0) -> NDArray[np.float64]:
    """Return position and motion x, y, dx, dy [m] of each moving group along the grid's axes, (A, 4).

    Parameters
    ----------
    grid : DynamicGrid
    seconds : float
        Time of motion at the mean velocity [s]. Means are weighted by the mass of dynamic.
    """
    if not (np.isfinite(seconds) and seconds >= 0):
        raise ValueError(f"seconds of the arrows must be 0 or more, got {seconds}")
    groups = moving_groups(grid)
    at = np.nonzero(groups)
    label, mass = groups[at], grid.dynamic[at].astype(np.float64)
    x, y = (np.broadcast_to(centers, grid.spec.shape)[at] for centers in grid.spec.cell_centers)
    vx, vy = grid.velocity[at].astype(np.float64).T
    total = np.bincount(label, mass)
    mean = np.stack([np.bincount(label, mass * column) for column in (x, y, vx, vy)], axis=-1)
    kept = np.bincount(label) >= MIN_CELLS
    arrows: NDArray[np.float64] = mean[kept] / total[kept, None]
    arrows = arrows[np.hypot(arrows[:, 2], arrows[:, 3]) >= MIN_SPEED]
    arrows[:, 2:] *= seconds
    return arrows


def _box_arrows(boxes: Boxes, seconds: float) -> NDArray[np.float64]:
    """Return position and motion x, y, dx, dy [m] of boxes with a velocity, (A, 4)."""
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
    """Return a ring in the colours of headings, forward up, (size, size, 4): red, green, blue, opacity."""
    right, down = np.meshgrid(*2 * [(np.arange(size) + 0.5) / (size / 2) - 1])
    radius = np.hypot(right, down)
    ring = np.clip((1 - radius) * size / 2, 0, 1) * np.clip((radius - _HOLE) * size / 2, 0, 1)
    colours = heading_colours(np.arctan2(-right, -down))
    return np.round(255 * np.dstack([colours, ring])).astype(np.uint8)


def _shifted(step: int) -> tuple[slice, slice]:
    """Return the cells with a neighbour `step` cells further along an axis, and these neighbours."""
    if step < 0:
        return slice(-step, None), slice(None, step)
    return (slice(None, -step), slice(step, None)) if step else (slice(None), slice(None))
