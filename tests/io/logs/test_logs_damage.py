"""Damaged logs: what is whole is read, the rest is reported, and nothing but `OgmError` is raised."""

import io
import re
import sqlite3
import struct
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from cases import each, refused
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from small_drive import KINDS, SCANS, drive

from ogm.io.logs import LogWriter, open_log
from ogm.storage.files import OgmError


def sent() -> list[tuple[str, float]]:
    return sorted(((topic, stamp) for topic, _, _, stamp in drive(1)), key=lambda row: row[1])


def got(path: Path) -> tuple[list[tuple[str, float]], list[str]]:
    """Read and decode all that there is."""
    with open_log(path) as log:
        messages = list(log.messages())
        for one in messages:
            one.decode()
        return [(one.topic, one.log_time) for one in messages], log.warnings


def whole_before(data: bytes) -> int:
    """Count the messages of a cut MCAP by the format's own reader, chunk by chunk."""
    count = 0
    try:
        for _ in NonSeekingReader(io.BytesIO(data)).iter_messages(log_time_order=False):
            count += 1
    except Exception:  # its end
        return count
    return count


@each("name, compression", KINDS)
def test_a_log_that_is_cut_at_60_percent_is_read_up_to_there(
    write: Callable[..., Path], name: str, compression: str
) -> None:
    path = write(name, compression)
    data = path.read_bytes()
    cut = data[: int(0.6 * len(data))]
    path.write_bytes(cut)
    messages, (warning,) = got(path)
    assert messages == sent()[: len(messages)]
    assert 10 <= len(messages) < 16  # of 25: 60 %, or one scan less
    assert re.search(r"is cut( or damaged)? ", warning)
    assert str(path) in warning
    if path.suffix == ".mcap":
        assert len(messages) >= whole_before(cut)
    with pytest.raises(Exception, match=r".") as other, AnyReader([path]) as reader:  # rosbags reads none
        list(reader.messages())
    assert not isinstance(other.value, OgmError)


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0, 1), kind=st.sampled_from(KINDS))
def test_cut_anywhere_the_beginning_is_read(
    tmp_path_factory: pytest.TempPathFactory, share: float, kind: tuple[str, str]
) -> None:
    folder = tmp_path_factory.mktemp("cut")
    path = folder / kind[0]
    with LogWriter(path, kind[1]) as log:
        for row in drive(300):
            log.write(*row)
    data = path.read_bytes()
    cut = data[: int(share * len(data))]
    path.write_bytes(cut)
    try:
        messages, warnings = got(path)
    except OgmError:  # nothing of it is left
        return
    assert messages == sent()[: len(messages)] or path.suffix == ".db3"  # its rows lie as SQLite likes
    assert set(messages) <= set(sent())
    assert warnings or len(messages) == len(sent())
    if path.suffix == ".mcap":
        assert len(messages) >= whole_before(cut)


@settings(max_examples=30, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(kind=st.sampled_from(KINDS), data=st.data())
def test_bytes_overwritten_anywhere_raise_nothing_else(
    tmp_path_factory: pytest.TempPathFactory, kind: tuple[str, str], data: st.DataObject
) -> None:
    path = tmp_path_factory.mktemp("bytes") / kind[0]
    with LogWriter(path, kind[1]) as log:
        for row in drive(300):
            log.write(*row)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.one_of(st.integers(0, len(content) - 1), st.integers(0, 4000)))
        content[at : at + 8] = data.draw(st.binary(min_size=8, max_size=8))
    path.write_bytes(content)
    with suppress(OgmError), open_log(path) as log:
        for one in log.messages():
            with suppress(OgmError):
                one.decode()


def chunks(path: Path) -> list[tuple[int, int]]:
    """Return begin and length of the stored bytes of an MCAP's chunks."""
    data, position, found = path.read_bytes(), 8, []
    while position < len(data) - 8:
        opcode, length = struct.unpack_from("<BQ", data, position)
        if opcode == 6:
            name = struct.unpack_from("<I", data, position + 37)[0]
            start = position + 41 + name + 8
            found.append((start, position + 9 + length - start))
        position += 9 + length
    return found


