"""How fast is the deep model, and where does the time go? Against the bare convolutions, in one run on two cores.

    python benchmarks/deep_speed.py [--data FOLDER] [--rounds N] [--quick]

One scan of 57,600 points (as many rays as a VLP-32C turn of 0.2 degrees has), drawn at random from the shipped road
scan, goes through both networks. Writes benchmarks/results/deep_speed.json and docs/pictures/deep_speed.png.
With a data set it also counts the augmented samples that one process prepares per second.
"""

import os

os.environ.setdefault("OGM_CORES", "2")

from _run import (  # noqa: E402
    CORES,
    FLOOR,
    OURS,
    PEER,
    PICTURES,
    RESULTS,
    TWIN,
    Contender,
    Times,
    caption,
    environment,
    measure,
    write_json,
)

# isort: split
import argparse  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable, Mapping  # noqa: E402
from importlib.resources import as_file, files  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any  # noqa: E402

import numpy as np  # noqa: E402
import torch  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from torch import nn  # noqa: E402

from ogm import GridSpec, read_scan  # noqa: E402
from ogm.deep import LITE, PAPER, DeepISM, Network  # noqa: E402
from ogm.deep.data import Augmentation, PillarDataset  # noqa: E402
from ogm.deep.network import ConvReLU  # noqa: E402
from ogm.deep.pillars import pillarize, pillarize_torch  # noqa: E402
from ogm.files import atomic_write  # noqa: E402
from ogm.geometric import HeightBandISM, RayISM  # noqa: E402

SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
POINTS, HEIGHT = 57_600, 1.98
NOTE = (
    "Weights do not change the time, so both networks are timed with random ones. 'convolutions' are the fused "
    "network's convolutions alone, each on the input that it has within the network, one after the other."
)


def scan() -> np.ndarray:
    with as_file(files("ogm") / "data" / "vls128_road.pcd.xz") as path:
        points = read_scan(path, axes=("+y", "-x", "+z")).points
    rng = np.random.default_rng(0)
    return np.ascontiguousarray(points[np.sort(rng.choice(len(points), POINTS, replace=False))])


def convolutions(network: Network, canvas: torch.Tensor) -> tuple[Callable[[], None], float]:
    """Return what runs the network's convolutions alone, and their multiplications and additions [1e9]."""
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
    hooks = [
        module.register_forward_hook(note)
        for module in network.modules()
        if module is network.join
        or isinstance(module, ConvReLU)
        or (isinstance(module, nn.Conv2d | nn.ConvTranspose2d) and module not in inside)
    ]
    network.evidence(canvas)
    for hook in hooks:
        hook.remove()

    def run() -> None:
        for module, given in calls:
            module(given)

    return run, operations / 1e9


def contenders(points: np.ndarray) -> tuple[dict[str, Contender], dict[str, float]]:
    """Return what is timed, and the operations of each network [1e9]."""
    raised = points.copy()
    raised[:, 2] += HEIGHT
    tensor = torch.from_numpy(raised)
    result = {
        "pillars": Contender(lambda _: pillarize(raised, SPEC)),
        "pillars, torch twin": Contender(lambda _: pillarize_torch(tensor, SPEC)),
    }
    operations = {}
    for name, config in (("lite", LITE), ("paper", PAPER)):
        ism = DeepISM(Network(config, SPEC), sensor_height=HEIGHT)
        network = ism.network
        pillars = pillarize(raised, SPEC, config.z_range)
        canvas = network.canvas(pillars)
        bare, operations[name] = convolutions(network, canvas)
        slow = name == "paper"
        result |= {
            f"{name}, whole": Contender(lambda _, ism=ism: ism(points), slow=slow),
            f"{name}, pillars to canvas": Contender(lambda _, n=network, p=pillars: n.canvas(p)),
            f"{name}, canvas to evidence": Contender(lambda _, n=network, c=canvas: n.evidence(c), slow=slow),
            f"{name}, convolutions": Contender(lambda _, run=bare: run(), slow=slow),
        }
    ray, band = RayISM(SPEC, HEIGHT), HeightBandISM(SPEC, HEIGHT)
    result["RayISM"] = Contender(lambda _: ray(points))
    result["HeightBandISM"] = Contender(lambda _: band(points))
    return result, operations


