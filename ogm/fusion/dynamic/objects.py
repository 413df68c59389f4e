"""Objects of a dynamic grid: groups of moving cells, as boxes with a velocity."""

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.dynamic_grid import DynamicGrid
from ogm.fusion.dynamic.object_kernels import join_cells, moving_cells
from ogm.scan import Boxes

_ANGLES = np.radians(np.arange(0, 90, 5))  # candidates for the yaw of a box without a heading


class ObjectSettings(NamedTuple):
    """Criteria for moving cells, and for cells of the same object.

    Attributes
    ----------
    min_dynamic : float
        Least mass of dynamic in a moving cell, [0, 1].
    min_share : float
        Least share of dynamic in its occupied mass, [0, 1].
    min_speed : float
        Least speed of a moving cell, and of an object [m/s].
    reach : float
        Greatest distance of the centres of neighbouring cells along x and along y [m]; at least one cell.
    max_difference, relative_difference : float
        Neighbours belong to one object if their velocities differ by at most the first [m/s] plus the second times the
        greater of their speeds.
    min_cells : int
        Least number of cells of an object.
    correlated_cells : float
        Number of cells whose velocities count as one measurement, at least 1.
    min_deviation, max_deviation : float
        Least and greatest standard deviation of an object's velocity [m/s], the root mean square over directions. A
        group of cells with a less certain velocity is not an object.
    heading_speed : float
        Speed from which a box is aligned with the velocity [m/s]; slower boxes have the least area.
    height : float
        Nominal height of every box [m], since a grid has none; boxes stand on z = 0.
    """

    min_dynamic: float = 0.2
    min_share: float = 0.5
    min_speed: float = 0.5
    reach: float = 0.8
    max_difference: float = 1.5
    relative_difference: float = 0.3
    min_cells: int = 4
    correlated_cells: float = 10.0
    min_deviation: float = 0.3
    max_deviation: float = 0.8
    heading_speed: float = 1.0
    height: float = 1.5


@dataclass(frozen=True, eq=False)
class Objects:
    """Moving objects, and the cells of a grid that belong to each.

    Parameters
    ----------
    boxes : Boxes
        Boxes around the cells, in the grid's frame, with `velocity` over ground [m/s]. The length is along the
        velocity, the height nominal. `track` is the number of an object once a tracker has confirmed it.
    covariance : (B, 2, 2) float64
        Covariance of the velocities [m²/s²].
    turn_rate : (B,) float64
        Turn rates of the velocities' directions, counter-clockwise [rad/s]; 0 if unknown.
    mass : (B,) float64
        Sum of the dynamic masses of the cells: the expected number of dynamic cells.
    label : (nx, ny) int32
        k + 1 in the cells of object k, 0 in all other cells.

    Raises
    ------
    ValueError
        If shapes disagree, or the boxes have no velocity.
    """

    boxes: Boxes
    covariance: NDArray[np.float64]
    turn_rate: NDArray[np.float64]
    mass: NDArray[np.float64]
    label: NDArray[np.int32]

    def __post_init__(self) -> None:
        if self.boxes.velocity is None:
            raise ValueError("boxes of Objects need a velocity, got None; give (B, 2) [m/s]")
        count = len(self.boxes)
        for name, shape in {"covariance": (count, 2, 2), "turn_rate": (count,), "mass": (count,)}.items():
            array = np.asarray(getattr(self, name), np.float64)
            if array.shape != shape:
                raise ValueError(f"{name} must have shape {shape} for {count} boxes, got {array.shape}")
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.boxes)

    def __repr__(self) -> str:
        return f"Objects({len(self)}, {sum(map(bool, self.boxes.track))} with a track number)"

    @property
    def velocity(self) -> NDArray[np.float64]:
        """Velocities of the boxes, (B, 2) [m/s]."""
        assert self.boxes.velocity is not None
        return self.boxes.velocity

    @property
    def confirmed(self) -> "Objects":
        """The objects with a track number."""
        return self.select([bool(name) for name in self.boxes.track])

    def select(self, keep: ArrayLike) -> "Objects":
        """Return a selection of the objects; cells of other objects become 0 in `label`.

        Parameters
        ----------
        keep : (B,) bool or (K,) int
        """
        at = np.arange(len(self))[np.asarray(keep)] if len(self) else np.empty(0, int)
        numbers = np.zeros(len(self) + 1, np.int32)
        numbers[at + 1] = np.arange(1, len(at) + 1)
        return replace(
            self,
            boxes=self.boxes.select(at),
            covariance=self.covariance[at],
            turn_rate=self.turn_rate[at],
            mass=self.mass[at],
            label=numbers[self.label],
        )


