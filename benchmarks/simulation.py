"""Cost of a simulated sample beyond its rays, gain of a second worker, speed of reading a data set.

    python benchmarks/simulation.py [--moments N] [--samples N] [--quick] [--store DATA]

All on two cores, unlike the other benchmarks. Writes benchmarks/results/simulation.json.
"""

import os

os.environ["OGM_CORES"] = "2"  # before _run, which pins to one core otherwise

import _run as run  # noqa: E402

# isort: split
import statistics  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
from concurrent.futures import ProcessPoolExecutor  # noqa: E402
from dataclasses import replace  # noqa: E402
from functools import partial  # noqa: E402
from multiprocessing import get_context  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402
import open3d  # noqa: E402
from _timing import Contender, once  # noqa: E402

from ogm.simulation import dataset  # noqa: E402
from ogm.simulation import workers as crew
from ogm.simulation.dataset import SceneSetup, make_sample, set_up  # noqa: E402
from ogm.simulation.mesh import merge  # noqa: E402
from ogm.simulation.mounts import single_sensor  # noqa: E402
from ogm.simulation.plan import DatasetPlan  # noqa: E402
from ogm.simulation.sensors import hd_directions  # noqa: E402
from ogm.simulation.store import Store  # noqa: E402
from ogm.simulation.traffic.bodies import ego_vehicle

CORES = (1, 2)
NOTE = (
    "'rays alone' is Open3D casting the sample's 57,600 + 5,400,000 rays at one scene that holds the town and the "
    "traffic, arrays and scene ready, everything else left out. A whole sample places traffic, scans, finds the "
    "ground below, casts, fills the truth grid, compresses and writes it."
)


def rays_of(here: SceneSetup) -> tuple[Any, Any]:
    """Return the scene of a moment in one piece, and the rays of a paper's sample, for Open3D itself."""
    T = here.T_world_sensor
    meshes = [one.mesh.moved(one.pose) for one in here.objects] + [ego_vehicle().moved(here.state.ego)]
    whole = merge([here.world.town.mesh, *meshes])
    scene = open3d.t.geometry.RaycastingScene(nthreads=2)
    scene.add_triangles(open3d.core.Tensor(whole.vertices), open3d.core.Tensor(whole.triangles))
    directions = np.concatenate([here.spec.directions().reshape(-1, 3), hd_directions(here.spec).reshape(-1, 3)])
    rays = np.empty((len(directions), 6), np.float32)
    rays[:, :3] = T[:3, 3]
    rays[:, 3:] = directions @ T[:3, :3].T.astype(np.float32)
    return scene, open3d.core.Tensor(rays)


def write_sample(store: Store, plan: DatasetPlan, k: int, index: int, _: None) -> None:
    """Make a sample on two cores, and write it as the k-th."""
    store.write("training", k, [make_sample(plan, "training", index, 2)])


def cost(plan: DatasetPlan, moments: int, repeats: int, folder: Path) -> dict[str, Any]:
    """Time whole samples of both modes beside their rays alone, moment by moment."""
    times: dict[str, list[float]] = {"rays alone": [], "hd": [], "aimed": []}
    plans = {mode: replace(plan, truth=mode) for mode in ("hd", "aimed")}
    for k in range(moments):
        index = 10 * k  # another drive each time
        scene, rays = rays_of(set_up(plan, "training", index))
        counts = {"training": index + 1}
        calls = {"rays alone": Contender(lambda _, scene=scene, rays=rays: scene.cast_rays(rays, 2))}
        for mode, one in plans.items():
            store = Store.create(folder / f"{mode}{k}", {}, counts, dataset.lidars(one), dataset.versions())
            calls[mode] = Contender(partial(write_sample, store, one, k, index))
        rounds = [{name: once(call)[0] for name, call in calls.items()} for _ in range(repeats + 1)]
        for name, values in times.items():
            values.append(statistics.median(seconds[name] for seconds in rounds[1:]))  # the first is to warm up
        print(k, {name: round(values[-1], 3) for name, values in times.items()}, flush=True)
    ratios = {mode: [a / b for a, b in zip(times[mode], times["rays alone"], strict=True)] for mode in plans}
    return {
        "seconds, median": {name: round(statistics.median(values), 3) for name, values in times.items()},
        "times the rays alone, median": {m: round(statistics.median(r), 3) for m, r in ratios.items()},
        "times the rays alone, worst moment": {m: round(max(r), 3) for m, r in ratios.items()},
        "moments": moments,
        "repeats": repeats,
    }


