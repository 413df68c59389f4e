"""Repeated drives through simulated towns: their maps, and the truth of the towns without traffic."""

import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.datasets import Dataset, open_dataset
from ogm.fusion import map_scans
from ogm.fusion.pipeline import grid_pose
from ogm.grid import GridSpec
from ogm.models import load_model
from ogm.pose import pose
from ogm.simulation.cells import measure_ground
from ogm.simulation.moments import set_up
from ogm.simulation.plan import SEQUENCE, DatasetPlan
from ogm.simulation.survey import aimed_truth
from ogm.state import CellState, Truth
from ogm.truth import TRUTH_SPEC, cells_in_boxes
from ogm.world import WorldMap
from ogm.world.layout import TileIndex

SPEC = GridSpec.centered()
TILE = 512  # [cells]
APART = 25.0  # [m] between the places that the truth is looked at from
PARKED = 1000  # tracks of parked vehicles begin here
Tiles = dict[TileIndex, NDArray[Any]]


class ScanRule(NamedTuple):
    """Combination of the scans of a drive: a rule of `WORLD_RULES`, and Shafer's discount of each scan before."""

    rule: str
    reliability: float = 1.0


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
    return static_truth(plan, split, numbers, spec)


def static_truth(plan: DatasetPlan, split: str, numbers: Iterable[int], spec: GridSpec) -> Truth:
    """Return the truth of a town without vehicles and people, moving or parked, in cells of its map.

    Rays are aimed from above the ground where the lidar was, by the rules of `ogm.simulation.survey`. The sensor stands
    upright and is moved by less than half a cell, so that the cells of all places are those of `spec`, and nothing is
    resampled. A cell that is occupied from one place is occupied; one where ground alone was hit is free; the others
    are unknown.
    """
    side, state = TRUTH_SPEC.resolution, np.full(spec.shape, CellState.UNKNOWN, np.uint8)
    corner = np.rint(np.array([TRUTH_SPEC.origin, spec.origin]) / side).astype(int)
    for number in numbers:
        here = set_up(plan, split, number, 1)
        here.world.scene.place([])  # without the traffic
        x, y, z = here.T_world_sensor[:3, 3]
        at = np.rint(np.array([x, y]) / side).astype(int)
        below = measure_ground(here.world.ground, pose(at[0] * side, at[1] * side, z))
        seen = aimed_truth(here.world.scene, below, (here.spec.elevations[0], here.spec.elevations[-1])).state
        keep_seen(state, seen, at + corner[0] - corner[1])
    return Truth(spec, state)


def keep_seen(state: NDArray[np.uint8], seen: NDArray[np.uint8], at: NDArray[np.int_]) -> None:
    """Put what was seen in the cells from `at` on into the state, in place; occupied wins over free."""
    low, high = np.maximum(at, 0), np.minimum(at + seen.shape, state.shape)
    if (low >= high).any():
        return
    there = state[low[0] : high[0], low[1] : high[1]]
    new = seen[low[0] - at[0] : high[0] - at[0], low[1] - at[1] : high[1] - at[1]]
    there[(new == CellState.FREE) & (there == CellState.UNKNOWN)] = CellState.FREE
    there[new == CellState.OCCUPIED] = CellState.OCCUPIED


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


def map_drives(drives: dict[str, Dataset], folder: Path, kinds: Iterable[ScanRule]) -> dict[ScanRule, dict[str, Tiles]]:
    """Return the map of each drive alone in tiles, for each way to combine its scans."""
    model, found = load_model("ray+radar", SPEC), {kind: dict[str, Tiles]() for kind in kinds}
    for name, part in drives.items():
        worlds = {kind: WorldMap.create(folder / f"{name}-{k}", rule=kind.rule) for k, kind in enumerate(found)}  # type: ignore[arg-type]
        for frame, grid in map_scans(part, model):
            for kind, world in worlds.items():
                world.integrate(grid, grid_pose(frame), reliability=kind.reliability)
        for kind, world in worlds.items():
            found[kind][name] = {index: world.tile(index) for index in world.tiles()}
            world.close()
        shutil.rmtree(folder)
    return found


def around(tiles: list[TileIndex]) -> GridSpec:
    """Return the cells of all tiles."""
    low, high = np.min(tiles, axis=0), np.max(tiles, axis=0) + 1
    i, j = (low * TILE * SPEC.resolution).tolist()
    nx, ny = ((high - low) * TILE).tolist()
    return GridSpec(SPEC.resolution, (nx, ny), (i, j))


def cut_all(array: NDArray[Any], tiles: list[TileIndex], spec: GridSpec) -> dict[TileIndex, NDArray[Any]]:
    """Return the tiles of an array over `spec`."""
    i, j = (round(o / spec.resolution) for o in spec.origin)
    return {(a, b): array[a * TILE - i :, b * TILE - j :][:TILE, :TILE] for a, b in tiles}
