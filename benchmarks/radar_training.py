"""Make the weights of the learned sensor model of radar, ogm/data/radar.*: simulate, train, export.

    python benchmarks/radar_training.py FOLDER [--moments 240] [--epochs 8]

Each moment of a drive through a town gives nine sweeps (seven for validation): of each radar of
`ogm.simulation.radars.RADARS` at the front bumper, and of radars at random places around the vehicle, with the truth of
the lidar's samples. Training: twelve towns of 320 m, seed 21. Validation, which chooses the weights: 70 moments in
three towns of 480 m, seed 22, and of their sweeps every third. What exists in FOLDER is kept, so that the script goes
on where it stopped. The weights are written to FOLDER/run and FOLDER/radar.safetensors, .json and .onnx.
"""

import _run  # noqa: F401, first: it sets the number of threads

# isort: split
import argparse
import math
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from radar import ego_footprint, velocities_of

from ogm import Frame, Mount, Scan
from ogm.deep.checkpoint import load_radar_network
from ogm.deep.export import export_onnx
from ogm.deep.polar import RadarGrid
from ogm.deep.recipe import RADAR_RECIPE
from ogm.deep.training import train
from ogm.models.radar import radar_noise
from ogm.pose import inverse, pose
from ogm.simulation.dataset import make_sample, set_up
from ogm.simulation.mounts import PLACES
from ogm.simulation.plan import DatasetPlan, moment
from ogm.simulation.radar import sweep
from ogm.simulation.radars import RADARS
from ogm.state import Truth
from ogm.storage.files import atomic_write
from ogm.truth import TRUTH_SPEC

TRAINING = DatasetPlan(seed=21, samples=1200, validation=0, test=0, towns=12, drives=24, spacing=5.0, town_size=320.0)
VALIDATION = DatasetPlan(seed=22, samples=70, validation=0, test=0, towns=3, drives=6, spacing=5.0)
CORNERS = [place for place in PLACES if "-" in place]


def chosen(rng: np.random.Generator, more: bool) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Yield the radars of a moment and their poses on the vehicle: all in front, the others outwards of its sides."""
    places = [(name, "front", 0.0) for name in RADARS]
    places += [(name, str(rng.choice(list(PLACES))), 1.0) for name in RADARS]
    if more:
        places += [(name, str(rng.choice(list(PLACES))), 1.0) for name in ("ars408", "ars548")]
    places.append(("corner", str(rng.choice(CORNERS)), 1.0))
    for name, place, varied in places:
        x, y, z, degrees = PLACES[place]
        x, y = (value + varied * math.copysign(rng.uniform(0, 0.2), value) for value in (x, y))
        z, degrees = z + varied * rng.uniform(-0.2, 0.3), degrees + varied * rng.uniform(-15, 15)
        if place in ("front", "rear"):
            y = varied * rng.uniform(-0.5, 0.5)
        yield name, pose(x, y, z, yaw=math.radians(degrees))


def make(plan: DatasetPlan, index: int, path: Path, more: bool) -> None:
    """Simulate a moment, and write its sweeps and its truth."""
    sample, here = make_sample(plan, "training", index, 1), set_up(plan, "training", index, 1)
    rng, velocities = np.random.default_rng([plan.seed, index]), velocities_of(here)
    rows: dict[str, Any] = {"truth": sample.truth.state, "footprint": np.array(ego_footprint(here))}
    for n, (name, T_vehicle_radar) in enumerate(chosen(rng, more)):
        T = here.state.ego @ T_vehicle_radar
        turning = np.cross([0, 0, here.state.ego_yaw_rate], T[:3, 3] - here.state.ego[:3, 3])
        velocity = here.state.ego_velocity + turning
        noise = np.random.default_rng([plan.seed, index, n])
        made = sweep(here.world.scene, RADARS[name], T, noise, velocity=velocity, velocities=velocities)
        rows[f"radar{n}"], rows[f"z{n}"] = np.array(name), T_vehicle_radar[2, 3]
        rows[f"T{n}"] = inverse(here.T_world_sensor) @ T
        rows[f"rows{n}"] = np.column_stack([made.xyz, made.doppler, made.rcs])
        rows["count"] = n + 1
    with atomic_write(path) as file:
        np.savez_compressed(file, **rows)


def moments(plan: DatasetPlan, folder: Path, indices: Sequence[int], more: bool) -> list[Frame]:
    """Simulate the moments that are missing, those of one town after each other, and read all."""
    folder.mkdir(parents=True, exist_ok=True)
    for index in sorted(indices, key=lambda k: (moment(plan, "training", k).scenario % plan.towns, k)):
        path = folder / f"{index:05d}.npz"
        if not path.exists():
            make(plan, index, path, more)
            print(path, flush=True)
    return [one for index in indices for one in read(folder / f"{index:05d}.npz")]


def read(path: Path) -> Iterator[Frame]:
    """Yield the sweeps of a moment with its truth."""
    with np.load(path) as rows:
        truth, edges = Truth(TRUTH_SPEC, rows["truth"]), tuple(float(edge) for edge in rows["footprint"])
        for n in range(int(rows["count"])):
            one = rows[f"rows{n}"]
            scan = Scan(one[:, :3].copy(), doppler=one[:, 3], rcs=one[:, 4], sensor=str(rows[f"radar{n}"]))
            mount = Mount(float(rows[f"z{n}"]), rows[f"T{n}"], ego_footprint=edges)
            yield Frame(scan, mount, None, truth, name=f"{path.stem}-{n}")


def provenance(plan: DatasetPlan, frames: Sequence[Frame]) -> dict[str, Any]:
    """Return the facts about data for the description of the weights."""
    facts = {name: getattr(plan, name) for name in ("seed", "towns", "town_size", "drives", "spacing")}
    return {
        "simulated by": "ogm.simulation.radar",
        "moments": len({id(one.truth) for one in frames}),
        "sweeps": len(frames),
        **facts,
    }


def main() -> None:
    """Simulate, train, export."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--moments", type=int, default=240)
    parser.add_argument("--epochs", type=int, default=RADAR_RECIPE.epochs)
    given = parser.parse_args()
    training = moments(TRAINING, given.folder / "train", range(given.moments), True)
    validation = moments(VALIDATION, given.folder / "val", range(VALIDATION.samples), False)[::3]
    facts = {
        "data": {"training": provenance(TRAINING, training), "validation": provenance(VALIDATION, validation)},
        "licence": "Apache-2.0; simulated data only",
    }
    recipe = replace(RADAR_RECIPE, epochs=given.epochs)
    options: Any = {"resume": True, "workers": 0, "facts": facts, "progress": False, "noise": radar_noise}
    best = train(training, validation, RadarGrid(), given.folder / "run", recipe, **options)
    network, description = load_radar_network(best)
    for end in (".safetensors", ".json"):
        shutil.copy(best.with_suffix(end), given.folder / f"radar{end}")
    export_onnx(network, given.folder / "radar.onnx", description=description, weights=best)
    print(description["result"])


if __name__ == "__main__":
    main()
