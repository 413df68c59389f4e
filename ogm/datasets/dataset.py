"""Data sets as sequences of frames."""

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.argoverse2 import argoverse2
from ogm.datasets.captures import captures
from ogm.datasets.kitti import kitti_object, kitti_odometry, kitti_raw, kitti_tracking
from ogm.datasets.layout import FrameRef, Layout
from ogm.datasets.logs import is_log, logs
from ogm.datasets.motion import MotionReader
from ogm.datasets.nuscenes import mmdet3d, nuscenes
from ogm.datasets.paths import SCAN_ENDINGS
from ogm.datasets.radarscenes import radarscenes
from ogm.datasets.range_images import range_images
from ogm.datasets.reader import FrameReader
from ogm.datasets.scans import scans
from ogm.datasets.simulated import simulated
from ogm.datasets.sustech import sustech
from ogm.datasets.truth import RecordedTruth
from ogm.datasets.truth_grids import grid_files, truth_grids
from ogm.grid import GridSpec
from ogm.io import Axes
from ogm.io.axes import rotation_to_flu
from ogm.io.logs import LOG_ENDINGS
from ogm.pose import Trajectory
from ogm.scan import Frame, LazyFrame
from ogm.state import LazyTruth, Truth
from ogm.storage.files import OgmError
from ogm.storage.remote import ObjectPath, as_path, is_remote

__all__ = ["Dataset", "open_dataset"]

# The first that knows a path reads it: the more a layout asks for, the earlier it is tried.
_LAYOUTS = (
    *(nuscenes, mmdet3d, argoverse2, sustech, radarscenes),
    *(kitti_object, kitti_tracking, kitti_odometry, kitti_raw, range_images),
)
_OTHERS = ("all", "later")
_KNOWN = (
    "KITTI object (velodyne/ label_2/ calib/), tracking (velodyne/0000/ label_02/ calib/), raw drives "
    "(velodyne_points/data/ or scans, label_02*.txt, calib*.txt) and odometry (velodyne/ poses.txt calib.txt); "
    "SemanticKITTI (velodyne/ labels/, or sequences/*/); nuScenes (v1.0-*/ samples/) and mmdetection3d's info as JSON; "
    "Argoverse 2 logs (sensors/lidar/ annotations.feather map/); SUSTechPOINTS (lidar/ label/); RadarScenes "
    "(scenes.json radar_data.h5, or sequence_*/); labelled range images (*.npy in semantic_kitti/ or nuscenes/); logs "
    "(.mcap, .db3, .bag); captures of Velodynes (.pcap); data sets that `ogm simulate` made (zarr.json)"
)


