"""By which rule should drives that are weeks apart be combined? Measured on repeated drives through simulated towns.

    python benchmarks/world_rules.py FIT REPORT

FIT and REPORT are data sets of drives, each through one of several towns; no two drives meet the same traffic or the
same parked cars. Their commands are in benchmarks/README.md. Every rule is run on both; the default is chosen by FIT,
and its figures are those of REPORT. One core. Writes benchmarks/results/world_rules.json, and
docs/pictures/world_rules.png.

Definitions
* static truth: `static_truth` of `_world_towns.py`, the town without vehicles and people, in the cells of the map;
* known: static truth is free or occupied there, and a scan had a belief about the cell. All figures are of these;
* occupied, free: mass above 1/2. Ghosts: free in the static truth, occupied in the map; false free: the reverse;
* log loss: -ln of the probability (mass + unknown / 2) of the true state, which is at least 0.01;
* left: free in the static truth, a parked car stood there in one drive, whose own map has the cell occupied, and the
  last drive that has the cell free or occupied has it free;
* next drive: the map of all drives before against the static truth with the parked cars of the next one, where that
  one saw something.
"""

import _run as run  # first: it sets the number of threads

# isort: split
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from _world_towns import TILE, ScanRule, Tiles, Town, around, cut_all, map_drives, parked_cells, towns_of, truth_of
from numpy.typing import NDArray

from ogm.datasets import Dataset
from ogm.evaluation import compare_paired
from ogm.grid import EvidentialGrid, GridSpec
from ogm.plot import mass_panel, save_picture
from ogm.simulation.exchange import truth_panel
from ogm.simulation.plan import DatasetPlan
from ogm.state import CellState, Truth
from ogm.world.kernels import MASS_STEPS, merge
from ogm.world.layout import WORLD_RULES, TileIndex

LEAST = 0.01  # of a probability whose logarithm is taken
SUMS = (
    *("free", "occupied", "ghosts", "false_free", "hit", "free_hit", "loss_free", "loss_occupied"),
    *("left", "left_occupied", "left_free"),
    *("next", "next_loss", "next_occupied", "next_false_free", "next_free", "next_ghosts"),
)
HIGHER = ("iou_occupied", "iou_free", "left_free")
ENOUGH = 300  # cells of either state that a tile needs to be compared
WIDE = 256  # [cells] of the picture


class Rule(NamedTuple):
    """Combination of scans to the map of a drive, and of the maps of drives to the map of the town.

    Attributes
    ----------
    scans : ScanRule
    drives : str
        In `WORLD_RULES`.
    reliability : float
        Shafer's discount of each drive's map before it is combined.
    bound : float
        The least that is left unknown.
    keep : float
        Share of the masses of earlier drives that stays where a later one has a belief.
    """

    scans: ScanRule
    drives: str
    reliability: float = 1.0
    bound: float = 0.02
    keep: float = 1.0


BEFORE, CHOSEN = "cautious", "cautious, drives x 0.8"
_CAUTIOUS, _DEMPSTER, _CUMULATIVE = map(ScanRule, ("cautious", "dempster", "cumulative"))
RULES = {
    BEFORE: Rule(_CAUTIOUS, "cautious"),
    "cautious, drives x 0.9": Rule(_CAUTIOUS, "cautious", reliability=0.9),
    CHOSEN: Rule(_CAUTIOUS, "cautious", reliability=0.8),
    "cautious, drives x 0.7": Rule(_CAUTIOUS, "cautious", reliability=0.7),
    "cautious, scans x 0.9": Rule(ScanRule("cautious", 0.9), "cautious"),
    "Dempster": Rule(_DEMPSTER, "dempster"),
    "Dempster, drives x 0.8": Rule(_DEMPSTER, "dempster", reliability=0.8),
    "Dempster, scans x 0.1": Rule(ScanRule("dempster", 0.1), "dempster"),
    "cumulative": Rule(_CUMULATIVE, "cumulative"),
    "cumulative, unknown at least 0.2": Rule(_CUMULATIVE, "cumulative", bound=0.2),
    "cumulative, scans x 0.3": Rule(ScanRule("cumulative", 0.3), "cumulative"),
    "scans cautious, drives Dempster": Rule(_CAUTIOUS, "dempster"),
    "scans cautious, drives cumulative": Rule(_CAUTIOUS, "cumulative"),
    "cautious, earlier drives x 0.5": Rule(_CAUTIOUS, "cautious", keep=0.5),
    "cautious, the last drive alone": Rule(_CAUTIOUS, "cautious", keep=0.0),
}


def main() -> None:
    parser = run.Parser(__doc__, picture=True)
    parser.add_argument("fit", type=Path)
    parser.add_argument("report", type=Path)
    parser.add_argument("--every", type=int, default=1, help="take every N-th scan of FIT (1)")
    options = parser.parse_args()
    record: dict[str, Any] = run.environment("ray") | {"chosen": CHOSEN}
    with tempfile.TemporaryDirectory() as folder:
        for part, path, every in (("fit", options.fit, options.every), ("report", options.report, 1)):
            found = [prepare(*one, Path(folder)) for one in towns_of(path, every)]
            record[part] = summary(found)
    picture(*found[0], record, options.picture)
    run.write_record(options.out, record)


def prepare(
    name: str, drives: dict[str, Dataset], plan: DatasetPlan, split: str, folder: Path
) -> tuple[Town, dict[ScanRule, dict[str, Tiles]]]:
    """Return a town with its truth, and the maps of its drives."""
    maps = map_drives(drives, folder / name, {rule.scans: None for rule in RULES.values()})
    tiles = sorted({index for one in next(iter(maps.values())).values() for index in one})
    spec = around(tiles)
    truth = truth_of(spec, drives, plan, split).state
    parked = {one: cut_all(parked_cells(part, spec), tiles, spec) for one, part in drives.items()}
    return Town(name, drives, cut_all(truth, tiles, spec), parked), maps


