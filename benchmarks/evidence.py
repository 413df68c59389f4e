# ruff: noqa: E402 (threads are limited before anything is imported)
"""Measure how fast the evidence algebra is: ``python benchmarks/evidence.py``.

On one core, for a grid of 512 x 352 cells in float32 (the paper's): the fusion rules against the time to copy
the bytes they read and write (in two readings), all rules in numpy, one combination on a frame of three states,
and other libraries per cell. All measurements of a round are taken in turn, and the figures are medians over rounds, so
that a busy moment of the machine falls on all of them.

Writes benchmarks/results/evidence.json and docs/pictures/evidence_speed.png, and remakes the table of rules and
the one of the copies in docs/evidence.md.
"""

import os

for variable in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[variable] = "1"
os.environ.setdefault("MPLBACKEND", "Agg")

import argparse
import importlib.metadata
import importlib.util
import json
import platform
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from ogm import evidence
from ogm.evidence import kernels, powerset

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "evidence.json"
PICTURE = ROOT / "docs" / "pictures" / "evidence_speed.png"
PAGE = ROOT / "docs" / "evidence.md"
COMMAND = "python benchmarks/evidence.py"
SHAPE = (512, 352)
CELLS = SHAPE[0] * SHAPE[1]
RELIABILITY = 0.9
PEER_CELLS = 2000  # per round; the pure-Python libraries take 10 to 300 us for each

# rule: (associative, vacuous is neutral, idempotent, where conflict goes, two dogmatic masses, total
# conflict). tests/evidence holds the first three against the code.
RULES = {
    "conjunctive": (
        "yes",
        "yes",
        "no",
        "stays, as mass on the empty set",
        "as the rule says",
        "conflict = 1",
    ),
    "dempster": (
        "yes",
        "yes",
        "no",
        "shared in proportion",
        "as the rule says",
        "policy, by default the mean",
    ),
    "yager": ("no", "yes", "no", "unknown", "as the rule says", "vacuous"),
    "dubois_prade": ("no", "yes", "no", "the union: here unknown", "as the rule says", "vacuous"),
    "disjunctive": ("yes", "no", "no", "none arises", "as the rule says", "vacuous"),
    "cautious": (
        "yes",
        "no",
        "yes",
        "stays, as mass on the empty set",
        "u read as 1e-6 / 1e-12",
        "conflict near 1",
    ),
    "bold": ("yes", "no", "yes", "needs some, keeps it", "as the rule says", "neutral element"),
    "normalized_cautious": (
        "yes",
        "yes",
        "yes",
        "shared in proportion",
        "u read as 1e-6 / 1e-12",
        "mean, (0.5, 0.5)",
    ),
    "pcr5": ("no", "yes", "no", "back to the states in it", "as the rule says", "halved"),
    "pcr6": ("no", "yes", "no", "back to the sources in it", "as the rule says", "halved"),
    "pcr6_plus": ("no", "yes", "no", "back to the conflicting sources", "as the rule says", "halved"),
    "murphy": ("no", "no", "no", "averaged away", "as the rule says", "mean, (0.5, 0.5)"),
    "cumulative": ("yes", "yes", "no", "evidence adds up", "mean", "mean"),
    "cumulative_epistemic": ("no", "no", "no", "unknown", "mean, maximised", "vacuous"),
    "averaging": ("no", "no", "yes", "averaged", "mean", "mean"),
    "weighted": ("no", "yes", "yes", "averaged by confidence", "mean", "mean"),
    "belief_constraint": (
        "yes",
        "yes",
        "no",
        "shared in proportion",
        "as the rule says",
        "policy, as Dempster",
    ),
    "consensus_compromise": ("no", "yes", "yes", "unknown", "as the rule says", "vacuous"),
}
FUSED = ["dempster", "yager", "cumulative"]
COPIES = {
    "copy": "copying the bytes it reads and writes",
    "copy of half": "a copy with the same memory traffic",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--rounds", type=int, default=41, help="repetitions of each measurement (median is quoted)"
    )
    rounds = parser.parse_args().rounds

    figures = measure(tasks(), rounds)
    report = {
        "date": datetime.now(UTC).date().isoformat(),
        "command": COMMAND,
        "machine": machine(),
        "grid": {"shape": SHAPE, "dtype": "float32", "reliability": RELIABILITY},
        "rounds": rounds,
        "milliseconds": {name: round(1e3 * seconds, 4) for name, seconds in figures.items()},
        "copy": "np.copyto of as many bytes as a rule reads (two masses) and writes (one): it reads them all and "
        "writes them all, twice the traffic of the rule",
        "copy of half": "np.copyto of half of them: reads and writes together are as many bytes as those of the rule",
        "targets": targets(figures),
    }
    RESULTS.parent.mkdir(parents=True, exist_ok=True)
    RESULTS.write_text(json.dumps(report, indent=2) + "\n")
    draw(figures, report)
    write_table(figures, report)
    write_floor(figures)
    for target in report["targets"]:
        verdict = "met   " if target["met"] else "MISSED"
        print(f"{verdict} {target['what']}: {target['value']} ({target['wanted']})")


