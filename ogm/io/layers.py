"""The layers by whose names files and messages hold a grid: its masses, and what moves."""

from collections.abc import Collection

import numpy as np
from numpy.typing import NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.grid import EvidentialGrid, LayeredGrid

AnyGrid = EvidentialGrid | DynamicGrid
_MASSES = ("free", "occupied")
_VELOCITY = ("x", "y", "covariance_xx", "covariance_xy", "covariance_yy")
_MOVING = ("static", "dynamic", *(f"velocity_{name}" for name in _VELOCITY))


def evidential(grid: AnyGrid) -> EvidentialGrid:
    """Return the masses of free and occupied of a grid."""
    return grid.to_evidential() if isinstance(grid, DynamicGrid) else grid


def layers_of(grid: AnyGrid) -> dict[str, NDArray[np.float32]]:
    """Return free, occupied and unknown, and of a `DynamicGrid` also what else `DynamicGrid.to_layers` has."""
    layers = {"free": grid.free, "occupied": grid.occupied, "unknown": grid.unknown}
    return layers | (dict(grid.to_layers().layers) if isinstance(grid, DynamicGrid) else {})


def needed_layers(names: Collection[str]) -> tuple[str, ...]:
    """Return the layers to read of those that there are: of a `DynamicGrid` if all are there, else the masses.

    Raises
    ------
    KeyError
        If free or occupied is missing, with the names of those.
    """
    if missing := [name for name in _MASSES if name not in names]:
        raise KeyError(" and ".join(missing))
    return _MASSES + (_MOVING if set(_MOVING) <= set(names) else ())


def grid_from_layers(layers: LayeredGrid, *, nan_is_unknown: bool = False) -> AnyGrid:
    """Return the grid of the `needed_layers`.

    Parameters
    ----------
    layers : LayeredGrid
    nan_is_unknown : bool
        Whether nothing is known where a mass has no value (NaN); else it is an error.

    Raises
    ------
    ValueError
        If the numbers are no masses.
    """
    names = needed_layers(layers.layers)
    masses = [name for name in names if not name.startswith("velocity")]
    unknown = np.zeros(layers.spec.shape, np.bool_)
    for name in masses if nan_is_unknown else ():
        unknown |= np.isnan(layers[name])
    if len(names) > len(_MASSES):
        taken = {name: layers[name] for name in names}
        if unknown.any():
            taken |= {name: np.where(unknown, np.float32(0), taken[name]) for name in masses}
        return DynamicGrid.from_layers(LayeredGrid(layers.spec, taken))
    mass = np.stack([layers[name] for name in _MASSES], axis=-1)
    mass[unknown] = 0
    return EvidentialGrid(layers.spec, mass)
