"""What do the sensor models make of real scans? Covered boxes, free road, labelled cells; failures shown too.

    python benchmarks/deep_real.py [--weights lite|PATH|none] [--quick]

No model was trained on these recordings and no weights were chosen by them; one rule of the deep model, about
intensities of another calibration, was added after a look at them (docs/deep.md). They cannot be shipped:
benchmarks/README.md says which and where they go; what is not there is left out, and the output says so. Writes
benchmarks/results/deep_real.json, docs/pictures/deep_real.png and deep_real_scores.png; pictures of scans that may
not be passed on with the project go to runs/deep_real/.
"""

from _run import DATA, OURS, PEER, PICTURES, RESULTS, TWIN, caption, environment, write_json

# isort: split
import argparse
import hashlib
import importlib.metadata
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from ground import GROUND, LABELS, NOTHING, OWN, kitti_drive, kitti_object, nuscenes_boxes, range_images
from numpy.typing import NDArray

from ogm import EvidentialGrid, GridSpec, read_points, read_scan
from ogm.geometric import HeightBandISM, RayISM
from ogm.io import Argoverse2Map, Objects, estimate_sensor_height, read_argoverse2, read_sustech
from ogm.plot import Panel, cells, masses, points
from ogm.pose import pose
from ogm.truth import (
    FREE,
    OCCUPIED,
    Kind,
    cells_in_areas,
    cells_in_box,
    count_returns,
    free_road,
    move_boxes,
    truth_from_points,
)

SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
DOTS = GridSpec.centered(
    length=81.92, width=56.32, resolution=0.32
)  # for pictures of points, one dot a cell of SPEC
ENOUGH = 50  # returns that make a participant known as a whole (van Kempen et al. 2021, Sec. IV-B)
ABOVE_BOTTOM = 0.15  # [m] what is higher above a box's bottom is a return from the object, not from the road
CORE = 0.25  # [m] further inside a box than this, no margin of the annotation is left
MAJORITY = 0.5  # a state is called where its mass is above this
BANDS = ((0, 10), (10, 20), (20, 30), (30, 50))  # [m] from the sensor
RESAMPLES = 10_000
VEHICLES = ("car", "van", "truck", "bus", "vehicle", "trailer", "tram")
BAND, RAY, DEEP = "HeightBandISM", "RayISM", "DeepISM"
BARE = "... no intensity"  # the same network, not told the intensities: those of KITTI are not calibrated
COLOURS = {BAND: TWIN, RAY: PEER, DEEP: OURS}  # of the models in the pictures


class Road(NamedTuple):
    """What a map says about the road around a scan."""

    cells: NDArray[np.bool_]  # (nx, ny) drivable, and nothing stands there
    in_sight: NDArray[np.bool_]  # (nx, ny) of these, those that nothing hides from the sensor
    below: NDArray[np.bool_]  # (nx, ny) nearer than where the lowest beam meets the ground
    outlines: list[NDArray[np.float64]]  # (N, 2) each, x, y [m] in the sensor's frame


class Scene(NamedTuple):
    """One real scan, in the frame of its sensor, and what is known about it."""

    name: str
    points: NDArray[np.float32]  # (N, 4) x, y, z [m], intensity [0, 1], without the own vehicle's
    height: float  # [m] of the sensor above ground, estimated from the points
    boxes: NDArray[np.float64] = np.empty((0, 7))  # (B, 7) x, y, yaw, length, width, bottom, top
    kinds: tuple[str, ...] = ()  # of the boxes
    ids: tuple[str, ...] = ()  # of the boxes: the same object in another scan of a set has the same
    road: Road | None = None
    truth: NDArray[np.uint8] | None = None  # (nx, ny) states of cells that were hit

    @property
    def returns(self) -> NDArray[np.int64]:
        """Returns from each box (B,)."""
        return count_returns(self.points, self.boxes + [0, 0, 0, 0, 0, ABOVE_BOTTOM, 0])

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Boxes that lie in the grid as a whole (B,)."""
        return np.array([SPEC.contains(*corners(box).T).all() for box in self.boxes], bool)


class Model(NamedTuple):
    """A sensor model for any mounting height."""

    name: str
    for_height: Callable[[float], Callable[[NDArray[np.float32]], EvidentialGrid]]
    what: str = "as by default"


def corners(box: NDArray[np.float64], more: float = 0.0) -> NDArray[np.float64]:
    """Return the corners of a box from above, (4, 2) [m], in turn."""
    x, y, yaw, length, width = box[:5]
    c, s = np.cos(yaw), np.sin(yaw)
    u = (length / 2 + more) * np.array([1, -1, -1, 1])
    v = (width / 2 + more) * np.array([1, 1, -1, -1])
    return np.column_stack([x + c * u - s * v, y + s * u + c * v])


def without_own(xyzi: NDArray[np.float32]) -> NDArray[np.float32]:
    """Drop returns from the own vehicle, so that no model has to tell them apart."""
    x, y = xyzi[:, 0], xyzi[:, 1]
    return np.ascontiguousarray(xyzi[(np.abs(x) > OWN[0]) | (np.abs(y) > OWN[1])], np.float32)


def scene(name: str, xyzi: NDArray[np.float32], height: float | None = None, **known: Any) -> Scene:
    """Make a scene; the sensor's height is estimated from the points where it is not given."""
    height = estimate_sensor_height(xyzi) if height is None else height
    if height is None:
        raise ValueError(f"{name} shows no ground around the sensor, so its height is not known")
    return Scene(name, without_own(xyzi), height, **known)


