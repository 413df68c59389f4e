"""Targets: data sets: labels, poses, calibrations, tables, range images, label pictures."""

import io
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from radarscenes_files import write_sequence
from seed_points import feather, npy, sweep
from targets import Target, check_poses, check_scan, cloud

from ogm import GridSpec
from ogm.datasets import open_dataset, read_setups
from ogm.io import read_poses
from ogm.io.argoverse2 import read_argoverse2
from ogm.io.kitti import read_calibration, read_kitti_objects, read_kitti_stamps, read_kitti_tracks
from ogm.io.nuscenes import read_mmdet3d, read_nuscenes
from ogm.io.range_images import NUSCENES_ELEVEN, read_range_image
from ogm.io.semantic_kitti import read_semantic_kitti
from ogm.io.sustech import read_sustech
from ogm.simulation.exchange import read_label, write_label
from ogm.state import Truth

Files = Callable[[], dict[str, bytes]]
CAMERA = np.array([[0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1.0]])
CALIBRATION = (
    b"P0: 7.2e+02 0 6.1e+02 0 0 7.2e+02 1.7e+02 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\n"
    b"Tr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\n"
)
LABEL = b"Car 0 0 0 0 0 0 0 1.5 2.0 4.0 4.0 1.7 8.0 -1.3\nDontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10\n"
SETUPS = (
    b"sensors:\n- topic: /points\n  height: 1.2\n  mount: {x: 0.0, y: 0.0, z: 0.0, roll: 0.0, pitch: 15.0, yaw: 0.0}\n"
    b"  footprint: [-0.7, -0.1, -0.3, 0.3]\n  range: [0.0, 30.0]\n  no_echo_at_greatest_range: true\n"
    b"- leave_out:\n  - [150, 210]\n  - [-10, 10]\n"
)
TRACKS = b"".join(b"%d %d Car 0 0 0 0 0 0 0 1.5 2.0 4.0 4.0 1.7 8.0 -1.3\n" % (k, t) for k in range(3) for t in (0, 1))


def poses(kind: str) -> bytes:
    """Return six poses as text."""
    lines = []
    for k in range(6):
        c, s = np.cos(0.1 * k), np.sin(0.1 * k)
        T = [c, -s, 0, 1.5 * k, s, c, 0, 0.2 * k, 0, 0, 1, 0.0]
        row = [0.1 * k + 1.6e9, 1.5 * k, 0.2 * k, 0.0, 0, 0, np.sin(0.05 * k), np.cos(0.05 * k)]
        number = f"{3 * k} " if kind == "kitti360" else ""
        blank = "," if kind == "csv" else " "
        lines.append(number + blank.join(repr(float(x)) for x in (T if "kitti" in kind else row)))
    if kind == "g2o":
        lines = [f"VERTEX_SE3:QUAT {k} " + line.split(" ", 1)[1] for k, line in enumerate(lines)]
        lines += ["VERTEX_SE2 9 1.0 2.0 0.5", "EDGE_SE2 0 9 1 2 0.5 1 0 0 1 0 1"]
    if kind == "csv":
        lines = ["# ogm.poses/1: T_map_sensor", "stamp,x,y,z,qx,qy,qz,qw", *lines]
    return ("\n".join(lines) + "\n").encode()


def nuscenes_tables() -> dict[str, bytes]:
    """Return a scene of two key frames."""
    turn = [1.0, 0.0, 0.0, 0.0]
    files, tokens = [f"samples/LIDAR_TOP/{k}.pcd.bin" for k in range(2)], {"calibrated_sensor_token": "c"}
    box = {"instance_token": "i", "translation": [8, 2, 0.8], "size": [2, 4, 1.5], "rotation": turn}
    tables: dict[str, list[dict[str, Any]]] = {
        "scene": [{"token": "s", "name": "scene-1"}],
        "sample": [{"token": f"f{k}", "scene_token": "s"} for k in range(2)],
        "sensor": [{"token": "l", "channel": "LIDAR_TOP"}],
        "calibrated_sensor": [{"token": "c", "sensor_token": "l", "translation": [0.9, 0, 1.8], "rotation": turn}],
        "ego_pose": [{"token": f"e{k}", "translation": [k, 0, 0], "rotation": turn} for k in range(2)],
        "sample_data": [
            {"token": f"d{k}", "sample_token": f"f{k}", "ego_pose_token": f"e{k}", "is_key_frame": True, **tokens}
            | {"timestamp": 1532402927647951 + 50000 * k, "filename": files[k]}
            for k in range(2)
        ],
        "category": [{"token": "k", "name": "vehicle.car"}],
        "instance": [{"token": "i", "category_token": "k"}],
        "sample_annotation": [{"token": f"a{k}", "sample_token": f"f{k}", **box} for k in range(2)],
    }
    rows = np.column_stack([cloud(), np.zeros(24)]).astype("<f4").tobytes()
    return {f"v1.0-mini/{name}.json": json.dumps(t).encode() for name, t in tables.items()} | dict.fromkeys(files, rows)


