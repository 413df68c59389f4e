"""Measure how fast the evidence algebra is: ``python benchmarks/evidence.py``.

On one core, for a grid of 512 x 352 cells in float32 (the paper's): all rules in numpy; the rules of
`ogm.evidence.kernels` with the discount of the map, against the time to copy the bytes they read and write (in two
readings); one combination on a frame of three states; and other libraries per cell. All measurements of a round are
taken in turn, and the figures are medians over rounds, so that other load falls on all of them.

Writes benchmarks/results/evidence.json; `python docs/make_evidence_pictures.py` makes the picture and the tables.
"""

import argparse
import importlib.metadata
import importlib.util
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from statistics import median
from typing import Any

from _run import RESULTS, environment, write_json  # first, as it limits threads

# isort: split
import numpy as np
from numba import njit

from ogm import evidence
from ogm.evidence import powerset
from ogm.evidence.kernels import FLOAT32, RULES

SHAPE = (512, 352)
CELLS = SHAPE[0] * SHAPE[1]
RELIABILITY = 0.9
PEER_CELLS = 2000  # per round; the pure-Python libraries take 10 to 300 us for each
ALL_RULES = [
    "conjunctive", "dempster", "yager", "dubois_prade", "disjunctive", "cautious", "bold", "normalized_cautious",
    "pcr5", "pcr6", "pcr6_plus", "murphy", "cumulative", "cumulative_epistemic", "averaging", "weighted",
    "belief_constraint", "consensus_compromise",
]  # fmt: skip
FUSED = ["dempster", "yager", "cumulative"]
COPIES = {"copy": "copying the bytes it reads and writes", "copy of half": "a copy with the same memory traffic"}
LIBRARIES = ("py_dempster_shafer", "pybelief", "evtools-dst", "eslimpp")
Task = Callable[[], Any]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=41, help="repetitions of each measurement (median is quoted)")
    rounds = parser.parse_args().rounds
    figures = measure(tasks(), rounds)
    machine = environment()
    for name in LIBRARIES:
        found = any(one.metadata["Name"] == name for one in importlib.metadata.distributions())
        machine["versions"][name] = importlib.metadata.version(name) if found else "not installed"
    report = {
        "date": datetime.now(UTC).date().isoformat(),
        "command": "python benchmarks/evidence.py",
        "machine": machine,
        "grid": {
            "shape": SHAPE,
            "dtype": "float32",
            "reliability": RELIABILITY,
            "cells of other libraries": PEER_CELLS,
        },
        "rounds": rounds,
        "milliseconds": {name: round(1e3 * seconds, 4) for name, seconds in figures.items()},
        "copy": "np.copyto of as many bytes as a rule reads (two masses) and writes (one): it reads them all and "
        "writes them all, twice the traffic of the rule",
        "copy of half": "np.copyto of half of them: reads and writes together are as many bytes as those of the rule",
        "targets": targets(figures),
    }
    write_json(RESULTS / "evidence.json", report)
    for one in report["targets"]:
        print(f"{'met   ' if one['met'] else 'MISSED'} {one['what']}: {one['value']} ({one['wanted']})")


