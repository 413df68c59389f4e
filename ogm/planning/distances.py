"""Distances to obstacles, and obstacles inflated by the radius of a vehicle."""

import math
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.grid import EvidentialGrid
from ogm.planning.kernels import squared_distances
from ogm.state import CellState, predict_state

DistanceUnknown = Literal["obstacle", "free", "only"]


def evidential_of(grid: EvidentialGrid | DynamicGrid) -> EvidentialGrid:
    """Return the masses of free and occupied of a grid, or raise TypeError for other objects."""
    if isinstance(grid, DynamicGrid):
        return grid.to_evidential()
    if not isinstance(grid, EvidentialGrid):
        raise TypeError(f"wanted an EvidentialGrid or a DynamicGrid, got {type(grid).__name__}: give mapper.grid")
    return grid


def check_length(name: str, length: float) -> None:
    """Raise ValueError unless a length is 0 or more and finite."""
    if not 0 <= length < math.inf:
        raise ValueError(f"{name} must be 0 m or more and finite, got {length}")


def cells_to(obstacle: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Return the squared distance of each cell to the nearest obstacle [cells²]; at least one obstacle must exist."""
    squares = np.empty(obstacle.shape, np.int64)
    squared_distances(np.ascontiguousarray(obstacle), squares)
    return squares


def distance_to_obstacles(
    grid: EvidentialGrid | DynamicGrid, unknown: DistanceUnknown = "obstacle"
) -> NDArray[np.float32]:
    """Return the Euclidean distance of each cell to the nearest obstacle.

    Distances are exact, from centre to centre of cells: an obstacle may begin up to 0.71 cells before its centre.

    Parameters
    ----------
    grid : EvidentialGrid or DynamicGrid
        Obstacles are the cells that `ogm.state.predict_state` predicts occupied.
    unknown : {"obstacle", "free", "only"}
        Role of unknown cells. "obstacle": obstacles, as is everything outside of the grid. "free": free cells. "only":
        the distance to the nearest unknown cell, or to the outside, is returned instead.

    Returns
    -------
    (nx, ny) float32
        [m]; 0 in obstacles, inf in a grid without obstacles.

    Raises
    ------
    TypeError
        If `grid` holds no masses.
    ValueError
        If `unknown` is not one of the choices.
    """
    if unknown not in get_args(DistanceUnknown):
        raise ValueError(f"unknown must be one of {', '.join(get_args(DistanceUnknown))}, got {unknown!r}")
    state = predict_state(evidential_of(grid).mass)
    obstacle = {
        "obstacle": state != CellState.FREE, "free": state == CellState.OCCUPIED, "only": state == CellState.UNKNOWN
    }[unknown]  # fmt: skip
    distance = np.sqrt(cells_to(obstacle)) if obstacle.any() else np.full(state.shape, np.inf)
    if unknown != "free":
        (nx, ny), i, j = state.shape, *map(np.arange, state.shape)
        np.minimum(distance, np.minimum(i + 1, nx - i)[:, None], out=distance)
        np.minimum(distance, np.minimum(j + 1, ny - j), out=distance)
    distance *= grid.spec.resolution
    return distance.astype(np.float32)


def inflated(grid: EvidentialGrid | DynamicGrid, radius: float) -> EvidentialGrid:
    """Return the grid for a round vehicle that is planned as a point: obstacles are inflated by its radius.

    Each cell has the greatest mass of occupied and the least mass of free of all cells within the radius, equal to
    `ogm.planning.collision` for a disc. Everything outside of the grid is unknown.

    Parameters
    ----------
    grid : EvidentialGrid or DynamicGrid
    radius : float
        Radius of the vehicle [m], from centre to centre of cells.

    Raises
    ------
    TypeError
        If `grid` holds no masses.
    ValueError
        If the radius is negative or not finite.
    """
    check_length("radius", radius)
    spec, mass = grid.spec, evidential_of(grid).mass
    nx, ny = spec.shape
    squared = (radius / spec.resolution) ** 2
    reach = min(math.floor(math.sqrt(squared)), max(nx, ny))
    around = np.zeros((nx + 2 * reach, ny + 2 * reach, 2), np.float32)
    around[reach : reach + nx, reach : reach + ny] = mass
    around[..., 0] *= -1  # so that both layers take the maximum
    result = np.full((nx, ny, 2), -np.inf, np.float32)
    widest, half = around[:, reach : reach + ny].copy(), 0  # maximum over `half` cells to both sides along y
    for di in range(reach, -1, -1):
        while (half + 1) ** 2 + di**2 <= squared and half < reach:
            half += 1
            np.maximum(widest, around[:, reach - half : reach - half + ny], out=widest)
            np.maximum(widest, around[:, reach + half : reach + half + ny], out=widest)
        for row in {reach - di, reach + di}:
            np.maximum(result, widest[row : row + nx], out=result)
    result[..., 0] *= -1
    return EvidentialGrid.trusted(spec, result)
