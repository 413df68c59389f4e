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
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import _run as run
import numpy as np
from matplotlib.figure import Figure

NAMES = (*parts.CHAINS, "points", "streams", "serve")
TITLES = {
    "ray": "RayISM",
    "evidential": "RayISM, EvidentialMapper",
    "dynamic": "RayISM, DynamicMapper",
    "network": "DeepISM lite",
    "serve": "ogm serve",
}
COLOURS = {"ray": "#0072b2", "evidential": "#56b4e9", "dynamic": "#009e73", "network": "#d55e00", "serve": "black"}


def measured(name: str, given: argparse.Namespace) -> dict[str, Any]:
    if name == "points":
        return parts.many_points(1_000_000 if given.quick else 20_000_000)
    if name == "streams":
        return parts.streams(0.2 if given.quick else 2.0, 2 if given.quick else 9)
    if name == "serve":
        folder = Path(tempfile.mkdtemp(prefix="ogm-soak-"))
        try:
            return parts.serving(folder, 0.5 if given.quick else given.serve_minutes)
        finally:
            shutil.rmtree(folder)
    return parts.many_scans(name, 200 if given.quick else given.scans)


def verdicts(name: str, found: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return what was wanted of a part, and whether it is so."""
    rows: list[tuple[str, float, float, str, bool]] = []
    if name == "points":
        rows = [
            (f"{model}, {found['points'] / 1e6:g} million points: mapped", one["refused"] == "", 1, "", True)
            for model, one in found["models"].items()
        ]
    elif name == "streams":
        rows = [
            (f"{TITLES[chain]}: two threads", one["two threads / one"], 1.7, "x", True)
            for chain, one in found["chains"].items()
        ]
    else:
        rows = [(f"{TITLES[name]}: {what} left", found[f"{what} left"], 0, "", False) for what in ("files", "threads")]
        rows += [(f"{TITLES[name]}: memory grown", found["memory grown [%]"], 2.0, "%", False)]
    if name in parts.CHAINS:
        p99 = found["processor time"]["last / first"]
        rows += [(f"{TITLES[name]}: p99 of the last hundred / first, processor time", p99, 1.2, "x", False)]
    if name == "serve":
        load = found["processor time, last tenth / first"]
        rows += [("ogm serve: processor time of the last tenth / first", load, 1.2, "x", False)]
        rows += [("ogm serve: failed scans", found["result"]["failed"], 0, "", False)]
    return [
        {"what": w, "got": g, "wanted": t, "unit": u, "met": bool(g >= t if least else g <= t)}
        for w, g, t, u, least in rows
    ]


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
    run.save_picture(figure, path, run.caption(record["environment"]))


def merged(path: Path, name: str, part: Mapping[str, Any], environment: Mapping[str, Any]) -> dict[str, Any]:
    """Return the record with a part of it measured anew; every part has a date and a machine of its own."""
    try:
        old = json.loads(path.read_text())["parts"]
    except (OSError, ValueError, KeyError):
        old = {}
    where = {key: environment[key] for key in ("command", "date", "cpu", "cores", "load at start")}
    new = {**old, name: {**where, **part}}
    return {
        "environment": {**environment, "command": "python benchmarks/soak.py"},
        "parts": {one: new[one] for one in NAMES if one in new},
    }


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=10_000)
    parser.add_argument("--serve-minutes", type=float, default=60.0)
    parser.add_argument("--only", choices=NAMES, help="measure one part, and keep the others of the record")
    parser.add_argument("--quick", action="store_true", help="see that everything runs; writes no files")
    parser.add_argument("--out", type=Path, default=run.RESULTS / "soak.json")
    parser.add_argument("--picture", type=Path, default=run.PICTURES / "soak.png")
    given = parser.parse_args(words)
    if given.only is None:
        again = list(sys.argv[1:] if words is None else words)
        failed = [n for n in NAMES if subprocess.run([sys.executable, __file__, *again, "--only", n]).returncode]
        if failed:
            raise SystemExit(f"did not run to the end: {', '.join(failed)}")
        return
    environment = run.environment()
    found = measured(given.only, given)
    found["verdicts"] = verdicts(given.only, found)
    for row in found["verdicts"]:
        line = f"{row['what']}: {row['got']:.4g} {row['unit']} (wanted {row['wanted']:g})"
        print(f"{'ok    ' if row['met'] else 'MISSED'} {line}")
    if not given.quick:
        record = merged(given.out, given.only, found, environment)
        run.write_json(given.out, record)
        picture(record, given.picture)


if __name__ == "__main__":
    main()