def tasks() -> dict[str, tuple[Callable[[], Any], int]]:
    """Return the tasks, each with n: it is run in every n-th round."""
    rng = np.random.default_rng(0)
    a, b = (rng.dirichlet([1, 1, 1], SHAPE).astype(np.float32)[..., :2].copy() for _ in range(2))
    a3, b3 = (evidence.conjunctive(m, m) for m in (a, b))
    general_a, general_b = (rng.dirichlet([1] * 8, SHAPE).astype(np.float32) for _ in range(2))
    out, state = np.empty_like(a), a.copy()
    source = np.ones(3 * a.size, np.float32)  # two masses read and one written
    target = np.empty_like(source)

    half = source.size // 2  # a copy moves each byte twice: this one moves as many bytes as a rule does
    result: dict[str, tuple[Callable[[], Any], int]] = {
        "copy": (lambda: np.copyto(target, source), 1),
        "copy of half": (lambda: np.copyto(target[:half], source[:half]), 1),
    }
    for name in FUSED:
        rule, kernel = getattr(evidence, name), getattr(kernels, name)
        result[f"numba {name} with discount"] = (
            lambda kernel=kernel: kernel(a, b, reliability=RELIABILITY, out=out),
            1,
        )
        result[f"numba {name} with discount, in place"] = (
            lambda kernel=kernel: kernel(state, b, reliability=RELIABILITY, out=state),
            1,
        )
        result[f"numpy {name} with discount"] = (
            lambda rule=rule: rule(evidence.discount(a, RELIABILITY), b),
            1,
        )
    for name in RULES:
        rule = getattr(evidence, name)
        arguments = (a3, b3) if name == "bold" else (a, b)
        result[f"numpy {name}"] = (lambda rule=rule, arguments=arguments: rule(*arguments), 4)
    result["powerset K=3 dempster"] = (lambda: powerset.dempster(general_a, general_b), 4)
    result["powerset K=3 conjunctive"] = (lambda: powerset.conjunctive(general_a, general_b), 4)
    few_a, few_b = (m.reshape(-1, 2)[:PEER_CELLS].astype(float) for m in (a, b))
    for name, task in peers(few_a, few_b).items():
        result[name] = (task, 8)
    return result


def peers(a: np.ndarray, b: np.ndarray) -> dict[str, Callable[[], Any]]:
    """Return combinations of a few cells by other libraries; their objects are built beforehand."""
    result: dict[str, Callable[[], Any]] = {}

    def loop(pairs: list[tuple[Any, Any]], combine: Callable[[Any, Any], Any]) -> Callable[[], Any]:
        return lambda: [combine(x, y) for x, y in pairs]

    def built(make: Callable[[float, float], Any]) -> list[tuple[Any, Any]]:
        return [(make(*x), make(*y)) for x, y in zip(a.tolist(), b.tolist(), strict=True)]

    if importlib.util.find_spec("pyds"):
        import pyds

        pairs = built(lambda f, o: pyds.MassFunction({"f": f, "o": o, "fo": 1 - f - o}))
        result["py_dempster_shafer dempster"] = loop(pairs, lambda x, y: x & y)
    if importlib.util.find_spec("pybelief"):
        import pybelief

        pairs = built(lambda f, o: pybelief.MassFunction(["f", "o"], {1: f, 2: o, 3: 1 - f - o}))
        result["pybelief dempster"] = loop(pairs, lambda x, y: x.combine_dempster(y))
        result["pybelief yager"] = loop(pairs, lambda x, y: x.combine_yager(y))
    if importlib.util.find_spec("evtools"):
        from evtools import combinations, dsvector

        pairs = built(lambda f, o: dsvector.DSVector.from_dense(["f", "o"], np.array([0, f, o, 1 - f - o])))
        result["evtools dempster"] = loop(pairs, combinations.dempster)
        result["evtools cautious"] = loop(pairs, combinations.cautious)
    if importlib.util.find_spec("subjective_logic"):
        module = importlib.import_module("subjective_logic._subjective_logic_lib_python_api")

        def opinion(f: float, o: float) -> Any:
            belief, prior = module.Array2d(), module.Array2d()
            belief[0], belief[1], prior[0], prior[1] = o, f, 0.5, 0.5
            return module.Opinion2d(belief, prior)

        pairs = built(opinion)
        result["eslimpp cumulative"] = loop(pairs, lambda x, y: x.cum_fuse(y))
        result["eslimpp belief_constraint"] = loop(pairs, lambda x, y: x.bc_fuse(y))
    return result


