"""Twenty drives into one map by one worker and many, in S3 the same, and 1e9 cells: what do they take? Measured.

    python benchmarks/world_build.py DRIVES [--only NAME ...] [--quick]

DRIVES is a data set with sequences of one town that `ogm simulate` made; the command of the record is in
benchmarks/README.md. Two cores. `--only` measures one part anew and keeps the others of the record: town (the map by
two workers, by a Dask cluster of two, and by that cluster into an S3 server on this machine), workers (one against
two), cells (1e9, of synthetic tiles). Writes benchmarks/results/world_build.json and docs/pictures/world.png.
"""

import os

os.environ["OGM_CORES"] = "2"

import _run as run  # first: it sets the number of threads

# isort: split
import json
import resource
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from _object_store import s3_server
from _timing import resident
from distributed import LocalCluster
from numpy.typing import NDArray

from ogm.datasets import Dataset, open_dataset
from ogm.grid import EvidentialGrid, GridSpec
from ogm.models import load_model
from ogm.plot import conflict_panel, layer_panel, mass_panel, save_picture
from ogm.pose import pose
from ogm.world import Progress, WorldMap, build_world

MODEL = load_model("ray+radar", GridSpec.centered())
PARTS = ("town", "workers", "cells")
PATCH = 256  # [cells] along the side of the part of the town that synthetic tiles repeat
MEMORY = 200e6  # [byte] of tiles that the large map keeps in memory
Drives = Mapping[str, Dataset]


def main() -> None:
    parser = run.Parser(__doc__, picture=True, quick=True)
    parser.add_argument("drives", type=Path)
    parser.add_argument("--only", choices=PARTS, nargs="+", default=PARTS, help="parts to measure")
    parser.add_argument("--workers-drives", type=int, default=20, help="drives that one and two workers build (20)")
    parser.add_argument("--every", type=int, default=1, help="take every N-th scan of the drives (1)")
    parser.add_argument("--cells", type=float, default=1e9, help="cells of the large map (1e9)")
    parser.add_argument("--folder", type=Path, help="where maps are made; the town's stays there")
    options = parser.parse_args()
    record: dict[str, Any] = json.loads(options.out.read_text()) if options.out.exists() else {}
    dataset = open_dataset(options.drives, split="sequences")
    drives = {
        f"drive-{n:02d}": dataset.select(numbers[:: options.every])
        for n, numbers in enumerate(dataset.sequences.values())
    }
    if options.quick:
        drives = {name: part[:12] for name, part in list(drives.items())[:2]}
        options.cells = min(options.cells, 1e7)
    with tempfile.TemporaryDirectory(dir=options.folder) as temporary:
        base = options.folder or Path(temporary)
        for name in options.only:
            if name == "town":
                record[name] = run.environment("ray") | town(drives, base, Path(temporary))
                with WorldMap.open(base / "town") as world:
                    picture(world, record, options.picture)
            elif name == "workers":
                chosen = dict(list(drives.items())[: options.workers_drives])
                record[name] = run.environment("ray") | one_and_two(chosen, Path(temporary))
            else:
                with WorldMap.open(base / "town") as world:
                    patch = seen_patch(world)
                record[name] = run.environment("ray") | many_cells(patch, Path(temporary) / "cells", options.cells)
            record |= run.environment("ray")
            run.write_record(options.out, record)


def build(place: Mapping[str, Any], drives: Drives, **how: Any) -> float:
    """Build a map anew, with overviews; return the seconds without those."""
    with WorldMap.create(**place) as world:
        start = time.perf_counter()
        build_world(world, drives, MODEL, **how)
        seconds = time.perf_counter() - start
        world.build_overviews()
    return round(seconds, 1)


