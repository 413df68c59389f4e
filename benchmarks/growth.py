"""How do time and memory grow with points, cells, scans and sensors? Their exponents.

    python benchmarks/growth.py [--only NAME] [--quick]

One core, each size in a process of its own; the exponent is fitted to the upper half of the sizes, which the fixed
cost of a call disturbs least. Writes benchmarks/results/growth.json and docs/pictures/growth.png.
"""

import _run as run  # first: it sets the number of threads
from _contenders import STREET_HEIGHT, street

# isort: split
import gc
import itertools
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from _charts import caption, save_picture
from _timing import Contender, once, peak_memory, resident
from fusion_speed import PERIOD, drive
from matplotlib.figure import Figure

from ogm import Frame, GridSpec, Mount, Scan
from ogm.fusion import EvidentialMapper, fuse
from ogm.geometric import RayISM
from ogm.models import load_model
from ogm.pose import pose

SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)  # 512 x 352 cells
COARSE = GridSpec.centered(length=81.92, width=56.32, resolution=0.32)
POINTS, POINTS_OF_MANY = 120_000, 20_000  # of a scan; of the scan of each of several lidars
SECONDS, CALLS = 2.0, 5  # a size is called until it took so long in all, at least once and at most so often
QUICK = 3  # sizes of a part with --quick
LINEAR, FLAT = 1.1, 0.05  # highest exponents
LEAST = 1.0  # [MB] a smaller peak is pages of the allocator: the exponent takes this instead
Call = Callable[[], object]


class Part(NamedTuple):
    """Work of growing size: `prepare` makes the input of a size, and returns a function that builds a call of it."""

    title: str
    unit: str
    sizes: tuple[int, ...]
    prepare: Callable[[int], Callable[[], Call]]
    limit: float = LINEAR


def points_of(model: str) -> Callable[[int], Callable[[], Call]]:
    def prepare(size: int) -> Callable[[], Call]:
        ism, scan = load_model(model, SPEC, Mount(STREET_HEIGHT)), street(size)
        ism(street(POINTS))
        return lambda: lambda: ism(scan)

    return prepare


def finer(cells: int) -> GridSpec:
    """Return about as many cells over the area of `SPEC`."""
    side = math.sqrt(SPEC.length * SPEC.width / cells)
    return GridSpec(side, (round(SPEC.length / side), round(SPEC.width / side)), SPEC.origin)


def scan_of_cells(size: int) -> Callable[[], Call]:
    points, spec = street(POINTS), finer(size)
    RayISM(SPEC, Mount(STREET_HEIGHT))(points)

    def build() -> Call:
        ism = RayISM(spec, Mount(STREET_HEIGHT))
        return lambda: ism(points)

    return build


def updates(spec: GridSpec, scans: int) -> Callable[[], Call]:
    """Return a function that fuses all but one of so many scans, and returns the update by a further one."""
    grid = RayISM(spec, Mount(STREET_HEIGHT))(street(POINTS))
    EvidentialMapper(COARSE).update(grid, pose(), stamp=0.0)

    def build() -> Call:
        mapper, ahead = EvidentialMapper(spec), drive()

        def update() -> None:
            T, stamp = ahead()
            mapper.update(grid, T, stamp=stamp)

        for _ in range(scans - 1):
            update()
        return update

    return build


def moment_of_sensors(size: int) -> Callable[[], Call]:
    """Return a function that builds the fusion of one moment of so many lidars, turned on one mast."""
    turns = [pose(yaw=2 * math.pi * k / size) for k in range(size)]
    mounts = {f"lidar {k}": Mount(STREET_HEIGHT, T) for k, T in enumerate(turns)}
    models = {name: RayISM(SPEC, mount) for name, mount in mounts.items()}
    scans = {name: Scan(street(POINTS_OF_MANY), sensor=name) for name in mounts}
    models["lidar 0"](scans["lidar 0"])

    def build() -> Call:
        mapper, moments = EvidentialMapper(SPEC), itertools.count()

        def moment() -> None:
            stamp = PERIOD * next(moments)
            frames = [Frame(scans[name], mount, T_map_sensor=mount.T_vehicle_sensor, stamp=stamp)
                      for name, mount in mounts.items()]  # fmt: skip
            if failed := [step.error for step in fuse(frames, models, mapper) if step.error]:
                raise failed[0]

        return moment

    return build