def measure(what: dict[str, tuple[Callable[[], Any], int]], rounds: int) -> dict[str, float]:
    """Return the median time of each task [s], after two runs to warm up."""
    times: dict[str, list[float]] = {name: [] for name in what}
    for task, _ in what.values():
        task()
        task()
    for number in range(rounds):
        for name, (task, every) in what.items():
            if number % every:
                continue
            start = time.perf_counter()
            task()
            times[name].append(time.perf_counter() - start)
    return {name: median(values) for name, values in times.items()}


def per_grid(name: str, seconds: float) -> float:
    """Return the time of a task on the whole grid; peers do PEER_CELLS cells of it."""
    return seconds * CELLS / PEER_CELLS if is_peer(name) else seconds


def is_peer(name: str) -> bool:
    return name.split()[0] not in ("copy", "numba", "numpy", "powerset")


def targets(figures: dict[str, float]) -> list[dict[str, Any]]:
    result = []

    def add(
        what: str, value: float, most: float | None = None, least: float | None = None, unit: str = "x"
    ) -> None:
        met = value <= most if most is not None else value >= (least or 0)
        wanted = f"at most {most} {unit}" if most is not None else f"at least {least} {unit}"
        result.append({"what": what, "value": f"{value:.3g} {unit}", "wanted": wanted, "met": bool(met)})

    for name in FUSED:
        for kind, most in [("numba", 2), ("numpy", 12)]:
            for copy, words in COPIES.items():
                ratio = figures[f"{kind} {name} with discount"] / figures[copy]
                add(f"{kind} {name} with discount / {words}", ratio, most=most)
        for copy, words in COPIES.items():
            ratio = figures[f"numba {name} with discount, in place"] / figures[copy]
            add(f"numba {name} with discount, in place / {words}", ratio, most=2)
    grid = {name: per_grid(name, seconds) for name, seconds in figures.items()}
    pure = [name for name in grid if is_peer(name) and not name.startswith("eslimpp")]
    if pure:
        fastest = min(pure, key=grid.__getitem__)
        slowest = max(grid[f"numba {name} with discount"] for name in FUSED)
        add(f"{fastest} / slowest numba rule, per cell", grid[fastest] / slowest, least=1000)
    for peer, ours in [("eslimpp cumulative", "cumulative"), ("eslimpp belief_constraint", "dempster")]:
        if peer in grid:
            add(
                f"{peer} / numba {ours}, per cell", grid[peer] / grid[f"numba {ours} with discount"], least=20
            )
    add("powerset K=3 dempster on the grid", 1e3 * figures["powerset K=3 dempster"], most=100, unit="ms")
    return result


def machine() -> dict[str, Any]:
    cpu = platform.processor()
    info = Path("/proc/cpuinfo")
    if info.exists():
        models = [
            line.split(":", 1)[1].strip() for line in info.read_text().splitlines() if "model name" in line
        ]
        cpu = models[0] if models else cpu
    names = ["numpy", "numba", "py_dempster_shafer", "pybelief", "evtools-dst", "eslimpp"]
    versions = {"python": platform.python_version()}
    for name in names:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    return {"cpu": cpu, "cores_used": 1, "system": platform.system(), "versions": versions}


