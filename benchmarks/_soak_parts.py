"""Parts of `soak.py`: models and maps over many scans, two streams in two threads, a scan of millions of points."""

import live  # first: it sets the number of threads

# isort: split
import gc
import itertools
import statistics
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import _run as run
import numpy as np
import psutil
from _contenders import STREET_HEIGHT, street
from _timing import Contender, once, peak_memory, resident
from numpy.typing import NDArray

from ogm import GridSpec, Mount, Scan, open_dataset
from ogm.deep import DeepISM
from ogm.fusion import DynamicMapper, EvidentialMapper, rolling_window
from ogm.geometric import RayISM
from ogm.pose import pose

SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
HUNDRED = 100  # scans whose latencies are taken together
WARM_UP = 300  # scans before the first hundred
PERIOD = 0.1  # [s] from scan to scan
Step = Callable[[int], object]


class Measured(NamedTuple):
    """A scan, and where it was taken."""

    scan: Scan
    T_map_sensor: NDArray[np.float64]


def drive() -> tuple[list[Measured], Mount, str]:
    """Return scans in the order in which they are mapped again and again, their mount, and what they are."""
    folder = run.DATA / "kitti_raw_0005"
    if folder.is_dir():
        frames = list(open_dataset(folder))
        order = list(live.there_and_back(len(frames), 2 * len(frames) - 2))
        scans = [Measured(frame.scan, frame.T_map_sensor) for frame in frames]
        return [scans[k] for k in order], frames[0].mount, "kitti_raw_0005, 24 scans there and back"
    rng, points = np.random.default_rng(0), street(120_000)
    scans = [Measured(Scan(points[rng.random(len(points)) < 0.9]), pose(z=STREET_HEIGHT)) for _ in range(20)]
    return scans, Mount(STREET_HEIGHT), "a synthetic street, 20 scans"


def ray(scans: list[Measured], mount: Mount, threads: int | None = None) -> Step:
    ism = RayISM(SPEC, mount)
    return lambda k: ism(scans[k % len(scans)].scan)


def network(scans: list[Measured], mount: Mount, threads: int | None = None) -> Step:
    ism = DeepISM.load("lite", mount=mount, threads=threads)
    return lambda k: ism(scans[k % len(scans)].scan)


def evidential(scans: list[Measured], mount: Mount, threads: int | None = None) -> Step:
    ism, mapper = RayISM(SPEC, mount), EvidentialMapper(rolling_window(SPEC))

    def step(k: int) -> None:
        scan, T = scans[k % len(scans)]
        mapper.update(ism(scan), T, stamp=PERIOD * k)
        mapper.view(SPEC)

    return step


def dynamic(scans: list[Measured], mount: Mount, threads: int | None = None) -> Step:
    ism, mapper = RayISM(SPEC, mount), DynamicMapper(SPEC)
    mapper.objects()  # from now on they are followed

    def step(k: int) -> None:
        scan, T = scans[k % len(scans)]
        mapper.update(ism(scan), T, stamp=PERIOD * k)
        mapper.objects()

    return step


CHAINS: dict[str, Callable[[list[Measured], Mount, int | None], Step]] = {
    "ray": ray,
    "evidential": evidential,
    "dynamic": dynamic,
    "network": network,
}


def many_scans(name: str, count: int) -> dict[str, Any]:
    """Map `count` scans; return latencies, memory, and what is left when model and map are gone."""
    scans, mount, source = drive()
    chain = CHAINS[name]
    chain(scans, mount, None)(0)  # libraries are loaded, kernels compiled, and their threads started
    gc.collect()
    process = psutil.Process()
    before = process.num_fds(), process.num_threads()
    step, numbers = chain(scans, mount, None), itertools.count()
    for _ in range(WARM_UP):
        step(next(numbers))
    mapped = Contender(step, lambda: next(numbers))
    wall, core, memory = np.empty(count), np.empty(count), []
    for k in range(count):
        if k % HUNDRED == 0:
            memory.append(resident())
        wall[k], core[k] = once(mapped)
    memory.append(resident())
    del step, mapped
    gc.collect()
    return {
        "source": source,
        "scans": count,
        "processor time": latencies(core),
        "wall time": latencies(wall),
        "memory [MB]": [round(one, 1) for one in memory],
        "memory grown [%]": grown(memory),
        "files left": process.num_fds() - before[0],
        "threads left": process.num_threads() - before[1],
    }


