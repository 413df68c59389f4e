"""Data sets as sequences of frames."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.datasets.argoverse2 import argoverse2
from ogm.datasets.kitti import kitti_object, kitti_odometry, kitti_raw, kitti_tracking
from ogm.datasets.layout import FrameRef, Layout
from ogm.datasets.nuscenes import mmdet3d, nuscenes
from ogm.datasets.range_images import range_images
from ogm.datasets.reader import FrameReader
from ogm.datasets.scans import scans
from ogm.datasets.simulated import simulated
from ogm.datasets.sustech import sustech
from ogm.datasets.truth_grids import grid_files, truth_grids
from ogm.grid import GridSpec
from ogm.io import Axes
from ogm.io.axes import rotation_to_flu
from ogm.pose import Trajectory
from ogm.scan import Frame

__all__ = ["Dataset", "open_dataset"]

# The first that knows a path reads it: the more a layout asks for, the earlier it is tried.
_LAYOUTS = (
    *(nuscenes, mmdet3d, argoverse2, sustech),
    *(kitti_object, kitti_tracking, kitti_odometry, kitti_raw, range_images),
)
_KNOWN = (
    "KITTI object (velodyne/ label_2/ calib/), tracking (velodyne/0000/ label_02/ calib/), raw drives "
    "(velodyne_points/data/ or scans, label_02*.txt, calib*.txt) and odometry (velodyne/ poses.txt calib.txt); "
    "SemanticKITTI (velodyne/ labels/, or sequences/*/); nuScenes (v1.0-*/ samples/) and mmdetection3d's info as JSON; "
    "Argoverse 2 logs (sensors/lidar/ annotations.feather map/); SUSTechPOINTS (lidar/ label/); labelled range images "
    "(*.npy in semantic_kitti/ or nuscenes/); data sets that `ogm simulate` made (zarr.json)"
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
        where there is no truth: asking a frame for it then raises a ValueError with the way out.
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

    def __init__(
        self,
        reader: FrameReader,
        options: Mapping[str, Any],
        numbers: Sequence[int] | None = None,
        facts: Mapping[str, Any] | None = None,
        trajectory: Trajectory | None = None,
    ) -> None:
        layout = reader.layout
        self.reader, self._options = reader, dict(options)
        self._numbers = tuple(range(len(layout.frames)) if numbers is None else numbers)
        self.name = layout.name or reader.path.name or reader.path.resolve().name or str(reader.path)
        self.format, self.description = layout.format, reader.description
        self.files = layout.files or (reader.path,)
        self.motion_distorted, self.trajectory = layout.motion_distorted, trajectory
        self._more_facts = dict(facts or {})
        stated = layout.facts or {"format": layout.format, "frames": len(layout.frames)}
        self.facts: dict[str, Any] = {**stated, **self._more_facts}

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
        ref, reader = self.reader.layout.frames[k], self.reader
        return Frame(
            partial(reader.scan, k),
            partial(reader.mount, k),
            partial(reader.boxes, k),
            partial(reader.truth, k),
            T_map_sensor=ref.T_map_sensor,
            stamp=ref.stamp,
            name=ref.name,
            sequence=ref.sequence,
        )

    def __repr__(self) -> str:
        return f"Dataset({self.name!r}: {len(self)} frames, {self.format})"

    def __reduce__(self) -> tuple[Any, ...]:
        arguments = (
            self._options,
            self._numbers,
            self.reader.layout.frames,
            self._more_facts,
            self.trajectory,
        )
        return _reopened, arguments

    def select(self, numbers: ArrayLike | Iterable[int]) -> "Dataset":
        """Return the data set of some frames, by their numbers in this one."""
        chosen = [self._numbers[int(n)] for n in np.asarray(numbers).ravel()]
        return Dataset(self.reader, self._options, chosen, self._more_facts, self.trajectory)

    @property
    def refs(self) -> tuple[FrameRef, ...]:
        """Name, sequence, stamp and pose of every frame; no frame is made for it."""
        return tuple(self.reader.layout.frames[k] for k in self._numbers)

    @property
    def sequences(self) -> dict[str, list[int]]:
        """Numbers of the frames of each sequence, in order; frames that stand alone are left out."""
        result: dict[str, list[int]] = {}
        for n, ref in enumerate(self.refs):
            if ref.sequence:
                result.setdefault(ref.sequence, []).append(n)
        return result

    def placed(
        self,
        stamps: NDArray[np.float64],
        poses: NDArray[np.float64],
        facts: Mapping[str, Any],
        trajectory: Trajectory | None = None,
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
        trajectory : Trajectory, optional
        """
        frames = [one._replace(T_map_sensor=None) for one in self.reader.layout.frames]
        sequences = {ref.sequence for ref in self.refs}
        sequence = sequences.pop() if len(sequences) == 1 and "" not in sequences else self.name
        for k, stamp, T in zip(self._numbers, stamps, poses, strict=True):
            known = bool(np.isfinite(stamp) and np.isfinite(T).all())
            frames[k] = FrameRef(
                frames[k].name, sequence, float(stamp) if known else None, T if known else None
            )
        return _with_frames(
            self._options, tuple(frames), self._numbers, {**self._more_facts, **facts}, trajectory, self.reader
        )


