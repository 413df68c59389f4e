"""Panels of points: each a dot in a colour of its own, or by its height over the ground."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.grid import GridSpec
from ogm.plot.colour_maps import colour_map
from ogm.plot.panels import Panel, cells_panel

BEHIND_POINTS = (0.08, 0.08, 0.08)
TURBO = (0.15, 0.825)  # of matplotlib's "turbo", what stands out from BEHIND_POINTS: contrast 4.5 or more (WCAG 2)
LOWEST, HIGHEST = -0.5, 3.5  # [m] over ground: heights with colours of their own
GROUND_CELL = 2.0  # [m] the ground is the median of the lowest points of cells this wide
DOTS, SPARSE_DOTS = 512, 384  # along the longer side of a picture
SPARSE = 0.05  # share of a picture of which dots of one half cell cover less


def dots_panel(
    xyz: NDArray[Any],
    colours: NDArray[Any],
    spec: GridSpec,
    title: str,
    legend: dict[str, tuple[float, float, float]],
    width: int | None = 1,
) -> Panel:
    """Show points from above, each in a colour of its own, on cells half as wide as those of `spec`.

    Parameters
    ----------
    xyz : (N, 3 or more) float array
        x, y, z [m] in the frame of `spec`. Where several fall into a cell, the highest is shown.
    colours : (N, 3) float array
        Red, green, blue [0, 1].
    spec : GridSpec
        The area to show.
    title : str
    legend : dict of str to (red, green, blue)
    width : int, optional
        Of a dot [half cells]; wider dots cover no others. None: by the size of the picture and how many there are.
    """
    fine = spec.refined(2)
    image, drawn = np.full((*fine.shape, 3), BEHIND_POINTS), np.zeros(fine.shape, bool)
    order = np.argsort(xyz[:, 2], kind="stable")  # the highest of a cell is drawn last
    order = order[fine.contains(xyz[order, 0], xyz[order, 1])]
    cells = fine.index(xyz[order, 0], xyz[order, 1])
    image[cells], drawn[cells] = colours[order], True
    if width is None:
        width = max(1, round(max(fine.shape) / (SPARSE_DOTS if drawn.mean() < SPARSE else DOTS)))
    _widen(image, drawn, width)
    return cells_panel(image, spec, title, legend)


def _widen(image: NDArray[Any], drawn: NDArray[np.bool_], width: int) -> None:
    """Copy each dot that is drawn to the cells behind it and beside it, where there is none."""
    for axis in (0, 1):
        to, of = (np.swapaxes(one, 0, axis) for one in (image, drawn))
        for step in range(1, width):
            # even steps grow one way and odd ones the other, so that dots stay where they are
            source, target = (slice(1, None), slice(-1)) if step % 2 else (slice(-1), slice(1, None))
            grown = of[source] & ~of[target]
            to[target][grown] = to[source][grown]
            of[target] |= grown


def points_panel(
    cloud: NDArray[np.float32], spec: GridSpec, title: str = "", ground_z: float | None = None, width: int | None = None
) -> Panel:
    """Show points from above, coloured by height.

    Parameters
    ----------
    cloud : (N, 3 or more) float array
        x, y, z [m] in the frame of `spec`.
    spec : GridSpec
        The area to show.
    title : str
    ground_z : float, optional
        Height of the ground in that frame [m]; by default the median of the lowest points of cells of 2 m.
    width : int, optional
        Of a dot [half cells]; by default wider in large pictures, and where there are few points.
    """
    cloud = cloud[np.isfinite(cloud[:, :3]).all(axis=1)]
    cloud = cloud[spec.contains(cloud[:, 0], cloud[:, 1])]
    base = _ground_z(cloud) if ground_z is None else ground_z
    legend = {f"{height} m": tuple(height_colours(np.array([height]))[0]) for height in (0, 1, 2, 3)}
    colours = height_colours(cloud[:, 2] - base)
    return dots_panel(cloud, colours, spec, title or "points by height", legend, width)


def height_colours(height: NDArray[Any]) -> NDArray[np.float64]:
    """Return red, green, blue [0, 1] of points by their height over ground [m], (..., 3): readable on black."""
    share = np.clip((height - LOWEST) / (HIGHEST - LOWEST), 0, 1)
    return colour_map("turbo", TURBO[0] + (TURBO[1] - TURBO[0]) * share)


def _ground_z(cloud: NDArray[Any]) -> float:
    """Return about where the ground is [m]: most cells hold a point of it. 0 without points."""
    if not len(cloud):
        return 0.0
    ix, iy = np.floor(cloud[:, :2].T / GROUND_CELL).astype(np.int64)
    _, cell = np.unique((ix << 32) + iy, return_inverse=True)
    lowest = np.full(cell.max() + 1, np.inf)
    np.minimum.at(lowest, cell, cloud[:, 2])
    return float(np.median(lowest))
