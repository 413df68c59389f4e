"""What `RayISM` predicts where it must not predict free, and where it must: hand-built scenes, one by one.

    python benchmarks/scenes.py [--before FILE | --keep FILE]

`--keep` saves the masses and does no more; `--before` sets them beside today's. For those of an earlier commit:

    git worktree add ../before COMMIT
    PYTHONPATH=../before python benchmarks/scenes.py --keep before.npz

Writes benchmarks/results/scenes.json and, with `--before`, docs/pictures/scenes.png.
"""

import _run as run  # first: it sets the number of threads
from _scene_pictures import gallery
from _scenes import BUILDERS, MOUNT, SPEC, Scene, scene

# isort: split
import argparse
import contextlib
import json
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import ogm
from ogm.geometric import RayISM

Masses = dict[str, NDArray[np.float32]]


def shares(masses: Masses, scenes: Mapping[str, Scene]) -> dict[str, dict[str, dict[str, float]]]:
    """Return, for each scene and region, what is predicted: a mass of more than half; and the mean masses."""
    result: dict[str, dict[str, dict[str, float]]] = {}
    for name, one in scenes.items():
        result[name] = {}
        for region, cells in one.regions.items():
            mass = masses[name][cells].astype(np.float64)
            (free, occupied), (mean_free, mean_occupied) = (mass > 0.5).mean(axis=0), mass.mean(axis=0)
            numbers = {"free": free, "occupied": occupied, "mean free": mean_free, "mean occupied": mean_occupied}
            rounded = {key: round(float(value), 4) for key, value in numbers.items()}
            result[name][region] = {"cells": int(cells.sum()), **rounded}
    return result


def commit() -> str:
    """Return the commit of the `ogm` in use, or "unknown"."""
    command = ["git", "-C", str(Path(ogm.__file__).parent), "describe", "--always", "--dirty"]
    with contextlib.suppress(OSError):
        return subprocess.run(command, capture_output=True, text=True).stdout.strip() or "unknown"
    return "unknown"


def report(record: Mapping[str, Any]) -> None:
    """Print shares of cells, those of before beside them."""
    before = record.get("before", {}).get("scenes", {})
    print(f"{'scene':34}{'region':14}{'cells':>7}  free, occupied [%]" + "   before" * bool(before))
    for name, regions in record["scenes"].items():
        for region, one in regions.items():
            then = before.get(name, {}).get(region)
            old = f"   {100 * then['free']:5.1f} {100 * then['occupied']:5.1f}" if then else ""
            new = f"{100 * one['free']:11.1f} {100 * one['occupied']:5.1f}"
            print(f"{name:34}{region:14}{one['cells']:7}{new}{old}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=0, help="of the range noise (default 0)")
    parser.add_argument("--before", type=Path, help="masses that --keep saved: measured and drawn beside today's")
    parser.add_argument("--keep", type=Path, help="save the masses (.npz) and stop")
    parser.add_argument("--out", type=Path, default=run.RESULTS / "scenes.json", help="where the figures go")
    parser.add_argument("--picture", type=Path, default=run.PICTURES / "scenes.png", help="where the picture goes")
    options = parser.parse_args()
    scenes = {name: scene(name, options.seed) for name in BUILDERS}
    ism = RayISM(SPEC, MOUNT)
    masses = {name: ism(one.scan).mass for name, one in scenes.items()}
    if options.keep:
        np.savez_compressed(options.keep, commit=np.array(commit()), **masses)
        print(f"wrote {options.keep}")
        return
    record = run.environment() | {"commit": commit(), "seed": options.seed}
    record["share"] = "of a region's cells with a mass of free, or of occupied, of more than 1/2"
    record["scenes"] = shares(masses, scenes)
    if options.before:
        with np.load(options.before) as file:
            then = {name: file[name] for name in scenes}
            record["before"] = {"commit": str(file["commit"]), "scenes": shares(then, scenes)}
    elif options.out.is_file():
        record["before"] = json.loads(options.out.read_text()).get("before", {})
    report(record)
    run.write_json(options.out, record)
    print(f"wrote {options.out}")
    if options.before:
        run.save_picture(gallery(scenes, then, masses), options.picture, run.caption(record), dpi=90)
        print(f"wrote {options.picture}")


if __name__ == "__main__":
    main()
