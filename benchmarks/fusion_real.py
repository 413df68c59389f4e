"""What does fusing over time give on real recordings? Maps, trails, conflict as a check of poses, odometry.

    python benchmarks/fusion_real.py [--quick]

Three recordings, one after the other in time each: KITTI odometry 00 (6 scans), KITTI raw drive 0005 (24 scans, boxes
with track ids in the front camera's view) and SUSTechPOINTS (3 scans half a second apart, boxes all around). Nothing
was trained on them and no number of the mapper was chosen by them. They cannot be shipped: benchmarks/README.md says
where they go; what is not there is left out, and the output says so. Writes benchmarks/results/fusion_real.json and
docs/pictures/fusion_real.png (charts alone); pictures that show the scans go to runs/fusion_real/.

The reference of a frame is made of OTHER scans than those in the map, see `Case` and `reference`.
"""

from _run import DATA, OURS, PEER, PICTURES, RESULTS, TWIN, caption, environment, write_json

# isort: split
import argparse
import importlib.metadata
import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias, TypeVar

import numpy as np
from deep_real import CORE, ENOUGH, SPEC, Scene, Warnings, corners, kitti, scene, shares, sustech
from numpy.typing import NDArray

from ogm import EvidentialGrid, GridSpec, read_points
from ogm.evidence import conflict, cumulative, dempster, yager
from ogm.fusion import BinaryBayesMapper, EvidentialMapper
from ogm.geometric import RayISM
from ogm.metrics import score, accumulate
from ogm.state import predict_state
from ogm.plot import Panel, cells, masses, points
from ogm.plot import conflict as conflict_panel
from ogm.pose import inverse, pose, transform_points
from ogm.recordings import open_recording, truth_from_others
from ogm.truth import (
    FREE,
    MARGIN,
    OCCUPIED,
    boxes_over_points,
    cells_in_box,
    cells_in_boxes,
    move_boxes,
    widen_boxes,
)

MAP = GridSpec.centered(length=102.4, width=102.4, resolution=0.16)  # holds SPEC at any heading
SPAN = 10  # scans in a map: k-9 ... k
MOVING = 1.0  # [m/s] over its whole track, from which an object moves
KITTI_CAR = (2.6, 1.7)  # [m] |x|, |y| of KITTI's car with what sticks out
# Drive 0005: scan, x and y [m] of the middle of the front, heading [deg] of the car behind, read off pictures
FOLLOWER = np.array(
    [
        (0, -8.2, 1.80, -14),
        (4, -7.9, 1.70, -13),
        (8, -7.7, 1.30, -10),
        (11, -7.6, 0.85, -6),
        (14, -7.6, 0.45, -2),
        (17, -7.6, 0.10, 2),
        (20, -7.45, -0.20, 5),
        (23, -7.3, -0.60, 9),
    ]
)
FOLLOWER_SIZE = (4.3, 1.9, 1.5)  # [m] length, width, height
RAY, LITE = "RayISM", "DeepISM lite"
ALONE, DEFAULT = "scan alone", "default"
DEMPSTER, YAGER, CUMULATIVE = "Dempster", "Yager", "cumulative"
BAYES, MATCHED = "Bayes", "Bayes, matched"
COLOURS = {
    ALONE: TWIN,
    DEFAULT: OURS,
    DEMPSTER: "#c0202b",
    YAGER: "#7fbf7b",
    CUMULATIVE: "#b8860b",
    BAYES: PEER,
    MATCHED: "#92c5de",
}
SHIFTS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.5, 1.0)  # [m] by which a pose is made wrong: ahead, back, left, right
TURNS = (0.0, 0.25, 0.5, 1.0, 2.0)  # [deg] likewise, left and right
NEAR = (-20.0, 28.0, -24.0, 20.0)  # [m] x_min, x_max, y_min, y_max of the picture that compares rules
AGES = (0.15, 0.35, 0.65, 1.05, 1.55, 2.35)  # [s] upper edges of the bins of time since a cell was left
ODOMETRY = ("kiss-icp", "small-gicp")


class Recording(NamedTuple):
    """Scans that follow each other, their poses, and which objects move."""

    name: str
    folder: str
    scenes: list[Scene]  # each in the frame of its sensor
    stamps: NDArray[np.float64]  # (K,) [s]
    poses: NDArray[np.float64]  # (K, 4, 4) T_map_sensor, derived by registration
    cases: "list[Case]"
    how: str  # the reference is made, in words
    min_scans: int  # that must agree in a cell of the reference

    @property
    def height(self) -> float:
        """Height of the sensor above ground [m]: one vehicle, one height."""
        return float(np.median([one.height for one in self.scenes]))

    @property
    def speeds(self) -> dict[str, float]:
        """Speed of every object with two or more boxes [m/s]: its way from first to last box over the time."""
        seen: dict[str, list[tuple[float, NDArray[np.float64]]]] = {}
        for stamp, T, one in zip(self.stamps, self.poses, self.scenes, strict=True):
            for box, name in zip(one.boxes, one.ids, strict=True):
                middle = T @ [box[0], box[1], (box[5] + box[6]) / 2, 1]
                seen.setdefault(name, []).append((float(stamp), middle[:2]))
        return {
            name: float(np.hypot(*(track[-1][1] - track[0][1])) / (track[-1][0] - track[0][0]))
            for name, track in seen.items()
            if len(track) > 1
        }

    @property
    def moving(self) -> set[str]:
        """Ids of the objects that move."""
        return {name for name, speed in self.speeds.items() if speed > MOVING}

    def boxes(self, n: int, seen_from: int, names: set[str] | None = None) -> NDArray[np.float64]:
        """Return the boxes of scan n, all or some, in the sensor's frame of another scan, (B, 7)."""
        one = self.scenes[n]
        kept = [k for k, name in enumerate(one.ids) if names is None or name in names]
        return move_boxes(one.boxes[kept], inverse(self.poses[seen_from]) @ self.poses[n])