MILLIONS = (10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000, 10_000_000, 20_000_000)
CELLS = (10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000, 10_000_000, 30_000_000, 100_000_000)
PARTS = {
    "points, ray": Part("`RayISM`, one scan", "points", MILLIONS, points_of("ray")),
    "points, combined": Part("`combined`, one scan", "points", MILLIONS, points_of("combined")),
    "cells, ray": Part("`RayISM`, one scan", "cells", CELLS, scan_of_cells),
    "cells, map": Part("map, one update", "cells", CELLS, lambda size: updates(finer(size), 2)),
    "scans, map": Part(
        "map, one update", "scans", tuple(10**k for k in range(6)), lambda size: updates(COARSE, size), FLAT
    ),
    "sensors": Part("`RayISM` and map, one moment", "lidars", (1, 2, 4, 8, 16), moment_of_sensors),
}


def measured(name: str, size: int) -> dict[str, float]:
    """Return the median time of a call and the peak of memory until its end, without its input."""
    build = PARTS[name].prepare(size)
    gc.collect()
    Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    before = resident()
    call = build()
    call()
    peak, seconds = peak_memory() - before, [once(Contender(lambda _: call()))[0]]
    while len(seconds) < CALLS and sum(seconds) < SECONDS:
        seconds.append(once(Contender(lambda _: call()))[0])
    return {"size": size, "time [ms]": 1e3 * statistics.median(seconds), "peak memory [MB]": peak}


def exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """Return the slope of log value over log size by least squares, over the upper half of the sizes."""
    half = len(sizes) // 2
    return float(np.polyfit(np.log(sizes[half:]), np.log(values[half:]), 1)[0])


def grown(name: str, sizes: Sequence[int]) -> dict[str, Any]:
    """Measure a part at all sizes, each in a new process."""
    rows = []
    for size in sizes:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
            rows.append(process.submit(measured, name, size).result())
        print(f"{name}: {size:,}: {rows[-1]['time [ms]']:.3g} ms, {rows[-1]['peak memory [MB]']:.4g} MB", flush=True)
    columns = {key: [row[key] for row in rows] for key in rows[0]}
    exponents = {
        "time [ms]": exponent(sizes, columns["time [ms]"]),
        "peak memory [MB]": exponent(sizes, [max(peak, LEAST) for peak in columns["peak memory [MB]"]]),
    }
    return {"title": PARTS[name].title, "unit": PARTS[name].unit, **columns, "exponents": exponents}


def verdicts(parts: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    return run.verdicts(
        (f"{name}: exponent of {key.rpartition(' ')[0]}", value, "<=", PARTS[name].limit, "")
        for name, part in parts.items()
        for key, value in part["exponents"].items()
    )


def picture(record: Mapping[str, Any], path: Path) -> None:
    """Draw time and memory over the sizes, a column for each kind of size."""
    units = list(dict.fromkeys(part["unit"] for part in record["parts"].values()))
    figure = Figure(figsize=(13, 6), layout="constrained")
    axes = figure.subplots(2, len(units), squeeze=False)
    for part in record["parts"].values():
        column = units.index(part["unit"])
        for ax, key in zip(axes[:, column], part["exponents"], strict=True):
            title = f"{part['title'].replace('`', '')}: {part['exponents'][key]:.2f}"
            ax.loglog(part["size"], part[key], "o-", lw=1.2, ms=4, label=title)
            ax.set(xlabel=part["unit"], ylabel=key)
    for ax in axes.flat:
        ax.grid(alpha=0.3)
        ax.legend(fontsize=8, frameon=False, title="exponent", title_fontsize=8)
    save_picture(figure, path, caption(record["environment"]))


def main() -> None:
    parser = run.Parser(__doc__, picture=True, quick=True)
    parser.add_argument("--only", choices=PARTS, help="measure one part alone")
    given = parser.parse_args()
    environment = run.environment("ray", "combined", "revise")
    names = [given.only] if given.only else list(PARTS)
    parts = {name: grown(name, PARTS[name].sizes[: QUICK if given.quick else None]) for name in names}
    record = {"environment": environment, "parts": parts, "verdicts": verdicts(parts)}
    run.write_record(given.out, record)
    picture(record, given.picture)


if __name__ == "__main__":
    main()
