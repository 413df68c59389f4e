"""Display of grids, scans and datasets in notebooks: a small picture and a table of facts.

`EvidentialGrid`, `DynamicGrid`, `LayeredGrid` and `Scan` call `png` and `html`, see `ogm.grid.ShownInNotebooks`.
"""

from base64 import b64encode
from collections.abc import Callable, Mapping, Sequence
from functools import partial, singledispatch
from html import escape
from io import BytesIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ogm import plot
from ogm.dynamic_grid import DynamicGrid
from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid
from ogm.plot.colours import colours
from ogm.plot.moving import moving_groups
from ogm.plot.overview import FULL_MASS, Steps, halve_codes, halve_mass, halve_numbers, mass_to_bytes
from ogm.plot.panels import CAUSE_LAYER, CONFLICT_LAYERS, VELOCITY_LAYERS
from ogm.plot.view_layers import CAUSE_STEPS
from ogm.scan import Scan

MAX_SIDE, MIN_SIDE = 520, 260  # [px] along the longer side of a panel
PANELS, GAP = 4, 6  # layers side by side; [px] between them
STRIP = 1024  # rows that are shrunk together; even
MIN_REACH, MAX_REACH = 5.0, 60.0  # [m] shown around the sensor, to include 98 % of the points


@singledispatch
def png(value: object) -> bytes:
    """Return the picture of a value as PNG; empty if there is nothing to show."""
    raise TypeError(f"there is no picture of {type(value).__name__}")


@singledispatch
def html(value: object) -> str:
    """Return HTML with the picture of a value and a table of facts."""
    raise TypeError(f"there is no page of {type(value).__name__}")


@png.register
def _grid_png(grid: EvidentialGrid) -> bytes:
    """Return a picture of belief, in the colours of `ogm.plot.colours`."""
    mass, spec = _shrunk(grid.spec, lambda rows: mass_to_bytes(grid.mass[rows]), halve_mass)
    shares = np.divide(mass, FULL_MASS, dtype=np.float32)
    return _png([plot.mass_panel(EvidentialGrid.trusted(spec, shares))])


@html.register
def _grid_html(grid: EvidentialGrid) -> str:
    """Return the picture of a grid, its cells and mean masses."""
    free, occupied = (float(mass.mean()) for mass in (grid.free, grid.occupied))
    shares = {"free": free, "occupied": occupied, "unknown": max(0.0, 1 - free - occupied)}
    facts = {f"{name}, mean": f"{100 * share:.1f} %" for name, share in shares.items()}
    text = f"belief: {colours().text}; x, forward, is up"
    return _html("EvidentialGrid", _spec_facts(grid.spec) | facts, _grid_png(grid), text)


