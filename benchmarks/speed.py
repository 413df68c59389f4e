"""How long does one scan take? ogm's two geometric models beside OctoMap, KISS-SLAM, and plain Python.

    python benchmarks/speed.py [--scan FILE] [--repeats N] [--quick]

Every contender gets the same points, the same origin and cells of the same size on one core, in one run.
What is compared, and what is not comparable about it, stands in benchmarks/README.md. Writes
benchmarks/results/speed.json and docs/pictures/speed.png.
"""

from _run import (
    DATA,
    FLOOR,
    OURS,
    PEER,
    PICTURES,
    RESULTS,
    ROOT,
    TWIN,
    Contender,
    Times,
    caption,
    environment,
    measure,
    silent,
    write_json,
)

# isort: split
import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm import GridSpec, read_points
from ogm.geometric import HeightBandISM, RayISM, local_ground, twins
from ogm.io import estimate_sensor_height

SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)  # 512 x 352 cells
MAX_RANGE = (
    math.hypot(SPEC.length, SPEC.width) / 2
)  # [m] the grid's far corner, where the 3D mappers stop too
SIZES = {"57.6k": (57_600, 32), "120k": (120_000, 64)}  # points, layers of the synthetic scan
COUNTS = (10_000, 30_000, 100_000, 300_000, 1_000_000, 2_000_000)
RESOLUTIONS = (0.32, 0.16, 0.08)  # [m] 256 x 176, 512 x 352, 1024 x 704 cells over the same area
ORIGIN = np.zeros(3)  # points come in the sensor's frame

HEIGHT_BAND, RAY, COPY = "HeightBandISM", "RayISM", "copy of the bytes it must read and write"
PYTHON, NUMPY = "HeightBandISM in plain Python", "HeightBandISM in numpy"
KISS, LOCAL, PATCHWORK = "KISS-SLAM mapper", "local_ground", "Patchwork++"
OCTOMAP = "OctoMap"  # all of its contenders' names begin so


@dataclass(frozen=True)
class Scan:
    """Points in the sensor's frame, how high the sensor is [m], and where they come from."""

    name: str
    points: NDArray[np.float32]
    sensor_height: float
    source: str

    def thinned(self, count: int) -> NDArray[np.float32]:
        """Return `count` of the points, drawn without replacement and in their order."""
        if len(self.points) <= count:
            return self.points
        kept = np.random.default_rng(0).choice(len(self.points), count, replace=False)
        return self.points[np.sort(kept)]


# --- Scans -----------------------------------------------------------------------------------------------


def street(count: int, layers: int = 64, sensor_height: float = 1.9, seed: int = 0) -> NDArray[np.float32]:
    """Make a scan of a simple street: a road with a slope of 3 %, house fronts all around, and parked cars.

    Every beam returns, from the nearest of them, with 2 cm of range noise.

    Parameters
    ----------
    count : int
        Points [rounded to a whole number per layer].
    layers : int
        Elevation rings, -25 to +2 degrees.
    sensor_height : float
        [m]
    seed : int
        Of the noise.

    Returns
    -------
    (N, 4) float32
        x, y, z [m] in the sensor's frame, intensity 0.5.
    """
    columns = round(count / layers)
    elevation = np.radians(np.linspace(2, -25, layers))[:, None]
    azimuth = (np.arange(columns) * 2 * math.pi / columns)[None, :]
    across = np.cos(elevation)
    beam = [across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation) + 0 * azimuth]
    beam = [np.where(np.abs(b) < 1e-9, 1e-9, b).ravel() for b in beam]

    slope = 0.03
    climb = beam[2] - slope * beam[0]
    distance = np.where(climb < 0, -sensor_height / np.minimum(climb, -1e-9), np.inf)  # road
    for k, wall in ((0, 70.0), (1, 14.0)):  # fronts at x = +-70 m, y = +-14 m
        distance = np.minimum(distance, wall / np.abs(beam[k]))
    for x, y in (
        (8, 4),
        (16, 4),
        (31, -5),
        (-9, -5),
        (-22, 4),
        (-35, -5),
        (48, 3),
    ):  # cars, 4.4 x 1.8 x 1.5 m
        bottom = slope * x - sensor_height
        enter, leave = np.zeros_like(distance), np.full_like(distance, np.inf)
        for b, low, high in zip(
            beam, (x - 2.2, y - 0.9, bottom), (x + 2.2, y + 0.9, bottom + 1.5), strict=True
        ):
            enter = np.maximum(enter, np.minimum(low / b, high / b))
            leave = np.minimum(leave, np.maximum(low / b, high / b))
        distance = np.where(enter < leave, np.minimum(distance, enter), distance)
    distance += np.random.default_rng(seed).normal(0, 0.02, distance.shape)
    return np.stack([*(distance * b for b in beam), np.full_like(distance, 0.5)], axis=1).astype(np.float32)


