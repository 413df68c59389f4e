"""Hand-built scenes with known truth, for tests of inverse sensor models.

>>> from ogm.geometric import RayISM
>>> from ogm.simulation.hand_built_scenes import SPEC, hand_built_scene
>>> scene = hand_built_scene("step 0.40 m at 12 m")
>>> mass = RayISM(SPEC)(scene.scan).mass[scene.regions["face"]]      # cells with returns from the step's face
>>> bool((mass[:, 0] > 0.5).mean() < 0.1)                            # share that is predicted free
True

`HandBuiltScene` describes scans and regions.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.ndimage import gaussian_filter

from ogm.simulation.materials import Material
from ogm.simulation.mesh import Mesh, box, cylinder, ellipsoid, merge, quads, sheet
from ogm.simulation.shape_scan import MOUNT, SPEC, HandBuiltScene, cells_of, middle, rectangle, scan_shapes, within

__all__ = ["MOUNT", "SCENES", "SPEC", "HandBuiltScene", "hand_built_scene"]

FAR = 120.0  # [m] half the side of the road's plane
CLEARANCE = 2.0  # [m] lower overhanging objects are obstacles, as in `RayISM`
CAR = (4.5, 1.8, 1.5)  # length, width, height [m]
DEEP = 0.3  # [m] returns further below the continued road show that the road ends
HIGH = 0.1  # [m] returns further above the road show an obstacle, as in `RayISM`
ANY = Material.ASPHALT  # intensities are not simulated

Rng = np.random.Generator


def plate(x0: float, x1: float, y0: float, y1: float, z: float = 0.0) -> Mesh:
    """Make a level rectangle [m]; z = 0 is the road under the sensor, here and below."""
    return quads([[(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)]], ANY)


def upright(a: tuple[float, float], b: tuple[float, float], height: float) -> Mesh:
    """Make an upright rectangle on the road between two points (x, y) [m]."""
    return quads([[(*a, 0), (*b, 0), (*b, height), (*a, height)]], ANY)


def road() -> Mesh:
    """Make a level road over the whole plane."""
    return plate(-FAR, FAR, -FAR, FAR)


def profile(line: list[tuple[float, float]], *, across: bool = False) -> Mesh:
    """Make a surface along a line (x, z), or (y, z) if `across` [m], level in the other direction."""
    right, left = (
        np.array([(side * FAR, a, z) if across else (a, side * FAR, z) for a, z in line]) for side in (-1, 1)
    )
    return sheet(right, left, ANY)


def car(x: float, y: float) -> tuple[Mesh, tuple[float, float, float, float]]:
    """Make a car from a box 0.18 m above the road and four wheels; return it and its footprint [m]."""
    length, width, height = CAR
    x0, x1, y0, y1 = x, x + length, y - width / 2, y + width / 2
    at = ((x0 + a, b) for a in (0.6, length - 1.2) for b in (y0, y1 - 0.2))
    wheels = (box((a, b, 0), (a + 0.6, b + 0.2, 0.6), ANY) for a, b in at)
    return merge([box((x0, y0, 0.18), (x1, y1, height), ANY), *wheels]), (x0, x1, y0, y1)


def flat(rng: Rng) -> HandBuiltScene:
    """Build a level road and nothing else."""
    return scan_shapes(rng, {"ground": road()})


def rough(rng: Rng, deviation: float) -> HandBuiltScene:
    """Build a road that undulates over half a metre with a standard deviation [m]."""
    along = np.arange(-45, 45.25, 0.25)
    height = gaussian_filter(rng.normal(size=(len(along), len(along))), 2)
    x, y = np.meshgrid(along, along, indexing="ij")
    lines = np.stack([x, y, height * (deviation / height.std())], axis=-1)
    return scan_shapes(rng, {"ground": merge(sheet(a, b, ANY) for a, b in zip(lines[:-1], lines[1:], strict=True))})


def slope(rng: Rng, rise: float, start: float) -> HandBuiltScene:
    """Build a road that climbs or descends from x = start on, everywhere for -inf. The sensor is level."""
    line = [(-FAR, 0.0), (start, 0.0)] if start > -FAR else [(-FAR, -rise * FAR)]
    return scan_shapes(rng, {"ground": profile([*line, (FAR, rise * (FAR - max(start, 0)))])})


def overhang(rng: Rng, underside: float, top: float, x: float, y: float, size: tuple[float, float]) -> HandBuiltScene:
    """Build a box in the air with its near face at x, its middle at y. "under": its cells behind the first row."""
    length, width = size
    x0, x1, y0, y1 = middle(x), middle(x + length), y - middle(width / 2), y + middle(width / 2)
    parts = {"ground": road(), "overhang": box((x0, y0, underside), (x1, y1, top), ANY)}
    occupied = rectangle(x0, x1, y0, y1) if underside < CLEARANCE else None
    return scan_shapes(rng, parts, occupied).with_regions(under=rectangle(x0, x1, y0, y1, whole=True))


def step(rng: Rng, height: float, x: float) -> HandBuiltScene:
    """Build a platform ahead, 20 m wide and 8 m deep: "face" and "top". "face_high": see `high`."""
    x = middle(x)
    face = upright((x, -10), (x, 10), height)
    parts = {"ground": road(), "face": face, "top": plate(x, x + 8, -10, 10, height)}
    return high(scan_shapes(rng, parts, rectangle(x, x, -10, 10)), "face")


def pavement(rng: Rng, height: float, y: float) -> HandBuiltScene:
    """Build a pavement along the road, 4 m wide, from 20 m behind to 20 m ahead. Regions as in `step`."""
    y = middle(y)
    face = upright((-20, y), (20, y), height)
    parts = {"ground": road(), "face": face, "top": plate(-20, 20, y, y + 4, height)}
    return high(scan_shapes(rng, parts, rectangle(-20, 20, y, y)), "face")


def banks(rng: Rng, edge: float, sides: tuple[int, ...], lidar: str = "vlp-32c") -> HandBuiltScene:
    """Build banks along the road, y = edge on, that climb 2 m within 3 m to a level plateau.

    "bank_high": see `high`; "bank_near": its cells within 10 m of the sensor.
    """
    edge, occupied = middle(edge), np.zeros(SPEC.shape, bool)
    slopes = [profile([(s * edge, 0), (s * (edge + 3), 2)], across=True) for s in sides]
    tops = [profile([(s * (edge + 3), 2), (s * FAR, 2)], across=True) for s in sides]
    for side in sides:
        occupied |= rectangle(-FAR, FAR, *sorted((side * edge, side * (edge + 3))))
    right, left = (edge if side in sides else FAR for side in (-1, 1))
    parts = {"ground": plate(-FAR, FAR, -right, left), "bank": merge(slopes), "plateau": merge(tops)}
    built = high(scan_shapes(rng, parts, occupied, lidar=lidar), "bank")
    return built.with_regions(bank_near=built.regions["bank_high"] & within(10))


def high(built: HandBuiltScene, part: str) -> HandBuiltScene:
    """Add the region PART_high: cells that hold returns of a shape from more than `HIGH` above the road."""
    xyz = built.points_on(part)
    return built.with_regions(**{f"{part}_high": cells_of(xyz[xyz[:, 2] > HIGH])})


def ditch(rng: Rng, x: float, depth: float, width: float) -> HandBuiltScene:
    """Build a ditch across the road.

    "inside": its cells; "below": cells that hold returns further than `DEEP` under the road; "inside_seen": cells of
    the ditch in the direction of such a return, within 1/1024 of a turn.
    """
    x0, x1 = middle(x), middle(x + width)
    ground = merge([plate(-FAR, x0, -FAR, FAR), plate(x1, FAR, -FAR, FAR)])
    inside = rectangle(x0, x1, -FAR, FAR, whole=True)
    hole = profile([(x0, 0), (x0, -depth), (x1, -depth), (x1, 0)])
    built = scan_shapes(rng, {"ground": ground, "ditch": hole}, inside)
    xyz, (cx, cy) = built.points_on("ditch"), SPEC.cell_centers
    xyz = xyz[xyz[:, 2] < -DEEP]
    sector, returned = (np.floor(np.arctan2(b, a) * 512 / np.pi) for a, b in ((cx, cy), (xyz[:, 0], xyz[:, 1])))
    return built.with_regions(inside=inside, below=cells_of(xyz), inside_seen=inside & np.isin(sector, returned))


def drop(rng: Rng, x: float, depth: float) -> HandBuiltScene:
    """Build an edge at which the road drops to a plane far "below". "beyond": all cells behind the edge."""
    x = middle(x)
    parts = {"ground": plate(-FAR, x, -FAR, FAR), "below": profile([(x, 0), (x, -depth), (FAR, -depth)])}
    beyond = rectangle(x, FAR, -FAR, FAR, whole=True)
    return scan_shapes(rng, parts, beyond).with_regions(beyond=beyond)


def parked(rng: Rng, x: float, y: float, swallowed: str = "", *, given: bool = True) -> HandBuiltScene:
    """Build a car that may swallow its beams; they are in `no_returns` if `given`. "footprint": the car's cells."""
    mesh, footprint = car(middle(x), y)
    built = scan_shapes(rng, {"ground": road(), "car": mesh}, rectangle(*footprint), swallowed=swallowed)
    built = built.with_regions(footprint=rectangle(*footprint, whole=True))
    return built if given else replace(built, scan=replace(built.scan, no_returns=None))


