"""The gallery of `scenes`: points from the side, the truth, and what was and is predicted."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from ogm.plot.colours import colours
from ogm.simulation.hand_built_scenes import MOUNT, SPEC, HandBuiltScene
from ogm.state import CellState


class Row(NamedTuple):
    """A scene to draw."""

    name: str
    region: str  # outlined, its shares stand in the captions
    y0: float = -4.5  # [m] right edge of the map, which is `SIZE` large
    x0: float = 3.0  # [m] rear edge
    across: bool = False  # the side view looks along the road
    strip: float = 2.0  # [m] half the width of what the side view shows, about `center`
    center: float = 0.0


SIZE = 22.0, 9.0  # [m] of each map, along x and y
ROWS = (
    Row("trailer 0.9 m at 12 m", "under"),
    Row("bar 1.5 m at 12 m", "under"),
    Row("trailer 1.2 m beside", "under", y0=-1.5, x0=0, across=True, strip=5, center=9),
    Row("step 0.15 m at 12 m", "face", strip=10),
    Row("step 0.25 m along", "face", y0=-1.5, x0=-4, across=True, strip=5, center=9),
    Row("step 0.40 m at 8 m", "face", strip=10),
    Row("ditch 1 m deep", "inside_seen", y0=1.0, strip=2, center=7),
    Row("ditch 2 m deep", "inside_seen", y0=-1.0, strip=2, center=4),
    Row("drop 3 m", "beyond", x0=11, strip=10),
    Row("swallowing car at 12 m", "footprint"),
    Row("banks at 9 m, HDL-32E", "bank_near", y0=4.0, x0=-11, across=True, strip=3),
    Row("slope +20% from 10 m", "ground"),
    Row("bridge 4.2 m", "under"),
    Row("tree crown 2.3 m", "under", center=2),
    Row("glass, 90% pass", "pane"),
    Row("wall along", "wall", y0=-1.5, across=True, strip=5, center=9),
    Row("parked car at 12 m", "car"),
    Row("ghosts beside", "around", y0=-1.5, center=3.5),
)
STATES = ("black", colours().free, colours().occupied, "0.6")  # by `CellState`
PARTS = ("tab:gray", "tab:blue", "tab:orange", "tab:purple")


def gallery(scenes: Mapping[str, HandBuiltScene], before: Mapping[str, NDArray], now: Mapping[str, NDArray]) -> Figure:
    """Draw a row for each of `ROWS`: points, truth, masses before and now."""
    figure = Figure(figsize=(16, 1.62 * len(ROWS) + 0.8), layout="constrained")
    axes = figure.subplots(len(ROWS), 4, squeeze=False)
    for row, (side, truth, *maps) in zip(ROWS, axes, strict=True):
        one = scenes[row.name]
        _points(side, one, row)
        truth.imshow(
            _upright(one.truth.state), cmap=ListedColormap(STATES), vmin=0, vmax=CellState.IGNORE, extent=SPEC.extent
        )
        truth.set_title("truth", fontsize=8, pad=2)
        for ax, masses, when in zip(maps, (before, now), ("before", "now"), strict=True):
            mass = masses[row.name]
            ax.imshow(_upright(colours().mix(mass)), extent=SPEC.extent)
            free, occupied = 100 * (mass[one.regions[row.region]] > 0.5).mean(axis=0)
            ax.set_title(f"{when}: {free:.0f} % free, {occupied:.0f} % occupied", fontsize=8, pad=2)
        for ax in (truth, *maps):
            outline = np.repeat(np.repeat(one.regions[row.region].T, 4, axis=0), 4, axis=1)
            ax.contour(outline, [0.5], colors="white", linewidths=0.6, extent=SPEC.extent)
            ax.set(xlim=(row.x0, row.x0 + SIZE[0]), ylim=(row.y0, row.y0 + SIZE[1]))
            ax.tick_params(labelsize=6, pad=1, length=2)
    legend = [Patch(color=STATES[s], label=CellState(s).name.lower()) for s in (1, 2, 0)]
    figure.legend(handles=legend, loc="outside upper right", ncols=3, fontsize=9, frameon=False)
    figure.suptitle(
        "Hand-built scenes. Shares are those of the outlined cells; seen from above, x [m] to the right, y [m] up",
        fontsize=12,
    )
    return figure


def _upright(cells: NDArray) -> NDArray:
    """Turn ``[ix, iy, ...]`` into rows from the left of the vehicle to its right, the vehicle facing right."""
    return np.clip(np.swapaxes(cells, 0, 1)[::-1], 0, None)


def _points(ax: Axes, one: HandBuiltScene, row: Row) -> None:
    """Draw the points of a strip from the side, heights above the road, a colour for each shape."""
    along, aside = (1, 0) if row.across else (0, 1)
    start, size = (row.y0, SIZE[1]) if row.across else (row.x0, SIZE[0])
    xyz = one.scan.points[:, :3]
    shown = np.abs(xyz[:, aside] - row.center) < row.strip
    for k, name in [*enumerate(one.parts), (-1, "ghosts")]:
        some = xyz[shown & (one.part == k)]
        if len(some):
            colour = PARTS[k] if k >= 0 else "black"
            ax.plot(some[:, along], some[:, 2] + MOUNT.sensor_height, ".", color=colour, ms=1.5, label=name)
    ax.set(xlim=(start, start + size), ylim=(-3.4 if "drop" in row.name else -1.8, 4.4))
    ax.set_title(f"{row.name}: {row.region}", fontsize=9, fontweight="bold", pad=2)
    ax.set_xlabel("y [m]" if row.across else "x [m]", fontsize=6, labelpad=0)
    ax.set_ylabel("z [m]", fontsize=6, labelpad=0)
    ax.tick_params(labelsize=6, pad=1, length=2)
    ax.legend(fontsize=6, frameon=False, loc="upper left", markerscale=4, ncols=4, handletextpad=0, borderpad=0)