def mmdet3d_info() -> bytes:
    """Return an info file of mmdetection3d with one frame."""
    T = np.eye(4).tolist()
    lidar = {"lidar_path": "n015__LIDAR_TOP__1532402927647951.pcd.bin", "lidar2ego": T}
    boxes = [{"bbox_3d": [8, 2, 0, 4, 2, 1.5, 0.3], "bbox_label_3d": 0}]
    entry = {"lidar_points": lidar, "ego2global": T, "timestamp": 1532402927.6, "instances": boxes}
    return json.dumps({"metainfo": {"dataset": "nuscenes", "categories": {"car": 0}}, "data_list": [entry]}).encode()


def argoverse_log() -> dict[str, bytes]:
    """Return a log of Argoverse 2 with two sweeps, boxes and map."""
    stamps = np.array([315973157959879000, 315973158059879000])
    turn = {"qw": [1.0, 1.0], "qx": [0.0, 0.0], "qy": [0.0, 0.0], "qz": [0.0, 0.0]}
    place = {"tx_m": [0.0, 1.0], "ty_m": [0.0, 0.0], "tz_m": [0.0, 0.0]}
    boxes = {"timestamp_ns": stamps, "track_uuid": ["a", "a"], "category": ["CAR", "CAR"], "length_m": [4.0, 4.0]}
    boxes |= {"width_m": [2.0, 2.0], "height_m": [1.5, 1.5], **turn, **place}
    corners = [{"x": x, "y": y, "z": 0.0} for x, y in ((-20, -20), (20, -20), (20, 20), (-20, 20))]
    plan = {"drivable_areas": {"1": {"area_boundary": corners, "id": 1}}}
    return {
        **{f"sensors/lidar/{stamp}.feather": sweep("uncompressed") for stamp in stamps},
        "city_SE3_egovehicle.feather": feather({"timestamp_ns": stamps, **turn, **place}),
        "calibration/egovehicle_SE3_sensor.feather": feather(
            {"sensor_name": ["up_lidar", "down_lidar"], **turn, **place}
        ),
        "annotations.feather": feather(boxes),
        "map/log_map_archive_x.json": json.dumps(plan).encode(),
        "map/x_ground_height_surface_x.npy": npy(np.zeros((8, 8), np.float32)),
        "map/x___img_Sim2_city.json": json.dumps({"R": [1, 0, 0, 1], "t": [4.0, 4.0], "s": 1.0}).encode(),
    }


def _boxes(boxes: Any) -> None:
    assert boxes.array.shape == (len(boxes.labels), 7), "boxes"
    assert np.isfinite(boxes.array).all(), "boxes not finite"


def _labelled(points: Any) -> None:
    assert len(points.points) == len(points.classes), "classes"
    assert np.isfinite(points.points).all(), "points not finite"


def _nuscenes(content: Any) -> None:
    for n, frame in enumerate(content.frames):
        check_poses(frame.T_map_sensor)
        assert np.isfinite(frame.stamp), "stamp"
        content.boxes(n)


def _argoverse(folder: Path) -> None:
    log = read_argoverse2(folder)
    for n, stamp in enumerate(log.stamps):
        check_poses(log.poses[stamp])
        log.boxes(n)
        if log.map is not None:
            log.map.outlines(log.poses[stamp])
            log.map.ground(np.zeros((3, 3)), log.poses[stamp])


def _poses(path: Path) -> None:
    found = read_poses(path)
    check_poses(found.poses)
    assert found.stamps is None or (np.diff(found.stamps) > 0).all(), "stamps do not increase"


def _frames(path: Path) -> None:
    for frame in open_dataset(path):
        check_scan(frame.scan)


def _one(name: str, content: Callable[[], bytes], read: Callable[[Path], object], folder: Path) -> Target:
    return Target({name: content()}, lambda files: read(files / name))


def _many(
    content: Callable[[], dict[str, bytes]], changed: str, read: Callable[[Path], object], folder: Path
) -> Target:
    files = content()
    return Target(files, read, tuple(name for name in files if changed in name))


def kitti_raw() -> dict[str, bytes]:
    """Return a drive of KITTI raw with two scans."""
    drive = "2011_09_26/2011_09_26_drive_0001_sync"
    scans = {f"{drive}/velodyne_points/data/{k:010d}.bin": cloud().tobytes() for k in range(2)}
    stamps = b"".join(b"2011-09-26 13:02:2%d.964389445\n" % k for k in range(2))
    return {**scans, f"{drive}/velodyne_points/timestamps.txt": stamps}


def kitti_odometry() -> dict[str, bytes]:
    """Return a sequence of KITTI odometry with two scans."""
    scans = {f"velodyne/{k:06d}.bin": cloud().tobytes() for k in range(2)}
    calibration = CALIBRATION.replace(b"Tr_velo_to_cam", b"Tr").replace(b"R0_rect", b"P1")
    lines = b"\n".join(poses("kitti").splitlines()[:2]) + b"\n"
    labels = {f"labels/{k:06d}.label": np.full(24, 40, "<u4").tobytes() for k in range(2)}
    return {**scans, **labels, "calib.txt": calibration, "times.txt": b"0.0\n0.1\n", "poses.txt": lines}