def town(drives: Drives, base: Path, temporary: Path) -> dict[str, Any]:
    """Build the town in a folder by two workers, there by a cluster, and in S3 by that; compare the maps."""
    found: dict[str, Any] = {"drives": len(drives), "frames": sum(map(len, drives.values())), "seconds": {}}
    here = {"url": base / "town"}
    found["seconds"]["two workers"] = build(here, drives, workers=2)
    one_thread = {"env": dict.fromkeys(run.THREADS, "1"), "threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(n_workers=2, **one_thread) as cluster, s3_server("maps") as storage:
        for name, place in (
            ("Dask, two workers", {"url": temporary / "dask"}),
            ("Dask, two workers, S3", {"url": "s3://maps/town", "storage": storage}),
        ):
            found["seconds"][name] = build(place, drives, scheduler=cluster.scheduler_address)
            found.setdefault("the same", {})[name] = same(here, place)
    with WorldMap.open(**here) as world:
        found["tiles"], found["levels"] = len(world.tiles()), world.levels
        found["seen_cells"] = sum(int((world.tile(index)[4] > 0).sum()) for index in world.tiles())
    return found


def same(first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    """Return whether two maps hold the same numbers in all layers of all tiles, and the same overviews."""
    with WorldMap.open(**first) as a, WorldMap.open(**second) as b:
        if a.levels != b.levels or a.tiles() != b.tiles():
            return False
        return all(
            a.store.tiles(level) == b.store.tiles(level)
            and all(
                np.array_equal(a.store.read_tile(index, level), b.store.read_tile(index, level))
                for index in a.store.tiles(level)
            )
            for level in range(a.levels)
        )


def one_and_two(drives: Drives, base: Path) -> dict[str, Any]:
    """Time the build by one worker and by two, all compiled before; by one also on the processor, in parts."""
    first = next(iter(drives))
    build({"url": base / "warm"}, {first: drives[first][:5]})
    marks: list[tuple[str, float]] = []

    def mark(event: Progress) -> None:
        marks.append((event.stage, time.process_time()))

    seconds = {"1": build({"url": base / "one"}, drives, progress=mark)}
    seconds["2"] = build({"url": base / "two"}, drives, workers=2)
    parts = {}
    for stage in ("sub-maps", "tiles"):
        times = [at for name, at in marks if name == stage]
        parts[stage] = {"tasks": len(times) - 1, "cpu_seconds": round(times[-1] - times[0], 2)}
    return {
        "drives": len(drives),
        "frames": sum(map(len, drives.values())),
        "seconds": seconds,
        "gain": round(seconds["1"] / seconds["2"], 2),
        "one worker": parts,
        "the same": same({"url": base / "one"}, {"url": base / "two"}),
        "bytes": {name: sum(sizes(base / "one" / name)) for name in ("0", "drives")},
        "objects": {name: len(sizes(base / "one" / name)) for name in ("0", "drives")},
        "load": [round(one, 2) for one in os.getloadavg()],
    }


def seen_patch(world: WorldMap) -> EvidentialGrid:
    """Return a square of the town, mirrored to 510 x 510 cells, in which nearly all was seen."""
    spec = world.cells()
    known = world.window(spec).mass.sum(axis=-1) > 0
    sums = known.cumsum(axis=0, dtype=np.int64).cumsum(axis=1)
    sums = np.pad(sums, ((1, 0), (1, 0)))
    inside = sums[PATCH:, PATCH:] - sums[:-PATCH, PATCH:] - sums[PATCH:, :-PATCH] + sums[:-PATCH, :-PATCH]
    i, j = np.unravel_index(inside.argmax(), inside.shape)
    low = [o + 0.16 * int(k) for o, k in zip(spec.origin, (i, j), strict=True)]
    p = world.window(GridSpec(0.16, (PATCH, PATCH), (low[0], low[1]))).mass[:-1, :-1]
    p[p.sum(axis=-1) == 0] = 0.1
    mass = np.concatenate([np.concatenate([p, p[:, ::-1]], axis=1), np.concatenate([p[::-1], p[::-1, ::-1]], axis=1)])
    return EvidentialGrid(GridSpec(0.16, mass.shape[:2], (0.16, 0.16)), mass)


def many_cells(grid: EvidentialGrid, url: Path, cells: float) -> dict[str, Any]:
    """Integrate a grid into as many tiles as there are cells, each tile once; watch memory, time and space."""
    per_tile = grid.mass.shape[0] * grid.mass.shape[1]
    count = int(np.ceil(cells / per_tile))
    columns = int(np.ceil(np.sqrt(count)))
    memory, begin = [], time.perf_counter()
    with WorldMap.create(url, memory=MEMORY) as world:
        for n in range(count):
            i, j = divmod(n, columns)
            world.integrate(grid, pose(i * 81.92, j * 81.92), stamp=float(n))
            if (n + 1) * 20 // count > n * 20 // count:  # twenty times
                memory.append(resident())
                print(f"  {(n + 1) / count:.0%} {memory[-1]:.0f} MB", flush=True)
    seconds = time.perf_counter() - begin
    begin = time.perf_counter()
    with WorldMap.open(url, "r+", memory=MEMORY) as world:
        levels = world.build_overviews()
        memory.append(resident())
        overviews = time.perf_counter() - begin
        checked = [world.tile(index) for index in world.tiles()[:: max(count // 20, 1)]]
        whole = all(int((tile[4] == 1).sum()) == per_tile for tile in checked)
        tiles = len(world.tiles())
    return {
        "cells": count * per_tile,
        "tiles": tiles,
        "seconds": round(seconds, 1),
        "overviews_seconds": round(overviews, 1),
        "levels": levels,
        "bytes_per_cell": round(sum(sizes(url / "0")) / (count * per_tile), 3),
        "gigabytes": round(sum(sizes(url)) / 1e9, 2),
        "objects": len(sizes(url)),
        "resident_mb": [round(megabytes) for megabytes in memory],
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3),
        "tiles_checked": len(checked) if whole else 0,
    }


def sizes(folder: Path) -> list[int]:
    """Return the bytes of each file below a folder."""
    return [file.stat().st_size for file in folder.rglob("*") if file.is_file()]


def picture(world: WorldMap, record: Mapping[str, Any], path: Path) -> None:
    """Draw the town: masses, conflict, number of scans."""
    everything = world.cells()
    counts: NDArray[np.float32] = world.layers(everything)["count"]
    x, y = (np.flatnonzero((counts > 1).any(axis=axis)) for axis in (1, 0))
    corner = [low + 0.16 * float(one[0]) for low, one in zip(everything.origin, (x, y), strict=True)]
    spec = GridSpec(0.16, (int(np.ptp(x)) + 1, int(np.ptp(y)) + 1), (corner[0], corner[1]))
    grid, layers = world.window(spec), world.layers(spec)
    panels = [
        mass_panel(grid, f"town of {record['town']['drives']} drives"),
        conflict_panel(layers, "greatest conflict"),
        layer_panel(layers, "count", "number of scans"),
    ]
    save_picture(path, *panels)


if __name__ == "__main__":
    main()
