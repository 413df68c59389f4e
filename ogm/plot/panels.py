"""Panels: pictures of grids and points from above, the vehicle facing up."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid
from ogm.plot.colour_maps import colour_map
from ogm.plot.colours import CAUSE_COLOURS, colours
from ogm.unknown_cause import UnknownCause

CAUSE_LAYER = "cause"
CONFLICT_LAYERS, VELOCITY_LAYERS = ("free_to_occupied", "occupied_to_free"), ("velocity_x", "velocity_y")
BLACK = (0.0, 0.0, 0.0)
APPEARED, WENT_AWAY = (1.0, 0.62, 0.10), (0.25, 0.62, 1.0)
NO_VALUE = NO_CONFLICT = (0.16, 0.17, 0.19)  # not black, which is unknown


class Panel(NamedTuple):
    """Picture of a grid or point cloud, seen from above.

    Attributes
    ----------
    image : (rows, columns, 3) uint8
        Row 0 is the front, column 0 the left.
    spec : GridSpec
        Area of the picture.
    title : str
    legend : dict of str to (red, green, blue)
        Colours [0, 1] by meaning.
    arrows : (A, 4) float array
        x, y, dx, dy [m] of arrows in the frame of `spec`.
    outlines : (B, 4, 2) float array
        x, y [m] of the corners of boxes in the frame of `spec`, the front first.
    wheel : bool
        Whether to draw a wheel as legend of `heading_colours`.
    """

    image: NDArray[np.uint8]
    spec: GridSpec
    title: str
    legend: dict[str, tuple[float, float, float]]
    arrows: NDArray[np.float64] = np.empty((0, 4))
    outlines: NDArray[np.float64] = np.empty((0, 4, 2))
    wheel: bool = False


def upright(cells: NDArray[Any]) -> NDArray[Any]:
    """Return a view of ``[ix, iy, ...]`` with rows from front to back and columns from left to right."""
    return cells[::-1, ::-1]


def colour_bytes(colours: NDArray[Any]) -> NDArray[np.uint8]:
    """Return colours in [0, 1] as bytes."""
    rounded: NDArray[np.uint8] = np.round(255 * np.clip(colours, 0, 1)).astype(np.uint8)
    return rounded


def cells_panel(
    colours: NDArray[Any], spec: GridSpec, title: str, legend: dict[str, tuple[float, float, float]]
) -> Panel:
    """Draw a colour for every cell.

    Parameters
    ----------
    colours : (nx, ny, 3) float array
        Red, green, blue [0, 1] of each cell of `spec`, or of finer cells on the same area.
    spec : GridSpec
    title : str
    legend : dict of str to (red, green, blue)
    """
    return Panel(upright(colour_bytes(colours)), spec, title, legend)


def mass_panel(grid: EvidentialGrid, title: str = "") -> Panel:
    """Draw belief: the colours of `ogm.plot.colours` for free, occupied and unknown, mixed by their masses."""
    grid.check()
    return cells_panel(colours().mix(grid.mass), grid.spec, title or "belief", colours().legend)


def probability_panel(grid: EvidentialGrid, title: str = "") -> Panel:
    """Draw the expected probability of occupied: white 0, grey 1/2 (also unknown cells), black 1."""
    grid.check()
    grey = np.repeat(1 - grid.probability[..., None], 3, axis=-1)
    legend = {"P(occupied) = 0": (1.0, 1.0, 1.0), "1/2": (0.5, 0.5, 0.5), "1": (0.0, 0.0, 0.0)}
    return cells_panel(grey, grid.spec, title or "probability of occupied", legend)


def unknown_panel(grid: EvidentialGrid, title: str = "") -> Panel:
    """Draw the mass of unknown: black 0, yellow 1 (matplotlib's "inferno")."""
    grid.check()
    colours = colour_map("inferno", grid.unknown * 0.92)
    legend = {f"unknown = {u:g}": tuple(colour_map("inferno", np.array([u * 0.92]))[0]) for u in (0, 0.5, 1)}
    return cells_panel(colours, grid.spec, title or "unknown", legend)


def conflict_panel(conflict: LayeredGrid, title: str = "") -> Panel:
    """Draw conflict between sources: orange from free to occupied, blue from occupied to free, grey no conflict.

    Parameters
    ----------
    conflict : LayeredGrid
        Layers ``free_to_occupied`` and ``occupied_to_free`` in [0, 1], see `ogm.fusion.EvidentialMapper`.
    title : str
    """
    appeared, went_away = (conflict[name] for name in CONFLICT_LAYERS)
    grey = np.array(NO_CONFLICT)
    colours = grey + appeared[..., None] * (APPEARED - grey) + went_away[..., None] * (WENT_AWAY - grey)
    legend = {"appeared": APPEARED, "went away": WENT_AWAY, "no conflict": NO_CONFLICT}
    return cells_panel(colours, conflict.spec, title or "conflict", legend)


def layer_panel(layers: LayeredGrid, name: str, title: str = "") -> Panel:
    """Draw numbers from the lowest, purple, to the highest, yellow (matplotlib's "viridis"); grey without value.

    The layer ``cause`` is drawn with a colour for each `ogm.UnknownCause`, and shares of cells in the legend.
    """
    layer = layers[name]
    if name == CAUSE_LAYER:
        codes = cause_codes(layer)
        shares = {cause: float((codes == cause).mean()) for cause in UnknownCause}
        legend = {
            f"{cause.label}, {share:.1%}": CAUSE_COLOURS[cause] for cause, share in shares.items() if share >= 5e-4
        }
        return cells_panel(cause_colours(codes), layers.spec, title or "why unknown", legend)
    finite = layer[np.isfinite(layer)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    share = (layer - low) / ((high - low) or 1.0)
    colours = np.where(np.isnan(layer)[..., None], NO_VALUE, colour_map("viridis", share))
    steps = np.linspace(0, 1, 3 if high > low else bool(finite.size))
    colours_of = colour_map("viridis", steps)
    legend = {f"{low + at * (high - low):.4g}": tuple(colour) for at, colour in zip(steps, colours_of, strict=True)}
    return cells_panel(colours, layers.spec, title or name, legend | {"no value": NO_VALUE})


def cause_codes(layer: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return a layer ``cause`` as codes of `ogm.UnknownCause`; other numbers become `OUTSIDE_VIEW`."""
    codes = np.where((layer >= 0) & (layer < len(UnknownCause)), layer, UnknownCause.OUTSIDE_VIEW)
    return np.rint(codes).astype(np.uint8)


def cause_colours(codes: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return red, green, blue [0, 1] of codes of `ogm.UnknownCause`, (..., 3)."""
    return np.array([CAUSE_COLOURS[cause] for cause in UnknownCause], np.float32)[codes]


def velocity_panel(layers: LayeredGrid, title: str = "", max_speed: float | None = None) -> Panel:
    """Draw velocities: direction by colour, speed by brightness; black without motion or velocity.

    Parameters
    ----------
    layers : LayeredGrid
        Layers ``velocity_x`` (forward) and ``velocity_y`` (left) [m/s].
    title : str
    max_speed : float, optional
        Speed of full brightness [m/s]; by default the greatest speed.
    """
    x, y = (np.nan_to_num(layers[name]) for name in VELOCITY_LAYERS)
    speed = np.hypot(x, y)
    max_speed = float(speed.max()) if max_speed is None else max_speed
    brightness = np.sqrt(np.clip(speed / (max_speed or 1.0), 0, 1))
    colours = heading_colours(np.arctan2(y, x)) * brightness[..., None]
    return cells_panel(
        colours, layers.spec, title or f"velocity, up to {max_speed:.3g} m/s", heading_legend() | {"none": BLACK}
    )


def heading_colours(heading: NDArray[Any]) -> NDArray[np.float64]:
    """Return red, green, blue [0, 1] of directions [rad], (..., 3); pale, unlike free and occupied."""
    return 0.7 + 0.3 * np.cos(heading[..., None] - np.array([0, 2, -2]) * np.pi / 3)


def heading_legend() -> dict[str, Any]:
    """Return the colours of the directions along the axes, by name."""
    angles = {"+x": 0.0, "+y": np.pi / 2, "-x": np.pi, "-y": -np.pi / 2}
    return {name: tuple(heading_colours(np.array(angle)).tolist()) for name, angle in angles.items()}


BEHIND_POINTS = (0.08, 0.08, 0.08)
TURBO = (0.15, 0.825)  # part of matplotlib's "turbo" with a contrast of 4.5 or more to BEHIND_POINTS (WCAG 2)
LOWEST, HIGHEST = -0.5, 3.5  # [m] heights above ground with distinct colours
GROUND_CELL = 2.0  # [m] side of cells whose lowest points give the ground, by their median
DOTS, SPARSE_DOTS = 512, 384  # along the longer side of a picture
SPARSE = 0.05  # share of a picture covered by dots of one half cell, below which dots are wider


def dots_panel(
    xyz: NDArray[Any],
    colours: NDArray[Any],
    spec: GridSpec,
    title: str,
    legend: dict[str, tuple[float, float, float]],
    width: int | None = 1,
) -> Panel:
    """Draw points from above in given colours, on cells half as wide as the cells of `spec`.

    Parameters
    ----------
    xyz : (N, 3 or more) float array
        x, y, z [m] in the frame of `spec`. The highest point of each cell is shown.
    colours : (N, 3) float array
        Red, green, blue [0, 1] of each point.
    spec : GridSpec
        Area of the picture.
    title : str
    legend : dict of str to (red, green, blue)
    width : int, optional
        Width of a dot [half cells]; wider dots do not cover others. None chooses it by the size of the picture and the
        number of points.
    """
    fine = spec.refined(2)
    image, drawn = np.full((*fine.shape, 3), BEHIND_POINTS), np.zeros(fine.shape, bool)
    order = np.argsort(xyz[:, 2], kind="stable")  # the highest point of a cell is drawn last
    order = order[fine.contains(xyz[order, 0], xyz[order, 1])]
    cells = fine.index(xyz[order, 0], xyz[order, 1])
    image[cells], drawn[cells] = colours[order], True
    if width is None:
        width = max(1, round(max(fine.shape) / (SPARSE_DOTS if drawn.mean() < SPARSE else DOTS)))
    _widen(image, drawn, width)
    return cells_panel(image, spec, title, legend)


def _widen(image: NDArray[Any], drawn: NDArray[np.bool_], width: int) -> None:
    """Widen dots to `width` cells, without covering other dots."""
    for axis in (0, 1):
        to, of = (np.swapaxes(array, 0, axis) for array in (image, drawn))
        for step in range(1, width):
            # even and odd steps grow in opposite directions, so that dots stay centred
            source, target = (slice(1, None), slice(-1)) if step % 2 else (slice(-1), slice(1, None))
            grown = of[source] & ~of[target]
            to[target][grown] = to[source][grown]
            of[target] |= grown


def points_panel(
    cloud: NDArray[np.float32], spec: GridSpec, title: str = "", ground_z: float | None = None, width: int | None = None
) -> Panel:
    """Draw points from above, coloured by height.

    Parameters
    ----------
    cloud : (N, 3 or more) float array
        x, y, z [m] in the frame of `spec`.
    spec : GridSpec
        Area of the picture.
    title : str
    ground_z : float, optional
        Height of the ground in that frame [m]; by default the median of the lowest points of cells of 2 m.
    width : int, optional
        Width of a dot [half cells]; by default wider in large pictures and for few points.
    """
    cloud = cloud[np.isfinite(cloud[:, :3]).all(axis=1)]
    cloud = cloud[spec.contains(cloud[:, 0], cloud[:, 1])]
    base = _ground_z(cloud) if ground_z is None else ground_z
    legend = {f"{height} m": tuple(height_colours(np.array([height]))[0]) for height in (0, 1, 2, 3)}
    colours = height_colours(cloud[:, 2] - base)
    return dots_panel(cloud, colours, spec, title or "points by height", legend, width)


def height_colours(height: NDArray[Any]) -> NDArray[np.float64]:
    """Return red, green, blue [0, 1] of heights above ground [m], (..., 3); readable on black."""
    share = np.clip((height - LOWEST) / (HIGHEST - LOWEST), 0, 1)
    return colour_map("turbo", TURBO[0] + (TURBO[1] - TURBO[0]) * share)


def _ground_z(cloud: NDArray[Any]) -> float:
    """Return an estimate of the ground's height [m], as most cells contain a ground point; 0 without points."""
    if not len(cloud):
        return 0.0
    ix, iy = np.floor(cloud[:, :2].T / GROUND_CELL).astype(np.int64)
    _, cell = np.unique((ix << 32) + iy, return_inverse=True)
    lowest = np.full(cell.max() + 1, np.inf)
    np.minimum.at(lowest, cell, cloud[:, 2])
    return float(np.median(lowest))
