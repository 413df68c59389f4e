"""Speed of the rules of the evidence algebra, per cell and per grid.

    python benchmarks/evidence.py [--rounds N]

On one core, for a grid of 512 x 352 cells in float32 (the paper's): all rules in numpy; the rules of
`ogm.evidence.kernels` with the discount of the map, against the time to copy the bytes they read and write (in two
readings); one combination on a frame of three states; and other libraries per cell. All measurements of a round are
taken in turn, and the figures are medians.

Writes benchmarks/results/evidence.json; `python docs/make_evidence_pictures.py` makes the picture and the tables.
"""

import _run as run  # first: it sets the number of threads

# isort: split
import importlib.util
from collections.abc import Callable
from typing import Any

import numpy as np
from _timing import Contender, measure
from numba import njit

from ogm import evidence
from ogm.evidence import powerset
from ogm.evidence.kernels import FLOAT32, RULES

SHAPE = (512, 352)
CELLS = SHAPE[0] * SHAPE[1]
RELIABILITY = 0.9
PEER_CELLS = 2000  # per round; the pure-Python libraries take 10 to 300 us for each
ALL_RULES = [
    "conjunctive", "dempster", "yager", "dubois_prade", "disjunctive", "cautious",
    "pcr5", "pcr6", "pcr6_plus", "murphy", "cumulative", "cumulative_epistemic", "averaging", "weighted",
    "belief_constraint", "consensus_compromise",
]  # fmt: skip
FUSED = ["dempster", "yager", "cumulative"]
COPIES = {"copy": "copying the bytes it reads and writes", "copy of half": "a copy with the same memory traffic"}
Task = Callable[[], Any]


def main() -> None:
    parser = run.Parser(__doc__)
    parser.add_argument("--rounds", type=int, default=41, help="repetitions of each measurement (median is quoted)")
    given = parser.parse_args()
    environment = run.environment()
    times = measure({name: Contender(lambda _, task=task: task()) for name, task in tasks().items()}, given.rounds)
    figures = {name: one.median for name, one in times.items()}
    report = {
        "environment": environment,
        "grid": {
            "shape": SHAPE,
            "dtype": "float32",
            "reliability": RELIABILITY,
            "cells of other libraries": PEER_CELLS,
        },
        "rounds": given.rounds,
        "milliseconds": {name: round(ms, 4) for name, ms in figures.items()},
        "copy": "np.copyto of as many bytes as a rule reads (two masses) and writes (one): it reads them all and "
        "writes them all, twice the traffic of the rule",
        "copy of half": "np.copyto of half of them: reads and writes together are as many bytes as those of the rule",
        "verdicts": verdicts(figures),
    }
    run.write_record(given.out, report)


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


def tasks() -> dict[str, Task]:
    """Return the tasks by name."""
    rng = np.random.default_rng(0)
    a, b = (rng.dirichlet([1, 1, 1], SHAPE).astype(np.float32)[..., :2].copy() for _ in range(2))
    general = tuple(rng.dirichlet([1] * 8, SHAPE).astype(np.float32) for _ in range(2))
    out, state = np.empty_like(a).reshape(-1), a.copy().reshape(-1)
    source = np.ones(3 * a.size, np.float32)  # two masses read and one written
    target, half = np.empty_like(source), source.size // 2  # a copy moves each byte twice
    r = np.float32(RELIABILITY)
    result: dict[str, Task] = {
        "copy": lambda: np.copyto(target, source),
        "copy of half": lambda: np.copyto(target[:half], source[:half]),
    }
    flat_a, flat_b = a.reshape(-1), b.reshape(-1)
    for name in FUSED:
        rule, (into, in_place) = getattr(evidence, name), map_loops(name)
        result |= {
            f"numba {name} with discount": lambda into=into: into(flat_a, flat_b, r, out),
            f"numba {name} with discount, in place": lambda in_place=in_place: in_place(state, flat_b, r),
            f"numpy {name} with discount": lambda rule=rule: rule(evidence.discount(a, RELIABILITY), b),
        }
    for name in ALL_RULES:
        rule = getattr(evidence, name)
        result[f"numpy {name}"] = lambda rule=rule: rule(a, b)
    result["powerset K=3 dempster"] = lambda: powerset.dempster(*general)
    result["powerset K=3 conjunctive"] = lambda: powerset.conjunctive(*general)
    few = (m.reshape(-1, 2)[:PEER_CELLS].astype(float).tolist() for m in (a, b))
    return result | peers(*few)


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


def is_peer(name: str) -> bool:
    return name.split()[0] not in ("copy", "numba", "numpy", "powerset")


def verdicts(figures: dict[str, float]) -> list[dict[str, Any]]:
    """Return the times on the whole grid beside their limits; peers do `PEER_CELLS` cells of it."""
    grid = {name: ms * (CELLS / PEER_CELLS if is_peer(name) else 1) for name, ms in figures.items()}
    rows = []
    for name in FUSED:
        for kind, most in (("numba {}", 2), ("numpy {}", 12), ("numba {}, in place", 2)):
            task = kind.format(f"{name} with discount")
            rows += [(f"{task} / {words}", grid[task] / grid[copy], "<=", most, "x") for copy, words in COPIES.items()]
    pure = [name for name in grid if is_peer(name) and not name.startswith("eslimpp")]
    if pure:
        fastest = min(pure, key=grid.__getitem__)
        slowest = max(grid[f"numba {name} with discount"] for name in FUSED)
        rows.append((f"{fastest} / slowest numba rule, per cell", grid[fastest] / slowest, ">=", 1000, "x"))
    for peer, ours in (("eslimpp cumulative", "cumulative"), ("eslimpp belief_constraint", "dempster")):
        if peer in grid:
            ratio = grid[peer] / grid[f"numba {ours} with discount"]
            rows.append((f"{peer} / numba {ours}, per cell", ratio, ">=", 20, "x"))
    rows.append(("powerset K=3 dempster on the grid", grid["powerset K=3 dempster"], "<=", 100, "ms"))
    return run.verdicts(rows)


if __name__ == "__main__":
    main()
