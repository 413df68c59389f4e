"""Simulated scans beside real ones: the same statistics of both, and truth beside a published label.

    python benchmarks/realism.py [--towns N] [--quick] [--store FOLDER]

With --store, the samples of a data set that `ogm simulate --recipe` made take the place of scans simulated here: those
in clear weather with all beams measured. Its figures belong into files of their own (--out, --picture).

Needs recordings that cannot be shipped; benchmarks/README.md names them and where they go. Writes
benchmarks/results/realism.json and docs/pictures/realism.png; `python docs/realism_tables.py` makes tables of the
record. The same picture with a real scan and a published truth grid beside the simulated ones, which may not be passed
on, goes to runs/realism/side_by_side.png.
"""

import _run as run  # first: it sets the number of threads

# isort: split
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from _charts import caption, save_picture
from _sweep_statistics import EDGES, SPEC, Sweep, histograms, statistics
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ogm import Scan, read_scan
from ogm.io import estimate_sensor_height
from ogm.io.argoverse2 import read_argoverse2
from ogm.plot.colours import colours
from ogm.pose import inverse, pose
from ogm.simulation.cells import measure_ground
from ogm.simulation.lidar import Weather, scan, to_points
from ogm.simulation.scene import EGO, Scene
from ogm.simulation.sensors import LIDARS, LidarSpec
from ogm.simulation.store import Store
from ogm.simulation.survey import Known, aimed_truth
from ogm.simulation.town import Town, build_town
from ogm.simulation.traffic.bodies import ego_vehicle
from ogm.simulation.traffic.motion import Traffic
from ogm.state import CellState
from ogm.truth.boxes import boxes_seen_from

SIDE_BY_SIDE = run.RUNS / "realism" / "side_by_side.png"
FIRING = 55.296e-6  # [s] VLP-32C: from one firing of a laser to its next
EGO_REACH = np.array([2.6, 1.05, 1.7])  # [m] from the middle of the ego vehicle's footprint, where its returns lie
STORED = {"pandar40": "pandar40p"}  # names in data sets
COLOURS = ("#d55e00", "#2c5f9e")  # of simulated and real sweeps


def in_layers(ring: NDArray[Any], xyz: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Sort the rings into layers by their median elevation; return each point's layer, and the elevations [deg]."""
    elevation = np.degrees(np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1])))
    rings, index = np.unique(ring, return_inverse=True)
    medians = np.array([np.median(elevation[index == k]) for k in range(len(rings))])
    rank = np.argsort(np.argsort(medians))
    return rank[index], np.sort(medians)


def sweep_of(name: str, scan: Scan, ring: Any, column: Any, columns: int, kept: Any = ..., **known: Any) -> Sweep:
    """Return the kept points of a scan as a sweep; its height is estimated where it is not given."""
    points = scan.points[kept] * np.float32([1, 1, 1, 255])
    points[:, :3] -= known.pop("origin", np.zeros(3)).astype(np.float32)
    layer, elevations = in_layers(ring[kept], points)
    height = known.pop("height", None) or estimate_sensor_height(points)
    return Sweep(name, points, layer, column[kept], elevations, columns, height, **known)


def firings(scan: Scan, period: float, columns: int) -> NDArray[np.int64]:
    """Return the columns of points from their times and the time from a firing to the next [s]."""
    return np.rint((scan.time - scan.time.min()) / period).astype(int).clip(0, columns - 1)


def argoverse2() -> Iterator[Sweep]:
    """Both VLP-32C of one sweep, each seen from where it stands; columns from the firing times."""
    folder = run.DATA / "argoverse2_adcf"
    log = read_argoverse2(folder) if folder.is_dir() else None
    for path in log.sweeps if log else ():
        scan = read_scan(path)
        ground, column = estimate_sensor_height(scan.points), firings(scan, FIRING, 1808)
        for title, name, first in (("upper", "up_lidar", 0), ("lower", "down_lidar", 32)):
            origin, kept = log.lidars[name], (scan.ring >= first) & (scan.ring < first + 32)
            place = {"origin": origin, "height": float(np.float32(origin[2])) + ground}
            yield sweep_of(f"Argoverse 2, {title}", scan, scan.ring, column, 1808, kept, **place)