def recipe_cost(name: str, samples: int) -> dict[str, Any]:
    """Return the processor time of samples of a recipe and of the default, on one core, and of a town of the recipe."""
    plans = {"default": DatasetPlan(), name: DatasetPlan.of_recipe(name, seed=18)}
    seconds: dict[str, list[float]] = {one: [] for one in plans}
    towns: dict[str, float] = {}
    for one, plan in plans.items():
        for number in range(2):
            first = number * (70 if one == name else 10)
            found = [processor_time(plan, first + k) for k in range(samples // 2 + 1)]
            seconds[one] += found[1:]
            towns[one] = found[0]  # the town, and kernels
    median = {one: round(statistics.median(values), 3) for one, values in seconds.items()}
    return {"seconds, median": median, "times the default": round(median[name] / median["default"], 3)} | {
        "seconds of a town with its first sample": round(towns[name], 2),
        "samples each": samples,
    }


def processor_time(plan: DatasetPlan, number: int) -> float:
    """Return the processor time of a training sample [s]."""
    return once(Contender(lambda _: make_sample(plan, "training", number, 1)))[1]


def made(workers: int, cores: int, plan: DatasetPlan, folder: str) -> tuple[float, float]:
    """Return samples per second once the towns stand, and bytes per sample."""
    os.sched_setaffinity(0, set(sorted(os.sched_getaffinity(0))[:cores]))
    store = crew.begin(folder, plan, dataset.lidars(plan), dataset.versions())
    events = crew.make_shards(store, plan, make_sample, workers=workers)
    next(events)  # the estimate: towns stand, kernels are compiled
    start, size = time.perf_counter(), 0
    for event in events:
        size += event.size
    return plan.samples / (time.perf_counter() - start), size / plan.samples


def scaling(plan: DatasetPlan, samples: int, folder: Path) -> dict[str, Any]:
    """Make the same data set on one core, and by two workers on two, and compare the files."""
    plan = replace(plan, samples=samples, validation=0, test=0)
    rates = {}
    for workers in CORES:
        target = folder / f"by{workers}"
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            rates[workers], size = pool.submit(made, workers, workers, plan, str(target)).result()
        print(f"{workers} worker(s): {rates[workers]:.2f} samples/s", flush=True)
    one, two = (
        {path.relative_to(top): path.read_bytes() for path in top.rglob("*") if path.is_file()}
        for top in (folder / "by1", folder / "by2")
    )
    return {
        "samples": samples,
        "samples per second by one worker on one core": round(rates[1], 3),
        "samples per second by two workers on two": round(rates[2], 3),
        "gain": round(rates[2] / rates[1], 3),
        "bytes per sample": round(size),
        "the same bytes": one == two,
    }


def read(path: str, first: int, step: int) -> tuple[int, float]:
    """Decode every step-th training sample to points and truth; return their number and the seconds."""
    split = Store.open(path)["training"]
    split[first].points, split[first].truth  # noqa: B018  compiles, opens
    start = time.perf_counter()
    for index in range(first, len(split), step):
        one = split[index]
        one.points, one.truth.state  # noqa: B018  decoded
    return len(range(first, len(split), step)), time.perf_counter() - start


def reading(path: Path) -> dict[str, float]:
    """Read a data set with one process, then with two at once."""
    rates = {}
    for count in CORES:
        with ProcessPoolExecutor(count, mp_context=get_context("spawn")) as pool:
            list(pool.map(read, [str(path)] * count, [0] * count, [10**9] * count))  # processes stand
            results = list(pool.map(read, [str(path)] * count, range(count), [count] * count))
        rate = round(sum(number / seconds for number, seconds in results), 1)
        rates[f"samples per second, {count} process{'es' if count > 1 else ''}"] = rate
    return rates


def main() -> None:
    parser = run.Parser(__doc__, quick=True)
    parser.add_argument("--moments", type=int, default=6, help="moments of samples that are timed (default 6)")
    parser.add_argument("--repeats", type=int, default=3, help="times each (default 3)")
    parser.add_argument("--samples", type=int, default=80, help="made to compare workers (default 80)")
    parser.add_argument("--store", type=Path, help="data set to read (default: the one made for the workers)")
    options = parser.parse_args()
    chosen = (options.moments, options.repeats, options.samples)
    moments, repeats, samples = (2, 1, 20) if options.quick else chosen
    record = run.environment()
    plan = DatasetPlan(mounts=single_sensor("vlp-32c"))
    with tempfile.TemporaryDirectory() as folder:
        record["one sample"] = cost(plan, moments, repeats, Path(folder))
        record["gen2"] = recipe_cost("gen2", 4 * moments)
        record["two workers"] = scaling(DatasetPlan(), samples, Path(folder))
        store = options.store or Path(folder) / "by2"
        record["reading"] = reading(store)
    record["note"] = NOTE
    run.write_record(options.out, record)


if __name__ == "__main__":
    main()