def summary(found: list[tuple[Town, dict[ScanRule, dict[str, Tiles]]]]) -> dict[str, Any]:
    """Return the figures of every rule, and its differences to `BEFORE` in pairs of tiles, with intervals."""
    sums = {name: [] for name in RULES}
    for town, maps in found:
        for name, rule in RULES.items():
            sums[name] += evaluate(town, maps[rule.scans], rule).values()
            print(f"{town.name}: {name}", flush=True)
    each = {name: scores(np.array(one)) for name, one in sums.items()}
    seen = np.array(sums[BEFORE])
    large = (seen[:, SUMS.index("occupied")] > ENOUGH) & (seen[:, SUMS.index("free")] > ENOUGH)
    rules = {}
    for name, one in sums.items():
        rules[name] = {key: round(float(value), 4) for key, value in scores(np.sum(one, axis=0)).items()}
        if name == BEFORE:
            continue
        pairs = {}
        for key in each[name]:
            better = "higher" if key in HIGHER else "lower"
            compared = compare_paired(each[name][key][large], each[BEFORE][key][large], better)
            pairs[key] = [round(float(value), 4) for value in compared.difference]
        rules[name]["difference"] = pairs
    counted = dict(zip(SUMS, np.sum(sums[BEFORE], axis=0).astype(int).tolist(), strict=True))
    return {
        "towns": len(found),
        "drives": sum(len(town.drives) for town, _ in found),
        "frames": sum(len(part) for town, _ in found for part in town.drives.values()),
        "tiles": int(large.sum()),
        "cells": {key: counted[key] for key in ("free", "occupied", "left", "next")},
        "rules": rules,
    }


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
                tile = np.zeros_like(part)
            else:
                both = (part[4] > 0) & (tile[4] > 0)
                found = counted(tile, both & free & ~parked, both & (occupied | (free & parked)))
                sums["next"] += found["free"] + found["occupied"]
                sums["next_loss"] += found["loss_free"] + found["loss_occupied"]
                for key in ("occupied", "free", "false_free", "ghosts"):
                    sums[f"next_{key}"] += found[key]
            combine(tile, part, rule)
            stood = parked & now_occupied & free
            gone[stood], was[stood] = False, True
            gone[now_occupied] = False
            gone[was & now_free & ~parked] = True
        if tile is None:
            continue
        known, nothing = tile[4] > 0, np.zeros(truth.shape, np.bool_)
        sums |= counted(tile, free & known, occupied & known)
        left = counted(tile, gone & free & known, nothing)
        sums |= {"left": left["free"], "left_occupied": left["ghosts"], "left_free": left["free_hit"]}
        result[index] = np.array([sums[key] for key in SUMS], np.float64)
    return result


def counted(tile: NDArray[Any], free: NDArray[np.bool_], occupied: NDArray[np.bool_]) -> dict[str, float]:
    """Return the sums of a tile over truly free and truly occupied cells."""
    m = tile[:2].astype(np.float32) / MASS_STEPS
    p = m[1] + (1 - m[0] - m[1]) / 2
    return {
        "free": np.count_nonzero(free),
        "occupied": np.count_nonzero(occupied),
        "ghosts": np.count_nonzero(m[1][free] > 0.5),
        "false_free": np.count_nonzero(m[0][occupied] > 0.5),
        "hit": np.count_nonzero(m[1][occupied] > 0.5),
        "free_hit": np.count_nonzero(m[0][free] > 0.5),
        "loss_free": _loss(1 - p[free]),
        "loss_occupied": _loss(p[occupied]),
    }


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


def final(drives: dict[str, Tiles], index: TileIndex, rule: Rule) -> NDArray[Any]:
    """Return a tile of all drives by a rule."""
    tile = None
    for tiles in drives.values():
        if index in tiles:
            if tile is None:
                tile = np.zeros_like(tiles[index])
            combine(tile, tiles[index], rule)
    assert tile is not None
    return tile


def picture(
    town: Town,
    maps: dict[ScanRule, dict[str, Tiles]],
    record: dict[str, Any],
    path: Path,
    chosen: tuple[str, ...] = (BEFORE, CHOSEN),
) -> None:
    """Draw the truth and some rules at the tile in which most parked cars have left, 40 m of it."""
    first = next(iter(RULES.values())).scans
    last = {index: evaluate(town, maps[first], RULES[BEFORE]).get(index) for index in town.truth}
    index = max(last, key=lambda one: 0 if last[one] is None else last[one][SUMS.index("left")])
    truth = town.truth[index]
    spec = around([index])
    left = np.any([town.parked[name][index] for name in town.parked], axis=0) & (truth == CellState.FREE)
    i, j = (int(np.clip(np.median(one) - WIDE // 2, 0, TILE - WIDE)) for one in np.nonzero(left))
    part = (slice(i, i + WIDE), slice(j, j + WIDE))
    small = GridSpec(spec.resolution, (WIDE, WIDE), (spec.origin[0] + i * 0.16, spec.origin[1] + j * 0.16))
    panels = [truth_panel(Truth(small, np.ascontiguousarray(truth[part])), "the town without traffic")]
    for name in chosen:
        tile = final(maps[RULES[name].scans], index, RULES[name])[:2, part[0], part[1]]
        mass = np.moveaxis(tile, 0, -1).astype(np.float32) / MASS_STEPS
        panels.append(mass_panel(EvidentialGrid(small, np.ascontiguousarray(mass)), name))
    save_picture(path, *panels)


if __name__ == "__main__":
    main()