def wet(rng: Rng, x: float, y: float, count: int) -> HandBuiltScene:
    """Build a car and ghost returns from its image in a wet road, 0.4 to 1.5 m below.

    "ghosts": cells that hold them; "around": cells of "ground" within 3 m of the car.
    """
    mesh, (x0, x1, y0, y1) = car(middle(x), y)
    image = box((x0, y0, -CAR[2]), (x1, y1, -0.4), ANY)
    built = scan_shapes(rng, {"ground": road(), "car": mesh}, rectangle(x0, x1, y0, y1), ghosts=(image, count))
    around = built.regions["ground"] & rectangle(x0 - 3, x1 + 3, y0 - 3, y1 + 3)
    return built.with_regions(ghosts=cells_of(built.scan.points[built.part < 0]), around=around)


def tree(rng: Rng, x: float, y: float, height: float) -> HandBuiltScene:
    """Build a trunk and a crown 5 m wide that begins at a height. "under": cells below, 0.5 m off the trunk."""
    x, y = middle(x), middle(y)
    trunk = cylinder((x, y, 0), (x, y, height + 1), 0.2, ANY)
    crown = ellipsoid((x, y, height + 1.5), (2.5, 2.5, 1.5), ANY, sides=20)
    away = np.hypot(SPEC.cell_centers[0] - x, SPEC.cell_centers[1] - y)
    built = scan_shapes(rng, {"ground": road(), "trunk": trunk, "crown": crown}, away < 0.3)
    return built.with_regions(under=(away > 0.5) & (away < 2.4))