class Dataset(Sequence[Frame]):
    """Frames of a recording or of simulated drives; `open_dataset` makes one.

    A frame reads its scan, and makes its truth, when it is first asked for them; the last ones are kept. Slices and
    `select` give data sets of some frames. Pickled, a data set goes to another process as its path.

    Attributes
    ----------
    name : str
    format : str
        What it is, in words.
    description : str
        What the truth is made of, in one sentence; it states "this scan" where the frame's own scan is used. ""
        where there is no truth: asking a frame for it then raises an error with the way out.
    facts : dict
        What else there is to know, as JSON can hold it.
    files : tuple of Path
        Files and folders that it reads from.
    motion_distorted : bool
        Whether points may be shifted by the ego motion during a scan, so that de-skewing makes sense.
    trajectory : Trajectory or None
        Poses between the frames, where they are known better than by the frames' own: of `with_poses`,
        `with_odometry`.
    """

    layout: Layout
    trajectory: Trajectory | None
    reader: FrameReader
    description: str
    name: str
    format: str
    motion_distorted: bool
    files: tuple[Path, ...] | tuple[Path]
    facts: dict[str, Any]

    def __init__(
        self,
        layout: Layout,
        options: Mapping[str, Any],
        numbers: Sequence[int] | None = None,
        trajectory: Trajectory | None = None,
    ) -> None:
        path = as_path(options["path"][0])
        self.layout, self._options, self.trajectory = layout, options, trajectory
        self.reader = FrameReader(layout, path, options["sensor_height"], options["sensor_position"])
        self._motion = MotionReader(self.reader)
        self._truth: Callable[[int], Truth]
        if layout.truth is not None:
            self._truth, self.description = layout.truth, layout.description
        else:
            self._truth = made = RecordedTruth(self.reader, options["truth"], options["others"])
            self.description = made.description
        self._numbers = tuple(range(len(layout.frames)) if numbers is None else numbers)
        self.name = layout.name or path.name or path.resolve().name or str(path)
        self.format, self.motion_distorted = layout.format, layout.motion_distorted
        self.files, self.facts = layout.files or (path,), dict(layout.facts)

    def __len__(self) -> int:
        return len(self._numbers)

    @overload
    def __getitem__(self, n: int) -> Frame: ...
    @overload
    def __getitem__(self, n: slice) -> "Dataset": ...
    def __getitem__(self, n: int | slice) -> "Frame | Dataset":
        """Return a frame, of which nothing is read yet, or a data set of several."""
        if isinstance(n, slice):
            return self.select(range(*n.indices(len(self))))
        k = self._numbers[n]
        ref, reader = self.layout.frames[k], self.reader
        scan, mount, boxes = partial(reader.scan, k), partial(reader.mount, k), partial(self._motion.boxes, k)
        return LazyFrame(scan, mount, boxes, partial(self._moving_truth, k), **ref._asdict())

    def _moving_truth(self, k: int) -> Truth:
        """Return the truth of a frame, whose motion is found when it is first asked for."""
        truth = self._truth(k)
        return LazyTruth(truth.spec, truth.state, truth.height_cm, partial(self._motion.cells, k, truth.spec))

    def __repr__(self) -> str:
        return f"Dataset({self.name!r}: {len(self)} frames, {self.format})"

    def _repr_html_(self) -> str:
        from ogm.plot.notebook import facts_html

        return facts_html(f"Dataset {self.name}", self.describe())

    def __reduce__(self) -> tuple[Any, ...]:
        options = dict(self._options) | {"path": [as_path(one).absolute() for one in self._options["path"]]}
        if self.layout.itself:
            return Dataset, (self.layout, options, self._numbers, self.trajectory)
        return _reopened, (options, self.layout.frames, self.facts, self._numbers, self.trajectory)

    def select(self, numbers: Iterable[int]) -> "Dataset":
        """Return the data set of some frames, by their numbers in this one; they share what was read."""
        chosen = object.__new__(type(self))  # copy.copy would open it again, as unpickling does
        chosen.__dict__.update(self.__dict__)
        chosen._numbers = tuple(self._numbers[int(n)] for n in numbers)
        return chosen

    def describe(self) -> dict[str, str]:
        """Return what the data set holds, as names and values to print; no scan is read."""
        stamps = [ref.stamp for ref in self.refs if ref.stamp is not None]
        posed = sum(ref.T_map_sensor is not None for ref in self.refs)
        sequences = [name for name in self.sequences if name]
        found = {"format": self.format, "frames": str(len(self))}
        if sequences:
            found["sequences"] = f"{len(sequences)} ({', '.join(sequences[:3])}{', ...' if sequences[3:] else ''})"
        found["poses"] = f"{posed} of {len(self)} frames" if posed else "none (see `ogm fuse --odometry`)"
        if stamps:
            found["stamps"] = f"{min(stamps):.3f} ... {max(stamps):.3f} s"
        return found | {"truth": self.description or "none"}

    @property
    def refs(self) -> tuple[FrameRef, ...]:
        """Name, sequence, stamp and pose of every frame; no frame is made for it."""
        return tuple(self.layout.frames[k] for k in self._numbers)

    @property
    def with_truth(self) -> list[int]:
        """Numbers of the frames that may have a truth: all but radar sweeps between a simulated lidar's turns."""
        known = self.layout.has_truth
        return [n for n, k in enumerate(self._numbers) if known is None or known(k)]

    @property
    def shards(self) -> NDArray[np.int64] | None:
        """Which frames lie together, where reading all that do costs little more than one: in object stores."""
        return None if self.layout.shards is None else self.layout.shards[list(self._numbers)]

    @property
    def sequences(self) -> dict[str, list[int]]:
        """Numbers of the frames of each sequence, in order; frames that stand alone are left out."""
        result: dict[str, list[int]] = {}
        for n, ref in enumerate(self.refs):
            if ref.sequence:
                result.setdefault(ref.sequence, []).append(n)
        return result

    def placed(
        self, stamps: NDArray[np.float64], poses: NDArray[np.float64], facts: Mapping[str, Any], trajectory: Trajectory
    ) -> "Dataset":
        """Return the data set with other stamps and poses, as one sequence; NaN where a frame has none.

        Parameters
        ----------
        stamps : (K,) float
            [s].
        poses : (K, 4, 4) float
            ``T_map_sensor``.
        facts : dict
            What is added to the facts.
        trajectory : Trajectory
        """
        frames = [one._replace(T_map_sensor=None) for one in self.layout.frames]
        names = {ref.sequence for ref in self.refs}
        sequence = (names.pop() if len(names) == 1 else "") or self.name
        known = np.isfinite(stamps) & np.isfinite(poses).all(axis=(1, 2))
        for n, k in enumerate(self._numbers):
            place = (float(stamps[n]), poses[n]) if known[n] else (None, None)
            frames[k] = FrameRef(frames[k].name, sequence, *place)
        layout = replace(self.layout, frames=tuple(frames), facts={**self.facts, **facts})
        return Dataset(layout, self._options, self._numbers, trajectory)


