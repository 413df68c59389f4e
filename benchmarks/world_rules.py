"""By which rule should drives that are weeks apart be combined? Measured on repeated drives through simulated towns.

    python benchmarks/world_rules.py FIT REPORT

FIT and REPORT are data sets of drives, each through one of several towns; no two drives meet the same traffic or the
same parked cars. Their commands are in benchmarks/README.md. Every rule is run on both; the default is chosen by FIT,
and its figures are those of REPORT. One core. Writes benchmarks/results/world_rules.json, and
docs/pictures/world_rules.png.

Definitions
* static truth: `ogm.simulation.static_truth`, the town without vehicles and people, in the cells of the map;
* known: static truth is free or occupied there, and a scan had a belief about the cell. All figures are of these;
* occupied, free: mass above 1/2. Ghosts: free in the static truth, occupied in the map; false free: the reverse;
* log loss: -ln of the probability (mass + unknown / 2) of the true state, which is at least 0.01;
* left: free in the static truth, a parked car stood there in one drive, whose own map has the cell occupied, and the
  last drive that has the cell free or occupied has it free;
* next drive: the map of all drives before against the static truth with the parked cars of the next one, where that
  one saw something.
"""


# isort: split
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.datasets import Dataset, open_dataset
from ogm.evaluation.models import NamedModels
from ogm.fusion import map_scans
from ogm.fusion.pipeline import grid_pose
from ogm.grid import GridSpec
from ogm.simulation.plan import SEQUENCE, DatasetPlan
from ogm.simulation.static_truth import static_truth
from ogm.state import CellState, Truth
from ogm.truth import cells_in_boxes
from ogm.world import WorldMap
from ogm.world.kernels import MASS_STEPS, merge
from ogm.world.layout import WORLD_RULES, TileIndex

SPEC = GridSpec.centered()
APART = 25.0  # [m] between the places that the truth is looked at from
PARKED = 1000  # tracks of parked vehicles begin here
LEAST = 0.01  # of a probability whose logarithm is taken
Tiles = dict[TileIndex, NDArray[Any]]


class Rule(NamedTuple):
    """A rule for the scans of a drive, and one between drives.

    Attributes
    ----------
    scans, drives : str
        In `WORLD_RULES`.
    reliability : float
        Shafer's discount of each drive's map before it is combined.
    bound : float
        The least that is left unknown.
    keep : float
        Share of the masses of earlier drives that stays where a later one has a belief.
    """

    scans: str
    drives: str
    reliability: float = 1.0
    bound: float = 0.02
    keep: float = 1.0


class Town(NamedTuple):
    """A town, its truth, and the drives through it."""

    name: str
    drives: dict[str, Dataset]
    truth: dict[TileIndex, NDArray[np.uint8]]
    parked: dict[str, dict[TileIndex, NDArray[np.bool_]]]


def towns_of(path: Path, limit: int | None) -> Iterator[tuple[str, dict[str, Dataset], DatasetPlan, str]]:
    """Yield the towns of a data set with their drives in order."""
    dataset = open_dataset(path)
    plan, split = DatasetPlan.from_dict(dataset.facts["plan"]), dataset.facts["split"]
    count = plan.test_towns if split == "test" else plan.towns
    for town in range(count):
        chosen = {}
        for name, numbers in dataset.sequences.items():
            drive = int(name.split()[-1])
            if drive % count == town:
                chosen[f"drive-{drive:03d}"] = dataset.select(numbers[:: limit or 1])
        if chosen and all(len(one) for one in chosen.values()):
            yield f"{path.name}-{town}", chosen, plan, split


def truth_of(spec: GridSpec, drives: dict[str, Dataset], plan: DatasetPlan, split: str) -> Truth:
    """Return the static truth of all cells of a map."""
    places: list[NDArray[np.float64]] = []
    numbers = []
    for part in drives.values():
        for ref in part.refs:
            at = np.asarray(ref.T_map_sensor)[:2, 3]
            if not places or np.linalg.norm(np.array(places) - at, axis=1).min() > APART:
                places.append(at)
                words = ref.name.split()  # "test 12", or "sequence 3 frame 12"
                numbers.append(int(words[-1]) + (SEQUENCE * int(words[1]) if split == "sequences" else 0))
    print(f"  truth from {len(numbers)} places")
    return static_truth(plan, split, numbers, spec, threads=1)


def parked_cells(part: Dataset, spec: GridSpec) -> NDArray[np.bool_]:
    """Return the cells under vehicles that were parked during a drive."""
    seen: set[str] = set()
    covered = np.zeros(spec.shape, np.bool_)
    for k in range(0, len(part), 5):
        frame = part[k]
        boxes, T = frame.boxes, frame.T_map_sensor
        if boxes is None or T is None:
            continue
        new = [k for k, track in enumerate(boxes.track) if int(track) >= PARKED and track not in seen]
        if new:
            seen |= {boxes.track[k] for k in new}
            covered |= cells_in_boxes(boxes.select(new).moved(T), spec)
    return covered


def map_drives(drives: dict[str, Dataset], folder: Path) -> dict[str, dict[str, Tiles]]:
    """Return the map of each drive alone in tiles, by each of `WORLD_RULES` for its scans."""
    model, found = NamedModels("ray", SPEC)(), {rule: dict[str, Tiles]() for rule in WORLD_RULES}
    for name, part in drives.items():
        worlds = {rule: WorldMap.create(folder / f"{name}-{rule}", rule=rule) for rule in WORLD_RULES}  # type: ignore[arg-type]
        for frame, grid in map_scans(part, model):
            for world in worlds.values():
                world.integrate(grid, grid_pose(frame))
        for rule, world in worlds.items():
            found[rule][name] = {index: world.tile(index) for index in world.tiles()}
            world.close()
        shutil.rmtree(folder)
    return found


