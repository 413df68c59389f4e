"""Targets: weights, exported networks, simulated data sets, kept frames of an evaluation, calibrations."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from targets import Target, check_scan

from ogm import GridSpec, open_dataset
from ogm.evaluation.cache import FrameResult, ResultCache
from ogm.metrics import ConfusionSums
from ogm.models import Calibration

SEEDS = Path(__file__).parent / "seeds"


def _weights(folder: Path) -> Target:
    from dataclasses import replace

    import torch

    from ogm.deep.checkpoint import load_network, save_network
    from ogm.deep.network import LITE, PillarNetwork

    torch.manual_seed(0)
    torch.set_num_threads(1)
    config = replace(LITE, pillar=4, up=4, blocks=((4, 1), (4, 1)))
    network = PillarNetwork(config, GridSpec(0.16, (16, 16), (-1.28, -1.28)))
    path = save_network(folder / "net.safetensors", network, {"seen": {"height": [1.7, 2.1]}})
    files = {one.name: one.read_bytes() for one in (path, path.with_suffix(".json"))}
    return Target(files, lambda files: load_network(files / "net.safetensors"))


def _exported(folder: Path) -> Target:
    from ogm.deep.onnx_file import read_onnx

    return Target({"net.onnx": (SEEDS / "net.onnx").read_bytes()}, lambda files: read_onnx(files / "net.onnx"))


def _engine(folder: Path) -> Target:
    from ogm.deep.onnx_engine import OnnxEngine

    points = np.random.default_rng(0).uniform(-1, 1, (200, 4)).astype(np.float32)

    def read(files: Path) -> None:
        engine = OnnxEngine(files / "net.onnx", threads=1)
        if max(engine.spec.shape) <= 64:  # a larger grid is the user's own choice
            engine.masses([engine.pillars(points, (-0.1, 0.1, -0.1, 0.1), np.eye(4))], None)

    return Target({"net.onnx": (SEEDS / "net.onnx").read_bytes()}, read)


def _store(kind: str, folder: Path) -> Target:
    from ogm.simulation.sample import OBJECT_DTYPE, Beams, SimulatedSample
    from ogm.simulation.store import Store
    from ogm.state import Truth
    from ogm.truth import TRUTH_SPEC

    limits = (kind, 0.3, 8.0) if kind else ()
    angles = ((-0.1, 0.1), (0.3, 0.3), -0.05) if kind else ((-0.2, 0.0), (0.0, 0.0), -0.4)
    beams = Beams("tiny", *angles, 15, 10.0, ((0.0, 0.0, 0.0),) * 2, *limits)
    state = np.zeros(TRUTH_SPEC.shape, np.uint8)
    state[100:200] = 1

    def made(k: int) -> SimulatedSample:
        objects = np.zeros(2, OBJECT_DTYPE)
        objects["length"] = 4
        return SimulatedSample(
            beams=beams, steps=np.full(beams.shape, 900 + k, np.uint16), intensities=np.full(beams.shape, 9, np.uint8),
            truth=Truth(TRUTH_SPEC, state), objects=objects, T_world_sensor=np.eye(4), T_vehicle_sensor=np.eye(4),
            velocity=np.zeros(3), yaw_rate=0.0, stamp=0.1 * k, split="training", index=k, scenario=0,
        )  # fmt: skip

    root = folder / "store"
    store = Store.create(root, {"seed": 1}, {"training": 3, "validation": 1}, [beams], {"ogm": "0"})
    store.write("training", 0, [made(k) for k in range(3)])
    files = {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}

    def read(folder: Path) -> None:
        opened = Store.open(folder)
        split = opened["training"] if "training" in opened.counts else opened[next(iter(opened.counts))]
        for k in split.finished.tolist()[:2]:
            sample = split[k]
            assert np.isfinite(sample.points).all(), "points not finite"
            assert sample.truth.state.max(initial=0) <= 3, "truth"
        if kind:
            for frame in open_dataset(folder, split=split.name)[:2]:
                check_scan(frame.scan)

    return Target(files, read)


def _frames(folder: Path) -> Target:
    cache = ResultCache(folder / "frames", {"a": 1})
    sums = ConfusionSums(*(np.zeros(3) for _ in ConfusionSums._fields))
    cache.save(0, FrameResult((sums,), np.zeros(4), {"truth": b"\x89PNG"}))
    files = {name: (folder / "frames" / name).read_bytes() for name in ("000000.npz", "run.json")}

    def read(folder: Path) -> None:
        try:
            ResultCache(folder, {"a": 1}).missing([0])
        finally:  # it writes, and deletes frames of other settings
            for name, content in files.items():
                (folder / name).write_bytes(content)

    return Target(files, read)


def _calibration(folder: Path) -> Target:
    Calibration("ray", {"azimuth_step": 0.01}, {"azimuth_step": 0.02}).save(folder / "c.json")
    return Target({"c.json": (folder / "c.json").read_bytes()}, lambda files: Calibration.load(files / "c.json"))


TARGETS: dict[str, Callable[[Path], Target]] = {
    "weights": _weights, "onnx-file": _exported, "onnx-engine": _engine, "cache": _frames,
    "store": partial(_store, ""), "store-depth": partial(_store, "depth"),
    "calibration-of-model": _calibration,
}  # fmt: skip
