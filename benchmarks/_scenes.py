"""Hand-built scenes that show what a geometric inverse sensor model must not predict free, and what it must.

Each is a few shapes on a road, scanned by a VLP-32C 1.9 m above it with a range noise of 2 cm. Every beam that hits
something within 100 m returns, unless the scene says otherwise; the others are `Scan.no_returns`. Nothing here
knows of `RayISM`: the regions to test are found from the shapes, and from which of them each noise-free beam hits.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import open3d
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from ogm import GridSpec, Mount, Scan
from ogm.simulation.mesh import Mesh, box, cylinder, ellipsoid, merge, quads, sheet
from ogm.simulation.sensors import LIDARS
from ogm.state import CellState, Truth

SPEC = GridSpec.centered()  # 512 x 352 cells of 0.16 m
MOUNT = Mount(1.9)
RANGE_NOISE, RANGE_MAX = 0.02, 100.0  # [m]
FAR = 120.0  # [m] half the side of the road's plane
CLEARANCE = 2.0  # [m] what hangs lower is an obstacle, as in `RayISM`
DEEP = 0.3  # [m] returns further below the continued road show that the road ends
CAR = (4.5, 1.8, 1.5)  # length, width, height [m]

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
        State of every cell, hidden ones too; the ego footprint is `IGNORE`.
    regions : mapping of str to (nx, ny) bool
        Cells of `SPEC` by name. One for each shape: the cells that hold its returns (of "ground": and are free).
        "occupied": cells that hold returns and are occupied. Others are named where the scene is built.
    part : (N,) int
        The shape that each point lies on, as index of `parts`; -1 for a ghost.
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


def middle(distance: float) -> float:
    """Return the middle of the cell that holds a coordinate [m]: noise then moves no return to another cell."""
    return (math.floor(distance / SPEC.resolution + 1e-9) + 0.5) * SPEC.resolution


def rectangle(x0: float, x1: float, y0: float, y1: float, *, whole: bool = False) -> Mask:
    """Return the cells that a rectangle [m] touches, or those that lie in it as a whole; (nx, ny)."""
    (x, y), grow = SPEC.cell_centers, (0.5 - 1e-6) * SPEC.resolution * (-1 if whole else 1)
    return (x > x0 - grow) & (x < x1 + grow) & (y > y0 - grow) & (y < y1 + grow)


def cells_of(xyz: NDArray) -> Mask:
    """Return the cells that hold points, (nx, ny)."""
    mask = np.zeros(SPEC.shape, bool)
    inside = SPEC.contains(xyz[:, 0], xyz[:, 1])
    mask[SPEC.index(xyz[inside, 0], xyz[inside, 1])] = True
    return mask


def plate(x0: float, x1: float, y0: float, y1: float, z: float = 0.0) -> Mesh:
    """Make a level rectangle; heights are above the road under the sensor [m]."""
    return quads([[(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)]], 0)


def profile(line: list[tuple[float, float]], *, across: bool = False) -> Mesh:
    """Span a surface whose height follows a line (x, z), or (y, z) if `across`, and is level the other way [m]."""
    one, two = (np.array([(a, side * FAR, z) for a, z in line]) for side in (-1, 1))
    return sheet(one[:, [1, 0, 2]], two[:, [1, 0, 2]], 0) if across else sheet(one, two, 0)


def road() -> Mesh:
    """Make a level road without end."""
    return plate(-FAR, FAR, -FAR, FAR)


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


def build(
    rng: np.random.Generator,
    parts: Mapping[str, Mesh],
    occupied: Mask | None = None,
    areas: Mapping[str, Mask] | None = None,
    *,
    swallowed: str = "",
    glass: tuple[str, float] = ("", 0.0),
    ghosts: tuple[Mesh, int] | None = None,
) -> Scene:
    """Scan shapes, and find the regions.

    Parameters
    ----------
    rng : numpy.random.Generator
    parts : mapping of str to Mesh
        Shapes by name, with heights above the road under the sensor [m].
    occupied : (nx, ny) bool, optional
        Cells that are truly occupied; all others are free.
    areas : mapping of str to (nx, ny) bool, optional
        Regions by place.
    swallowed : str
        The shape whose beams do not return.
    glass : (str, float)
        The shape that lets this share of its beams through.
    ghosts : (Mesh, int), optional
        A shape below the road, and how many of the beams towards it return from there instead of from the road.
    """
    names, meshes = tuple(parts), list(parts.values())
    directions = LIDARS["vlp-32c"].directions().reshape(-1, 3)
    distance, part = cast(meshes, directions)
    if glass[0]:
        passes = (part == names.index(glass[0])) & (rng.random(len(part)) < glass[1])
        others = [k for k, name in enumerate(names) if name != glass[0]]
        behind, which = cast([meshes[k] for k in others], directions[passes])
        distance[passes], part[passes] = behind, np.where(which < 0, -1, np.array(others)[which])
    if ghosts is not None:
        mirrored, which = cast([ghosts[0]], directions)
        beams = np.flatnonzero((which == 0) & (part == names.index("ground")))
        beams = rng.choice(beams, ghosts[1], replace=False)
        distance[beams], part[beams] = mirrored[beams], -1
    if swallowed:
        distance[part == names.index(swallowed)] = np.inf

    back = np.isfinite(distance)
    reach = distance[back] + rng.normal(0, RANGE_NOISE, int(back.sum()))
    xyz, part = directions[back] * reach[:, None], part[back]
    points = np.pad(xyz, ((0, 0), (0, 1))).astype(np.float32)
    occupied = np.zeros(SPEC.shape, bool) if occupied is None else occupied
    state = np.where(occupied, CellState.OCCUPIED, CellState.FREE).astype(np.uint8)
    state[rectangle(*MOUNT.ego_footprint)] = CellState.IGNORE
    regions = {name: cells_of(xyz[part == k]) for k, name in enumerate(names)}
    regions["ground"] &= state == CellState.FREE
    regions["occupied"] = cells_of(xyz[part >= 0]) & occupied
    regions = {name: mask for name, mask in (regions | dict(areas or {})).items() if mask.any()}
    scan = Scan(points, no_returns=directions[~back], sensor="vlp-32c")
    return Scene("", scan, MOUNT, Truth(SPEC, state), regions, part, names)


def flat(rng: np.random.Generator) -> Scene:
    """A level road and nothing else."""
    return build(rng, {"ground": road()})


def rough(rng: np.random.Generator, deviation: float) -> Scene:
    """A road that undulates over half a metre with a standard deviation [m]."""
    step, edge = 0.25, 45.0
    along = np.arange(-edge, edge + step, step)
    height = gaussian_filter(rng.normal(size=(len(along), len(along))), 2)
    height *= deviation / height.std()
    x, y = np.meshgrid(along, along, indexing="ij")
    grid = np.stack([x, y, height], axis=-1)
    return build(rng, {"ground": merge(sheet(a, b, 0) for a, b in zip(grid[:-1], grid[1:], strict=True))})


def overhang(
    rng: np.random.Generator, underside: float, top: float, x: float, y: float, size: tuple[float, float]
) -> Scene:
    """A box in the air with its near corner at x and its middle at y. "under": all its cells behind the first row."""
    length, width = size
    corners = middle(x), middle(x + length), -middle(width / 2) + y, middle(width / 2) + y
    lower, upper = (corners[0], corners[2], underside), (corners[1], corners[3], top)
    under = rectangle(*corners, whole=True)
    occupied = rectangle(*corners) if underside < CLEARANCE else None
    return build(rng, {"ground": road(), "overhang": box(lower, upper, 0)}, occupied, {"under": under})


def step(rng: np.random.Generator, height: float, x: float) -> Scene:
    """A platform ahead, 20 m wide and 8 m deep. "face": its riser; "top": its level."""
    edge = middle(x)
    riser = quads([[(edge, -10, 0), (edge, 10, 0), (edge, 10, height), (edge, -10, height)]], 0)
    parts = {"ground": road(), "face": riser, "top": plate(edge, edge + 8, -10, 10, height)}
    return high(build(rng, parts, rectangle(edge, edge, -10, 10)))


def kerb(rng: np.random.Generator, height: float, y: float) -> Scene:
    """A pavement along the road, 4 m wide, from 20 m behind to 20 m ahead. Regions as in `step`."""
    edge = middle(y)
    riser = quads([[(-20, edge, 0), (20, edge, 0), (20, edge, height), (-20, edge, height)]], 0)
    parts = {"ground": road(), "face": riser, "top": plate(-20, 20, edge, edge + 4, height)}
    return high(build(rng, parts, rectangle(-20, 20, edge, edge)))


def high(scene: Scene) -> Scene:
    """Add "face_high": the cells of "face" with a return more than 0.1 m above the road."""
    face, xyz = scene.part == scene.parts.index("face"), scene.scan.points[:, :3]
    over = cells_of(xyz[face & (xyz[:, 2] > 0.1 - MOUNT.sensor_height)])
    return replace(scene, regions={**scene.regions, **({"face_high": over} if over.any() else {})})


def ditch(rng: np.random.Generator, x: float, depth: float, width: float) -> Scene:
    """A ditch across the road. "inside": its cells; "inside_seen": see `deep`."""
    one, two = middle(x), middle(x + width)
    ground = merge([plate(-FAR, one, -FAR, FAR), plate(two, FAR, -FAR, FAR)])
    hole = profile([(one, 0), (one, -depth), (two, -depth), (two, 0)])
    inside = rectangle(one, two, -FAR, FAR, whole=True)
    return deep(build(rng, {"ground": ground, "ditch": hole}, inside, {"inside": inside}), "inside")


def drop(rng: np.random.Generator, x: float, depth: float) -> Scene:
    """The road ends at an edge, and goes on far below. "beyond": all cells there; "beyond_seen": see `deep`."""
    edge = middle(x)
    low = profile([(edge, 0), (edge, -depth), (FAR, -depth)])
    beyond = rectangle(edge, FAR, -FAR, FAR, whole=True)
    parts = {"ground": plate(-FAR, edge, -FAR, FAR), "low": low}
    return deep(build(rng, parts, beyond, {"beyond": beyond}), "beyond")


def deep(scene: Scene, area: str) -> Scene:
    """Add two regions. "below": the cells that hold returns further than `DEEP` under the road; "AREA_seen": the
    cells of an area that lie in the direction of such a return, within 1/1024 of a turn."""
    xyz, (x, y) = scene.scan.points[:, :3], SPEC.cell_centers
    xyz = xyz[xyz[:, 2] < -MOUNT.sensor_height - DEEP]
    sector, returned = (np.floor(np.arctan2(b, a) * 512 / np.pi) for a, b in ((x, y), (xyz[:, 0], xyz[:, 1])))
    seen = scene.regions[area] & np.isin(sector, returned)
    return replace(scene, regions={**scene.regions, "below": cells_of(xyz), f"{area}_seen": seen})


def car(x: float, y: float) -> tuple[Mesh, tuple[float, float, float, float]]:
    """Make a car from a box 0.18 m above the road and four wheels; return it and its footprint [m]."""
    length, width, height = CAR
    x0, x1, y0, y1 = x, x + length, y - width / 2, y + width / 2
    wheels = [
        box((x0 + a, b, 0), (x0 + a + 0.6, b + 0.2, 0.6), 0) for a in (0.6, length - 1.2) for b in (y0, y1 - 0.2)
    ]
    return merge([box((x0, y0, 0.18), (x1, y1, height), 0), *wheels]), (x0, x1, y0, y1)


def parked(rng: np.random.Generator, x: float, y: float, *, returns: bool = True, given: bool = True) -> Scene:
    """A car that returns its beams, or swallows all; they are in `no_returns` if `given`. "footprint": its cells."""
    mesh, footprint = car(middle(x), y)
    areas = {"footprint": rectangle(*footprint, whole=True)}
    parts = {"ground": road(), "car": mesh}
    scene = build(rng, parts, rectangle(*footprint), areas, swallowed="" if returns else "car")
    return scene if given else replace(scene, scan=replace(scene.scan, no_returns=None))


def ghosts(rng: np.random.Generator, x: float, y: float, count: int) -> Scene:
    """A parked car, and its image in a wet road, 0.4 to 1.5 m below. "mirror": the cells that hold the image."""
    mesh, footprint = car(middle(x), y)
    x0, x1, y0, y1 = footprint
    image = box((x0, y0, -CAR[2]), (x1, y1, -0.4), 0)
    scene = build(rng, {"ground": road(), "car": mesh}, rectangle(*footprint), ghosts=(image, count))
    return replace(scene, regions={**scene.regions, "mirror": cells_of(scene.scan.points[scene.part < 0, :3])})


def banks(rng: np.random.Generator, edge: float, sides: tuple[int, ...]) -> Scene:
    """Banks along the road that climb 2 m within 3 m, with a level plateau behind. "bank": the slope."""
    edge, occupied, slopes, tops = middle(edge), np.zeros(SPEC.shape, bool), [], []
    for side in sides:
        slopes.append(profile([(side * edge, 0), (side * (edge + 3), 2)], across=True))
        tops.append(profile([(side * (edge + 3), 2), (side * FAR, 2)], across=True))
        occupied |= rectangle(-FAR, FAR, *sorted((side * edge, side * (edge + 3))))
    left, right = (edge if side in sides else FAR for side in (1, -1))
    parts = {"ground": plate(-FAR, FAR, -right, left), "bank": merge(slopes), "plateau": merge(tops)}
    return build(rng, parts, occupied)


def slope(rng: np.random.Generator, rise: float, start: float) -> Scene:
    """A road that climbs, or descends, from x = start on; everywhere if that is -inf. The sensor stays level."""
    first = max(start, -FAR)
    line = [(-FAR, 0.0)] * (first > -FAR) + [(first, rise * min(first, 0)), (FAR, rise * (FAR - max(first, 0)))]
    return build(rng, {"ground": profile(line)})


def tree(rng: np.random.Generator, x: float, y: float, height: float) -> Scene:
    """A trunk, and a crown 5 m wide that begins at a height. "under": cells below it, 0.5 m off the trunk."""
    x, y = middle(x), middle(y)
    parts = {
        "ground": road(),
        "trunk": cylinder((x, y, 0), (x, y, height + 1), 0.2, 0),
        "crown": ellipsoid((x, y, height + 1.5), (2.5, 2.5, 1.5), 0, sides=20),
    }
    away = np.hypot(SPEC.cell_centers[0] - x, SPEC.cell_centers[1] - y)
    areas = {"under": (away > 0.5) & (away < 2.4)}
    return build(rng, parts, rectangle(x - 0.2, x + 0.2, y - 0.2, y + 0.2), areas)


def pane(rng: np.random.Generator, x: float, share: float) -> Scene:
    """A pane 6 m wide that lets a share of the beams through, to a wall 8 m behind."""
    x = middle(x)
    glass = quads([[(x, -3, 0), (x, 3, 0), (x, 3, 2.5), (x, -3, 2.5)]], 0)
    wall = box((x + 8, -8, 0), (x + 8.3, 8, 3), 0)
    occupied = rectangle(x, x, -3, 3) | rectangle(x + 8, x + 8.3, -8, 8)
    return build(rng, {"ground": road(), "pane": glass, "wall": wall}, occupied, glass=("pane", share))


def block(rng: np.random.Generator, name: str, x: tuple[float, float], y: tuple[float, float], height: float) -> Scene:
    """A box that stands on the road between two corners. "footprint": its cells."""
    footprint = rectangle(*x, *y)
    mesh = box((x[0], y[0], 0), (x[1], y[1], height), 0)
    return build(rng, {"ground": road(), name: mesh}, footprint, {"footprint": footprint})


DISTANCES = (8, 12, 15)  # [m]
UNDERSIDES = (0.9, 1.2, 1.5, 1.8)  # [m]
STEPS = (0.08, 0.10, 0.12, 0.15, 0.20, 0.25, 0.30, 0.40)  # [m]
RISES = (-0.20, -0.10, -0.05, 0.05, 0.10, 0.20)

BUILDERS: dict[str, Callable[[np.random.Generator], Scene]] = {
    "flat road": flat,
    **{f"rough road {d * 100:g} cm": partial(rough, deviation=d) for d in (0.02, 0.03)},
    **{f"trailer {u:g} m at {d} m": partial(overhang, underside=u, top=3.5, x=d, y=0, size=(4, 2.6))
       for u in UNDERSIDES for d in DISTANCES},
    **{f"bar {u:g} m at {d} m": partial(overhang, underside=u, top=u + 0.2, x=d, y=0, size=(4, 6))
       for u in UNDERSIDES for d in DISTANCES},
    **{f"trailer {u:g} m beside": partial(overhang, underside=u, top=3.5, x=4, y=4.5, size=(10, 2.6))
       for u in UNDERSIDES},
    **{f"step {h:.2f} m at {d} m": partial(step, height=h, x=d) for h in STEPS for d in DISTANCES},
    **{f"step {h:.2f} m along": partial(kerb, height=h, y=4) for h in STEPS},
    "ditch 1 m deep": partial(ditch, x=10, depth=1, width=2),
    "ditch 2 m deep": partial(ditch, x=10, depth=2, width=4),
    "drop 3 m": partial(drop, x=12, depth=3),
    **{f"swallowing car at {d} m": partial(parked, x=d, y=0, returns=False) for d in DISTANCES},
    **{f"swallowing car at {d} m, not given": partial(parked, x=d, y=0, returns=False, given=False)
       for d in DISTANCES},
    "bank left": partial(banks, edge=4, sides=(1,)),
    "banks": partial(banks, edge=4, sides=(1, -1)),
    "banks near": partial(banks, edge=2.5, sides=(1, -1)),
    **{f"slope {100 * r:+.0f} %": partial(slope, rise=r, start=-math.inf) for r in RISES},
    **{f"slope {100 * r:+.0f} % from 10 m": partial(slope, rise=r, start=10) for r in RISES},
    "bridge 4.2 m": partial(overhang, underside=4.2, top=5, x=12, y=0, size=(8, 40)),
    "tree crown 2.3 m": partial(tree, x=12, y=2, height=2.3),
    **{f"glass {s:.0%} pass": partial(pane, x=12, share=s) for s in (0.5, 0.9)},
    "wall along": partial(block, name="wall", x=(2, 40), y=(middle(4), middle(4) + 0.3), height=2.5),
    **{f"parked car at {d} m": partial(parked, x=d, y=0) for d in DISTANCES},
    **{f"low object at {d} m": partial(block, name="object", x=(d, d + 0.32), y=(-0.48, 0.48), height=0.3)
       for d in (8, 12, 20)},
    "ghosts ahead": partial(ghosts, x=12, y=0, count=40),
    "ghosts beside": partial(ghosts, x=8, y=3.5, count=40),
}  # fmt: skip


def scene(name: str, seed: int = 0) -> Scene:
    """Build one scene by its name, a key of `BUILDERS`."""
    return replace(BUILDERS[name](np.random.default_rng(seed)), name=name)


def all_scenes(seed: int = 0) -> list[Scene]:
    """Build all scenes."""
    return [scene(name, seed) for name in BUILDERS]
