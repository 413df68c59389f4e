"""Do long runs stay as small and as quick as they began? 10,000 scans, an hour of `ogm serve`, 20 million points.

    python benchmarks/soak.py [--scans N] [--serve-minutes M] [--only NAME] [--quick]

Parts, each in a process of its own: `ray`, `evidential` (RayISM and EvidentialMapper), `dynamic` (RayISM and
DynamicMapper with matching and objects), `network` (DeepISM), `points` (one huge scan), `streams` (two streams in two
threads; on an idle machine) and `serve` (with a viewer that comes and goes). Writes benchmarks/results/soak.json,
part by part, and docs/pictures/soak.png.
"""

import _soak_parts as parts  # first: it sets the number of threads

# isort: split
import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import _run as run
import numpy as np
from _charts import caption, save_picture
from matplotlib.figure import Figure

NAMES = (*parts.CHAINS, "points", "streams", "serve")
TITLES = {
    "ray": "RayISM",
    "evidential": "RayISM, EvidentialMapper",
    "dynamic": "RayISM, DynamicMapper",
    "network": "DeepISM lite",
    "serve": "ogm serve",
}
MODELS = {  # and maps
    "ray": ("ray",), "evidential": ("ray", "cautious"), "dynamic": ("ray", "dynamic"), "network": ("lite",),
    "points": ("ray", "lite"), "streams": ("ray", "cautious", "dynamic", "lite"), "serve": ("combined", "cautious"),
}  # fmt: skip
COLOURS = {"ray": "#0072b2", "evidential": "#56b4e9", "dynamic": "#009e73", "network": "#d55e00", "serve": "black"}


def measured(name: str, given: argparse.Namespace) -> dict[str, Any]:
    if name == "points":
        return parts.many_points(1_000_000 if given.quick else 20_000_000)
    if name == "streams":
        return parts.streams(0.2 if given.quick else 2.0, 2 if given.quick else 9)
    if name == "serve":
        with tempfile.TemporaryDirectory(prefix="ogm-soak-") as folder:
            return parts.serving(Path(folder), 0.5 if given.quick else given.serve_minutes)
    return parts.many_scans(name, 200 if given.quick else given.scans)


def verdicts(name: str, found: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the figures of a part beside their limits."""
    if name == "points":
        millions = f"{found['points'] / 1e6:g} million points"
        models = found["models"].items()
        return run.verdicts(
            (f"{model}, {millions}: mapped", one["refused"] == "", ">=", 1, "") for model, one in models
        )
    if name == "streams":
        chains = found["chains"].items()
        return run.verdicts(
            (f"{TITLES[n]}: two threads", one["two threads / one"], ">=", 1.7, "x") for n, one in chains
        )
    title = TITLES[name]
    rows = [(f"{title}: {what} left", found[f"{what} left"], "<=", 0, "") for what in ("files", "threads")]
    rows += [(f"{title}: memory grown", found["memory grown [%]"], "<=", 2.0, "%")]
    if name in parts.CHAINS:
        p99 = found["processor time"]["last / first"]
        rows += [(f"{title}: p99 of the last hundred / first, processor time", p99, "<=", 1.2, "x")]
    if name == "serve":
        load = found["processor time, last tenth / first"]
        rows += [(f"{title}: processor time of the last tenth / first", load, "<=", 1.2, "x")]
        rows += [(f"{title}: failed scans", found["result"]["failed"], "<=", 0, "")]
    return run.verdicts(rows)


def picture(record: Mapping[str, Any], path: Path) -> None:
    figure = Figure(figsize=(13, 3.6), layout="constrained")
    memory, latency = figure.subplots(1, 2)
    shown = {name: one for name, one in record["parts"].items() if name in TITLES}
    for name, one in shown.items():
        if name == "serve":
            at, held = np.array(one["memory [s, MB]"]).T
            memory.plot(10 * at, held, lw=1.2, color=COLOURS[name], label=TITLES[name])
            continue
        held = one["memory [MB]"]
        memory.plot(parts.HUNDRED * np.arange(len(held)), held, lw=1.2, color=COLOURS[name], label=TITLES[name])
        p99 = one["processor time"]["p99 of hundreds [ms]"]
        latency.plot(parts.HUNDRED * (np.arange(len(p99)) + 0.5), p99, lw=1.0, color=COLOURS[name])
    memory.set(xlabel="scans", ylabel="resident memory [MB]", ylim=(0, None), title="memory")
    latency.set(xlabel="scans", ylabel="p99 of a hundred scans [ms]", ylim=(0, None), title="processor time of a scan")
    figure.legend(frameon=False, fontsize=8, loc="outside right center")
    save_picture(figure, path, caption(record["environment"]))


def merged(path: Path, name: str, part: Mapping[str, Any], environment: Mapping[str, Any]) -> dict[str, Any]:
    """Return the record with a part of it measured anew; every part has a date and a machine of its own."""
    try:
        old = json.loads(path.read_text())["parts"]
    except (OSError, ValueError, KeyError):
        old = {}
    kept = ("command", "date", "commit", "cpu", "cores", "load at start", "checksums")
    where = {key: environment[key] for key in kept if key in environment}
    new = {**old, name: {**where, **part}}
    return {
        "environment": {
            **environment,
            "command": "python benchmarks/soak.py",
            "checksums": {},
        },  # each part has its own
        "parts": {one: new[one] for one in NAMES if one in new},
    }


def main() -> None:
    parser = run.Parser(__doc__, picture=True, quick=True)
    parser.add_argument("--scans", type=int, default=10_000)
    parser.add_argument("--serve-minutes", type=float, default=60.0)
    parser.add_argument("--only", choices=NAMES, help="measure one part, and keep the others of the record")
    given = parser.parse_args()
    if given.only is None:
        again = [sys.executable, *sys.argv]
        failed = [name for name in NAMES if subprocess.run([*again, "--only", name]).returncode]
        if failed:
            raise SystemExit(f"did not run to the end: {', '.join(failed)}")
        return
    environment = run.environment(*MODELS[given.only])
    found = measured(given.only, given)
    found["verdicts"] = verdicts(given.only, found)
    run.print_verdicts(found["verdicts"])
    record = merged(given.out, given.only, found, environment)
    run.write_record(given.out, record)
    picture(record, given.picture)


if __name__ == "__main__":
    main()
