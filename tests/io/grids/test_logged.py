"""Grids in logs, read by other libraries: mcap-ros2-support, rosbags."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cases import each, needs, refused

from ogm.grid import EvidentialGrid, GridSpec
from ogm.io import GridLog, PlacedGrid, read_grid, read_placed_grid, write_grid
from ogm.io.logs import LogWriter, open_log
from ogm.io.messages import StampedTransform, occupancy_grid
from ogm.io.messages.grids import occupancy_values
from ogm.io.messages.plain import header
from ogm.pose import pose
from ogm.storage.files import OgmError

needs("rosbags")
SPEC = GridSpec(0.25, (9, 5), (-1.75, 2.5))
T = pose(12.0, -3.0, 0.5, yaw=0.6)
ENDINGS = (".mcap", ".db3", ".bag")


def l_shape() -> EvidentialGrid:
    mass = np.random.default_rng(0).dirichlet((1, 1, 1), SPEC.shape)[..., :2].astype(np.float32)
    mass[2:8, 1] = 0.05, 0.9
    mass[7, 1:4] = 0.05, 0.9
    mass[0] = 0
    return EvidentialGrid(SPEC, mass)


def looked_up(grid: PlacedGrid) -> list[tuple[float, float, int, int]]:
    """Return x, y in the frame of the message, and the cell that lies there."""
    xs, ys = grid.grid.spec.cell_centers
    found = []
    for ix, iy in np.ndindex(grid.grid.spec.shape):
        x, y, *_ = grid.T_frame_grid @ (xs[ix, 0], ys[0, iy], 0, 1)
        found.append((x, y, ix, iy))
    return found


def occupancy_at(message: Any, x: float, y: float) -> int:
    """Look a value up as a ROS node does, from position and quaternion of the origin."""
    origin, info = message.info.origin, message.info
    yaw = 2 * np.arctan2(origin.orientation.z, origin.orientation.w)
    dx, dy = x - origin.position.x, y - origin.position.y
    column = int((np.cos(yaw) * dx + np.sin(yaw) * dy) // info.resolution)
    row = int((np.cos(yaw) * dy - np.sin(yaw) * dx) // info.resolution)
    return int(message.data[row * info.width + column])


def by_ros2(path: Path) -> dict[str, list[Any]]:
    """Read an MCAP by mcap-ros2-support, a db3 by rosbags."""
    found: dict[str, list[Any]] = {}
    if path.suffix == ".mcap":
        reader = pytest.importorskip("mcap_ros2.reader")
        for one in reader.read_ros2_messages(str(path)):
            found.setdefault(one.channel.topic, []).append((one.ros_msg, one.log_time_ns))
        return found
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([path], default_typestore=get_typestore(Stores.LATEST)) as reader:
        for connection, time, raw in reader.messages():
            found.setdefault(connection.topic, []).append((reader.deserialize(raw, connection.msgtype), time))
    return found


@each("ending", ENDINGS)
@each("message", ["occupancy-grid", "grid-map", "foxglove-grid"])
def test_a_grid_comes_back(tmp_path: Path, ending: str, message: str) -> None:
    path, placed = tmp_path / f"map{ending}", PlacedGrid(l_shape(), pose(z=0.5), "odom", 12.5)
    if message == "foxglove-grid":
        pytest.importorskip("foxglove")
    if message == "foxglove-grid" and ending != ".mcap":
        refused(r"only for \.mcap files", write_grid, path, placed, message=message)
        return
    write_grid(path, placed, message=message)
    again = read_placed_grid(path)
    assert (again.frame_id, again.stamp, again.grid.spec) == ("odom", 12.5, SPEC)
    np.testing.assert_allclose(again.T_frame_grid, pose(z=0.5), atol=1e-12)
    if message == "occupancy-grid":
        assert np.array_equal(occupancy_values(again.grid), occupancy_values(l_shape()))
    else:
        assert np.array_equal(again.grid.mass, l_shape().mass)
    assert np.array_equal(read_grid(path).mass, again.grid.mass)
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


@each("ending", [".mcap", ".db3"])
def test_ros_2_finds_every_cell_where_it_is(tmp_path: Path, ending: str) -> None:
    path, placed = tmp_path / f"map{ending}", PlacedGrid(l_shape(), T, "odom", 1_700_000_000.25)
    with GridLog(path) as log:
        log.write(placed, [StampedTransform("odom", "base_link", 1_700_000_000.25, T)])
    topics = by_ros2(path)
    ((message, time),) = topics["/map"]
    assert (message.header.frame_id, message.header.stamp.sec, message.header.stamp.nanosec) == (
        "odom", 1_700_000_000, 250_000_000,
    )  # fmt: skip
    assert time == 1_700_000_000_250_000_000
    assert message.info.origin.position.z == pytest.approx(0.5)
    for x, y, ix, iy in looked_up(placed):
        assert occupancy_at(message, x, y) == occupancy_values(placed.grid)[ix, iy]
    ((tf, _),) = topics["/tf"]
    assert tf.transforms[0].child_frame_id == "base_link"
    assert tf.transforms[0].transform.translation.y == -3.0


def test_the_last_map_of_a_topic_is_read(tmp_path: Path) -> None:
    grids = [EvidentialGrid(GridSpec(0.5, (2, 3), (k, 0)), np.full((2, 3, 2), 0.1 * k, np.float32)) for k in range(4)]
    with GridLog(tmp_path / "maps.mcap", "grid-map") as log:
        for k, grid in enumerate(grids):
            log.write(PlacedGrid(grid, stamp=k))
    assert read_grid(tmp_path / "maps.mcap") == grids[-1]
    with open_log(tmp_path / "maps.mcap") as log:
        assert log.topics["/map"].count == 4
        assert log.topics["/map"].rate == pytest.approx(1.0)


def update(x: int, y: int, values: Any, stamp: float = 5.0) -> SimpleNamespace:
    """Return an update of a map by values (width, height)."""
    values = np.array(values, np.int8)
    width, height = values.shape
    return SimpleNamespace(header=header(stamp, "map"), x=x, y=y, width=width, height=height, data=values.T.reshape(-1))


@each("ending", ENDINGS)
def test_updates_change_the_map_that_was_recorded_before_them(
    tmp_path: Path, ending: str, caplog: pytest.LogCaptureFixture
) -> None:
    path, topic = tmp_path / f"maps{ending}", "/local/costmap"
    whole = occupancy_grid(EvidentialGrid.vacuous(SPEC), frame_id="map", stamp=1.0)
    updates = [
        (0.5, update(0, 0, [[100]])),  # of the map before
        (2.0, update(1, 2, [[0, 100, -1], [100, 100, 100]], 2.0)),
        (3.0, update(7, 3, [[0, 0], [100, 100]], 3.0)),
        (4.0, update(8, 4, [[0, 0], [100, 100]], 4.0)),  # beyond the border
        (5.0, update(-1, 0, [[0]])),
    ]
    with LogWriter(path) as log:
        log.write(topic, "nav_msgs/msg/OccupancyGrid", whole, 0.0)
        for time, message in updates:
            log.write(f"{topic}_updates", "map_msgs/msg/OccupancyGridUpdate", message, time)
            if time == 0.5:
                log.write(topic, "nav_msgs/msg/OccupancyGrid", whole, 1.0)
    placed = read_placed_grid(path)
    values = np.full(SPEC.shape, -1)
    values[1:3, 2:5] = [[0, 100, -1], [100, 100, 100]]
    values[7:9, 3:5] = [[0, 0], [100, 100]]
    assert np.array_equal(occupancy_values(placed.grid), values)
    assert placed.stamp == 3.0
    assert "2 updates of /local/costmap_updates are left out" in caplog.text


def test_updates_without_a_map_are_named(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "maps.mcap") as log:
        log.write("/map_updates", "map_msgs/msg/OccupancyGridUpdate", update(0, 0, [[1]]), 1.0)
    refused("has updates of a map, but no complete map", read_grid, tmp_path / "maps.mcap", error=OgmError)


def test_several_topics_ask_for_one(tmp_path: Path) -> None:
    def write(*topics: str) -> Path:
        with LogWriter(tmp_path / "maps.bag") as log:
            for k, topic in enumerate(topics):
                grid = EvidentialGrid.vacuous(GridSpec(1.0, (k + 1, 1), (0, 0)))
                log.write(topic, "nav_msgs/msg/OccupancyGrid", occupancy_grid(grid, frame_id="/map"), 1.0)
        return tmp_path / "maps.bag"

    path = write("/costmap", "/map")
    assert read_grid(path).spec.shape == (2, 1)
    assert read_placed_grid(path, topic="/costmap").grid.spec.shape == (1, 1)
    assert read_placed_grid(path).frame_id == "map"
    refused(r"maps\.bag has no topic /x; there are /costmap", read_grid, path, error=OgmError, topic="/x")
    refused("has grids of /a, /b: give one as `topic`", read_grid, write("/a", "/b"), error=OgmError)
    refused(r"topic is only for \.mcap", read_grid, tmp_path / "maps.npz", topic="/a")


def test_logs_without_grids_and_damaged_ones_are_refused(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "tf.mcap") as log:
        log.write("/tf", "tf2_msgs/msg/TFMessage", log_transform(), 1.0)
    with pytest.raises(OgmError, match=r"tf\.mcap has no grids .* only /tf \(tf2_msgs/msg/TFMessage\)"):
        read_grid(tmp_path / "tf.mcap")
    refused("has messages of tf2_msgs/msg/TFMessage", read_grid, tmp_path / "tf.mcap", error=OgmError, topic="/tf")
    (tmp_path / "x.mcap").write_bytes(b"x")
    refused(r"x\.mcap is no log", read_grid, tmp_path / "x.mcap", error=OgmError)


def log_transform() -> Any:
    from ogm.io.messages import tf_message

    return tf_message([StampedTransform("map", "base_link", 1.0, T)])


def test_a_cut_log_gives_the_last_whole_map(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    rng = np.random.default_rng(0)
    with GridLog(tmp_path / "maps.mcap", "grid-map") as log:
        for k in range(9):
            mass = rng.dirichlet((1, 1, 1), (300, 200))[..., :2].astype(np.float32)
            log.write(PlacedGrid(EvidentialGrid(GridSpec(1.0, (300, 200), (k, 0)), mass), stamp=k))
    data = (tmp_path / "maps.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    grid = read_grid(tmp_path / "cut.mcap")
    assert 0 < grid.spec.origin[0] < 8
    assert "cut.mcap" in caplog.text


@each("damage", ["cut", "huge", "wire", "empty", "name", "float"])
def test_a_damaged_foxglove_grid_is_refused(tmp_path: Path, damage: str) -> None:
    writer = pytest.importorskip("mcap.writer")
    foxglove = pytest.importorskip("foxglove")
    from ogm.io.messages import foxglove_grid

    good = bytes(foxglove_grid(l_shape(), frame_id="map").encode())
    assert foxglove
    bad = {
        "cut": good[: len(good) // 2], "huge": good[:-3] + b"\x48\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff\xff",
        "wire": b"\x0b" + good, "empty": b"", "name": b"\x12\x02\xff\xfe" + b"", "float": b"\x20\x01" + good,
    }[damage]  # fmt: skip
    with open(tmp_path / "m.mcap", "wb") as file:
        out = writer.Writer(file)
        out.start()
        schema = out.register_schema("foxglove.Grid", "protobuf", b"")
        channel = out.register_channel("/map", "protobuf", schema)
        out.add_message(channel, 1, bad, 1)
        out.finish()
    if damage == "float":  # a field of another wire type in front of the right one: the last counts
        assert read_grid(tmp_path / "m.mcap") == l_shape()
        return
    refused(r"m\.mcap", read_grid, tmp_path / "m.mcap", error=OgmError)


def test_an_error_inside_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "maps.mcap"
    write_grid(path, l_shape())
    before = path.read_bytes()

    def stopped() -> None:
        with GridLog(path) as log:
            log.write(PlacedGrid(l_shape()))
            raise RuntimeError("half-way")

    refused("half-way", stopped, error=RuntimeError)
    assert path.read_bytes() == before
    assert [one.name for one in tmp_path.iterdir()] == ["maps.mcap"]


def test_options_are_checked_before_the_work(tmp_path: Path) -> None:
    for path, message, text in (
        ("m.mcap", "map", "message must be one of occupancy-grid, grid-map, foxglove-grid"),
        ("m.npz", "grid-map", r"message is only for \.mcap"),
        ("m.db3", "foxglove-grid", r"only for \.mcap files"),
    ):
        refused(text, write_grid, tmp_path / path, l_shape(), message=message)
    assert not list(tmp_path.iterdir())
