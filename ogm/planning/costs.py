"""Costs of cells, equal to nav2's inflation layer."""

import math
from functools import lru_cache
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.grid import EvidentialGrid
from ogm.planning.distances import cells_to, check_length, evidential_of
from ogm.state import CellState, predict_state

CostUnknown = Literal["unknown", "inflated", "obstacle", "free"]
INSCRIBED, LETHAL, UNKNOWN = 253, 254, 255  # nav2_costmap_2d/cost_values.hpp


def costmap(
    grid: EvidentialGrid | DynamicGrid,
    inscribed_radius: float,
    inflation_radius: float,
    cost_scaling: float = 10.0,
    unknown: CostUnknown = "unknown",
) -> NDArray[np.uint8]:
    """Return the costs of nav2's inflation layer for a map.

    A cell at the distance d from the nearest obstacle, from centre to centre, costs
    ``252 exp(-cost_scaling (d - inscribed_radius))``, rounded down.

    Parameters
    ----------
    grid : EvidentialGrid or DynamicGrid
        Obstacles are the cells that `ogm.state.predict_state` predicts occupied, as in a map of map_server.
    inscribed_radius : float
        Radius of the largest circle about the vehicle's origin inside its footprint [m].
    inflation_radius : float
        Distance beyond which obstacles have no cost [m], rounded up to whole cells; at least `inscribed_radius`.
    cost_scaling : float
        Decrease of costs with distance [1/m], nav2's ``cost_scaling_factor``, 0 or more.
    unknown : {"unknown", "inflated", "obstacle", "free"}
        Cost of unknown cells. "unknown": 255, but 253 within the inscribed radius, nav2's default. "inflated": 255, or
        the cost of near obstacles (``inflate_unknown``). "obstacle": 254, with costs around
        (``inflate_around_unknown``). "free": as free cells.

    Returns
    -------
    (nx, ny) uint8
        0 free to 252, 253 within the inscribed radius of an obstacle, 254 obstacle, 255 unknown.

    Raises
    ------
    TypeError
        If `grid` holds no masses.
    ValueError
        If a number is out of its range, or `unknown` is not one of the choices.

    Notes
    -----
    Computed as in nav2_costmap_2d, ``InflationLayer::computeCost`` and ``updateCosts``, but with exact distances: for
    one cell in 9,000, nav2's search misses the nearest obstacle and the cost is lower. Since 2026 nav2 uses exact
    distances too, rounded to hundredths of a cell.
    """
    if unknown not in get_args(CostUnknown):
        raise ValueError(f"unknown must be one of {', '.join(get_args(CostUnknown))}, got {unknown!r}")
    for name, length in (("inscribed_radius", inscribed_radius), ("inflation_radius", inflation_radius)):
        check_length(name, length)
    if not 0 <= cost_scaling < math.inf:
        raise ValueError(f"cost_scaling must be 0 or more and finite [1/m], got {cost_scaling}")
    if inflation_radius < inscribed_radius:
        raise ValueError(
            f"inflation_radius must be at least inscribed_radius, {inscribed_radius} m, got {inflation_radius}: else "
            "cells in which the vehicle collides would have no cost"
        )
    state, side = predict_state(evidential_of(grid).mass), grid.spec.resolution
    of_state = np.zeros(3, np.uint8)
    of_state[CellState.UNKNOWN] = {"free": 0, "obstacle": LETHAL}.get(unknown, UNKNOWN)
    of_state[CellState.OCCUPIED] = LETHAL
    costs = of_state[state]
    obstacle = costs == LETHAL
    reach = min(math.ceil(inflation_radius / side), math.isqrt(sum(n * n for n in state.shape)) + 1)
    if not reach or not obstacle.any():
        return costs
    around = cost_table(reach, side, inscribed_radius, cost_scaling).take(cells_to(obstacle), mode="clip")
    kept = (costs == UNKNOWN) & (around < (1 if unknown == "inflated" else INSCRIBED))
    costs[costs == UNKNOWN] = 0
    np.maximum(costs, around, out=costs)
    costs[kept] = UNKNOWN
    return costs


@lru_cache(maxsize=8)
def cost_table(reach: int, side: float, inscribed_radius: float, cost_scaling: float) -> NDArray[np.uint8]:
    """Return the cost at squared distances 0 ... reach² [cells²] from the nearest obstacle, then 0.

    Parameters
    ----------
    reach : int
        Greatest distance [cells].
    side : float
        Side of a cell [m].
    inscribed_radius, cost_scaling : float
        See `costmap`.
    """
    table = np.zeros(reach * reach + 2, np.uint8)
    for square in range(reach * reach + 1):
        distance = math.sqrt(square) * side
        inside = distance <= inscribed_radius
        factor = 1.0 if inside else math.exp(-cost_scaling * (distance - inscribed_radius))  # as in C; numpy's differs
        table[square] = INSCRIBED if inside else int((INSCRIBED - 1) * factor)
    table[0] = LETHAL
    table.flags.writeable = False
    return table