def nuscenes() -> Iterator[Sweep]:
    """HDL-32E: the file holds every beam, those without a return as points at the sensor."""
    for path in sorted((run.DATA / "nuscenes_n015").glob("*.pcd.bin")):
        scan = read_scan(path, axes="nuscenes")
        distance = np.linalg.norm(scan.points[:, :3], axis=1)
        column, kept = np.arange(len(distance)) // 32, distance > 2.5
        ego = int(((distance > 0.55) & ~kept).sum())
        yield sweep_of("nuScenes", scan, scan.ring, column, int(column[-1]) + 1, kept, ego=ego)


def kitti() -> Iterator[Sweep]:
    """HDL-64E: points in the order of the layers, each from azimuth 0 counter-clockwise; intensities not calibrated."""
    for pattern in ("kitti_odometry_00/000000.bin", "kitti_object/velodyne/*.bin", "kitti_raw_0005/*70.pcd.xz"):
        for path in sorted(run.DATA.glob(pattern)):
            scan = read_scan(path)
            azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))
            (turns,) = np.nonzero((np.abs(azimuth[:-1] + 45) < 45) & (np.abs(azimuth[1:] - 45) <= 45))
            turns = turns[np.diff(turns, prepend=-1) > 400] + 1
            ring = np.searchsorted(turns, np.arange(len(azimuth)), side="right")
            column = (azimuth % 360 / 0.1728).astype(int)
            yield sweep_of("KITTI", scan, ring, column, 2083, calibrated=False, timed=False)


def pandar40() -> Iterator[Sweep]:
    """Hesai with 40 layers (SUSTechPOINTS); columns from the firing times."""
    for path in sorted((run.DATA / "sustechpoints").glob("lidar/*.pcd.xz")):
        scan = read_scan(path, axes=("-y", "+x", "+z"))
        yield sweep_of("Pandar40 (SUSTech)", scan, scan.ring, firings(scan, 55.5e-6, 1800), 1800)


class Place(NamedTuple):
    """Place and time of a simulated scan."""

    seed: int
    clockwise: bool
    time: float  # [s]


def simulated(
    sensors: Mapping[str, tuple[LidarSpec, float]], where: list[Place]
) -> Iterator[tuple[str, Sweep, NDArray[np.uint8] | None]]:
    """Scan every place with every sensor, given as its specification and its height above ground [m].

    The first sensor's scans come with the true states of the cells around them.
    """
    town: Town | None = None
    for place in where:
        if town is None or town.seed != place.seed:
            town = build_town(place.seed)
            scene, ground = Scene(town.mesh, threads=1), Scene(town.ground, threads=1)
            traffic = {way: Traffic(town, place.seed, clockwise=way) for way in (True, False)}
        state = traffic[place.clockwise].at(place.time)
        scene.place([o.mesh.moved(o.pose) for o in state.objects], ego_vehicle().moved(state.ego))
        for k, (name, (spec, height)) in enumerate(sensors.items()):
            rng = np.random.default_rng([place.seed, int(place.time), int(place.clockwise)])
            T = state.ego @ pose(0.0, 0.0, height)
            image, cells = scan(scene, spec, T, rng), None
            if k == 0:
                boxes = boxes_seen_from(inverse(T), [o.pose for o in state.objects], [o.size for o in state.objects])
                returns = np.bincount(image.object[image.object >= 0], minlength=len(boxes))
                below, span = measure_ground(ground, T, SPEC), (min(spec.elevations), max(spec.elevations))
                cells = aimed_truth(scene, below, span, Known(boxes, returns)).state
            points, layer, column = to_points(image, spec)
            points[:, 3] = np.rint(255 * points[:, 3])
            other = image.object[layer, column] != EGO
            kept = points[other], layer[other], column[other], np.degrees(spec.elevations)
            ego = int(np.count_nonzero(~other))
            yield name, Sweep(f"town {place.seed}", *kept, image.range.shape[1], height, ego), cells


