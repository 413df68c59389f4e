"""A small made-up street, and writers that put it down as every data set would.

The street is flat. A wall stands ahead, a car is parked, another drives past, and the ego vehicle goes 1 m forward
from scan to scan. The writers use the data sets' own axes and units and nothing of the library.
"""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

HEIGHT = 1.8  # [m] of the sensor
SCANS = 4
PARKED = np.array([8.0, -4.0, 0.3, 4.0, 2.0, 0.0, 1.5])  # x, y, yaw, length, width, bottom, top; on the street
# Camera: x right, y down, z forward; a little behind and above the lidar
T_CAMERA = np.array([[0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1.0]])
CLASSES = {"road": 40, "building": 50, "car": 10, "moving-car": 252, "outlier": 1}


def driving(k: int) -> np.ndarray:
    """Return the box of the car that drives, at scan k, on the street."""
    return np.array([4.0 + 1.5 * k, 4.0, 0.0, 4.0, 2.0, 0.0, 1.5])


def boxes(k: int) -> np.ndarray:
    """Return both cars as seen from the sensor at scan k."""
    return np.array([PARKED, driving(k)]) - [k, 0, 0, 0, 0, HEIGHT, HEIGHT]


def on_box(box: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Scatter returns in a box, above its lowest 0.35 m."""
    x, y, yaw, length, width, bottom, top = box
    u, v = rng.uniform(-0.5, 0.5, (2, count)) * [[0.96 * length], [0.96 * width]]
    z = rng.uniform(bottom + 0.35, top - 0.02, count)
    return np.column_stack([x + np.cos(yaw) * u - np.sin(yaw) * v, y + np.sin(yaw) * u + np.cos(yaw) * v, z])


def scan(k: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, 4) float32 from the sensor, and the name of each one's class."""
    rng = np.random.default_rng(k)
    x, y = np.meshgrid(np.arange(-12, 15, 0.11), np.arange(-10, 10, 0.11), indexing="ij")
    ground = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]) + rng.uniform(0, 0.01, (x.size, 3))
    under = np.zeros(len(ground), bool)
    for cx, cy, yaw, length, width, *_ in (PARKED, driving(k)):
        c, s, px, py = np.cos(yaw), np.sin(yaw), ground[:, 0] - cx, ground[:, 1] - cy
        under |= (np.abs(c * px + s * py) < length / 2) & (np.abs(c * py - s * px) < width / 2)
    ground = ground[~under & (ground[:, 0] < 13)]
    wall = np.column_stack([rng.uniform(13.0, 13.1, 3000), rng.uniform(-9, 9, 3000), rng.uniform(0.4, 1.9, 3000)])
    own = np.tile([k + 0.4, 0.2, 1.4], (40, 1)) + rng.uniform(0, 0.2, (40, 3))
    parts = {
        "road": ground, "building": wall, "car": on_box(PARKED, 900, rng), "moving-car": on_box(driving(k), 900, rng),
        "outlier": own,
    }  # fmt: skip
    points = np.concatenate(list(parts.values())) - [k, 0, HEIGHT]
    names = np.repeat(list(parts), [len(part) for part in parts.values()])
    return np.column_stack([points, np.full(len(points), 0.5)]).astype(np.float32), names


def on_map(k: int) -> np.ndarray:
    """Return T_map_sensor at scan k, on a map that is turned and far away."""
    T = np.eye(4)
    T[:2, :2] = [[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]]
    T[:3, 3] = T[:3, :3] @ [k, 0, HEIGHT] + [100.0, 50.0, 0.0]
    return T


def quaternion(T: np.ndarray) -> list[float]:
    """Return w, x, y, z of a turn about z."""
    half = np.arctan2(T[1, 0], T[0, 0]) / 2
    return [float(np.cos(half)), 0.0, 0.0, float(np.sin(half))]


