"""Logs as data sets: scans by the stamps of their headers, poses by transforms or odometry, one lidar or several."""

import copy
import pickle
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cases import each, refused
from typer.testing import CliRunner

from ogm.cli import app
from ogm.datasets import Dataset, open_dataset, with_odometry, with_poses
from ogm.datasets.log_scans import LogScans
from ogm.fusion import covering_window, fuse, make_mapper
from ogm.geometric import RayISM
from ogm.grid import EvidentialGrid, GridSpec
from ogm.io import read_scan, write_poses
from ogm.io.logs import LogWriter
from ogm.io.logs.definitions import RandomAccess
from ogm.io.messages import StampedTransform, point_cloud2, tf_message
from ogm.io.messages.plain import ros_stamp
from ogm.pose import Trajectory, inverse, pose, transform_points
from ogm.scan import Scan
from ogm.storage.files import OgmError

CLOUD, TF, ODOMETRY = "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage", "nav_msgs/msg/Odometry"

START, STEP, FRAMES = 1_700_000_000.0, 1 / 8, 5  # [s]: multiples of 2**-4, which stamps hold exactly
STAMPS = START + STEP * np.arange(FRAMES)
HEIGHT, WALL = 1.7, 12.0  # [m]
MAP_BASE = np.array([pose(0.5 * k, 0.1 * k, yaw=0.03 * k) for k in range(FRAMES)])
T_BASE_LIDAR = pose(0.8, -0.1, 1.2, roll=0.01, pitch=0.05, yaw=0.4)  # base_link is 0.5 m above ground
SPEC = GridSpec.centered(24, 16, 0.5)

Row = tuple[str, str, Any, float]


def world() -> np.ndarray:
    """Ground, and a wall across the way; x, y, z on the map, whose z is that of base_link."""
    rng = np.random.default_rng(0)
    ground, wall = rng.uniform(-20, 20, (20_000, 4)), rng.uniform(-12, 12, (4000, 4))
    ground[:, 0] = np.minimum(ground[:, 0], WALL)
    ground[:, 2], wall[:, 0] = 1.2 - HEIGHT, WALL
    wall[:, 2] = rng.uniform(1.2 - HEIGHT, 1.2, len(wall))
    points = np.concatenate([ground, wall])
    points[:, 3] = rng.uniform(0, 1, len(points))
    return points


def seen_from(T_map_sensor: np.ndarray) -> Scan:
    return Scan(transform_points(inverse(T_map_sensor), world()).astype(np.float32))


def cloud(T: np.ndarray, stamp: float, frame: str = "lidar", topic: str = "/points", late: float = 0.3) -> Row:
    """Return what a sensor at a place sees, recorded some time later."""
    return topic, CLOUD, point_cloud2(seen_from(T), frame_id=frame, stamp=stamp), stamp + late


def moved(parent: str, child: str, stamp: float, T: np.ndarray, late: float = 0.5) -> Row:
    return "/tf", TF, tf_message([StampedTransform(parent, child, stamp, T)]), stamp + late


def moves(child: str, parent: str = "map") -> list[Row]:
    return [moved(parent, child, stamp, T) for stamp, T in zip(STAMPS, MAP_BASE, strict=True)]


def fixed(parent: str, child: str, T: np.ndarray) -> Row:
    return "/tf_static", TF, tf_message([StampedTransform(parent, child, 0.0, T)]), START


def odometry(stamp: float, T: np.ndarray, child: str = "base_link") -> Row:
    (placed,) = tf_message([StampedTransform("odom", "base_link", stamp, T)]).transforms
    x = placed.transform
    position = SimpleNamespace(**vars(x.translation))
    zero = SimpleNamespace(x=0.0, y=0.0, z=0.0)
    message = SimpleNamespace(
        header=SimpleNamespace(seq=0, stamp=ros_stamp(stamp), frame_id="odom"),
        child_frame_id=child,
        pose=SimpleNamespace(pose=SimpleNamespace(position=position, orientation=x.rotation), covariance=np.zeros(36)),
        twist=SimpleNamespace(twist=SimpleNamespace(linear=zero, angular=zero), covariance=np.zeros(36)),
    )
    return "/odom", ODOMETRY, message, stamp