def boxed(
    name: str, xyzi: NDArray[np.float32], objects: Objects, ids: Sequence[str] = (), **known: Any
) -> Scene:
    """Make a scene with boxes; where the set names no objects, `ids` does."""
    kinds = tuple(label.lower() for label in objects.labels)
    ids = tuple(ids) or objects.tracks
    return scene(name, xyzi, boxes=objects.boxes, kinds=kinds, ids=ids, **known)


def free_scans() -> list[Scene]:
    """Read the scans whose licence is the project's own, Apache-2.0: nothing is annotated in them."""
    with as_file(files("ogm") / "data" / "vls128_road.pcd.xz") as path:
        found = [scene("VLS-128, no intensities", read_scan(path, axes=("+y", "-x", "+z")).points)]
    path = DATA / "autoware_apache2" / "test.pcd.xz"
    if path.is_file():
        found.append(scene("64 layers, constant intensity", read_scan(path, intensity_max=255).points))
    return found


# --- Argoverse 2: two VLP-32C, boxes, a map ---------------------------------------------------------


def middles() -> NDArray[np.float64]:
    """Return the middles of the cells, (nx * ny, 2) [m]."""
    x, y = (o + (np.arange(n) + 0.5) * SPEC.resolution for o, n in zip(SPEC.origin, SPEC.shape, strict=True))
    return np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)


