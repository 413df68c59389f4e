"""Layers of the page of `ogm.plot.viewer`, as tables of colours taken from the panels of `ogm.plot`."""

from base64 import b64encode
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm import plot
from ogm.dynamic_grid import DynamicGrid
from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid
from ogm.plot.colours import CAUSE_COLOURS, colours
from ogm.plot.moving import moving_arrows
from ogm.plot.overview import FULL_MASS, Steps
from ogm.plot.panels import CAUSE_LAYER, CONFLICT_LAYERS, NO_CONFLICT, NO_VALUE, VELOCITY_LAYERS, colour_bytes
from ogm.unknown_cause import UnknownCause

Layer = dict[str, Any]
CAUSE_STEPS = Steps(0.0, 254.0)  # whole numbers
_AXES = "directions along the map's axes, x up and y to the left"
_SHADES = 24  # of the bar of a continuous scale


def mass_layers(stored: int) -> list[Layer]:
    """Return the layers of an evidential grid.

    Parameters
    ----------
    stored : int
        Index of its masses in the stored numbers of the page.
    """
    mass = np.arange(FULL_MASS + 1) / FULL_MASS
    none = np.zeros_like(mass)
    free, occupied = plot.mass_panel(_masses(mass, none)), plot.mass_panel(_masses(none, mass))
    unknown = plot.unknown_panel(_masses(1 - mass, none))
    probability = np.arange(2 * FULL_MASS + 1) / (2 * FULL_MASS)  # occupied + unknown / 2: half steps
    grey = plot.probability_panel(_masses(1 - probability, probability))
    state = plot.mass_panel(_masses(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])))  # in the order of CellState
    both, scale = [[stored, 0], [stored, 1]], ["0", "0.5", "1"]
    return [
        _layer("belief", "sum", both, [free, occupied], "mixed by the masses of the cell", swatches=colours().legend),
        _layer("free", "sum", both[:1], [free], "mass of free", scale),
        _layer("occupied", "sum", both[1:], [occupied], "mass of occupied", scale),
        _layer("unknown", "unknown", both, [unknown], "mass of unknown: 1 − free − occupied", scale),
        _layer("probability", "probability", both, [grey], "of occupied: occupied + unknown / 2", scale),
        _layer("state", "state", both, [state], "the greatest of the three masses", swatches=colours().legend),
    ]


def number_layer(stored: int, name: str, steps: Steps) -> Layer:
    """Return the layer of one number per cell."""
    panel = plot.layer_panel(_cells({name: steps.numbers}), name)
    *scale, _ = panel.legend
    return _layer(name, "sum", [[stored, 0]], [panel], "", scale, {"no value": NO_VALUE})


def cause_layer(stored: int) -> Layer:
    """Return the layer of causes of unknown cells, codes of `ogm.UnknownCause` stored in `CAUSE_STEPS`."""
    numbers = np.nan_to_num(CAUSE_STEPS.numbers, nan=-1.0)
    panel = plot.layer_panel(_cells({CAUSE_LAYER: numbers}), CAUSE_LAYER)
    swatches = {cause.label: CAUSE_COLOURS[cause] for cause in UnknownCause}
    return _layer("why unknown", "sum", [[stored, 0]], [panel], "", swatches=swatches)


def conflict_layer(stored: Sequence[tuple[int, Steps]]) -> Layer:
    """Return the layer of both kinds of conflict, by the index and the steps of each."""
    panels = []
    for name, (_, steps) in zip(CONFLICT_LAYERS, stored, strict=True):
        numbers = {other: np.zeros(FULL_MASS + 1) for other in CONFLICT_LAYERS}
        panels.append(plot.conflict_panel(_cells(numbers | {name: np.nan_to_num(steps.numbers)})))
    grey = colour_bytes(np.array(NO_CONFLICT) / 2)  # the page adds both colours
    panels = [panel._replace(image=np.maximum(panel.image, grey) - grey) for panel in panels]
    text = "of scans and map: free cells became occupied, or occupied cells free"
    return _layer("conflict", "sum", [[place, 0] for place, _ in stored], panels, text, swatches=panels[0].legend)


def motion_layer(masses: int, dynamic: int, velocity: int, grid: DynamicGrid) -> Layer:
    """Return the layer of static cells, dynamic cells coloured by heading, and arrows of moving groups.

    Parameters
    ----------
    masses, dynamic, velocity : int
        Indices of free and occupied, of dynamic, and of the velocity in the stored numbers of the page.
    grid : DynamicGrid
        Grid for the arrows.
    """
    legend = plot.dynamic_panel(grid, seconds=0.0).legend
    mass = np.arange(FULL_MASS + 1) / FULL_MASS
    free, static = (plot.mass_panel(_masses(*parts)) for parts in ((mass, 0 * mass), (0 * mass, mass)))
    text = f"mixed by the masses of the cell; {_AXES}; an arrow shows the motion of a group in 1 s"
    of = [[masses, 0], [masses, 1], [dynamic, 0], [velocity, 0], [velocity, 1]]
    layer = _layer("motion", "motion", of, [_headings(), free, static], text, swatches=legend)
    return layer | {"arrows": moving_arrows(grid).round(3).tolist()}


def velocity_layer(stored: int, steps: Steps) -> Layer:
    """Return the layer of velocities: direction by colour, speed by brightness."""
    panel = _headings()
    text = f"direction by colour, speed by brightness, up to {steps.high:.3g} m/s; {_AXES}"
    layer = _layer("velocity", "velocity", [[stored, 0], [stored, 1]], [panel], text, swatches=panel.legend)
    return layer | {"fastest": steps.high}


def _headings() -> plot.Panel:
    """Return the panel of 256 directions, starting forward."""
    heading = np.arange(256) * (2 * np.pi / 256)
    parts = zip(VELOCITY_LAYERS, (np.cos(heading), np.sin(heading)), strict=True)
    return plot.velocity_panel(_cells(dict(parts)))


def _layer(
    name: str,
    paint: str,
    of: list[list[int]],
    tables: Sequence[plot.Panel],
    text: str,
    scale: Sequence[str] = (),
    swatches: dict[str, tuple[float, float, float]] | None = None,
) -> Layer:
    """Return a layer: painting method, stored numbers, tables of colours, and legend."""
    colours = [panel.image[0, ::-1] for panel in tables]  # in the order of the bytes
    shades = colours[0][np.linspace(len(colours[0]) > 1, len(colours[0]) - 1, _SHADES).astype(int)]
    return {
        "name": name,
        "paint": paint,
        "of": of,
        "tables": [b64encode(table.tobytes()).decode() for table in colours],
        "text": text,
        "scale": list(scale),
        "shades": shades.tolist() if scale else [],
        "swatches": [[key, [round(255 * part) for part in colour]] for key, colour in (swatches or {}).items()],
    }


def _cells(numbers: dict[str, NDArray[np.float64]]) -> LayeredGrid:
    """Return a row of cells with layers, a cell for each byte."""
    count = len(next(iter(numbers.values())))
    spec = GridSpec(1.0, (1, count), (0.0, 0.0))
    return LayeredGrid(spec, {name: layer[None].astype(np.float32) for name, layer in numbers.items()})


def _masses(free: NDArray[np.float64], occupied: NDArray[np.float64]) -> EvidentialGrid:
    """Return a row of cells with masses, a cell for each byte."""
    mass = np.stack([free, occupied], axis=-1)[None].astype(np.float32)
    return EvidentialGrid(GridSpec(1.0, mass.shape[:2], (0.0, 0.0)), mass)
