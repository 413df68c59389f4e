"""How long does one scan take? ogm's two geometric models beside OctoMap, KISS-SLAM, and plain Python.

    python benchmarks/speed.py [--scan FILE] [--repeats N] [--quick]
    python benchmarks/speed.py --table      # the table of docs/speed.md: prints it, and writes nothing

All get the same points, the same origin and cells of the same size on one core, in one run. benchmarks/README.md
states what is compared, and what is not comparable about it. Writes benchmarks/results/speed.json and
docs/pictures/speed.png.
"""

import _contenders as make  # first: it sets the number of threads
import _run as run
from _contenders import COPY, HEIGHT_BAND, KISS, LOCAL, NUMPY, OCTOMAP, PYTHON, RAY, STREET_HEIGHT, NamedScan

# isort: split
import itertools
import json
import math
import os
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from _charts import FLOOR, OURS, PEER, TWIN, caption, draw_times, save_picture
from _timing import Contender, Times, measure
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ogm import GridSpec, Mount, Scan
from ogm.fusion import EvidentialMapper
from ogm.geometric import HeightBandISM, PlanarISM, RayISM, ray
from ogm.geometric.causes import unknown_causes
from ogm.geometric.ground import surface_of
from ogm.geometric.inputs import to_vehicle_frame
from ogm.geometric.kernels.arguments import Cells, Points, RayNumbers
from ogm.geometric.kernels.belief import clear_sectors, ray_mass
from ogm.geometric.kernels.breaks import ground_breaks
from ogm.geometric.kernels.evidence import ground_evidence
from ogm.geometric.kernels.polar import ray_limits
from ogm.geometric.kernels.rays import aim_rays, place_rays, sort_sectors
from ogm.pose import pose

SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)  # 512 x 352 cells
MAX_RANGE = math.hypot(SPEC.length, SPEC.width) / 2  # [m] the grid's far corner, where the 3D mappers stop too
SIZES = {"57.6k": (57_600, 32), "120k": (120_000, 64)}  # points, layers of the synthetic scan
COUNTS = (10_000, 30_000, 100_000, 300_000, 1_000_000, 2_000_000)
RESOLUTIONS = (0.32, 0.16, 0.08)  # [m] 256 x 176, 512 x 352, 1024 x 704 cells over the same area
DIFFER = "cells of HeightBandISM that differ from"
UNITS = {"median": "median [ms]", "low": "quartile 25 [ms]", "high": "quartile 75 [ms]", "on_core": "on core"}
NOTE = """Read with care: OctoMap and the KISS-SLAM mapper are 3D mappers and do more work. They update
every voxel that a ray passes, in a tree or sparse grid that keeps a whole map, where ogm fills the cells of
one 2D grid. The ratios show what a 2D evidential grid saves where it is enough, not that those are worse."""


FIRST_CALLS = """
import json, time
start = time.perf_counter()
import numpy as np
from ogm import GridSpec, Mount
from ogm.geometric import HeightBandISM, RayISM
steps = {"import": time.perf_counter() - start}
points = np.random.default_rng(0).uniform((-40, -25, -2, 0), (40, 25, 2, 1), (20000, 4)).astype(np.float32)
for model in (HeightBandISM, RayISM):
    ism = model(GridSpec.centered(), Mount(1.8))
    start = time.perf_counter()
    ism(points)
    steps["first call of " + model.__name__] = time.perf_counter() - start
print(json.dumps(steps))
"""


TWO_THREADS = """
import os, sys, time
from concurrent.futures import ThreadPoolExecutor
import numpy as np
from ogm import GridSpec, Mount
from ogm.geometric import RayISM
points, ism = np.load(sys.argv[1]), RayISM(GridSpec.centered(), Mount(float(sys.argv[2])))
expected, rates = ism(points).mass, {}
for _ in range(5):
    for threads in (1, 2):
        with ThreadPoolExecutor(threads) as pool:
            start = time.perf_counter()
            grids = list(pool.map(ism, [points] * 60))
            rates.setdefault(threads, []).append(60 / (time.perf_counter() - start))
        assert all((grid.mass == expected).all() for grid in grids)
print(max(rates[1]), max(rates[2]))
"""


def two_threads(scan: NamedScan) -> dict[str, float]:
    """Return the scans per second of one model in one thread and in two, on two cores; their grids are the same."""
    cores = os.cpu_count() or 1
    if cores < 2:
        return {}
    prepare = partial(os.sched_setaffinity, 0, range(cores)) if hasattr(os, "sched_setaffinity") else None
    with tempfile.TemporaryDirectory() as folder:
        np.save(path := Path(folder) / "points.npy", make.thinned(scan.points, 120_000))
        out = run.in_new_process(TWO_THREADS, [path, scan.sensor_height], preexec_fn=prepare)
    one, two = map(float, out.split())
    return {"one thread [1/s]": one, "two threads [1/s]": two, "ratio": two / one}


