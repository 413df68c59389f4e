"""Recording of a simulated dataset: samples with truth, boxes and poses."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured
from numpy.typing import NDArray

from ogm.datasets.frames import EGO, FrameRef, RawFrame
from ogm.datasets.recording import OpenOptions, Recording
from ogm.io.depth import Intrinsics, depth_scan
from ogm.pose import inverse, pose
from ogm.scan import Boxes, Mount, Scan
from ogm.simulation.plan import SEQUENCE, count_towns
from ogm.simulation.radars import RADARS
from ogm.simulation.sample import LABELS, RANGE_STEP, PlacedSweep, SimulatedSample
from ogm.simulation.store import FACTS, SHARD, Store
from ogm.state import CellState, Truth
from ogm.storage.files import OgmError
from ogm.storage.remote import ObjectPath
from ogm.truth.scans import ignore_cells

_SPLITS = ("validation", "sequences", "test", "training")  # by default the first split with samples is used
_SPLIT_ALIASES = {"train": "training", "val": "validation"}
_RAYS = {
    "aimed": "rays from the sensor's position, aimed at every cell,",
    "hd": "the rays of a lidar with thousands of layers at the sensor's position",
}
LIDAR, RADAR = "lidar", "radar"  # names of the lidar and of all radars in the option `sensors`


class _Source(NamedTuple):
    """Source of a frame: the lidar scan of a sample, or a radar sweep."""

    sample: int  # number of the sample among the finished samples
    sweep: int = -1  # number among the sample's sweeps; -1 for the lidar
    radar: int = -1  # number among the dataset's radars; -1 for the lidar


class SimulatedRecording(Recording):
    """Finished samples of a split of a simulated dataset: lidar scans and radar sweeps."""

    format = "simulated dataset"
    labelled = ("boxes",)
    ego_footprint = None
    known_mount = True
    known_truth = True
    own_options = ("split", "sensors")

    def __init__(self, path: Any, store: Store, split: str, numbers: NDArray[np.int64], options: OpenOptions) -> None:
        self._split, self._numbers, self._radars = store[split], numbers, store.radars
        self.stamped = split == "sequences"
        self._observed, self._unknown_ignored = store.plan.get("truth") != "none", options.others == "later"
        self._kerbs = options.kerbs
        facts = self._split.facts[numbers]
        poses = np.tile(np.eye(4), (2, len(facts), 1, 1))
        first = FACTS.index("T_world_sensor_00")
        poses[:, :, :3] = facts[:, first : first + 24].reshape(-1, 2, 3, 4).swapaxes(0, 1)
        self._T_world_lidar, self._T_vehicle_lidar = poses
        self._lidar_place = self._T_vehicle_lidar[:, :2, 3].copy()
        self._T_vehicle_lidar[:, :2, 3] = 0.0  # all grids, also of radars, are centred on the lidar
        kinds = [beams.kind for beams in store.beams]
        self._kinds = [kinds[int(n)] for n in facts[:, FACTS.index("lidar")]]
        self._stamps = facts[:, FACTS.index("stamp")].tolist()
        scenarios = facts[:, FACTS.index("scenario")].astype(int).tolist()
        lidar, radars = LIDAR in (options.sensors or (LIDAR,)), _radars_of(store, options.sensors)
        frames = [row for k in range(len(numbers)) for row in self._frames_of(k, scenarios[k], lidar, radars)]
        if self.stamped and radars:  # frames in the order of time within each sequence; sorting is stable
            order = {ref.sequence: k for k, (ref, _) in reversed([*enumerate(frames)])}
            frames.sort(key=lambda frame: (order[frame[0].sequence], frame[0].stamp))
        super().__init__(path, [ref for ref, _ in frames], f"{path.name or path.absolute().name}, {split}")
        self._sources = [source for _, source in frames]
        self.motion_distorted = store.plan.get("in_motion", 0.0) == 1.0
        self.facts = {
            **{"split": split, "plan": store.plan, "versions": store.versions, "samples": numbers.tolist()},
            "towns": count_towns(store.plan, split, scenarios),
            "radars": {self._radars[k].name: self._radars[k].radar for k in radars},
        }
        if isinstance(path, ObjectPath):
            self.shards = numbers[[source.sample for source in self._sources]] // SHARD
        else:
            self.files = [path / "zarr.json", path / split]
        if self._observed:
            rays = _RAYS.get(str(store.plan.get("truth")), "rays from the sensor's position")
            self.description = (
                f"Simulated: surfaces that {rays} hit; all cells of participants with 50 returns or more; cells "
                "without a hit are unknown."
            )
            if self._kerbs != "occupied":
                self.description += f" Obstacles up to 0.15 m: {self._kerbs}."
            if self._unknown_ignored:
                self.description += " Maps may know such cells from other frames: they are left out."

    @classmethod
    def open(cls, paths: Sequence[Any], options: OpenOptions) -> "SimulatedRecording | None":
        """Return the finished samples of a split, or None if the path is no simulated dataset.

        Raises
        ------
        FileNotFoundError
            If a path lies in an object store, and is no simulated dataset.
        ValueError
            If the split or the sensor does not exist, or the split has no sample.
        """
        path = paths[0]
        if len(paths) > 1 or not is_simulated(path):
            if remote := [place for place in paths if isinstance(place, ObjectPath)]:
                raise FileNotFoundError(f"{remote[0]} is no dataset of `ogm simulate`: copy other data to a folder")
            return None
        store = Store.open(path)
        split = options.default_split if options.split is None else options.split
        wanted = None if split is None else _SPLIT_ALIASES.get(split, split)
        found = {name: store[name].finished for name in store.counts if wanted in (None, name)}
        if (chosen := next((name for name in (*_SPLITS, *found) if len(found.get(name, ()))), None)) is None:
            raise OgmError(_no_sample(store, wanted))
        return cls(path, store, chosen, found[chosen], options)

    def _frames_of(self, k: int, scenario: int, lidar: bool, radars: list[int]) -> Iterator[tuple[FrameRef, _Source]]:
        """Yield the frames of a sample."""
        drive, name, n = self.stamped, self._split.name, int(self._numbers[k])
        # outside of sequences, the samples of a drive are too far apart to be fused
        title = f"sequence {n // SEQUENCE} frame {n % SEQUENCE}" if drive else f"{name} {n}"
        group = f"sequence {n // SEQUENCE}" if drive else f"drive {scenario}"
        if lidar:
            yield FrameRef(title, group, self._stamps[k] if drive else None, self._T_world_lidar[k]), _Source(k)
        for m, row in enumerate(self._split.sweep_rows(n) if radars else ()):
            radar, stamp = int(row[1]), float(row[2])
            if radar in radars:
                sweep = f"{title} {self._radars[radar].name}" + (f" {stamp:.3f} s" if drive else "")
                T = np.vstack([row[4:16].reshape(3, 4), [0, 0, 0, 1]])
                yield FrameRef(sweep, group, stamp if drive else None, T), _Source(k, m, radar)

    @cached_property
    def _sample(self) -> Callable[[int], SimulatedSample]:
        return lru_cache(2)(self._split.__getitem__)

    @cached_property
    def _sweeps(self) -> Callable[[int], tuple[PlacedSweep, ...]]:
        return lru_cache(2)(self._split.sweeps)

    def read(self, n: int) -> RawFrame:
        """Read the lidar scan or radar sweep of a frame."""
        source = self._sources[n]
        number = int(self._numbers[source.sample])
        if source.radar < 0:
            return RawFrame(_scan(self._sample(number)))
        sweep, radar = self._sweeps(number)[source.sweep], self._radars[source.radar]
        spec = RADARS.get(radar.radar)  # None for a radar of a later version
        return RawFrame(sweep.detections.scan(sweep.stamp, radar.name, spec.doppler_interval if spec else None))

    def mount(self, n: int) -> Mount:
        """Return the mount of the sensor; all sensors of a sample share one vehicle frame."""
        source = self._sources[n]
        if source.radar < 0:
            T, (x, y) = self._T_vehicle_lidar[source.sample], self._lidar_place[source.sample]
            box = (EGO[0] - x, EGO[1] - x, EGO[2] - y, EGO[3] - y) if self._kinds[source.sample] else None
            return Mount(T[2, 3], T, box)  # type: ignore[arg-type]
        radar, (x, y) = self._radars[source.radar], self._lidar_place[source.sample]
        return Mount(radar.z, pose(radar.x - x, radar.y - y, radar.z, yaw=radar.yaw), EGO)

    def has_truth(self, n: int) -> bool:
        """Return whether there is truth at the time of a frame."""
        stamp = self.frames[n].stamp
        return self._observed and (stamp is None or abs(stamp - self._stamps[self._sources[n].sample]) < 1e-6)

    def truth(self, n: int) -> Truth:
        """Return the truth around the lidar.

        Raises
        ------
        OgmError
            If the dataset was made without truth, or the frame is a sweep between the lidar's scans.
        """
        if not self._observed:
            raise OgmError(f"{self.path} was made without truth: simulate a dataset with truth in a new folder")
        if not self.has_truth(n):
            name = self.frames[n].name
            raise OgmError(f"{name} lies between lidar scans and has no truth: use the frames of `Dataset.with_truth`")
        truth = self._sample(int(self._numbers[self._sources[n].sample])).truth.with_kerbs(self._kerbs)
        return ignore_cells(truth, truth.state == CellState.UNKNOWN) if self._unknown_ignored else truth

    def read_boxes(self, n: int) -> Boxes:
        """Read the boxes of objects in the sensor's frame, at the time of the lidar scan."""
        source = self._sources[n]
        found = _boxes(self._split.objects(int(self._numbers[source.sample])))
        if source.radar < 0:
            return found
        return found.moved(inverse(np.asarray(self.frames[n].T_map_sensor)) @ self._T_world_lidar[source.sample])