def depth_folder() -> dict[str, bytes]:
    """Return two depth images with camera and poses, as of Open3D."""
    pictures = dict[str, bytes]()
    for k in range(2):
        stream = io.BytesIO()
        Image.fromarray(np.arange(1000 + k, 1048 + k, dtype=np.uint16).reshape(6, 8)).save(stream, "PNG")
        pictures[f"depth_{k}.png"] = stream.getvalue()
    camera = {"width": 8, "height": 6, "intrinsic_matrix": [50.0, 0, 0, 0, 50.0, 0, 3.5, 2.5, 1]}
    lines = "".join(f"{k} {k} {k + 1}\n1 0 0 {k}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n" for k in range(2))
    return {**pictures, "camera.json": json.dumps(camera).encode(), "odometry.log": lines.encode()}


def _range_image() -> bytes:
    image = np.random.default_rng(2).uniform(1, 9, (4, 8, 6)).astype(np.float32)
    image[..., 5] = np.arange(8) % 8
    return npy(image)


def _sustech() -> bytes:
    xyz = {"x": 1.0, "y": 2.0, "z": 0.5}
    note = {"psr": {"position": xyz, "scale": xyz, "rotation": xyz}, "obj_type": "Car", "obj_id": "1"}
    return json.dumps([note] * 2).encode()


def _semantic() -> dict[str, bytes]:
    label = np.resize(np.array([40, 10 | 3 << 16, 252], "<u4"), 24).tobytes()
    return {"0.bin": cloud().tobytes(), "0.label": label}


def _label(folder: Path) -> Target:
    spec = GridSpec(0.16, (8, 6), (0.0, 0.0))
    write_label(folder / "a.png", Truth(spec, (np.arange(48).reshape(8, 6) % 3).astype(np.uint8)))
    return Target({"a.png": (folder / "a.png").read_bytes()}, lambda files: read_label(files / "a.png", spec))


def _radarscenes(storage: dict[str, Any], folder: Path) -> Target:
    write_sequence(folder, 4, 4, **storage)
    files = {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    return Target(files, lambda files: _frames(files / "sequence_1"))


_STAMPS = b"".join(b"2011-09-26 13:02:2%d.964389445\n" % k for k in range(5))
_KITTI = {
    "calibration": ("calib.txt", lambda: CALIBRATION, lambda path: check_poses(read_calibration(path))),
    "kitti-objects": ("l.txt", lambda: LABEL * 3, lambda path: read_kitti_objects(path, CAMERA)),
    "kitti-tracks": ("l.txt", lambda: TRACKS, lambda path: read_kitti_tracks(path, CAMERA)),
    "kitti-stamps": ("t.txt", lambda: _STAMPS, read_kitti_stamps),
    "range-image": ("r.npy", _range_image, lambda path: _labelled(read_range_image(path, NUSCENES_ELEVEN))),
    "sustech": ("0.json", _sustech, read_sustech),
    "mmdet3d": ("info.json", mmdet3d_info, lambda path: _nuscenes(read_mmdet3d(path))),
}
_FOLDERS: dict[str, tuple[Files, str, Callable[[Path], object]]] = {
    "semantic-kitti": (_semantic, "", lambda f: _labelled(read_semantic_kitti(f / "0.bin", f / "0.label"))),
    "nuscenes": (nuscenes_tables, ".json", lambda folder: _nuscenes(read_nuscenes(folder))),
    "dataset-nuscenes": (nuscenes_tables, "sample", _frames),
    "dataset-argoverse2": (argoverse_log, ".", _frames),
    "argoverse2": (argoverse_log, ".", _argoverse),
    "dataset-kitti-raw": (kitti_raw, "", lambda f: _frames(f / "2011_09_26/2011_09_26_drive_0001_sync")),
    "dataset-kitti-odometry": (kitti_odometry, "", _frames),
    "dataset-depth": (depth_folder, "", _frames),
}
TARGETS: dict[str, Callable[[Path], Target]] = {
    **{
        f"poses-{kind}": partial(_one, f"poses.{ending}", partial(poses, kind), _poses)
        for kind, ending in {"tum": "txt", "kitti": "txt", "kitti360": "txt", "csv": "csv", "g2o": "g2o"}.items()
    },
    **{name: partial(_one, *given) for name, given in _KITTI.items()},
    **{name: partial(_many, *given) for name, given in _FOLDERS.items()},
    "label-picture": _label,
    "setups": partial(_one, "vehicle.yaml", lambda: SETUPS, read_setups),
    "radarscenes": partial(_radarscenes, {}),
    "radarscenes-packed": partial(_radarscenes, {"compression": "gzip", "shuffle": True, "chunks": (9,)}),
}