def map_loops(name: str) -> tuple[Any, Any]:
    """Return kernels that discount a map and combine it with a scan, cell by cell: into a new map, and in place.

    Two loops: where `out` may be `a`, the compiler cannot use vector instructions.
    """
    cell = RULES[name].cell
    compiled = njit(nogil=True, error_model="numpy", fastmath={"contract"})

    @compiled
    def combine(f: Any, o: Any, g: Any, p: Any) -> Any:
        free, occupied, whole = cell(FLOAT32, f, o, g, p)
        half = np.float32(0.5)
        return half if whole == 0 else free / whole, half if whole == 0 else occupied / whole

    @compiled
    def into(a: Any, b: Any, r: Any, out: Any) -> None:
        for i in range(a.size // 2):
            out[2 * i], out[2 * i + 1] = combine(r * a[2 * i], r * a[2 * i + 1], b[2 * i], b[2 * i + 1])

    @compiled
    def in_place(a: Any, b: Any, r: Any) -> None:
        for i in range(a.size // 2):
            a[2 * i], a[2 * i + 1] = combine(r * a[2 * i], r * a[2 * i + 1], b[2 * i], b[2 * i + 1])

    return into, in_place


def tasks() -> dict[str, tuple[Task, int]]:
    """Return the tasks, each with n: it is run in every n-th round."""
    rng = np.random.default_rng(0)
    a, b = (rng.dirichlet([1, 1, 1], SHAPE).astype(np.float32)[..., :2].copy() for _ in range(2))
    a3, b3 = (evidence.conjunctive(m, m) for m in (a, b))
    general = tuple(rng.dirichlet([1] * 8, SHAPE).astype(np.float32) for _ in range(2))
    out, state = np.empty_like(a).reshape(-1), a.copy().reshape(-1)
    source = np.ones(3 * a.size, np.float32)  # two masses read and one written
    target, half = np.empty_like(source), source.size // 2  # a copy moves each byte twice
    r = np.float32(RELIABILITY)
    result: dict[str, tuple[Task, int]] = {
        "copy": (lambda: np.copyto(target, source), 1),
        "copy of half": (lambda: np.copyto(target[:half], source[:half]), 1),
    }
    flat_a, flat_b = a.reshape(-1), b.reshape(-1)
    for name in FUSED:
        rule, (into, in_place) = getattr(evidence, name), map_loops(name)
        for key, task in {
            f"numba {name} with discount": lambda into=into: into(flat_a, flat_b, r, out),
            f"numba {name} with discount, in place": lambda in_place=in_place: in_place(state, flat_b, r),
            f"numpy {name} with discount": lambda rule=rule: rule(evidence.discount(a, RELIABILITY), b),
        }.items():
            result[key] = task, 1
    for name in ALL_RULES:
        rule, pair = getattr(evidence, name), (a3, b3) if name == "bold" else (a, b)
        result[f"numpy {name}"] = (lambda rule=rule, pair=pair: rule(*pair), 4)
    result["powerset K=3 dempster"] = (lambda: powerset.dempster(*general), 4)
    result["powerset K=3 conjunctive"] = (lambda: powerset.conjunctive(*general), 4)
    few = (m.reshape(-1, 2)[:PEER_CELLS].astype(float).tolist() for m in (a, b))
    return result | {name: (task, 8) for name, task in peers(*few).items()}


def peers(a: list[list[float]], b: list[list[float]]) -> dict[str, Task]:
    """Return combinations of a few cells by other libraries; their objects are built beforehand."""
    result: dict[str, Task] = {}

    def add(name: str, make: Callable[[float, float], Any], combine: Callable[[Any, Any], Any]) -> None:
        pairs = [(make(*x), make(*y)) for x, y in zip(a, b, strict=True)]
        result[name] = lambda: [combine(x, y) for x, y in pairs]

    if importlib.util.find_spec("pyds"):
        import pyds

        add(
            "py_dempster_shafer dempster",
            lambda f, o: pyds.MassFunction({"f": f, "o": o, "fo": 1 - f - o}),
            lambda x, y: x & y,
        )
    if importlib.util.find_spec("pybelief"):
        import pybelief

        for rule in ("dempster", "yager"):
            add(
                f"pybelief {rule}",
                lambda f, o: pybelief.MassFunction(["f", "o"], {1: f, 2: o, 3: 1 - f - o}),
                getattr(pybelief.MassFunction, f"combine_{rule}"),
            )
    if importlib.util.find_spec("evtools"):
        from evtools import combinations, dsvector

        for rule in ("dempster", "cautious"):
            add(
                f"evtools {rule}",
                lambda f, o: dsvector.DSVector.from_dense(["f", "o"], np.array([0, f, o, 1 - f - o])),
                getattr(combinations, rule),
            )
    if importlib.util.find_spec("subjective_logic"):
        module = importlib.import_module("subjective_logic._subjective_logic_lib_python_api")

        def opinion(f: float, o: float) -> Any:
            belief, prior = module.Array2d(), module.Array2d()
            belief[0], belief[1], prior[0], prior[1] = o, f, 0.5, 0.5
            return module.Opinion2d(belief, prior)

        add("eslimpp cumulative", opinion, lambda x, y: x.cum_fuse(y))
        add("eslimpp belief_constraint", opinion, lambda x, y: x.bc_fuse(y))
    return result


def measure(what: dict[str, tuple[Task, int]], rounds: int) -> dict[str, float]:
    """Return the median time of each task [s], after two runs to warm up."""
    times: dict[str, list[float]] = {name: [] for name in what}
    for task, _ in what.values():
        task()
        task()
    for number in range(rounds):
        for name, (task, every) in what.items():
            if number % every == 0:
                start = time.perf_counter()
                task()
                times[name].append(time.perf_counter() - start)
    return {name: median(values) for name, values in times.items()}


def per_grid(figures: dict[str, float]) -> dict[str, float]:
    """Return the time of each task on the whole grid [ms]; peers do PEER_CELLS cells of it."""
    scale = 1e3 * CELLS / PEER_CELLS
    return {name: seconds * (scale if is_peer(name) else 1e3) for name, seconds in figures.items()}


def is_peer(name: str) -> bool:
    return name.split()[0] not in ("copy", "numba", "numpy", "powerset")


def targets(figures: dict[str, float]) -> list[dict[str, Any]]:
    grid, rows = per_grid(figures), []
    for name in FUSED:
        for task, most in ((f"numba {name} with discount", 2), (f"numpy {name} with discount", 12)):
            rows += [(f"{task} / {words}", grid[task] / grid[copy], most, "x") for copy, words in COPIES.items()]
        task = f"numba {name} with discount, in place"
        rows += [(f"{task} / {words}", grid[task] / grid[copy], 2, "x") for copy, words in COPIES.items()]
    pure = [name for name in grid if is_peer(name) and not name.startswith("eslimpp")]
    if pure:
        fastest = min(pure, key=grid.__getitem__)
        slowest = max(grid[f"numba {name} with discount"] for name in FUSED)
        rows.append((f"{fastest} / slowest numba rule, per cell", grid[fastest] / slowest, -1000, "x"))
    for peer, ours in (("eslimpp cumulative", "cumulative"), ("eslimpp belief_constraint", "dempster")):
        if peer in grid:
            ratio = grid[peer] / grid[f"numba {ours} with discount"]
            rows.append((f"{peer} / numba {ours}, per cell", ratio, -20, "x"))
    rows.append(("powerset K=3 dempster on the grid", grid["powerset K=3 dempster"], 100, "ms"))
    return [
        {
            "what": what,
            "value": f"{value:.3g} {unit}",
            "wanted": f"{'at most' if bound > 0 else 'at least'} {abs(bound)} {unit}",
            "met": bool(value <= bound if bound > 0 else value >= -bound),
        }
        for what, value, bound, unit in rows
    ]


if __name__ == "__main__":
    sys.exit(main())