class Case(NamedTuple):
    """A map of some scans, seen from the last of them, and other scans that say what is there."""

    window: list[int]
    others: list[int]


def inflated(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Make boxes wider and longer on every side, by what annotation and de-skewing leave outside."""
    return widen_boxes(boxes, MARGIN)


def covered(boxes: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the cells that boxes cover."""
    return cells_in_boxes(boxes, SPEC)


# --- Recordings -------------------------------------------------------------------------------------


def derived_poses(folder: str) -> NDArray[np.float64]:
    """Read the poses that registration gave, in the axes that the points are read in."""
    return np.array([frame.T_map_sensor for frame in open_recording(DATA / folder)])


def recordings() -> Iterator[Recording]:
    """Read what is there of the three recordings."""
    folder = "kitti_odometry_00"
    paths = sorted((DATA / folder).glob("*.bin*"))
    if paths:
        scenes = [without_car(scene(path.name.split(".")[0], read_points(path))) for path in paths]
        cases = [Case([k - 2, k - 1, k], rest(len(paths), k - 2, k)) for k in range(2, len(paths))]
        how = "map of scans k-2 ... k, reference of the three others; nothing is labelled, so that nothing is removed"
        yield Recording(
            "KITTI odometry 00",
            folder,
            scenes,
            0.1 * np.arange(len(paths), dtype=np.float64),
            derived_poses(folder),
            cases,
            how,
            2,
        )
    scenes = [without_car(one) for one in kitti().get("KITTI, drive 0005", [])]
    if scenes:
        scenes = [with_follower(one, int(one.name) - 60) for one in scenes]
        folder, last = "kitti_raw_0005", len(scenes)
        cases = [
            Case([*range(k - SPAN + 1, k + 1)], rest(last, k - SPAN + 1, k)) for k in range(SPAN - 1, last)
        ]
        how = f"map of scans k-9 ... k, reference of the {last - SPAN} others without the boxes of moving objects"
        yield Recording(
            "KITTI drive 0005",
            folder,
            scenes,
            0.1 * np.arange(last, dtype=np.float64),
            derived_poses(folder),
            cases,
            how,
            2,
        )
    for scenes in sustech().values():
        folder = "sustechpoints"
        cases = [Case([0, 1], [2]), Case([1, 2], [0]), Case([0, 2], [1])]
        how = "leave-one-out: map of two scans, reference of the third without the boxes of moving objects"
        yield Recording(
            "SUSTechPOINTS",
            folder,
            scenes,
            0.5 * np.arange(3, dtype=np.float64),
            derived_poses(folder),
            cases,
            how,
            1,
        )


def without_car(one: Scene) -> Scene:
    """Drop what is left of the own car in KITTI's scans: 30 returns beside the doors, outside the usual box."""
    x, y = one.points[:, 0], one.points[:, 1]
    return one._replace(points=one.points[(np.abs(x) > KITTI_CAR[0]) | (np.abs(y) > KITTI_CAR[1])])


def with_follower(one: Scene, n: int) -> Scene:
    """Add the box of a car that follows 8 m behind: it has no label, as the camera looks ahead."""
    x, y, yaw = (np.interp(n, FOLLOWER[:, 0], FOLLOWER[:, k]) for k in (1, 2, 3))
    length, width, height = FOLLOWER_SIZE
    yaw = np.radians(yaw)
    middle = x - np.cos(yaw) * length / 2, y - np.sin(yaw) * length / 2
    box = [*middle, yaw, length, width, -one.height, height - one.height]
    return one._replace(
        boxes=np.vstack([one.boxes, box]), kinds=(*one.kinds, "car"), ids=(*one.ids, "follower, by hand")
    )


def rest(count: int, first: int, last: int) -> list[int]:
    """Return the numbers below `count` that do not lie in first ... last."""
    return [n for n in range(count) if not first <= n <= last]


# --- Reference --------------------------------------------------------------------------------------


def reference(one: Recording, k: int, others: Sequence[int]) -> NDArray[np.uint8]:
    """Say what some scans know about the cells around scan k: `ogm.truth.truth_from_scans`.

    Their points are brought to its frame by the derived poses, without those over moving boxes (and 0.3 m around).
    Heights are above the ground that `local_ground` finds in all of them together. Cells in moving boxes of scan k
    itself (and 0.3 m around) are ignored. Unlike the truth of `open_recording`, scan k itself is not asked.
    """
    clouds = []
    for n in others:
        cloud = one.scenes[n].points
        cloud = cloud[~boxes_over_points(cloud, inflated(one.boxes(n, n, one.moving)))]
        clouds.append(transform_points(inverse(one.poses[k]) @ one.poses[n], cloud))
    moving = one.boxes(k, k, one.moving)
    return truth_from_others(clouds, one.height, SPEC, moving, min_scans=one.min_scans).state


# --- Maps -------------------------------------------------------------------------------------------

Mapper: TypeAlias = EvidentialMapper | BinaryBayesMapper
AnyMapper = TypeVar("AnyMapper", EvidentialMapper, BinaryBayesMapper, Mapper)


def default_map() -> EvidentialMapper:
    """Make the mapper that users get by default, on a window that holds the view at any heading."""
    return EvidentialMapper(MAP)


def plain(rule: Callable[..., Any]) -> Callable[[], EvidentialMapper]:
    """Return maps of a rule in which what came stays as long as all else."""
    return lambda: EvidentialMapper(MAP, rule, moving_half_life=float("inf"))


def bayes_like_dempster() -> BinaryBayesMapper:
    """Make a Bayes filter that forgets, reads scans and is bounded as the map of Dempster's rule is."""
    twin = plain(dempster)()
    least = twin.min_unknown / (1 + twin.min_unknown)  # normalised plausibility of occupied at its most free
    return BinaryBayesMapper(MAP, twin.half_life[0], match="plausibility", limits=(least, 1 - least))


MAPPERS: dict[str, Callable[[], Mapper]] = {
    DEFAULT: default_map,
    DEMPSTER: plain(dempster),
    YAGER: plain(yager),
    CUMULATIVE: plain(cumulative),
    BAYES: lambda: BinaryBayesMapper(MAP),
    MATCHED: bayes_like_dempster,
}
KEYS = (
    *("iou_free", "iou_occupied", "iou_free_known", "iou_occupied_known"),
    *("false_free", "missed_occupied", "false_occupied", "brier", "ece"),
)
HIGHER = ("complete", "right", "iou_free", "iou_occupied", "iou_free_known", "iou_occupied_known")


def fuse(
    make: Callable[[], AnyMapper],
    grids: Sequence[EvidentialGrid],
    window: Sequence[int],
    stamps: NDArray[np.float64],
    poses: NDArray[np.float64],
) -> AnyMapper:
    """Make a map of some scans, in their order."""
    mapper = make()
    for n in window:
        mapper.update(grids[n], poses[n], stamp=float(stamps[n]))
    return mapper


def run_evaluation(grid: EvidentialGrid, state: NDArray[np.uint8]) -> dict[str, float]:
    """Compare a grid with a reference, on the cells that the reference knows.

    A cell is called what has most mass, unknown included. ``complete``: share of the cells that are called free or
    occupied; ``right``: called what the reference says; ``false free of called``: of the occupied cells that are
    called anything, those called free. The others are those of `ogm.metrics.METRICS`.
    """
    counts = accumulate(grid.mass, state)
    values = score(counts)
    known = counts.confusion[1:]
    return {
        "complete": float(known[:, 1:].sum() / known.sum()),
        "right": float((known[0, 1] + known[1, 2]) / known.sum()),
        "false free of called": float(known[1, 1] / known[1, 1:].sum()),
        **{key: values[key] for key in KEYS},
    }


def judge_maps(
    one: Recording,
    grids: dict[str, list[EvidentialGrid]],
    odometry: dict[str, NDArray[np.float64]],
    cases: Sequence[Case],
) -> dict[str, Any]:
    """Judge scans and maps against the references of all cases; and what maps make of moving objects."""
    rows: dict[str, list[dict[str, float]]] = {}
    boxes: dict[str, list[dict[str, float]]] = {}
    known = []
    for case in cases:
        k = case.window[-1]
        state = reference(one, k, case.others)
        known.append([np.count_nonzero(state == FREE), np.count_nonzero(state == OCCUPIED)])
        now: dict[str, EvidentialGrid] = {}
        for sensor, scans in grids.items():
            now[f"{sensor}, {ALONE}"] = scans[k]
            for name, make in MAPPERS.items():
                now[f"{sensor}, {name}"] = fuse(make, scans, case.window, one.stamps, one.poses).view(SPEC)
        controls = {f"poses of {name}": T for name, T in odometry.items()}
        controls["no poses"] = np.tile(np.eye(4), (len(one.poses), 1, 1))
        for name, poses in controls.items():
            made = fuse(default_map, grids[RAY], case.window, one.stamps, poses)
            now[f"{RAY}, {DEFAULT}, {name}"] = made.view(SPEC)
        one_scan = fuse(default_map, grids[RAY], [k], one.stamps, one.poses)
        now[f"{RAY}, {ALONE}, through a map"] = one_scan.view(SPEC)  # what turning it there and back costs
        for name, grid in now.items():
            rows.setdefault(name, []).append(run_evaluation(grid, state))
        scan = one.scenes[k]
        for n in np.flatnonzero((scan.returns >= ENOUGH) & scan.inside):
            if scan.ids[n] in one.moving:
                inner = np.maximum(scan.boxes[n, 3:5] - 2 * CORE, 0.01)
                for name, grid in now.items():
                    boxes.setdefault(name, []).append(
                        {
                            **shares(grid, cells_in_box(scan.boxes[n], SPEC)),
                            "free in the core": shares(
                                grid, cells_in_box([*scan.boxes[n, :3], *inner], SPEC)
                            )["free"],
                        }
                    )
    return {
        "cases": [{"map of": case.window, "reference of": case.others} for case in cases],
        "reference cells": {
            "free": float(np.mean([n for n, _ in known])),
            "occupied": float(np.mean([n for _, n in known])),
        },
        "mean": {name: mean_of(found) for name, found in rows.items()},
        "paired": {
            f"{sensor}: {first} minus {second}": compare(
                rows[f"{sensor}, {first}"], rows[f"{sensor}, {second}"]
            )
            for sensor in grids
            for first, second in (
                (DEFAULT, ALONE),
                (DEFAULT, BAYES),
                (DEFAULT, DEMPSTER),
                (DEMPSTER, ALONE),
                (BAYES, ALONE),
                (DEMPSTER, BAYES),
                (DEMPSTER, MATCHED),
            )
        },
        "moving boxes": {
            "boxes": len(next(iter(boxes.values()), [])),
            "models": {name: mean_of(found) for name, found in boxes.items()},
        },
    }


def mean_of(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the means of every column; rows without a value are left out of it."""
    return {key: round(float(np.nanmean([row[key] for row in rows])), 5) for key in rows[0]}


def compare(first: list[dict[str, float]], second: list[dict[str, float]]) -> dict[str, Any]:
    """Compare two models frame by frame. The frames share scans, so that no interval is worth printing."""
    result = {}
    for key in first[0]:
        gap = np.array([a[key] - b[key] for a, b in zip(first, second, strict=True)])
        better = gap > 1e-9 if key in HIGHER else gap < -1e-9
        result[key] = {
            "mean": round(float(gap.mean()), 5),
            "least": round(float(gap.min()), 5),
            "most": round(float(gap.max()), 5),
            "frames better": int(better.sum()),
            "of": len(gap),
        }
    return result


# --- Trails -----------------------------------------------------------------------------------------


class Left(NamedTuple):
    """Cells that moving objects left, seen from scan k."""

    age: NDArray[np.float64]  # (nx, ny) seconds since a box covered the cell last; inf: never, or not judged
    marked: NDArray[np.bool_]  # (nx, ny) of these, those that a scan marked while they were covered


def left_cells(one: Recording, k: int, scans: Sequence[EvidentialGrid], state: NDArray[np.uint8]) -> Left:
    """Find the cells that boxes of moving objects covered before, that no box covers, and that are free now."""
    age, marked = np.full(SPEC.shape, np.inf), np.zeros(SPEC.shape, bool)
    clear = (state == FREE) & ~covered(inflated(one.boxes(k, k)))
    for j in reversed(range(k)):
        ix, iy = np.nonzero(covered(one.boxes(j, k, one.moving)) & clear)
        age[ix, iy] = np.minimum(age[ix, iy], one.stamps[k] - one.stamps[j])
        x, y = SPEC.cell_centers
        middle = np.column_stack([x[ix, 0], y[0, iy], np.full(len(ix), -one.height)])
        there = transform_points(inverse(one.poses[j]) @ one.poses[k], middle)
        seen = SPEC.contains(there[:, 0], there[:, 1])
        hit = predict_state(scans[j].mass)[SPEC.index(*there[seen, :2].T)] == OCCUPIED
        marked[ix[seen][hit], iy[seen][hit]] = True
    return Left(age, marked)


def trails(one: Recording, grids: dict[str, list[EvidentialGrid]], step: int) -> dict[str, Any]:
    """Count what is left in maps of all scans so far behind moving objects, by the time since they left.

    What is free is known from all scans, those in the map included: this is about time, not about accuracy.
    """
    edges = np.array([0, *AGES])
    result: dict[str, Any] = {"up to [s]": list(AGES), "models": {}}
    for sensor, scans in grids.items():
        mappers = {name: make() for name, make in MAPPERS.items()}
        tallies = {name: np.zeros((2, len(AGES), 4)) for name in (ALONE, *mappers)}
        cleared = np.zeros(2)
        for k in range(len(scans)):
            for mapper in mappers.values():
                mapper.update(scans[k], one.poses[k], stamp=float(one.stamps[k]))
            if k % step or not k:
                continue
            left = left_cells(one, k, scans, trail_state(one, k))
            views = {ALONE: scans[k], **{name: mapper.view(SPEC) for name, mapper in mappers.items()}}
            for row, chosen in enumerate((np.isfinite(left.age), np.isfinite(left.age) & left.marked)):
                at = np.digitize(left.age[chosen], edges) - 1
                for name, grid in views.items():
                    call, p = predict_state(grid.mass)[chosen], grid.probability[chosen]
                    for column, what in enumerate(
                        (call >= 0, p > 0.5 + 1e-6, call == OCCUPIED, call != FREE)
                    ):
                        tallies[name][row, :, column] += np.bincount(at[what], minlength=len(AGES))[
                            : len(AGES)
                        ]
            cleared += [np.isfinite(left.age).sum(), (np.isfinite(left.age) & left.marked).sum()]
        for name, found in tallies.items():
            result["models"][f"{sensor}, {name}"] = {
                which: {
                    "cells": found[row, :, 0].astype(int).tolist(),
                    **{
                        what: [
                            round(float(v), 4) if n else None
                            for v, n in zip(
                                found[row, :, column] / np.maximum(found[row, :, 0], 1),
                                found[row, :, 0],
                                strict=True,
                            )
                        ]
                        for column, what in (
                            (1, "likelier occupied"),
                            (2, "called occupied"),
                            (3, "not called free"),
                        )
                    },
                    "all ages": {
                        what: round(float(found[row, :, column].sum() / max(found[row, :, 0].sum(), 1)), 4)
                        for column, what in (
                            (1, "likelier occupied"),
                            (2, "called occupied"),
                            (3, "not called free"),
                        )
                    },
                }
                for row, which in enumerate(("all", "marked"))
            }
    return result


_STATES: dict[tuple[str, int], NDArray[np.uint8]] = {}


def trail_state(one: Recording, k: int) -> NDArray[np.uint8]:
    """Return the reference of all scans, seen from scan k."""
    if (one.name, k) not in _STATES:
        _STATES[one.name, k] = reference(one, k, range(len(one.scenes)))
    return _STATES[one.name, k]


# --- Conflict as a check of poses -------------------------------------------------------------------


def wrong_poses() -> dict[str, dict[str, list[NDArray[np.float64]]]]:
    """Return errors of a pose, by kind and size: each size in every direction."""
    shifts = {f"{d:g}": [pose(x=d), pose(x=-d), pose(y=d), pose(y=-d)] if d else [pose()] for d in SHIFTS}
    turns = {f"{a:g}": [pose(yaw=np.radians(a)), pose(yaw=-np.radians(a))] if a else [pose()] for a in TURNS}
    return {"shift [m]": shifts, "turn [deg]": turns}


def contradiction(
    mapper: EvidentialMapper, scan: EvidentialGrid, T: NDArray[np.float64], where: NDArray[np.bool_]
) -> float:
    """Return the mean conflict of a scan with a map, over the cells that both know (unknown below 1/2)."""
    before = mapper.view(SPEC, T)
    both = where & (before.unknown < 0.5) & (scan.unknown < 0.5)
    return float(conflict(before.mass[both], scan.mass[both]).mean())


def check_poses(
    one: Recording,
    scans: Sequence[EvidentialGrid],
    odometry: dict[str, NDArray[np.float64]],
    cases: Sequence[Case],
) -> dict[str, Any]:
    """Say how much the last scan of a map contradicts the ones before, with right and wrong poses.

    Only the last pose is made wrong. Cells that a moving object covers in any of the scans do not count. No label
    is used beyond that, and the reference not at all.
    """
    curves: dict[str, dict[str, list[float]]] = {}
    worse: dict[str, dict[str, list[float]]] = {}
    others: dict[str, list[float]] = {name: [] for name in ("derived", *odometry)}
    for case in cases:
        k, before = case.window[-1], case.window[:-1]
        still = ~covered(np.concatenate([inflated(one.boxes(j, k, one.moving)) for j in case.window]))
        mapper = fuse(default_map, scans, before, one.stamps, one.poses)
        right = contradiction(mapper, scans[k], one.poses[k], still)
        others["derived"].append(right)
        for kind, sizes in wrong_poses().items():
            for size, errors in sizes.items():
                found = [contradiction(mapper, scans[k], one.poses[k] @ error, still) for error in errors]
                curves.setdefault(kind, {}).setdefault(size, []).append(float(np.mean(found)))
                worse.setdefault(kind, {}).setdefault(size, []).append(
                    float(np.mean(np.array(found) > right))
                )
        for name, poses in odometry.items():
            made = fuse(default_map, scans, before, one.stamps, poses)
            others[name].append(contradiction(made, scans[k], poses[k], still))
    return {
        "mean conflict of known cells": {
            kind: {size: round(float(np.mean(found)), 5) for size, found in sizes.items()}
            for kind, sizes in curves.items()
        },
        "share of wrong poses with more conflict than the derived one": {
            kind: {size: round(float(np.mean(found)), 4) for size, found in sizes.items() if size != "0"}
            for kind, sizes in worse.items()
        },
        "poses of": {name: round(float(np.mean(found)), 5) for name, found in others.items()},
        "frames with less conflict than with derived poses": {
            name: f"{int(np.sum(np.array(found) < np.array(others['derived'])))} of {len(found)}"
            for name, found in others.items()
            if name != "derived"
        },
    }


# --- Odometry ---------------------------------------------------------------------------------------


def run_odometry(one: Recording) -> dict[str, NDArray[np.float64]]:
    """Let others estimate the poses from the scans alone, from the first scan on; leave out what is not there."""
    result = {}
    for method in ODOMETRY:
        try:
            from ogm.fusion.odometry import odometry

            found = odometry([scan.points for scan in one.scenes], one.stamps, method=method)
        except ImportError as error:
            print(f"left out: {method}: {error}")
        except (RuntimeError, ValueError) as error:
            print(f"left out: {method} on {one.name}: {error}")
        else:
            result[method] = one.poses[0] @ inverse(found.poses[0]) @ found.poses
    return result


def apart(first: NDArray[np.float64], second: NDArray[np.float64]) -> tuple[float, float]:
    """Return how far two transforms lie apart: [m], [deg]."""
    gap = inverse(first) @ second
    return float(np.linalg.norm(gap[:3, 3])), float(
        np.degrees(np.arccos(np.clip((np.trace(gap[:3, :3]) - 1) / 2, -1, 1)))
    )


def compare_poses(one: Recording, poses: NDArray[np.float64]) -> dict[str, Any]:
    """Compare poses with the derived ones: step by step, and at the end."""
    steps = [
        apart(inverse(a) @ b, inverse(p) @ q)
        for a, b, p, q in zip(one.poses[:-1], one.poses[1:], poses[:-1], poses[1:], strict=True)
    ]
    metres, degrees = np.array(steps).T
    way = float(np.linalg.norm(np.diff(one.poses[:, :3, 3], axis=0), axis=1).sum())
    end = apart(inverse(one.poses[0]) @ one.poses[-1], inverse(poses[0]) @ poses[-1])
    return {
        "path [m]": round(way, 3),
        "step [m]": {"median": round(float(np.median(metres)), 4), "most": round(float(metres.max()), 4)},
        "step [deg]": {"median": round(float(np.median(degrees)), 4), "most": round(float(degrees.max()), 4)},
        "each step [m]": [round(float(v), 4) for v in metres],
        "each step [deg]": [round(float(v), 4) for v in degrees],
        "end [m]": round(end[0], 4),
        "end [deg]": round(end[1], 4),
        "end, of the path": round(end[0] / way, 5),
    }


# --- Pictures ---------------------------------------------------------------------------------------


def panels_of(one: Recording, case: Case, scans: Sequence[EvidentialGrid]) -> list[Panel]:
    """Show a frame: points, scan, map, conflict, reference."""
    k = case.window[-1]
    mapper = fuse(default_map, scans, case.window, one.stamps, one.poses)
    dots = GridSpec.centered(length=81.92, width=56.32, resolution=0.32)
    return [
        points(one.scenes[k].points, dots, f"{one.name}, scan {one.scenes[k].name}", ground_z=-one.height),
        masses(scans[k], "the scan alone"),
        masses(mapper.view(SPEC), f"map of {len(case.window)} scans"),
        conflict_panel(mapper.conflict_view(SPEC), SPEC, "conflict"),
        reference_panel(reference(one, k, case.others), f"reference; other scans: {len(case.others)}"),
    ]


def reference_panel(state: NDArray[np.uint8], title: str) -> Panel:
    """Show a reference."""
    legend = {"free": (0.1, 0.8, 0.2), "occupied": (0.93, 0.16, 0.16), "not judged": (0.25, 0.25, 0.25)}
    colours = np.full((*state.shape, 3), 0.25)
    colours[state == FREE], colours[state == OCCUPIED] = legend["free"], legend["occupied"]
    return cells(colours, SPEC, title, legend)


def gallery(
    rows: list[tuple[Recording, int, list[Panel]]],
    path: Path,
    around: tuple[float, float, float, float] | None = None,
) -> None:
    """Draw rows of panels with the boxes of moving objects; `around` crops: x_min, x_max, y_min, y_max."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    columns = max(len(panels) for _, _, panels in rows)
    figure = Figure(
        figsize=(3.6 * columns, (5.2 if around is None else 3.6) * len(rows) + 0.6), layout="constrained"
    )
    axes = figure.subplots(len(rows), columns, squeeze=False)
    for line, (one, k, panels) in zip(axes, rows, strict=True):
        for ax, panel in zip(line, panels, strict=False):
            x_min, x_max, y_min, y_max = SPEC.extent
            ax.imshow(panel.image, extent=(y_max, y_min, x_min, x_max), interpolation="nearest")
            ax.plot(0, 0, "^", markersize=6, color="white", markeredgecolor="black", markeredgewidth=0.8)
            for j, style in ((k, "-"), (max(k - SPAN + 1, 0), ":")):
                for box in one.boxes(j, k, one.moving):
                    x, y = corners(box)[[0, 1, 2, 3, 0]].T
                    ax.plot(y, x, style, color="white", linewidth=0.9)
            if around is not None:
                x_min, x_max, y_min, y_max = around
            ax.set_xlim(y_max, y_min)
            ax.set_ylim(x_min, x_max)
            ax.tick_params(labelsize=7)
            ax.set_title(panel.title, fontsize=9)
    legend: dict[str, tuple[float, float, float]] = {}
    for _, _, panels in rows:
        for panel in panels[1:]:
            legend |= panel.legend
    figure.legend(
        handles=[Patch(facecolor=colour, edgecolor="0.6", label=name) for name, colour in legend.items()],
        loc="outside lower center",
        ncols=len(legend),
        frameon=False,
        fontsize=9,
        title="boxes: moving objects now (line) and in the oldest scan of the map (dots)",
        title_fontsize=9,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def chart(record: dict[str, Any], path: Path) -> None:
    """Draw the figures: maps, trails, conflict, poses."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(17, 10), layout="constrained")
    axes = figure.subplots(2, 3)
    found = record["recordings"]
    main_one = "KITTI drive 0005" if "KITTI drive 0005" in found else next(iter(found))
    _chart_maps(axes[0, 0], found, main_one)
    _chart_boxes(axes[0, 1], found[main_one], main_one)
    axes[0, 2].set_visible("trails" in found[main_one])
    if "trails" in found[main_one]:
        _chart_trails(axes[0, 2], found[main_one]["trails"], main_one)
    _chart_places(axes[1, 0], found)
    for name, colour in zip(found, (PEER, OURS, "#b8860b"), strict=False):
        for kind, style, scale in (("shift [m]", "o-", 1.0), ("turn [deg]", "s:", 0.5)):
            curve = found[name]["conflict"]["mean conflict of known cells"][kind]
            axes[1, 1].plot(
                [float(size) * scale for size in curve],
                [100 * value for value in curve.values()],
                style, color=colour, label=f"{name}, {kind}" + ("" if scale == 1 else ": half of it shown"),
            )  # fmt: skip
    axes[1, 1].set_xlabel("error of the last pose: shift [m]; turn [deg] / 2")
    axes[1, 1].set_ylabel("mean conflict with the map, known static cells [%]")
    axes[1, 1].set_title("Conflict tells a wrong pose from a right one", fontsize=11)
    axes[1, 1].set_ylim(bottom=0)
    axes[1, 1].legend(fontsize=8)
    ax = axes[1, 2]
    for n, name in enumerate(found):
        for method, marker, colour in zip(ODOMETRY, ("o", "x"), (PEER, OURS), strict=True):
            if method in found[name]["odometry"]:
                one = found[name]["odometry"][method]
                ax.plot(
                    one["each step [m]"],
                    one["each step [deg]"],
                    marker,
                    color=colour,
                    alpha=0.35 + 0.3 * n,
                    label=f"{method}, {name}",
                )
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel("difference of a step, scan to scan [m]")
    ax.set_ylabel("[deg]")
    ax.set_title("Odometry against the derived poses", fontsize=11)
    if ax.lines:
        ax.legend(fontsize=8)
    figure.supxlabel(caption(record), fontsize=7.5, color="#555555")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)


def _chart_maps(ax: Any, found: dict[str, Any], main_one: str) -> None:
    groups = (
        ("complete", "known cells\nof the reference"), ("iou_occupied", "IoU occupied"), ("iou_free", "IoU free"),
        ("false_free", "false free"), ("false_occupied", "false occupied"),
    )  # fmt: skip
    names = (ALONE, *MAPPERS)
    for n, name in enumerate(names):
        values = [100 * found[main_one]["maps"]["mean"][f"{RAY}, {name}"][key] for key, _ in groups]
        places = np.arange(len(groups)) + (n - (len(names) - 1) / 2) * 0.12
        ax.bar(places, values, 0.115, color=COLOURS[name], label=name)
        for place, value in zip(places, values, strict=True):
            ax.text(
                place,
                value + 1,
                f"{value:.0f}" if value >= 9.95 else f"{value:.1f}",
                ha="center",
                fontsize=5.5,
            )
    ax.set_xticks(range(len(groups)), [title for _, title in groups], fontsize=8)
    ax.set_ylabel("[%]")
    ax.set_title(f"{main_one}: {RAY}, mean of {len(found[main_one]['maps']['cases'])} frames", fontsize=11)
    ax.legend(fontsize=8)


def _chart_places(ax: Any, found: dict[str, Any]) -> None:
    """Draw false free and IoU occupied of all recordings."""
    groups = [
        (name, key, title)
        for key, title in (("iou_occupied", "IoU occupied"), ("false_free", "false free"))
        for name in found
    ]
    names = (ALONE, *MAPPERS)
    for n, which in enumerate(names):
        values = [100 * found[name]["maps"]["mean"][f"{RAY}, {which}"][key] for name, key, _ in groups]
        places = np.arange(len(groups)) + (n - (len(names) - 1) / 2) * 0.12
        ax.bar(places, values, 0.115, color=COLOURS[which], label=which)
    ticks = [f"{title}\n{name.replace(' ', chr(10), 1)}" for name, _, title in groups]
    ax.set_xticks(range(len(groups)), ticks, fontsize=8)
    ax.set_ylabel("[%]")
    ax.set_title(f"All recordings, {RAY}: more is better (left), less is better (right)", fontsize=11)
    ax.legend(fontsize=8)


def _chart_boxes(ax: Any, found: dict[str, Any], name: str) -> None:
    models = found["maps"]["moving boxes"]["models"]
    names = [
        (sensor, which)
        for sensor in (RAY, LITE)
        for which in (ALONE, *MAPPERS)
        if f"{sensor}, {which}" in models
    ]
    for n, (sensor, which) in enumerate(names):
        bottom = 0.0
        for key, colour in (("free", "#4fae5b"), ("occupied", "#d7403a"), ("neither", "#d9d9d9")):
            value = 100 * models[f"{sensor}, {which}"][key]
            ax.bar(n, value, 0.8, bottom=bottom, color=colour)
            if value > 4:
                ax.text(n, bottom + value / 2, f"{value:.0f}", ha="center", va="center", fontsize=8)
            bottom += value
    ax.set_xticks(
        range(len(names)),
        [f"{which}\n{sensor}" for sensor, which in names],
        fontsize=7,
        rotation=60,
        ha="right",
    )
    ax.set_ylabel("cells [%]")
    count = found["maps"]["moving boxes"]["boxes"]
    ax.set_title(
        f"{name}: moving objects now, {count} boxes:\ncalled free (green), occupied (red), neither (grey)",
        fontsize=11,
    )


def _chart_trails(ax: Any, found: dict[str, Any], name: str) -> None:
    edges = np.array([0, *found["up to [s]"]])
    for which in (ALONE, *MAPPERS):
        entry = found["models"][f"{RAY}, {which}"]["marked"]
        at = [n for n, count in enumerate(entry["cells"]) if count >= 10]
        ax.plot(
            (edges[:-1] + edges[1:])[at] / 2,
            [100 * entry["likelier occupied"][n] for n in at],
            "o-",
            color=COLOURS[which],
            label=which,
        )
    ax.set_xlabel("since the object left the cell [s]")
    ax.set_ylabel("still likelier occupied than free [%]")
    ax.set_title(f"{name}: trails, {RAY}\ncells that a scan had marked on moving objects", fontsize=11)
    ax.set_ylim(bottom=0)
    ax.legend(fontsize=8)


# --- Report -----------------------------------------------------------------------------------------

COLUMNS = {
    "complete": "complete",
    "right": "right",
    "iou_free": "IoU free",
    "iou_occupied": "IoU occ.",
    "iou_free_known": "IoU free, P",
    "iou_occupied_known": "IoU occ., P",
    "false_free": "false free",
    "false free of called": "..., of those called",
    "false_occupied": "false occ.",
    "brier": "Brier",
    "ece": "ECE",
}


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = ["| " + " | ".join(head) + " |", "|---" + "|---:" * (len(head) - 1) + "|"]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def percent(value: float | None) -> str:
    """Write a share."""
    return "" if value is None else f"{100 * value:.1f}"


def report(record: dict[str, Any]) -> None:
    """Print the result as Markdown."""
    for name, found in record["recordings"].items():
        maps = found["maps"]
        print(
            f"\n## {name}\n\n{found['how']}; {len(maps['cases'])} maps; moving: {', '.join(found['moving']) or '-'}\n"
        )
        rows = [[which, *(percent(row[key]) for key in COLUMNS)] for which, row in maps["mean"].items()]
        print(table(["cells known to the reference [%]", *COLUMNS.values()], rows))
        print("\nframe by frame, difference (frames better)")
        for pair, entry in maps["paired"].items():
            parts = [
                f"{COLUMNS[key]} {100 * entry[key]['mean']:+.1f} ({entry[key]['frames better']} of {entry[key]['of']})"
                for key in (
                    "complete",
                    "right",
                    "iou_free",
                    "iou_occupied",
                    "false_free",
                    "false free of called",
                    "brier",
                )
            ]
            print(f"  {pair}: {', '.join(parts)}")
        if maps["moving boxes"]["boxes"]:
            keys = ("occupied", "free", "free in the core", "neither")
            rows = [
                [which, *(percent(row[key]) for key in keys)]
                for which, row in maps["moving boxes"]["models"].items()
            ]
            print(f"\nmoving objects now, {maps['moving boxes']['boxes']} boxes\n")
            print(table(["cells [%]", *keys], rows))
        if "trails" in found:
            report_trails(found["trails"])
        report_poses(found["conflict"], found["odometry"])
    for message, where in record["warnings"].items():
        print(f"warning on {where}: {message}")
    print("\n" + NOTE)


def report_trails(found: dict[str, Any]) -> None:
    """Print what is left behind moving objects."""
    edges = [0, *found["up to [s]"]]
    head = ["cells left [%]", *(f"{a:g}-{b:g} s" for a, b in zip(edges[:-1], edges[1:], strict=True)), "all"]
    for which, what in (
        ("marked", "likelier occupied"),
        ("marked", "called occupied"),
        ("marked", "not called free"),
        ("all", "likelier occupied"),
    ):
        rows = []
        for sensor in (RAY, LITE):
            mine = {name: row[which] for name, row in found["models"].items() if name.startswith(sensor)}
            if mine:
                counts = next(iter(mine.values()))["cells"]
                rows.append([f"{sensor}: cells", *map(str, counts), str(sum(counts))])
            for name, row in mine.items():
                rows.append([name, *map(percent, row[what]), percent(row["all ages"][what])])
        print(f"\ntrails, {which} cells, {what}\n\n" + table(head, rows))


def report_poses(conflict_: dict[str, Any], odometry: dict[str, Any]) -> None:
    """Print what conflict says about poses, and how far odometry lies from the derived ones."""
    print("\nconflict of the last scan with the map before [%], static known cells")
    key = "share of wrong poses with more conflict than the derived one"
    for kind, curve in conflict_["mean conflict of known cells"].items():
        worse = conflict_[key][kind]
        parts = [
            f"{size}: {100 * value:.2f}" + (f" ({percent(worse[size])} % have more)" if size in worse else "")
            for size, value in curve.items()
        ]
        print(f"  {kind}: {', '.join(parts)}")
    less = conflict_["frames with less conflict than with derived poses"]
    print(f"  poses of: {conflict_['poses of']}; less than with the derived ones: {less}")
    for method, entry in odometry.items():
        print(
            f"  {method}: { {name: value for name, value in entry.items() if not name.startswith('each')} }"
        )


# --- Command ----------------------------------------------------------------------------------------

NOTE = (
    "The reference is of the same sensor as the maps, from a few metres away: it shares its blind spots and its\n"
    "registration, knows cells with returns only, and takes RayISM's estimate of the ground (on many scans, with a\n"
    "higher threshold). Objects without a box (drive 0005: all that the front camera does not see, but for the car\n"
    "behind, boxed by hand) stay in it if they stood long enough; KITTI 00 has no box at all. Frames of one drive\n"
    "share scans: their number says little about how sure a mean is. Three places in all."
)


def models(height: float, quick: bool) -> dict[str, Callable[[NDArray[np.float32]], EvidentialGrid]]:
    """Return the sensor models, with their defaults."""
    result: dict[str, Callable[[NDArray[np.float32]], EvidentialGrid]] = {
        RAY: RayISM(SPEC, sensor_height=height)
    }
    if not quick:
        try:
            from ogm.deep import DeepISM

            result[LITE] = DeepISM.load("lite", spec=SPEC, sensor_height=height)
        except ImportError as error:
            print(f"left out: {LITE}: {error}")
    return result


def look_at(one: Recording, options: argparse.Namespace) -> tuple[dict[str, Any], list[list[Any]]]:
    """Answer all questions on one recording."""
    print(f"{one.name}: {len(one.scenes)} scans, {one.how}", flush=True)
    cases = one.cases[:: 7 if options.quick else 1]
    grids = {
        name: [model(scan.points) for scan in one.scenes]
        for name, model in models(one.height, options.quick).items()
    }
    odometry = run_odometry(one)
    found: dict[str, Any] = {
        "how": one.how,
        "sensor height [m]": round(one.height, 3),
        "speeds [m/s]": {name: round(speed, 2) for name, speed in one.speeds.items()},
        "moving": sorted(one.moving),
        "maps": judge_maps(one, grids, odometry, cases),
        "conflict": check_poses(one, grids[RAY], odometry, cases),
        "odometry": {name: compare_poses(one, poses) for name, poses in odometry.items()},
    }
    if one.moving:
        found["trails"] = trails(one, grids, 6 if options.quick and len(one.scenes) > 6 else 1)
    middle = cases[len(cases) // 2]
    rows: list[list[Any]] = [[one, middle.window[-1], panels_of(one, middle, grids[RAY])]]
    last = cases[-1]
    rows.append(
        [
            one,
            last.window[-1],
            [masses(grids[RAY][last.window[-1]], ALONE)]
            + [
                masses(fuse(make, grids[RAY], last.window, one.stamps, one.poses).view(SPEC), name)
                for name, make in MAPPERS.items()
            ],
        ]
    )
    return found, rows


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="a few frames, without the network")
    parser.add_argument("--out", type=Path, default=RESULTS / "fusion_real.json", help="where the figures go")
    parser.add_argument(
        "--picture", type=Path, default=PICTURES / "fusion_real.png", help="where the charts go"
    )
    parser.add_argument(
        "--galleries",
        type=Path,
        default=Path("runs/fusion_real"),
        help="folder for pictures of the scans: their licences are not the project's",
    )
    options = parser.parse_args()
    record = environment()
    for package in ("torch", "matplotlib", "kiss-icp", "small_gicp"):
        try:
            record["versions"][package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            print(f"not installed: {package}")
    record["note"] = NOTE
    heard = Warnings()
    logging.getLogger("ogm").addHandler(heard)
    record["recordings"] = {}
    overview, rules = [], []
    for one in recordings():
        heard.scan = one.name
        record["recordings"][one.name], (first, second) = look_at(one, options)
        overview.append(tuple(first))
        rules.append(tuple(second))
    record["warnings"] = heard.said
    for folder in ("kitti_odometry_00", "kitti_raw_0005", "sustechpoints"):
        if not (DATA / folder).is_dir():
            print(f"left out: {folder}: not under {DATA}")
    if not record["recordings"]:
        print("nothing to look at: benchmarks/README.md says which recordings are needed, and where")
        return
    write_json(options.out, record)
    gallery(overview, options.galleries / "overview.png")
    gallery(rules, options.galleries / "rules.png", NEAR)
    chart(record, options.picture)
    report(record)
    print(f"\nwrote {options.out}, {options.picture} and pictures of the scans in {options.galleries}")


if __name__ == "__main__":
    main()
