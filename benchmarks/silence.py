"""Does a lidar's map clear in fog what the lidar does not see? Drives in clear air and in fog, with silence or without.

    python benchmarks/silence.py [--drives N] [--scans N] [--seed N] [--keep FOLDER] [--out FILE] [--before FILE]

Drives of `radar_far.py`, or of another seed, their lidar alone. Compared are the last scans of each drive and the map
of all (`DynamicMapper`): by `RayISM` with beams without echo, and without ("echoes alone", `no_return_weight` 0). Scans
are kept in --keep, so that an earlier version of ogm can map the same ones (`PYTHONPATH=FOLDER`): --before takes its
record over. Writes benchmarks/results/silence.json.
"""

import _run as run  # first: it sets the number of threads
import radar_far

# isort: split
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm import Frame, GridSpec, Mount, Scan
from ogm.fusion import DynamicMapper, rolling_window, update_map
from ogm.geometric import RayISM
from ogm.metrics import ConfusionSums, accumulate, distances, score
from ogm.simulation.lidar import Weather
from ogm.simulation.moments import set_up
from ogm.simulation.plan import SEQUENCE, moment
from ogm.state import CellState

SPEC = GridSpec.centered()
SKIES = {
    "clear": Weather(),
    "fog, 100 m": Weather(fog=100.0),
    "fog, 50 m": Weather(fog=50.0),
    "fog, 20 m": Weather(fog=20.0),
}
WAYS = {"with silence": {}, "echoes alone": {"no_return_weight": 0.0}}
METRICS = ("nll", "brier", "false_free", "iou_free", "iou_occupied", "missed_occupied")
LAST = 3  # scans of a drive that are compared with their truth


class Drive(NamedTuple):
    """Scans of a drive under each sky, with poses, and the true states around the last ones by number."""

    frames: dict[str, list[Frame]]
    states: dict[int, NDArray[np.uint8]]


def drive(sequence: int, scans: int, folder: Path) -> Drive:
    """Simulate a drive, or read it from a folder."""
    path = folder / f"{radar_far.PLAN.seed}-{sequence}-{scans}.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(path, **dict(_simulated(sequence, scans)))
    frames: dict[str, list[Frame]] = {sky: [] for sky in SKIES}
    with np.load(path) as kept:
        for k, (sky, found) in ((k, pair) for k in range(scans) for pair in frames.items()):
            T, stamp = kept[f"pose {k}"], float(kept[f"stamp {k}"])
            mount = Mount(float(kept["mount"][2, 3]), kept["mount"])
            taken = Scan(kept[f"points {k} {sky}"], stamp=stamp, no_returns=kept[f"silent {k} {sky}"])
            found.append(Frame(taken, mount, None, None, T_map_sensor=T, stamp=stamp))
        return Drive(frames, {k: kept[f"state {k}"] for k in range(scans - LAST, scans)})


def _simulated(sequence: int, scans: int) -> Iterator[tuple[str, Any]]:
    for k in range(scans):
        index = SEQUENCE * sequence + k
        here, stamp = set_up(radar_far.PLAN, "sequences", index), moment(radar_far.PLAN, "sequences", index).time
        yield f"pose {k}", here.T_world_sensor
        yield f"stamp {k}", stamp
        for sky, weather in SKIES.items():
            frame, returns = radar_far.lidar_frame(here, index, radar_far.Sky(weather), stamp)
            yield f"points {k} {sky}", frame.scan.points
            yield f"silent {k} {sky}", frame.scan.no_returns
            if sky == "clear" and k >= scans - LAST:
                yield f"state {k}", radar_far.truth_of(here, returns)[0].crop(SPEC).state
        if k == 0:
            yield "mount", frame.mount.T_vehicle_sensor


def compared(one: Drive) -> dict[str, dict[str, ConfusionSums]]:
    """Return the scores of single scans and of maps, near and all, by sky and way."""
    near, found = distances(SPEC) < 20.0, {}
    for sky, frames in one.frames.items():
        for way, options in WAYS.items():
            model = RayISM(SPEC, **options)
            mapper, sums = DynamicMapper(rolling_window(SPEC)), {}
            for k, frame in enumerate(frames):
                grid = model(frame.scan)
                update_map(mapper, grid, frame)
                if (state := one.states.get(k)) is None:
                    continue
                known = np.where(state == CellState.UNKNOWN, np.uint8(CellState.IGNORE), state)
                for what, mass in (("scan", grid.mass), ("map", mapper.view(SPEC).mass)):
                    for part, inside in (("", near | ~near), (" below 20 m", near)):
                        cells = accumulate(mass, np.where(inside, known, np.uint8(CellState.IGNORE)))
                        name = what + part
                        sums[name] = sums[name].plus(cells) if name in sums else cells
            found[f"{sky}, {way}"] = sums
    return found


def main() -> None:
    parser = run.Parser(__doc__)
    parser.add_argument("--drives", type=int, default=3)
    parser.add_argument("--scans", type=int, default=30, help="of each drive, 10 in a second")
    parser.add_argument("--seed", type=int, default=radar_far.PLAN.seed)
    parser.add_argument("--keep", type=Path, default=run.RUNS / "silence")
    parser.add_argument("--before", type=Path, help="record of an earlier version (default: the one before stays)")
    given = parser.parse_args()
    radar_far.PLAN = replace(radar_far.PLAN, seed=given.seed, radars=())
    drives = [compared(drive(k, given.scans, given.keep)) for k in range(given.drives)]
    means: dict[str, Any] = {}
    for key in drives[0]:
        for what in drives[0][key]:
            scores = [score(one[key][what]) for one in drives]
            means.setdefault(key, {})[what] = {m: round(float(np.nanmean([s[m] for s in scores])), 4) for m in METRICS}
    record = {
        "environment": run.environment("ray", "dynamic"),
        "drives": given.drives,
        "scans": given.scans,
        "seed": given.seed,
    }
    if given.before:
        record["before"] = json.loads(given.before.read_text())["means over drives"]
    elif given.out.is_file():
        record["before"] = json.loads(given.out.read_text())["before"]
    run.write_record(given.out, record | {"means over drives": means})


if __name__ == "__main__":
    main()