def drive() -> list[Row]:
    """One lidar that is mounted askew; its transforms are recorded after the scans that need them."""
    clouds = [cloud(T @ T_BASE_LIDAR, stamp) for stamp, T in zip(STAMPS, MAP_BASE, strict=True)]
    return [fixed("base_link", "lidar", T_BASE_LIDAR), *clouds, *moves("base_link")]


@pytest.fixture
def log(tmp_path: Path) -> Callable[..., Path]:
    """Give a function that writes messages to a log, in the order of their log times."""

    def write(rows: Iterable[Row], name: str = "drive.mcap", compression: str = "") -> Path:
        with LogWriter(tmp_path / name, compression) as writer:
            for row in sorted(rows, key=lambda row: row[3]):
                writer.write(*row)
        return tmp_path / name

    return write


def on_map(dataset: Dataset, n: int) -> np.ndarray:
    frame = dataset[n]
    assert frame.T_map_sensor is not None
    return transform_points(frame.T_map_sensor, frame.scan.points.astype(np.float64))


# --- One lidar ---------------------------------------------------------------------------------------


@each("name", ["drive.mcap", "drive.db3", "drive.bag"])
def test_points_come_back_to_their_places_on_the_map(log: Callable[..., Path], name: str) -> None:
    dataset = open_dataset(log(drive(), name))
    assert [frame.stamp for frame in dataset] == STAMPS.tolist()  # of the headers, not of the log
    assert [frame.name for frame in dataset] == [f"{int(stamp * 16) * 10**9 // 16}" for stamp in STAMPS]
    assert {frame.sequence for frame in dataset} == {"drive"}
    for n in range(FRAMES):
        assert np.abs(on_map(dataset, n) - world()).max() < 1e-4
        assert dataset[n].scan.stamp == STAMPS[n]
    assert dataset.facts["frame"] == "map"
    assert dataset.facts["poses"] == "5 of 5 scans, by transforms (map <- base_link <- lidar)"


def test_points_are_turned_to_the_axes_of_the_vehicle(log: Callable[..., Path]) -> None:
    """So that the wall stands across the way, the ground is level, and its height is found."""
    dataset = open_dataset(log(drive()))
    frame = dataset[0]
    level = frame.scan.points[frame.scan.points[:, 0] < 5, 2]
    assert np.ptp(level) < 1e-5
    assert frame.mount.sensor_height == pytest.approx(HEIGHT, abs=1e-3)
    assert np.array_equal(frame.mount.T_vehicle_sensor, pose(z=frame.mount.sensor_height))
    assert np.allclose(frame.T_map_sensor[:3, :3], np.eye(3), atol=1e-12)
    refused("state the axes", open_dataset, log(drive()), axes="nuscenes")


def test_without_base_link_points_have_their_own_axes(log: Callable[..., Path]) -> None:
    path = log([*(cloud(T, stamp) for stamp, T in zip(STAMPS, MAP_BASE, strict=True)), *moves("lidar", "world")])
    assert np.array_equal(open_dataset(path)[1].scan.points, seen_from(MAP_BASE[1]).points)
    turned = open_dataset(path, axes=("+y", "-x", "+z"))
    assert np.array_equal(turned[1].scan.points[:, 0], seen_from(MAP_BASE[1]).points[:, 1])
    assert np.abs(on_map(turned, 1) - world()).max() < 1e-4


def test_the_stamps_of_headers_give_the_order(log: Callable[..., Path]) -> None:
    rows = [cloud(T, stamp, late=0.3 + k % 2) for k, (stamp, T) in enumerate(zip(STAMPS, MAP_BASE, strict=True))]
    assert [frame.stamp for frame in open_dataset(log(rows))] == STAMPS.tolist()


