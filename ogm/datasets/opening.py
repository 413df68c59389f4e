"""`open_dataset`: detection of the format at a path."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ogm.datasets.argoverse2 import Argoverse2Recording
from ogm.datasets.carmen import CarmenRecording
from ogm.datasets.dataset import Dataset
from ogm.datasets.depth_images import DepthImagesRecording
from ogm.datasets.kitti import KittiObjectRecording, KittiOdometryRecording, KittiRawRecording, KittiTrackingRecording
from ogm.datasets.logs import CAPTURE_ENDINGS, CaptureRecording, LogRecording
from ogm.datasets.nuscenes import NuScenesRecording
from ogm.datasets.ouster import OUSTER_ENDING, OusterRecording
from ogm.datasets.radarscenes import RadarScenesRecording
from ogm.datasets.range_images import RangeImagesRecording
from ogm.datasets.recording import OpenOptions, Recording
from ogm.datasets.scans import SCAN_ENDINGS, ScansRecording
from ogm.datasets.sensor_setup import SensorSetup
from ogm.datasets.simulated import SimulatedRecording
from ogm.datasets.sustech import SustechRecording
from ogm.datasets.truth_grids import TruthGridsRecording, grid_files
from ogm.grid import GridSpec
from ogm.io import Axes
from ogm.io.logs import LOG_ENDINGS
from ogm.io.scan_table import rotation_to_flu
from ogm.state import kerb_state
from ogm.storage.files import OgmError
from ogm.storage.remote import ObjectPath, as_path

# The first format that accepts the paths is used; formats that require more files come first.
RECORDINGS: tuple[type[Recording], ...] = (
    *(SimulatedRecording, LogRecording, NuScenesRecording, Argoverse2Recording, SustechRecording),
    *(RadarScenesRecording, KittiObjectRecording, KittiTrackingRecording, KittiOdometryRecording, KittiRawRecording),
    *(RangeImagesRecording, DepthImagesRecording, TruthGridsRecording, OusterRecording, CaptureRecording),
    *(CarmenRecording, ScansRecording),
)
_OTHERS = ("all", "later")
_KNOWN = (
    "KITTI object (velodyne/ label_2/ calib/), tracking (velodyne/0000/ label_02/ calib/), raw drives "
    "(velodyne_points/data/ or scans, label_02*.txt, calib*.txt) and odometry (velodyne/ poses.txt calib.txt); "
    "SemanticKITTI (velodyne/ labels/, or sequences/*/); nuScenes (v1.0-*/ samples/) and mmdetection3d's info as JSON; "
    "Argoverse 2 logs (sensors/lidar/ annotations.feather map/); SUSTechPOINTS (lidar/ label/); RadarScenes "
    "(scenes.json radar_data.h5, or sequence_*/); labelled range images (*.npy in semantic_kitti/ or nuscenes/); logs "
    "(.mcap, .db3, .bag); CARMEN logs; captures of Velodynes (.pcap) and Ousters (.pcap with .json, .osf); "
    "depth images (PNGs of 16 bit next to a camera's JSON); datasets that `ogm simulate` made (zarr.json)"
)


def open_dataset(
    path: str | Path | ObjectPath | Sequence[str | Path],
    *,
    storage: Mapping[str, str] | None = None,
    axes: Axes = "flu",
    intensity_max: float | None = None,
    time_unit: float | None = None,
    sensor_height: float | None = None,
    sensor_position: tuple[float, float, float] | None = None,
    origin: tuple[float, float, float] | None = None,
    setups: SensorSetup | Iterable[SensorSetup] = (),
    split: str | None = None,
    default_split: str | None = None,
    truth: str | Iterable[str] = (),
    others: str = "all",
    kerbs: str = "ignore",
    spec: GridSpec | None = None,
    topic: str | Iterable[str] = (),
    frame: str | None = None,
    sensors: str | Iterable[str] = (),
) -> Dataset:
    """Open a dataset as a sequence of frames. No scan is read.

    Parameters
    ----------
    path : path or sequence of paths
        One scan, several scans, a folder of scans (with or without poses), a log or a dataset. The format is detected
        from the files.

        * Datasets: KITTI object, tracking, raw and odometry recordings, SemanticKITTI, nuScenes, mmdetection3d's info
          (JSON), an Argoverse 2 log, SUSTechPOINTS, sequences of RadarScenes, labelled range images, a folder of truth
          grids, or the output of ``ogm simulate``, also in an object store (``s3://bucket/prefix``).
        * A ROS 1 or ROS 2 log (.bag, .db3, .mcap, or the folder of its parts) is one drive: the scans of `topic` in
          the order of their header stamps, with poses from its transforms or odometry.
        * A CARMEN log is detected by content. It is one drive of the laser with most scans, or of `topic` (FLASER,
          RLASER, ROBOTLASER1), with the poses in the log.
        * A capture of a Velodyne (.pcap) or an Ouster (.osf, or .pcap with the sensor's .json), or a folder with one
          capture, is one drive. Only an Ouster capture can have poses, in a file NAME_poses*.txt.
        * A folder of depth images (PNGs of 16 bit) contains the camera's intrinsics (JSON), and may contain poses in
          Open3D's format.
    storage : mapping of str to str, optional
        Endpoint and credentials of the object store, see `ogm.storage.remote.as_path`.
    axes, intensity_max, time_unit
        Axes and units of files of scans, see `ogm.io.read_scan`; datasets define their own.
    sensor_height : float, optional
        Height of the sensor above ground [m]. By default it is stated by the dataset, or estimated as the median over
        up to five scans of the sequence. Estimates outside 0.5 to 5 m are refused.
    sensor_position : (x, y, z), optional
        Position of the sensor in the frame of the points [m], if that is the vehicle's.
    origin : (x, y, z), optional
        Position of the sensor in the coordinates of files of scans [m], for map coordinates (UTM). A scan with a pose
        in these coordinates uses the position of the pose instead, and its points are turned to the sensor's axes.
    setups : SensorSetup or iterable of SensorSetup
        Mounts, ego footprints and ranges of the sensors, see `ogm.datasets.SensorSetup`.
    split : str, optional
        Split of a simulated dataset: training (train), validation (val), test or sequences. By default validation, or
        the first of sequences, test and training that has samples.
    default_split : str, optional
        Split of a simulated dataset if `split` is not given; unlike `split`, it is ignored for other data.
    truth : iterable of str
        Sources of the truth of a recording; by default every available source.

        * ``"boxes"``: cells of boxes with 50 returns or more are occupied; cells of other boxes are never free;
        * ``"classes"``: cells with ground points are free, cells with obstacle points are occupied;
        * ``"map"``: visible drivable area is free;
        * ``"aggregated"``: states on which neighbouring scans agree, transformed by the poses, without moving objects.

        Contradictions between sources are ignored, except that boxes win. Cells without a label are ignored too: the
        truth of a recording has no unknown cells.
    others : {"all", "later"}
        Neighbouring scans of aggregated truth: all scans near in space and time, or only later scans. Use "later" for
        maps that are fused over time, which must not be evaluated on the scans in the map; the last frames then have
        little truth. With "later", cells without hits are ignored in the truth of a simulated dataset, because the map
        may know them from another frame.
    kerbs : {"ignore", "occupied", "unknown", "free"}
        State of obstacles up to 0.15 m in the truth of a simulated dataset, see `ogm.state.Truth.with_kerbs`. By
        default they are left out; the paper counts them as occupied. The truth of other datasets has no heights.
    spec : GridSpec, optional
        Grid of the states and pictures in a folder of truth grids, which do not state it.
    topic : str or iterable of str
        Topics of a log with scans; by default the only topic of a lidar, else of a planar laser, depth camera, radar
        or range sensor. Frames of several topics are in the order of their stamps, and need transforms from base_link
        to each sensor.
    frame : str, optional
        Fixed frame of the poses of a log; by default map, odom, world, or the root of the transforms.
    sensors : str or iterable of str
        Sensors of a simulated dataset: "lidar", "radar", or names of radars; by default the lidar. Scans are frames in
        the order of time within a drive. A radar frame has a truth if a lidar frame has the same stamp.

    Raises
    ------
    FileNotFoundError
        If there is nothing at the path.
    ValueError
        If the path is no supported dataset, lacks the requested labels or split, is damaged or incomplete, or does
        not accept an option.
    """
    given = [path] if isinstance(path, str | Path | ObjectPath) else path
    paths = [as_path(each, storage) for each in given]
    if not paths:
        raise ValueError("got no path to open: give files of scans, or a folder")
    if others not in _OTHERS:
        raise ValueError(f"others must be one of {', '.join(_OTHERS)}, got {others!r}")
    kerb_state(kerbs)
    rotation_to_flu(axes)  # refuses wrong axes before any file is read
    units = {"intensity_max": intensity_max, "time_unit": time_unit, "origin": origin}
    units = {name: unit for name, unit in units.items() if unit is not None}
    options = OpenOptions(
        *(axes, units, sensor_height, sensor_position, split, default_split, others, kerbs, spec, frame),
        *(_names(truth), _names(topic), _names(sensors)),
        (setups,) if isinstance(setups, SensorSetup) else tuple(setups),
    )
    recording = _recording(paths, options)
    _check(recording, options)
    recording.sensor_height, recording.sensor_position = sensor_height, sensor_position
    recording.setups = options.setups
    return Dataset(recording, options.truth, others)


def _names(given: str | Iterable[str]) -> tuple[str, ...]:
    return (given,) if isinstance(given, str) else tuple(given)


def _recording(paths: list[Any], options: OpenOptions) -> Recording:
    """Return the recording of the first format that accepts the paths; refuse options of other formats."""
    path = paths[0]
    if len(paths) == 1 and isinstance(path, Path) and not path.exists():
        raise FileNotFoundError(f"there is no {path}: check the name and the folder")
    found = (kind.open(paths, options) for kind in RECORDINGS)
    recording = next(filter(None, found), None)
    own = () if recording is None else recording.own_options
    if options.sensors and "sensors" not in own:
        raise ValueError(f"`sensors` is for datasets that `ogm simulate` made, which {path} is not: leave it out")
    if (options.topic or options.frame is not None) and "topic" not in own:
        raise ValueError(f"`topic` and `frame` are for logs ({', '.join(LOG_ENDINGS)}), got {path}: leave them out")
    if options.split is not None and "split" not in own:
        raise ValueError(f"`split` is for datasets that `ogm simulate` made, which {path} is not: leave it out")
    if recording is None and len(paths) == 1 and isinstance(path, Path) and path.is_dir():
        captures = sorted(file for file in path.iterdir() if file.suffix.lower() in (*CAPTURE_ENDINGS, OUSTER_ENDING))
        if len(captures) == 1:
            return _recording(captures, options)
        if captures:
            raise OgmError(f"{path} holds captures, {', '.join(file.name for file in captures)[:200]}: give one alone")
    if recording is None:
        grids = "it holds grids: give their `spec` to open them"
        raise OgmError(
            f"{path} is no known dataset and holds no scans ({' '.join(SCAN_ENDINGS)}, .xz, .gz); "
            + (grids if grid_files(path) else f"known are: {_KNOWN}")
        )
    return recording


def _check(recording: Recording, options: OpenOptions) -> None:
    """Raise ValueError if an option contradicts a property that the recording states itself."""
    path = recording.path
    turned = not np.array_equal(rotation_to_flu(options.axes), np.eye(3))
    if recording.known_axes and (turned or options.units):
        raise ValueError(
            f"{path} ({recording.format}) has known axes and units: leave out `axes`, `intensity_max`, `time_unit` "
            "and `origin`, or give its scans as files"
        )
    if recording.known_truth and options.truth:
        raise ValueError(f"`truth` is for recordings, {path} ({recording.format}) holds its truth: leave out `truth`")
    stated = [setup.topic for setup in options.setups]
    used = recording.facts.get("topics", [stated[0]] if len(stated) == 1 else [])
    if stated and "" not in stated and not set(stated) & set(used):
        raise ValueError(
            f"the `setups` are for the topics {', '.join(stated)}, but {path} has scans of "
            f"{', '.join(used) or 'no topic'}: name that topic, or leave topic out"
        )
    if recording.known_axes and any(setup.mount is not None for setup in options.setups):
        raise ValueError(f"{path} ({recording.format}) states its mounts: leave mount out of the `setups`")
    given = options.sensor_height is not None or any(setup.sensor_height is not None for setup in options.setups)
    if recording.known_mount and given:
        raise ValueError(f"{path} states its sensor's height: leave out `sensor_height`")
    if options.sensor_position is not None and (recording.known_mount or recording.known_axes):
        kind = recording.format
        raise ValueError(f"the points of {path} ({kind}) are in the sensor's frame: leave out `sensor_position`")
