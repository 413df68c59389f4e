"""Pictures of points and grids, the vehicle facing up. The only place that flips axes or knows colours.

>>> from ogm import EvidentialGrid, GridSpec, plot
>>> grid = EvidentialGrid.vacuous(GridSpec.centered(length=20.0, width=10.0, resolution=0.5))
>>> plot.save_picture("grid.png", grid, plot.probability_panel(grid), titles=["masses", "probability"])
"""

from ogm.plot.figures import save_picture, show
from ogm.plot.moving import dynamic_panel, heading_wheel, moving_arrows, moving_groups
from ogm.plot.panels import (
    APPEARED,
    BLACK,
    CONFLICT_LAYERS,
    NO_VALUE,
    VELOCITY_LAYERS,
    WENT_AWAY,
    Panel,
    cells_panel,
    colour_bytes,
    conflict_panel,
    heading_colours,
    layer_panel,
    mass_panel,
    probability_panel,
    unknown_panel,
    upright,
    velocity_panel,
)
from ogm.plot.points import BEHIND_POINTS, HIGHEST, LOWEST, dots_panel, height_colours, points_panel

__all__ = [
    "APPEARED",
    "BEHIND_POINTS",
    "BLACK",
    "CONFLICT_LAYERS",
    "HIGHEST",
    "LOWEST",
    "NO_VALUE",
    "VELOCITY_LAYERS",
    "WENT_AWAY",
    "Panel",
    "cells_panel",
    "conflict_panel",
    "dots_panel",
    "dynamic_panel",
    "heading_colours",
    "heading_wheel",
    "height_colours",
    "layer_panel",
    "mass_panel",
    "moving_arrows",
    "moving_groups",
    "points_panel",
    "probability_panel",
    "save_picture",
    "show",
    "colour_bytes",
    "unknown_panel",
    "upright",
    "velocity_panel",
]
