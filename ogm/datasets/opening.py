"""`open_dataset`: which recording lies at a path."""

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
from ogm.storage.files import OgmError
from ogm.storage.remote import ObjectPath, as_path

# The first that knows the paths reads them: the more files a format asks for, the earlier it is tried.
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
    "depth images (PNGs of 16 bit beside a camera's JSON); data sets that `ogm simulate` made (zarr.json)"
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
    spec: GridSpec | None = None,
    topic: str | Iterable[str] = (),
    frame: str | None = None,
    sensors: str | Iterable[str] = (),
) -> Dataset:
    """Open a dataset as a sequence of frames. No scan is read.

    Parameters
    ----------
    path : path or sequence of paths
        A scan, several scans, a folder of scans (with or without poses), or a dataset: KITTI object, tracking, raw
        and odometry recordings, SemanticKITTI, nuScenes, mmdetection3d's info (as JSON), an Argoverse 2 log,
        SUSTechPOINTS, one or several sequences of RadarScenes, labelled range images, the output of ``ogm simulate``,
        or a folder of truth grids. The files decide. A log of ROS 1 or ROS 2 (.bag, .db3, .mcap, or a folder of its
        parts) is one drive: the scans of `topic`, in the order of their headers' stamps, with poses by the transforms
        or the odometry in it. A CARMEN log, known by its content, is one drive of the laser with most scans, or of the
        `topic` (FLASER, RLASER, ROBOTLASER1), with the poses in it. A capture of a Velodyne (.pcap) is one drive
        without poses, and so is one of an Ouster (.pcap with the sensor's .json, or .osf) without a file
        NAME_poses*.txt; a folder that holds one capture is that capture. A folder of depth images (PNGs of 16 bit) has
        the JSON of its camera beside them, and perhaps poses, as of Open3D. The output of ``ogm simulate`` may also lie
        in an object store, ``s3://bucket/prefix``.
    storage : mapping of str to str, optional
        Endpoint and credentials of the object store, see `ogm.storage.remote.as_path`.
    axes, intensity_max, time_unit
        Axes and units of files of scans, see `ogm.io.read_scan`; they are known for datasets.
    sensor_height : float, optional
        Height of the sensor above ground [m]. By default it is stated by the dataset, or estimated: the median of up
        to five scans of the sequence. Estimates outside of 0.5 to 5 m are refused.
    sensor_position : (x, y, z), optional
        Position of the sensor in the frame of the points [m], if that is the vehicle's.
    origin : (x, y, z), optional
        Position of the sensor in the coordinates of files of scans [m], for map coordinates (UTM). Where a scan has a
        pose, in the same coordinates, its position counts instead, and its points are turned to the sensor's axes.
    setups : SensorSetup or iterable of these
        Mounts, ego footprints and ranges of the sensors, see `ogm.datasets.SensorSetup`.
    split : str, optional
        Split of a simulated dataset: training (train), validation (val), test or sequences. By default validation, or
        the first of sequences, test and training that has samples.
    default_split : str, optional
        Split of a simulated dataset if `split` is not given; unlike `split`, it is ignored for other data.
    truth : iterable of str
        Labels that the truth of a recording is made of; by default all that exist.

        * ``"boxes"``: cells of boxes with 50 returns or more are occupied; those with fewer are never free;
        * ``"classes"``: cells in which the scan hit ground are free, those with obstacles are occupied;
        * ``"map"``: drivable area that is in sight is free;
        * ``"aggregated"``: states that neighbouring scans agree on, brought to the frame by the poses, without moving
          objects.

        A cell in which they contradict each other is ignored, but boxes win. A cell without a label is ignored too:
        nothing is unknown in the truth of a recording.
    others : {"all", "later"}
        Neighbouring scans of aggregated truth: all that are near in space and time, or only those after the frame.
        "later" is for maps that are fused over time, which must not be evaluated on the scans that they are made of;
        the last frames then know little. For such maps, cells that nothing hit are ignored in the truth of a simulated
        dataset: another frame may have seen them.
    spec : GridSpec, optional
        Cells of the states and pictures in a folder of truth grids, which do not state them.
    topic : str or iterable of str
        Topics of a log with scans; by default the only lidar's, or the only radar's. Frames of several come in the
        order of their stamps, and need transforms from base_link to each sensor.
    frame : str, optional
        Fixed frame of the poses of a log; by default map, odom, world, or the root of the transforms.
    sensors : str or iterable of str
        Sensors of a simulated dataset: "lidar", "radar", or names of radars; by default the lidar. Their scans become
        frames, within a drive in the order of time. A radar's frame has a truth if it has the stamp of a lidar's.

    Raises
    ------
    FileNotFoundError
        If there is nothing at the path.
    ValueError
        If the path is no supported dataset, lacks the labels or the split that are asked for, a part of it is damaged
        or missing, or an option does not belong to it.
    """
    paths = [as_path(one, storage) for one in ([path] if isinstance(path, str | Path | ObjectPath) else path)]
    if not paths:
        raise ValueError("there is no path to open: give files of scans, or a folder")
    if others not in _OTHERS:
        raise ValueError(f"others must be one of {', '.join(_OTHERS)}, got {others!r}")
    units = {"intensity_max": intensity_max, "time_unit": time_unit, "origin": origin}
    units = {name: unit for name, unit in units.items() if unit is not None}
    options = OpenOptions(
        *(axes, units, sensor_height, sensor_position, split, default_split, others, spec, frame),
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
    """Return the recording of the first format that knows the paths, or refuse options of other formats."""
    path = paths[0]
    if len(paths) == 1 and isinstance(path, Path) and not path.exists():
        raise FileNotFoundError(f"there is no {path}: check the name and the folder")
    found = (kind.open(paths, options) for kind in RECORDINGS)
    recording = next((one for one in found if one is not None), None)
    own = () if recording is None else recording.own_options
    if options.sensors and "sensors" not in own:
        raise ValueError(f"`sensors` is for data sets that `ogm simulate` made, which {path} is not")
    if (options.topic or options.frame is not None) and "topic" not in own:
        raise ValueError(f"`topic` and `frame` are for logs ({', '.join(LOG_ENDINGS)}), got {path}")
    if options.split is not None and "split" not in own:
        raise ValueError(f"`split` is for data sets that `ogm simulate` made, which {path} is not")
    if recording is None and len(paths) == 1 and isinstance(path, Path) and path.is_dir():
        captures = sorted(one for one in path.iterdir() if one.suffix.lower() in (*CAPTURE_ENDINGS, OUSTER_ENDING))
        if len(captures) == 1:
            return _recording(captures, options)
        if captures:
            raise OgmError(f"{path} holds captures, {', '.join(one.name for one in captures)[:200]}: give one alone")
    if recording is None:
        grids = "it holds grids: give spec, their cells, to open them"
        raise OgmError(
            f"{path} is no data set that is known and holds no scans ({' '.join(SCAN_ENDINGS)}, .xz, .gz); "
            + (grids if grid_files(path) else f"known are: {_KNOWN}")
        )
    return recording


def _check(recording: Recording, options: OpenOptions) -> None:
    """Raise ValueError if an option states what the recording states itself."""
    path = recording.path
    turned = not np.array_equal(rotation_to_flu(options.axes), np.eye(3))
    if recording.known_axes and (turned or options.units):
        raise ValueError(
            f"{path} ({recording.format}) has known axes and units; leave out `axes`, `intensity_max`, `time_unit` "
            "and `origin`, or give its scans as files"
        )
    if recording.known_truth and options.truth:
        raise ValueError(f"`truth` is for recordings; {path} ({recording.format}) holds its truth itself: leave it out")
    stated = [setup.topic for setup in options.setups]
    used = recording.facts.get("topics", [stated[0]] if len(stated) == 1 else [])
    if stated and "" not in stated and not set(stated) & set(used):
        raise ValueError(
            f"the `setups` are of {', '.join(stated)}, the scans of {path} of "
            f"{', '.join(used) or 'no topic'}: name that topic, or leave topic out"
        )
    if recording.known_axes and any(setup.mount is not None for setup in options.setups):
        raise ValueError(f"{path} ({recording.format}) states its mounts: leave mount out of the `setups`")
    given = options.sensor_height is not None or any(one.sensor_height is not None for one in options.setups)
    if recording.known_mount and given:
        raise ValueError(f"{path} states its sensor's height; leave out `sensor_height`")
    if options.sensor_position is not None and (recording.known_mount or recording.known_axes):
        raise ValueError(
            f"the points of {path} ({recording.format}) are in the sensor's frame; leave out `sensor_position`"
        )
