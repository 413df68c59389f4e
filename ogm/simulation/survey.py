"""Observation of the truth by rays from the sensor and vertical rays to the ground.

There are two sets of rays. The *HD lidar* follows the paper (van Kempen et al. 2021, Sec. IV-B): thousands of layers
over the sensor's field of view. At long range its layers hit the ground more than a cell apart, and free space breaks
up into rings. *Aimed* rays avoid such rings: they point from the sensor to every cell's ground and to points above it.
Both have the same occlusions, stay within the sensor's field of view, and follow the rules of `ogm.truth`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import binary_dilation

from ogm.jit import kernel
from ogm.scan import Boxes
from ogm.simulation.cells import AIMS, Aim, Below, aimed_directions, steep_cells
from ogm.simulation.kernels import View, in_view, lose_sight
from ogm.simulation.materials import GROUND, Material
from ogm.simulation.mesh import Bytes, Floats32, Mask
from ogm.simulation.scene import Scene
from ogm.state import Truth
from ogm.truth import HEIGHT_LIMITS, Kind
from ogm.truth.observe import OBSTACLE_SEEN, HeightLimits
from ogm.truth.points import finalize_truth
from ogm.truth.rays import observe_rays

BATCH = 2**19  # rays per call, which limits the memory of their hits

KINDS = np.full(256, Kind.OTHER, np.uint8)  # `ogm.truth.Kind` of each material; OTHER for 255, no hit
KINDS[[*Material]] = Kind.OBSTACLE
KINDS[[*GROUND]] = Kind.GROUND
KINDS[[Material.KERB, Material.FOLIAGE, Material.EGO_VEHICLE]] = Kind.STEP, Kind.PLANT, Kind.OTHER


class Known(NamedTuple):
    """Additional knowledge about a frame, in the sensor's frame.

    Attributes
    ----------
    boxes, returns
        Traffic participants and the scan's points on each, see `ogm.truth.points.finalize_truth`.
    ego : (nx, ny) bool
        Cells under the ego vehicle, set to `IGNORE`.
    """

    boxes: Boxes | None = None
    returns: ArrayLike | None = None
    ego: Mask | None = None


_NOTHING = Known()


class Limits(NamedTuple):
    """Limits of the truth: visibility of the scan, and the slope that can be driven on.

    Attributes
    ----------
    view : View, optional
        Visibility of the scan. Cells outside it stay unknown.
    steepest : float
        Largest slope (height over run) of ground that is not an obstacle. The height of such an obstacle is its rise
        over three cells.
    heights : HeightLimits
    """

    view: View | None = None
    steepest: float = np.inf
    heights: HeightLimits = HEIGHT_LIMITS


UNLIMITED = Limits()


def hd_truth(
    scene: Scene,
    below: Below,
    directions: Floats32,
    known: Known = _NOTHING,
    *,
    salt: int = 0,
    limits: Limits = UNLIMITED,
) -> Truth:
    """Observe the truth with an HD lidar.

    Cells without ground, beyond the end of the world, become `IGNORE`, because heights above ground are unknown there.
    Only the box of a traffic participant makes them `OCCUPIED`.

    Parameters
    ----------
    scene : Scene
        The whole world, with the frame's moving objects placed.
    below : Below
        Ground heights from `measure_ground`, with the cells and the sensor's pose.
    directions : (..., 3) float32
        Directions of all rays in the sensor's frame, see `ogm.simulation.sensors.hd_directions`.
    known : Known
    salt : int
        Seed of the selection of rays that pass through glass, see `Scene.cast`.
    limits : Limits
    """
    observer = _Observer(scene, below, salt, limits)
    observer.cast(directions.reshape(-1, 3))
    return observer.truth(known)


def aimed_truth(
    scene: Scene,
    below: Below,
    elevations: tuple[float, float],
    known: Known = _NOTHING,
    *,
    salt: int = 0,
    limits: Limits = UNLIMITED,
) -> Truth:
    """Observe the truth with rays aimed at every cell.

    A hit counts for the cell that contains it, not for the target of its ray. The first rays go to all cells. Further
    rays go to cells with possible gaps: steps, and neighbours of obstacles or of unobserved cells. Cells without ground
    are treated as in `hd_truth`.

    Parameters
    ----------
    elevations : (float, float)
        Lowest and highest elevation of the sensor's field of view [rad].

    For the other parameters see `hd_truth`.
    """
    if not -np.pi / 2 <= elevations[0] < elevations[1] <= np.pi / 2:
        raise ValueError(f"elevations must ascend within -pi/2 ... pi/2 rad, got {elevations}")
    observer = _Observer(scene, below, salt, limits)
    seen, spec = observer.seen, below.spec

    def cast(aim: Aim, chosen: Mask, z: Floats32 = below.z) -> None:
        observer.cast(aimed_directions(z, spec, aim, elevations, chosen))

    for aim in AIMS["every"]:
        cast(aim, np.ones(spec.shape, np.bool_))
    colour = np.add.outer(np.arange(spec.shape[0]), np.arange(spec.shape[1])) % 2
    for n, aim in enumerate(AIMS["alternate"]):
        cast(aim, colour == n % 2)
    steps = (below.rise >= HEIGHT_LIMITS.obstacle) & (seen < OBSTACLE_SEEN)
    for aim in AIMS["step"]:
        cast(aim, steps, (below.ground + below.rise / 2).astype(np.float32))
    beside = _with_neighbours(seen >= OBSTACLE_SEEN) & (seen < OBSTACLE_SEEN)
    for aim in AIMS["beside"]:
        cast(aim, beside)
    edge = _with_neighbours(seen != 0) & (seen == 0)
    for aim in AIMS["edge"]:
        cast(aim, edge)
    return observer.truth(known)


def _with_neighbours(cells: Mask) -> Mask:
    """Return the cells and their eight neighbours."""
    return np.asarray(binary_dilation(cells, np.ones((3, 3))))


class _Observer:
    """Cast rays from one pose and collect the observations of each cell."""

    def __init__(self, scene: Scene, below: Below, salt: int, limits: Limits) -> None:
        self.scene, self.below, self.salt, self.view, self.heights = scene, below, salt, limits.view, limits.heights
        self._rise, self._steep = below.rise, None
        if limits.steepest < np.inf:
            self._steep, climb = steep_cells(below, limits.steepest)
            self._rise = np.where(self._steep, np.maximum(climb, below.rise), below.rise)
        self.seen = np.zeros(below.spec.shape, np.uint8)
        self.highest = np.zeros(below.spec.shape, np.float32)  # [m] of the obstacle hits in each cell
        self._number = 0  # number of rays cast

    def cast(self, directions: Floats32) -> None:
        """Cast rays (N, 3) in batches."""
        _, ground, _, spec, T = self.below
        if self.view is not None:
            directions = directions[in_view(directions, self.view)]
        for start in range(0, len(directions), BATCH):
            part = directions[start : start + BATCH]
            hits = self.scene.cast(T, part, salt=self.salt, number=self._number + start)
            kinds = KINDS[hits.material]
            if self.view is not None:
                lose_sight(hits.distance, part, kinds == Kind.GROUND, self.view)
            if self._steep is not None:
                _steep_is_step(kinds, hits.distance, part, self._steep, (spec.resolution, *spec.origin))
            observe_rays(self.seen, self.highest, hits.distance, part, kinds, ground, self._rise, spec, self.heights)
        self._number += len(directions)

    def truth(self, known: Known) -> Truth:
        """Return the truth of the cells."""
        boxes, returns, ego = known
        beyond, spec = np.isnan(self.below.z), self.below.spec
        return finalize_truth(
            self.seen, spec, boxes=boxes, returns=returns, unobserved=ego, beyond=beyond, highest=self.highest
        )


@kernel
def _steep_is_step(
    kinds: Bytes, distance: Floats32, directions: Floats32, steep: Mask, grid: tuple[float, float, float]
) -> None:
    """Change hits of ground (N,) in steep cells to hits of a step, in place."""
    resolution, x0, y0 = grid
    for i in range(len(kinds)):
        d = np.float64(distance[i])
        if kinds[i] != 0 or not d < 1e6:  # Kind.GROUND
            continue
        u = (d * directions[i, 0] - x0) / resolution
        v = (d * directions[i, 1] - y0) / resolution
        if u >= 0 and v >= 0 and u < steep.shape[0] and v < steep.shape[1] and steep[int(u), int(v)]:
            kinds[i] = 3  # Kind.STEP
