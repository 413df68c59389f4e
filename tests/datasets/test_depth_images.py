"""Depth images in logs and in folders: cameras, axes, scales and poses."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import each, needs, refused
from PIL import Image
from rooms import CAMERA, TABLE, depths, image_message, info_message, looking

from ogm.datasets import SensorSetup, open_dataset
from ogm.io.depth import T_OPTICAL_BODY
from ogm.io.logs import LogWriter
from ogm.io.messages import StampedTransform, tf_message
from ogm.pose import inverse, pose, transform_points

needs("rosbags", "mcap")
IMAGE, INFO, TF = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"
PACKED, PACKED_IMAGE = "/depth/image/compressedDepth", "sensor_msgs/msg/CompressedImage"
FRAME = "camera_optical_frame"
T_BODY_OPTICAL = inverse(T_OPTICAL_BODY)
T_BASE_CAMERA = pose(0.1, 0.0, 0.8) @ pose(pitch=np.radians(12))


def write(
    path: Path, encoding: str = "16UC1", *, frame: str = FRAME, rotation: np.ndarray = T_BODY_OPTICAL, **left_out: bool
) -> Path:
    """Write three depth images of a robot that moves towards a table, and the transforms of its camera."""
    ros1 = path.suffix == ".bag"
    with LogWriter(path) as log:
        for k in range(3):
            stamp, T = 100 + k / 8, pose(0.2 * k, 0.1)
            depth = depths(T @ T_BASE_CAMERA, TABLE)
            topic, kind = (PACKED, PACKED_IMAGE) if "compressed" in encoding else ("/depth/image", IMAGE)
            log.write(topic, kind, image_message(depth, encoding, frame, stamp), stamp)
            log.write("/colour/image", IMAGE, image_message(depth, "rgb8", "colour_optical_frame", stamp), stamp)
            if "info" not in left_out:
                log.write("/depth/camera_info", INFO, info_message(frame, stamp, ros1), stamp)
            if "tf" not in left_out:
                moving = StampedTransform("odom", "base_link", stamp, T)
                mounted = StampedTransform("base_link", frame, stamp, T_BASE_CAMERA @ rotation)
                log.write("/tf", TF, tf_message([moving]), stamp)
                log.write("/tf_static", TF, tf_message([mounted]), stamp)
    return path


def room_points(dataset: Any, n: int) -> np.ndarray:
    """Return the points of a frame in the room: the map of its poses lies there."""
    return transform_points(dataset[n].T_map_sensor, dataset[n].scan.points)[:, :3]


def in_room(points: np.ndarray) -> bool:
    """Return whether the points lie on the walls and the table of the room, within the millimetres of the pixels."""
    x, y, z = points.T
    walls = np.minimum.reduce([abs(x - 5), abs(y - 3), abs(y + 3), abs(z), abs(z - 2.6)]) < 0.01
    table = (x > 1.98) & (x < 3.02) & (abs(y) < 0.62) & (z < 0.76)
    return bool((walls | table).all())


@each(
    "name, encoding",
    [("a.mcap", "16UC1"), ("a.db3", "32FC1"), ("a.bag", "16UC1"), ("b.mcap", "16UC1; compressedDepth png")],
)
def test_a_log_with_depth_images_is_a_drive(name: str, encoding: str, tmp_path: Path) -> None:
    dataset = open_dataset(write(tmp_path / name, encoding), sensor_height=0.8)
    assert dataset.facts["topics"] == [PACKED if "compressed" in encoding else "/depth/image"]
    assert all(in_room(room_points(dataset, n)) for n in range(3))
    assert dataset[0].scan.kind == "depth"
    assert dataset[0].mount.ego_footprint == (0, 0, 0, 0)
    assert not dataset.recording.frame_notes


@each(
    "frame, rotation, note",
    [
        ("camera", np.eye(4), "z axis points up: it is taken for the camera body"),
        ("camera", T_BODY_OPTICAL, ""),
        (FRAME, np.eye(4), "the camera would look up; the rotation to optical axes"),
    ],
)
def test_wrong_frames_are_told(frame: str, rotation: np.ndarray, note: str, tmp_path: Path) -> None:
    dataset = open_dataset(write(tmp_path / "a.mcap", frame=frame, rotation=rotation), sensor_height=0.8)
    assert in_room(room_points(dataset, 0)) == (frame == "camera")
    assert note in "".join(text for text, _ in dataset.recording.frame_notes)


def test_a_vehicle_file_states_the_place_of_the_body(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", tf=False)
    setup = SensorSetup("/depth/image", 0.8, (0.1, 0.0, 0.8, 0.0, np.radians(12), 0.0))
    frame = open_dataset(path, setups=setup)[0]
    assert in_room(transform_points(frame.mount.T_vehicle_points, frame.scan.points)[:, :3] + [0.1, 0.1, 0])
    notes = open_dataset(path, sensor_height=0.8).recording.frame_notes
    assert not notes  # the frame is called optical


@each(
    "match, options",
    [
        ("camera of /depth/image is not known; wanted .*CameraInfo on /depth/camera_info", {"info": False}),
        ("only depth images are scans", {"encoding": "8UC1"}),
    ],
)
def test_a_log_without_camera_or_depths_is_refused(match: str, options: dict[str, Any], tmp_path: Path) -> None:
    refused(match, open_dataset, write(tmp_path / "a.mcap", **options))


def test_a_colour_topic_is_refused(tmp_path: Path) -> None:
    refused(
        "/colour/image .*encoding rgb8, wanted scans", open_dataset, write(tmp_path / "a.mcap"), topic="/colour/image"
    )


def folder(path: Path, images: dict[str, np.ndarray], intrinsics: bool = True) -> Path:
    path.mkdir(exist_ok=True)
    for name, pixels in images.items():
        Image.fromarray(pixels).save(path / name)
    if intrinsics:
        matrix = [CAMERA.fx, 0, 0, 0, CAMERA.fy, 0, CAMERA.cx, CAMERA.cy, 1]
        text = json.dumps({"width": CAMERA.width, "height": CAMERA.height, "intrinsic_matrix": matrix})
        (path / "camera.json").write_text(text)
    return path


def millimetres(k: int = 0) -> np.ndarray:
    return (depths(looking(0.8, 12), TABLE) * 1000 + k).round().astype(np.uint16)


def rotated(pixels: np.ndarray) -> np.ndarray:
    return pixels << 3 | pixels >> 13


@each(
    "pixels, scale, said",
    [
        (millimetres(), None, "1000 at 1 m, millimetres assumed, which gives a median of"),
        (millimetres() * 5, None, "5000 at 1 m, fifths of millimetres"),
        (rotated(millimetres()), None, "bits rotated by 3"),
        (millimetres() // 4, 250.0, "250 at 1 m, given"),
    ],
)
def test_a_folder_of_pngs_is_a_drive(pixels: np.ndarray, scale: float | None, said: str, tmp_path: Path) -> None:
    path = folder(tmp_path, {"depth_0.png": pixels, "depth_1.png": pixels, "other.png": pixels})
    rows = "1 0 0 0\n0 1 0 0\n0 0 1 {}\n0 0 0 1\n"
    (path / "odometry.log").write_text("".join(f"{k} {k} {k + 1}\n" + rows.format(0.5 * k) for k in range(2)))
    dataset = open_dataset(path, sensor_height=0.8, setups=SensorSetup(depth_scale=scale))
    assert said in dataset.facts["depth_scale"]
    assert "1 images with other names" in dataset.recording.warnings[0]
    points = transform_points(looking(0.8, 12), dataset[1].scan.points)[:, :3]
    assert in_room(points) or scale
    np.testing.assert_allclose(dataset[1].T_map_sensor, pose(0.5), atol=1e-9)  # forward is z of the camera


@each(
    "match, images, intrinsics",
    [
        ("0 files with camera intrinsics", {"a.png": millimetres()}, False),
        ("half of them are beyond 10 m: give --depth-scale", {"a.png": millimetres() * 7}, True),
        ("in steps of 5, or fifths of millimetres", {"a.png": millimetres() // 5 * 5}, True),
        ("in steps of 8, or values of SUN RGB-D", {"a.png": millimetres() // 8 * 8}, True),
        ("raw disparities of a Kinect", {"a.pgm": millimetres()}, True),
    ],
)
def test_a_scale_is_known_or_refused(match: str, images: dict[str, Any], intrinsics: bool, tmp_path: Path) -> None:
    refused(match, open_dataset, folder(tmp_path, images, intrinsics))


def test_recorded_images_of_three_conventions(real: Callable[[str], Path]) -> None:
    path = real("depth_redwood")
    assert len(open_dataset(path)) == 5
    depths_of = [open_dataset(path / name)[0].scan.points[:, 0] for name in ("TUM_depth.png", "SUN_depth.png")]
    assert [round(float(np.median(one)), 1) for one in depths_of] == [2.4, 2.7]
    refused("raw disparities", open_dataset, path / "NYU_depth.pgm.xz")


def test_a_capture_of_an_ouster_states_what_is_missing(tmp_path: Path, real: Callable[[str], Path]) -> None:
    capture = real("ouster_bsd3/OS-1-32-*.pcap")
    (tmp_path / "a.pcap").symlink_to(capture)
    refused("packets of an Ouster.*wanted a.json next to it", open_dataset, tmp_path / "a.pcap")
    try:
        import ouster.sdk  # noqa: F401
    except ImportError:
        refused("cannot be read: ouster is not installed: ", open_dataset, capture, error=ImportError)


def test_captures_of_ousters_are_drives(real: Callable[[str], Path]) -> None:
    pytest.importorskip("ouster.sdk")
    packets, frames = (open_dataset(real(f"ouster_bsd3/OS-1-128*.{ending}")) for ending in ("pcap", "osf"))
    assert len(packets) == len(frames) == 3
    scan, same = packets[0].scan, frames[0].scan
    np.testing.assert_array_equal(scan.points, same.points)
    assert scan.ring is not None
    assert scan.time is not None
    assert scan.no_returns is not None
    assert len(scan) + len(scan.no_returns) == 128 * 1024
    np.testing.assert_allclose(np.linalg.norm(scan.no_returns, axis=1), 1, atol=1e-5)
    assert (scan.time.min(), round(float(scan.time.max()), 2)) == (0, 0.1)
    assert packets[2].T_map_sensor[0, 3] == pytest.approx(0.498, abs=1e-3)
    assert 1.5 < packets[0].mount.sensor_height < 2.5