def loading(folder: Path, count: int = 200) -> dict[str, float]:
    """Return the samples that one process reads and augments per second."""
    from ogm.simulation.store import Store

    scenes = PillarDataset(Store.open(folder)["training"], SPEC, Augmentation())
    for i in range(5):
        scenes[0, i]
    torch.set_num_threads(1)
    start, core = time.perf_counter(), time.process_time()
    for i in range(count):
        scenes[0, i]
    wall, core = time.perf_counter() - start, time.process_time() - core
    torch.set_num_threads(CORES)
    return {"samples": count, "samples per second": count / wall, "on core": core / wall}


def summary(times: Mapping[str, Times], operations: Mapping[str, float]) -> dict[str, Any]:
    said: dict[str, Any] = {
        "pillars, torch twin / kernel": times["pillars, torch twin"].median / times["pillars"].median
    }
    for name in ("lite", "paper"):
        whole, bare = times[f"{name}, whole"].median, times[f"{name}, convolutions"].median
        said[name] = {
            "scans per second": 1000 / whole,
            "whole / convolutions": whole / bare,
            "share outside convolutions": 1 - bare / whole,
            "operations [1e9]": operations[name],
            "convolutions [1e9 operations / s]": 1000 * operations[name] / bare,
            "whole / RayISM": whole / times["RayISM"].median,
        }
    return said


def picture(path: Path, times: Mapping[str, Times], record: Mapping[str, Any]) -> None:
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    for ax, name in zip(figure.subplots(1, 2), ("lite", "paper"), strict=True):
        whole, bare = times[f"{name}, whole"].median, times[f"{name}, convolutions"].median
        pillars, canvas = times["pillars"].median, times[f"{name}, pillars to canvas"].median
        parts = {
            "pillars": (pillars, OURS),
            "features, canvas": (canvas, TWIN),
            "convolutions": (bare, PEER),
            "rest": (max(whole - bare - pillars - canvas, 0), FLOOR),
        }
        left = 0.0
        for label, (width, colour) in parts.items():
            ax.barh(0, width, left=left, color=colour, label=f"{label}: {width:.1f} ms")
            left += width
        ax.barh(1, times["RayISM"].median, color="black", label=f"RayISM: {times['RayISM'].median:.1f} ms")
        ax.set_yticks([0, 1], [f"{name}\n{1000 / whole:.1f} scans/s", "RayISM"])
        ax.set_xlabel("ms per scan of 57,600 points")
        ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.22), ncol=2, fontsize=8, frameon=False)
    figure.suptitle(caption(record), fontsize=6)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, help="data set of `ogm simulate`, to time its reading")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--quick", action="store_true", help="three rounds, and no files")
    options = parser.parse_args()
    record = environment()
    torch.set_num_threads(CORES)
    with torch.inference_mode():
        timed, operations = contenders(scan())
        times = measure(timed, 3 if options.quick else options.rounds)
    record |= {
        "note": NOTE,
        "points": POINTS,
        "times [ms]": {name: one._asdict() for name, one in times.items()},
        "summary": summary(times, operations),
    }
    if options.data:
        record["reading and augmenting, one process"] = loading(options.data)
        record["command"] = f"python benchmarks/deep_speed.py --data {options.data.name}"
    for name, one in times.items():
        print(f"{name:30} {one}")
    for name, value in {
        **record["summary"],
        "reading": record.get("reading and augmenting, one process"),
    }.items():
        print(f"{name:30} {value}")
    if not options.quick:
        write_json(RESULTS / "deep_speed.json", record)
        picture(PICTURES / "deep_speed.png", times, record)


if __name__ == "__main__":
    main()