def kitti_line(box: np.ndarray, label: str) -> str:
    """Write a box as KITTI does: in the camera's frame, the middle of its bottom, turned about y, downwards."""
    x, y, yaw, length, width, bottom, top = box
    place = T_CAMERA @ [x, y, bottom, 1]
    turn = -yaw - np.pi / 2
    numbers = [0, 0, 0, 0, 0, 0, 0, top - bottom, width, length, *place[:3], turn]
    return f"{label} " + " ".join(f"{value:.9f}" for value in numbers)


def write_calibration(path: Path, name: str = "Tr_velo_to_cam", rectify: bool = True) -> None:
    rows = [f"{name}: " + " ".join(map(repr, T_CAMERA[:3].ravel().tolist()))]
    rows += ["R0_rect: 1 0 0 0 1 0 0 0 1"] if rectify else []
    path.write_text("\n".join(rows) + "\n")


def write_kitti_object(folder: Path) -> None:
    for name in ("velodyne", "label_2", "calib"):
        (folder / name).mkdir(parents=True)
    for k in range(SCANS):
        scan(k)[0].tofile(folder / "velodyne" / f"{k:06}.bin")
        lines = [kitti_line(box, "Car") for box in boxes(k)]
        lines.append("DontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10")
        (folder / "label_2" / f"{k:06}.txt").write_text("\n".join(lines) + "\n")
        write_calibration(folder / "calib" / f"{k:06}.txt")


def tracking_lines() -> str:
    rows = [f"{k} {track} {kitti_line(box, 'Car')}" for k in range(SCANS) for track, box in enumerate(boxes(k))]
    return "\n".join([*rows, "0 -1 DontCare -1 -1 -10 1 2 3 4 -1000 -1000 -1000 -10 -1 -1 -1"]) + "\n"


def write_lidar_poses(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [f"{k} " + " ".join(map(repr, on_map(k)[:3].ravel().tolist())) for k in range(SCANS)]
    path.write_text("# number and T_map_sensor\n" + "\n".join(rows) + "\n")


def write_kitti_tracking(folder: Path) -> None:
    for name in ("velodyne/0003", "label_02", "calib", "poses"):
        (folder / name).mkdir(parents=True)
    for k in range(SCANS):
        scan(k)[0].tofile(folder / "velodyne" / "0003" / f"{k:06}.bin")
    (folder / "label_02" / "0003.txt").write_text(tracking_lines())
    write_calibration(folder / "calib" / "0003.txt", "Tr_velo_cam")
    write_lidar_poses(folder / "poses" / "0003.txt")


def write_kitti_raw(folder: Path) -> None:
    """Write the folder of a drive as KITTI ships it, in that of its day; labels and poses are added by hand."""
    data = folder / "velodyne_points" / "data"
    data.mkdir(parents=True)
    for k in range(SCANS):
        scan(k)[0].tofile(data / f"{k:010}.bin")
    stamps = [f"2011-09-26 13:02:2{5 + k // 10}.{k % 10}64389445" for k in range(SCANS)]
    (folder / "velodyne_points" / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    rows = [f"R: {' '.join(map(repr, T_CAMERA[:3, :3].ravel().tolist()))}"]
    rows.append(f"T: {' '.join(map(repr, T_CAMERA[:3, 3].tolist()))}")
    (folder.parent / "calib_velo_to_cam.txt").write_text("calib_time: 15-Mar-2012 11:37:16\n" + "\n".join(rows))
    (folder.parent / "calib_cam_to_cam.txt").write_text("corner_dist: 9.95e-02\nR_rect_00: 1 0 0 0 1 0 0 0 1\n")
    (folder / "label_02").mkdir()
    (folder / "label_02" / "0000.txt").write_text(tracking_lines())
    write_lidar_poses(folder / "derived" / "poses_lidar.txt")


def write_scans_and_poses(folder: Path) -> None:
    folder.mkdir(parents=True)
    for k in range(SCANS):
        scan(k)[0].tofile(folder / f"{k:06}.bin")
    write_lidar_poses(folder / "derived" / "poses_lidar.txt")


def write_semantic_kitti(folder: Path) -> None:
    """Write a data set of one sequence, with poses of the camera as KITTI's odometry has them."""
    sequence = folder / "sequences" / "07"
    for name in ("velodyne", "labels"):
        (sequence / name).mkdir(parents=True)
    rows = []
    for k in range(SCANS):
        points, names = scan(k)
        points.tofile(sequence / "velodyne" / f"{k:06}.bin")
        numbers = np.array([CLASSES[name] for name in names], "<u4")
        instances = np.where(np.isin(names, ["car", "moving-car"]), 7, 0).astype("<u4")
        (numbers | instances << 16).tofile(sequence / "labels" / f"{k:06}.label")
        T = T_CAMERA @ np.linalg.inv(on_map(0)) @ on_map(k) @ np.linalg.inv(T_CAMERA)
        rows.append(" ".join(map(repr, T[:3].ravel().tolist())))
    (sequence / "poses.txt").write_text("\n".join(rows) + "\n")
    (sequence / "times.txt").write_text("".join(f"{0.1 * k:e}\n" for k in range(SCANS)))
    write_calibration(sequence / "calib.txt", "Tr", rectify=False)


T_EGO_LIDAR = np.array([[0, 1, 0, 0.9], [-1, 0, 0, 0], [0, 0, 1, HEIGHT], [0, 0, 0, 1.0]])
FROM_FLU = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])  # to x right, y forward, z up