def is_simulated(path: Any) -> bool:
    """Return whether a folder or object store holds a dataset that `ogm simulate` made."""
    return bool((path / "zarr.json").exists())


def _radars_of(store: Store, sensors: Sequence[str]) -> list[int]:
    """Return the numbers of the chosen radars; raise OgmError for an unknown sensor."""
    names = [radar.name for radar in store.radars]
    if unknown := [name for name in sensors if name not in (LIDAR, RADAR, *names)]:
        has = f"{LIDAR}, {RADAR} for all radars, {', '.join(names)}" if names else f"{LIDAR} alone"
        raise OgmError(f"{store.path} has no sensor {unknown[0]!r}; it has {has}")
    if RADAR in sensors and not names:
        raise OgmError(f"{store.path} has no radar; `ogm simulate ... --radar ars548` makes datasets with radars")
    return [k for k, name in enumerate(names) if RADAR in sensors or name in sensors]


def _no_sample(store: Store, name: str | None) -> str:
    """Return the error text for a split without samples."""
    path, resume = store.path, f"resume with `ogm simulate {store.path} --resume`"
    if name is None:
        return f"{path} has no finished sample; {resume}"
    begin = f"; `ogm simulate {path} --resume --sequences 1` makes one (100 scans at 10 Hz)"
    way = begin if name == "sequences" else ""
    if name not in store.counts:
        return f"{path} has no split {name!r}; it has {', '.join(store.counts)}{way}"
    return f"{path} has no sample of {name}{f'; {resume}' if store.counts[name] else way}"