def stored(
    path: Path, sensors: Mapping[str, tuple[LidarSpec, float]]
) -> Iterator[tuple[str, Sweep, NDArray[np.uint8]]]:
    """Return the intact scans in clear weather of a data set, with the true states of the cells around them."""
    names = {STORED.get(spec.name, spec.name): name for name, (spec, _) in sensors.items()}
    store = Store.open(path)
    for split in ("training", "validation", "test"):
        for k in store[split].finished:
            sample = store[split][int(k)]
            whole = sample.measured is None or sample.measured.all()
            if sample.lidar not in names or not whole or sample.weather != Weather():
                continue
            T = sample.T_vehicle_sensor
            own = (np.abs(sample.points[:, :3] @ T[:3, :3].T + T[:3, 3]) < EGO_REACH).all(axis=1)
            points = sample.points[~own] * np.float32([1, 1, 1, 255])
            kept = points, sample.ring[~own].astype(int), sample.column[~own], np.degrees(sample.beams.elevation)
            facts = {"ego": int(own.sum()), "calibrated": bool(sample.intensities.any())}
            sweep = Sweep(f"{split} {k}", *kept, sample.beams.columns, float(T[2, 3]), **facts)
            yield names[sample.lidar], sweep, sample.truth.crop(SPEC).state


RADII = (0, 3, 6, 10, 15, 20, 30, 50)  # [m]


def published_label() -> NDArray[np.uint8] | None:
    """Return one label of the paper's own data, (nx, ny) along x forward and y left: 0 unknown, 1 free, 2 occupied."""
    path = run.DATA.parent / "evilog_label_256x176.npy"
    return np.load(path)[::-1, ::-1] if path.is_file() else None


def truth_shares(state: NDArray[np.uint8]) -> dict[str, float]:
    """Return the shares of states in all cells, and by distance [%]; ignored cells count as unknown."""
    length = SPEC.resolution * SPEC.shape[0] / state.shape[0]
    x, y = (length * (np.arange(n) - (n - 1) / 2) for n in state.shape)
    distance = np.hypot(x[:, None], y)
    result = {}
    for name, value in (("free", state == CellState.FREE), ("occupied", state == CellState.OCCUPIED)):
        result[name] = 100 * float(value.mean())
        for low, high in pairwise(RADII):
            ring = (distance >= low) & (distance < high)
            result[f"{name} at {low} to {high} m"] = 100 * float(value[ring].mean())
    # Along rays from the sensor: what lies behind the first occupied cell?
    along = np.arange(3.5, 50.0, length / 2)
    azimuth = np.radians(np.arange(360))[:, None]
    ix, iy = (
        np.floor(along * way(azimuth) / length + n / 2) for way, n in zip((np.cos, np.sin), state.shape, strict=True)
    )
    inside = (ix >= 0) & (ix < state.shape[0]) & (iy >= 0) & (iy < state.shape[1])
    met = state[tuple(np.where(inside, index, 0).astype(int) for index in (ix, iy))]
    behind = inside & (np.cumsum(inside & (met == CellState.OCCUPIED), axis=1) > 0)
    share = float((met[behind] == CellState.FREE).mean()) if behind.any() else 0.0
    result["free of what lies behind the first occupied cell"] = 100 * share
    return {"unknown": 100 - result["free"] - result["occupied"], **result}


