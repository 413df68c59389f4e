"""Every example is run: the own driver whole, the ROS 2 node on a stand-in for rclpy, the bridge over real sessions."""

import importlib.util
import runpy
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cases import refused
from foxglove_client import Client, grid_fields
from rooms import CAMERA, image_message, info_message

from ogm import EvidentialGrid, Frame, GridSpec, Mount, Scan
from ogm.fusion import EvidentialMapper, fuse, rolling_window
from ogm.geometric import RayISM
from ogm.io import T_OPTICAL_BODY, read_grid, read_placed_grid
from ogm.io.messages import StampedTransform, occupancy_grid, point_cloud2, tf_message
from ogm.io.messages.grids import occupancy_values
from ogm.io.messages.plain import header
from ogm.io.transforms import TransformBuffer
from ogm.pose import inverse, pose, transform_points

EXAMPLES = Path(__file__).parents[1] / "examples"
SPEC, MOUNT = GridSpec.centered(length=20, width=20, resolution=0.25), Mount(1.8)
CLOUD, TF, GRID = "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage", "nav_msgs/msg/OccupancyGrid"
T_BASE_LIDAR = pose(0.5, 0.0, 1.8)


def example(name: str) -> ModuleType:
    """Import an example by its file."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def until(condition: Callable[[], object], seconds: float = 240.0) -> None:  # kernels may have to be compiled
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def scan(k: int) -> Scan:
    """Return what a lidar sees of the ground and of a wall at x = 8 m of the map."""
    rng = np.random.default_rng(1)
    ground, wall = rng.uniform(-8, 8, (6000, 4)), rng.uniform(-8, 8, (2000, 4))
    ground[:, 2], wall[:, 0], wall[:, 2] = 0.0, 8.1, rng.uniform(0, 2, len(wall))
    points = np.concatenate([ground, wall])
    points[:, 3] = 0.5
    T = T_map_base(k) @ T_BASE_LIDAR
    return Scan(transform_points(inverse(T), points).astype(np.float32), stamp=100 + 0.1 * k)


def T_map_base(k: int) -> np.ndarray:  # noqa: N802
    return pose(0.1 * k, 0.05 * k, yaw=0.02 * k)


@cache
def types() -> Any:
    """Return the message types of ROS 2 as rosbags has them."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_JAZZY)


def as_rosbags(plain: Any, kind: str) -> Any:
    """Return a message of rosbags' own classes, by way of its bytes."""
    return types().deserialize_cdr(types().serialize_cdr(plain, kind), kind)


def messages() -> Iterator[tuple[str, Any]]:
    """Yield what a vehicle publishes: tf is there for a cloud only after it."""
    static = tf_message([StampedTransform("base_link", "lidar", 0.0, T_BASE_LIDAR)])
    yield "tf_static", as_rosbags(static, TF)
    yield "tf", as_rosbags(tf_message([StampedTransform("odom", "base_link", 99.9, T_map_base(0))]), TF)
    for k in range(5):
        cloud = point_cloud2(scan(k), frame_id="/lidar" if k == 0 else "lidar")
        yield "points", as_rosbags(cloud, CLOUD)
        yield "tf", as_rosbags(tf_message([StampedTransform("odom", "base_link", 100 + 0.1 * k, T_map_base(k))]), TF)


def direct(spec: GridSpec, mount: Mount = MOUNT) -> SimpleNamespace:
    """Return the map of the same scans, without any message between."""
    mapper = EvidentialMapper(rolling_window(spec))
    frames = [
        Frame(scan(k), mount, None, None, T_map_sensor=T_map_base(k) @ T_BASE_LIDAR, stamp=100 + 0.1 * k)
        for k in range(5)
    ]
    steps = list(fuse(frames, RayISM(spec), mapper))
    assert all(step.grid is not None for step in steps)
    return occupancy_grid(mapper.grid, frame_id="odom", stamp=100.4)


def assert_same(found: Any, wanted: Any) -> None:
    np.testing.assert_array_equal(found.data, wanted.data)
    values = np.asarray(found.data)
    assert (values.min(), values.max() > 80, ((values >= 0) & (values < 20)).any()) == (-1, True, True)
    assert (found.info.width, found.info.height) == (wanted.info.width, wanted.info.height)
    assert found.info.resolution == pytest.approx(wanted.info.resolution)
    for name in "xyz":
        assert getattr(found.info.origin.position, name) == getattr(wanted.info.origin.position, name)
    assert found.header.frame_id == "odom"
    assert found.header.stamp.sec == 100
    assert found.header.stamp.nanosec == pytest.approx(400_000_000, abs=100)