def real_scans() -> list[Scan]:
    """Return the real scans at hand: one ships with the package, one is the user's to download."""
    scans = []
    kitti = DATA / "kitti_odometry_00" / "000000.bin"
    if kitti.is_file():
        scans.append(
            Scan("KITTI HDL-64E", read_points(kitti), 1.73, "KITTI odometry, sequence 00, scan 000000")
        )
    else:
        print(f"no {kitti.name} of KITTI odometry under {DATA}: done without it")
    vls = [ROOT / "ogm" / "data" / "vls128_road.pcd.xz", *DATA.glob("nebula_apache2/vls128/*.pcd")]
    vls = [path for path in vls if path.is_file()]
    if vls:
        scans.append(
            Scan("VLS-128", read_points(vls[0]), 1.98, "VLS-128 on a road, TIER IV nebula, Apache-2.0")
        )
    return scans


def chosen_scan(path: Path) -> Scan:
    """Read the scan that the user named."""
    try:
        points = read_points(path)
    except (OSError, ValueError, ImportError) as error:
        raise SystemExit(str(error)) from None
    height = estimate_sensor_height(points)
    if height is None or height <= 0:
        raise SystemExit(f"{path}: no ground to be seen below the sensor, so its height is not known")
    return Scan(path.name, points, round(height, 2), f"{path.name}, sensor height estimated from the points")


# --- Contenders ------------------------------------------------------------------------------------------