# Sensor of the simulator, its height above ground [m], and the recordings to compare with
PANDAR40 = np.radians([*range(-16, -6), *np.linspace(-6, 2, 25), *range(3, 8)])
_PANDAR40 = {"elevations": tuple(PANDAR40.tolist()), "azimuth_offsets": (0.0,) * len(PANDAR40)}
GROUPS: dict[str, tuple[LidarSpec, float, Callable[[], Iterator[Sweep]]]] = {
    "VLP-32C": (LIDARS["vlp-32c"], 1.98, argoverse2),
    "HDL-32E": (LIDARS["hdl-32e"], 1.85, nuscenes),
    "HDL-64E": (LIDARS["hdl-64e"], 1.75, kitti),
    "Pandar40": (replace(LIDARS["vlp-32c"], name="pandar40", **_PANDAR40), 1.77, pandar40),
}
MARGIN = 1.25  # a simulated median this far beyond the real values is a difference
FLOOR = 0.5  # or this much, in the statistic's own unit, where that is more


def spread(values: list[float]) -> dict[str, float]:
    low, median, high = np.percentile(values, (10, 50, 90)).tolist()
    return {"median": median, "p10": low, "p90": high}


def compare(real: Mapping[str, list[dict[str, float]]], fake: list[dict[str, float]]) -> dict[str, Any]:
    """Compare the statistics of simulated scans with the medians of real sets.

    A statistic is "low" or "high" where the simulated median lies below or above all of this sensor's real
    sets by more than a quarter.
    """
    rows = {}
    for name in dict.fromkeys(name for sets in real.values() for one in sets for name in one):
        if not (made := [one[name] for one in fake if name in one]):
            continue
        found = {key: [one[name] for one in sweeps if name in one] for key, sweeps in real.items()}
        sets = {key: float(np.median(values)) for key, values in found.items() if values}
        least, most, span = min(sets.values()), max(sets.values()), spread(made)
        low = span["median"] < min(least / MARGIN, least - FLOOR)
        high = span["median"] > max(most * MARGIN, most + FLOOR)
        rows[name] = {"real": sets, "simulated": span, "verdict": "high" if high else "low" if low else ""}
    return rows


def picture(
    record: Mapping[str, Any],
    sensor: str,
    sweeps: Mapping[str, list[Sweep]],
    shown: Mapping[str, tuple[Sweep, NDArray[np.uint8] | None]],
    path: Path,
) -> None:
    """Draw a range image and a truth grid of each name in `shown`, and histograms of all sweeps by name."""
    figure = Figure(figsize=(16, 2.6 * len(shown) + 10), layout="constrained")
    parts = figure.subfigures(len(shown) + 2, 1, height_ratios=[2.5] * len(shown) + [6.0, 3.6])
    shown_as = np.array([(0.0, 0.0, 0.0), colours().free, colours().occupied, (0.44, 0.44, 0.44)])  # by `CellState`
    truths = parts[-2].subplots(1, len(shown), squeeze=False)[0]
    for part, ax, (name, (sweep, state)) in zip(parts, truths, shown.items(), strict=False):
        image = part.subplots().imshow(range_picture(sweep), aspect="auto", cmap="viridis", vmin=2, vmax=60)
        part.colorbar(image, label="range [m]", pad=0.005)
        part.suptitle(f"Range image, {name} (layers from top to bottom, azimuth; white: no return)")
        if state is not None:
            ax.imshow(shown_as[state[::-1, ::-1]], extent=(-28.16, 28.16, -40.96, 40.96), interpolation="nearest")
            ax.set_title(f"Truth, {name}: {colours().text}")
    for ax, (name, edges) in zip(parts[-1].subplots(1, len(EDGES)), EDGES.items(), strict=True):
        for colour, (group, members) in zip(COLOURS, sweeps.items(), strict=False):
            counts = [histograms(sweep) for sweep in members]
            stack = 100 * np.array([one[name] for one in counts if name in one])
            if len(stack):
                low, median, high = np.percentile(stack, (10, 50, 90), axis=0)
                middle = (edges[1:] + edges[:-1]) / 2
                ax.fill_between(middle, low, high, step="mid", color=colour, alpha=0.25)
                ax.step(middle, median, where="mid", color=colour, label=f"{group}, median; 10 % to 90 %")
        ax.set(xlabel=name, ylabel="returns [%]", yscale="log")
        ax.legend(fontsize=7)
    figure.suptitle(f"{sensor}, real and simulated", fontsize=14)
    save_picture(figure, path, caption(record), dpi=90)


