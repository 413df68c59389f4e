"""The simulator's store: samples with truth, boxes and poses."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray

from ogm.datasets.layout import FrameRef, Layout, RawFrame
from ogm.files import OgmError
from ogm.scan import Boxes, Mount, Scan
from ogm.simulation.plan import SEQUENCE, count_towns
from ogm.simulation.sample import LABELS, SimulatedSample
from ogm.simulation.store import FACTS, Store
from ogm.state import CellState, Truth
from ogm.truth import ignore_cells

__all__ = ["simulated"]

_SPLITS = ("validation", "sequences", "test", "training")  # the first that has samples is taken
_SHORT = {"train": "training", "val": "validation"}
_RAYS = {
    "aimed": "rays from the sensor's place, aimed at every cell,",
    "hd": "the rays of a lidar with thousands of layers at the sensor's place",
}


def simulated(path: Path, split: str | None = None, others: str = "all") -> Layout:
    """Return the finished samples of a split.

    Parameters
    ----------
    path : Path
        Of the data set, see `Store.open`.
    split : str, optional
        "training" or "train", "validation" or "val", "test", "sequences"; by default the first of validation,
        sequences, test and training that has samples.
    others : {"all", "later"}
        "later" for maps: what nothing hit in a frame is ignored instead of unknown, as other frames may know it.

    Raises
    ------
    ValueError
        If there is no such split, or no sample in it.
    """
    store = Store.open(path)
    wanted = None if split is None else _SHORT.get(split, split)
    found = {one: store[one].finished for one in store.counts if wanted in (None, one)}
    name = next((one for one in (*_SPLITS, *found) if len(found.get(one, ()))), None)
    if name is None:
        raise OgmError(_no_sample(store, wanted))
    part, numbers = store[name], found[name]
    facts = part.facts[numbers]
    poses = np.tile(np.eye(4), (2, len(facts), 1, 1))
    first = FACTS.index("T_world_sensor_00")
    poses[:, :, :3] = facts[:, first : first + 24].reshape(-1, 2, 3, 4).swapaxes(0, 1)
    T_world_sensor, T_vehicle_sensor = poses
    T_vehicle_sensor[:, :2, 3] = 0.0  # the grids lie around the sensor
    drive = name == "sequences"
    scenarios = facts[:, FACTS.index("scenario")].astype(int)  # samples of one drive, too far apart to be fused
    each = zip(numbers, scenarios, T_world_sensor, strict=True)
    frames = [FrameRef(f"{name} {n}", f"drive {number}", None, T) for n, number, T in each]
    if drive:
        stamps = facts[:, FACTS.index("stamp")].tolist()
        drives = [f"sequence {n // SEQUENCE}" for n in numbers]
        names = [f"{one} frame {n % SEQUENCE}" for one, n in zip(drives, numbers, strict=True)]
        frames = list(map(FrameRef, names, drives, stamps, T_world_sensor))

    @lru_cache(2)
    def sample(k: int) -> SimulatedSample:
        return part[int(numbers[k])]

    def truth(k: int) -> Truth:
        one = sample(k).truth
        if others == "all":
            return one
        return ignore_cells(one, one.state == CellState.UNKNOWN)

    towns = count_towns(store.plan, name, scenarios.tolist())
    rays = _RAYS.get(str(store.plan.get("truth")), "rays from the sensor's place")
    description = f"Simulated: what {rays} hit; participants with 50 returns or more as a whole; without a hit unknown."
    if others == "later":
        description += " Maps may know such cells from other frames: they are left out."
    return Layout(
        "simulated data set",
        tuple(frames),
        lambda k: RawFrame(_scan(sample(k))),
        boxes=lambda k: _boxes(part.objects(int(numbers[k]))),
        ego_footprint=None,
        mount=lambda k: Mount(T_vehicle_sensor[k, 2, 3], T_vehicle_sensor[k]),
        truth=truth,
        description=description,
        stamped=drive,
        motion_distorted=store.plan.get("in_motion", 0.0) == 1.0,
        name=f"{path.name or path.resolve().name}, {name}",
        facts={"split": name, "plan": store.plan, "versions": store.versions, "samples": numbers.tolist()}
        | {"towns": towns},
        files=(path / "zarr.json", path / name),
    )


def _no_sample(store: Store, name: str | None) -> str:
    """Return why there is no sample of a split, and the way out."""
    path, resume = store.path, f"go on with `ogm simulate {store.path} --resume`"
    if name is None:
        return f"{path} has no finished sample; {resume}"
    begin = f"; `ogm simulate {path} --resume --sequences 1` makes one (100 scans at 10 Hz)"
    way = begin if name == "sequences" else ""
    if name not in store.counts:
        return f"{path} has no split {name!r}; it has {', '.join(store.counts)}{way}"
    return f"{path} has no sample of {name}{f'; {resume}' if store.counts[name] else way}"


def _scan(sample: SimulatedSample) -> Scan:
    """Return a sample's scan; beams of its range image without range are those without echo."""
    beams, echo = sample.beams, sample.steps > 0
    layers = len(beams.elevation)
    return Scan(
        sample.points,
        stamp=sample.stamp,
        time=np.tile(beams.times.astype(np.float64), layers).take(np.flatnonzero(echo)),
        ring=np.repeat(np.arange(layers, dtype=np.uint16), np.count_nonzero(echo, axis=1)),
        no_returns=sample.no_returns,
        sensor=sample.lidar,
    )


def _boxes(objects: NDArray[Any]) -> Boxes:
    def columns(*names: str) -> NDArray[np.float64]:
        return structured_to_unstructured(objects[list(names)], np.float64)

    center, size, yaw = columns("x", "y", "z"), columns("length", "width", "height"), columns("yaw")
    labels, tracks = [LABELS[one] for one in objects["label"]], [str(one) for one in objects["track"]]
    return Boxes(center, size, yaw, columns("vx", "vy"), labels, tracks)
