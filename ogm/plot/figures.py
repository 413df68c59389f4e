"""Panels side by side, with axes and legends: shown by matplotlib, or written to a file."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.files import atomic_write
from ogm.grid import EvidentialGrid
from ogm.plot.moving import dynamic_panel, heading_wheel
from ogm.plot.panels import Panel, mass_panel
from ogm.plot.points import points_panel

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["save_picture", "show"]

Shown = EvidentialGrid | DynamicGrid | NDArray[Any] | Panel


def show(*items: Shown, titles: Sequence[str] = ()) -> "Figure":
    """Draw grids, clouds and panels side by side.

    Parameters
    ----------
    *items : EvidentialGrid, DynamicGrid, (N, 4) array or Panel
        A grid is shown by its `mass_panel` or `dynamic_panel`; an array by its `points_panel` over the area of the
        first grid or panel.
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


def save_picture(path: str | os.PathLike[str], *items: Shown, titles: Sequence[str] = ()) -> None:
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


def _panels(items: Sequence[Shown], titles: Sequence[str]) -> list[Panel]:
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
        elif isinstance(item, DynamicGrid):
            panels.append(dynamic_panel(item, title))
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
    from matplotlib.offsetbox import AnchoredOffsetbox, OffsetImage
    from matplotlib.patches import Patch, Polygon

    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for k, (axis, panel) in enumerate(zip(axes, panels, strict=True)):
        x_min, x_max, y_min, y_max = panel.spec.extent
        axis.imshow(panel.image, extent=(y_max, y_min, x_min, x_max), interpolation="nearest", aspect="equal")
        if panel.spec.contains(0.0, 0.0):
            axis.plot(0, 0, marker="^", markersize=7, color="white", markeredgecolor="black", markeredgewidth=0.8)
        for corners in panel.outlines:
            for colour, width in (("white", 2.4), ("black", 1.2)):
                axis.add_patch(Polygon(corners[:, ::-1], fill=False, edgecolor=colour, linewidth=width))
        if len(panel.arrows):
            x, y, dx, dy = panel.arrows.T
            heads = {"headwidth": 3.5, "headlength": 4, "headaxislength": 3.5, "minlength": 0}
            arrows = axis.quiver(y, x, dy, dx, angles="xy", scale_units="xy", scale=1, units="dots", width=3.2, **heads)
            arrows.set(facecolor="black", edgecolor="white", linewidth=0.8)
        if panel.wheel:
            wheel = OffsetImage(heading_wheel(120), zoom=0.25)
            axis.add_artist(AnchoredOffsetbox("upper right", child=wheel, pad=0.2, borderpad=0.3))
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
