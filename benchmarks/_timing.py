"""Times of contenders in interleaved rounds, and of many calls of one, with the memory of the process."""

import gc
import math
import resource
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import _run  # noqa: F401, first: it sets the number of threads

# isort: split
import numpy as np

SLOW = 0.3  # [s] a call that takes longer is not repeated within a round
BURST, MAX_CALLS = 0.05, 10  # [s] time for which, and number of times that, a quick call is repeated within a round
LONG, MIN_ROUNDS = 10.0, 3  # [s] a contender that took longer after these rounds is not repeated further
BLOCK = 100  # calls of a long run whose median is taken


@dataclass(frozen=True)
class Contender:
    """A function to time, `run`, and the preparation of its argument, which is not in the time."""

    run: Callable[[Any], Any]
    prepare: Callable[[], Any] = lambda: None
    slow: bool = False  # takes seconds and has nothing to warm up: a single round makes no extra call


class Times(NamedTuple):
    """Median and quartiles of the times of a contender [ms], number of calls, and share of processor time."""

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
    """Time every contender in every round, so that disturbances of the machine meet all of them alike; print the times.

    Each runs once beforehand (compilation, memory), except slow ones if there is only one round. A quick one runs
    once more at the start of each round, untimed, to bring its data back to the caches, and then several times. A
    contender that has taken 10 s in all is left out from the fourth round on.
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
                if n >= MIN_ROUNDS and sum(wall for wall, _ in samples[name]) > LONG:
                    continue
                if last[name] < SLOW:
                    once(contender)
                calls = min(max(int(BURST / last[name]), 1), MAX_CALLS)
                samples[name] += [once(contender) for _ in range(calls)]
                last[name] = samples[name][-1][0]
    finally:
        gc.enable()
    result = {}
    for name, pairs in samples.items():
        wall, core = np.array(pairs).T
        low, median, high = (1e3 * np.percentile(wall, (25, 50, 75))).tolist()
        result[name] = Times(median, low, high, len(wall), round(float(core.sum() / wall.sum()), 3))
        print(f"{name:44} {result[name]!s:>34}   on core {result[name].on_core:.2f}")
    return result


def long_run(contender: Contender, count: int) -> dict[str, Any]:
    """Call a contender many times; return medians of hundreds of calls [ms] and the memory of the process [MB]."""
    seconds, memory = np.empty(count), []
    for k in range(count):
        seconds[k] = once(contender)[0]
        if k % max(count // 100, 1) == 0 or k == count - 1:
            memory.append(resident())
    blocks = np.median(seconds[: count // BLOCK * BLOCK].reshape(-1, BLOCK), axis=1) * 1e3
    return {
        "scans": count,
        "first hundred [ms]": float(blocks[0]),
        "last hundred [ms]": float(blocks[-1]),
        "last / first": float(blocks[-1] / blocks[0]),
        "medians of hundreds [ms]": np.round(blocks, 4).tolist(),
        "memory [MB]": [round(megabytes, 2) for megabytes in memory],
        "memory grown [MB]": round(memory[-1] - memory[1], 3),
    }


def resident(pid: int | str = "self") -> float:
    """Return the memory that a process holds now [MB] (Linux); 0 when it has ended."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except (OSError, IndexError):
        return 0.0
    return pages * resource.getpagesize() / 1e6


def peak_memory() -> float:
    """Return the greatest memory of this process [MB] (Linux), since its peak was last cleared."""
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(status["VmHWM"].split()[0]) * 1024 / 1e6
