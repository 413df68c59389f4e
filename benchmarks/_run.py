"""What the benchmarks share: one core, medians of interleaved rounds, and a record of the machine.

Importing this module pins the process to one core, and must therefore come before numpy is imported: the
thread pools of numba, OpenMP and BLAS read their sizes when they are loaded. A benchmark that is about several
cores sets OGM_CORES in ``os.environ`` before it imports this module: their number, and the process may use every core.
"""

import os

THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
CORES = int(os.environ.get("OGM_CORES", "1"))
os.environ.update(dict.fromkeys(THREADS, str(CORES)))
CORE = None
if CORES == 1 and hasattr(os, "sched_setaffinity"):  # Linux
    CORE = max(os.sched_getaffinity(0))
    os.sched_setaffinity(0, {CORE})
elif hasattr(os, "sched_setaffinity"):  # a benchmark that is pinned may have started this one
    os.sched_setaffinity(0, range(os.cpu_count() or 1))

import contextlib  # noqa: E402
import ctypes  # noqa: E402
import gc  # noqa: E402
import importlib.metadata  # noqa: E402
import json  # noqa: E402
import math  # noqa: E402
import platform  # noqa: E402
import sys  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable, Iterator, Mapping, Sequence  # noqa: E402
from dataclasses import dataclass  # noqa: E402
from datetime import UTC, datetime  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import TYPE_CHECKING, Any, NamedTuple  # noqa: E402

import numpy as np  # noqa: E402

from ogm.storage.files import atomic_write  # noqa: E402

if TYPE_CHECKING:
    from ogm.evaluation import Evaluation

ROOT = Path(__file__).resolve().parents[1]
RESULTS, PICTURES = ROOT / "benchmarks" / "results", ROOT / "docs" / "pictures"
DATA = Path(os.environ.get("OGM_DATA", ROOT.parent / "shared" / "data" / "real"))  # see benchmarks/README.md
PACKAGES = (
    *("rosbags", "mcap", "mcap-ros2-support"),
    *("numpy", "numba", "llvmlite", "open3d", "zarr", "dask", "obstore", "shapely", "torch", "onnxruntime", "openvino"),
    *("pyoctomap", "octomap-python", "kiss-slam", "pypatchworkpp"),
)
SLOW = 0.3  # [s] a call that takes longer is not repeated within a round
BURST = 0.05  # [s] how long a quick call is repeated within a round
MOST = 10  # calls per round
LONG, FEWEST = 10.0, 3  # [s] what has taken this long in all, in that many rounds, is not repeated further
BUSY = 0.5  # load beyond which other programs disturb the figures

# Colours of the pictures: ours, other people's, yardsticks
OURS, PEER, TWIN, FLOOR = "#1b7837", "#2c5f9e", "#8c8c8c", "#c9c9c9"


@dataclass(frozen=True)
class Contender:
    """What is timed: `run`, on what `prepare` made afresh. Neither making nor freeing that is in the time."""

    run: Callable[[Any], Any]
    prepare: Callable[[], Any] = lambda: None
    slow: bool = False  # seconds a call, and nothing to warm up: a single round goes without the extra call


class Times(NamedTuple):
    """Median and quartiles of one contender [ms], of how many calls, and the share of them on the core."""

    median: float
    low: float
    high: float
    calls: int
    on_core: float  # CPU time over wall time; less than 1 where other programs had the core

    def __str__(self) -> str:
        digits = 0 if self.median >= 100 else 1 if self.median >= 10 else 2 if self.median >= 0.3 else 3
        return f"{self.median:.{digits}f} ms ({self.low:.{digits}f} to {self.high:.{digits}f})"


def once(contender: Contender) -> tuple[float, float]:
    """Return the seconds that one call takes, on the wall and on the core."""
    state = contender.prepare()
    start, start_core = time.perf_counter_ns(), time.process_time_ns()
    result = contender.run(state)
    stop_core, stop = time.process_time_ns(), time.perf_counter_ns()
    del result, state
    return (stop - start) * 1e-9, (stop_core - start_core) * 1e-9