def write_nuscenes_points(path: Path, k: int) -> None:
    points = scan(k)[0]
    rows = np.column_stack([points[:, :3] @ FROM_FLU.T, 255 * points[:, 3], np.zeros(len(points))])
    path.parent.mkdir(parents=True, exist_ok=True)
    rows.astype(np.float32).tofile(path)


def ego(k: int) -> np.ndarray:
    """Return T_map_vehicle of nuScenes at scan k."""
    T = np.eye(4)
    T[:3, :3] = FROM_FLU
    return on_map(k) @ np.linalg.inv(T) @ np.linalg.inv(T_EGO_LIDAR)


def write_nuscenes(folder: Path, version: str = "v1.0-mini") -> None:
    tables: dict[str, list[dict]] = {
        "scene": [{"token": "s", "name": "scene-0001"}],
        "sensor": [{"token": "lidar", "channel": "LIDAR_TOP"}, {"token": "camera", "channel": "CAM_FRONT"}],
        "calibrated_sensor": [
            {
                "token": one,
                "sensor_token": one,
                "translation": T_EGO_LIDAR[:3, 3].tolist(),
                "rotation": quaternion(T_EGO_LIDAR),
            }
            for one in ("lidar", "camera")
        ],
        "category": [{"token": "c", "name": "vehicle.car"}],
        "instance": [{"token": name, "category_token": "c"} for name in ("parked", "driving")],
        **{name: [] for name in ("sample", "sample_data", "ego_pose", "sample_annotation")},
    }
    for k in range(SCANS):
        sample, pose = f"sample {k}", f"pose {k}"
        tables["sample"].append({"token": sample, "scene_token": "s", "timestamp": 10**15 + 100_000 * k})
        T = ego(k)
        tables["ego_pose"].append({"token": pose, "translation": T[:3, 3].tolist(), "rotation": quaternion(T)})
        for sensor, key_frame in (("lidar", True), ("camera", True), ("lidar", False)):
            name = f"samples/LIDAR_TOP/n__LIDAR_TOP__{10**15 + 100_000 * k}.pcd.bin"
            row = {
                "token": f"{k} {sensor} {key_frame}", "sample_token": sample, "ego_pose_token": pose,
                "calibrated_sensor_token": sensor, "timestamp": 10**15 + 100_000 * k, "is_key_frame": key_frame,
                "filename": name if sensor == "lidar" else "samples/CAM_FRONT/x.jpg",
            }  # fmt: skip
            tables["sample_data"].append(row)
        write_nuscenes_points(folder / name, k)
        for name, box in zip(("parked", "driving"), boxes(k), strict=True):
            placed, turned = on_map(k), np.eye(4)
            turned[:2, :2] = [[np.cos(box[2]), -np.sin(box[2])], [np.sin(box[2]), np.cos(box[2])]]
            middle = placed @ [box[0], box[1], (box[5] + box[6]) / 2, 1]
            tables["sample_annotation"].append(
                {
                    "token": f"{k} {name}", "sample_token": sample, "instance_token": name,
                    "translation": middle[:3].tolist(), "size": [box[4], box[3], box[6] - box[5]],
                    "rotation": quaternion(placed @ turned),
                }
            )  # fmt: skip
    (folder / version).mkdir(parents=True)
    for name, rows in tables.items():
        (folder / version / f"{name}.json").write_text(json.dumps(rows))


