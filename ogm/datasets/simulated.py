"""The simulator's store: samples with truth, boxes and poses."""

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.layout import FrameRef, Layout, RawFrame
from ogm.files import OgmError
from ogm.scan import Boxes, Mount, Scan
from ogm.simulation.plan import SEQUENCE
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
    found = {name: store[name].finished for name in store.counts if split is None or _is(name, split)}
    name = next((one for one in (*_SPLITS, *found) if len(found.get(one, ()))), None)
    if name is None:
        raise OgmError(_no_sample(store, path, split))
    part, numbers = store[name], found[name]
    facts = part.facts[numbers]
    poses, mounts = (_poses(facts, f"T_{one}_00") for one in ("world_sensor", "vehicle_sensor"))
    mounts[:, :2, 3] = 0.0  # the grids lie around the sensor
    drive = name == "sequences"
    stamps = facts[:, FACTS.index("stamp")].tolist()
    frames = tuple(
        FrameRef(f"sequence {n // SEQUENCE} frame {n % SEQUENCE}", f"sequence {n // SEQUENCE}", stamp, T)
        if drive
        else FrameRef(f"{name} {n}", "", None, T)
        for n, stamp, T in zip(numbers.tolist(), stamps, poses, strict=True)
    )

    @lru_cache(2)
    def sample(k: int) -> SimulatedSample:
        return part[int(numbers[k])]

    def truth(k: int) -> Truth:
        one = sample(k).truth
        if others == "all":
            return one
        return ignore_cells(one, one.state == CellState.UNKNOWN)

    rays = _RAYS.get(str(store.plan.get("truth")), "rays from the sensor's place")
    description = f"Simulated: what {rays} hit; participants with 50 returns or more as a whole; without a hit unknown."
    if others == "later":
        description += " Maps may know such cells from other frames: they are left out."
    return Layout(
        "simulated data set",
        frames,
        lambda k: RawFrame(_scan(sample(k))),
        boxes=lambda k: _boxes(sample(k)),
        ego_footprint=None,
        mount=lambda k: Mount(mounts[k, 2, 3], mounts[k]),
        truth=truth,
        description=description,
        stamped=drive,
        motion_distorted=store.plan.get("in_motion", 0.0) == 1.0,
        name=f"{path.name or path.resolve().name}, {name}",
        facts={"split": name, "plan": store.plan, "versions": store.versions, "samples": numbers.tolist()},
        files=(path / "zarr.json", path / name),
    )


def _is(name: str, split: str) -> bool:
    return name == _SHORT.get(split, split)


def _no_sample(store: Store, path: Path, split: str | None) -> str:
    if split is None:
        return f"{path} has no finished sample; go on with `ogm simulate {path} --resume`"
    name = _SHORT.get(split, split)
    begin = f"; `ogm simulate {path} --resume --sequences 1` makes one (100 scans at 10 Hz)"
    way = begin if name == "sequences" else ""
    if name not in store.counts:
        return f"{path} has no split {split!r}; it has {', '.join(store.counts)}{way}"
    way = f"; go on with `ogm simulate {path} --resume`" if store.counts[name] else way
    return f"{path} has no sample of {name}{way}"


def _poses(facts: NDArray[np.float64], first: str) -> NDArray[np.float64]:
    """Return the poses whose numbers begin at a column of `FACTS`, (K, 4, 4)."""
    poses = np.tile(np.eye(4), (len(facts), 1, 1))
    poses[:, :3] = facts[:, FACTS.index(first) :][:, :12].reshape(-1, 3, 4)
    return poses


def _scan(sample: SimulatedSample) -> Scan:
    """Return a sample's scan; beams of its range image without range are those without echo."""
    return Scan(
        sample.points,
        stamp=sample.stamp,
        time=sample.time.astype(np.float64),
        ring=sample.ring,
        no_returns=sample.beams.directions[sample.steps == 0],
        sensor=sample.lidar,
    )


def _boxes(sample: SimulatedSample) -> Boxes:
    columns = {name: sample.objects[name].astype(np.float64) for name in sample.objects.dtype.names or ()}
    center, size, velocity = (
        np.column_stack([columns[name] for name in names])
        for names in (("x", "y", "z"), ("length", "width", "height"), ("vx", "vy"))
    )
    labels, tracks = [LABELS[one] for one in sample.objects["label"]], map(str, sample.objects["track"])
    return Boxes(center, size, columns["yaw"], velocity, labels, tuple(tracks))