@png.register
def _dynamic_png(grid: DynamicGrid) -> bytes:
    """Return the picture of `ogm.plot.dynamic_panel` without arrows; pixels show their most occupied cell."""
    step = -(-max(grid.spec.shape) // MAX_SIDE)
    occupied = np.pad(grid.occupied, [(0, -count % step) for count in grid.spec.shape], constant_values=-1)
    nx, ny = (count // step for count in occupied.shape)
    most = occupied.reshape(nx, step, ny, step).swapaxes(1, 2).reshape(nx, ny, -1).argmax(axis=-1)
    at = step * np.arange(nx)[:, None] + most // step, step * np.arange(ny) + most % step
    spec = GridSpec(grid.spec.resolution * step, most.shape, grid.spec.origin)
    small = DynamicGrid(spec, grid.mass[at], grid.velocity[at], grid.covariance[at])
    return _png([plot.dynamic_panel(small, seconds=0.0)])


@html.register
def _dynamic_html(grid: DynamicGrid) -> str:
    """Return the picture of a dynamic grid, its cells, mean masses and the median speed of moving cells."""
    shares = {name: float(getattr(grid, name).mean()) for name in ("free", "static", "dynamic", "unknown")}
    facts = {f"{name}, mean": f"{100 * share:.1f} %" for name, share in shares.items()}
    moving = moving_groups(grid) > 0
    facts["moving cells"] = f"{np.count_nonzero(moving)}" + (
        f", median {np.median(grid.speed[moving]):.1f} m/s" if moving.any() else ""
    )
    text = f"{colours().text}, pale the heading of moving cells; x, forward, is up"
    return _html("DynamicGrid", _spec_facts(grid.spec) | facts, _dynamic_png(grid), text)


@png.register
def _layers_png(layers: LayeredGrid) -> bytes:
    """Return a picture of the first layers, side by side; empty without layers."""
    return _png(_layer_panels(layers))


@html.register
def _layers_html(layers: LayeredGrid) -> str:
    """Return the picture of layers, and their ranges of numbers."""
    facts = _spec_facts(layers.spec)
    for name, layer in layers.layers.items():
        low, high = (f"{number:.4g}" for number in Steps.of(layer)[:2])
        known = 1 - np.count_nonzero(np.isnan(layer)) / layer.size
        facts[name] = f"{low} … {high}" + (f", {100 * known:.1f} % of the cells" if known < 1 else "")
    titles = ", ".join(panel.title for panel in _layer_panels(layers))
    return _html("LayeredGrid", facts, _layers_png(layers), f"{titles}; x, forward, is up")


@png.register
def _scan_png(scan: Scan) -> bytes:
    """Return a picture of the points around the sensor, by height."""
    xyz = scan.points[np.isfinite(scan.points[:, :3]).all(axis=1), :3]
    reach = float(np.quantile(np.abs(xyz[:, :2]).max(axis=1), 0.98)) if len(xyz) else MIN_REACH
    half = min(max(1.05 * reach, MIN_REACH), MAX_REACH)
    spec = GridSpec(2 * half / 200, (200, 200), (-half, -half))
    return _png([plot.points_panel(xyz, spec)])


@html.register
def _scan_html(scan: Scan) -> str:
    """Return the picture of a scan, its extent and its columns."""
    columns = [name for name in ("time", "ring", "doppler", "rcs") if getattr(scan, name) is not None]
    facts = {"sensor": scan.sensor} if scan.sensor else {}
    if scan.kind:
        facts["kind"] = scan.kind
    facts["points"] = f"{len(scan)}"
    if scan.stamp is not None:
        facts["stamp"] = f"{scan.stamp:.3f} s"
    xyz = scan.points[np.isfinite(scan.points[:, :3]).all(axis=1)]
    for name, values in zip(("x", "y", "z"), xyz.T, strict=False):
        if len(xyz):
            facts[name] = f"{values.min():.1f} … {values.max():.1f} m"
    facts["columns"] = ", ".join(["x, y, z, intensity", *columns])
    if scan.no_returns is not None:
        facts["beams without echo"] = f"{len(scan.no_returns)}"
    if scan.max_range is not None:
        facts["greatest range"] = f"{scan.max_range:g} m"
    return _html("Scan", facts, _scan_png(scan), "points by height, red the highest; x, forward, is up")


def facts_html(title: str, facts: Mapping[str, str]) -> str:
    """Return names and values as an HTML table."""
    left = 'style="text-align:left;padding-right:1em"'
    lines = ((escape(name), escape(value)) for name, value in facts.items())
    rows = "".join(f"<tr><th {left}>{name}</th><td {left}>{value}</td></tr>" for name, value in lines)
    return f'<table><caption style="text-align:left;font-weight:bold">{escape(title)}</caption>{rows}</table>'


def _html(title: str, facts: Mapping[str, str], png: bytes, text: str) -> str:
    image = (
        f'<img src="data:image/png;base64,{b64encode(png).decode()}" alt="{escape(text)}" title="{escape(text)}" '
        'style="max-height:320px;max-width:100%">'
        if png
        else ""
    )
    style = "display:flex;flex-wrap:wrap;gap:1em;align-items:flex-start"
    return f'<div style="{style}">{image}{facts_html(title, facts)}</div>'


def _spec_facts(spec: GridSpec) -> dict[str, str]:
    x0, x1, y0, y1 = spec.extent
    cells = f"{spec.shape[0]} x {spec.shape[1]} of {spec.resolution:g} m"
    return {"cells": cells, "x": f"{x0:g} … {x1:g} m", "y": f"{y0:g} … {y1:g} m"}


def _layer_panels(layers: LayeredGrid) -> list[plot.Panel]:
    """Return panels of the first layers; pairs of velocity and conflict layers share a panel."""
    names, panels = list(layers.layers), []
    for pair, panel in ((VELOCITY_LAYERS, plot.velocity_panel), (CONFLICT_LAYERS, plot.conflict_panel)):
        if set(pair) <= set(names):
            names = [name for name in names if name not in pair]
            panels.append(panel(_small(layers, pair)))
    panels += [plot.layer_panel(_small(layers, (name,)), name) for name in names[: max(0, PANELS - len(panels))]]
    return panels


def _small(layers: LayeredGrid, names: Sequence[str]) -> LayeredGrid:
    """Return layers at the resolution of the picture."""
    steps = Steps.of(*(layers[name] for name in names), symmetric=len(names) > 1)
    halve: Callable[[NDArray[np.uint8]], NDArray[np.uint8]] = partial(halve_numbers, steps=steps)
    if names == (CAUSE_LAYER,):
        steps, halve = CAUSE_STEPS, halve_codes

    def rows(of: slice) -> NDArray[np.uint8]:
        return np.stack([steps.to_bytes(layers[name][of]) for name in names], axis=-1)

    cells, spec = _shrunk(layers.spec, rows, halve)
    numbers = steps.numbers.astype(np.float32)[cells]
    return LayeredGrid(spec, {name: numbers[..., k] for k, name in enumerate(names)})


def _shrunk(
    spec: GridSpec, rows: Callable[[slice], NDArray[np.uint8]], halve: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]
) -> tuple[NDArray[np.uint8], GridSpec]:
    """Return bytes and spec at a resolution that is halved until the cells fit into the picture."""
    large = max(spec.shape) > MAX_SIDE
    strips = (rows(slice(start, start + STRIP)) for start in range(0, spec.shape[0], STRIP))
    cells = np.concatenate([halve(strip) if large else strip for strip in strips])
    factor = 2 if large else 1
    while max(cells.shape) > MAX_SIDE:
        cells, factor = halve(cells), 2 * factor
    return cells, GridSpec(spec.resolution * factor, cells.shape[:2], spec.origin)


def _png(panels: Sequence[plot.Panel]) -> bytes:
    """Return panels side by side as PNG; small panels are enlarged."""
    if not panels:
        return b""
    images = []
    for panel in panels:
        times = max(1, MIN_SIDE // max(panel.image.shape))
        images += [panel.image.repeat(times, axis=0).repeat(times, axis=1)]
        images += [np.full((len(images[-1]), GAP, 3), 255, np.uint8)]
    file = BytesIO()
    Image.fromarray(np.concatenate(images[:-1], axis=1)).save(file, "PNG")
    return file.getvalue()
