"""What does a map in tiles cost: a scan, a window, a cell on disk, a merge, a long drive? Measured.

    python benchmarks/world.py DRIVES [--kilometres N] [--quick]

DRIVES is a data set with sequences that `ogm simulate` made, of one town; the command of the record is in
benchmarks/README.md. One core. Writes benchmarks/results/world.json.
"""

import _run as run  # first: it sets the number of threads

# isort: split
import resource
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from _timing import resident
from numcodecs import Zstd

from ogm.datasets import open_dataset
from ogm.fusion import EvidentialMapper, map_scans, rolling_window
from ogm.fusion.pipeline import grid_pose
from ogm.grid import EvidentialGrid, GridSpec
from ogm.models import load_model
from ogm.pose import pose
from ogm.world import WorldMap, build_world
from ogm.world.kernels import merge
from ogm.world.layout import LAYERS, WORLD_RULES

SPEC = GridSpec.centered()
Scans = list[tuple[EvidentialGrid, np.ndarray, float]]


def main() -> None:
    parser = run.Parser(__doc__, quick=True)
    parser.add_argument("drives", type=Path)
    parser.add_argument("--kilometres", type=float, default=20.0, help="length of the long drive (20)")
    options = parser.parse_args()
    record: dict[str, Any] = run.environment("ray") | {"cells": "512 x 352 of 0.16 m, tiles of 512 x 512"}
    dataset = open_dataset(options.drives, split="sequences")
    parts = {f"drive-{n}": dataset.select(numbers) for n, numbers in enumerate(dataset.sequences.values())}
    if options.quick:
        parts = {name: part[:12] for name, part in list(parts.items())[:2]}
    with tempfile.TemporaryDirectory(dir=options.out.parent if options.out.parent.is_dir() else None) as folder:
        base = Path(folder)
        scans = first_scans(parts["drive-0"], 20 if options.quick else 60)
        record["integrate"] = integrating(scans, base)
        record["merge"] = {rule: merging(scans, rule) for rule in WORLD_RULES}
        record["drive"] = long_drive(scans[0][0], base / "long", 0.5 if options.quick else options.kilometres)
        with WorldMap.create(base / "town") as world:
            start = time.perf_counter()
            build_world(world, parts, load_model("ray+radar", SPEC))
            record["build"] = {
                "drives": len(parts),
                "frames": sum(map(len, parts.values())),
                "seconds": round(time.perf_counter() - start, 1),
            }
            start = time.perf_counter()
            record["build"]["levels"] = world.build_overviews()
            record["build"]["overviews_seconds"] = round(time.perf_counter() - start, 2)
        with WorldMap.open(base / "town") as world:
            record["disk"] = on_disk(world, base / "town")
            record["window"] = windows(world, 20 if options.quick else 200)
    run.write_record(options.out, record)


def first_scans(frames: Any, count: int) -> Scans:
    """Return measurement grids, their poses and stamps."""
    model = load_model("ray+radar", SPEC)
    return [(grid, grid_pose(frame), float(frame.stamp)) for frame, grid in map_scans(frames[:count], model)]


def integrating(scans: Scans, base: Path) -> dict[str, Any]:
    """Time a scan into the map in tiles and into the mapper, in turn, with all tiles in memory."""
    kinds: dict[str, Callable[[EvidentialGrid, np.ndarray, float], Any]] = {}
    for dtype in ("uint16", "float32"):
        world = WorldMap.create(base / dtype, dtype=dtype)  # type: ignore[arg-type]
        kinds[f"WorldMap, {dtype}"] = lambda grid, T, stamp, world=world: world.integrate(grid, T, stamp=stamp)
    for name, spec in (("512 x 352", SPEC), ("624 x 624", rolling_window(SPEC))):
        mapper = EvidentialMapper(spec)
        kinds[f"EvidentialMapper, {name}"] = lambda grid, T, stamp, mapper=mapper: mapper.update(grid, T, stamp=stamp)
    times: dict[str, list[float]] = {name: [] for name in kinds}
    for lap in range(6):  # the first one reads tiles and fills caches
        for grid, T, stamp in scans:
            for name, integrate in kinds.items():
                start = time.perf_counter()
                integrate(grid, T, stamp + 60.0 * lap)
                if lap:
                    times[name].append(time.perf_counter() - start)
    ms = {name: [round(1e3 * float(q), 3) for q in np.percentile(one, (50, 25, 75))] for name, one in times.items()}
    ratio = {name: round(ms["WorldMap, uint16"][0] / ms[name][0], 2) for name in ms if "Mapper" in name}
    return {"ms": ms, "ratio": ratio, "scans": len(times["WorldMap, uint16"])}