def latencies(seconds: NDArray[np.float64]) -> dict[str, Any]:
    """Return quantiles of the first and the last hundred, and of all hundreds [ms]."""
    blocks = 1e3 * seconds[: len(seconds) // HUNDRED * HUNDRED].reshape(-1, HUNDRED)
    p99 = np.percentile(blocks, 99, axis=1)
    return {
        "p99 of the first hundred [ms]": float(p99[0]),
        "p99 of the last hundred [ms]": float(p99[-1]),
        "last / first": float(p99[-1] / p99[0]),
        "median [ms]": float(np.median(blocks)),
        "medians of hundreds [ms]": np.round(np.median(blocks, axis=1), 3).tolist(),
        "p99 of hundreds [ms]": np.round(p99, 3).tolist(),
    }


def grown(memory: list[float]) -> float:
    """Return by how much the median of the last tenth exceeds that of the first [%]."""
    tenth = max(len(memory) // 10, 1)
    return 100 * (statistics.median(memory[-tenth:]) / statistics.median(memory[:tenth]) - 1)


def streams(seconds: float, rounds: int) -> dict[str, Any]:
    """Map one stream in one thread and two streams in two, in turns; return how many times as many scans two map.

    Each thread has a model and a map of its own, and computes with one thread.
    """
    scans, mount, source = drive()
    found = {}
    for name, chain in CHAINS.items():
        pair = [chain(scans, mount, 1) for _ in range(2)]
        numbers = [itertools.count(), itertools.count()]
        advance = [lambda step=step, at=at: step(next(at)) for step, at in zip(pair, numbers, strict=True)]
        for one in advance:
            one()
        count = max(int(seconds / timed(advance[:1], 5)[0] * 5), 2)
        ratios, cores = [], []
        for _ in range(rounds):
            one, _ = timed(advance[:1], count)
            two, core = timed(advance, count)
            ratios.append(2 * one / two)
            cores.append(core / two)
        found[name] = {
            "two threads / one": statistics.median(ratios),
            "least": min(ratios),
            "most": max(ratios),
            "cores used by two": statistics.median(cores),
        }
    return {"source": source, "rounds": rounds, "chains": found}


def timed(functions: list[Callable[[], object]], count: int) -> tuple[float, float]:
    """Call each function `count` times, in a thread each; return the time on the wall and on all cores [s]."""
    ready = threading.Barrier(len(functions) + 1)

    def repeat(function: Callable[[], object]) -> None:
        ready.wait()
        for _ in range(count):
            function()

    threads = [threading.Thread(target=repeat, args=(function,)) for function in functions]
    for thread in threads:
        thread.start()
    ready.wait()
    start, start_core = time.perf_counter(), time.process_time()
    for thread in threads:
        thread.join()
    return time.perf_counter() - start, time.process_time() - start_core


def many_points(count: int) -> dict[str, Any]:
    """Map a scan of very many points; return times and peaks of memory, or the error that refuses it."""
    base = street(120_000)
    points = np.tile(base, (-(-count // len(base)), 1))[:count]
    points[:, :3] += np.random.default_rng(0).normal(0, 0.05, (count, 3)).astype(np.float32)
    scan, mount = Scan(points), Mount(STREET_HEIGHT)
    models = {"RayISM": RayISM(SPEC, mount), "DeepISM lite": DeepISM.load("lite", mount=mount)}
    found: dict[str, Any] = {}
    for name, ism in models.items():
        ism(base)
        gc.collect()
        Path("/proc/self/clear_refs").write_text("5")  # peaks begin anew
        before, start, start_core = resident(), time.perf_counter(), time.process_time()
        try:
            grid, error = ism(scan), ""
        except (ValueError, MemoryError) as refused:
            grid, error = None, f"{type(refused).__name__}: {refused}"
        found[name] = {
            "wall time [s]": time.perf_counter() - start,
            "processor time [s]": time.process_time() - start_core,
            "memory before [MB]": before,
            "peak above that [MB]": peak_memory() - before,
            "refused": error,
            "known cells [%]": None if grid is None else 100 * float((grid.mass.sum(axis=-1) > 0).mean()),
        }
    return {"points": count, "bytes of the scan [MB]": points.nbytes / 1e6, "models": found}


def serving(folder: Path, minutes: float) -> dict[str, Any]:
    """Run `ogm serve` at 10 Hz with a viewer that comes and goes; return what it printed and what its process took."""
    frames, seconds = open_dataset(run.DATA / "kitti_raw_0005"), 60 * minutes
    path = live.drive_of_files(folder, frames, int((seconds + 30) * live.RATE))
    found = live.observe(path, seconds, stay=min(20.0, seconds / 6))
    settled = min(60.0, seconds / 3)  # [s] after which memory must be flat: 600 scans
    memory = [mb for at, mb in found["memory [s, MB]"] if at > settled]
    handles = [row for row in found["handles [s, files, threads, processor s]"] if row[0] > settled]
    tenth = max(len(handles) // 10, 2)
    first, last = handles[:tenth], handles[-tenth:]
    least = [[min(row[k] for row in part) for part in (first, last)] for k in (1, 2)]  # while no viewer is there
    load = [(part[-1][3] - part[0][3]) / (part[-1][0] - part[0][0]) for part in (first, last)]
    thin = max(len(found["memory [s, MB]"]) // 240, 1)
    return {
        "source": "kitti_raw_0005, 24 scans there and back",
        "minutes": minutes,
        "result": found["result"],
        "viewer": {key: found["viewer"][key] for key in ("messages", "connections", "MB/s")},
        "reports": [[one[key] for key in ("seconds", "p50 [ms]", "p99 [ms]")] for one in found["reports"]],
        "memory [s, MB]": found["memory [s, MB]"][::thin],
        "memory grown [%]": grown(memory),
        "files left": least[0][1] - least[0][0],
        "threads left": least[1][1] - least[1][0],
        "processor time, last tenth / first": load[1] / load[0],
    }
