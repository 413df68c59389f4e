"""Truth of a town without its traffic: what stands still, seen from many places of the drives through it."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from ogm.grid import GridSpec
from ogm.pose import pose
from ogm.simulation.cells import measure_ground
from ogm.simulation.moments import set_up
from ogm.simulation.plan import DatasetPlan
from ogm.simulation.survey import aimed_truth
from ogm.state import CellState, Truth
from ogm.truth import TRUTH_SPEC


def static_truth(plan: DatasetPlan, split: str, numbers: Iterable[int], spec: GridSpec, *, threads: int = 0) -> Truth:
    """Return the truth of a town without vehicles and people, moving or parked, in cells of the world.

    Rays are aimed from above the ground where the lidar was, by the rules of `ogm.simulation.survey`. The sensor stands
    upright and is moved by less than half a cell, so that the cells of all places are those of `spec`, and nothing is
    resampled. A cell that is occupied from one place is occupied; one where ground alone was hit is free; the others
    are unknown.

    Parameters
    ----------
    plan : DatasetPlan
        Of the drives.
    split : str
    numbers : iterable of int
        Samples of one town, whose places are looked from. One every 15 m is enough.
    spec : GridSpec
        Cells of 0.16 m whose corners are whole multiples of it, such as `ogm.world.WorldMap.cells` gives.
    threads : int
        Processor cores to use, 0 for all. The truth does not depend on it.

    Raises
    ------
    ValueError
        If the cells have another size or lie beside the multiples of it.
    """
    side = TRUTH_SPEC.resolution
    corner = np.array(spec.origin) / side
    if abs(spec.resolution - side) > 1e-9 or np.abs(corner - np.rint(corner)).max() > 1e-4:
        raise ValueError(f"the truth has cells of {side} m at whole multiples of it, got {spec}")
    state = np.full(spec.shape, CellState.UNKNOWN, np.uint8)
    for number in numbers:
        here = set_up(plan, split, number, threads)
        here.world.scene.place([])  # without the traffic
        x, y, z = here.T_world_sensor[:3, 3]
        at = np.rint(np.array([x, y]) / side).astype(int)
        below = measure_ground(here.world.ground, pose(at[0] * side, at[1] * side, z))
        seen = aimed_truth(here.world.scene, below, (here.spec.elevations[0], here.spec.elevations[-1])).state
        _keep(state, seen, at + np.rint(np.array(TRUTH_SPEC.origin) / side).astype(int) - np.rint(corner).astype(int))
    return Truth(spec, state)


def _keep(state: NDArray[np.uint8], seen: NDArray[np.uint8], at: NDArray[np.int_]) -> None:
    """Put what was seen in the cells from `at` on into the state, in place; occupied wins over free."""
    low, high = np.maximum(at, 0), np.minimum(at + seen.shape, state.shape)
    if (low >= high).any():
        return
    there = state[low[0] : high[0], low[1] : high[1]]
    new = seen[low[0] - at[0] : high[0] - at[0], low[1] - at[1] : high[1] - at[1]]
    there[(new == CellState.FREE) & (there == CellState.UNKNOWN)] = CellState.FREE
    there[new == CellState.OCCUPIED] = CellState.OCCUPIED