def measure(contenders: Mapping[str, Contender], rounds: int) -> dict[str, Times]:
    """Time every contender in every round, so that what disturbs the machine meets all of them alike.

    Each runs once beforehand (compilation, memory), except slow ones if there is only one round. A
    quick one runs once more at the start of each round, untimed, to bring its data back to the caches,
    and then several times. What has taken 10 s in all is left out from the fourth round on.
    """
    samples: dict[str, list[tuple[float, float]]] = {name: [] for name in contenders}
    last = {}
    for name, contender in contenders.items():
        last[name] = once(contender)[0] if rounds > 1 or not contender.slow else math.inf
    gc.collect()
    gc.disable()
    try:
        for n in range(rounds):
            for name, contender in contenders.items():
                if n >= FEWEST and sum(wall for wall, _ in samples[name]) > LONG:
                    continue
                if last[name] < SLOW:
                    once(contender)
                calls = min(max(int(BURST / last[name]), 1), MOST)
                samples[name] += [once(contender) for _ in range(calls)]
                last[name] = samples[name][-1][0]
    finally:
        gc.enable()
    result = {}
    for name, pairs in samples.items():
        wall, core = np.array(pairs).T
        low, median, high = (1e3 * np.percentile(wall, (25, 50, 75))).tolist()
        result[name] = Times(median, low, high, len(wall), round(float(core.sum() / wall.sum()), 3))
    return result


def environment() -> dict[str, Any]:
    """Return what a figure must be read with: command, date, machine, versions."""
    load = [round(value, 2) for value in os.getloadavg()] if hasattr(os, "getloadavg") else None
    if load and load[0] > BUSY:
        print(f"other programs run on this machine (load {load[0]}): its figures are good for ratios at best")
    versions = {}
    for package in PACKAGES:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[package] = importlib.metadata.version(package)
    words = (Path(word).name if Path(word).is_absolute() else word for word in sys.argv[1:])
    return {
        "command": " ".join([f"python benchmarks/{Path(sys.argv[0]).name}", *words]),
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "cores used": CORES,
        "pinned": CORE is not None,
        "load at start": load,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": versions,
    }


def _cpu() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def caption(record: Mapping[str, Any]) -> str:
    """Return one line with the machine and the date of a picture's figures."""
    versions = record["versions"]
    cores = "one core" if record["cores used"] == 1 else f"{record['cores used']} cores"
    return (
        f"{record['cpu']}, {cores}, {record['date'][:10]}, Python {record['python']}, "
        f"numpy {versions['numpy']}, numba {versions['numba']}; remade by: {record['command']}"
    )


def save_picture(figure: Any, path: Path, note: str, dpi: int = 110) -> None:
    """Write a figure as PNG, whole or not at all, with a note below it."""
    figure.supxlabel(note, fontsize=7, color="#555555")
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=dpi)


def write_json(path: Path, record: Mapping[str, Any]) -> None:
    """Write a result, whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path, "w") as file:
        json.dump(record, file, indent=1, default=_plain, allow_nan=False)
        file.write("\n")


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"cannot write {type(value).__name__} as JSON")


def finite(value: float) -> float | None:
    """Return a number, or None, which JSON has, for NaN and infinity."""
    return float(value) if np.isfinite(value) else None


def compared(result: "Evaluation", base: str, metrics: Sequence[str]) -> dict[str, Any]:
    """Return the means of all methods, and their differences from `base` with 95 % intervals over drives."""
    pairs = {name: result.compare(name, base) for name in result.methods if name != base}
    return {
        "frames": len(result.frames),
        "drives": len({one.sequence or one.name for one in result.frames}),
        "means": {name: {m: finite(result.macro(name)[m]) for m in metrics} for name in result.methods},
        f"minus {base}": {
            name: {m: [finite(x) for x in found[m].difference] for m in metrics if m in found}
            for name, found in pairs.items()
        },
    }


@contextlib.contextmanager
def silent() -> Iterator[None]:
    """Swallow what native code prints to the standard output."""
    flush = ctypes.CDLL(None).fflush if os.name == "posix" else lambda _: None
    sys.stdout.flush()
    flush(None)
    kept = os.dup(1)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 1)
    try:
        yield
    finally:
        flush(None)
        os.dup2(kept, 1)
        os.close(kept)