def write_mmdet3d(folder: Path) -> None:
    folder.mkdir(parents=True)
    entries = []
    for k in range(SCANS):
        name = f"n__LIDAR_TOP__{10**15 + 100_000 * k}.pcd.bin"
        write_nuscenes_points(folder / name, k)
        instances = []
        for box in boxes(k):
            x, y, z = FROM_FLU @ [box[0], box[1], (box[5] + box[6]) / 2]
            sizes = [box[3], box[4], box[6] - box[5]]
            instances.append({"bbox_3d": [x, y, z, *sizes, box[2] + np.pi / 2], "bbox_label_3d": 0})
        entries.append(
            {
                "timestamp": 1e9 + 0.1 * k,
                "ego2global": ego(k).tolist(),
                "lidar_points": {"lidar_path": name, "lidar2ego": T_EGO_LIDAR.tolist()},
                "instances": instances,
            }
        )
    about = {"dataset": "nuscenes", "categories": {"car": 0}, "info_version": "1.1"}
    (folder / "infos.json").write_text(json.dumps({"metainfo": about, "data_list": entries}))


UP = np.array([1.35, 0.0, 1.5])  # Argoverse 2's upper lidar in the vehicle's frame


def write_argoverse2(folder: Path) -> None:
    import pyarrow as pa
    import pyarrow.feather

    def write(name: str, columns: dict) -> None:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        pyarrow.feather.write_feather(pa.table(columns), path)

    shift = np.eye(4)
    shift[:3, 3] = UP
    stamps = [315_000_000_000_000_000 + 100_000_000 * k for k in range(SCANS)]
    notes: dict[str, list] = {"timestamp_ns": [], "track_uuid": [], "category": []}
    poses: dict[str, list] = {"timestamp_ns": stamps}
    rows: list[list[float]] = []
    for k, stamp in enumerate(stamps):
        points = scan(k)[0]
        both = np.concatenate([points, points[:50]])  # the lower lidar's returns come last
        ring = np.r_[np.zeros(len(points), np.uint8), np.full(50, 40, np.uint8)]
        xyz = (both[:, :3] + UP.astype(np.float32)).T
        write(
            f"sensors/lidar/{stamp}.feather",
            {
                **dict(zip("xyz", xyz, strict=True)),
                "intensity": np.full(len(both), 128, np.uint8),
                "laser_number": ring,
                "offset_ns": np.zeros(len(both), np.int32),
            },
        )
        T = on_map(k) @ np.linalg.inv(shift)
        w, x, y, z = quaternion(T)
        for name, value in zip(("qw", "qx", "qy", "qz"), (w, x, y, z), strict=True):
            poses.setdefault(name, []).append(value)
        for name, value in zip(("tx_m", "ty_m", "tz_m"), T[:3, 3], strict=True):
            poses.setdefault(name, []).append(float(value))
        for name, box in zip(("parked", "driving"), boxes(k), strict=True):
            notes["timestamp_ns"].append(stamp)
            notes["track_uuid"].append(name)
            notes["category"].append("REGULAR_VEHICLE")
            middle = np.array([box[0], box[1], (box[5] + box[6]) / 2]) + UP
            half = box[2] / 2
            rows.append([*box[3:5], box[6] - box[5], np.cos(half), 0, 0, np.sin(half), *middle])
    names = ("length_m", "width_m", "height_m", "qw", "qx", "qy", "qz", "tx_m", "ty_m", "tz_m")
    write("annotations.feather", {**notes, **dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))})
    write("city_SE3_egovehicle.feather", poses)
    write(
        "calibration/egovehicle_SE3_sensor.feather",
        {
            "sensor_name": ["up_lidar", "down_lidar"],
            **{name: [float(v), float(v)] for name, v in zip(("tx_m", "ty_m", "tz_m"), UP, strict=True)},
        },
    )
    corners = [[-20, -6], [20, -6], [20, 6], [-20, 6]]  # drivable, on the street
    way = on_map(0) @ np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -HEIGHT], [0, 0, 0, 1.0]])
    outline = [dict(zip("xyz", (way @ [x, y, 0, 1])[:3].tolist(), strict=True)) for x, y in corners]
    (folder / "map").mkdir()
    areas = {"drivable_areas": {"1": {"area_boundary": outline, "id": 1}}}
    (folder / "map" / "log_map_archive_x.json").write_text(json.dumps(areas))
    np.save(folder / "map" / "x_ground_height_surface_y.npy", np.zeros((400, 400), np.float32))
    place = {"R": [1.0, 0.0, 0.0, 1.0], "t": [-40.0, 10.0], "s": 10 / 3}  # 120 m from (40, -10) on
    (folder / "map" / "x___img_Sim2_city.json").write_text(json.dumps(place))


