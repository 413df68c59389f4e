"""What does radar add to lidar, drive by drive? Lidar alone, both, and both without Doppler.

    python benchmarks/radar_fusion.py DRIVES [--choose] [--first N] [--film SEQUENCE]

DRIVES holds drives that `ogm simulate --sequences N --lidar vlp-32c --radar ars548 --radar corner` made. All maps are
`DynamicMapper`s of the same cells; scans of all sensors are fused in the order of time. After every scan of the lidar,
from the tenth on, a map is compared with the truth: motion and times to detect on the cells that the lidar's scan shows
(see `dynamic.py`), and masses on all cells of the paper's grid. `--choose` tries reliabilities of radar instead, for
drives that are not tested on, and writes to runs/. Intervals are over drives. Writes
benchmarks/results/radar_fusion.json; with `--film`, docs/pictures/radar_fusion.webp of a drive instead.
"""

import _run as run  # first: it sets the number of threads

# isort: split
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from _dynamic_drives import WARM_UP, Recorder, Snapshot, snapshots
from _dynamic_filters import Reading
from _fusion_drives import PAPER, WINDOW
from PIL import Image, ImageSequence

from ogm import Frame, open_dataset
from ogm.evaluation import compare_paired
from ogm.fusion import DynamicMapper, update_map
from ogm.metrics import ConfusionSums, accumulate, score, score_motion
from ogm.models import load_model
from ogm.plot import dynamic_panel
from ogm.plot.movie import open_movie
from ogm.scan import run_model
from ogm.state import CellState

RELIABILITY = 0.25  # of radar beside lidar: of those tried on another drive, that with the best log loss
MAPS = {"lidar": ("lidar",), "radar": ("radar",), "lidar and radar": ("lidar", "radar")}
NO_DOPPLER = "lidar and radar, no Doppler"
APPROACHING = 1.0  # [m/s] of its own motion towards the lidar
MOTION = ("motion_ap", "motion_iou", "static_moving")
STATIC = ("nll", "brier", "iou_free", "iou_occupied", "false_free")


class Measured(NamedTuple):
    """A scan of a drive with its measurement grid."""

    frame: Frame
    grid: Any


def measured(frames: Sequence[Frame]) -> list[Measured]:
    """Map every scan by itself."""
    models = load_model("ray+radar", PAPER)
    return [Measured(one, run_model(models, one)) for one in frames]


def without_doppler(frame: Frame) -> Frame:
    scan = replace(frame.scan, doppler=None)
    return Frame(scan, frame.mount, T_map_sensor=frame.T_map_sensor, stamp=frame.stamp)


def is_radar(frame: Frame) -> bool:
    return frame.scan.rcs is not None


class Compared:
    """A map of some sensors over a drive, and what it is compared with."""

    def __init__(self, sensors: Sequence[str], drive: Sequence[Any], reliability: float, doppler: bool) -> None:
        self.sensors, self.reliability, self.doppler = sensors, reliability, doppler
        self.mapper = DynamicMapper(WINDOW)
        self.recorder = Recorder(self.mapper, drive, {"map": Reading()})
        self.cells = ConfusionSums.zeros()

    def update(self, one: Measured) -> None:
        """Fuse a scan if it is of a sensor of this map."""
        kind = "radar" if is_radar(one.frame) else "lidar"
        if kind not in self.sensors:
            return
        share = self.reliability if kind == "radar" and len(self.sensors) > 1 else 1.0
        frame = one.frame if self.doppler else without_doppler(one.frame)
        update_map(self.mapper, one.grid, frame, reliability=share)

    def compare(self, k: int, here: Snapshot) -> None:
        """Compare the map after the k-th scan of the lidar."""
        self.recorder.compare(here.frame.stamp)
        if k < WARM_UP:
            return
        view = self.mapper.view(PAPER)
        truth = here.truth.crop(PAPER).state
        known = np.where(truth == CellState.UNKNOWN, np.uint8(CellState.IGNORE), truth)
        self.cells = self.cells.plus(accumulate(view.mass, known))


def over_drive(frames: Sequence[Frame], maps: Mapping[str, tuple[Sequence[str], float, bool]]) -> Any:
    """Run all maps over a drive; return their scores and sums."""
    every = measured(frames)
    lidar = [one for one in every if not is_radar(one.frame)]
    poses = np.array([one.frame.T_map_sensor @ one.frame.mount.T_sensor_level for one in lidar])
    drive = snapshots([one.frame for one in lidar], poses, [one.grid for one in lidar])
    result = {}
    for name, (sensors, reliability, doppler) in maps.items():
        compared, k = Compared(sensors, drive, reliability, doppler), 0
        for one in every:
            compared.update(one)
            if not is_radar(one.frame):
                compared.compare(k, drive[k])
                k += 1
        sums = next(iter(compared.recorder.results().values()))
        result[name] = scores_of(sums, compared, drive)
    return result