def cut(array: NDArray[Any], index: TileIndex, spec: GridSpec, n: int) -> NDArray[Any]:
    """Return the cells of a tile from an array over `spec`, which is made of whole tiles."""
    i, j = (round(o / spec.resolution) for o in spec.origin)
    a, b = index[0] * n - i, index[1] * n - j
    return array[a : a + n, b : b + n]


SUMS = ("free", "occupied", "ghosts", "false_free", "hit", "free_hit", "loss_free", "loss_occupied", "left", "left_occupied",
        "left_free", "next", "next_loss", "next_occupied", "next_false_free", "next_free", "next_ghosts")  # fmt: skip


def combine(tile: NDArray[Any], part: NDArray[Any], rule: Rule) -> None:
    """Combine the map of a drive with the tile of all drives before, in place."""
    if rule.keep < 1:
        again = part[4] > 0
        tile[:2, again] = np.rint(tile[:2, again] * rule.keep).astype(tile.dtype)
    if rule.reliability < 1:
        part = part.copy()
        part[:2] = np.rint(part[:2] * rule.reliability).astype(part.dtype)
    merge(tile, part, WORLD_RULES[rule.drives], 1 - rule.bound)


def evaluate(town: Town, drives: dict[str, Tiles], rule: Rule) -> dict[TileIndex, NDArray[np.float64]]:
    """Return the sums `SUMS` of every tile."""
    result = {}
    for index, truth in town.truth.items():
        sums, tile = dict.fromkeys(SUMS, 0.0), None
        free, occupied = truth == CellState.FREE, truth == CellState.OCCUPIED
        was = np.zeros(truth.shape, np.bool_)  # a parked car's, in some drive
        gone = np.zeros(truth.shape, np.bool_)
        for name, tiles in drives.items():
            if index not in tiles:
                continue
            part, parked = tiles[index], town.parked[name].get(index)
            half = MASS_STEPS / 2
            now_free, now_occupied = part[0] > half, part[1] > half
            if tile is None:
                tile = part.copy()
                if rule.reliability < 1:
                    tile[:2] = np.rint(tile[:2] * rule.reliability).astype(tile.dtype)
            else:
                both = (part[4] > 0) & (tile[4] > 0)
                next_occupied = both & (occupied | (free & parked))
                next_free = both & free & ~parked
                m = tile[:2].astype(np.float32) / MASS_STEPS
                p = m[1] + (1 - m[0] - m[1]) / 2
                sums["next"] += np.count_nonzero(next_occupied) + np.count_nonzero(next_free)
                sums["next_loss"] += _loss(p[next_occupied]) + _loss(1 - p[next_free])
                sums["next_occupied"] += np.count_nonzero(next_occupied)
                sums["next_free"] += np.count_nonzero(next_free)
                sums["next_false_free"] += np.count_nonzero(m[0][next_occupied] > 0.5)
                sums["next_ghosts"] += np.count_nonzero(m[1][next_free] > 0.5)
                combine(tile, part, rule)
            stood = parked & now_occupied & free
            gone[stood], was[stood] = False, True
            gone[now_occupied] = False
            gone[was & now_free & ~parked] = True
        if tile is None:
            continue
        known = tile[4] > 0
        m = tile[:2].astype(np.float32) / MASS_STEPS
        p = m[1] + (1 - m[0] - m[1]) / 2
        free, occupied = free & known, occupied & known
        sums["free"], sums["occupied"] = np.count_nonzero(free), np.count_nonzero(occupied)
        sums["ghosts"], sums["false_free"] = np.count_nonzero(m[1][free] > 0.5), np.count_nonzero(m[0][occupied] > 0.5)
        sums["hit"], sums["free_hit"] = np.count_nonzero(m[1][occupied] > 0.5), np.count_nonzero(m[0][free] > 0.5)
        sums["loss_free"], sums["loss_occupied"] = _loss(1 - p[free]), _loss(p[occupied])
        left = gone & free
        sums["left"] = np.count_nonzero(left)
        sums["left_occupied"], sums["left_free"] = (
            np.count_nonzero(m[1][left] > 0.5),
            np.count_nonzero(m[0][left] > 0.5),
        )
        result[index] = np.array([sums[one] for one in SUMS], np.float64)
    return result


def _loss(p: NDArray[Any]) -> float:
    return float(-np.log(np.maximum(p, LEAST)).sum())


def scores(sums: NDArray[np.float64]) -> dict[str, NDArray[np.float64]]:
    """Return the figures of sums (..., SUMS)."""
    s = dict(zip(SUMS, np.moveaxis(sums, -1, 0), strict=True))
    with np.errstate(all="ignore"):
        return {
            "iou_occupied": s["hit"] / (s["occupied"] + s["ghosts"]),
            "iou_free": s["free_hit"] / (s["free"] + s["false_free"]),
            "ghosts": s["ghosts"] / s["free"],
            "false_free": s["false_free"] / s["occupied"],
            "loss": (s["loss_free"] + s["loss_occupied"]) / (s["free"] + s["occupied"]),
            "loss_both": (s["loss_free"] / s["free"] + s["loss_occupied"] / s["occupied"]) / 2,
            "left_occupied": s["left_occupied"] / s["left"],
            "left_free": s["left_free"] / s["left"],
            "next_loss": s["next_loss"] / s["next"],
            "next_false_free": s["next_false_free"] / s["next_occupied"],
            "next_ghosts": s["next_ghosts"] / s["next_free"],
        }
