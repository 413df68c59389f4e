"""How the simulator finds out what is true: rays from the sensor, and a look straight down at the ground.

Two ways to choose the rays. The *HD lidar* is the paper's (van Kempen et al. 2021, Sec. IV-B): thousands of
layers over the sensor's field of view. Far away its layers meet the ground further apart than cells are long,
and free space dissolves into rings. *Aimed* rays have no such rings: they go from the sensor to every cell's
ground and to points above it, and so ask of every cell whether it can be seen, and what is there. Both meet the
same occlusions, stay within the sensor's field of view and are judged alike, by `ogm.truth`.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.grid import GridSpec
from ogm.pose import check_pose
from ogm.simulation.aims import AIMS, Aim, Aims, aimed_directions
from ogm.simulation.below import Below, look_down
from ogm.simulation.materials import GROUND, Material
from ogm.simulation.scene import Hits, Scene
from ogm.truth import (
    CLEARANCE,
    MIN_RETURNS,
    OBSTACLE_HEIGHT,
    OBSTACLE_SEEN,
    PLANT_HEIGHT,
    TRUTH_SPEC,
    Kind,
    Truth,
    check_heights,
    finalize_truth,
    tally_rays,
)

__all__ = [
    "AIMS",
    "KINDS",
    "Aim",
    "Aims",
    "Below",
    "aimed_directions",
    "aimed_truth",
    "hd_truth",
    "look_down",
]

BATCH = 2**19  # rays per call: their hits stay small, however many rays there are


def _kinds() -> NDArray[np.uint8]:
    kinds = np.full(256, Kind.OTHER, np.uint8)
    kinds[[int(material) for material in Material]] = Kind.OBSTACLE
    kinds[[int(material) for material in GROUND]] = Kind.GROUND
    kinds[Material.KERB] = Kind.STEP
    kinds[Material.FOLIAGE] = Kind.PLANT
    kinds[Material.OWN_VEHICLE] = Kind.OTHER
    return kinds


KINDS = _kinds()  # (256,) uint8: `ogm.truth.Kind` of each material, OTHER for 255, no hit


def hd_truth(
    scene: Scene,
    below: Below,
    T_world_sensor: ArrayLike,
    directions: NDArray[np.float32],
    spec: GridSpec = TRUTH_SPEC,
    *,
    obstacle_height: float = OBSTACLE_HEIGHT,
    plant_height: float = PLANT_HEIGHT,
    clearance: float = CLEARANCE,
    boxes: ArrayLike | None = None,
    returns: ArrayLike | None = None,
    min_returns: int = MIN_RETURNS,
    own: ArrayLike | None = None,
    salt: int = 0,
) -> Truth:
    """Look around with an HD lidar.

    Cells without ground, beyond the end of the world, become `IGNORE`: nobody knows how high above ground what is
    hit in them would be. Only the box of a traffic participant makes them `OCCUPIED`.

    Parameters
    ----------
    scene : Scene
        All there is, with the frame's moving things in place.
    below : Below
        What `look_down` found from the same pose on the same cells.
    T_world_sensor : (4, 4) float
    directions : (..., 3) float32
        Of all rays, in the sensor's frame: `ogm.simulation.lidar.hd_directions`.
    spec : GridSpec
        Cells in the sensor's frame.
    obstacle_height, plant_height, clearance, boxes, returns, min_returns, own
        As in `ogm.truth.truth_grid`.
    salt : int
        Decides which rays pass through glass, as in `Scene.cast`.
    """
    check_heights(obstacle_height, plant_height, clearance)
    _check_below(below, spec)
    heights = (obstacle_height, plant_height, clearance)
    seen = np.zeros(spec.shape, np.uint8)
    room = Hits.allocate(BATCH)
    _look(seen, scene, below, T_world_sensor, directions.reshape(-1, 3), spec, heights, salt, 0, room)
    return finalize_truth(
        seen, spec, boxes=boxes, returns=returns, min_returns=min_returns, own=own, beyond=np.isnan(below.z)
    )


def aimed_truth(
    scene: Scene,
    below: Below,
    T_world_sensor: ArrayLike,
    elevations: tuple[float, float],
    spec: GridSpec = TRUTH_SPEC,
    *,
    aims: Aims = AIMS,
    obstacle_height: float = OBSTACLE_HEIGHT,
    plant_height: float = PLANT_HEIGHT,
    clearance: float = CLEARANCE,
    boxes: ArrayLike | None = None,
    returns: ArrayLike | None = None,
    min_returns: int = MIN_RETURNS,
    own: ArrayLike | None = None,
    salt: int = 0,
) -> Truth:
    """Look at every cell.

    What a ray hits counts for the cell that it was hit in, whichever the ray was aimed at. First all cells are
    looked at, then more closely those where that may have missed something: steps, and what borders on obstacles
    or on cells not seen. Cells without ground are treated as in `hd_truth`.

    Parameters
    ----------
    elevations : (float, float)
        Lowest and highest that the sensor sees [rad].
    aims : Aims
        Points of each cell to look at.

    Others as in `hd_truth`.
    """
    check_heights(obstacle_height, plant_height, clearance)
    _check_below(below, spec)
    heights = (obstacle_height, plant_height, clearance)
    seen = np.zeros(spec.shape, np.uint8)
    room = Hits.allocate(BATCH)
    if not -np.pi / 2 <= elevations[0] < elevations[1] <= np.pi / 2:
        raise ValueError(f"elevations must be the lowest and the highest [rad], got {elevations}")
    number = 0

    def look(z: NDArray[np.float32], aim: Aim, chosen: NDArray[np.bool_]) -> None:
        nonlocal number
        directions = aimed_directions(z, spec, aim, elevations, chosen)
        _look(seen, scene, below, T_world_sensor, directions, spec, heights, salt, number, room)
        number += len(directions)

    for aim in aims.every:
        look(below.z, aim, np.ones(spec.shape, np.bool_))
    colour = np.add.outer(np.arange(spec.shape[0]), np.arange(spec.shape[1])) % 2
    for n, aim in enumerate(aims.alternate):
        look(below.z, aim, colour == n % 2)
    steps = (below.rise >= obstacle_height) & (seen < OBSTACLE_SEEN)
    for aim in aims.step:
        look((below.ground + below.rise / 2).astype(np.float32), aim, steps)
    beside = _touching(seen >= OBSTACLE_SEEN) & (seen < OBSTACLE_SEEN)
    for aim in aims.beside:
        look(below.z, aim, beside)
    edge = _touching(seen != 0) & (seen == 0)
    for aim in aims.edge:
        look(below.z, aim, edge)
    return finalize_truth(
        seen, spec, boxes=boxes, returns=returns, min_returns=min_returns, own=own, beyond=np.isnan(below.z)
    )


def _check_below(below: Below, spec: GridSpec) -> None:
    if below.z.shape != spec.shape:
        raise ValueError(f"below was looked at on {below.z.shape} cells, but spec has {spec.shape}")


def _touching(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the cells that touch one of these, with a side or a corner, and these."""
    rows = cells.copy()
    rows[1:] |= cells[:-1]
    rows[:-1] |= cells[1:]
    result = rows.copy()
    result[:, 1:] |= rows[:, :-1]
    result[:, :-1] |= rows[:, 1:]
    return result


def _look(
    seen: NDArray[np.uint8],
    scene: Scene,
    below: Below,
    T_world_sensor: ArrayLike,
    directions: NDArray[np.float32],
    spec: GridSpec,
    heights: tuple[float, float, float],
    salt: int,
    number: int,
    room: Hits,
) -> None:
    """Cast rays, batch by batch, and add what they hit to the tally."""
    T = check_pose(T_world_sensor, "T_world_sensor")
    for start in range(0, len(directions), BATCH):
        part = directions[start : start + BATCH]
        n = len(part)
        out = Hits(room.distance[:n], room.material[:n], room.object[:n], room.cosine[:n])
        hits = scene.cast(T, part, salt=salt, number=number + start, out=out)
        tally_rays(seen, hits.distance, part, hits.material, KINDS, below.ground, below.rise, spec, *heights)
