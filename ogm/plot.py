"""Pictures of points and grids, the vehicle facing up. The only place that flips axes or knows colours."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.files import atomic_write
from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "Panel",
    "cells_panel",
    "conflict_panel",
    "dots_panel",
    "mass_panel",
    "points_panel",
    "probability_panel",
    "save_picture",
    "show",
    "unknown_panel",
]

GREEN, RED, BLACK = (0.10, 0.80, 0.20), (0.93, 0.16, 0.16), (0.0, 0.0, 0.0)
LEGEND = {"free": GREEN, "occupied": RED, "unknown": BLACK}
APPEARED, WENT_AWAY = (1.0, 0.62, 0.10), (0.25, 0.62, 1.0)


class Panel(NamedTuple):
    """One picture from above.

    Attributes
    ----------
    image : (rows, columns, 3) uint8
        Row 0 is the front, column 0 the left.
    spec : GridSpec
        The area that it shows.
    title : str
    legend : dict of str to (red, green, blue)
        What the colours mean, [0, 1].
    """

    image: NDArray[np.uint8]
    spec: GridSpec
    title: str
    legend: dict[str, tuple[float, float, float]]


def _upright(cells: NDArray) -> NDArray:
    """Turn ``[ix, iy, ...]`` into rows from the front to the back and columns from left to right."""
    return cells[::-1, ::-1]


def _bytes(colours: NDArray) -> NDArray[np.uint8]:
    return np.round(255 * np.clip(colours, 0, 1)).astype(np.uint8)


def cells_panel(colours: NDArray, spec: GridSpec, title: str, legend: dict[str, tuple[float, float, float]]) -> Panel:
    """Show a colour for every cell.

    Parameters
    ----------
    colours : (nx, ny, 3) float array
        Red, green, blue [0, 1] of each cell of `spec`, or of finer cells of the same area.
    spec : GridSpec
    title : str
    legend : dict of str to (red, green, blue)
    """
    return Panel(_upright(_bytes(colours)), spec, title, legend)


def dots_panel(
    xyz: NDArray, colours: NDArray, spec: GridSpec, title: str, legend: dict[str, tuple[float, float, float]]
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
    """
    fine = spec.refined(2)
    image = np.full((*fine.shape, 3), 0.08)
    order = np.argsort(xyz[:, 2], kind="stable")  # the highest of a cell is drawn last
    order = order[fine.contains(xyz[order, 0], xyz[order, 1])]
    image[fine.index(xyz[order, 0], xyz[order, 1])] = colours[order]
    return cells_panel(image, spec, title, legend)


def mass_panel(grid: EvidentialGrid, title: str = "") -> Panel:
    """Show belief: green free, red occupied, black unknown, mixed by their masses."""
    colours = grid.free[..., None] * np.array(GREEN) + grid.occupied[..., None] * np.array(RED)
    return cells_panel(colours, grid.spec, title or "belief", LEGEND)


def probability_panel(grid: EvidentialGrid, title: str = "") -> Panel:
    """Show the expected probability of occupied: white 0, grey 1/2 (also where nothing is known), black 1."""
    grey = np.repeat(1 - grid.probability[..., None], 3, axis=-1)
    legend = {"P(occupied) = 0": (1.0, 1.0, 1.0), "1/2": (0.5, 0.5, 0.5), "1": (0.0, 0.0, 0.0)}
    return cells_panel(grey, grid.spec, title or "probability of occupied", legend)


def unknown_panel(grid: EvidentialGrid, title: str = "") -> Panel:
    """Show the mass of unknown: black 0, yellow 1 (matplotlib's "inferno")."""
    colours = _colour_map("inferno", grid.unknown * 0.92)
    legend = {f"unknown = {u:g}": tuple(_colour_map("inferno", np.array([u * 0.92]))[0]) for u in (0, 0.5, 1)}
    return cells_panel(colours, grid.spec, title or "unknown", legend)


def conflict_panel(conflict: LayeredGrid, title: str = "") -> Panel:
    """Show where sources contradict each other: orange what appeared, blue what went away, black no conflict.

    Parameters
    ----------
    conflict : LayeredGrid
        With the layers ``free_to_occupied`` and ``occupied_to_free`` in [0, 1], as `ogm.fusion.EvidentialMapper` has
        them.
    title : str
    """
    appeared, went_away = conflict["free_to_occupied"], conflict["occupied_to_free"]
    colours = appeared[..., None] * np.array(APPEARED) + went_away[..., None] * np.array(WENT_AWAY)
    legend = {"appeared": APPEARED, "went away": WENT_AWAY, "no conflict": BLACK}
    return cells_panel(colours, conflict.spec, title or "conflict", legend)


