"""Logs of other writers are read, and other readers read ours: rosbags, mcap, mcap-ros2-support, SQLite, ROS 1."""

import importlib.util
import shutil
import sqlite3
import subprocess
from collections.abc import Callable
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cases import each, refused
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2.decoder import DecoderFactory
from rosbags import rosbag1, rosbag2
from rosbags.highlevel import AnyReader
from small_drive import CLOUD, KINDS, SCANS, START, TF, drive, plain, scan

from ogm.io.logs import LogWriter, open_log
from ogm.io.logs.definitions import message_types
from ogm.io.messages import scan_from_point_cloud2
from ogm.storage.files import OgmError

ROS1_PYTHON = Path("/usr/bin/python3")  # that of Debian, for which its ROS packages are


def stamped(seconds: float) -> int:
    return round(seconds * 16) * 10**9 // 16


def check(path: Path) -> None:
    """Compare a log with the drive."""
    with open_log(path) as log:
        assert not log.warnings
        assert {name: facts.type for name, facts in log.topics.items()} == {
            "/points": CLOUD, "/tf": TF, "/tf_static": TF,
        }  # fmt: skip
        sent = sorted(drive(), key=lambda row: row[3])
        for one, (topic, _, message, stamp) in zip(log.messages(), sent, strict=True):
            assert (one.topic, one.log_time) == (topic, stamp)
            assert plain(one.decode()) == plain(message)


# --- Other readers -----------------------------------------------------------------------------------


@each("name, compression", KINDS)
def test_rosbags_reads_ours(write: Callable[..., Path], name: str, compression: str) -> None:
    sent = sorted(drive(), key=lambda row: row[3])
    with AnyReader([write(name, compression)]) as reader:
        got = [
            (one.topic, one.msgtype, time, reader.deserialize(raw, one.msgtype)) for one, time, raw in reader.messages()
        ]
    assert [one[:3] for one in got] == [(topic, kind, stamped(stamp)) for topic, kind, _, stamp in sent]
    assert [plain(one[3]) for one in got] == [plain(row[2]) for row in sent]