def draw(figures: dict[str, float], report: dict[str, Any]) -> None:
    import matplotlib.pyplot as plt

    shown = [
        name
        for name in figures
        if "with discount" in name or is_peer(name) or name in ("copy", "powerset K=3 dempster")
    ]
    times = {name: 1e3 * per_grid(name, figures[name]) for name in shown}
    names = sorted(times, key=times.__getitem__, reverse=True)
    colors = {"copy": "#999999", "numba": "#d55e00", "numpy": "#1f77b4", "powerset": "#56b4e9"}
    figure, axes = plt.subplots(figsize=(8, 0.27 * len(names) + 1.3), layout="constrained")
    axes.barh(
        names, [times[name] for name in names], color=[colors.get(n.split()[0], "#bbbbbb") for n in names]
    )
    for row, name in enumerate(names):
        axes.text(
            times[name] * 1.08,
            row,
            f"{times[name]:,.0f}" if times[name] > 100 else f"{times[name]:.2g}",
            va="center",
            fontsize=8,
        )
    axes.set_xscale("log")
    axes.set_xlim(0.05, 5 * max(times.values()))
    axes.tick_params(axis="y", labelsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel(
        f"time for a grid of {SHAPE[0]} x {SHAPE[1]} cells [ms], one core; other libraries extrapolated"
    )
    axes.set_title(f"{report['machine']['cpu']}, {report['date']}", fontsize=9, loc="left")
    figure.savefig(PICTURE, dpi=110, metadata={"Software": ""})
    plt.close(figure)


def write_table(figures: dict[str, float], report: dict[str, Any]) -> None:
    """Replace what stands between the markers in docs/evidence.md."""
    best: dict[str, tuple[float, str]] = {}
    for name, seconds in figures.items():
        if not is_peer(name):
            continue
        library, rule = name.split()
        rules = {"dempster": ["dempster"], "belief_constraint": ["belief_constraint"]}.get(rule, [rule])
        for ours in rules:
            milliseconds = 1e3 * per_grid(name, seconds)
            if ours not in best or milliseconds < best[ours][0]:
                best[ours] = (milliseconds, library)
    lines = [
        "| rule | associative | vacuous neutral | idempotent | conflict | both u = 0 | total conflict | "
        "numpy [ms] | numba [ms] | fastest peer [ms] |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, properties in RULES.items():
        numba = figures.get(f"numba {name} with discount")
        peer = f"{best[name][0]:,.0f} ({best[name][1]})" if name in best else ""
        cells = [
            f"`{name}`",
            *properties,
            f"{1e3 * figures[f'numpy {name}']:.1f}",
            f"{1e3 * numba:.2f}" if numba else "",
            peer,
        ]
        lines.append(f"| {' | '.join(cells)} |")
    versions = ", ".join(f"{name} {version}" for name, version in report["machine"]["versions"].items())
    lines += [
        "",
        f"Times for one combination of two 512 x 352 grids in float32 on one core of "
        f"{report['machine']['cpu']}; numba with the discount included; peers extrapolated from "
        f"{PEER_CELLS} cells. How this compares to copying memory is told under [Speed](#speed). "
        f"{report['date']}; {versions}; remade by "
        f"`{COMMAND}`.",
    ]
    replace_between("table", lines)


def write_floor(figures: dict[str, float]) -> None:
    """Write the fused rules as multiples of the two copies into docs/evidence.md."""
    lines = [
        "How near is that to what memory allows? Two yardsticks, both for one grid. **Copying the bytes**: a rule "
        "reads two masses and writes one, and a copy of an array as large as the three takes "
        f"{1e3 * figures['copy']:.2f} ms. **The same traffic**: a copy reads *and* writes every byte, so that one "
        "moves twice as much memory as the rule does; a copy of half as many bytes moves just as much, and takes "
        f"{1e3 * figures['copy of half']:.2f} ms. A kernel may thus take less than 1 x the first copy (it moves "
        "half as much), but hardly less than 1 x the second, unless it works in place and touches one array less.",
        "",
        "| with the discount included | time [ms] | x copying the bytes | x the same traffic |",
        "|---|---|---|---|",
    ]
    for name in FUSED:
        for task in (
            f"numba {name} with discount",
            f"numba {name} with discount, in place",
            f"numpy {name} with discount",
        ):
            seconds = figures[task]
            lines.append(
                f"| {task.replace(' with discount', '')} | {1e3 * seconds:.2f} | "
                f"{seconds / figures['copy']:.2f} | {seconds / figures['copy of half']:.2f} |"
            )
    replace_between("floor", lines)


def replace_between(name: str, lines: list[str]) -> None:
    """Replace what stands between two markers in docs/evidence.md."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    before, rest = PAGE.read_text().split(begin)
    _, after = rest.split(end)
    PAGE.write_text(f"{before}{begin}\n" + "\n".join(lines) + f"\n{end}{after}")


if __name__ == "__main__":
    sys.exit(main())