def approaches(track: str, stamp: float, drive: Sequence[Snapshot]) -> bool:
    """Return whether a vehicle drives towards the lidar by 1 m/s or more when it comes into sight."""
    boxes = next(one.frame.boxes for one in drive if one.frame.stamp == stamp)
    k = list(boxes.track).index(track)
    toward = -boxes.center[k, :2] / np.hypot(*boxes.center[k, :2])
    vehicle = not any(word in boxes.label[k] for word in ("pedestrian", "cycl"))
    return vehicle and bool(boxes.velocity[k] @ toward >= APPROACHING)


def scores_of(sums: Any, compared: Compared, drive: Sequence[Snapshot]) -> dict[str, Any]:
    motion, cells = score_motion(sums.motion), score(compared.cells)
    row: dict[str, Any] = {name: float(motion[name]) for name in MOTION}
    row |= {name: float(cells[name]) for name in STATIC}
    times = [one.seconds for one in sums.detections]
    row["seconds to detect"] = times  # of each object; infinite where it was never
    row["approaching"] = [approaches(one.track, one.stamp, drive) for one in sums.detections]
    return row


def drives(path: Path, first: int | None) -> Iterator[tuple[str, list[Frame]]]:
    """Yield the drives of a data set with the scans of all sensors."""
    dataset = open_dataset(path, split="sequences", sensors=("lidar", "radar"), others="later", kerbs="occupied")
    for name, numbers in list(dataset.sequences.items())[:first]:
        yield name, list(dataset.select(numbers))


def film(frames: Sequence[Frame], path: Path) -> None:
    """Draw the lidar's map, the radars' and the dynamic map of both, scan by scan of the lidar."""
    maps = {name: DynamicMapper(WINDOW) for name in MAPS}
    models, titles = load_model("ray+radar", PAPER), ("points of the lidar", *(f"map of {name}" for name in MAPS))
    height = frames[0].mount.sensor_height
    large = path.with_stem("large")
    with open_movie(large, PAPER, titles, -height) as movie:
        for frame in frames:
            kind, grid = "radar" if is_radar(frame) else "lidar", run_model(models, frame)
            for name, mapper in maps.items():
                if kind in MAPS[name]:
                    share = RELIABILITY if kind == "radar" and len(MAPS[name]) > 1 else 1.0
                    update_map(mapper, grid, frame, reliability=share)
            if kind == "lidar":
                panels = [dynamic_panel(mapper.dynamic_view(PAPER), name, 1.0) for name, mapper in maps.items()]
                movie.add(frame.scan.points, panels, f"{frame.stamp:.1f} s", float(frame.stamp or 0.0))
    with Image.open(large) as image:  # every second picture, smaller, for a page
        shown = [one.convert("RGB") for one in ImageSequence.Iterator(image)][::2]
    shown = [one.resize((880, round(one.height * 880 / one.width)), Image.Resampling.LANCZOS) for one in shown]
    shown[0].save(path, save_all=True, append_images=shown[1:], duration=200, loop=0, quality=45)
    large.unlink()


def main() -> None:
    parser = run.Parser(__doc__)
    parser.add_argument("drives", type=Path)
    parser.add_argument("--choose", action="store_true")
    parser.add_argument("--first", type=int, help="take the first N drives")
    parser.add_argument("--film", type=int, help="number of a drive")
    given = parser.parse_args()
    if given.film is not None:
        film([*drives(given.drives, None)][given.film][1], run.PICTURES / "radar_fusion.webp")
        return
    if given.choose:
        maps: Any = {"lidar": (("lidar",), 1.0, True)}
        maps |= {f"reliability {r:g}": (("lidar", "radar"), r, True) for r in (0.25, 0.5, 0.75, 1.0)}
    else:
        maps = {name: (sensors, RELIABILITY, True) for name, sensors in MAPS.items() if name != "radar"}
        maps[NO_DOPPLER] = (MAPS["lidar and radar"], RELIABILITY, False)
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in maps}
    for name, frames in drives(given.drives, given.first):
        for method, row in over_drive(frames, maps).items():
            rows[method].append(row)
            print(name, method, row, flush=True)
    numbers, keys = [str(k) for k in range(len(rows["lidar"]))], (*MOTION, *STATIC)
    columns = {method: {key: [one[key] for one in found] for key in keys} for method, found in rows.items()}
    lidar = columns["lidar"]
    record = {
        "environment": run.environment("ray", "radar", "dynamic"),
        "reliability of radar": RELIABILITY,
        "drives": rows,
        "mean": {method: {key: np.nanmean(found[key]) for key in keys} for method, found in columns.items()},
        "minus lidar": {
            method: {key: list(compare_paired(found[key], lidar[key], "lower", numbers).difference) for key in keys}
            for method, found in columns.items()
            if method != "lidar" and len(numbers) > 1
        },
    }
    run.write_record(run.RUNS / "radar_reliability.json" if given.choose else given.out, record)


if __name__ == "__main__":
    main()
