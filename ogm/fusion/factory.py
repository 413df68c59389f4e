"""Maps by rule name, and the windows that they need."""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.evidence.map_rules import ADDING_RULES, BAYES, DYNAMIC, MAP_RULES, NUSS, RULES
from ogm.fusion.bayes import BinaryBayesMapper
from ogm.fusion.dynamic.mapper import DynamicFilter, DynamicMapper
from ogm.fusion.dynamic.settings import DynamicSettings
from ogm.fusion.evidential import EvidentialMapper
from ogm.fusion.map_editing import extended
from ogm.fusion.mapper import Mapper
from ogm.fusion.window import WindowMode
from ogm.grid import GridSpec
from ogm.io.grids.placed import PlacedGrid
from ogm.scan import Frame

_MARGIN = 1.0  # [m] around echoes
_DAMAGED = (ValueError, TypeError, OSError)  # errors of one scan, which the mapping reports
_MAX_CELLS = 2**24  # cells of a covering window: 655 m x 655 m at 0.16 m
_NO_POSES = "no scan has a pose, so the extent of a fixed window is unknown: give poses, or window=rolling"


def make_mapper(
    rule: str,
    spec: GridSpec,
    half_life: float | None = None,
    window: WindowMode = "rolling",
    particles: int = 200_000,
    max_speed: float = 70.0,
    saved: PlacedGrid | None = None,
    T_map_vehicle: NDArray[np.float64] | None = None,  # noqa: N803
) -> Mapper:
    """Return a map for the name of a rule, with default parameters.

    Parameters
    ----------
    rule : str
        A name in `ogm.evidence.map_rules.MAP_RULES`: an evidence rule, ``"bayes"`` for `BinaryBayesMapper`, or
        ``"dynamic"`` and ``"nuss"`` for `DynamicMapper` with its own filter and with the filter of Nuss et al.
    spec : GridSpec
        Window of the map.
    half_life : float, optional
        Half-life of belief [s]: by default 2, and infinity for ``"bayes"``. For dynamic maps the half-life of static,
        by default that of `DynamicSettings`.
    window : {"rolling", "fixed"}
    particles : int
        Number of particles of a dynamic map.
    max_speed : float
        Greatest speed [m/s]; a pose beyond its reach is a jump. Infinity allows every jump.
    saved : PlacedGrid, optional
        A map that an evidence rule continues, see `EvidentialMapper.from_grid`.
    T_map_vehicle : (4, 4) array, optional
        First pose of a rolling window of a saved map.

    Raises
    ------
    ValueError
        If there is no such rule, or a saved map has no cell in the window.
    """
    if saved is not None and rule not in RULES:
        raise ValueError(f"a saved map is continued by the rules {', '.join(RULES)}, got {rule}")
    if rule == BAYES:
        return BinaryBayesMapper(spec, math.inf if half_life is None else half_life, window=window, max_speed=max_speed)
    if rule in (DYNAMIC, NUSS):
        filter_name: DynamicFilter = "hybrid" if rule == DYNAMIC else "nuss"
        settings = None if half_life is None else DynamicSettings(static_half_life=half_life)
        return DynamicMapper(spec, particles, filter=filter_name, window=window, max_speed=max_speed, settings=settings)
    if rule not in RULES:
        raise ValueError(f"there is no rule {rule!r}; there are {', '.join(MAP_RULES)}")
    half_life = 2.0 if half_life is None else half_life
    options: dict[str, Any] = {"half_life": half_life, "window": window, "max_speed": max_speed}
    if saved is None:
        return EvidentialMapper(spec, RULES[rule], **options)
    return EvidentialMapper.from_grid(saved, spec, T_map_vehicle=T_map_vehicle, rule=RULES[rule], **options)


def adding_rule_warning(rule: str) -> str:
    """Return a warning about a rule that treats scans as independent, "" for other rules.

    Parameters
    ----------
    rule : str
        A name in `ogm.evidence.map_rules.MAP_RULES`.
    """
    if rule not in ADDING_RULES:
        return ""
    return (
        f"rule {rule} adds up evidence that every scan repeats: cells become free or occupied although no single scan "
        "shows it, as in the shadow of a parked car; revise, the default, leaves them unknown (docs/fusion.md)"
    )