@each("compression", ["", "zstd"])
def test_mcap_ros2_support_reads_ours(write: Callable[..., Path], compression: str) -> None:
    with open(write("a.mcap", compression), "rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        clouds = [one.decoded_message for one in reader.iter_decoded_messages(topics="/points")]
        channels = reader.get_summary().channels.values()
    for k, cloud in enumerate(clouds):
        assert np.array_equal(scan_from_point_cloud2(cloud).points, scan(k).points)
    assert len(clouds) == SCANS
    durable = [one.topic for one in channels if "durability: 1" in one.metadata["offered_qos_profiles"]]
    assert durable == ["/tf_static"]


def test_sqlite_reads_ours(write: Callable[..., Path]) -> None:
    with sqlite3.connect(write("a.db3")) as base:
        rows = base.execute("SELECT name, type, serialization_format, offered_qos_profiles FROM topics").fetchall()
        times = [row[0] for row in base.execute("SELECT timestamp FROM messages WHERE topic_id = 2 ORDER BY id")]
        assert base.execute("PRAGMA integrity_check").fetchone() == ("ok",)
    base.close()
    assert [row[:3] for row in rows] == [("/tf_static", TF, "cdr"), ("/points", CLOUD, "cdr"), ("/tf", TF, "cdr")]
    assert ["durability: 1" in row[3] for row in rows] == [True, False, False]
    assert times == [stamped(START + k / 8 + 1 / 16) for k in range(SCANS)]


def ros1(code: str, *arguments: object) -> str:
    """Run a program with ROS 1's own libraries."""
    found = ROS1_PYTHON.exists() and subprocess.run(
        [ROS1_PYTHON, "-c", "import rosbag"], capture_output=True, check=False
    )
    if not found or found.returncode:
        pytest.skip("no ROS 1: apt-get install python3-rosbag")
    done = subprocess.run([ROS1_PYTHON, "-c", code, *map(str, arguments)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_ros1_reads_ours(write: Callable[..., Path]) -> None:
    code = """
import sys, rosbag
for topic, message, time in rosbag.Bag(sys.argv[1]).read_messages():
    if topic == "/points":
        assert message._md5sum == "1158d486dd51d683ce2f1be655c3c181", message._md5sum
        at = message.header
        print(topic, time.to_nsec(), at.stamp.to_nsec(), at.frame_id, message.width, sum(bytearray(message.data)))
    else:
        parts = message.transforms
        print(topic, time.to_nsec(), *[(p.header.frame_id, p.child_frame_id, p.transform.translation.x) for p in parts])
"""
    lines = ros1(code, write("a.bag")).splitlines()
    wanted = []
    for topic, _, message, stamp in sorted(drive(), key=lambda row: row[3]):
        line = [topic, stamped(stamp)]
        if topic == "/points":
            at = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
            line += [at, "lidar", message.width, int(message.data.sum(dtype=np.int64))]
        else:
            parts = message.transforms
            line += [(one.header.frame_id, one.child_frame_id, float(one.transform.translation.x)) for one in parts]
        wanted.append(" ".join(map(str, line)))
    assert lines == wanted


# --- Other writers -----------------------------------------------------------------------------------


@pytest.mark.slow
@each("packing", ["none", "bz2", "lz4"])
def test_bags_of_ros1_are_read(write: Callable[..., Path], tmp_path: Path, packing: str) -> None:
    code = """
import sys, rosbag
with rosbag.Bag(sys.argv[2], "w", compression=sys.argv[3], chunk_threshold=100000) as out:
    for topic, message, time in rosbag.Bag(sys.argv[1]).read_messages():
        out.write(topic, message, time)
"""
    ros1(code, write("a.bag"), tmp_path / "b.bag", packing)
    check(tmp_path / "b.bag")


@each("packing", ["", "BZ2", "LZ4"])
def test_bags_of_rosbags_are_read(tmp_path: Path, packing: str) -> None:
    store = message_types(1)
    from ogm.io.logs.writer import _for_ros1

    writer = rosbag1.Writer(tmp_path / "a.bag")
    if packing:
        writer.set_compression(rosbag1.Writer.CompressionFormat[packing])
    with writer:
        known = {}
        for topic, kind, message, stamp in drive():
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=store)
            data = store.serialize_ros1(_for_ros1(message, kind, store), kind)
            writer.write(known[topic], stamped(stamp), data)
    check(tmp_path / "a.bag")


@each(
    "plugin, packing, version", [("MCAP", "", 9), ("MCAP", "STORAGE", 8), ("SQLITE3", "", 8), ("SQLITE3", "MESSAGE", 9)]
)
@each("alone", [False, True])  # in their folder, or without it
def test_ros2_bags_of_rosbags_are_read(tmp_path: Path, plugin: str, packing: str, version: int, alone: bool) -> None:
    """In their folder or without it; big-endian too."""
    store = message_types(2)
    writer = rosbag2.Writer(tmp_path / "a", version=version, storage_plugin=rosbag2.StoragePlugin[plugin])
    if packing:
        writer.set_compression(rosbag2.CompressionMode[packing], rosbag2.CompressionFormat.ZSTD)
    with writer:
        known = {}
        for n, (topic, kind, message, stamp) in enumerate(drive()):
            if topic not in known:
                known[topic] = writer.add_connection(topic, kind, typestore=store)
            data = store.serialize_cdr(message, kind, little_endian=n % 2 == 0)
            writer.write(known[topic], stamped(stamp), data)
    path = tmp_path / "a"
    if alone:
        (part,) = [one for one in path.iterdir() if one.name != "metadata.yaml"]
        path = Path(shutil.move(part, tmp_path))
    check(path)
    with open_log(path) as log:
        assert [log.head(ref).stamp for ref in log.refs(["/points"])] == [START + k / 8 for k in range(SCANS)]


BARE = ("repeat_channels", "repeat_schemas", "use_statistics", "use_summary_offsets")
FORMS: dict[str, dict[str, Any]] = {
    "whole": {},
    "without index": {"index_types": IndexType.NONE},
    "without chunks": {"use_chunking": False},
    "without summary": {"index_types": IndexType.NONE} | dict.fromkeys(BARE, False),
}


@each("form, packing, ros", [*product(FORMS, CompressionType, [2]), *product(FORMS, [CompressionType.NONE], [1])])
def test_mcaps_of_any_form_are_read(tmp_path: Path, form: str, packing: CompressionType, ros: int) -> None:
    """In the profiles of ROS 1 and ROS 2."""
    from ogm.io.logs.writer import _for_ros1

    store, encoding = message_types(ros), ("ros1", "cdr")[ros - 1]
    with open(tmp_path / "a.mcap", "wb") as file:
        writer = Writer(file, compression=packing, chunk_size=200_000, **FORMS[form])
        writer.start(profile=f"ros{ros}")
        known: dict[str, int] = {}
        for topic, kind, message, stamp in drive():
            if topic not in known:
                text = store.generate_msgdef(kind, ros_version=ros)[0].encode()
                name = kind if ros == 2 else kind.replace("/msg/", "/")
                known[topic] = writer.register_channel(
                    topic, encoding, writer.register_schema(name, f"ros{ros}msg", text)
                )
            data = store.serialize_cdr(message, kind)
            if ros == 1:
                data = store.serialize_ros1(_for_ros1(message, kind, store), kind)
            writer.add_message(known[topic], stamped(stamp), bytes(data), stamped(stamp))
        writer.finish()
    check(tmp_path / "a.mcap")


def test_messages_of_other_encodings_are_listed_but_not_decoded(tmp_path: Path) -> None:
    with open(tmp_path / "a.mcap", "wb") as file:
        writer = Writer(file)
        writer.start()
        writer.add_message(writer.register_channel("/notes", "json", 0), 10**9, b"{}", 10**9)
        writer.finish()
    with open_log(tmp_path / "a.mcap") as log:
        assert log.topics["/notes"].count == 1
        (one,) = log.messages()
        assert bytes(one.raw) == b"{}"
        refused("/notes cannot be read: messages of .* have json encoding", one.decode, error=OgmError)


@pytest.mark.skipif(importlib.util.find_spec("foxglove") is None, reason="no foxglove-sdk")
def test_foxglove_messages_go_into_mcap(tmp_path: Path) -> None:
    from foxglove.messages import Grid, PackedElementField, PackedElementFieldNumericType, Vector2
    from mcap_protobuf.decoder import DecoderFactory as Protobuf

    fields = [PackedElementField(name="free", offset=0, type=PackedElementFieldNumericType.Float32)]
    grid = Grid(
        frame_id="map", column_count=2, cell_size=Vector2(x=0.5, y=0.5), row_stride=8, cell_stride=4, fields=fields,
        data=np.arange(4, dtype="<f4").tobytes(),
    )  # fmt: skip
    with LogWriter(tmp_path / "a.mcap") as log:
        log.write("/grid", "foxglove.Grid", grid, START)
        log.write("/tf", TF, drive(10)[0][2], START)
    with open(tmp_path / "a.mcap", "rb") as file:
        (one,) = make_reader(file, decoder_factories=[Protobuf()]).iter_decoded_messages(topics="/grid")
    assert np.array_equal(np.frombuffer(one.decoded_message.data, "<f4"), np.arange(4))
    assert one.decoded_message.cell_size.x == 0.5
    with open_log(tmp_path / "a.mcap") as log:
        assert log.topics["/grid"].type == "foxglove.Grid"


# --- Types -------------------------------------------------------------------------------------------


@each("name, md5", [
        ("tf2_msgs/msg/TFMessage", "94810edda583a504dfda3829e70d7eec"),
        ("tf/msg/tfMessage", "94810edda583a504dfda3829e70d7eec"),
        ("velodyne_msgs/msg/VelodyneScan", "50804fc9533a0e579e6322c04ae70566"),
        ("livox_ros_driver/msg/CustomMsg", "e4d6829bdfe657cb6c21a746c86b21a6"),
        ("grid_map_msgs/msg/GridMap", "95681e052b1f73bf87b7eb984382b401"),
        ("nav_msgs/msg/OccupancyGrid", "3381f2d731d4076ec5c71b0759edbe4e"),
    ])  # fmt: skip
def test_shipped_definitions_have_the_checksums_of_ros1(name: str, md5: str) -> None:
    assert message_types(1).generate_msgdef(name)[1] == md5


def test_logs_without_definitions_are_decoded_by_the_shipped_ones(tmp_path: Path) -> None:
    path, name = tmp_path / "a.db3", "livox_ros_driver2/msg/CustomMsg"
    header = drive(1)[1][2].header
    message = SimpleNamespace(header=header, timebase=7, point_num=0, lidar_id=3, rsvd=np.zeros(3, np.uint8), points=[])
    with LogWriter(path) as log:
        log.write("/x", name, message, START)
    with sqlite3.connect(path) as base:
        base.execute("DROP TABLE message_definitions")
    base.close()
    with open_log(path) as log:
        (one,) = log.messages()
        assert not one.channel.definition
        assert plain(one.decode()) == plain(message)


def test_types_that_are_nowhere_defined_are_named(tmp_path: Path) -> None:
    path = tmp_path / "a.db3"
    with LogWriter(path) as log:
        log.write("/tf", TF, drive(1)[0][2], START)
    with sqlite3.connect(path) as base:
        base.execute("DROP TABLE message_definitions")
        base.execute("UPDATE topics SET type = 'our_msgs/msg/Own'")
    base.close()
    with (
        open_log(path) as log,
        pytest.raises(OgmError, match="/tf cannot be read: the type our_msgs/msg/Own is unknown"),
    ):
        next(log.messages()).decode()


# --- Logs that are a little wrong ---------------------------------------------------------------------


@each("kind, text, encoding", [
        (CLOUD, CLOUD, "ros2msg"),  # the name alone
        (CLOUD, "uint8 wrong\n", "ros2msg"),
        (CLOUD, "std_msgs/Header header\n", "ros2msg"),  # without the definition of a part
        (CLOUD, "module { nothing", "ros2idl"),
        (CLOUD, "\0\1", "ros2msg"),
        ("sensor_msgs::msg::dds_::PointCloud2_", "", ""),
    ])  # fmt: skip
def test_a_wrong_definition_of_a_known_type_is_not_needed(tmp_path: Path, kind: str, text: str, encoding: str) -> None:
    with LogWriter(tmp_path / "good.mcap") as log:
        log.write("/points", CLOUD, drive()[1][2], START)
    raw = bytes(next(iter(open_log(tmp_path / "good.mcap").messages(["/points"]))).raw)
    with open(tmp_path / "bad.mcap", "wb") as file:
        writer = Writer(file)
        writer.start("ros2", "x")
        schema = writer.register_schema(kind, encoding, text.encode())
        writer.add_message(writer.register_channel("/points", "cdr", schema), 10**9, raw, 10**9)
        writer.finish()
    (message,) = open_log(tmp_path / "bad.mcap").messages()
    assert message.type == CLOUD
    assert np.array_equal(scan_from_point_cloud2(message.decode()).points, scan(0).points)


@each("name", ["a.bag", "a.mcap", "a.db3"])
def test_a_log_that_was_not_finished_is_read(write: Callable[..., Path], name: str) -> None:
    from ogm.datasets import open_dataset

    path = write(name, "", 200)
    active = path.rename(path.parent / f"{name}.active")
    assert len(open_dataset(active)) == len(open_dataset(active.parent)) == SCANS
    active.unlink()