def range_picture(sweep: Sweep, columns: int = 1800) -> NDArray[np.float32]:
    """Sort the returns into layers (lowest last) and azimuths (from behind over left); NaN without return."""
    xyz = sweep.points[:, :3]
    turn = np.arctan2(xyz[:, 1], xyz[:, 0]) / (2 * np.pi)
    image = np.full((len(sweep.elevations), columns), np.nan, np.float32)
    image[sweep.layer, np.floor((0.5 - turn) * columns + 0.25).astype(int) % columns] = np.linalg.norm(xyz, axis=1)
    return image[::-1]


def main() -> None:
    parser = run.Parser(__doc__, picture=True, quick=True)
    parser.add_argument("--towns", type=int, default=4, help="towns to scan in (default 4)")
    parser.add_argument("--each", type=int, default=10, help="places in each town (default 10)")
    parser.add_argument("--store", type=Path, help="data set whose scans are compared (default: simulate some)")
    options = parser.parse_args()
    towns, each = (1, 2) if options.quick else (options.towns, options.each)
    where = [Place(seed, bool(n % 2), 25.0 + 13.0 * n) for seed in range(1, towns + 1) for n in range(each)]

    record = run.environment()
    real = {sensor: list(reader()) for sensor, (_, _, reader) in GROUPS.items()}
    for sensor in (sensor for sensor, sweeps in real.items() if not sweeps):
        print(f"left out: {sensor}: no recording of it under {run.DATA}")
    sensors = {s: (spec, height) for s, (spec, height, _) in GROUPS.items() if real[s]}
    if not sensors:
        print("nothing to compare with: benchmarks/README.md names the recordings that are needed, and where")
        return
    found: dict[str, list[tuple[Sweep, NDArray[np.uint8] | None]]] = {sensor: [] for sensor in sensors}
    if options.store is None:
        record["places"], scans = [list(place) for place in where], simulated(sensors, where)
    else:
        record["data set"], scans = options.store.name, stored(options.store, sensors)
    for sensor, *scan_and_truth in scans:
        found[sensor].append(tuple(scan_and_truth))

    record["sensors"], made = {}, {sensor: [statistics(sweep) for sweep, _ in pairs] for sensor, pairs in found.items()}
    for sensor, ours in made.items():
        if not ours:
            print(f"left out: {sensor}: no intact scan of it in {options.store}")
            continue
        sets: dict[str, list[dict[str, float]]] = {}
        for sweep in real[sensor]:
            sets.setdefault(sweep.name, []).append(statistics(sweep))
        counts = {name: len(sweeps) for name, sweeps in sets.items()}
        record["sensors"][sensor] = {"scans": counts, "simulated scans": len(ours), "statistics": compare(sets, ours)}
    label = published_label()
    shares = [truth_shares(state) for pairs in found.values() for _, state in pairs if state is not None]
    known = {} if label is None else truth_shares(label)
    record["truth"] = {
        name: {"label": known.get(name), "simulated": spread([one[name] for one in shares])} for name in shares[0]
    }
    run.write_record(options.out, record)
    first = next(sensor for sensor in sensors if made[sensor])
    # The scan in the picture is a typical one: its distance to obstacles is the median of all.
    reach = [one["nearest obstacle, sectors of 1 deg, p50 [m]"] for one in made[first]]
    shown = {"simulated": found[first][int(np.argsort(reach)[len(reach) // 2])]}
    sweeps = {"simulated": [sweep for sweep, _ in found[first]], "real": real[first]}
    picture(record, first, sweeps, shown, options.picture)
    picture(record, first, sweeps, shown | {"real": (real[first][0], label)}, SIDE_BY_SIDE)  # not to be passed on


if __name__ == "__main__":
    main()