def test_poses_are_interpolated_and_not_extrapolated(log: Callable[..., Path]) -> None:
    rows = [fixed("base_link", "lidar", np.eye(4))]
    rows += [cloud(pose(k), stamp) for k, stamp in enumerate(STAMPS)]
    rows += [moved("map", "base_link", stamp, pose(8 * (stamp - START))) for stamp in (START + 0.0625, START + 0.4375)]
    dataset = open_dataset(log(rows))
    known = [frame.T_map_sensor is not None for frame in dataset]
    assert known == [False, True, True, True, False]
    assert [frame.T_map_sensor[0, 3] for frame in dataset[1:4]] == pytest.approx([1, 2, 3])
    assert dataset.facts["poses"].startswith("3 of 5 scans, by transforms")
    assert "2 of /points: the transform from base_link to map needs extrapolation by 0.0625 s" in dataset.facts["poses"]


@each("wanted, x", [(None, 7.0), ("odom", 2.0), ("/map", 7.0), ("earth", 107.0)])
def test_the_fixed_frame_is_map_unless_another_is_wanted(
    log: Callable[..., Path], wanted: str | None, x: float
) -> None:
    rows = [fixed("earth", "map", pose(100.0)), fixed("base_link", "lidar", np.eye(4)), cloud(np.eye(4), START)]
    for stamp in (START - 1, START + 1):
        rows += [moved("map", "odom", stamp, pose(5.0)), moved("odom", "base_link", stamp, pose(2.0))]
    (frame,) = open_dataset(log(rows), frame=wanted)
    assert frame.T_map_sensor[0, 3] == pytest.approx(x)


def test_the_root_is_the_fixed_frame_where_none_has_a_known_name(log: Callable[..., Path]) -> None:
    rows = [cloud(np.eye(4), START), *(moved("hall", "lidar", t, pose(3.0)) for t in (START - 1, START + 1))]
    dataset = open_dataset(log(rows))
    assert dataset.facts["frame"] == "hall"
    with pytest.raises(OgmError, match=r"`frame` moon cannot be used: there is no frame 'moon'; known frames are hall"):
        open_dataset(log(rows), frame="moon")


def test_odometry_serves_where_transforms_do_not(log: Callable[..., Path]) -> None:
    rows = [fixed("base_link", "lidar", T_BASE_LIDAR)]
    rows += [cloud(T @ T_BASE_LIDAR, stamp) for stamp, T in zip(STAMPS, MAP_BASE, strict=True)]
    rows += [odometry(STAMPS[k], MAP_BASE[k], ("base_link", "")[k % 2]) for k in range(FRAMES)]
    dataset = open_dataset(log(rows))
    assert np.abs(on_map(dataset, 4) - world()).max() < 1e-4
    assert dataset.facts["poses"] == "5 of 5 scans, by odometry (/odom) (odom <- base_link <- lidar)"
    both = [*rows, *moves("base_link")]
    assert open_dataset(log(both)).facts["frame"] == "map"
    assert open_dataset(log(both), frame="odom").facts["frame"] == "odom"


@each("rows, missing", [
        ([], "no transforms (/tf, /tf_static) and no odometry"),
        ([fixed("base_link", "lidar", np.eye(4))], "one from a fixed frame (map, odom, world) to base_link is missing"),
        (
            [moved("base_link", "lidar", START + k, np.eye(4)) for k in (-1, 1)],
            "one from a fixed frame (map, odom, world) to base_link is missing",
        ),
        ([moved("map", "base_link", START, np.eye(4))], "no transform leads to lidar, the frame of /points; there are"),
        ([odometry(START, np.eye(4))], "no transform leads to lidar, the frame of /points; there are odom, base_link"),
    ])  # fmt: skip
