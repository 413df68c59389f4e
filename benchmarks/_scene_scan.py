"""Scans of hand-built shapes, and the cells to test: what `_scenes` builds its scenes with.

A VLP-32C 1.9 m above a road casts its beams at shapes, with a range noise of 2 cm. Every beam that hits something
within 100 m returns, unless the scene defines otherwise; the others are `Scan.no_returns`. The regions are found from
the shapes, and from which of them each noise-free beam hits: no sensor model is needed.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import open3d
from numpy.typing import NDArray

from ogm import GridSpec, Mount, Scan
from ogm.simulation.mesh import Mesh
from ogm.simulation.sensors import LIDARS
from ogm.state import CellState, Truth

SPEC = GridSpec.centered()  # 512 x 352 cells of 0.16 m
MOUNT = Mount(1.9)
RANGE_NOISE, RANGE_MAX = 0.02, 100.0  # [m]
NEAR = 20.0  # [m] how far "ground" and "occupied" reach: further out, few cells hold enough returns
DEEP = 0.3  # [m] returns further below the continued road show that the road ends
HIGH = 0.1  # [m] returns further above the road show an obstacle, as in `RayISM`

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Scene:
    """A scan of a scene, the true state of its cells, and the cells to test.

    Parameters
    ----------
    name : str
    scan : Scan
        In the vehicle frame; the road under the sensor is at z = -1.9 m.
    mount : Mount
    truth : Truth
        State of every cell of `SPEC`, hidden ones too; the ego footprint is `IGNORE`.
    regions : mapping of str to (nx, ny) bool
        Cells by name, none of them empty. One for each shape that returns beams: the cells that hold its returns;
        "ground" holds its free cells within `NEAR`. "occupied": truly occupied cells within `NEAR` that hold returns
        of anything but ground. The builders of `_scenes` add others.
    part : (N,) int
        The shape that each point lies on, as index of `parts`; -1 for a ghost return.
    parts : tuple of str
        Names of the shapes.
    """

    name: str
    scan: Scan
    mount: Mount
    truth: Truth
    regions: Mapping[str, Mask]
    part: NDArray[np.int64]
    parts: tuple[str, ...]

    def points_on(self, part: str) -> NDArray[np.float32]:
        """Return the points on one shape, (N, 3), heights above the road [m]."""
        return self.scan.points[self.part == self.parts.index(part), :3] + np.float32([0, 0, MOUNT.sensor_height])

    def with_regions(self, **regions: Mask) -> "Scene":
        """Return the scene with more regions; empty ones are left out."""
        return replace(self, regions={**self.regions, **{name: mask for name, mask in regions.items() if mask.any()}})


def middle(distance: float) -> float:
    """Return the middle of the cell that holds a coordinate [m]: noise then moves no return to another cell."""
    return (math.floor(distance / SPEC.resolution + 1e-9) + 0.5) * SPEC.resolution


def rectangle(x0: float, x1: float, y0: float, y1: float, *, whole: bool = False) -> Mask:
    """Return the cells that a rectangle [m] touches, or those that lie in it as a whole; (nx, ny)."""
    (x, y), grow = SPEC.cell_centers, (0.5 - 1e-6) * SPEC.resolution * (-1 if whole else 1)
    return (x > x0 - grow) & (x < x1 + grow) & (y > y0 - grow) & (y < y1 + grow)


def within(distance: float) -> Mask:
    """Return the cells whose middles lie within a distance of the sensor [m]."""
    return np.hypot(*SPEC.cell_centers) < distance


def cells_of(xyz: NDArray) -> Mask:
    """Return the cells that hold points, (nx, ny)."""
    mask = np.zeros(SPEC.shape, bool)
    inside = SPEC.contains(xyz[:, 0], xyz[:, 1])
    mask[SPEC.index(xyz[inside, 0], xyz[inside, 1])] = True
    return mask


def cast(meshes: list[Mesh], directions: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the range [m] at which each beam hits, inf for none, and which mesh, -1 for none."""
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    for mesh in meshes:
        scene.add_triangles(np.ascontiguousarray(mesh.vertices), np.ascontiguousarray(mesh.triangles))
    rays = np.zeros((len(directions), 6), np.float32)
    rays[:, 2], rays[:, 3:] = MOUNT.sensor_height, directions
    hits = scene.cast_rays(rays, nthreads=1)
    distance = hits["t_hit"].numpy().astype(np.float64)
    near = distance <= RANGE_MAX
    return np.where(near, distance, np.inf), np.where(near, hits["geometry_ids"].numpy().astype(np.int64), -1)


def scan_shapes(
    rng: np.random.Generator,
    parts: Mapping[str, Mesh],
    occupied: Mask | None = None,
    *,
    swallowed: str = "",
    glass: tuple[str, float] = ("", 0.0),
    ghosts: tuple[Mesh, int] | None = None,
    lidar: str = "vlp-32c",
) -> Scene:
    """Scan shapes, and find the regions.

    Parameters
    ----------
    rng : numpy.random.Generator
    parts : mapping of str to Mesh
        Shapes by name, one of them "ground", with heights above the road under the sensor [m].
    occupied : (nx, ny) bool, optional
        Cells that are truly occupied; all others are free.
    swallowed : str
        The shape whose beams do not return.
    glass : (str, float)
        The shape that lets this share of its beams through.
    ghosts : (Mesh, int), optional
        A shape below the road, and how many of the beams towards it return from there instead of from the road.
    lidar : str
        A key of `LIDARS`.
    """
    names, meshes = tuple(parts), list(parts.values())
    directions = LIDARS[lidar].directions().reshape(-1, 3)
    distance, part = cast(meshes, directions)
    if glass[0]:
        passes = (part == names.index(glass[0])) & (rng.random(len(part)) < glass[1])
        others = [k for k, name in enumerate(names) if name != glass[0]]
        distance[passes], behind = cast([meshes[k] for k in others], directions[passes])
        part[passes] = np.where(behind < 0, -1, np.array(others)[behind])
    if ghosts is not None:
        below, which = cast([ghosts[0]], directions)
        beams = rng.choice(np.flatnonzero((which == 0) & (part == names.index("ground"))), ghosts[1], replace=False)
        distance[beams], part[beams] = below[beams], -1
    if swallowed:
        distance[part == names.index(swallowed)] = np.inf

    back = np.isfinite(distance)
    part = part[back]
    reach = distance[back] + rng.normal(0, RANGE_NOISE, len(part))
    points = (directions[back] * reach[:, None]).astype(np.float32)
    occupied = np.zeros(SPEC.shape, bool) if occupied is None else occupied
    state = np.where(occupied, CellState.OCCUPIED, CellState.FREE).astype(np.uint8)
    state[rectangle(*MOUNT.ego_footprint)] = CellState.IGNORE
    regions = {name: cells_of(points[part == k]) for k, name in enumerate(names)}
    regions["ground"] &= (state == CellState.FREE) & within(NEAR)
    regions["occupied"] = cells_of(points[(part >= 0) & (part != names.index("ground"))]) & occupied & within(NEAR)
    scan = Scan(points, no_returns=directions[~back], sensor=lidar)
    return Scene("", scan, MOUNT, Truth(SPEC, state), {}, part, names).with_regions(**regions)