def find_objects(grid: DynamicGrid, settings: ObjectSettings | None = None) -> Objects:
    """Return the groups of moving cells of a grid as objects.

    Moving cells are joined to one object if they are neighbours and their velocities agree. The velocity of an object
    is the mean over its cells, weighted by dynamic mass. Objects are in the order of their first cells.

    Parameters
    ----------
    grid : DynamicGrid
    settings : ObjectSettings, optional

    Returns
    -------
    Objects
        Objects without turn rates and track numbers, which an `ObjectTracker` adds.
    """
    chosen = ObjectSettings() if settings is None else settings
    mass, velocity = np.ascontiguousarray(grid.mass), np.ascontiguousarray(grid.velocity)
    cells = moving_cells(mass, velocity, chosen.min_dynamic, chosen.min_share, chosen.min_speed)
    label = np.zeros(grid.spec.shape, np.int32)
    reach = max(int(chosen.reach / grid.spec.resolution + 1e-6), 1)
    group = join_cells(cells, velocity, label, reach, (chosen.max_difference, chosen.relative_difference))
    weight = grid.dynamic[cells[:, 0], cells[:, 1]].astype(np.float64)
    v = velocity[cells[:, 0], cells[:, 1]].astype(np.float64)
    count = int(group.max(initial=-1)) + 1
    total = np.bincount(group, weight, count)
    mean = np.stack([np.bincount(group, weight * v[:, k], count) / total for k in (0, 1)], axis=-1)
    away = v - mean[group]
    covariance = _covariance_of_mean(grid.covariance[cells[:, 0], cells[:, 1]], away, weight, group, chosen)
    enough = np.bincount(group, minlength=count) >= chosen.min_cells
    enough &= np.hypot(*mean.T) >= chosen.min_speed
    enough &= np.trace(covariance, axis1=1, axis2=2) <= 2 * chosen.max_deviation**2

    number = np.cumsum(enough) * enough  # of the kept groups, from 1; 0 for other groups
    label[cells[:, 0], cells[:, 1]] = number[group]
    kept = enough[group]
    xy = (cells[kept] + 0.5) * grid.spec.resolution + grid.spec.origin
    boxes = _boxes(xy, number[group[kept]] - 1, mean[enough], grid.spec.resolution, chosen)
    return Objects(boxes, covariance[enough], np.zeros(len(boxes)), np.asarray(total[enough], np.float64), label)


def _covariance_of_mean(
    cells: NDArray[Any], away: NDArray[Any], weight: NDArray[Any], group: NDArray[Any], settings: ObjectSettings
) -> NDArray[np.float64]:
    """Return the covariance of each object's mean velocity, (B, 2, 2) [m²/s²].

    The covariance of one cell is the mean of the cells' own covariances plus the covariance between the cells. For the
    mean of n cells it is divided by the number of independent cells among them.
    """
    spread = np.nan_to_num(cells.astype(np.float64)) + away[:, :, None] * away[:, None, :]
    count = int(group.max(initial=-1)) + 1
    total = np.bincount(group, weight, count)
    parts = [np.bincount(group, weight * spread[:, i, j], count) / total for i in (0, 1) for j in (0, 1)]
    independent = np.maximum(np.bincount(group, minlength=count) / settings.correlated_cells, 1)
    mean = np.stack(parts, axis=-1).reshape(-1, 2, 2) / independent[:, None, None]
    return mean + settings.min_deviation**2 * np.eye(2)


def _boxes(
    xy: NDArray[Any], group: NDArray[Any], velocity: NDArray[Any], resolution: float, settings: ObjectSettings
) -> Boxes:
    """Return the boxes around cells at `xy` (K, 2) that belong to the objects `group` (K,)."""
    count = len(velocity)
    if not count:
        return Boxes(np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty((0, 2)))
    order = np.argsort(group, kind="stable")
    xy, group = xy[order], group[order]
    first = np.searchsorted(group, np.arange(count))
    heading = np.arctan2(velocity[:, 1], velocity[:, 0])
    slow = np.hypot(*velocity.T) < settings.heading_speed
    if slow.any():
        areas = np.stack([np.prod(_extent(xy, group, first, heading + a, resolution)[1], axis=-1) for a in _ANGLES])
        heading = np.where(slow, heading + _ANGLES[np.argmin(areas, axis=0)], heading)
    center, size = _extent(xy, group, first, heading, resolution)
    turned = slow & (size[:, 1] > size[:, 0])  # so that the length is the longer side
    size = np.where(turned[:, None], size[:, ::-1], size)
    yaw = np.where(turned, heading - np.pi / 2, heading)
    height = np.full(count, float(settings.height))
    return Boxes(np.column_stack([center, height / 2]), np.column_stack([size, height]), yaw, velocity)


def _extent(
    xy: NDArray[Any], group: NDArray[Any], first: NDArray[Any], yaw: NDArray[Any], resolution: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the centres and sizes (B, 2) [m] of the boxes at given yaws; `xy` is sorted by group."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    c, s = cosine[group], sine[group]
    along = np.stack([c * xy[:, 0] + s * xy[:, 1], c * xy[:, 1] - s * xy[:, 0]], axis=-1)
    low, high = np.minimum.reduceat(along, first), np.maximum.reduceat(along, first)
    middle = (low + high) / 2
    center = np.stack([cosine * middle[:, 0] - sine * middle[:, 1], sine * middle[:, 0] + cosine * middle[:, 1]], -1)
    return center, high - low + resolution