def test_without_poses_the_missing_transform_is_named(
    log: Callable[..., Path], rows: list[Row], missing: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = log([*rows, cloud(np.eye(4), START), cloud(np.eye(4), START + STEP)])
    dataset = open_dataset(path)
    assert all(frame.T_map_sensor is None for frame in dataset)
    assert missing in dataset.facts["poses"]
    with pytest.raises(SystemExit) as stop:
        app(["fuse", str(path), "--sensor-height", "1.7"])
    assert stop.value.code == 2
    words = " ".join(capsys.readouterr().err.split())
    assert missing in words
    assert "--odometry kiss-icp" in words


def test_a_static_map_counts_where_it_is_wanted(log: Callable[..., Path]) -> None:
    path = log([fixed("map", "lidar", pose(4.0)), cloud(np.eye(4), START)])
    assert open_dataset(path)[0].T_map_sensor is None
    assert open_dataset(path, frame="map")[0].T_map_sensor[0, 3] == 4.0


def test_heights_of_base_footprint_are_taken_as_they_are(log: Callable[..., Path]) -> None:
    """Also those of small robots, which an estimate may not have."""
    low = pose(0.2, 0, 0.1)
    rows = [*drive(), fixed("base_footprint", "base_link", pose(z=0.2))]
    rows[0] = fixed("base_link", "lidar", low)
    path = log(rows)
    assert open_dataset(path)[0].mount.sensor_height == pytest.approx(0.3)
    assert open_dataset(path, sensor_height=0.4)[0].mount.sensor_height == 0.4


def test_points_in_the_vehicle_frame_need_the_sensor_position(log: Callable[..., Path]) -> None:
    rows = [cloud(T, stamp, "base_link") for stamp, T in zip(STAMPS, MAP_BASE, strict=True)]
    dataset = open_dataset(log([*rows, *moves("base_link")]), sensor_position=(0.8, 0.0, 1.2))
    frame = dataset[2]
    assert frame.mount.points_in == "vehicle"
    assert frame.mount.sensor_height == pytest.approx(HEIGHT, abs=1e-3)
    assert np.allclose(frame.T_map_sensor, MAP_BASE[2] @ pose(0.8, 0.0, 1.2))
    assert np.abs(transform_points(MAP_BASE[2], frame.scan.points.astype(float)) - world()).max() < 1e-4


def test_headers_without_stamps_are_reported(log: Callable[..., Path]) -> None:
    scan = point_cloud2(seen_from(np.eye(4)), frame_id="lidar", stamp=0.0)
    rows = [("/points", CLOUD, scan, START + k) for k in (0, 1)]
    dataset = open_dataset(log(rows))
    assert [frame.stamp for frame in dataset] == [None, None]
    assert len({frame.name for frame in dataset}) == 2
    assert "2 headers have no stamp" in dataset.facts["poses"]


# --- Topics ------------------------------------------------------------------------------------------


def test_topics_are_listed_where_one_must_be_chosen(log: Callable[..., Path]) -> None:
    clouds = [cloud(np.eye(4), START, topic=topic) for topic in ("/front", "/rear")]
    two = log([*clouds, odometry(START, np.eye(4))])
    refused(r"several topics with scans, /front \(sens.*\), /rear .*`topic`", open_dataset, two, error=OgmError)
    assert len(open_dataset(two, topic="/rear")) == 1
    with pytest.raises(OgmError, match=r"has no topic /side; topics with scans are /front .*/odom"):
        open_dataset(two, topic="/side")
    with pytest.raises(OgmError, match="topic /odom of .* has 1 messages of nav_msgs/msg/Odometry"):
        open_dataset(two, topic="/odom")
    with pytest.raises(OgmError, match=r"has no scans .* its topics are /odom \(nav_msgs"):
        open_dataset(log([odometry(START, np.eye(4))], "odometry.mcap"))


@each("topic, kind, way", [
        ("/front/nebula_packets", "nebula_msgs/msg/NebulaPackets", "/front/nebula_packets: packets are not decoded"),
        ("/radar/nebula_packets", "nebula_msgs/msg/NebulaPackets", "radars are mapped by radar_msgs/msg/RadarScan, "),
        ("/front", "ars408_msgs/msg/ObjectList", "/front: radars are mapped by radar_msgs/msg/RadarScan, "),
        ("/odom", "nav_msgs/msg/Odometry", ""),
    ])  # fmt: skip
def test_radars_and_packets_that_are_not_read_are_refused_with_what_is(topic: str, kind: str, way: str) -> None:
    logged: Any = SimpleNamespace(
        paths=[Path("a.mcap")], topics={topic: SimpleNamespace(type=kind, count=2)}, warnings=[]
    )
    text = refused("a.mcap has no scans", LogScans, logged, error=OgmError)
    assert way in text if way else text.endswith("(nav_msgs/msg/Odometry)")
    assert (f". {topic}: " in refused("wanted scans", LogScans, logged, topic, error=OgmError)) == bool(way)


def test_topic_and_frame_are_for_logs(tmp_path: Path, log: Callable[..., Path]) -> None:
    seen_from(np.eye(4)).points.tofile(tmp_path / "000.bin")
    log(drive())  # in a folder of scans, which is no log for that
    assert len(open_dataset(tmp_path)) == 1
    for options in ({"topic": "/points"}, {"frame": "map"}):
        refused("`topic` and `frame` are for logs", open_dataset, tmp_path, **options)


# --- Several lidars ----------------------------------------------------------------------------------

FRONT, REAR = pose(3.0, 0.5, 0.2, yaw=0.3), pose(-1.0, 0.0, 1.2, yaw=np.pi, pitch=0.1)


def two_lidars() -> list[Row]:
    rows = [fixed("base_link", "front", FRONT), fixed("base_link", "rear", REAR)]
    for stamp, T in zip(STAMPS, MAP_BASE, strict=True):
        rows += [cloud(T @ FRONT, stamp, "front", "/front/points"), cloud(T @ REAR, stamp, "rear", "/rear/points")]
        rows.append(moved("map", "base_link", stamp, T))
    return rows


def test_several_lidars_have_their_own_mounts_and_origins(log: Callable[..., Path]) -> None:
    dataset = open_dataset(log(two_lidars()), topic=["/front/points", "/rear/points"])
    assert len(dataset) == 2 * FRAMES
    assert [frame.stamp for frame in dataset] == np.repeat(STAMPS, 2).tolist()
    assert len({frame.name for frame in dataset}) == 2 * FRAMES
    for n in range(2 * FRAMES):
        assert np.abs(on_map(dataset, n) - world()).max() < 1e-4
        frame = dataset[n]
        T_base_sensor = FRONT if frame.scan.sensor == "front" else REAR
        assert np.allclose(frame.mount.origin[:2], T_base_sensor[:2, 3])
        assert frame.mount.sensor_height == pytest.approx(T_base_sensor[2, 3] + HEIGHT - 1.2, abs=1e-2)
        assert np.allclose(frame.mount.ego_footprint, (1 - 2.5, 1 + 2.5, 0.25 - 1.1, 0.25 + 1.1))
        T_map_vehicle = frame.T_map_sensor @ inverse(frame.mount.T_vehicle_sensor)
        assert np.allclose(T_map_vehicle[:2, 3], MAP_BASE[n // 2][:2, 3])  # one vehicle
    given = open_dataset(log(two_lidars()), topic=["/front/points", "/rear/points"], sensor_height=0.8)
    heights = {frame.scan.sensor: frame.mount.sensor_height for frame in given}
    assert heights == pytest.approx({"front": 0.8, "rear": 1.8})  # that of the first topic; the other by transforms


def test_several_lidars_are_fused_into_one_map(log: Callable[..., Path]) -> None:
    """The wall lies where it is, and no scan is taken for a jump of the pose."""
    dataset = open_dataset(log(two_lidars()), topic=["/rear/points", "/front/points"])
    model = RayISM(SPEC)
    poses = np.array([frame.T_map_sensor for frame in dataset])
    mapper = make_mapper("cautious", covering_window(SPEC, poses), None, "fixed")
    steps = list(fuse(dataset, model, mapper))
    assert all(step.error is None and not step.restart for step in steps)
    grid = mapper.grid
    x = grid.spec.origin[0] + grid.spec.resolution * (np.argmax(grid.occupied.sum(axis=1)) + 0.5)
    assert x == pytest.approx(WALL, abs=grid.spec.resolution)


def test_several_lidars_need_base_link(log: Callable[..., Path]) -> None:
    rows = [*two_lidars()[1:]]
    with pytest.raises(OgmError, match="no transform leads from base_link to front.*choose one `topic`"):
        open_dataset(log(rows), topic=["/front/points", "/rear/points"])


@each("ending", [".mcap", ".db3", ".bag"])
def test_a_radar_is_fused_beside_a_lidar_or_alone(log: Callable[..., Path], ending: str) -> None:
    """A detection every 4 m along the wall and one of a car that comes; the radar looks to the front, 3 m before."""
    T_base_radar = pose(3.0, 0.0, 0.1)
    rows, kind = [*drive(), fixed("base_link", "radar", T_base_radar)], "radar_msgs/msg/RadarScan"
    for stamp, T in zip(STAMPS + STEP / 4, MAP_BASE, strict=True):
        seen = transform_points(inverse(T @ T_base_radar), np.array([[WALL, y, 1.0] for y in range(-8, 9, 4)]))
        away, azimuth, up = np.linalg.norm(seen, axis=1), np.arctan2(seen[:, 1], seen[:, 0]), seen[:, 2]
        returns = [
            SimpleNamespace(
                range=r, azimuth=a, elevation=np.arcsin(z / r), doppler_velocity=-4 * np.cos(a), amplitude=1.0
            )
            for r, a, z in zip(away, azimuth, up, strict=True)
        ]
        header = SimpleNamespace(seq=0, stamp=ros_stamp(stamp), frame_id="radar")
        rows += [("/radar", kind, SimpleNamespace(header=header, returns=returns), stamp + 0.01)]
        rows += [moved("map", "base_link", stamp, T, late=0.1)]
    path = log(rows, f"both{ending}")
    assert open_dataset(path).facts["topics"] == ["/points"]
    both = open_dataset(path, topic=["/points", "/radar"])
    assert [frame.scan.rcs is not None for frame in both] == [False, True] * FRAMES
    radar = both[1]
    assert radar.scan.sensor == "radar"
    assert np.abs(on_map(both, 1)[:, 0] - WALL).max() < 1e-3
    np.testing.assert_allclose(radar.mount.origin, [3.0, 0.0, 0.6], atol=1e-3)  # by the lidar, which shows the ground
    with pytest.raises(OgmError, match="shows the ground"):
        open_dataset(path, topic="/radar")[0].mount  # noqa: B018
    for topics in (["/radar"], ["/points", "/radar"]):
        size = ["--ism", "ray", "--length", "40", "--width", "24", "--sensor-height", "1.7"]
        chosen = [f"--topic={topic}" for topic in topics]
        result = CliRunner().invoke(app, ["fuse", str(path), *chosen, *size, "--out", str(path.parent / "m.npz")])
        assert result.exit_code == 0, result.output
    only = log([row for row in rows if row[0] != "/points"], f"radar{ending}")
    assert open_dataset(only).facts["topics"] == ["/radar"]


def test_odometry_and_truth_are_for_one_lidar(log: Callable[..., Path], tmp_path: Path) -> None:
    dataset = open_dataset(log(two_lidars()), topic=["/front/points", "/rear/points"])
    refused("several sensors", with_odometry, dataset)
    write_poses(tmp_path / "poses.txt", Trajectory(STAMPS, MAP_BASE))
    refused("several sensors", with_poses, dataset, tmp_path / "poses.txt")
    with pytest.raises(OgmError, match="scans of several sensors, of which no truth is made"):
        _ = dataset[0].truth
    assert not dataset.motion_distorted


# --- Access ------------------------------------------------------------------------------------------


@each("name, compression", [("a.mcap", ""), ("a.mcap", "zstd"), ("a.db3", ""), ("a.bag", "")])
def test_frames_are_read_in_any_order_by_any_thread_and_after_pickling(
    log: Callable[..., Path], name: str, compression: str
) -> None:
    dataset = open_dataset(log(drive(), name, compression))
    wanted = [frame.scan.points for frame in dataset]
    order = [4, 0, 3, 3, 1, 2, 0]
    again = open_dataset(log(drive(), name, compression))
    with ThreadPoolExecutor(4) as pool:
        for n, points in zip(order, pool.map(lambda n: again[n].scan.points, order), strict=True):
            assert np.array_equal(points, wanted[n])
    for one in (pickle.loads(pickle.dumps(dataset[1:])), copy.copy(dataset)[1:]):
        assert np.array_equal(one[0].scan.points, wanted[1])
        assert np.array_equal(one[0].T_map_sensor, dataset[1].T_map_sensor)


@each("ending", [".mcap", ".bag"])
def test_opening_reads_no_points_and_a_frame_no_others(
    log: Callable[..., Path], ending: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    large = Scan(np.tile(seen_from(np.eye(4)).points, (4, 1)))  # larger than a chunk
    rows = [("/points", CLOUD, point_cloud2(large, frame_id="lidar", stamp=stamp), stamp) for stamp in STAMPS]
    path = log([*rows, *(moved("map", "lidar", stamp, np.eye(4)) for stamp in STAMPS)], f"a{ending}")
    count = 0

    def read(file: RandomAccess, start: int, size: int, plain: Any = RandomAccess.read) -> bytes:
        nonlocal count
        data: bytes = plain(file, start, size)
        count += len(data)
        return data

    monkeypatch.setattr(RandomAccess, "read", read)
    dataset, size = open_dataset(path), path.stat().st_size
    assert count < 0.05 * size
    count = 0
    _ = dataset[3].scan
    assert count < 1.1 * size / FRAMES + 4096


def test_a_damaged_scan_alone_cannot_be_read(log: Callable[..., Path]) -> None:
    path = log([row for k, row in enumerate(drive()) if k < 8], compression="zstd")  # in two chunks
    data = bytearray(path.read_bytes())
    data[600_000:600_100] = bytes(100)
    path.write_bytes(data)
    dataset, failed = open_dataset(path), []
    for frame in dataset:
        try:
            _ = frame.scan
        except OgmError as error:
            failed.append(str(error))
    assert 0 < len(failed) < len(dataset)
    assert all(error.count(str(path)) == 1 and "the chunk at byte" in error for error in failed)


def test_of_a_cut_log_the_whole_scans_are_read(log: Callable[..., Path], caplog: pytest.LogCaptureFixture) -> None:
    path = log(drive())
    data = path.read_bytes()
    path.write_bytes(data[: int(0.7 * len(data))])
    dataset = open_dataset(path)
    assert 2 <= len(dataset) < FRAMES
    assert f"{path} is cut at byte" in caplog.text
    assert np.abs(on_map(dataset, 0) - world()).max() < 1e-4


# --- Commands ----------------------------------------------------------------------------------------


def run(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[str, int]:
    """Run a command; return what it prints, in one line, and its exit code."""
    code = 0
    try:
        app([str(word) for word in words], standalone_mode=False)
    except SystemExit as stop:
        code = int(stop.code or 0)
    printed = capsys.readouterr()
    return " ".join((printed.out + printed.err).split()), code


def test_info_shows_what_a_log_holds_and_what_lacks(
    log: Callable[..., Path], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "300")
    text, _ = run(capsys, "info", log([*drive(), odometry(START, np.eye(4))]))
    for part in (
        "format MCAP",
        "/points sensor_msgs/msg/PointCloud2, 5 messages, 8.0 Hz",
        "/odom nav_msgs/msg/Odometry, 1 message /",
        "2023-11-14 22:13:20 UTC",
        "base_link <- lidar (static), map <- base_link",
        "poses of /points 5 of 5 scans, by transforms (map <- base_link <- lidar)",
    ):
        assert part in text
    text, _ = run(capsys, "info", log(two_lidars()[1:], "two.bag"))
    assert "poses of /front/points none; no transform leads to front" in text
    assert "poses of /rear/points 5 of 5 scans" in text


def test_fuse_makes_of_a_log_the_map_of_the_files(
    log: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    T_base_lidar, rows = pose(z=1.2), [fixed("base_link", "lidar", pose(z=1.2))]
    (tmp_path / "files").mkdir()
    for k, (stamp, T) in enumerate(zip(STAMPS, MAP_BASE, strict=True)):
        rows += [cloud(T @ T_base_lidar, stamp), moved("map", "base_link", stamp, T)]
        seen_from(T @ T_base_lidar).points.tofile(tmp_path / "files" / f"{k}.bin")
    write_poses(tmp_path / "poses.csv", Trajectory(STAMPS, MAP_BASE @ T_base_lidar), np.arange(FRAMES))
    words = ("--sensor-height", HEIGHT, "--length", 24, "--width", 16, "--resolution", 0.5, "--out")
    run(capsys, "fuse", tmp_path / "files", "--poses", tmp_path / "poses.csv", *words, tmp_path / "files.npz")
    text, code = run(capsys, "fuse", log(rows), *words, tmp_path / "log.npz")
    assert code == 0, text
    assert "5 of 5 scans, by transforms (map <- base_link <- lidar)" in text
    assert EvidentialGrid.load(tmp_path / "log.npz") == EvidentialGrid.load(tmp_path / "files.npz")  # bit for bit


# --- Real recordings ---------------------------------------------------------------------------------


def test_packets_decode_to_the_clouds_of_the_driver(real: Callable[[str], Path]) -> None:
    """As far as the other interpolation of azimuths allows: one of the scans is the driver's cloud."""
    from scipy.spatial import cKDTree

    pytest.importorskip("velodyne_decoder")
    (path,) = real("nebula_apache2").glob("vlp16/*/*.db3")
    (cloud_file,) = real("nebula_apache2").glob("vlp16/*.pcd")
    dataset, driver = open_dataset(path, sensor_height=1.9), read_scan(cloud_file).points[:, :3]
    assert dataset.facts["topics"] == [name for name in dataset.facts["topics"] if name.endswith("velodyne_packets")]
    apart = [np.quantile(cKDTree(frame.scan.points[:, :3]).query(driver)[0], 0.9) for frame in dataset]
    assert min(apart) < 0.03
    whole = open_dataset(path.parent, sensor_height=1.9)  # the folder, with its metadata.yaml
    assert [frame.name for frame in whole] == [frame.name for frame in dataset]


def test_a_folder_with_one_capture_is_that_capture(tmp_path: Path) -> None:
    pytest.importorskip("velodyne_decoder")
    (tmp_path / "a.pcap").write_bytes(b"no capture")
    text = refused(r"a\.pcap", open_dataset, tmp_path / "a.pcap")
    assert refused(r"a\.pcap", open_dataset, tmp_path) == text
    (tmp_path / "b.osf").touch()
    refused(r"holds captures, a\.pcap, b\.osf: give one alone", open_dataset, tmp_path)


def test_captures_are_data_sets(
    real: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("velodyne_decoder")
    path = real("velodyne_pcap/sample_velodyne_hdl32.pcap")
    dataset = open_dataset(path)
    assert len(dataset) == 2
    last, first = dataset[1].scan, dataset[0].scan  # backwards, too
    assert (first.stamp, last.stamp) == tuple(frame.stamp for frame in dataset)
    assert 0.08 < last.stamp - first.stamp < 0.12
    assert len(first) > 50_000
    assert dataset[0].mount.sensor_height == pytest.approx(2.07, abs=0.1)
    turned = open_dataset(path, axes=("+y", "-x", "+z"))[0].scan
    assert np.array_equal(turned.points[:, 1], -first.points[:, 0])
    assert "network capture" in run(capsys, "info", path)[0]
    (tmp_path / path.name).symlink_to(path)
    assert "network capture" in run(capsys, "info", tmp_path)[0]
    refused("known units", open_dataset, path, time_unit=1e-9)