def merging(scans: Scans, rule: str) -> float:
    """Return the cells per second that are merged, of tiles in memory."""
    with tempfile.TemporaryDirectory() as folder, WorldMap.create(Path(folder) / "map", rule=rule) as world:  # type: ignore[arg-type]
        for grid, T, stamp in scans[:20]:
            world.integrate(grid, T, stamp=stamp)
        tiles = [world.tile(index) for index in world.tiles()]
        seconds = []
        for _ in range(8):
            fresh = [tile.copy() for tile in tiles]
            start = time.perf_counter()
            for tile, other in zip(fresh, tiles[1:] + tiles[:1], strict=True):
                merge(tile, other, WORLD_RULES[rule], 0.98)
            seconds.append(time.perf_counter() - start)
    rate = sum(tile[0].size for tile in tiles) / float(np.median(seconds[1:]))
    return round(rate / 1e6, 1)


def long_drive(grid: EvidentialGrid, url: Path, kilometres: float) -> dict[str, Any]:
    """Drive straight on at 20 scans per 20 m, with 200 MB of tiles in memory, and watch memory and times."""
    seconds, memory = [], []
    per_kilometre = 1000
    with WorldMap.create(url, memory=200e6) as world:
        for k in range(int(kilometres * per_kilometre)):
            T = pose(float(k), 0.05 * k, yaw=0.05 + 0.2 * np.sin(0.01 * k))
            start = time.perf_counter()
            world.integrate(grid, T, stamp=0.05 * k)
            seconds.append(time.perf_counter() - start)
            if k % per_kilometre == per_kilometre - 1:
                memory.append(round(resident()))
        tiles = len(world.tiles())
        start = time.perf_counter()
    closing = time.perf_counter() - start
    ms = 1e3 * np.array(seconds)
    return {
        "kilometres": kilometres,
        "scans": len(seconds),
        "tiles": tiles,
        "ms_median": round(float(np.median(ms)), 2),
        "ms_mean": round(float(ms.mean()), 2),
        "ms_99": round(float(np.percentile(ms, 99)), 1),
        "ms_most": round(float(ms.max()), 1),
        "hz_mean": round(1e3 / float(ms.mean()), 1),
        "resident_mb": memory,
        "peak_mb": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3),
        "closing_seconds": round(closing, 2),
    }


def on_disk(world: WorldMap, folder: Path) -> dict[str, Any]:
    """Return the bytes per seen cell: of the tiles, and of each layer packed as they are."""
    codec, sizes, seen = Zstd(3), np.zeros(len(LAYERS)), 0
    for index in world.tiles():
        tile = world.tile(index)
        seen += int((tile[4] > 0).sum())
        for k, layer in enumerate(tile):
            parts = [layer[i : i + 256, j : j + 256] for i in (0, 256) for j in (0, 256)]
            sizes[k] += sum(len(codec.encode(np.ascontiguousarray(part))) for part in parts)
    by_layer = dict(zip(LAYERS, (round(float(one), 3) for one in sizes / seen), strict=True))

    def stored(name: str) -> float:
        return round(sum(one.stat().st_size for one in (folder / name).rglob("*") if one.is_file()) / seen, 3)

    return {
        "seen_cells": seen,
        "tiles": len(world.tiles()),
        "bytes_per_seen_cell": {
            "masses": round(by_layer["free"] + by_layer["occupied"], 3),
            "all layers": stored("0"),
            "overviews": stored("1"),
            "sub-maps of drives": stored("drives"),
        },
        "by_layer": by_layer,
    }


def windows(world: WorldMap, count: int) -> dict[str, Any]:
    """Time the reading of windows of 512 x 352 cells at random places of the map, none of them in memory."""
    area, rng, seconds = world.cells(), np.random.default_rng(0), []
    for _ in range(count):
        i, j = (int(rng.integers(0, n - m)) for n, m in zip(area.shape, SPEC.shape, strict=True))
        spec = GridSpec(0.16, SPEC.shape, (area.origin[0] + i * 0.16, area.origin[1] + j * 0.16))
        start = time.perf_counter()
        world.window(spec)
        seconds.append(time.perf_counter() - start)
    low, median, high = (round(1e3 * float(q), 2) for q in np.percentile(seconds, (25, 50, 75)))
    return {"ms": [median, low, high], "windows": count}


if __name__ == "__main__":
    main()