def open_dataset(
    path: str | Path | ObjectPath | Sequence[str | Path],
    *,
    storage: Mapping[str, str] | None = None,
    axes: Axes = "flu",
    intensity_max: float | None = None,
    time_unit: float | None = None,
    sensor_height: float | None = None,
    sensor_position: tuple[float, float, float] | None = None,
    split: str | None = None,
    truth: str | Iterable[str] = (),
    others: str = "all",
    spec: GridSpec | None = None,
    topic: str | Iterable[str] = (),
    frame: str | None = None,
    sensors: str | Iterable[str] = (),
) -> Dataset:
    """Open a data set as a sequence of frames. No scan is read.

    Parameters
    ----------
    path : path or sequence of paths
        A scan, several scans, a folder of scans (with or without poses), or a data set: KITTI object, tracking, raw
        and odometry recordings, SemanticKITTI, nuScenes, mmdetection3d's info (as JSON), an Argoverse 2 log,
        SUSTechPOINTS, a sequence of RadarScenes or several, labelled range images, what ``ogm simulate`` made, or a
        folder of truth grids. What lies in it decides. A log of ROS 1 or ROS 2 (.bag, .db3, .mcap, or a folder of its
        parts) is one drive: the scans of `topic`, in the order of their headers' stamps, with poses by the transforms
        or the odometry in it. A capture of a Velodyne (.pcap) is one drive without poses. What ``ogm simulate`` made
        may also lie in an object store, ``s3://bucket/prefix``.
    storage : mapping of str to str, optional
        Of a data set in an object store: where that is and who may read, see `ogm.storage.remote.as_path`.
    axes, intensity_max, time_unit
        Of files of scans, as for `ogm.io.read_scan`; those of data sets are known.
    sensor_height : float, optional
        Of the sensor above ground [m]; by default known from the data set, or estimated: the median of up to five
        scans of the sequence. Estimates outside of 0.5 to 5 m are refused.
    sensor_position : (x, y, z), optional
        Of the sensor in the frame of the points [m], where that is the vehicle's.
    split : str, optional
        Of a simulated data set: training (train), validation (val), test or sequences. By default validation, or the
        first of sequences, test and training that has samples.
    truth : iterable of str
        Of a recording: what to make the truth of; by default all that there is.

        * ``"boxes"``: cells of boxes with 50 returns or more are occupied; those with fewer are never free;
        * ``"classes"``: cells in which the scan hit ground are free, those with obstacles are occupied;
        * ``"map"``: drivable area that is in sight is free;
        * ``"aggregated"``: what neighbouring scans agree on, brought to the frame by the poses, without what moves.

        Where they contradict each other, a cell is ignored, but boxes win. What has no label is ignored too: nothing
        is unknown in the truth of a recording.
    others : {"all", "later"}
        Which neighbouring scans aggregated truth takes: all that are near in space and time, or only those after the
        frame. "later" is for maps that are fused over time, which must not be evaluated on the scans that they are
        made of; the last frames then know little. For such maps, what nothing hit is ignored in the truth of a
        simulated data set: another frame may have seen it.
    spec : GridSpec, optional
        Of a folder of truth grids: the cells of states and pictures, which do not state it.
    topic : str or iterable of str
        Of a log: the lidars whose scans are taken; by default the only one. Scans of several, with frames in
        the order of their stamps, need transforms from base_link to each.
    frame : str, optional
        Of a log: the fixed frame of the poses; by default map, odom, world, or the root of the transforms.
    sensors : str or iterable of str
        Of a simulated data set: "lidar", "radar", or names of radars, whose scans become frames, those of a drive in
        the order of time; by default the lidar's. Frames of radars have truth where they are of a lidar's moment.

    Raises
    ------
    FileNotFoundError
        If there is nothing at the path.
    ValueError
        If it is no known data set, lacks what `truth` or `split` ask for, a part of it is damaged or missing, or an
        option does not belong to it.
    """
    given: list[Any] = [path] if isinstance(path, str | Path | ObjectPath) else list(path)
    if not given:
        raise ValueError("there is no path to open: give files of scans, or a folder")
    if storage or any(is_remote(one) for one in given):
        given = [as_path(one, storage) for one in given]
    options = {
        "path": given,
        "reading": {"axes": axes, "intensity_max": intensity_max, "time_unit": time_unit},
        **{"sensor_height": sensor_height, "sensor_position": sensor_position, "split": split},
        **{"truth": (truth,) if isinstance(truth, str) else tuple(truth), "others": others, "spec": spec},
        **{"topic": (topic,) if isinstance(topic, str) else tuple(topic), "frame": frame},
        "sensors": (sensors,) if isinstance(sensors, str) else tuple(sensors),
    }
    return Dataset(_opened(options), options)