def steps(scan: NamedScan, rounds: int) -> dict[str, Times]:
    """Time the steps of `RayISM`, each on what the steps before it made."""
    points, mount = make.thinned(scan.points, 120_000), Mount(scan.sensor_height)
    ism, cells = RayISM(SPEC, mount), Cells(*SPEC.origin, SPEC.resolution)
    polar = ray.polar_grid(SPEC, (0.0, 0.0), mount.ego_footprint, ism.azimuth_step)
    coarse = ray._ground_spec(SPEC, ism.ground_cell)
    numbers = RayNumbers(*(float(getattr(ism, name)) for name in RayNumbers._fields))
    origin, nothing = mount.origin.astype(np.float32), np.empty((0, 3), np.float32)
    xyz = to_vehicle_frame(points, mount, mount.ego_footprint)
    ground = surface_of(ism.ground(xyz, coarse, mount.ground_point), coarse)
    columns, alarms = Points(*xyz.T), ray._powers(math.sqrt(ism.p_false_alarm))
    trace = ism.trace(points)
    limits, work, rays, shown = trace.limits, trace.work, trace.rays, trace.shown
    returns, sectors, mass = (0, len(xyz), 0), (0, polar.sectors), trace.mass.copy()
    breaks, silence = ground_breaks(rays, limits, polar, numbers), np.ones(polar.bins, np.float32)
    calls = {
        "points in the vehicle frame": lambda _: to_vehicle_frame(points, mount, mount.ego_footprint),
        "returns that show the ground": lambda _: ground_evidence(columns, origin, mount.sensor_height),
        "ground map": lambda _: ism.ground(xyz, coarse, mount.ground_point),
        "limits of rays": lambda _: ray_limits(ground, origin, numbers.clearance, polar),
        "directions of rays": lambda _: aim_rays(columns, nothing, origin, polar, numbers.max_range, returns, work),
        "heights, marks and rays by sectors": lambda _: place_rays(
            columns, origin, ground, cells, numbers, shown, returns, work
        ),
        "breaks of the ground": lambda _: ground_breaks(rays, limits, polar, numbers),
        "belief in free": lambda _: clear_sectors(
            rays, columns, limits, polar, cells, breaks, silence, numbers, (*sectors, 0), work
        ),
        "masses": lambda _: ray_mass(work, polar, alarms, numbers, 0, SPEC.shape[0], mass),
        "rays, sorted": lambda _: sort_sectors(rays, *sectors, len(xyz), work),
        "causes of unknown cells, where asked for": lambda _: unknown_causes(trace),
    }
    return measure({name: Contender(call) for name, call in calls.items()}, rounds)


def planar(rounds: int) -> dict[str, Times]:
    """Time a planar scan of 361 beams in a room of 16 m x 12 m, and its fusion, on 800 x 800 cells of 0.05 m."""
    azimuth = np.deg2rad(np.arange(-180, 181) / 2)
    with np.errstate(divide="ignore"):
        reach = np.minimum(8 / np.abs(np.cos(azimuth)), 6 / np.abs(np.sin(azimuth)))
    points = np.column_stack([reach * np.cos(azimuth), reach * np.sin(azimuth), 0 * azimuth]).astype(np.float32)
    spec, stamps = GridSpec.centered(40.0, 40.0, 0.05), itertools.count()
    scan, ism = Scan(points, kind="planar"), PlanarISM(spec, Mount(0.3, ego_footprint=(0, 0, 0, 0)))
    grid, mapper, T = ism(scan), EvidentialMapper(spec), pose(0.3, 0.2, yaw=0.4)
    calls = {
        "PlanarISM": lambda _: ism(scan),
        "EvidentialMapper": lambda _: mapper.update(grid, T, stamp=0.1 * next(stamps)),
    }
    return measure({name: Contender(call) for name, call in calls.items()}, rounds)


def first_calls() -> dict[str, dict[str, float]]:
    """Return the times of import and first calls [s] in a new process, with an empty and a filled cache of kernels."""
    result = {}
    with tempfile.TemporaryDirectory() as cache:
        for state in ("cold (compiles)", "from the cache"):
            result[state] = json.loads(run.in_new_process(FIRST_CALLS, env=os.environ | {"NUMBA_CACHE_DIR": cache}))
    return result