@each("compression", ["", "zstd"])
def test_of_a_damaged_chunk_alone_messages_are_lost(write: Callable[..., Path], compression: str) -> None:
    path = write("a.mcap", compression, points=100_000)  # a scan is larger than a chunk
    all_chunks = chunks(path)
    assert len(all_chunks) == SCANS + 1
    content = bytearray(path.read_bytes())
    start, length = all_chunks[5]
    content[start + length // 2 : start + length // 2 + 200] = bytes(200)
    path.write_bytes(content)
    messages, warnings = got(path)
    lost = set(sent()) - set(messages)
    assert [topic for topic, _ in lost] == ["/points"] if not compression else {topic for topic, _ in lost}
    assert len(messages) >= len(sent()) - 2
    assert any(f"chunk at byte {start} is damaged" in warning for warning in warnings)
    with open_log(path) as log:  # the others by their places
        refs = log.refs(["/points"])
        assert len(bytes(log.message(refs[-1]).raw)) > 10**6


def test_a_checksum_that_does_not_fit_is_noticed(write: Callable[..., Path]) -> None:
    path = write("a.mcap", points=100_000)
    content = bytearray(path.read_bytes())
    start, length = chunks(path)[0]
    content[start + length - 5000] ^= 1  # one bit of a point
    path.write_bytes(content)
    messages, (warning,) = got(path)
    assert len(messages) == len(sent()) - 1
    assert "its checksum does not match" in warning
    refused("crc", list, StreamReader(io.BytesIO(bytes(content)), validate_crcs=True).records)


@each("name", ["a.mcap", "a.db3", "a.bag"])
def test_the_first_bytes_decide_whatever_the_name(write: Callable[..., Path], name: str) -> None:
    path = write(name, points=10)
    for other in (".mcap", ".db3", ".bag"):
        assert got(path.rename(path.with_suffix(other)))[0] == sent()
        path = path.with_suffix(other)


@each("content, reason", [
        (b"", "holds 0 bytes"),
        (b"stamp,x,y,z\n1,2,3,4\n", "is no log: it begins with b'stamp"),
        (bytes(range(256)) * 100, "is no log"),
        (b"\x28\xb5\x2f\xfd" + bytes(100), "unpack it first: zstd -d"),
        (b"SQLite format 3\0" + bytes(5000), "no readable ROS 2 bag"),
        (b"#ROSBAG V1.2\n" + bytes(100), "begins with b'#ROSBAG V1.2"),
    ])  # fmt: skip
@each("ending", [".mcap", ".db3", ".bag"])
def test_what_is_no_log_is_refused(tmp_path: Path, content: bytes, reason: str, ending: str) -> None:
    path = tmp_path / f"a{ending}"
    path.write_bytes(content)
    with pytest.raises(OgmError, match=re.escape(reason)) as error:
        open_log(path)
    assert str(error.value).count(str(path)) == 1


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    refused(r"there is no .*a\.bag", open_log, tmp_path / "a.bag", error=FileNotFoundError)
    refused("holds no log", open_log, tmp_path, error=OgmError)


def test_a_database_of_something_else_is_refused(tmp_path: Path) -> None:
    import sqlite3

    with sqlite3.connect(tmp_path / "a.db3") as base:
        base.execute("CREATE TABLE topics (id INTEGER)")
    base.close()
    refused("no readable ROS 2 bag", open_log, tmp_path / "a.db3", error=OgmError)


def test_an_encrypted_bag_is_refused(write: Callable[..., Path]) -> None:
    path = write("a.bag", points=10)
    content = path.read_bytes()
    field = b"encryptor=rosbag/AesCbcEncryptor"
    size = struct.unpack_from("<I", content, 13)[0]
    header = content[17 : 17 + size] + struct.pack("<I", len(field)) + field
    padding = struct.unpack_from("<I", content, 17 + size)[0] - len(field) - 4
    rest = content[13 + 4096 :]
    path.write_bytes(
        content[:13] + struct.pack("<I", len(header)) + header + struct.pack("<I", padding) + bytes(padding) + rest
    )
    refused("is encrypted", open_log, path, error=OgmError)


@each("row, read", [
        ("NULL,1,2,x'01'", True), ("'abc',1,2,x'01'", True), ("1.5,1,2,x'01'", True), ("7,1,2,x'01'", True),
        ("2,'a',1,x'00'", False), ("2,1,'b',x'00'", False), ("2,NULL,NULL,NULL", False), ("2,9,1,x'00'", False),
    ])  # fmt: skip
def test_rows_of_a_db3_need_a_topic_and_a_time_but_no_id(tmp_path: Path, row: str, read: bool) -> None:
    with sqlite3.connect(tmp_path / "a.db3") as base:
        base.executescript(
            "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
            "CREATE TABLE messages(id, topic_id, timestamp, data BLOB);"
            "INSERT INTO topics VALUES(1, '/map', 'nav_msgs/msg/OccupancyGrid', 'cdr');"
            f"INSERT INTO messages VALUES(7, 1, 1, x'00'); INSERT INTO messages VALUES({row});"
        )
    log = open_log(tmp_path / "a.db3")
    assert [bytes(message.raw) for message in log.messages()] == [b"\0", b"\1"][: 1 + read]
    assert [warning.partition(": ")[2][:30] for warning in log.warnings] == ["1 messages are left out: their"] * (
        not read
    )