def pane(rng: Rng, x: float, share: float) -> HandBuiltScene:
    """Build a pane 6 m wide that lets a share of the beams through, to a wall 8 m behind."""
    x = middle(x)
    glass = upright((x, -3), (x, 3), 2.5)
    wall = box((x + 8, -8, 0), (x + 8.3, 8, 3), ANY)
    occupied = rectangle(x, x, -3, 3) | rectangle(x + 8, x + 8.3, -8, 8)
    return scan_shapes(rng, {"ground": road(), "pane": glass, "wall": wall}, occupied, glass=("pane", share))


def block(rng: Rng, name: str, x: tuple[float, float], y: tuple[float, float], height: float) -> HandBuiltScene:
    """Build a box that stands on the road between two corners [m]. "footprint": its cells."""
    footprint = rectangle(*x, *y)
    mesh = box((x[0], y[0], 0), (x[1], y[1], height), ANY)
    return scan_shapes(rng, {"ground": road(), name: mesh}, footprint).with_regions(footprint=footprint)


DISTANCES = (8, 12, 15)  # [m]
UNDERSIDES = (0.9, 1.2, 1.5, 1.8)  # [m]
STEPS = (0.08, 0.10, 0.12, 0.15, 0.20, 0.25, 0.30, 0.40)  # [m]
RISES = (-0.20, -0.10, -0.05, 0.05, 0.10, 0.20)

