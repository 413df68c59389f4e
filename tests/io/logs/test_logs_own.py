"""What `LogWriter` writes, `open_log` reads back; files appear whole or not at all."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cases import each, refused
from small_drive import CLOUD, KINDS, SCANS, START, TF, drive, plain

from ogm.io.logs import LogWriter, open_log
from ogm.io.messages import tf_message
from ogm.io.messages.plain import ros_stamp
from ogm.storage.files import OgmError


@each("name, compression", KINDS)
def test_what_is_written_is_read_in_the_order_of_log_times(
    write: Callable[..., Path], name: str, compression: str
) -> None:
    sent = sorted(drive(), key=lambda row: row[3])
    with open_log(write(name, compression)) as log:
        got = list(log.messages())
        assert not log.warnings
        counts = {"/points": (CLOUD, SCANS), "/tf": (TF, SCANS), "/tf_static": (TF, 1)}
        assert {topic: (facts.type, facts.count) for topic, facts in log.topics.items()} == counts
        assert log.topics["/points"].rate == 8.0
        assert np.isnan(log.topics["/tf_static"].rate)
        assert [(one.topic, one.type, one.log_time) for one in got] == [
            (topic, kind, stamp) for topic, kind, _, stamp in sent
        ]
        for one, (_, _, message, _) in zip(got, sent, strict=True):
            assert plain(one.decode()) == plain(message)


@each("name, compression", KINDS)
def test_topics_and_start_choose_messages(write: Callable[..., Path], name: str, compression: str) -> None:
    with open_log(write(name, compression)) as log:
        times = [one.log_time for one in log.messages(["/points"], start=START + 1.0)]
        assert times == [START + k / 8 + 1 / 16 for k in range(8, SCANS)]
        with pytest.raises(OgmError, match=r"has no topic /nope; there are /points \(.*PointCloud2\), /tf"):
            next(log.messages(["/nope"]))


@each("name, compression", KINDS)
def test_headers_are_read_without_the_rest(write: Callable[..., Path], name: str, compression: str) -> None:
    with open_log(write(name, compression)) as log:
        heads = [log.head(ref) for ref in log.refs(["/points"])]
    assert [head.stamp for head in heads] == [START + k / 8 for k in range(SCANS)]
    assert {head.frame for head in heads} == {"lidar"}
    assert heads[1].time == int(START) * 10**9 + 125_000_000


def test_a_closed_log_is_not_read(write: Callable[..., Path]) -> None:
    with open_log(write("a.mcap")) as log:
        refs = log.refs()
    refused("closed", log.message, refs[0])


def test_parts_in_a_folder_are_one_log(tmp_path: Path) -> None:
    rows = drive(100)
    for part in range(11):  # part 10 comes after part 9, and metadata.yaml is not needed
        with LogWriter(tmp_path / f"drive_{part}.db3") as log:
            for topic, kind, message, stamp in rows[part::11]:
                log.write(topic, kind, message, stamp)
    with open_log(tmp_path) as log:
        assert [path.name for path in log.paths] == [f"drive_{part}.db3" for part in range(11)]
        assert [one.log_time for one in log.messages()] == sorted(row[3] for row in rows)
        assert log.topics["/points"].count == SCANS
    with LogWriter(tmp_path / "other.mcap"):
        pass
    refused("several kinds", open_log, tmp_path, error=OgmError)


@pytest.mark.parametrize("name", ["a.mcap", "a.db3", "a.bag"])
def test_an_error_leaves_the_file_that_was_there(write: Callable[..., Path], name: str) -> None:
    path = write(name, points=10)
    before = path.read_bytes()
    with pytest.raises(OgmError), LogWriter(path) as log:
        log.write("/tf", "no_msgs/msg/None", tf_message([]), START)
    assert path.read_bytes() == before
    assert [one.name for one in path.parent.iterdir()] == [name]


@each("name", ["a.mcap", "a.db3", "a.bag"])
def test_messages_that_do_not_fit_their_type_are_refused(tmp_path: Path, name: str) -> None:
    with LogWriter(tmp_path / name) as log:
        with pytest.raises(OgmError, match=r"/a \(no_msgs/msg/None\) cannot be written: its type is unknown"):
            log.write("/a", "no_msgs/msg/None", SimpleNamespace(), 1.0)
        with pytest.raises(OgmError, match="cannot be written: .*header"):
            log.write("/a", "geometry_msgs/msg/PoseStamped", tf_message([]), 1.0)
        log.write("/tf", TF, tf_message([]), 1.0)
    with open_log(tmp_path / name) as log:
        assert [one.topic for one in log.messages()] == ["/tf"]


def test_the_name_of_a_log_decides_its_kind(tmp_path: Path) -> None:
    refused(r"name it \.mcap, \.db3, \.bag", LogWriter, tmp_path / "a.npz")
    refused("zstd' for .mcap", LogWriter, tmp_path / "a.bag", "zstd")
    refused("no folder", LogWriter, tmp_path / "none" / "a.bag", error=FileNotFoundError)
    (tmp_path / "b.bag").mkdir()
    with pytest.raises(IsADirectoryError):
        LogWriter(tmp_path / "b.bag")
    with pytest.raises(ValueError, match="inside of the with block"):
        LogWriter(tmp_path / "a.bag").write("/tf", TF, tf_message([]), 1.0)


def test_a_decoded_ros2_message_goes_into_a_ros1_bag(write: Callable[..., Path], tmp_path: Path) -> None:
    pose = SimpleNamespace(position=SimpleNamespace(x=1.0, y=2.0, z=3.0), orientation=None)
    pose.orientation = SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    layout = SimpleNamespace(dim=[], data_offset=0)
    sheet = SimpleNamespace(
        header=SimpleNamespace(stamp=ros_stamp(START), frame_id="map"),
        info=SimpleNamespace(resolution=0.5, length_x=2.0, length_y=1.0, pose=pose), layers=["free"], basic_layers=[],
        data=[SimpleNamespace(layout=layout, data=np.arange(8, dtype=np.float32))],
        outer_start_index=0, inner_start_index=0,
    )  # fmt: skip
    with open_log(write("a.db3", points=10)) as log, LogWriter(tmp_path / "b.bag") as copy:
        for one in log.messages():
            copy.write(one.topic, one.type, one.decode(), one.log_time)
        copy.write("/grid", "grid_map_msgs/msg/GridMap", sheet, START)
    with open_log(tmp_path / "a.db3") as log, open_log(tmp_path / "b.bag") as copy:
        for one, other in zip(log.messages(["/points", "/tf"]), copy.messages(["/points", "/tf"]), strict=True):
            assert plain(one.decode()) == plain(other.decode())
        (got,) = [one.decode() for one in copy.messages(["/grid"])]
    assert got.info.header.frame_id == "map"  # where ROS 1 has it
    assert got.data[0].data.tolist() == list(range(8))