def numpy_height_band(
    xyz: NDArray, z_low: float, z_high: float, spec: GridSpec, evidence: float
) -> NDArray[np.float32]:
    """Return the masses of the paper's geometric model, written in numpy: one line per return.

    All lines advance by one cell at a time, those that meet an occupied cell drop out. The sensor is at 0, 0.
    """
    x, y = xyz[(xyz[:, 2] > z_low) & (xyz[:, 2] < z_high), :2].astype(np.float64).T
    x0, x1, y0, y1 = spec.extent
    inside = spec.contains(x, y)
    share = np.ones_like(x)  # of the ray that lies in the grid
    for along, low, high in ((x, x0, x1), (y, y0, y1)):
        share = np.where(along < low, np.minimum(share, low / np.where(along < low, along, 1)), share)
        share = np.where(along >= high, np.minimum(share, high / np.where(along >= high, along, 1)), share)
    i, j = spec.index(x * share, y * share)
    i, j = np.clip(i, 0, spec.shape[0] - 1), np.clip(j, 0, spec.shape[1] - 1)
    occupied, free = np.zeros(spec.shape, bool), np.zeros(spec.shape, bool)
    occupied[i[inside], j[inside]] = True

    i0, j0 = (int(index) for index in spec.index(0.0, 0.0))
    di, dj = i - i0, j - j0
    steps = np.maximum(np.abs(di), np.abs(dj))
    order = np.argsort(steps)
    di, dj, steps = di[order], dj[order], steps[order]
    for n in range(steps.max(initial=-1) + 1):
        begun = np.searchsorted(steps, n)  # lines that are as long as this
        di, dj, steps = di[begun:], dj[begun:], steps[begun:]
        half, whole = steps, np.maximum(2 * steps, 1)
        u = i0 + np.sign(di) * ((2 * n * np.abs(di) + half) // whole)
        v = j0 + np.sign(dj) * ((2 * n * np.abs(dj) + half) // whole)
        going = ~occupied[u, v]
        free[u[going], v[going]] = True
        di, dj, steps = di[going], dj[going], steps[going]
    mass = np.zeros((*spec.shape, 2), np.float32)
    mass[free, 0] = mass[occupied, 1] = evidence / (evidence + 2)
    return mass


def own_contenders(points: NDArray[np.float32], sensor_height: float) -> dict[str, Contender]:
    """Return ogm's models, the yardstick of copying bytes, and the ground estimate alone."""
    band, ray = HeightBandISM(SPEC, sensor_height), RayISM(SPEC, sensor_height)
    mass = np.ones((*SPEC.shape, 2), np.float32)
    points_copy, mass_copy = np.empty_like(points), np.empty_like(mass)

    def copy(_: None) -> None:
        np.copyto(points_copy, points)
        np.copyto(mass_copy, mass)

    xyz, coarse = np.ascontiguousarray(points[:, :3]), GridSpec(1.0, (82, 57), SPEC.origin)
    return {
        HEIGHT_BAND: Contender(lambda _: band(points)),
        RAY: Contender(lambda _: ray(points)),
        COPY: Contender(copy),
        LOCAL: Contender(lambda _: local_ground(xyz, coarse, (0.0, 0.0, -sensor_height))),
    }


def twin_contenders(points: NDArray[np.float32], sensor_height: float) -> dict[str, Contender]:
    """Return what HeightBandISM does, in plain Python and in numpy."""
    ism = HeightBandISM(SPEC, sensor_height)
    low, high = ism.z_min - sensor_height, ism.z_max - sensor_height
    xyz = points[:, :3]
    return {
        NUMPY: Contender(lambda _: numpy_height_band(xyz, low, high, SPEC, ism.evidence)),
        PYTHON: Contender(
            lambda _: twins.height_band_mass(xyz, (0.0, 0.0, 0.0), low, high, 0.0, SPEC, ism.evidence),
            slow=True,
        ),
    }


def peers(points: NDArray[np.float32], sensor_height: float) -> tuple[dict[str, Contender], dict[str, str]]:
    """Return the peers that are installed, and for the others the reason why they are left out.

    Their points are put into the type they like best beforehand; a fresh, empty map is made for each call.
    """
    found: dict[str, Contender] = {}
    reasons: dict[str, str] = {}
    wide, narrow = points[:, :3].astype(np.float64), np.ascontiguousarray(points[:, :3])
    side = SPEC.resolution
    try:
        import pyoctomap

        def insert(lazy: bool, discretize: bool) -> Contender:
            return Contender(
                lambda tree: tree.insertPointCloud(wide, ORIGIN, MAX_RANGE, lazy, discretize),
                lambda: pyoctomap.OcTree(side),
                slow=True,
            )

        found[f"{OCTOMAP} (pyoctomap)"] = insert(False, False)
        found[f"{OCTOMAP} (pyoctomap), lazy"] = insert(True, False)
        found[f"{OCTOMAP} (pyoctomap), lazy, discretised"] = insert(True, True)
    except ImportError as error:
        reasons["pyoctomap"] = str(error)
    try:
        import octomap

        for suffix, lazy in (("", False), (", lazy", True)):
            found[f"{OCTOMAP} (octomap-python){suffix}"] = Contender(
                lambda tree, lazy=lazy: tree.insertPointCloud(wide, ORIGIN, MAX_RANGE, lazy),
                lambda: octomap.OcTree(side),
                slow=True,
            )
    except ImportError as error:
        reasons["octomap-python"] = str(error)
    try:
        from kiss_slam.kiss_slam_pybind import kiss_slam_pybind

        vector, pose = kiss_slam_pybind._Vector3fVector(narrow), np.eye(4)
        found[KISS] = Contender(
            lambda mapper: mapper._integrate_frame(vector, pose),
            lambda: kiss_slam_pybind._OccupancyMapper(side, MAX_RANGE),
        )
    except ImportError as error:
        reasons["kiss-slam"] = str(error)
    try:
        import pypatchworkpp

        parameters = pypatchworkpp.Parameters()
        parameters.verbose, parameters.sensor_height = False, sensor_height
        with silent():
            estimator = pypatchworkpp.patchworkpp(parameters)
        found[PATCHWORK] = Contender(lambda _: estimator.estimateGround(points))
    except ImportError as error:
        reasons["pypatchworkpp"] = str(error)
    return found, reasons


# --- Measurements ----------------------------------------------------------------------------------------

FIRST_CALLS = """
import json, time
start = time.perf_counter()
import numpy as np
from ogm import GridSpec
from ogm.geometric import HeightBandISM, RayISM
steps = {"import": time.perf_counter() - start}
spec = GridSpec.centered(81.92, 56.32, 0.16)
points = np.random.default_rng(0).uniform((-40, -25, -2, 0), (40, 25, 2, 1), (20000, 4)).astype(np.float32)
for model in (HeightBandISM, RayISM):
    ism = model(spec, sensor_height=1.8)
    start = time.perf_counter()
    ism(points)
    steps["first call of " + model.__name__] = time.perf_counter() - start
print(json.dumps(steps))
"""


def warm_up() -> dict[str, dict[str, float]]:
    """Return how long import and first calls take [s] in a new process, with nothing compiled and cached."""
    result = {}
    with tempfile.TemporaryDirectory() as cache:
        for state in ("cold (compiles)", "from the cache"):
            out = subprocess.run(
                [sys.executable, "-c", FIRST_CALLS],
                env=os.environ | {"NUMBA_CACHE_DIR": cache},
                capture_output=True,
                text=True,
                check=True,
            )
            result[state] = json.loads(out.stdout)
    return result


def compare(scan: Scan, size: str, rounds: int) -> dict[str, Any]:
    """Time all contenders on one scan."""
    points = scan.thinned(SIZES[size][0])
    others, reasons = peers(points, scan.sensor_height)
    small = twin_contenders(points, scan.sensor_height) if size == "57.6k" else {}
    times = measure(own_contenders(points, scan.sensor_height) | small | others, rounds)
    result: dict[str, Any] = {"scan": scan.name, "points": len(points), "left out": reasons, "times": times}
    if small:
        mass = HeightBandISM(SPEC, scan.sensor_height)(points).mass
        result["cells of HeightBandISM that differ from"] = {
            name: int((np.abs(mass - twin.run(None)) > 1e-6).any(axis=2).sum())
            for name, twin in small.items()
        }
    return result


def growth(sizes: NDArray, times: list[Times]) -> dict[str, float]:
    """Fit time ~ size ** slope, and find the steepest step from one size to the next."""
    x, y = np.log(sizes), np.log([t.median for t in times])
    slope = float(np.polyfit(x, y, 1)[0]) if len(x) > 1 else math.nan
    steps = np.diff(y) / np.diff(x)
    return {"slope": slope, "steepest step": float(steps.max(initial=-math.inf))}


def cost_of_points(counts: tuple[int, ...], rounds: int) -> dict[str, Any]:
    """Time both models on synthetic scans of growing size."""
    scans = [street(count) for count in counts]
    sizes = [len(points) for points in scans]
    result: dict[str, Any] = {"points": sizes}
    for model in (HeightBandISM, RayISM):
        ism = model(SPEC, sensor_height=1.9)
        runs = {str(len(points)): Contender(lambda _, p=points, ism=ism: ism(p)) for points in scans}
        times = list(measure(runs, rounds).values())
        result[model.__name__] = {"times": times, **growth(np.array(sizes), times)}
    return result


def cost_of_cells(rounds: int) -> dict[str, Any]:
    """Time both models on one synthetic scan and grids of one area with ever smaller cells."""
    points = street(120_000)
    specs = [GridSpec.centered(SPEC.length, SPEC.width, resolution) for resolution in RESOLUTIONS]
    cells = [math.prod(spec.shape) for spec in specs]
    result: dict[str, Any] = {"cells": cells, "shapes": [spec.shape for spec in specs]}
    for model in (HeightBandISM, RayISM):
        isms = [model(spec, sensor_height=1.9) for spec in specs]
        runs = {str(ism.spec.shape): Contender(lambda _, ism=ism: ism(points)) for ism in isms}
        times = list(measure(runs, rounds).values())
        result[model.__name__] = {"times": times, **growth(np.array(cells), times)}
    return result


# --- Verdict ---------------------------------------------------------------------------------------------


def fastest_octomap(times: dict[str, Times]) -> str | None:
    """Return the name of the fastest way to call OctoMap, options that spare it work included."""
    names = [name for name in times if name.startswith(OCTOMAP)]
    return min(names, key=lambda name: times[name].median) if names else None


def verdicts(comparisons: list[dict[str, Any]], points: dict[str, Any]) -> list[dict[str, Any]]:
    """Set the ratios beside what they have to reach."""
    found = []

    def add(what: str, got: float, wanted: float, unit: str, at_least: bool) -> None:
        met = got >= wanted if at_least else got <= wanted
        sign = ">=" if at_least else "<="
        found.append({"what": what, "got": got, "wanted": f"{sign} {wanted:g} {unit}".strip(), "met": met})

    for comparison in comparisons:
        times, where = comparison["times"], f"{comparison['scan']}, {comparison['points']} points"
        model, factor = (HEIGHT_BAND, 500) if comparison["size"] == "57.6k" else (RAY, 100)
        ours, octomap = times[model].median, fastest_octomap(times)
        if octomap:
            what = f"{model}: times faster than {octomap} ({where})"
            add(what, times[octomap].median / ours, factor, "x", at_least=True)
        if model == HEIGHT_BAND:
            add(f"{model}: of the time of a copy ({where})", ours / times[COPY].median, 12, "x", False)
        else:
            if KISS in times:
                add(
                    f"{model}: times faster than {KISS} ({where})",
                    times[KISS].median / ours,
                    15,
                    "x",
                    at_least=True,
                )
            add(f"{model}: time ({where})", ours, 8, "ms", at_least=False)
    for model in (HEIGHT_BAND, RAY):
        for kind in ("slope", "steepest step"):
            what = f"{model}: {kind} of log time over log points, to {max(points['points'])} points"
            add(what, points[model][kind], 1, "", at_least=False)
    return found


def report(record: dict[str, Any]) -> None:
    """Print the result."""
    print(f"\n{record['cpu']}, one of {record['cores']} cores, load {record['load at start']}")
    print("New process [s]:")
    for state, steps in record["new process [s]"].items():
        print(f"  {state:16}" + ", ".join(f"{name} {seconds:.2f}" for name, seconds in steps.items()))
    for comparison in record["comparisons"]:
        print(f"\n{comparison['scan']}, {comparison['points']} points: median (quartiles)")
        for name, times in sorted(comparison["times"].items(), key=lambda item: item[1].median):
            disturbed = f", on the core {times.on_core:.0%} of it" if times.on_core < 0.97 else ""
            print(f"  {name:44} {times}{disturbed}")
        for name, reason in comparison["left out"].items():
            print(f"  {name:44} left out: {reason}")
        for name, cells in comparison.get("cells of HeightBandISM that differ from", {}).items():
            print(f"  cells of HeightBandISM that differ from '{name}': {cells}")
    for axis, key in (("points", "cost of points"), ("cells", "cost of cells")):
        sizes = record[key][axis]
        print(f"\nCost over {axis}: " + ", ".join(f"{size:,}" for size in sizes))
        for model in (HEIGHT_BAND, RAY):
            cost = record[key][model]
            medians = ", ".join(f"{t.median:.2f}" for t in cost["times"])
            print(
                f"  {model:14} {medians} ms; slope {cost['slope']:.2f}, steepest {cost['steepest step']:.2f}"
            )
    print("\nWanted and measured")
    for verdict in record["verdicts"]:
        met = "met   " if verdict["met"] else "MISSED"
        print(f"  {met} {verdict['got']:8.4g}  wanted {verdict['wanted']:9} {verdict['what']}")
    print("\n" + record["note"])


# --- Picture ---------------------------------------------------------------------------------------------


def picture(record: dict[str, Any], path: Path) -> None:
    """Draw all contenders on a log scale, and how the cost grows."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 10), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=(1.5, 1))
    comparisons = record["comparisons"]
    for ax, size in zip(upper.subplots(1, 2), SIZES, strict=True):
        _bars(ax, [c for c in comparisons if c["size"] == size])
    left, right = lower.subplots(1, 2)
    points, cells = record["cost of points"], record["cost of cells"]
    _curves(left, points, "points", [f"{n / 1000:,.0f}k" for n in points["points"]])
    left.set_xlabel("points per scan (synthetic street), 512 x 352 cells")
    _curves(right, cells, "cells", [f"{nx} x {ny}" for nx, ny in cells["shapes"]])
    right.set_xlabel("cells over the same area, 120 000 points")
    figure.suptitle(
        "One lidar scan to one occupancy grid, on one core: median time\n"
        "OctoMap and KISS-SLAM build 3D maps and do more work: they answer a larger question",
        fontsize=13,
    )
    figure.supxlabel(caption(record), fontsize=7.5, color="#555555")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _bars(ax: Any, comparisons: list[dict[str, Any]]) -> None:
    times: dict[str, Times] = comparisons[0]["times"]
    names = sorted(times, key=lambda name: -times[name].median)
    ax.barh(range(len(names)), [times[n].median for n in names], color=[_colour(n) for n in names])
    for row, name in enumerate(names):
        median = times[name].median
        text = f"{median:.3g}" if median < 1000 else f"{median:.0f}"
        ax.text(1.02, row, f"{text} ms", va="center", transform=ax.get_yaxis_transform())
    for comparison, marker in zip(comparisons[1:], "o^sD", strict=False):
        rows = [row for row, name in enumerate(names) if name in comparison["times"]]
        medians = [comparison["times"][names[row]].median for row in rows]
        ax.plot(medians, rows, marker, color="black", markersize=5, mfc="white", label=comparison["scan"])
    labels = [n.replace(" of the bytes it", "\nof the bytes it").replace("), ", "),\n") for n in names]
    ax.set_yticks(range(len(names)), labels, fontsize=9)
    ax.set_xscale("log")
    ax.set_xlim(0.05, max(t.median for c in comparisons for t in c["times"].values()) * 2)
    ax.set_xlabel("ms per scan")
    ax.set_title(f"{comparisons[0]['points']:,} points; bars: {comparisons[0]['scan']}", fontsize=11)
    ax.grid(axis="x", alpha=0.3)
    ax.set_axisbelow(True)
    for colour, label in (
        (OURS, "ogm"),
        (PEER, "other libraries"),
        (TWIN, "HeightBandISM by hand"),
        (FLOOR, "copy"),
    ):
        ax.bar(0, 0, color=colour, label=label)
    ax.legend(loc="upper right", fontsize=9)


def _colour(name: str) -> str:
    if name in (HEIGHT_BAND, RAY, LOCAL):
        return OURS
    return FLOOR if name == COPY else TWIN if name in (PYTHON, NUMPY) else PEER


def _curves(ax: Any, cost: dict[str, Any], axis: str, labels: list[str]) -> None:
    sizes = np.array(cost[axis], float)
    for model, colour in ((RAY, OURS), (HEIGHT_BAND, "#7fbf7b")):
        times = cost[model]["times"]
        medians = np.array([t.median for t in times])
        ax.plot(sizes, medians, "o-", color=colour, label=f"{model}: slope {cost[model]['slope']:.2f}")
        ax.fill_between(sizes, [t.low for t in times], [t.high for t in times], color=colour, alpha=0.2)
    last = cost[RAY]["times"][-1].median
    ax.plot(sizes, last * sizes / sizes[-1], ":", color="black", linewidth=1, label="linear")
    ax.set_xscale("log")
    ax.set_yscale("log")
    low = min(t.median for t in cost[HEIGHT_BAND]["times"])
    ax.set_ylim(low / 2, last * 2)
    ax.set_xticks(sizes, labels)
    ax.set_xticks([], minor=True)
    ax.set_ylabel("ms per scan")
    ax.grid(alpha=0.3, which="both")
    ax.legend(fontsize=9)


# --- Command ---------------------------------------------------------------------------------------------

NOTE = """Read with care: OctoMap and the KISS-SLAM mapper are 3D mappers and do more work. They update
every voxel that a ray passes, in a tree or sparse grid that keeps a whole map, where ogm fills the cells of
one 2D grid. The ratios say what a 2D evidential grid saves where it is enough, not that those are worse."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scan", type=Path, help="measure on this scan, beside the synthetic one")
    parser.add_argument(
        "--repeats", type=int, default=9, help="rounds; at least 3 for what takes seconds (default 9)"
    )
    parser.add_argument("--quick", action="store_true", help="one scan, one round, up to 300 000 points")
    parser.add_argument("--out", type=Path, default=RESULTS / "speed.json", help="where the figures go")
    parser.add_argument("--picture", type=Path, default=PICTURES / "speed.png", help="where the picture goes")
    options = parser.parse_args()
    if options.repeats < 1:
        parser.error("--repeats must be at least 1")
    rounds = 1 if options.quick else options.repeats
    counts = tuple(c for c in COUNTS if not options.quick or c <= 300_000)

    record = environment()
    scans: list[Callable[[str], Scan]] = []
    found = [chosen_scan(options.scan)] if options.scan else [] if options.quick else real_scans()
    scans += [lambda size, scan=scan: scan for scan in found]
    scans.append(
        lambda size: Scan("synthetic street", street(*SIZES[size]), 1.9, "made by this benchmark: street()")
    )
    if options.quick:
        scans = scans[:1]
    record["grid"] = {"shape": SPEC.shape, "resolution [m]": SPEC.resolution, "max range, 3D [m]": MAX_RANGE}
    record["bytes to copy"] = {
        size: count * 16 + math.prod(SPEC.shape) * 8 for size, (count, _) in SIZES.items()
    }
    record["scans"] = {s.name: s.source for s in (make("120k") for make in scans)}
    print("a new process: compiling, then loading from the cache ...", flush=True)
    record["new process [s]"] = warm_up()
    record["comparisons"] = []
    for make in scans:
        for size in SIZES:
            scan = make(size)
            print(f"{scan.name}, {size} points ...", flush=True)
            record["comparisons"].append({"size": size, **compare(scan, size, rounds)})
    print("growth ...", flush=True)
    record["cost of points"] = cost_of_points(counts, rounds)
    record["cost of cells"] = cost_of_cells(rounds)
    record["verdicts"] = verdicts(record["comparisons"], record["cost of points"])
    record["note"] = NOTE
    report(record)
    write_json(options.out, _named(record))
    picture(record, options.picture)
    print(f"\nwrote {options.out} and {options.picture}")


UNITS = {"median": "median [ms]", "low": "quartile 25 [ms]", "high": "quartile 75 [ms]", "on_core": "on core"}


def _named(value: Any) -> Any:
    """Give times their names for the file."""
    if isinstance(value, Times):
        return {UNITS.get(key, key): v for key, v in value._asdict().items()}
    if isinstance(value, dict):
        return {key: _named(v) for key, v in value.items()}
    return [_named(v) for v in value] if isinstance(value, list) else value


if __name__ == "__main__":
    main()
