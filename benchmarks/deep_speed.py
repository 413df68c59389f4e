"""How fast is the deep model, by which engine, and where does the time go? In one run on two cores.

    python benchmarks/deep_speed.py [--data FOLDER] [--rounds N] [--quick]

One scan of 57,600 points (as many rays as a VLP-32C turn of 0.2 degrees has), drawn at random from the shipped road
scan, goes through both networks, by torch and against their bare convolutions, through the shipped one by every
engine that is installed, and through the default model `combined`. `lite` takes the masses of `RayISM`, whose time is
part of its own. New processes time loading: from the first import to the first grid. Writes
benchmarks/results/deep_speed.json and docs/pictures/deep_speed.png. With a data set it also counts the augmented frames
that one process prepares per second.
"""

# ruff: noqa: E402
import os

os.environ.setdefault("OGM_CORES", "2")

import _run as run

# isort: split
import tempfile
import time
from collections.abc import Callable, Mapping
from importlib.resources import as_file, files
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _charts import FLOOR, OURS, PEER, TWIN, caption, save_picture
from _contenders import thinned
from _timing import Contender, Times, measure
from matplotlib.figure import Figure
from torch import nn

from ogm import GridSpec, Mount, read_scan
from ogm.datasets import open_dataset
from ogm.deep import PAPER, DeepISM, PillarNetwork
from ogm.deep.data import Augmentation, PillarDataset
from ogm.deep.pillars import pillarize, pillarize_torch
from ogm.deep.recipe import LITE_RECIPE
from ogm.deep.torch_engine import ConvReLU
from ogm.geometric import HeightBandISM, RayISM
from ogm.models import load_model

SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
POINTS, MOUNT = 57_600, Mount(1.98)
ENGINES = {
    "lite by onnxruntime": {"engine": "onnxruntime", "threads": run.CORES},  # in 8-bit integers
    "lite by onnxruntime, float32": {"engine": "onnxruntime", "threads": run.CORES, "precision": "float32"},
    "lite by torch": {"engine": "torch"},
    "lite by openvino": {"engine": "openvino", "threads": run.CORES},
    "lite by openvino, bfloat16": {"engine": "openvino", "threads": run.CORES, "precision": "bfloat16"},
    "lite by torch, bfloat16": {"engine": "torch", "precision": "bfloat16"},
}
LOADING = """
import time
start = time.perf_counter()
import sys
import numpy as np
import ogm
from ogm.deep import DeepISM
DeepISM.load("lite", mount=ogm.Mount(1.98), engine=sys.argv[1])(np.load(sys.argv[2]))
print(time.perf_counter() - start, time.process_time())
"""
NOTE = "Both networks have random weights. 'convolutions' run alone, each on its input within the network."


def scan() -> np.ndarray:
    with as_file(files("ogm") / "data" / "vls128_road.pcd.xz") as path:
        return thinned(read_scan(path, axes=("+y", "-x", "+z")).points, POINTS)


def convolutions(network: PillarNetwork, feature_map: torch.Tensor) -> tuple[Callable[[], Any], float]:
    """Return a function that runs the network's convolutions alone, and their multiplications and additions [1e9]."""
    calls: list[tuple[Callable[..., Any], Any]] = []
    operations = 0.0

    def note(module: nn.Module, given: tuple[torch.Tensor, ...], made: Any) -> None:
        nonlocal operations
        if module is network.join:  # the head, by parts as the network does it
            calls.append((network._head, made))
            operations += 2 * network.head.weight.numel() * made[0][0, 0].numel()
            return
        conv = module.conv if isinstance(module, ConvReLU) else module
        calls.append((conv, given[0].clone(memory_format=torch.preserve_format)))
        cells = given[0] if isinstance(conv, nn.ConvTranspose2d) else made
        operations += 2 * conv.weight.numel() * cells[0, 0].numel()

    inside = {module.conv for module in network.modules() if isinstance(module, ConvReLU)}
    kinds = (ConvReLU, nn.Conv2d, nn.ConvTranspose2d)
    timed = [one for one in network.modules() if isinstance(one, kinds) and one not in inside]
    hooks = [module.register_forward_hook(note) for module in (*timed, network.join)]
    network.evidence(feature_map)
    for hook in hooks:
        hook.remove()

    return lambda: [module(given) for module, given in calls], operations / 1e9


def contenders(points: np.ndarray) -> tuple[dict[str, Contender], dict[str, float]]:
    raised = points + np.array([0, 0, MOUNT.sensor_height, 0], np.float32)
    tensor = torch.from_numpy(raised)
    runs: dict[str, Callable[[], Any]] = {
        "pillars": lambda: pillarize(raised, SPEC),
        "pillars, torch reference": lambda: pillarize_torch(tensor, SPEC),
    }
    operations, ray = {}, RayISM(SPEC, MOUNT)
    rays = torch.from_numpy(ray(points).mass[None])
    for name, config in (("lite", LITE_RECIPE.network), ("paper", PAPER)):
        ism = DeepISM(PillarNetwork(config, SPEC), mount=MOUNT)
        network, pillars = ism.engine.network, pillarize(raised, SPEC, config.z_range)._replace(rays=rays)
        feature_map = network.feature_map(pillars)
        bare, operations[name] = convolutions(network, feature_map)
        runs |= {
            f"{name}, whole": lambda ism=ism: ism(points),
            f"{name}, pillars to feature map": lambda n=network, p=pillars: n.feature_map(p),
            f"{name}, feature map to evidence": lambda n=network, x=feature_map: n.evidence(x),
            f"{name}, convolutions": bare,
        }
    runs |= {name: lambda ism=ism: ism(points) for name, ism in engines().items()}
    for model in (ray, HeightBandISM(SPEC, MOUNT), load_model("combined", SPEC, MOUNT)):
        runs[type(model).__name__] = lambda model=model: model(points)
    return {name: Contender(lambda _, call=call: call()) for name, call in runs.items()}, operations