# Builders of the scenes by name.
SCENES: dict[str, Callable[[Rng], HandBuiltScene]] = {
    "flat road": flat,
    **{f"rough road {100 * d:g} cm": partial(rough, deviation=d) for d in (0.02, 0.03)},
    **{f"slope {r:+.0%}": partial(slope, rise=r, start=-math.inf) for r in RISES},
    **{f"slope {r:+.0%} from 10 m": partial(slope, rise=r, start=10) for r in RISES},
    **{f"trailer {u} m at {d} m": partial(overhang, underside=u, top=3.5, x=d, y=0, size=(4, 2.6))
       for u in UNDERSIDES for d in DISTANCES},
    **{f"bar {u} m at {d} m": partial(overhang, underside=u, top=u + 0.2, x=d, y=0, size=(4, 6))
       for u in UNDERSIDES for d in DISTANCES},
    **{f"trailer {u} m beside": partial(overhang, underside=u, top=3.5, x=4, y=4.5, size=(10, 2.6))
       for u in UNDERSIDES},
    **{f"step {h:.2f} m at {d} m": partial(step, height=h, x=d) for h in STEPS for d in DISTANCES},
    **{f"step {h:.2f} m along": partial(pavement, height=h, y=4) for h in STEPS},
    "ditch 1 m deep": partial(ditch, x=10, depth=1, width=2),
    "ditch 2 m deep": partial(ditch, x=10, depth=2, width=4),
    "drop 3 m": partial(drop, x=12, depth=3),
    **{f"swallowing car at {d} m": partial(parked, x=d, y=0, swallowed="car") for d in DISTANCES},
    **{f"swallowing car at {d} m, not given": partial(parked, x=d, y=0, swallowed="car", given=False)
       for d in DISTANCES},
    "bank left": partial(banks, edge=4, sides=(1,)),
    **{f"banks at {d} m": partial(banks, edge=d, sides=(1, -1)) for d in (2.5, 4, 9)},
    **{f"banks at {d} m, HDL-32E": partial(banks, edge=d, sides=(1, -1), lidar="hdl-32e") for d in (4, 7, 9)},
    "bridge 4.2 m": partial(overhang, underside=4.2, top=5, x=12, y=0, size=(8, 40)),
    "tree crown 2.3 m": partial(tree, x=12, y=2, height=2.3),
    **{f"glass, {s:.0%} pass": partial(pane, x=12, share=s) for s in (0.5, 0.9)},
    "wall along": partial(block, name="wall", x=(2, 40), y=(middle(4), middle(4) + 0.3), height=2.5),
    **{f"parked car at {d} m": partial(parked, x=d, y=0) for d in DISTANCES},
    **{f"low object at {d} m": partial(block, name="object", x=(middle(d), middle(d) + 0.16), y=(-0.5, 0.5), height=0.3)
       for d in (8, 12, 20)},
    "ghosts ahead": partial(wet, x=12, y=0, count=40),
    "ghosts beside": partial(wet, x=8, y=3.5, count=40),
}  # fmt: skip


def hand_built_scene(name: str, seed: int = 0) -> HandBuiltScene:
    """Return a scene.

    Parameters
    ----------
    name : str
        A key of `SCENES`.
    seed : int
        Seed of the range noise.
    """
    return replace(SCENES[name](np.random.default_rng(seed)), name=name)