def open_dataset(
    path: str | Path | Sequence[str | Path],
    *,
    axes: Axes = "flu",
    intensity_max: float | None = None,
    time_unit: float | None = None,
    sensor_height: float | None = None,
    sensor_position: tuple[float, float, float] | None = None,
    split: str | None = None,
    truth: str | Iterable[str] = (),
    others: str = "all",
    spec: GridSpec | None = None,
) -> Dataset:
    """Open a data set as a sequence of frames. No scan is read.

    Parameters
    ----------
    path : path or sequence of paths
        A scan, several scans, a folder of scans (with or without poses), or a data set: KITTI object, tracking, raw
        and odometry recordings, SemanticKITTI, nuScenes, mmdetection3d's info (as JSON), an Argoverse 2 log,
        SUSTechPOINTS, labelled range images, what ``ogm simulate`` made, or a folder of truth grids. What lies in it
        decides.
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

    Raises
    ------
    FileNotFoundError
        If there is nothing at the path.
    ValueError
        If it is no known data set, lacks what `truth` or `split` ask for, a part of it is damaged or missing, or an
        option does not belong to it.
    """
    given = [path] if isinstance(path, str | Path) else list(path)
    if not given:
        raise ValueError("there is no path to open: give files of scans, or a folder")
    options = {
        **{"path": given, "axes": axes, "intensity_max": intensity_max, "time_unit": time_unit},
        **{"sensor_height": sensor_height, "sensor_position": sensor_position, "split": split},
        **{"truth": (truth,) if isinstance(truth, str) else tuple(truth), "others": others, "spec": spec},
    }
    return Dataset(_reader(options), options)


def _reader(options: Mapping[str, Any], frames: tuple[FrameRef, ...] | None = None) -> FrameReader:
    """Open a data set by the options of `open_dataset`, perhaps with other poses."""
    paths = [Path(one) for one in options["path"]]
    names = ("axes", "intensity_max", "time_unit")
    reading = {name: options[name] for name in names}
    layout = _layout(paths, options["split"], options["others"], options["spec"], reading)
    chosen = not np.array_equal(rotation_to_flu(options["axes"]), np.eye(3))
    if layout.known_axes and (chosen or options["intensity_max"] or options["time_unit"]):
        raise ValueError(
            f"{paths[0]} ({layout.format}) has known axes and units; leave out axes, intensity_max and time_unit "
            "(--axes, --intensity-max, --time-unit), or give its scans as files"
        )
    layout = replace(layout, frames=frames or _named_apart(layout.frames))
    asked = ("truth", "others", "sensor_height", "sensor_position")
    return FrameReader(layout, paths[0], **{name: options[name] for name in asked})


def _layout(
    paths: Sequence[Path], split: str | None, others: str, spec: GridSpec | None, reading: Mapping[str, Any]
) -> Layout:
    """Return what the first layout that knows the paths makes of them."""
    if len(paths) > 1:
        return scans(paths, **reading)
    (path,) = paths
    if not path.exists():
        raise FileNotFoundError(f"there is no {path}: check the name and the folder")
    if (path / "zarr.json").exists():
        return simulated(path, split, others)
    if split is not None:
        raise ValueError(f"split (--split) is for data sets that `ogm simulate` made, which {path} is not")
    grids = spec is not None and path.is_dir() and bool(grid_files(path))
    try:
        layout = next((one for find in _LAYOUTS if (one := find(path)) is not None), None)
    except ValueError:
        if not grids:
            raise
        layout = None  # arrays that state nothing of themselves
    if layout is None and spec is not None and grids:
        layout = truth_grids(path, spec)
    if layout is not None:
        return layout
    if path.is_dir() and grid_files(path) and not any(_is_scan(one) for one in path.iterdir()):
        raise ValueError(f"{path} holds grids; give spec, the cells of the truth, to open them as such")
    try:
        return scans(paths, **reading)
    except ValueError as error:
        if "holds no scans" not in str(error):
            raise
        raise ValueError(f"{path} is no data set that is known, and {error}. Known are: {_KNOWN}") from error


def _is_scan(path: Path) -> bool:
    from ogm.datasets.paths import ending_of

    return bool(ending_of(path))


def _named_apart(frames: tuple[FrameRef, ...]) -> tuple[FrameRef, ...]:
    """Give each frame a name of its own: some data sets count the frames of each sequence from 0."""
    times = Counter(one.name for one in frames)
    return tuple(
        one if times[one.name] == 1 else one._replace(name=f"{one.sequence} {one.name}".strip())
        for one in frames
    )


def _with_frames(
    options: Mapping[str, Any],
    frames: tuple[FrameRef, ...],
    numbers: Sequence[int],
    facts: Mapping[str, Any],
    trajectory: Trajectory | None,
    reader: FrameReader | None = None,
) -> Dataset:
    if reader is None:
        reader = _reader(options, frames)
    else:
        asked = ("truth", "others", "sensor_height", "sensor_position")
        reader = FrameReader(
            replace(reader.layout, frames=frames), reader.path, **{name: options[name] for name in asked}
        )
    return Dataset(reader, options, numbers, facts, trajectory)


def _reopened(
    options: Mapping[str, Any],
    numbers: Sequence[int],
    frames: tuple[FrameRef, ...],
    facts: Mapping[str, Any],
    trajectory: Trajectory | None,
) -> Dataset:
    """Open a pickled data set again."""
    return _with_frames(options, frames, numbers, facts, trajectory)
