"""Panels: pictures of grids from above, the vehicle facing up. Only here axes flip and colours are known."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid
from ogm.plot.colour_maps import colour_map
from ogm.plot.colours import colours

CONFLICT_LAYERS, VELOCITY_LAYERS = ("free_to_occupied", "occupied_to_free"), ("velocity_x", "velocity_y")
BLACK = (0.0, 0.0, 0.0)
APPEARED, WENT_AWAY = (1.0, 0.62, 0.10), (0.25, 0.62, 1.0)
NO_VALUE = (0.16, 0.17, 0.19)


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
    arrows : (A, 4) float array
        x, y, dx, dy [m] of arrows in the frame of `spec`.
    outlines : (B, 4, 2) float array
        x, y [m] of the corners of boxes in the frame of `spec`, the front first.
    wheel : bool
        Whether colours of `heading_colours` need a legend of their own.
    """

    image: NDArray[np.uint8]
    spec: GridSpec
    title: str
    legend: dict[str, tuple[float, float, float]]
    arrows: NDArray[np.float64] = np.empty((0, 4))
    outlines: NDArray[np.float64] = np.empty((0, 4, 2))
    wheel: bool = False


def upright(cells: NDArray[Any]) -> NDArray[Any]:
    """Turn ``[ix, iy, ...]``, without a copy, into rows from the front to the back and columns from left to right."""
    return cells[::-1, ::-1]


def colour_bytes(colours: NDArray[Any]) -> NDArray[np.uint8]:
    """Return colours in [0, 1] as bytes."""
    rounded: NDArray[np.uint8] = np.round(255 * np.clip(colours, 0, 1)).astype(np.uint8)
    return rounded


def cells_panel(
    colours: NDArray[Any], spec: GridSpec, title: str, legend: dict[str, tuple[float, float, float]]
) -> Panel:
    """Show a colour for every cell.

    Parameters
    ----------
    colours : (nx, ny, 3) float array
        Red, green, blue [0, 1] of each cell of `spec`, or of finer cells of the same area.
    spec : GridSpec
    title : str
    legend : dict of str to (red, green, blue)
    """
    return Panel(upright(colour_bytes(colours)), spec, title, legend)


def mass_panel(grid: EvidentialGrid, title: str = "") -> Panel:
    """Show belief: the colours of `ogm.plot.colours` for free, occupied and unknown, mixed by their masses."""
    return cells_panel(colours().mix(grid.mass), grid.spec, title or "belief", colours().legend)


def probability_panel(grid: EvidentialGrid, title: str = "") -> Panel:
    """Show the expected probability of occupied: white 0, grey 1/2 (also where nothing is known), black 1."""
    grey = np.repeat(1 - grid.probability[..., None], 3, axis=-1)
    legend = {"P(occupied) = 0": (1.0, 1.0, 1.0), "1/2": (0.5, 0.5, 0.5), "1": (0.0, 0.0, 0.0)}
    return cells_panel(grey, grid.spec, title or "probability of occupied", legend)


def unknown_panel(grid: EvidentialGrid, title: str = "") -> Panel:
    """Show the mass of unknown: black 0, yellow 1 (matplotlib's "inferno")."""
    colours = colour_map("inferno", grid.unknown * 0.92)
    legend = {f"unknown = {u:g}": tuple(colour_map("inferno", np.array([u * 0.92]))[0]) for u in (0, 0.5, 1)}
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
    appeared, went_away = (conflict[name] for name in CONFLICT_LAYERS)
    colours = appeared[..., None] * np.array(APPEARED) + went_away[..., None] * np.array(WENT_AWAY)
    legend = {"appeared": APPEARED, "went away": WENT_AWAY, "no conflict": BLACK}
    return cells_panel(colours, conflict.spec, title or "conflict", legend)


def layer_panel(layers: LayeredGrid, name: str, title: str = "") -> Panel:
    """Show numbers from their lowest, purple, to their highest, yellow (matplotlib's "viridis"); grey without value."""
    layer = layers[name]
    finite = layer[np.isfinite(layer)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    share = (layer - low) / ((high - low) or 1.0)
    colours = np.where(np.isnan(layer)[..., None], NO_VALUE, colour_map("viridis", share))
    steps = np.linspace(0, 1, 3 if high > low else bool(finite.size))
    colours_of = colour_map("viridis", steps)
    legend = {f"{low + at * (high - low):.4g}": tuple(one) for at, one in zip(steps, colours_of, strict=True)}
    return cells_panel(colours, layers.spec, title or name, legend | {"no value": NO_VALUE})


def velocity_panel(layers: LayeredGrid, title: str = "", fastest: float | None = None) -> Panel:
    """Show velocities: the direction by colour, the speed by brightness; black what stands or has none.

    Parameters
    ----------
    layers : LayeredGrid
        With the layers ``velocity_x`` (forward) and ``velocity_y`` (left) [m/s].
    title : str
    fastest : float, optional
        Speed of full brightness [m/s]; by default the greatest.
    """
    x, y = (np.nan_to_num(layers[name]) for name in VELOCITY_LAYERS)
    speed = np.hypot(x, y)
    fastest = float(speed.max()) if fastest is None else fastest
    brightness = np.sqrt(np.clip(speed / (fastest or 1.0), 0, 1))
    heading = {"forward": 0.0, "left": np.pi / 2, "backward": np.pi, "right": -np.pi / 2}
    legend = {name: tuple(heading_colours(np.array(angle))) for name, angle in heading.items()}
    colours = heading_colours(np.arctan2(y, x)) * brightness[..., None]
    return cells_panel(colours, layers.spec, title or f"velocity, up to {fastest:.3g} m/s", legend | {"none": BLACK})


def heading_colours(heading: NDArray[Any]) -> NDArray[np.float64]:
    """Return red, green, blue [0, 1] of directions [rad], (..., 3)."""
    return 0.5 + 0.5 * np.cos(heading[..., None] - np.array([0, 2, -2]) * np.pi / 3)
