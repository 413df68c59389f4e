"""Targets: logs (ROS 1 bags, ROS 2 bags, MCAP), read as messages and as a data set, and captures of packets."""

import io
import struct
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from targets import Target, check_poses, check_scan, cloud

from ogm.datasets import open_dataset
from ogm.io.logs import LogWriter, open_log
from ogm.io.messages import StampedTransform, point_cloud2, scans_from_pcap, tf_message
from ogm.pose import pose
from ogm.scan import Scan
from ogm.storage.files import OgmError

CLOUD, TF = "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"
START = 1_700_000_000.0  # [s]


def drive() -> list[tuple[str, str, Any, float]]:
    """Return topics, types, messages and log times of a drive of four scans."""
    static = tf_message([StampedTransform("base_link", "lidar", START, pose(z=1.75))])
    rows: list[tuple[str, str, Any, float]] = [("/tf_static", TF, static, START)]
    for k in range(4):
        stamp = START + k / 8
        scan = Scan(cloud(), stamp=stamp, ring=np.arange(24) % 4, time=np.linspace(0, 0.1, 24))
        rows.append(("/points", CLOUD, point_cloud2(scan, frame_id="lidar"), stamp + 1 / 16))
        moving = tf_message([StampedTransform("map", "base_link", stamp, pose(x=k, yaw=0.1 * k))])
        rows.append(("/tf", TF, moving, stamp + 1 / 8))
    return rows


def _messages(path: Path) -> None:
    with open_log(path) as log:
        for message in log.messages():
            with suppress(OgmError):
                message.decode()
        for ref in log.iter_refs():
            with suppress(OgmError):
                log.head(ref)


def _frames(path: Path) -> None:
    dataset = open_dataset(path, sensor_height=1.8)
    for n in range(min(len(dataset), 4)):
        with suppress(OgmError):
            frame = dataset[n]
            check_scan(frame.scan)
            if frame.T_map_sensor is not None:
                check_poses(frame.T_map_sensor)


def _written(name: str, packing: str, frames: bool, folder: Path) -> Target:
    path = folder / name
    with LogWriter(path, packing) as log:
        for row in drive():
            log.write(*row)
    read = _frames if frames else _messages
    return Target({name: path.read_bytes()}, lambda files: read(files / name))


def _packed_mcap(folder: Path) -> Target:
    """An MCAP of another writer, with chunks in lz4, statistics and an index."""
    from mcap.writer import CompressionType, Writer

    with LogWriter(folder / "own.mcap", "") as log:
        for row in drive():
            log.write(*row)
    stream = io.BytesIO()
    writer = Writer(stream, chunk_size=2000, compression=CompressionType.LZ4)
    writer.start("ros2")
    with open_log(folder / "own.mcap") as log:
        channels: dict[str, int] = {}
        for message in log.messages():
            if message.topic not in channels:
                schema = writer.register_schema(message.type, "ros2msg", message.channel.definition.encode())
                channels[message.topic] = writer.register_channel(message.topic, "cdr", schema)
            time = int(message.log_time * 1e9)
            writer.add_message(channels[message.topic], time, bytes(message.raw), time)
    writer.finish()
    return Target({"a.mcap": stream.getvalue()}, lambda files: _messages(files / "a.mcap"))


def _packed_bag(packing: str, folder: Path) -> Target:
    """A bag of another writer with packed chunks."""
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Writer(folder / "a.bag")
    writer.set_compression(Writer.CompressionFormat[packing])
    with writer:
        topic = writer.add_connection("/points", CLOUD, typestore=store)
        for _, kind, message, stamp in drive():
            if kind == CLOUD:
                writer.write(topic, int(stamp * 1e9), store.serialize_ros1(message, CLOUD))
    return Target({"a.bag": (folder / "a.bag").read_bytes()}, lambda files: _messages(files / "a.bag"))


def packets(count: int = 26) -> list[bytes]:
    """Return packets of a VLP-16, in whose steps one turn has 25 packets."""
    found = []
    for k in range(count):
        blocks = b""
        for block in range(12):
            azimuth = (120 * (12 * k + block)) % 36000
            returns = [(500 + 37 * n + 11 * block, (17 * n + k) % 256) if n % 5 else (0, 0) for n in range(32)]
            blocks += b"\xff\xee" + struct.pack("<H", azimuth) + b"".join(struct.pack("<HB", *one) for one in returns)
        found.append(blocks + struct.pack("<I", 1327 * k) + b"\x37\x22")
    return found


def _capture(folder: Path) -> Target:
    frames = []
    for k, payload in enumerate(packets()):
        udp = struct.pack(">HHHH", 2368, 2368, 8 + len(payload), 0) + payload
        ip = struct.pack(
            ">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), k, 0, 64, 17, 0, bytes((192, 168, 1, 201)), b"\xff" * 4
        )
        frame = b"\xff" * 6 + bytes(6) + b"\x08\x00" + ip + udp
        frames.append(struct.pack("<IIII", 1_700_000_000, 1327 * k, len(frame), len(frame)) + frame)
    data = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1) + b"".join(frames)

    def read(files: Path) -> None:
        for scan in scans_from_pcap(files / "a.pcap"):
            check_scan(scan)

    return Target({"a.pcap": data}, read)


def _capture_ng(folder: Path) -> Target:
    """The same packets as blocks of the newer format."""
    old = _capture(folder).files["a.pcap"]
    out = struct.pack("<IIIHHqI", 0x0A0D0D0A, 28, 0x1A2B3C4D, 1, 0, -1, 28)
    out += struct.pack("<IIHHII", 1, 20, 1, 0, 65535, 20)
    at = 24
    while at < len(old):
        sec, usec, size, _ = struct.unpack_from("<IIII", old, at)
        stamp, gap = sec * 10**6 + usec, -size % 4
        whole = 32 + size + gap
        out += struct.pack("<IIIIIII", 6, whole, 0, stamp >> 32, stamp & 0xFFFFFFFF, size, size)
        out += old[at + 16 : at + 16 + size] + bytes(gap) + struct.pack("<I", whole)
        at += 16 + size
    return Target({"a.pcapng": out}, lambda files: [check_scan(one) for one in scans_from_pcap(files / "a.pcapng")])


TARGETS = {
    **{
        f"{use}-{name}": partial(_written, f"a.{name.partition('-')[0]}", name.partition("-")[2], use == "frames")
        for name in ("mcap", "mcap-zstd", "db3", "bag")
        for use in ("log", "frames")
    },
    "log-mcap-lz4": _packed_mcap,
    "log-bag-bz2": partial(_packed_bag, "BZ2"),
    "log-bag-lz4": partial(_packed_bag, "LZ4"),
    "pcap": _capture,
    "pcapng": _capture_ng,
}