def _opened(options: Mapping[str, Any]) -> Layout:
    """Return the layout of a data set by the options of `open_dataset`."""
    if options["others"] not in _OTHERS:
        raise ValueError(f"others must be one of {', '.join(_OTHERS)}, got {options['others']!r}")
    paths, reading = [as_path(one) for one in options["path"]], options["reading"]
    path, layout = paths[0], _layout(paths, options)
    if layout is None:
        grids = "it holds grids: give spec, their cells, to open them"
        raise OgmError(
            f"{path} is no data set that is known and holds no scans ({' '.join(SCAN_ENDINGS)}, .xz, .gz); "
            + (grids if grid_files(path) else f"known are: {_KNOWN}")
        )
    turned = not np.array_equal(rotation_to_flu(reading["axes"]), np.eye(3))
    if layout.known_axes and (turned or reading["intensity_max"] or reading["time_unit"]):
        raise ValueError(
            f"{path} ({layout.format}) has known axes and units; leave out axes, intensity_max and time_unit "
            "(--axes, --intensity-max, --time-unit), or give its scans as files"
        )
    if layout.truth is not None and options["truth"]:
        raise ValueError(
            f"truth (--truth) is for recordings; {path} ({layout.format}) holds its truth itself: leave it out"
        )
    facts = layout.facts or {"format": layout.format, "frames": len(layout.frames)}
    return replace(layout, frames=_named_apart(layout.frames), facts=facts)


def _layout(paths: Sequence[Path], options: Mapping[str, Any]) -> Layout | None:
    """Return what the first layout that knows the paths makes of them."""
    path, spec = paths[0], options["spec"]
    if remote := [one for one in paths if isinstance(one, ObjectPath)]:
        if len(paths) > 1 or not (path / "zarr.json").exists():
            raise FileNotFoundError(
                f"{remote[0]} is no data set that `ogm simulate` made; others are no object stores'"
            )
        return simulated(path, options["split"], options["others"], options["sensors"])
    if len(paths) == 1 and not path.exists():
        raise FileNotFoundError(f"there is no {path}: check the name and the folder")
    if len(paths) == 1 and (path / "zarr.json").exists():
        return simulated(path, options["split"], options["others"], options["sensors"])
    if options["sensors"]:
        raise ValueError(f"sensors (--sensor) is for data sets that `ogm simulate` made, which {path} is not")
    if is_log(paths):
        return logs(paths, options["topic"], options["frame"], options["sensor_position"], **options["reading"])
    if options["topic"] or options["frame"] is not None:
        raise ValueError(f"topic and frame (--topic, --frame) are for logs ({', '.join(LOG_ENDINGS)}), got {path}")
    if options["split"] is not None:
        raise ValueError(f"split (--split) is for data sets that `ogm simulate` made, which {path} is not")
    found = (find(path) for find in _LAYOUTS) if len(paths) == 1 else ()
    layout = next((one for one in found if one is not None), None)
    if layout is None and len(paths) == 1 and spec is not None and grid_files(path):
        return truth_grids(path, spec)
    return layout or captures(paths, **options["reading"]) or scans(paths, **options["reading"])


def _named_apart(frames: tuple[FrameRef, ...]) -> tuple[FrameRef, ...]:
    """Give each frame a name of its own: some data sets count the frames of each sequence from 0."""
    times = Counter(one.name for one in frames)
    return tuple(
        one if times[one.name] == 1 else one._replace(name=f"{one.sequence} {one.name}".strip()) for one in frames
    )


def _reopened(
    options: Mapping[str, Any], frames: tuple[FrameRef, ...], facts: Mapping[str, Any], *more: Any
) -> Dataset:
    """Open a pickled data set again, with its poses."""
    return Dataset(replace(_opened(options), frames=frames, facts=facts), options, *more)