def compare(scan: NamedScan, size: str, rounds: int) -> dict[str, Any]:
    """Time all contenders on one scan."""
    points, mount, slow = make.thinned(scan.points, SIZES[size][0]), Mount(scan.sensor_height), size == "57.6k"
    ours = make.contenders(SPEC, points, mount, slow)
    others, reasons = make.peers(SPEC, points, scan.sensor_height)
    times = measure(ours | others, rounds)
    result = {"size": size, "scan": scan.name, "points": len(points), "left out": reasons, "times": times}
    if slow:
        mass = HeightBandISM(SPEC, mount)(points).mass
        result[DIFFER] = {
            name: int((np.abs(mass - ours[name].run(None)) > 1e-6).any(axis=2).sum()) for name in (NUMPY, PYTHON)
        }
    return result


def cost(sizes: list[int], runs: list[tuple[GridSpec, NDArray[np.float32]]], rounds: int) -> dict[str, Any]:
    """Time both models on runs of growing size: fit time ~ size ** slope, and find the steepest step."""
    result: dict[str, Any] = {}
    for model in (HeightBandISM, RayISM):
        calls = {
            size: Contender(lambda ism, p=points: ism(p), partial(model, spec, Mount(STREET_HEIGHT)))
            for size, (spec, points) in zip(map(str, sizes), runs, strict=True)
        }
        times = list(measure(calls, rounds).values())
        x, y = np.log(sizes), np.log([t.median for t in times])
        slope, steepest = float(np.polyfit(x, y, 1)[0]), float((np.diff(y) / np.diff(x)).max())
        result[model.__name__] = {"times": times, "slope": slope, "steepest step": steepest}
    return result


def verdicts(
    comparisons: list[dict[str, Any]], points: dict[str, Any], threads: dict[str, float]
) -> list[dict[str, Any]]:
    """Return the ratios beside what they have to reach."""
    rows: list[tuple[str, float, str, float, str]] = []
    for comparison in comparisons:
        medians = {name: times.median for name, times in comparison["times"].items()}
        where = f"({comparison['scan']}, {comparison['points']} points)"
        model, factor, copies = (HEIGHT_BAND, 500, 12) if comparison["size"] == "57.6k" else (RAY, 100, 10)
        trees = [name for name in medians if name.startswith(OCTOMAP)]
        peers = {min(trees, key=medians.__getitem__): factor} if trees else {}
        peers |= {KISS: 15} if model == RAY and KISS in medians else {}
        for peer, limit in peers.items():
            rows.append(
                (f"{model}: times faster than {peer} {where}", medians[peer] / medians[model], ">=", limit, "x")
            )
        rows.append((f"{model}: of the time of a copy {where}", medians[model] / medians[COPY], "<=", copies, "x"))
        if model == RAY:
            rows.append((f"{model}: time {where}", medians[model], "<=", 8, "ms"))
    if threads:
        rows.append((f"{RAY}: two threads against one", threads["ratio"], ">=", 1.6, "x"))
    for model in (HEIGHT_BAND, RAY):
        for kind in ("slope", "steepest step"):
            what = f"{model}: {kind} of log time over log points, to {max(points['points'])} points"
            rows.append((what, points[model][kind], "<=", 1, ""))
    return run.verdicts(rows)


def picture(record: dict[str, Any], path: Path) -> None:
    """Draw all contenders on a log scale, and how the cost grows."""
    figure = Figure(figsize=(13, 10), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(1.5, 1))
    for ax, size in zip(upper.subplots(1, 2), SIZES, strict=True):
        _bars(ax, [c for c in record["comparisons"] if c["size"] == size])
    left, right = lower.subplots(1, 2)
    points, cells = record["cost of points"], record["cost of cells"]
    _curves(left, points, points["points"], [f"{n / 1000:,.0f}k" for n in points["points"]])
    left.set_xlabel("points per scan (synthetic street), 512 x 352 cells")
    _curves(right, cells, cells["cells"], [f"{nx} x {ny}" for nx, ny in cells["shapes"]])
    right.set_xlabel("cells over the same area, 120 000 points")
    figure.suptitle(
        "One lidar scan to one occupancy grid, on one core: median time\n"
        "OctoMap and KISS-SLAM build 3D maps and do more work: they answer a larger question",
        fontsize=13,
    )
    save_picture(figure, path, caption(record))


def _bars(axes: Axes, comparisons: list[dict[str, Any]]) -> None:
    """Draw the times on the first scan as bars, the times on other scans as marks."""
    first, *others = ({name: times.median for name, times in one["times"].items()} for one in comparisons)
    first = dict(sorted(first.items(), key=lambda item: item[1]))
    colours = dict.fromkeys(first, PEER) | dict.fromkeys((HEIGHT_BAND, RAY, LOCAL), OURS)
    colours |= dict.fromkeys((PYTHON, NUMPY), TWIN) | {COPY: FLOOR}
    draw_times(axes, first, colours, f"{comparisons[0]['points']:,} points; bars: {comparisons[0]['scan']}")
    for medians, comparison, marker in zip(others, comparisons[1:], "o^sD", strict=False):
        rows = [(medians[name], row) for row, name in enumerate(reversed(first)) if name in medians]
        axes.plot(*zip(*rows, strict=True), marker, color="black", ms=5, mfc="white", label=comparison["scan"])
    labels = {"ogm": OURS, "other libraries": PEER, "HeightBandISM by hand": TWIN, "copy": FLOOR}
    for label, colour in labels.items():
        axes.bar(0, 0, color=colour, label=label)
    axes.grid(axis="x", alpha=0.3)
    axes.legend(loc="upper right", fontsize=9)


