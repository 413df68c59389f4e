"""Scans of hand-built shapes with the true states of the cells: the base of `ogm.simulation.hand_built_scenes`.

A VLP-32C 1.9 m above a road scans the shapes with a range noise of 2 cm. Every beam that hits a shape within 100 m
returns, unless the scene defines otherwise; the others are `Scan.no_returns`. Regions of cells follow from the shapes
and from the shape that each noise-free beam hits, without a sensor model.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ogm.grid import GridSpec
from ogm.scan import Mount, Scan
from ogm.simulation.mesh import Floats, Floats32, Ints32, Mask, Mesh, empty
from ogm.simulation.scene import Scene
from ogm.simulation.sensors import LIDARS
from ogm.state import CellState, Truth

SPEC = GridSpec.centered()  # 512 x 352 cells of 0.16 m
MOUNT = Mount(1.9)  # of the lidar of every scene
RANGE_NOISE, RANGE_MAX = 0.02, 100.0  # [m]
NEAR = 20.0  # [m] reach of "ground" and "occupied": farther cells hold too few returns


@dataclass(frozen=True, eq=False)
class HandBuiltScene:
    """A scan of a scene, the true state of its cells, and the cells to test.

    Parameters
    ----------
    name : str
    scan : Scan
        In the vehicle frame, with its mount; the road under the sensor is at z = -1.9 m.
    truth : Truth
        State of every cell of `SPEC`, hidden ones too; the ego footprint is `IGNORE`.
    regions : mapping of str to (nx, ny) bool
        Cells by name, none of them empty. One region per shape that returns beams: the cells that hold its returns;
        "ground" holds its free cells within `NEAR`. "occupied": truly occupied cells within `NEAR` that hold returns
        of anything but ground. The builders of a scene add others.
    part : (N,) int32
        Index of the shape in `parts` that each point lies on; -1 for a ghost return.
    parts : tuple of str
        Names of the shapes.
    """

    name: str
    scan: Scan
    truth: Truth
    regions: Mapping[str, Mask]
    part: Ints32
    parts: tuple[str, ...]

    def points_on(self, part: str) -> Floats32:
        """Return the points on one shape, (N, 3), heights above the road [m]."""
        points: Floats32 = self.scan.points[self.part == self.parts.index(part), :3]
        return points + np.array([0, 0, MOUNT.sensor_height], np.float32)

    def with_regions(self, **regions: Mask) -> "HandBuiltScene":
        """Return the scene with more regions; empty ones are left out."""
        return replace(self, regions={**self.regions, **{name: mask for name, mask in regions.items() if mask.any()}})


def middle(distance: float) -> float:
    """Return the middle of the cell that holds a coordinate [m]: noise then moves no return to another cell."""
    return (math.floor(distance / SPEC.resolution + 1e-9) + 0.5) * SPEC.resolution


def rectangle(x0: float, x1: float, y0: float, y1: float, *, whole: bool = False) -> Mask:
    """Return the cells that a rectangle [m] touches, or the cells that lie in it as a whole; (nx, ny)."""
    (x, y), grow = SPEC.cell_centers, (0.5 - 1e-6) * SPEC.resolution * (-1 if whole else 1)
    return (x > x0 - grow) & (x < x1 + grow) & (y > y0 - grow) & (y < y1 + grow)


def within(distance: float) -> Mask:
    """Return the cells with their middle within a distance of the sensor [m]."""
    return np.asarray(np.hypot(*SPEC.cell_centers) < distance)


def cells_of(xyz: NDArray[np.floating]) -> Mask:
    """Return the cells that hold points, (nx, ny)."""
    mask = np.zeros(SPEC.shape, bool)
    inside = SPEC.contains(xyz[:, 0], xyz[:, 1])
    mask[SPEC.index(xyz[inside, 0], xyz[inside, 1])] = True
    return mask


def scan_shapes(
    rng: np.random.Generator,
    parts: Mapping[str, Mesh],
    occupied: Mask | None = None,
    *,
    swallowed: str = "",
    glass: tuple[str, float] = ("", 0.0),
    ghosts: tuple[Mesh, int] | None = None,
    lidar: str = "vlp-32c",
) -> HandBuiltScene:
    """Return the scan of shapes with its regions.

    Parameters
    ----------
    rng : numpy.random.Generator
    parts : mapping of str to Mesh
        Shapes by name, one of them "ground", with heights above the road under the sensor [m].
    occupied : (nx, ny) bool, optional
        Cells that are truly occupied; all others are free.
    swallowed : str
        Name of the shape from which no beams return.
    glass : (str, float)
        Name of the shape that lets beams through, and their share.
    ghosts : (Mesh, int), optional
        A shape below the road, and the number of beams towards it that return from there instead of from the road.
    lidar : str
        A key of `LIDARS`.
    """
    names, meshes = tuple(parts), list(parts.values())
    directions = LIDARS[lidar].directions().reshape(-1, 3)
    distance, part = _cast(meshes, directions)
    if glass[0]:
        passes = (part == names.index(glass[0])) & (rng.random(len(part)) < glass[1])
        others = [k for k, name in enumerate(names) if name != glass[0]]
        distance[passes], behind = _cast([meshes[k] for k in others], directions[passes])
        part[passes] = np.where(behind < 0, -1, np.array(others)[behind])
    if ghosts is not None:
        below, image = _cast([ghosts[0]], directions)
        beams = rng.choice(np.flatnonzero((image == 0) & (part == names.index("ground"))), ghosts[1], replace=False)
        distance[beams], part[beams] = below[beams], -1
    if swallowed:
        distance[part == names.index(swallowed)] = np.inf

    returned = np.isfinite(distance)
    part = part[returned]
    reach = distance[returned] + rng.normal(0, RANGE_NOISE, len(part))
    points = (directions[returned] * reach[:, None]).astype(np.float32)
    occupied = np.zeros(SPEC.shape, bool) if occupied is None else occupied
    state = np.where(occupied, CellState.OCCUPIED, CellState.FREE).astype(np.uint8)
    state[rectangle(*MOUNT.ego_footprint)] = CellState.IGNORE
    regions = {name: cells_of(points[part == k]) for k, name in enumerate(names)}
    regions["ground"] &= (state == CellState.FREE) & within(NEAR)
    regions["occupied"] = cells_of(points[(part >= 0) & (part != names.index("ground"))]) & occupied & within(NEAR)
    scan = Scan(points, no_returns=directions[~returned], sensor=lidar, mount=MOUNT)
    return HandBuiltScene("", scan, Truth(SPEC, state), {}, part, names).with_regions(**regions)


def _cast(meshes: list[Mesh], directions: Floats32) -> tuple[Floats, Ints32]:
    """Return the range [m] at which each beam hits a mesh, inf without a hit, and the index of the mesh or -1."""
    scene = Scene(empty(), threads=1)
    scene.place(meshes)
    hits = scene.cast((0.0, 0.0, MOUNT.sensor_height), directions)
    near = hits.distance <= RANGE_MAX
    return np.where(near, hits.distance.astype(np.float64), np.inf), np.where(near, hits.object, -1)
