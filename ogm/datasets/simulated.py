"""The simulator's store: samples with truth, boxes and poses."""

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray

from ogm.datasets.layout import EGO, FrameRef, Layout, RawFrame
from ogm.pose import inverse, pose
from ogm.scan import Boxes, Mount, Scan
from ogm.simulation.plan import SEQUENCE, count_towns
from ogm.simulation.radars import RADARS
from ogm.simulation.sample import LABELS, SimulatedSample
from ogm.simulation.store import FACTS, SHARD, Store
from ogm.state import CellState, Truth
from ogm.storage.files import OgmError
from ogm.storage.remote import ObjectPath
from ogm.truth import ignore_cells

__all__ = ["simulated"]

_SPLITS = ("validation", "sequences", "test", "training")  # the first that has samples is taken
_SHORT = {"train": "training", "val": "validation"}
_RAYS = {
    "aimed": "rays from the sensor's place, aimed at every cell,",
    "hd": "the rays of a lidar with thousands of layers at the sensor's place",
}
LIDAR, RADAR = "lidar", "radar"  # words for all lidars, all radars


class _Place(NamedTuple):
    """Which scan a frame is: that of a sample's lidar, or a sweep of it."""

    sample: int  # number in the split
    sweep: int = -1  # of the sample's sweeps; -1 for the lidar
    radar: int = -1  # of the data set's radars


def simulated(
    path: Path | ObjectPath, split: str | None = None, others: str = "all", sensors: Sequence[str] = ()
) -> Layout:
    """Return the finished samples of a split.

    Parameters
    ----------
    path : Path or ObjectPath
        Of the data set, see `Store.open`.
    split : str, optional
        "training" or "train", "validation" or "val", "test", "sequences"; by default the first of validation,
        sequences, test and training that has samples.
    others : {"all", "later"}
        "later" for maps: what nothing hit in a frame is ignored instead of unknown, as other frames may know it.
    sensors : sequence of str
        "lidar", "radar", or names of radars: whose scans become frames, those of a drive in the order of time. By
        default the lidar's.

    Raises
    ------
    ValueError
        If there is no such split or sensor, or no sample in it.
    """
    store = Store.open(path)
    wanted = None if split is None else _SHORT.get(split, split)
    found = {one: store[one].finished for one in store.counts if wanted in (None, one)}
    name = next((one for one in (*_SPLITS, *found) if len(found.get(one, ()))), None)
    if name is None:
        raise OgmError(_no_sample(store, wanted))
    made = _Frames(store, name, found[name], sensors, others == "later")
    rays = _RAYS.get(str(store.plan.get("truth")), "rays from the sensor's place")
    description = f"Simulated: what {rays} hit; participants with 50 returns or more as a whole; without a hit unknown."
    if not made.observed:
        description = ""
    elif others == "later":
        description += " Maps may know such cells from other frames: they are left out."
    remote = isinstance(path, ObjectPath)
    return Layout(
        "simulated data set",
        tuple(made.refs),
        made.read,
        boxes=made.boxes,
        ego_footprint=None,
        mount=made.mount,
        truth=made.truth,
        has_truth=made.has_truth,
        description=description,
        stamped=made.drive,
        motion_distorted=store.plan.get("in_motion", 0.0) == 1.0,
        name=f"{path.name or path.absolute().name}, {name}",
        facts={"split": name, "plan": store.plan, "versions": store.versions} | made.facts,
        files=() if remote else (path / "zarr.json", path / name),  # type: ignore[arg-type]
        shards=made.shards if remote else None,
        itself=True,
    )