def engines() -> dict[str, DeepISM]:
    """Return the shipped model by every engine that is installed."""
    found = {name: options for name, options in ENGINES.items() if find_spec(str(options["engine"]))}
    return {name: DeepISM.load("lite", mount=MOUNT, **options) for name, options in found.items()}


def differences(points: np.ndarray) -> dict[str, dict[str, float]]:
    """Return the distance of each engine's masses from torch's in float32."""
    masses = {name: ism(points).mass for name, ism in engines().items()}
    errors = {name: np.abs(mass - masses["lite by torch"]) for name, mass in masses.items()}
    return {name: {"largest": float(e.max()), "mean": float(e.mean())} for name, e in errors.items()}


def starting(points: np.ndarray, count: int) -> dict[str, dict[str, float]]:
    """Return the seconds from the first import to the first grid, of new processes: the best and the median of some."""
    result = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "points.npy"
        np.save(path, points)
        for engine in ("onnxruntime", "torch"):
            rows = [run.in_new_process(LOADING, [engine, path]).split() for _ in range(count + 1)]
            wall, core = np.array(rows[1:], float).T  # the first fills the caches
            result[engine] = {
                "best [s]": float(min(wall)),
                "median [s]": float(np.median(wall)),
                "best on the cores [s]": float(min(core)),
            }
    return result


def loading(folder: Path, count: int = 200) -> dict[str, float]:
    dataset = PillarDataset(open_dataset(folder, split="training"), SPEC, Augmentation())
    torch.set_num_threads(1)
    dataset[0, 0]
    start = time.perf_counter()
    for k in range(count):
        dataset[0, k % len(dataset)]
    return {"samples": count, "samples per second": count / (time.perf_counter() - start)}


def summary(times: Mapping[str, Times], operations: Mapping[str, float]) -> dict[str, Any]:
    median = {name: one.median for name, one in times.items()}
    result: dict[str, Any] = {}
    for name in ("lite", "paper"):
        whole, bare = median[f"{name}, whole"], median[f"{name}, convolutions"]
        result[name] = {
            "scans per second": 1000 / whole,
            "whole / convolutions": whole / bare,
            "share outside convolutions": 1 - bare / whole,
            "operations [1e9]": operations[name],
        }
    by_torch = times["lite by torch"]
    result["engines, torch / engine"] = {
        name: {"medians": by_torch.median / times[name].median, "quickest quarters": by_torch.low / times[name].low}
        for name in ENGINES
        if name in times
    }
    return result


def picture(path: Path, median: Mapping[str, float], record: Mapping[str, Any]) -> None:
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    for ax, name in zip(figure.subplots(1, 2), ("lite", "paper"), strict=True):
        whole, left = median[f"{name}, whole"], 0.0
        for label, key, colour in (
            ("pillars", "pillars", OURS),
            ("feature map", f"{name}, pillars to feature map", TWIN),
            ("convolutions", f"{name}, convolutions", PEER),
            ("rest", "", FLOOR),
        ):
            width = median[key] if key else max(whole - left, 0)
            ax.barh(0, width, left=left, color=colour, label=f"{label}: {width:.1f} ms")
            left += width
        ax.barh(1, median["RayISM"], color="black", label=f"RayISM: {median['RayISM']:.1f} ms")
        ax.set_yticks([0, 1], [f"{name}\n{1000 / whole:.1f} scans/s", "RayISM"])
        ax.set_xlabel("ms per scan of 57,600 points")
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.22), ncol=2, fontsize=8)
    save_picture(figure, path, caption(record), dpi=130)


def main() -> None:
    parser = run.Parser(__doc__, picture=True, quick=True, rounds=15)
    parser.add_argument("--data", type=Path, help="data set of `ogm simulate`, to time its reading")
    options = parser.parse_args()
    record = run.environment("ray", "height-band", "lite", "combined")
    torch.set_num_threads(run.CORES)
    with torch.inference_mode():
        timed, operations = contenders(scan())
        times = measure(timed, 3 if options.quick else options.rounds)
    record |= {"note": NOTE, "points": POINTS, "summary": summary(times, operations)}
    record["differences in mass"] = differences(scan())
    record["loading, first import to first grid"] = starting(scan(), 1 if options.quick else 7)
    record["times [ms]"] = times
    if options.data:
        record["reading and augmenting, one process"] = loading(options.data)
    run.write_record(options.out, record)
    picture(options.picture, {name: one.median for name, one in times.items()}, record)


if __name__ == "__main__":
    main()