def _curves(axes: Axes, costs: dict[str, Any], sizes: list[int], labels: list[str]) -> None:
    """Draw time over size for both models."""
    for model, colour in ((RAY, OURS), (HEIGHT_BAND, "#7fbf7b")):
        times = costs[model]["times"]
        medians = [t.median for t in times]
        axes.plot(sizes, medians, "o-", color=colour, label=f"{model}: slope {costs[model]['slope']:.2f}")
        axes.fill_between(sizes, [t.low for t in times], [t.high for t in times], color=colour, alpha=0.2)
    last = costs[RAY]["times"][-1].median
    axes.plot(sizes, [last * size / sizes[-1] for size in sizes], ":", color="black", linewidth=1, label="linear")
    lowest = min(t.median for t in costs[HEIGHT_BAND]["times"])
    axes.set(xscale="log", yscale="log", ylim=(lowest / 2, last * 2), ylabel="ms per scan")
    axes.set_xticks(sizes, labels)
    axes.set_xticks([], minor=True)
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=9)


def main() -> None:
    parser = run.Parser(__doc__, picture=True, quick=True)
    parser.add_argument("--scan", type=Path, help="measure on this scan, beside the synthetic one")
    parser.add_argument("--repeats", type=int, help="rounds (default 9; 1 with --table); at least 3 for slow peers")
    parser.add_argument("--table", action="store_true", help="measure the table of docs/speed.md alone, and print it")
    options = parser.parse_args()
    if options.table:
        shipped = make.real_scans(None)[-1]
        found = [compare(shipped, size, options.repeats or 1) for size in SIZES]
        sys.path.append(str(run.ROOT / "docs"))
        from speed_tables import speed  # only now: it is no module of the benchmarks

        print(f"\n{speed(_named(found))}")
        return
    rounds = 1 if options.quick else options.repeats or 9
    record = run.environment("ray", "height-band")
    real = make.real_scans(options.scan) if options.scan or not options.quick else []
    synthetic = {
        size: NamedScan("synthetic street", make.street(*of), STREET_HEIGHT, "made by this benchmark: street()")
        for size, of in SIZES.items()
    }
    record["grid"] = {"shape": SPEC.shape, "resolution [m]": SPEC.resolution, "max range, 3D [m]": MAX_RANGE}
    record["bytes to copy"] = {s: count * 16 + math.prod(SPEC.shape) * 8 for s, (count, _) in SIZES.items()}
    record["scans"] = {scan.name: scan.source for scan in (*real, synthetic["120k"])}
    record["new process [s]"] = first_calls()
    scans = [dict.fromkeys(SIZES, scan) for scan in real] + [synthetic]
    scans = scans[:1] if options.quick else scans
    record["comparisons"] = [compare(scan[size], size, rounds) for scan in scans for size in SIZES]
    streets = [make.street(count) for count in COUNTS if not options.quick or count <= 300_000]
    counts = [len(points) for points in streets]
    record["cost of points"] = {"points": counts, **cost(counts, [(SPEC, p) for p in streets], rounds)}
    specs = [GridSpec.centered(SPEC.length, SPEC.width, resolution) for resolution in RESOLUTIONS]
    cells, shapes = [math.prod(spec.shape) for spec in specs], [spec.shape for spec in specs]
    by_cells = cost(cells, [(spec, synthetic["120k"].points) for spec in specs], rounds)
    record["cost of cells"] = {"cells": cells, "shapes": shapes, **by_cells}
    timed = scans[0]["120k"]
    record["steps of RayISM"] = {"scan": timed.name, "times": steps(timed, rounds)}
    record["planar scan"] = planar(rounds)
    record["two threads"] = two_threads(timed)
    record["verdicts"] = verdicts(record["comparisons"], record["cost of points"], record["two threads"])
    record["note"] = NOTE
    run.write_record(options.out, _named(record))
    picture(record, options.picture)


def _named(value: Any) -> Any:
    """Give times their names for the file."""
    if isinstance(value, Times):
        return {UNITS.get(key, key): v for key, v in value._asdict().items()}
    if isinstance(value, dict):
        return {key: _named(v) for key, v in value.items()}
    return [_named(v) for v in value] if isinstance(value, list) else value


if __name__ == "__main__":
    main()
