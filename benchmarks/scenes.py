"""Shares that `RayISM` predicts where it must not predict free, and where it must: hand-built scenes, one by one.

    python benchmarks/scenes.py [--before FOLDER]

FOLDER is a checkout of an earlier commit (`git worktree add ../before COMMIT`), whose model maps the same scans.
Without it, the earlier figures of the record stay. Writes benchmarks/results/scenes.json and, with `--before`,
docs/pictures/scenes.png.
"""

import _run as run  # first: it sets the number of threads
from _charts import caption, save_picture
from _scene_pictures import gallery

# isort: split
import json
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ogm.geometric import RayISM
from ogm.simulation.hand_built_scenes import SCENES, SPEC, HandBuiltScene, hand_built_scene

Masses = dict[str, NDArray[np.float32]]
MAP_SCANS = """
import sys
import numpy as np
from ogm import GridSpec, Mount, Scan
from ogm.geometric import RayISM
SILENT = ", no returns"
ism, (scans, masses) = RayISM(GridSpec.centered(), Mount(1.9)), sys.argv[1:]
with np.load(scans) as file:
    given = {name: file[name] for name in file}
names = [name for name in given if not name.endswith(SILENT)]
grids = {name: ism(Scan(given[name], no_returns=given.get(name + SILENT))) for name in names}
np.savez(masses, **{name: grid.mass for name, grid in grids.items()})
"""


def shares(masses: Masses, scenes: Mapping[str, HandBuiltScene]) -> dict[str, dict[str, dict[str, float]]]:
    """Return, for each scene and region, the shares of cells with a mass of more than half, and the mean masses."""
    result: dict[str, dict[str, dict[str, float]]] = {}
    for name, scene in scenes.items():
        result[name] = {}
        for region, cells in scene.regions.items():
            mass = masses[name][cells].astype(np.float64)
            (free, occupied), (mean_free, mean_occupied) = (mass > 0.5).mean(axis=0), mass.mean(axis=0)
            numbers = {"free": free, "occupied": occupied, "mean free": mean_free, "mean occupied": mean_occupied}
            rounded = {key: round(float(value), 4) for key, value in numbers.items()}
            result[name][region] = {"cells": int(cells.sum()), **rounded}
    return result


def masses_of(checkout: Path, scenes: Mapping[str, HandBuiltScene]) -> Masses:
    """Return the masses of the scenes by the model of another checkout."""
    arrays = {name: scene.scan.points for name, scene in scenes.items()}
    silent = {name: scene.scan.no_returns for name, scene in scenes.items()}
    arrays |= {f"{name}, no returns": directions for name, directions in silent.items() if directions is not None}
    with tempfile.TemporaryDirectory() as folder:
        scans, masses = Path(folder) / "scans.npz", Path(folder) / "masses.npz"
        np.savez(scans, **arrays)
        run.in_new_process(MAP_SCANS, [scans, masses], cwd=checkout, env=os.environ | {"PYTHONPATH": str(checkout)})
        with np.load(masses) as file:
            return {name: file[name] for name in scenes}


def main() -> None:
    parser = run.Parser(__doc__, picture=True)
    parser.add_argument("--seed", type=int, default=0, help="of the range noise (default 0)")
    parser.add_argument("--before", type=Path, help="checkout of an earlier commit, measured and drawn too")
    options = parser.parse_args()
    scenes = {name: hand_built_scene(name, options.seed) for name in SCENES}
    ism = RayISM(SPEC)
    masses = {name: ism(scene.scan).mass for name, scene in scenes.items()}
    record = run.environment("ray") | {"seed": options.seed}
    record["share"] = "of a region's cells with a mass of free, or of occupied, of more than 1/2"
    record["scenes"] = shares(masses, scenes)
    if options.before:
        then = masses_of(options.before, scenes)
        record["before"] = {"commit": run.commit(options.before), "scenes": shares(then, scenes)}
        save_picture(gallery(scenes, then, masses), options.picture, caption(record), dpi=90)
    elif options.out.is_file():
        record["before"] = json.loads(options.out.read_text()).get("before", {})
    run.write_record(options.out, record)


if __name__ == "__main__":
    main()