def points_panel(cloud: NDArray[np.float32], spec: GridSpec, title: str = "", ground_z: float | None = None) -> Panel:
    """Show points from above, coloured by height.

    Parameters
    ----------
    cloud : (N, 3 or more) float array
        x, y, z [m] in the frame of `spec`.
    spec : GridSpec
        The area to show.
    title : str
    ground_z : float, optional
        Height of the ground in that frame [m]; by default the median of the points.
    """
    cloud = cloud[np.isfinite(cloud[:, :3]).all(axis=1)]
    cloud = cloud[spec.contains(cloud[:, 0], cloud[:, 1])]
    base = float(np.median(cloud[:, 2])) if ground_z is None and len(cloud) else (ground_z or 0.0)
    low, high = -0.5, 3.5
    colours = _colour_map("turbo", 0.12 + 0.85 * (cloud[:, 2] - base - low) / (high - low))
    legend = {
        f"{height:g} m": tuple(_colour_map("turbo", np.array([0.12 + 0.85 * (height - low) / (high - low)]))[0])
        for height in (0, 1, 2, 3)
    }
    return dots_panel(cloud, colours, spec, title or "points by height", legend)


def _colour_map(name: str, values: NDArray) -> NDArray[np.float64]:
    from matplotlib import colormaps

    return colormaps[name](np.clip(values, 0, 1))[..., :3]


def show(*items: EvidentialGrid | NDArray | Panel, titles: Sequence[str] = ()) -> "Figure":
    """Draw grids, clouds and panels side by side.

    Parameters
    ----------
    *items : EvidentialGrid, (N, 4) array or Panel
        A grid is shown by its `mass_panel`; an array by its `points_panel` over the area of the first grid or panel.
    titles : sequence of str, optional
        One per item.

    Returns
    -------
    matplotlib.figure.Figure
        A notebook shows it by itself; in a script, call ``matplotlib.pyplot.show()``, or use `save_picture`.

    Raises
    ------
    ValueError
        If there is nothing to show, or `titles` has another length, or points come without a grid.
    """
    import matplotlib.pyplot as plt

    panels = _panels(items, titles)
    return _draw(plt.figure(figsize=_size(panels), layout="constrained"), panels)


def save_picture(
    path: str | os.PathLike[str], *items: EvidentialGrid | NDArray | Panel, titles: Sequence[str] = ()
) -> None:
    """Write what `show` would show to a PNG file, in one step.

    Parameters
    ----------
    path : path
        Ends in ``.png``.
    *items, titles
        As for `show`.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if Path(path).suffix.lower() != ".png":
        raise ValueError(f"a picture is saved as .png, got {path}")
    panels = _panels(items, titles)
    figure = Figure(figsize=_size(panels), layout="constrained")
    FigureCanvasAgg(figure)
    _draw(figure, panels)
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=110, bbox_inches="tight", pad_inches=0.12)


def _panels(items: Sequence[EvidentialGrid | NDArray | Panel], titles: Sequence[str]) -> list[Panel]:
    """Turn whatever `show` takes into panels."""
    if not items:
        raise ValueError("nothing to show: give a grid, points or a panel")
    if titles and len(titles) != len(items):
        raise ValueError(f"titles must be one per item, got {len(titles)} for {len(items)}")
    spec = next((item.spec for item in items if not isinstance(item, np.ndarray)), None)
    panels = []
    for item, title in zip(items, titles or [""] * len(items), strict=True):
        if isinstance(item, Panel):
            panels.append(item._replace(title=title or item.title))
        elif isinstance(item, EvidentialGrid):
            panels.append(mass_panel(item, title))
        elif spec is None:
            raise ValueError("points need an area: show them beside a grid, or as ogm.plot.points_panel(cloud, spec)")
        else:
            panels.append(points_panel(item, spec, title))
    return panels


def _size(panels: Sequence[Panel]) -> tuple[float, float]:
    """Figure size [inch] at which the panels stand 7 inches tall."""
    widths = [6.4 * panel.spec.width / panel.spec.length + 0.9 for panel in panels]
    return min(max(sum(widths), 4.0), 40.0), 7.6


def _shown(title: str, most: int = 40) -> str:
    """Cut a title to what fits over a panel, and replace what the font cannot show."""
    title = title.encode("latin-1", "replace").decode("latin-1")
    return title if len(title) <= most else f"{title[: most // 2 - 1]}...{title[-most // 2 + 2 :]}"


def _draw(figure: "Figure", panels: Sequence[Panel]) -> "Figure":
    from matplotlib.patches import Patch

    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for k, (axis, panel) in enumerate(zip(axes, panels, strict=True)):
        x_min, x_max, y_min, y_max = panel.spec.extent
        axis.imshow(panel.image, extent=(y_max, y_min, x_min, x_max), interpolation="nearest", aspect="equal")
        if panel.spec.contains(0.0, 0.0):
            axis.plot(0, 0, marker="^", markersize=7, color="white", markeredgecolor="black", markeredgewidth=0.8)
        axis.set_title(_shown(panel.title), fontsize=11, parse_math=False)
        axis.set_xlabel("y, left [m]")
        if k == 0:
            axis.set_ylabel("x, forward [m]")
        handles = [Patch(facecolor=c, edgecolor="0.6", label=name) for name, c in panel.legend.items()]
        axis.legend(
            handles=handles,
            loc="upper center",
            bbox_to_anchor=(0.5, -0.09),
            ncols=len(handles),
            frameon=False,
            fontsize=9,
            handlelength=1.2,
            columnspacing=1.0,
        )
    return figure
