"""What does radar add to lidar far away and in fog? Maps of one lidar, and of it and five radars, on longer grids.

    python benchmarks/radar_far.py [--drives N] [--scans N] [--visibility METRES]

Drives of the towns of `radar_fusion.py`, simulated anew: each moment is scanned by the lidar in clear air and in fog.
The radars' sweeps are the same in both, as the simulator's radars know no weather. In fog a beam without echo tells
nothing: "echoes alone" leaves those beams out. The grid reaches 112 m ahead; its truth is that of rays aimed at every
cell, as in data sets. Every fifth scan from the 20th on is compared, apart below
and beyond 60 m. Intervals are over drives. Writes benchmarks/results/radar_far.json.
"""

import _run as run  # first: it sets the number of threads

# isort: split
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm import Frame, GridSpec, Mount, Scan
from ogm.evaluation import compare_paired
from ogm.fusion import DynamicMapper, update_map
from ogm.metrics import ConfusionSums, accumulate, distances, score
from ogm.models import load_model
from ogm.pose import inverse, pose
from ogm.scan import run_model
from ogm.simulation.cells import measure_ground
from ogm.simulation.lidar import Weather, scan, to_points
from ogm.simulation.moments import SceneSetup, sample_sweeps, set_up
from ogm.simulation.mounts import radars_at, single_sensor
from ogm.simulation.plan import SEQUENCE, DatasetPlan, moment
from ogm.simulation.radars import RADARS
from ogm.simulation.survey import Known, aimed_truth
from ogm.state import CellState, Truth
from ogm.truth import cells_in_boxes
from ogm.truth.boxes import boxes_seen_from

FAR = GridSpec(0.16, (960, 352), (-40.96, -28.16))  # up to 112 m ahead
WINDOW = GridSpec.centered(length=240.0, width=240.0, resolution=0.16)  # holds FAR at any heading
APART = 60.0  # [m]
EGO = (-2.5, 2.5, -1.1, 1.1)  # [m] around the lidar
RELIABILITY = 0.25  # of radar beside lidar, as in radar_fusion.py
FIRST, EVERY = 20, 5  # scans: the first that is compared, and from one to the next
MOVING = 1.0  # [m/s]
BANDS = ("below 60 m", "beyond 60 m")
STATIC = ("nll", "brier", "iou_free", "iou_occupied", "false_free", "missed_occupied")
PLAN = DatasetPlan(
    seed=31, samples=0, validation=0, test=0, sequences=6, towns=6,
    mounts=single_sensor("vlp-32c"), radars=tuple(radars_at(["ars548", "corner"])),
)  # fmt: skip


class Sky(NamedTuple):
    """Weather, and whether the map takes beams without echo for what they are in clear air: probably free."""

    weather: Weather
    silent: bool = True


class Moment(NamedTuple):
    """The scan of the lidar under each sky, the sweeps until the next, and every fifth time the truth."""

    lidar: dict[str, Frame]
    radars: list[Frame]
    truth: Truth | None
    traffic: list[NDArray[np.bool_]]  # cells of each moving participant


def lidar_frame(here: SceneSetup, index: int, sky: Sky, stamp: float) -> tuple[Frame, NDArray[np.int64]]:
    """Scan a moment; also return how many points each object has."""
    rng = np.random.default_rng([PLAN.seed, 7, index])
    image = scan(here.world.scene, here.spec, here.T_world_sensor, rng, weather=sky.weather)
    points, layer, column = to_points(image, here.spec)
    number = image.object[layer, column]
    T_vehicle_sensor = here.T_vehicle_sensor.copy()
    T_vehicle_sensor[:2, 3] = 0.0
    mount = Mount(T_vehicle_sensor[2, 3], T_vehicle_sensor)
    silent = here.spec.directions()[image.range == 0] if sky.silent else None
    taken = Scan(points, stamp=stamp, no_returns=silent, sensor=here.spec.name)
    returns = np.bincount(number[number >= 0], minlength=len(here.objects))
    return Frame(taken, mount, None, None, T_map_sensor=here.T_world_sensor, stamp=stamp), returns


def truth_of(here: SceneSetup, returns: NDArray[np.int64]) -> tuple[Truth, list[NDArray[np.bool_]]]:
    """Return the truth on `FAR`, and the cells of each participant that moves."""
    T, objects = inverse(here.T_world_sensor), here.objects
    boxes = boxes_seen_from(T, [one.pose for one in objects], [one.size for one in objects])
    x, y = FAR.cell_centers
    ego = (x > EGO[0]) & (x < EGO[1]) & (y > EGO[2]) & (y < EGO[3])
    ends = here.spec.elevations[0], here.spec.elevations[-1]
    below = measure_ground(here.world.ground, here.T_world_sensor, FAR)
    truth = aimed_truth(here.world.scene, below, ends, Known(boxes, returns, ego))
    moving = [k for k, one in enumerate(objects) if np.hypot(*one.velocity[:2]) > MOVING]
    return truth, [cells_in_boxes(boxes.select(np.array([k])), FAR) for k in moving]


