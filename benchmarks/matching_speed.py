"""How long does it take to match the moving groups of a scan with earlier scans? Beside scipy's distance transform.

    python benchmarks/matching_speed.py [--rounds N]

One core, 640 x 448 cells of 0.16 m, 30 moving groups among walls, four earlier scans. Writes
benchmarks/results/matching_speed.json.
"""

import _run as run  # first: it sets the number of threads

# isort: split
from typing import Any

import numpy as np
from _timing import Contender, measure
from numpy.typing import NDArray
from scipy import ndimage

from ogm.fusion.dynamic.groups import capped_distance, find_groups
from ogm.fusion.dynamic.matching import MatchSettings, match_velocities
from ogm.fusion.dynamic.scan_history import ScanCells

SHAPE, SIDE = (640, 448), 0.16  # [cells], [m]
AGES = (0.1, 0.2, 0.3, 0.4)  # [s]
GROUPS = {"pedestrian": (15, 5, 4, 1.4), "bicycle": (5, 11, 2, 5.0), "car": (10, 28, 11, 8.0)}  # number, cells, m/s
KEPT = 0.8  # share of the cells that a scan measures


def outline(length: int, width: int) -> NDArray[np.int64]:
    """Return the cells of two sides of a box."""
    return np.array([(i, 0) for i in range(length)] + [(0, j) for j in range(1, width)])


def scene(rng: np.random.Generator) -> tuple[list[NDArray[np.bool_]], NDArray[np.bool_]]:
    """Return the occupied cells of scans, newest first, and those of what moves in the newest."""
    masks = [np.zeros(SHAPE, bool) for _ in (0.0, *AGES)]
    moving = np.zeros(SHAPE, bool)
    places = iter(rng.permutation([(x, y) for x in range(60, 580, 74) for y in range(60, 400, 66)]))
    for count, length, width, speed in GROUPS.values():
        for _ in range(count):
            place, heading = next(places), rng.uniform(-np.pi, np.pi)
            velocity = speed * np.array([np.cos(heading), np.sin(heading)])
            for mask, age in zip(masks, (0.0, *AGES), strict=True):
                x, y = np.round(outline(length, width) + place - velocity * age / SIDE).astype(int).T
                mask[x, y] = True
            x, y = (outline(length, width) + place).T
            moving[x, y] = True
    for mask in masks:
        mask[:, 40:440:66] = True  # walls
        mask &= rng.random(SHAPE) < KEPT
    return masks, moving & masks[0]


def main() -> None:
    parser = run.Parser(__doc__, rounds=30)
    given = parser.parse_args()
    record: dict[str, Any] = run.environment("dynamic")
    (now, *before), moving = scene(np.random.default_rng(0))
    nothing = np.zeros(SHAPE, bool)
    scan, earlier = (
        ScanCells(now, nothing, 0.0),
        [ScanCells(mask, nothing, age) for mask, age in zip(before, AGES, strict=True)],
    )
    out, copies = np.empty(SHAPE, np.uint8), [mask.copy() for mask in before]
    bits, few = now.view(np.uint8), moving.view(np.uint8)
    contenders = {
        "match_velocities": Contender(lambda _: match_velocities(scan, moving, earlier, SIDE)),
        "... up to 30 m/s": Contender(
            lambda _: match_velocities(scan, moving, earlier, SIDE, MatchSettings(max_speed=30.0))
        ),
        "... all groups": Contender(lambda _: match_velocities(scan, now, earlier, SIDE)),
        "find_groups": Contender(lambda _: find_groups(bits, few, 5, 5)),
        "capped_distance, one scan": Contender(lambda _: capped_distance(bits, 3.0, out)),
        "scipy distance, one scan": Contender(lambda _: ndimage.distance_transform_edt(~now)),
        "copy of the masks": Contender(lambda _: [np.copyto(a, b) for a, b in zip(copies, before, strict=True)]),
    }
    times = measure(contenders, given.rounds)
    match = match_velocities(scan, moving, earlier, SIDE)
    record["moving groups"], record["cells in them"] = len(match.valid), int((match.label > 0).sum())
    record["matched"], record["occupied cells"] = int(match.valid.sum()), int(now.sum())
    record["milliseconds"] = times
    run.write_record(given.out, record)


if __name__ == "__main__":
    main()