class _Frames:
    """The frames of a split: scans of its samples' lidars, and sweeps of radars. They go to other processes as such."""

    def __init__(
        self, store: Store, name: str, numbers: NDArray[np.int64], sensors: Sequence[str], unknown_ignored: bool
    ) -> None:
        self.unknown_ignored = unknown_ignored
        self.part, self.numbers, self.radars, self.drive = store[name], numbers, store.radars, name == "sequences"
        self.observed = store.plan.get("truth") != "none"
        facts = self.part.facts[numbers]
        poses = np.tile(np.eye(4), (2, len(facts), 1, 1))
        first = FACTS.index("T_world_sensor_00")
        poses[:, :, :3] = facts[:, first : first + 24].reshape(-1, 2, 3, 4).swapaxes(0, 1)
        self.T_world_lidar, self.T_vehicle_lidar = poses
        self.lidar_place = self.T_vehicle_lidar[:, :2, 3].copy()
        self.T_vehicle_lidar[:, :2, 3] = 0.0  # the grids lie around the lidar, those of radars too
        self.stamps = facts[:, FACTS.index("stamp")].tolist()
        scenarios = facts[:, FACTS.index("scenario")].astype(int).tolist()
        chosen = _radars_of(store, sensors)
        frames: list[tuple[FrameRef, _Place]] = []
        for k, (n, scenario) in enumerate(zip(numbers.tolist(), scenarios, strict=True)):
            # samples of a drive that are no sequence are too far apart to be fused
            title = f"sequence {n // SEQUENCE} frame {n % SEQUENCE}" if self.drive else f"{name} {n}"
            group = f"sequence {n // SEQUENCE}" if self.drive else f"drive {scenario}"
            if LIDAR in (sensors or (LIDAR,)):
                stamp = self.stamps[k] if self.drive else None
                frames.append((FrameRef(title, group, stamp, self.T_world_lidar[k]), _Place(k)))
            for m, row in enumerate(self.part.sweep_rows(n) if chosen else ()):
                radar, stamp = int(row[1]), float(row[2])
                if radar in chosen:
                    one = f"{title} {self.radars[radar].name}" + (f" {stamp:.3f} s" if self.drive else "")
                    T = np.vstack([row[4:16].reshape(3, 4), [0, 0, 0, 1]])
                    frames.append((FrameRef(one, group, stamp if self.drive else None, T), _Place(k, m, radar)))
        if self.drive and chosen:  # sequences are one after the other, and sorting is stable
            order = {ref.sequence: k for k, (ref, _) in reversed([*enumerate(frames)])}
            frames.sort(key=lambda pair: (order[pair[0].sequence], pair[0].stamp))
        self.refs, self.places = [ref for ref, _ in frames], [place for _, place in frames]
        self.facts = {
            "samples": numbers.tolist(),
            "towns": count_towns(store.plan, name, scenarios),
            "radars": {self.radars[k].name: self.radars[k].radar for k in chosen},
        }
        self._keep_last()

    def _keep_last(self) -> None:
        self._sample = lru_cache(2)(lambda k: self.part[int(self.numbers[k])])
        self._sweeps = lru_cache(2)(lambda k: self.part.sweeps(int(self.numbers[k])))

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in ("_sample", "_sweeps")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._keep_last()

    @property
    def shards(self) -> NDArray[np.int64]:
        """The shard that each frame lies in."""
        return self.numbers[[place.sample for place in self.places]] // SHARD

    def read(self, k: int) -> RawFrame:
        """Return a scan."""
        at = self.places[k]
        if at.radar < 0:
            return RawFrame(_scan(self._sample(at.sample)))
        one = self._sweeps(at.sample)[at.sweep]
        radar = self.radars[at.radar]
        spec = RADARS.get(radar.radar)  # None for one of a later version
        return RawFrame(one.detections.scan(one.stamp, radar.name, spec.doppler_interval if spec else None))

    def mount(self, k: int) -> Mount:
        """Return how the sensor of a frame is mounted; all sensors of a sample have one vehicle frame."""
        at = self.places[k]
        if at.radar < 0:
            T = self.T_vehicle_lidar[at.sample]
            return Mount(T[2, 3], T)
        radar, (x, y) = self.radars[at.radar], self.lidar_place[at.sample]
        return Mount(radar.z, pose(radar.x - x, radar.y - y, radar.z, yaw=radar.yaw), EGO)

    def has_truth(self, k: int) -> bool:
        """Return whether there is truth at the time of a scan."""
        stamp = self.refs[k].stamp
        return self.observed and (stamp is None or abs(stamp - self.stamps[self.places[k].sample]) < 1e-6)

    def truth(self, k: int) -> Truth:
        """Return the truth around the lidar, or raise OgmError where there is none."""
        if not self.observed:
            raise OgmError("the data set was made without truth (--truth none): make one with it in a new folder")
        if not self.has_truth(k):
            raise OgmError(f"{self.refs[k].name} lies between the lidar's turns, whose truth is known: there is none")
        one = self._sample(self.places[k].sample).truth
        return ignore_cells(one, one.state == CellState.UNKNOWN) if self.unknown_ignored else one

    def boxes(self, k: int) -> Boxes:
        """Return the objects in the frame of the sensor, at the time of the lidar's scan."""
        at = self.places[k]
        found = _boxes(self.part.objects(int(self.numbers[at.sample])))
        if at.radar < 0:
            return found
        return found.moved(inverse(np.asarray(self.refs[k].T_map_sensor)) @ self.T_world_lidar[at.sample])


def _radars_of(store: Store, sensors: Sequence[str]) -> list[int]:
    """Return the numbers of the radars that are wanted, or raise OgmError where there is no such sensor."""
    names = [one.name for one in store.radars]
    if unknown := [one for one in sensors if one not in (LIDAR, RADAR, *names)]:
        has = f"{LIDAR}, {RADAR} for all radars, {', '.join(names)}" if names else f"{LIDAR} alone"
        raise OgmError(f"{store.path} has no sensor {unknown[0]!r}; it has {has}")
    if RADAR in sensors and not names:
        raise OgmError(f"{store.path} has no radar; `ogm simulate ... --radar ars548` makes data sets with radars")
    return [k for k, one in enumerate(names) if RADAR in sensors or one in sensors]


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