def moments(sequence: int, scans: int, skies: dict[str, Sky]) -> Iterator[Moment]:
    """Simulate a drive."""
    for k in range(scans):
        index = SEQUENCE * sequence + k
        here, stamp = set_up(PLAN, "sequences", index), moment(PLAN, "sequences", index).time
        taken = {name: lidar_frame(here, index, sky, stamp) for name, sky in skies.items()}
        truth, traffic = None, []
        if k >= FIRST and (k - FIRST) % EVERY == 0:
            truth, traffic = truth_of(here, taken["clear"][1])
        sweeps = []
        for one in sample_sweeps(PLAN, "sequences", index, here.world):
            radar, (x, y) = PLAN.radars[one.radar], here.T_vehicle_sensor[:2, 3]
            mount = Mount(radar.z, pose(radar.x - x, radar.y - y, radar.z, yaw=radar.yaw), EGO)
            found = one.detections.scan(one.stamp, radar.name, RADARS[radar.radar].doppler_interval)
            sweeps.append(Frame(found, mount, None, None, T_map_sensor=one.T_world_sensor, stamp=one.stamp))
        yield Moment({name: frame for name, (frame, _) in taken.items()}, sweeps, truth, traffic)


class Compared:
    """A map, and what it is worth in each band of distance."""

    def __init__(self, radar: bool) -> None:
        self.radar, self.mapper = radar, DynamicMapper(WINDOW)
        self.cells = {band: ConfusionSums.zeros() for band in BANDS}
        self.traffic = {band: np.zeros(2, np.int64) for band in BANDS}  # in sight, and shown by the map

    def compare(self, here: Moment) -> None:
        """Compare the map with the truth of a moment."""
        if here.truth is None:
            return
        mass, state = self.mapper.view(FAR).mass, here.truth.state
        known = np.where(state == CellState.UNKNOWN, np.uint8(CellState.IGNORE), state)
        for band, inside in IN_BAND.items():
            cells = np.where(inside, known, np.uint8(CellState.IGNORE))
            self.cells[band] = self.cells[band].plus(accumulate(mass, cells))
        for box in here.traffic:
            if (state[box] == CellState.OCCUPIED).any():
                band = BANDS[int(DISTANCE[box].min() >= APART)]
                self.traffic[band] += [1, (mass[box][:, 1] > 0.5).any()]

    def results(self) -> dict[str, Any]:
        """Return the scores of the drive by band."""
        found: dict[str, Any] = {}
        for band in BANDS:
            scores = score(self.cells[band])
            found[band] = {key: float(scores[key]) for key in STATIC}
            found[band]["traffic"] = self.traffic[band].tolist()
        return found


DISTANCE = distances(FAR)
IN_BAND = dict(zip(BANDS, (DISTANCE < APART, DISTANCE >= APART), strict=True))


def over_drive(sequence: int, scans: int, skies: dict[str, Sky]) -> dict[str, Any]:
    """Map a drive by the lidar alone and with radars, in every weather."""
    models = load_model("ray+radar", FAR)
    maps = {(sky, kind): Compared(kind != "lidar") for sky in skies for kind in ("lidar", "lidar and radar")}
    for here in moments(sequence, scans, skies):
        grids = {sky: run_model(models, frame) for sky, frame in here.lidar.items()}
        seen = [(frame, run_model(models, frame)) for frame in here.radars]
        for (sky, _), one in maps.items():
            # sweeps around the scan are in the order of time; those before it first
            lidar = (here.lidar[sky], grids[sky])
            for frame, grid in sorted([lidar, *seen] if one.radar else [lidar], key=lambda pair: pair[0].stamp or 0.0):
                share = RELIABILITY if frame.scan.rcs is not None else 1.0
                update_map(one.mapper, grid, frame, reliability=share)
                if frame is here.lidar[sky]:
                    one.compare(here)
    return {f"{sky}, {kind}": one.results() for (sky, kind), one in maps.items()}


def differences(drives: Sequence[dict[str, Any]], skies: dict[str, Sky]) -> dict[str, Any]:
    """Return the change by radar, mean over drives with its interval, by weather and band."""
    numbers, found = [str(k) for k in range(len(drives))], {}
    for sky in skies:
        for band in BANDS:
            pair = [[one[f"{sky}, {kind}"][band] for one in drives] for kind in ("lidar and radar", "lidar")]
            found[f"{sky}, {band}"] = {
                key: list(compare_paired(*([one[key] for one in rows] for rows in pair), "lower", numbers).difference)
                for key in STATIC
            }
    return found


def main() -> None:
    parser = run.Parser(__doc__)
    parser.add_argument("--drives", type=int, default=6)
    parser.add_argument("--scans", type=int, default=60, help="of each drive, 10 in a second")
    parser.add_argument("--visibility", type=float, default=50.0, help="in fog [m]")
    given = parser.parse_args()
    fog = Weather(fog=given.visibility)
    skies = {"clear": Sky(Weather()), "fog": Sky(fog), "fog, echoes alone": Sky(fog, silent=False)}
    drives = []
    for k in range(given.drives):
        drives.append(over_drive(k, given.scans, skies))
        print(k, drives[-1], flush=True)
    record = {
        "environment": run.environment("ray", "radar", "dynamic"),
        "visibility in fog [m]": given.visibility,
        "scans of a drive": given.scans,
        "reliability of radar": RELIABILITY,
        "drives": drives,
        "radar minus none": differences(drives, skies) if len(drives) > 1 else {},
    }
    run.write_record(given.out, record)


if __name__ == "__main__":
    main()
