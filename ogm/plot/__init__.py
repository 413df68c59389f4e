"""Pictures of points and grids, the vehicle facing up. Only this package flips axes and defines colours.

>>> from ogm import EvidentialGrid, GridSpec, plot
>>> grid = EvidentialGrid.vacuous(GridSpec.centered(length=20.0, width=10.0, resolution=0.5))
>>> plot.save_picture("grid.png", grid, plot.probability_panel(grid), titles=["masses", "probability"])
"""

from ogm.plot.figures import save_picture, show
from ogm.plot.moving import dynamic_panel
from ogm.plot.panels import (
    Panel,
    cells_panel,
    conflict_panel,
    layer_panel,
    mass_panel,
    points_panel,
    probability_panel,
    unknown_panel,
    velocity_panel,
)

__all__ = [
    "Panel", "cells_panel", "conflict_panel", "dynamic_panel", "layer_panel", "mass_panel", "points_panel",
    "probability_panel", "save_picture", "show", "unknown_panel", "velocity_panel",
]  # fmt: skip