def _scan(sample: SimulatedSample) -> Scan:
    """Return the scan of a sample; beams without range are beams without echo, except for depth cameras."""
    beams, echo = sample.beams, sample.steps > 0
    if beams.kind == "depth":
        return replace(_depth_scan(sample), sensor=sample.lidar)
    layers = len(beams.elevation)
    return Scan(
        sample.points,
        stamp=sample.stamp,
        time=np.tile(beams.times.astype(np.float64), layers).take(np.flatnonzero(echo)),
        ring=np.repeat(np.arange(layers, dtype=np.uint16), np.count_nonzero(echo, axis=1)),
        no_returns=sample.no_returns,
        sensor=sample.lidar,
        kind=beams.kind,
        max_range=beams.range_max or None,
    )


def _depth_scan(sample: SimulatedSample) -> Scan:
    """Return the scan of a depth camera, with image rows from top to bottom."""
    beams = sample.beams
    rows, columns = beams.shape
    depth = sample.steps * np.float32(RANGE_STEP) * beams.directions[..., 0]
    across, up = np.tan(beams.azimuth[0]) / abs(beams.step), np.tan(beams.elevation)
    focal = (rows - 1) / (up[-1] - up[0]) if rows > 1 else 1 / abs(beams.step)
    camera = Intrinsics(columns, rows, 1 / abs(beams.step), focal, across, up[-1] * focal)
    limits = {"min_range": beams.range_min, "max_range": beams.range_max}
    return depth_scan(depth[::-1], camera.check(beams.name), 1.0, stride=1, stamp=sample.stamp, **limits)


def _boxes(objects: NDArray[Any]) -> Boxes:
    def columns(*names: str) -> NDArray[np.float64]:
        return structured_to_unstructured(objects[list(names)], np.float64)

    center, size, yaw = columns("x", "y", "z"), columns("length", "width", "height"), columns("yaw")
    labels, tracks = [LABELS[label] for label in objects["label"]], [str(track) for track in objects["track"]]
    return Boxes(center, size, yaw, columns("vx", "vy"), labels, tracks)