def write_sustech(folder: Path) -> None:
    """Write it with the axes of SUSTechPOINTS' example: forward is -y, left is +x."""
    for name in ("lidar", "label", "derived"):
        (folder / name).mkdir(parents=True)
    turn = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1.0]])  # from forward, left, up
    rows = []
    for k in range(SCANS):
        points = scan(k)[0]
        points[:, :3] = points[:, :3] @ turn.T
        points.tofile(folder / "lidar" / f"{k:06}.bin")
        notes = []
        for name, box in zip(("parked", "driving"), boxes(k), strict=True):
            place = dict(zip("xyz", (turn @ [box[0], box[1], (box[5] + box[6]) / 2]).tolist(), strict=True))
            psr = {
                "position": place,
                "scale": {"x": box[3], "y": box[4], "z": box[6] - box[5]},
                "rotation": {"x": 0, "y": 0, "z": box[2] - np.pi / 2},
            }
            notes.append({"psr": psr, "obj_type": "Car", "obj_id": name})
        (folder / "label" / f"{k:06}.json").write_text(json.dumps(notes))
        whole = np.eye(4)
        whole[:3, :3] = turn
        rows.append(f"{k} " + " ".join(map(repr, (whole @ on_map(k) @ whole.T)[:3].ravel().tolist())))
    (folder / "derived" / "poses_lidar.txt").write_text("\n".join(rows) + "\n")


WRITERS: dict[str, Callable[[Path], None]] = {
    "kitti object": write_kitti_object, "kitti tracking": write_kitti_tracking, "kitti raw": write_kitti_raw,
    "scans and poses": write_scans_and_poses, "semantic kitti": write_semantic_kitti, "nuscenes": write_nuscenes,
    "mmdet3d": write_mmdet3d, "argoverse 2": write_argoverse2, "sustech": write_sustech,
}  # fmt: skip


@pytest.fixture(scope="session")
def written(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return the folder of the street, written as one of `WRITERS`; it must not be changed."""
    folder = tmp_path_factory.mktemp("street")

    def find(name: str) -> Path:
        path = folder / name / "data"
        if not path.exists():
            path.parent.mkdir()
            WRITERS[name](path)
        return path

    return find


@pytest.fixture
def fresh(tmp_path: Path) -> Callable[[str], Path]:
    """Return a folder of the street that a test may damage."""

    def make(name: str, folder: Path = tmp_path) -> Path:
        (folder / "day").mkdir()
        WRITERS[name](folder / "day" / "data")
        return folder / "day" / "data"

    return make


@pytest.fixture
def street() -> tuple[Callable, Callable, Callable]:
    """Return scan(k), boxes(k) and on_map(k) of the street."""
    return scan, boxes, on_map