def rolling_window(spec: GridSpec) -> GridSpec:
    """Return a square window as wide as the diagonal of a grid, so that views of the grid are complete at any yaw."""
    side = 2 * math.ceil(math.hypot(spec.length, spec.width) / 2 / spec.resolution + 1)
    corner = -side * spec.resolution / 2
    return GridSpec(spec.resolution, (side, side), (corner, corner))


def covering_window(spec: GridSpec, poses: NDArray[np.float64]) -> GridSpec:
    """Return the window, in map coordinates, that contains a grid at all poses (K, 4, 4) of a drive.

    Raises
    ------
    ValueError
        If there is no pose, or more than 2**24 cells would be needed.
    """
    if not len(poses):
        raise ValueError(_NO_POSES)
    reach = math.hypot(spec.length, spec.width) / 2
    xy = poses[:, :2, 3]
    return bounding_window(spec.resolution, xy.min(axis=0) - reach, xy.max(axis=0) + reach)


def bounding_window(step: float, lowest: NDArray[np.float64], highest: NDArray[np.float64]) -> GridSpec:
    """Return the window of cells of side `step` [m], in map coordinates, that contains a rectangle.

    Parameters
    ----------
    step : float
    lowest, highest : (2,) float64
        Corners of the rectangle [m].

    Raises
    ------
    ValueError
        If more than 2**24 cells would be needed.
    """
    low, high = [math.floor(x / step) for x in lowest], [math.ceil(x / step) for x in highest]
    nx, ny = (max(b - a, 1) for a, b in zip(low, high, strict=True))
    if nx * ny > _MAX_CELLS:
        raise ValueError(
            f"a fixed window would need {nx} x {ny} cells for a drive over {nx * step:.0f} m x {ny * step:.0f} m, at "
            f"most {_MAX_CELLS} are allowed; give `window=rolling`, or a coarser `resolution`"
        )
    return GridSpec(step, (nx, ny), (low[0] * step, low[1] * step))


def continued_window(cells: GridSpec, saved: PlacedGrid, window: WindowMode | str) -> GridSpec:
    """Return the window of a drive that continues a saved map; a fixed window holds both, on the cells of the map.

    Parameters
    ----------
    cells : GridSpec
        Window of the drive alone.
    saved : PlacedGrid
    window : {"rolling", "fixed"}
    """
    old = saved.upright.grid.spec
    if window == "rolling":
        return cells
    return extended(old, cells) if math.isclose(old.resolution, cells.resolution) else extended(cells, old)


def echo_window(frames: Iterable[Frame], spec: GridSpec) -> GridSpec:
    """Return the window, in map coordinates, that contains all echoes of planar scans with a margin of 1 m.

    All scans are read once. Echoes beyond the reach of a measurement grid are ignored.

    Parameters
    ----------
    frames : iterable of Frame
    spec : GridSpec
        Cells of a measurement grid.

    Raises
    ------
    ValueError
        If no scan has a pose, or more than 2**24 cells would be needed.
    """
    reach = math.hypot(spec.length, spec.width) / 2
    corners = []
    for frame in frames:
        T = frame.T_map_sensor
        if T is None:
            continue
        corners.append(np.stack([T[:2, 3], T[:2, 3]]))
        try:
            points = frame.scan.points[:, :3]
        except _DAMAGED:
            continue
        points = points[np.hypot(points[:, 0], points[:, 1]) < reach]  # false for NaN
        if len(points):
            ends = points.astype(np.float64) @ T[:2, :3].T + T[:2, 3]
            corners.append(np.stack([ends.min(axis=0), ends.max(axis=0)]))
    if not corners:
        raise ValueError(_NO_POSES)
    both = np.stack(corners)
    return bounding_window(spec.resolution, both[:, 0].min(axis=0) - _MARGIN, both[:, 1].max(axis=0) + _MARGIN)