# Models and masses.


def test_models_are_compared_on_a_folder_of_scans(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for k in range(2):
        np.save(tmp_path / f"{k}.npy", scan(k).points)
    found = example("compare_models").main(str(tmp_path), ("ray", "height-band"))
    (pair, means), *others = found.table().items()
    assert (pair, others, len(found.frames)) == ("ray, height-band", [], 2)
    assert 0 < means["agreement"] < 1
    assert min(means["kl"], means["kl_reverse"]) > 0
    assert "ray, height-band" in capsys.readouterr().out


def test_the_tests_of_evidence_pass() -> None:
    module = example("evidence_tests")
    found = [name for name in vars(module) if name.startswith("test_")]
    assert len(found) == 5
    for name in found:
        getattr(module, name)()


# The own driver.


def test_an_own_driver_is_served() -> None:
    module, results = example("own_driver"), []
    started, go = threading.Event(), threading.Event()

    def sweeps() -> Iterator[Any]:
        started.set()
        go.wait(20)
        yield from module.driver(6)

    class Publisher(module.FoxglovePublisher):  # type: ignore[name-defined]
        def __init__(self, *args: Any, **more: Any) -> None:
            super().__init__(*args, **more)
            results.append(self)

    module.FoxglovePublisher = Publisher
    thread = threading.Thread(target=lambda: results.append(module.main(sweeps(), port=0)))
    thread.start()
    assert started.wait(300)  # kernels may have to be compiled
    publisher = results[0]
    with Client(publisher.port, ("/map",)) as client:
        until(publisher._map.has_sinks)
        go.set()
        grid = [client.receive() for _ in range(2)][-1].message
    thread.join()
    report = results[1]
    assert report.failed == 0
    assert report.mapped + report.dropped == 6
    assert report.mapped >= 2
    fields = grid_fields(grid)
    i = int((14.9 - grid.pose.position.x) / 0.2), int((14.9 - grid.pose.position.y) / 0.2)
    j = int(-grid.pose.position.x / 0.2), int(-grid.pose.position.y / 0.2)
    assert fields["occupied"][i[0] : i[0] + 2, j[1]].max() > 0.5  # the wall, 15 m ahead
    assert fields["occupied"][j[0], i[1] : i[1] + 2].max() > 0.5  # and to the left
    assert fields["free"][(i[0] + j[0]) // 2, j[1]] > 0.5


# The node.


def test_the_node_reads_scans_of_every_sensor() -> None:
    """The plain function, on messages of rosbags."""
    node, tf = example("ros2_node"), TransformBuffer()
    optical = T_BASE_LIDAR @ inverse(T_OPTICAL_BODY)
    for static, one in (
        (True, StampedTransform("base_link", "lidar", 0.0, T_BASE_LIDAR)),
        (True, StampedTransform("base_link", "optical", 0.0, optical)),
        *((False, StampedTransform("odom", "base_link", stamp, T_map_base(1))) for stamp in (99.0, 101.0)),
    ):
        tf.add(one, static)
    kept = {
        "points": point_cloud2(scan(0), frame_id="/lidar"),
        "scan": SimpleNamespace(header=header(100.0, "lidar"), ranges=[5.0] * 5, intensities=[], angle_min=-1.0,
            angle_max=1.0, angle_increment=0.5, time_increment=0.0, scan_time=0.1, range_min=0.1, range_max=9.0),
        "depth": image_message(np.full((CAMERA.height, CAMERA.width), 2.0), "16UC1", "optical", 100.0),
        "camera_info": info_message("optical", 100.0, ros1=False),
    }  # fmt: skip
    for topic, kind in (("points", ""), ("scan", "planar"), ("depth", "depth")):
        frame = node.read_frame(kept, topic, tf, ["odom", "base_link"])
        assert frame.scan.kind == kind
        assert (len(frame.scan) > 0, frame.stamp) == (True, 100.0)
        np.testing.assert_allclose(frame.T_map_sensor, T_map_base(1) @ T_BASE_LIDAR, atol=1e-12)
        np.testing.assert_allclose(frame.mount.T_vehicle_sensor, T_BASE_LIDAR, atol=1e-12)
    refused("CameraInfo must have a header", node.read_frame, {"depth": kept["depth"]}, "depth", tf, ["odom"])


class FakeNode:
    """What the example uses of a node."""

    last: "FakeNode"

    def __init__(self, name: str) -> None:
        self.name, self.subscriptions, self.published, self.warnings = name, {}, [], []
        FakeNode.last = self

    def declare_parameter(self, name: str, default: Any) -> SimpleNamespace:
        return SimpleNamespace(value=default)

    def create_publisher(self, kind: type, topic: str, qos: Any) -> SimpleNamespace:
        return SimpleNamespace(publish=self.published.append)

    def create_subscription(self, kind: type, topic: str, callback: Callable[[Any], None], qos: Any) -> None:
        self.subscriptions[topic.lstrip("/")] = callback

    def get_logger(self) -> SimpleNamespace:
        return SimpleNamespace(warning=lambda text, **_: self.warnings.append(text))


def fake_ros(monkeypatch: pytest.MonkeyPatch, spin: Callable[[FakeNode], None]) -> None:
    """Put modules with the names of ROS 2's in place: enough to run every line of the node."""

    class OccupancyGrid(SimpleNamespace):
        def __init__(self) -> None:
            stamp = SimpleNamespace(sec=0, nanosec=0)
            origin = SimpleNamespace(
                position=SimpleNamespace(x=0.0, y=0.0, z=0.0), orientation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
            )
            info = SimpleNamespace(map_load_time=stamp, resolution=0.0, width=0, height=0, origin=origin)
            super().__init__(header=SimpleNamespace(stamp=stamp, frame_id=""), info=info, data=[])

    policy = SimpleNamespace(TRANSIENT_LOCAL=1)
    qos = {"DurabilityPolicy": policy, "QoSProfile": SimpleNamespace, "qos_profile_sensor_data": object()}
    found = {
        "rclpy": {"qos": SimpleNamespace(**qos), "init": lambda: None, "create_node": FakeNode, "spin": spin},
        "rclpy.qos": qos,
        **{name: {} for name in ("nav_msgs", "sensor_msgs", "tf2_msgs")},
        "nav_msgs.msg": {"OccupancyGrid": OccupancyGrid},
        "sensor_msgs.msg": dict.fromkeys(("PointCloud2", "LaserScan", "Image", "CameraInfo"), object),
        "tf2_msgs.msg": {"TFMessage": object},
    }
    for name, content in found.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)


def test_the_node_publishes_a_map_for_every_cloud(monkeypatch: pytest.MonkeyPatch) -> None:
    def spin(node: FakeNode) -> None:
        for topic, message in messages():
            node.subscriptions[topic](message)
        cut = as_rosbags(point_cloud2(scan(0), frame_id="lidar"), CLOUD)
        cut.data = cut.data[:-1]
        node.subscriptions["points"](cut)

    fake_ros(monkeypatch, spin)
    runpy.run_path(str(EXAMPLES / "ros2_node.py"), run_name="__main__")
    node = FakeNode.last
    assert set(node.subscriptions) == {"tf", "tf_static", "points", "scan", "depth", "camera_info"}
    assert len(node.published) == 5
    assert_same(node.published[-1], direct(GridSpec.centered(), Mount(1.8, T_BASE_LIDAR)))
    assert len(node.warnings) == 1
    assert "cut short" in node.warnings[0]


# Planners.


@pytest.mark.slow
def test_a_path_is_free_up_to_the_wall(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    static, dynamic = example("path_query").main()
    for found in (static, dynamic):
        front = 8.0 + 0.5 * found.first_doubtful + 3.5  # the wall stands 15 m from the middle of the yard
        assert 13.5 <= front <= 15.0
        assert (found.plausibility[found.first_doubtful + 3 :] == 1).all()


def test_costs_for_nav2_lie_beside_the_map(tmp_path: Path) -> None:
    mass = np.full((*SPEC.shape, 2), (0.9, 0.0), np.float32)
    mass[40, 40], mass[60:] = (0.0, 0.9), 0
    EvidentialGrid(SPEC, mass).save(tmp_path / "map.npz")
    costs = example("nav2_costmap").main(str(tmp_path / "map.npz"))["cost"]
    assert [costs[40, 40], costs[41, 40], costs[50, 40], costs[70, 40]] == [254, 253, 0, 255]
    exact = read_placed_grid(tmp_path / "map_costs.mcap").grid["cost"]
    np.testing.assert_array_equal(np.where(np.isnan(exact), 255, exact), costs)
    values = occupancy_values(read_grid(tmp_path / "map_costs.yaml"))
    assert [values[40, 40], values[41, 40], values[50, 40], values[70, 40]] == [100, 99, 0, -1]


def test_the_loop_drives_straight_on_until_the_car_crosses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    module = example("planner_loop")
    choices = list(module.loop(module.frames(22)))
    assert [one.curvature for one in choices[:8]] == [0.0] * 8
    assert all(one.free == pytest.approx(10.0) for one in choices[:8])
    assert any(one.free < 9 for one in choices[12:])  # it stands across the way
    assert choices[-1].curvature < 0  # behind it, to the right
    assert choices[-1].free == pytest.approx(10.0)


# The bridge.


def test_the_bridge_maps_clouds_of_another_session() -> None:
    zenoh = pytest.importorskip("zenoh")
    pytest.importorskip("zenoh.ext")
    module = example("zenoh_bridge")

    def config(**more: Any) -> Any:
        result = zenoh.Config()
        result.insert_json5("scouting/multicast/enabled", "false")
        result.insert_json5("timestamping/enabled", "true")  # for what is kept for late subscribers
        for key, value in more.items():
            result.insert_json5(f"{key}/endpoints", f'["{value}"]')
        return result

    grids: list[Any] = []
    lines: list[str] = []
    stop, reports = threading.Event(), []
    module.print = lambda *words: lines.append(" ".join(map(str, words)))
    port = free_port()
    with (
        zenoh.open(config(listen=f"tcp/127.0.0.1:{port}")) as ours,
        zenoh.open(config(connect=f"tcp/127.0.0.1:{port}", listen="tcp/127.0.0.1:0")) as theirs,
    ):
        theirs.declare_subscriber(
            "map", lambda sample: grids.append(types().deserialize_cdr(sample.payload.to_bytes(), GRID))
        )
        publishers = {key: theirs.declare_publisher(key) for key in ("points", "tf")}
        static = zenoh.ext.declare_advanced_publisher(
            theirs, "tf_static", cache=zenoh.ext.CacheConfig(10), publisher_detection=True
        )
        static.put(
            next(bytes(types().serialize_cdr(message, TF)) for _, message in messages())
        )  # before there is a bridge
        thread = threading.Thread(target=lambda: reports.append(module.bridge(ours, MOUNT, "odom", stop)))
        thread.start()
        until(lambda: all(one.matching_status.matching for one in publishers.values()), 60)
        publishers["points"].put(b"no cloud")
        until(lambda: lines)
        for k, (topic, message) in enumerate(list(messages())[1:]):
            publishers[topic].put(bytes(types().serialize_cdr(message, CLOUD if topic == "points" else TF)))
            until(lambda: len(grids) >= k // 2)  # noqa: B023  # one per cloud, once the transform after it is there
        stop.set()
        thread.join(20)
    assert len(grids) == 5
    assert_same(grids[-1], direct(GridSpec.centered()))
    assert (reports[0].mapped, reports[0].dropped, reports[0].failed) == (5, 0, 0)
    assert "a scan is skipped" in lines[0]


def free_port() -> int:
    import socket

    with socket.create_server(("127.0.0.1", 0)) as one:
        return int(one.getsockname()[1])


def test_no_example_is_left_out_and_none_is_long() -> None:
    code = (EXAMPLES / "compare_models.py").read_text().splitlines()
    assert sum(bool(line.strip()) for line in code) <= 20
    assert {path.stem for path in EXAMPLES.glob("*.py")} == {
        "compare_models", "ego_motion", "evidence_tests", "own_driver", "ros2_node", "zenoh_bridge",
        "nav2_costmap", "path_query", "planner_loop",
        "hall", "own_sensor_model", "read_live_map", "yard",  # tests/test_tutorials.py
    }  # fmt: skip
    for path in set(EXAMPLES.glob("*.py")) - {EXAMPLES / "ego_motion.py", EXAMPLES / "hall.py"}:  # with their data
        assert sum(bool(line.strip()) for line in path.read_text().splitlines()) <= 60, path.name


@pytest.mark.slow
def test_ego_motion_filters_and_smooths() -> None:
    module = example("ego_motion")
    errors = module.compare(3)
    assert errors["filter"] < 0.6 * min(errors["fixes"], errors["dead reckoning"])
    assert errors["smoother"] < 0.8 * errors["filter"]
    ego = module.EgoMotion(0.0, [0, 0, 0, 5.0, 0.5], [0.001] * 5)  # a circle of 10 m
    for stamp in np.linspace(0, 4 * np.pi, 127)[1:]:
        assert ego.measure("speed", stamp, 5.0, 0.001)
        assert ego.measure("yaw_rate", stamp, 0.5, 0.0001)
    assert not ego.measure("position", stamp, [100.0, 0.0], 1.0)
    path = module.trajectory(*ego.smoothed()).poses
    np.testing.assert_allclose(np.hypot(path[:, 0, 3], path[:, 1, 3] - 10), 10, atol=0.03)
    np.testing.assert_allclose(path[-1], np.eye(4), atol=0.03)
