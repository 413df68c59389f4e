"""nuScenes, Argoverse 2, SUSTechPOINTS, labelled range images, and any scans with poses."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ogm.io import (
    NUSCENES_ELEVEN,
    SEMANTIC_KITTI_TRAINING,
    NuScenes,
    estimate_sensor_height,
    read_argoverse2,
    read_mmdet3d,
    read_nuscenes,
    read_points,
    read_range_image,
    read_scan,
    read_sustech,
)
from ogm.recordings.layout import (
    CAR,
    KITTI_CAR,
    Layout,
    Plan,
    Seen,
    Shot,
    drive,
    kinds_of,
    pose_files,
    poses_of,
    scans_in,
    stem,
)
from ogm.scan import Boxes

__all__ = ["argoverse2", "mmdet3d", "nuscenes", "range_images", "scans_and_poses", "sustech"]

_IMAGES = {  # names of the classes, axes, intensity that means 1, own vehicle
    "semantic_kitti": (SEMANTIC_KITTI_TRAINING, "kitti", 1.0, KITTI_CAR),
    "nuscenes": (NUSCENES_ELEVEN, "nuscenes", 255.0, CAR),
}
_UPPER = 32  # lasers of Argoverse 2's upper lidar; the lower one's are counted on


def nuscenes(path: Path) -> Layout | None:
    """Find the tables of nuScenes, ``v1.0-*/``."""
    here = path.name.startswith("v1.") and (path / "sample_data.json").is_file()
    if not here and not sorted(path.glob("v1.*-*/sample_data.json")):
        return None
    return _nuscenes(read_nuscenes(path), "nuScenes")


def mmdet3d(path: Path) -> Layout | None:
    """Find mmdetection3d's info of nuScenes: a ``.json``, or a folder with one beside its ``.pcd.bin``."""
    files = [path] if path.suffix == ".json" else sorted(path.glob("*.json"))
    if not files or not (path.suffix == ".json" or sorted(path.glob("*.pcd.bin"))):
        return None
    if len(files) > 1:
        raise ValueError(f"{path} has {len(files)} files that end in .json, wanted one info file: give it")
    return _nuscenes(read_mmdet3d(files[0]), "nuScenes (mmdetection3d's info)")


def _nuscenes(content: NuScenes, name: str) -> Layout:
    shots = tuple(Shot(stem(one.path), one.scene, one.stamp, one.T_map_sensor) for one in content.frames)

    def read(n: int) -> Seen:
        return Seen(read_points(content.frames[n].path, axes="nuscenes"))

    def height(n: int) -> float:
        estimate = estimate_sensor_height(read(n).points)
        return content.frames[n].height if estimate is None else estimate

    return Layout(
        name,
        shots,
        read,
        "boxes of nuScenes (sample_annotation.json, instance.json, category.json)",
        content.boxes if content.annotated else None,
        heights=height,
    )


def argoverse2(path: Path) -> Layout | None:
    """Find one log of Argoverse 2, and look at it from the upper of its two lidars.

    The paper's vehicle has one lidar of that kind, and rays of both cannot start at one place. Returns of the
    lower one still count for what hides the road.
    """
    if not sorted(path.glob("sensors/lidar/*.feather")):
        return None
    log = read_argoverse2(path)
    if "up_lidar" not in log.lidars:
        raise ValueError(
            f"{path} does not say where its upper lidar stands: wanted calibration/egovehicle_SE3_sensor.feather with "
            "up_lidar; that of another log of the data set will do, for the cars are alike"
        )
    origin = log.lidars["up_lidar"]
    shift = np.eye(4)
    shift[:3, 3] = origin
    poses = [log.poses[stamp] @ shift for stamp in log.stamps]
    back = np.eye(4)
    back[:3, 3] = -origin

    def read(n: int) -> Seen:
        sweep = read_scan(log.sweeps[n], axes="argoverse")
        if sweep.ring is None:
            raise ValueError(f"{log.sweeps[n]} has no laser_number, which tells the two lidars apart")
        around = sweep.points - np.array([*origin, 0], np.float32)
        return Seen(np.ascontiguousarray(around[sweep.ring < _UPPER]), around=around)

    def objects(n: int) -> Boxes:
        return log.boxes(n).moved(back)

    def plan(n: int) -> Plan:
        city = log.map
        if city is None:
            raise ValueError(f"{path} has no map")
        return Plan(city.outlines(poses[n]), lambda xyz: city.ground(xyz, poses[n]))

    def height(n: int) -> float:
        """Tell it from both lidars: the lower one sees ground around the car that the upper one does not."""
        ground = estimate_sensor_height(read_scan(log.sweeps[n], axes="argoverse").points)
        return float(origin[2] + (0.33 if ground is None else ground))

    shots = tuple(
        Shot(str(stamp), path.name, stamp * 1e-9, T) for stamp, T in zip(log.stamps, poses, strict=True)
    )
    return Layout(
        "Argoverse 2 log",
        shots,
        read,
        "boxes (annotations.feather), or a map (map/)",
        None if log.annotations is None else objects,
        None if log.map is None else plan,
        view="seen from the upper lidar",
        heights=height,
    )


def sustech(path: Path) -> Layout | None:
    """Find ``lidar/`` and ``label/*.json`` of SUSTechPOINTS, with the axes of its example."""
    scans = scans_in(path / "lidar")
    if not scans or not sorted((path / "label").glob("*.json")):
        return None
    scans = [one for one in scans if (path / "label" / f"{stem(one)}.json").is_file()]
    poses = poses_of(pose_files(path), [stem(one) for one in scans], axes="sustech")
    return Layout(
        "SUSTechPOINTS",
        drive(path.name, scans, poses),
        lambda n: Seen(read_points(scans[n], axes="sustech")),
        "boxes (label/*.json)",
        lambda n: read_sustech(path / "label" / f"{stem(scans[n])}.json"),
    )


def range_images(path: Path) -> Layout | None:
    """Find range images with classes, ``.npy``, in a folder named after their data set, or one of them."""
    files = [path] if path.is_file() else sorted([*path.glob("*.npy"), *path.glob("*.npy.xz")])
    files = [one for one in files if one.name.endswith((".npy", ".npy.xz", ".npy.gz"))]
    if not files:
        return None
    folder = path.resolve() if path.is_dir() else path.resolve().parent
    if folder.name not in _IMAGES:
        raise ValueError(
            f"{path} may hold labelled range images, but nothing in them says what their classes mean and which way "
            f"their axes point: wanted a folder named {' or '.join(_IMAGES)}, after their data set, got {folder.name}"
        )
    names, axes, intensity_max, own = _IMAGES[folder.name]

    def read(n: int) -> Seen:
        found = read_range_image(files[n], names, axes, intensity_max=intensity_max)
        return Seen(found.points, kinds_of(found))

    shots = tuple(Shot(stem(one), folder.name, float("nan"), None) for one in files)
    return Layout(f"labelled range images ({folder.name})", shots, read, "classes", classes=True, own=own)


def scans_and_poses(path: Path) -> Layout | None:
    """Find scans in the lidar's axes with their poses: nothing labelled, but they judge each other."""
    scans = scans_in(path) or scans_in(path / "velodyne")
    if not scans:
        return None
    poses: list[NDArray[np.float64] | None] = poses_of(pose_files(path), [stem(one) for one in scans])
    return Layout(
        "scans with poses",
        drive(path.name, scans, poses),
        lambda n: Seen(read_points(scans[n])),
        "poses (poses.txt, poses.csv, derived/poses*.txt)",
        own=KITTI_CAR,
    )