def road(
    plan: Argoverse2Map,
    T: NDArray[np.float64],
    xyzi: NDArray[np.float32],
    height: float,
    lowest: float,
    boxes: NDArray[np.float64],
) -> Road:
    """Tell which cells are road that should be free, and which of them the sensor can see: `ogm.truth.free_road`.

    All models are judged on the same cells, and the returns are those of both lidars; `lowest` is the tangent of
    the judged one's lowest beam's elevation. Where the map has no ground, it is taken to be as low as here.
    """

    def ground(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        z = plan.ground(xyz, T)
        return np.where(np.isnan(z), -height, z)

    where, outlines, xyz = middles(), plan.outlines(T), xyzi[:, :3].astype(float)
    floor = ground(np.column_stack([where, np.full(len(where), -height)])).reshape(SPEC.shape)
    drivable = cells_in_areas(outlines, SPEC)
    found = free_road(drivable, floor, xyz, xyz[:, 2] - ground(xyz), SPEC, boxes=boxes, own_reach=OWN[0])
    below = floor / np.hypot(*where.T).reshape(SPEC.shape) < lowest
    return Road(found.clear, found.in_sight, below, outlines)


def argoverse2() -> dict[str, list[Scene]]:
    """Read the upper lidar, the lower one (upside down), and both together, seen from the upper one."""
    folder = DATA / "argoverse2_adcf"
    if not folder.is_dir():
        return {}
    log = read_argoverse2(folder)
    result: dict[str, list[Scene]] = {}
    for n, (path, stamp) in enumerate(zip(log.sweeps, log.stamps, strict=True)):
        sweep, objects = read_scan(path), log.objects(n)
        ground = estimate_sensor_height(sweep.points)
        for what, sensor, rings in (
            ("upper VLP-32C", "up_lidar", (0, 32)),
            ("lower VLP-32C", "down_lidar", (32, 64)),
            ("both VLP-32C", "up_lidar", (0, 64)),
        ):
            origin = log.lidars[sensor]
            every = sweep.points - np.float32([*origin, 0])
            xyzi = every[(sweep.ring >= rings[0]) & (sweep.ring < rings[1])]
            height = float(origin[2] + ground)
            lowest = float(np.quantile(xyzi[:, 2] / np.hypot(*xyzi[:, :2].T), 0.001))
            moved = replace(objects, boxes=move_boxes(objects.boxes, pose(*-origin)))
            T = log.poses[stamp] @ pose(*origin)
            way = road(log.map, T, without_own(every), height, lowest, moved.boxes)
            one = boxed(path.stem, xyzi, moved, height=height, road=way)
            result.setdefault(f"Argoverse 2, {what}", []).append(one)
    return result


# --- nuScenes, KITTI, SUSTechPOINTS: boxes ----------------------------------------------------------


def nuscenes() -> dict[str, list[Scene]]:
    """HDL-32E: the file holds every beam; a quarter of them met the own vehicle."""
    scenes = [boxed(*one, ids=list(map(str, range(len(one[2]))))) for one in nuscenes_boxes()]
    return {"nuScenes, HDL-32E": scenes} if scenes else {}


def kitti() -> dict[str, list[Scene]]:
    """HDL-64E: only objects that the front camera sees have a box, so boxes are judged, not their absence."""
    single = [boxed(*one, ids=[f"{one[0]} {n}" for n in range(len(one[2]))]) for one in kitti_object()]
    drive = [boxed(*one) for one in kitti_drive()]
    return ({"KITTI, single scans": single} if single else {}) | (
        {"KITTI, drive 0005": drive} if drive else {}
    )


def sustech() -> dict[str, list[Scene]]:
    """Hesai with 40 layers, three scans half a second apart; forward is -y, left is +x."""
    scenes = []
    folder = DATA / "sustechpoints"
    for path in sorted(folder.glob("lidar/*.pcd.xz")):
        stem = path.name.split(".")[0]
        objects = read_sustech(folder / "label" / f"{stem}.json")
        scenes.append(boxed(stem, read_points(path, axes="sustech"), objects))
    return {"SUSTechPOINTS, 40 layers": scenes} if scenes else {}


# --- Labelled range images --------------------------------------------------------------------------


def labelled(name: str) -> list[Scene]:
    """Read range images, and make truth of them. Vegetation is soft; terrain (grass, soil) is ground here."""
    scenes = []
    for stem, image in range_images(LABELS[name]):
        words = image.named()
        kind = np.full(len(words), int(Kind.OBSTACLE))
        for group, value in ((GROUND, Kind.GROUND), (("vegetation",), Kind.PLANT), (NOTHING, Kind.OTHER)):
            kind[np.isin(words, group)] = value
        truth = truth_from_points(image.points, kind, SPEC, own=(0.0, 0.0, 0.0, 2 * OWN[0], 2 * OWN[1]))
        scenes.append(scene(stem, image.points, truth=truth.state))
    return scenes


# --- Verdicts ---------------------------------------------------------------------------------------


def called(grid: EvidentialGrid) -> NDArray[np.uint8]:
    """Return the state of each cell that has more than half of the mass; 0 where neither has."""
    return np.where(grid.free > MAJORITY, FREE, np.where(grid.occupied > MAJORITY, OCCUPIED, 0)).astype(
        np.uint8
    )


def shares(grid: EvidentialGrid, where: Any) -> dict[str, float]:
    """Say what a model makes of some cells: shares that are called free, occupied, neither; and mean masses."""
    state = called(grid)[where]
    free, occupied, unknown = grid.free[where], grid.occupied[where], grid.unknown[where]
    return {
        "free": float((state == FREE).mean()),
        "occupied": float((state == OCCUPIED).mean()),
        "neither": float((state == 0).mean()),
        "free is largest": float(((free > occupied) & (free > unknown)).mean()),
        "occupied is largest": float(((occupied > free) & (occupied > unknown)).mean()),
        "mean free": float(free.mean()),
        "mean occupied": float(occupied.mean()),
        "mean unknown": float(unknown.mean()),
    }


def judge_boxes(one: Scene, grids: Mapping[str, EvidentialGrid]) -> list[dict[str, Any]]:
    """Say what each model makes of each box with enough returns that lies in the grid."""
    returns, result = one.returns, []
    for n in np.flatnonzero((returns >= ENOUGH) & one.inside):
        box = one.boxes[n]
        where = cells_in_box(box, SPEC)
        inner = np.maximum(box[3:5] - 2 * CORE, 0.01)
        core = cells_in_box([*box[:3], *inner], SPEC)
        result.append(
            {
                "scan": one.name,
                "id": one.ids[n],
                "kind": one.kinds[n],
                "distance [m]": round(float(np.hypot(*box[:2])), 1),
                "returns": int(returns[n]),
                "cells": len(where[0]),
                "models": {
                    name: {
                        **shares(grid, where),
                        "free in the core": float((grid.free[core] > MAJORITY).mean()),
                    }
                    for name, grid in grids.items()
                },
            }
        )
    return result


def compact(row: Mapping[str, Any]) -> dict[str, Any]:
    """Keep of a judged box what is worth reading."""
    kept = {
        name: {key: round(one[key], 3) for key in ("occupied", "free", "free in the core")}
        for name, one in row["models"].items()
    }
    return {**row, "models": kept}


PAIRS = ((RAY, BAND), (DEEP, BAND), (DEEP, RAY), (BARE, DEEP))
KEYS = ("occupied", "free", "free in the core", "neither", "occupied is largest", "free is largest")


def is_vehicle(kind: str) -> bool:
    return any(word in kind for word in VEHICLES)


def sum_up(judged: list[dict[str, Any]], names: list[str]) -> dict[str, Any]:
    """Average over boxes, pool cells, and pair the models object by object.

    An object that was scanned several times counts once in means and intervals, with the mean of its scans.
    Intervals are the middle 95 % of bootstrap means over objects.
    """
    objects: dict[str, list[int]] = {}
    for n, row in enumerate(judged):
        objects.setdefault(row["id"], []).append(n)
    size = np.array([row["cells"] for row in judged], float)
    result: dict[str, Any] = {"boxes": len(judged), "objects": len(objects), "models": {}, "paired": {}}
    columns = {}
    for key in KEYS:
        for name in names:
            value = np.array([row["models"][name][key] for row in judged])
            columns[name, key] = np.array([value[members].mean() for members in objects.values()])
            entry = result["models"].setdefault(name, {})
            entry[key] = {
                "mean over objects": float(columns[name, key].mean()),
                "interval": interval(columns[name, key]),
                "of all cells": float((value * size).sum() / size.sum()),
            }
    for name, other in PAIRS:
        if {name, other} <= set(names):
            pair = result["paired"].setdefault(f"{name} minus {other}", {})
            for key in ("occupied", "free", "free in the core"):
                difference = columns[name, key] - columns[other, key]
                pair[key] = {
                    "mean": float(difference.mean()),
                    "interval": interval(difference),
                    "objects with more": int((difference > 1e-9).sum()),
                    "objects with less": int((difference < -1e-9).sum()),
                }
    return result


def interval(value: NDArray[np.float64]) -> list[float] | None:
    """Return the middle 95 % of bootstrap means; nothing for fewer than five values."""
    if len(value) < 5:
        return None
    rng = np.random.default_rng(0)
    means = value[rng.integers(0, len(value), (RESAMPLES, len(value)))].mean(axis=1)
    return [float(q) for q in np.percentile(means, (2.5, 97.5))]


def judge_road(way: Road, grids: Mapping[str, EvidentialGrid]) -> dict[str, Any]:
    """Say what each model makes of the road: all of it, what is in sight, and that by distance."""
    distance = np.hypot(*middles().T).reshape(SPEC.shape)
    parts = {"all": way.cells, "in sight": way.in_sight}
    parts["in sight, where beams reach the ground"] = way.in_sight & ~way.below
    parts["in sight, but below the lowest beam"] = way.in_sight & way.below
    parts |= {
        f"in sight, {low} to {high} m": way.in_sight & (distance >= low) & (distance < high)
        for low, high in BANDS
    }
    return {
        part: {
            "cells": int(where.sum()),
            "models": {name: shares(grid, where) for name, grid in grids.items()},
        }
        for part, where in parts.items()
        if where.any()
    }


def judge_truth(scenes: list[Scene], grids: list[Mapping[str, EvidentialGrid]]) -> dict[str, Any]:
    """Pool the cells of a set of labelled scans by their true state."""
    result: dict[str, Any] = {"scans": len(scenes), "cells": {}, "models": {}, "each": {}}
    for what, state in (("free", FREE), ("occupied", OCCUPIED)):
        count = np.array([np.count_nonzero(one.truth == state) for one in scenes])
        result["cells"][what] = int(count.sum())
        for name in grids[0]:
            each = [shares(grid[name], one.truth == state) for one, grid in zip(scenes, grids, strict=True)]
            weight = count / count.sum()
            result["models"].setdefault(name, {})[f"truly {what}"] = {
                key: float(sum(w * one[key] for w, one in zip(weight, each, strict=True))) for key in each[0]
            }
            result["each"].setdefault(name, {})[f"truly {what}"] = [
                {key: round(one[key], 4) for key in ("free", "occupied", "neither")} for one in each
            ]
    return result


def verdict(record: Mapping[str, Any]) -> dict[str, bool]:
    """Say where the network is better than both geometric models; by the means, whatever the intervals."""
    result = {}
    for group, found in record["boxes"].items():
        mean = {
            name: {key: entry[key]["mean over objects"] for key in KEYS}
            for name, entry in found["models"].items()
        }
        covered, free = ({name: entry[key] for name, entry in mean.items()} for key in ("occupied", "free"))
        result[f"covers more of the boxes: {group}"] = covered[DEEP] > max(covered[BAND], covered[RAY])
        result[f"no more false free than the better one: {group}"] = free[DEEP] <= min(free[BAND], free[RAY])
    for group, parts in record["road"].items():
        for part in ("in sight", "in sight, where beams reach the ground", "all"):
            share = {name: entry["free"] for name, entry in parts[part]["models"].items()}
            result[f"calls more of the road free: {group}, {part}"] = share[DEEP] > max(
                share[BAND], share[RAY]
            )
    return result


# --- Models -----------------------------------------------------------------------------------------


def geometric() -> list[Model]:
    """Return the paper's baseline, and the geometric model to use, both with their defaults."""
    return [
        Model(BAND, lambda height: HeightBandISM(SPEC, sensor_height=height)),
        Model(RAY, lambda height: RayISM(SPEC, sensor_height=height)),
    ]


def deep(weights: str) -> list[Model]:
    """Load a network, to be asked with and without the intensities."""
    from ogm.deep.ism import DeepISM

    def for_height(height: float) -> Callable[[NDArray[np.float32]], EvidentialGrid]:
        return DeepISM.load(weights, sensor_height=height)

    def bare(height: float) -> Callable[[NDArray[np.float32]], EvidentialGrid]:
        model = for_height(height)
        return lambda xyzi: model(np.ascontiguousarray(xyzi[:, :3]))

    first = DeepISM.load(weights)
    if first.spec != SPEC:
        raise ValueError(f"{weights} fills {first.spec}, but this benchmark judges {SPEC}")
    digest = hashlib.sha256()
    for value in first.network.state_dict().values():
        digest.update(value.cpu().numpy().tobytes())
    what = f"{Path(weights).stem}, SHA-256 of the fused weights {digest.hexdigest()[:12]}"
    return [Model(DEEP, for_height, what), Model(BARE, bare, "the same, given x, y, z alone")]


class Warnings(logging.Handler):
    """Keeps what the library logs as warnings: a scan far from the training data, for one."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.scan, self.said = "", {}

    def emit(self, record: logging.LogRecord) -> None:
        """Note a message and the first scan it came with."""
        self.said.setdefault(record.getMessage(), self.scan)


def run(models: list[Model], one: Scene) -> dict[str, EvidentialGrid]:
    return {model.name: model.for_height(one.height)(one.points) for model in models}


# --- Report -----------------------------------------------------------------------------------------

NOTE = (
    "Boxes: cells under annotated objects with at least 50 returns, the whole box, also the side that no beam met.\n"
    "Road: drivable area of the map, one scan of one place; 'in sight': nothing stands before it. Around the vehicle,\n"
    "below the lowest beam, no beam reaches the road. That part was set apart after a network's result was seen.\n"
    "Labelled cells: the truth is from the same scan, so that it only knows cells that were hit, and says nothing\n"
    "about those between. The scans of one set follow each other and show one street."
)


VERDICTS = (
    ("covered", "occupied"),
    ("false free", "free"),
    (f"more than {CORE:g} m inside", "free in the core"),
)


def percent(value: float) -> str:
    return f"{100 * value:5.1f}"


def span(entry: Mapping[str, Any], key: str = "mean over objects") -> str:
    inside = entry["interval"]
    extra = f" [{percent(inside[0])}, {percent(inside[1])}]" if inside else ""
    return percent(entry[key]) + extra


def report(record: Mapping[str, Any]) -> None:
    """Print the result."""
    print("\nBoxes: share of an object's cells [%], mean over objects [95 % of bootstrap means]; (all cells)")
    for group, result in record["boxes"].items():
        print(f"  {group}: {result['boxes']} boxes, {result['objects']} objects")
        for name, entry in result["models"].items():
            parts = [
                f"{what} {span(entry[key])} ({percent(entry[key]['of all cells']).strip()})"
                for what, key in VERDICTS
            ]
            print(f"    {name:16} {'   '.join(parts)}")
        for name, pair in result["paired"].items():
            parts = [
                f"{what} {span(pair[key], 'mean')}, more on {pair[key]['objects with more']}, "
                f"less on {pair[key]['objects with less']}"
                for what, key in VERDICTS
            ]
            print(f"      {name}: {'; '.join(parts)}")
    for group, parts in record["road"].items():
        print(f"\nRoad, {group}: cells called free, occupied, neither [%]")
        for part, result in parts.items():
            print(f"  {part}: {result['cells']} cells")
            _triples(result["models"])
    for group, result in record["labelled"].items():
        for what in ("free", "occupied"):
            print(
                f"\nLabelled, {group}, truly {what}: {result['cells'][what]} cells of {result['scans']} scans: "
                "called free, occupied, neither [%]"
            )
            _triples({name: entry[f"truly {what}"] for name, entry in result["models"].items()})
    if record["verdict"]:
        print(f"\nIs {DEEP} better than both geometric models?")
        for what, held in record["verdict"].items():
            print(f"  {'yes' if held else 'no':3} {what}")
    if record["warnings"]:
        print("\nWarnings of the models")
        for message, where in record["warnings"].items():
            print(f"  {where}: {message}")
    print("\n" + NOTE)


def _triples(models: Mapping[str, Mapping[str, float]]) -> None:
    for name, entry in models.items():
        print(f"    {name:16} {'  '.join(percent(entry[key]) for key in ('free', 'occupied', 'neither'))}")


# --- Pictures ---------------------------------------------------------------------------------------


class Shown(NamedTuple):
    """A row of a picture."""

    title: str
    scene: Scene
    grids: dict[str, EvidentialGrid]


def gallery(chosen: list[Shown], title: str, record: Mapping[str, Any], path: Path) -> None:
    """Draw points and grids of some scans beside each other, their boxes and roads over them."""
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    with_truth = any(row.scene.truth is not None for row in chosen)
    columns = 1 + sum(name in COLOURS for name in chosen[0].grids) + with_truth
    figure = Figure(figsize=(3.6 * columns, 5.1 * len(chosen) + 1.2), layout="constrained")
    axes = figure.subplots(len(chosen), columns, squeeze=False)
    for line, row in zip(axes, chosen, strict=True):
        panels = [points(row.scene.points, DOTS, "points by height", ground_z=-row.scene.height)]
        panels += [masses(grid, name) for name, grid in row.grids.items() if name in COLOURS]
        if row.scene.truth is not None:
            panels.append(truth_panel(row.scene.truth))
        for ax, panel in zip(line, panels, strict=True):
            x_min, x_max, y_min, y_max = SPEC.extent
            ax.imshow(panel.image, extent=(y_max, y_min, x_min, x_max), interpolation="nearest")
            ax.plot(0, 0, "^", markersize=6, color="white", markeredgecolor="black", markeredgewidth=0.8)
            for outline in row.scene.road.outlines if row.scene.road else []:
                ax.plot(*outline[[*range(len(outline)), 0]].T[::-1], "-", color="#39c5ff", linewidth=0.6)
            enough = (row.scene.returns >= ENOUGH) & row.scene.inside
            for box, known in zip(row.scene.boxes, enough, strict=True):
                x, y = corners(box)[[0, 1, 2, 3, 0]].T
                ax.plot(y, x, "-" if known else ":", color="white", linewidth=1.0 if known else 0.7)
            ax.set_xlim(y_max, y_min)
            ax.set_ylim(x_min, x_max)
            ax.tick_params(labelsize=7)
            ax.set_title(panel.title, fontsize=10)
        line[0].set_ylabel(f"{row.title}\nx, forward [m]", fontsize=10)
    for ax in axes[-1]:
        ax.set_xlabel("y, left [m]", fontsize=8)
    legend = [
        Patch(facecolor=colour, label=name)
        for name, colour in masses(next(iter(chosen[0].grids.values()))).legend.items()
    ]
    if any(len(row.scene.boxes) for row in chosen):
        legend.append(Line2D([], [], color="0.6", label=f"annotated, {ENOUGH} returns or more"))
        legend.append(
            Line2D(
                [], [], color="0.6", linestyle=":", label="annotated, fewer, or cut by the edge: not judged"
            )
        )
    if any(row.scene.road for row in chosen):
        legend.append(Line2D([], [], color="#39c5ff", label="drivable area of the map"))
    if with_truth:
        legend.append(Patch(facecolor="0.25", label="in the truth: not hit, or not labelled"))
    figure.legend(
        handles=legend,
        loc="outside upper center",
        ncols=4,
        frameon=False,
        fontsize=9,
        title=title,
        title_fontsize=13,
    )
    figure.supxlabel(caption(record), fontsize=7, color="#555555")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)


def truth_panel(state: NDArray[np.uint8]) -> Panel:
    """Show the truth of the cells that were hit."""
    legend = masses(EvidentialGrid.vacuous(SPEC)).legend
    colours = np.full((*state.shape, 3), 0.25)
    for value, name in ((FREE, "free"), (OCCUPIED, "occupied")):
        colours[state == value] = legend[name]
    return cells(colours, SPEC, "truth of the same scan's hits", legend)


def chart(record: Mapping[str, Any], path: Path) -> None:
    """Draw the shares as bars: boxes, road, labelled cells."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    figure = Figure(figsize=(19, 10), layout="constrained")
    axes = figure.subplots(2, 2)
    names = [name for name in record["models"] if name in COLOURS]
    for ax in axes[0]:
        ax.set_visible(bool(record["boxes"]))
    if record["boxes"]:
        groups = list(record["boxes"])
        ticks = [
            "\n".join([*group.split(", "), f"{record['boxes'][group]['objects']} objects"])
            for group in groups
        ]
        for ax, key, title in (
            (axes[0, 0], "occupied", "Boxes: share of the cells called occupied (more is better)"),
            (axes[0, 1], "free", "Boxes: share of the cells called free (wrongly; less is better)"),
        ):
            for k, name in enumerate(names):
                entries = [record["boxes"][group]["models"][name][key] for group in groups]
                places = np.arange(len(groups)) + (k - (len(names) - 1) / 2) * 0.27
                heights = np.array([100 * entry["mean over objects"] for entry in entries])
                ax.bar(places, heights, 0.25, color=COLOURS[name], label=name)
                for place, entry in zip(places, entries, strict=True):
                    if entry["interval"]:
                        low, high = (100 * edge for edge in entry["interval"])
                        ax.plot([place, place], [low, high], color="black", linewidth=1)
            ax.set_xticks(range(len(groups)), ticks, fontsize=7.5)
            ax.set_ylabel("mean over objects [%]; lines: 95 % of bootstrap means")
            ax.set_title(title, fontsize=11)
            ax.set_ylim(bottom=0)
    road_bars = {
        f"{group.split(', ')[-1]}\n{short}": record["road"][group][part]["models"]
        for group in record["road"]
        for short, part in (
            ("in reach", "in sight, where beams reach the ground"),
            ("in sight", "in sight"),
            ("all", "all"),
        )
    }
    label_bars = {
        f"{group}\ntruly {what}": {name: entry[f"truly {what}"] for name, entry in result["models"].items()}
        for group, result in record["labelled"].items()
        for what in ("free", "occupied")
    }
    for ax, bars, title in (
        (
            axes[1, 0],
            road_bars,
            "Road of the map, Argoverse 2, one place: called free (green), occupied (red), neither (grey)",
        ),
        (
            axes[1, 1],
            label_bars,
            "Labelled cells that were hit: called free (green), occupied (red), neither (grey)",
        ),
    ):
        ax.set_visible(bool(bars))
        _stacks(ax, bars, names)
        ax.set_title(title, fontsize=11)
    handles = [Patch(color=COLOURS[name], label=f"{name} ({record['models'][name]})") for name in names]
    figure.legend(handles=handles, loc="outside upper center", ncols=3, frameon=False)
    figure.supxlabel(caption(record), fontsize=7.5, color="#555555")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def _stacks(ax: Any, bars: Mapping[str, Mapping[str, Mapping[str, float]]], names: list[str]) -> None:
    for k, name in enumerate(names):
        places = np.arange(len(bars)) + (k - (len(names) - 1) / 2) * 0.27
        bottom = np.zeros(len(bars))
        for key, colour in (("free", "#4fae5b"), ("occupied", "#d7403a"), ("neither", "#d9d9d9")):
            height = np.array([100 * entry[name][key] for entry in bars.values()])
            ax.bar(places, height, 0.25, bottom=bottom, color=colour, edgecolor=COLOURS[name], linewidth=2)
            for place, low, part in zip(places, bottom, height, strict=True):
                if part > 3.5:
                    ax.text(place, low + part / 2, f"{part:.0f}", ha="center", va="center", fontsize=7)
            bottom += height
    ax.set_xticks(range(len(bars)), list(bars), fontsize=8)
    ax.set_ylabel("cells [%]")
    ax.set_ylim(0, 100)


# --- Command ----------------------------------------------------------------------------------------

FIRST = ("Argoverse 2, upper VLP-32C", "nuScenes, HDL-32E", "KITTI, drive 0005")
MORE = (
    "Argoverse 2, both VLP-32C",
    "Argoverse 2, lower VLP-32C",
    "KITTI, single scans",
    "SUSTechPOINTS, 40 layers",
)
ALL = "all, each place once"  # of Argoverse 2, the upper lidar


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--weights", help='network to judge: "lite" (default), a path, or "none"')
    parser.add_argument("--quick", action="store_true", help="one scan of each set")
    parser.add_argument("--out", type=Path, default=RESULTS / "deep_real.json", help="where the figures go")
    parser.add_argument(
        "--picture",
        type=Path,
        default=PICTURES / "deep_real.png",
        help="where the pictures go that show scans which may be passed on; and, with _scores, the figures",
    )
    parser.add_argument(
        "--galleries",
        type=Path,
        default=Path("runs/deep_real"),
        help="folder for pictures of all other scans: their licences are not the project's",
    )
    options = parser.parse_args()

    models = geometric()
    if options.weights != "none":
        try:
            models += deep(options.weights or "lite")
        except (ImportError, FileNotFoundError, AttributeError) as error:
            if options.weights:
                raise
            print(f"left out: {DEEP}: {error}")
    record = environment()
    for package in ("torch", "matplotlib"):
        record["versions"][package] = importlib.metadata.version(package)
    names = [model.name for model in models]
    record["models"] = {model.name: model.what for model in models}
    record["note"] = NOTE
    heard = Warnings()
    logging.getLogger("ogm").addHandler(heard)

    sets: dict[str, list[Scene]] = {}
    for what, read in (
        ("argoverse2_adcf", argoverse2),
        ("nuscenes_n015", nuscenes),
        ("kitti_object, kitti_raw_0005", kitti),
        ("sustechpoints", sustech),
    ):
        found = read()
        sets |= found
        if not found:
            print(f"left out: {what}: not under {DATA}")
    record["scans"], record["boxes"], record["each box"], record["road"] = {}, {}, {}, {}
    rows_of: dict[str, Shown] = {}
    together: list[dict[str, Any]] = []
    for group, scenes in sets.items():
        judged: list[dict[str, Any]] = []
        most = -1
        for one in scenes[: 1 if options.quick else None]:
            heard.scan = f"{group}, {one.name}"
            grids = run(models, one)
            found_boxes = judge_boxes(one, grids)
            judged += found_boxes
            if one.road is not None:
                record["road"][group] = judge_road(one.road, grids)
            if len(found_boxes) > most:  # the scan with the most boxes to judge is shown
                most = len(found_boxes)
                rows_of[group] = Shown(f"{group}, {one.name}" if len(scenes) > 1 else group, one, grids)
        record["scans"][group] = [
            {"name": one.name, "points": len(one.points), "sensor height [m]": round(one.height, 3)}
            for one in scenes
        ]
        record["each box"][group] = [compact(row) for row in judged]
        if judged:
            record["boxes"][group] = sum_up(judged, names)
        if group not in MORE[:2]:
            together += [{**row, "id": f"{group} {row['id']}"} for row in judged]
    if together:
        record["boxes"][ALL] = sum_up(together, names)
        for what, chosen in (("vehicles", True), ("people and others", False)):
            part = [row for row in together if is_vehicle(row["kind"]) is chosen]
            if part:
                record["boxes"][f"all, {what}"] = sum_up(part, names)

    record["labelled"] = {}
    labelled_rows = []
    for name in LABELS:
        scenes = labelled(name)[: 1 if options.quick else None]
        if not scenes:
            print(f"left out: {name}: no labelled_range_images/{LABELS[name].folder}/*.npy.xz under {DATA}")
            continue
        made = []
        for one in scenes:
            heard.scan = f"{name}, {one.name}"
            made.append(run(models, one))
        record["labelled"][name] = judge_truth(scenes, made)
        middle = len(scenes) // 2
        labelled_rows.append(Shown(f"{name}, {scenes[middle].name}", scenes[middle], made[middle]))
    record["warnings"] = heard.said
    record["verdict"] = verdict(record) if DEEP in names else {}
    if not sets and not labelled_rows:
        print("nothing to judge: benchmarks/README.md says which recordings are needed, and where")
        return

    report(record)
    write_json(options.out, record)
    stem = options.picture.with_suffix("")
    written = [options.out]
    for path, chosen, title in (
        (options.picture, [Shown(one.name, one, run(models, one)) for one in free_scans()], "Real scans"),
        (
            options.galleries / "first.png",
            [rows_of[group] for group in FIRST if group in rows_of],
            "Real scans",
        ),
        (
            options.galleries / "more.png",
            [rows_of[group] for group in MORE if group in rows_of],
            "More real scans",
        ),
        (options.galleries / "labelled.png", labelled_rows, "Labelled real scans"),
    ):
        if chosen:
            written.append(path)
            gallery(chosen, title, record, path)
    written.append(stem.with_name(f"{stem.name}_scores.png"))
    chart(record, written[-1])
    print(f"\nwrote {', '.join(str(path) for path in written)}")


if __name__ == "__main__":
    main()
