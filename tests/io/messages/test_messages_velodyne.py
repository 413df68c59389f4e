"""Velodyne packets: recorded messages against the clouds of another driver, and captures."""

import logging
import sqlite3
import struct
from types import SimpleNamespace

import numpy as np
import pytest
from cases import each, needs, refused

from ogm.io import read_scan
from ogm.io.messages import scan_from_velodyne_scan, scans_from_pcap
from ogm.io.messages.velodyne import VELODYNE_MODELS
from ogm.pose import pose, transform_points
from ogm.storage.files import OgmError

needs("velodyne_decoder")
KIND = "velodyne_msgs/msg/VelodyneScan"

# folder, the message of the cloud beside it, its points, model, what 99 of 100 points keep to [m]
RECORDED = [
    ("vlp16", 3, 14831, "VLP-16", 0.03),
    ("vlp32", 0, 26216, "VLP-32C", 0.05),
    ("vls128", 1, 208680, "VLS-128", 0.35),
]


@pytest.fixture
def recorded(real, stores):
    """Give the messages of a bag, and the cloud that Nebula's driver made of one of them."""

    def read(folder):
        (bag,) = real("nebula_apache2").glob(f"{folder}/*/*.db3")
        (cloud,) = real("nebula_apache2").glob(f"{folder}/*.pcd")
        rows = sqlite3.connect(bag).execute("select data from messages order by timestamp").fetchall()
        return [stores[2].deserialize_cdr(row[0], KIND) for row in rows], read_scan(cloud)

    return read


@each("folder, which, number, model, tolerance", RECORDED)
def test_packets_give_the_cloud_of_the_other_driver(folder, which, number, model, tolerance, recorded):
    from scipy.spatial import cKDTree

    messages, cloud = recorded(folder)
    scan = scan_from_velodyne_scan(messages[which])
    assert len(cloud) == number
    assert abs(len(scan) - number) < 0.01 * number
    far, _ = cKDTree(scan.points[:, :3]).query(cloud.points[:, :3])
    back, _ = cKDTree(cloud.points[:, :3]).query(scan.points[:, :3])
    assert max(np.quantile(far, 0.99), np.quantile(back, 0.99)) < tolerance
    turned, _ = cKDTree(transform_points(pose(yaw=0.03), scan.points)[:, :3]).query(cloud.points[:, :3])
    assert np.quantile(turned, 0.5) > 3 * np.quantile(far, 0.5)  # so the axes are the same
    header = messages[which].header.stamp
    assert scan.stamp == header.sec + header.nanosec * 1e-9
    assert -1e-4 < scan.time.min() < 1e-4
    assert scan.time.max() < 0.11
    assert 0 < scan.points[:, 3].max() <= 1
    named = scan_from_velodyne_scan(messages[which], model, no_returns=False)
    np.testing.assert_array_equal(named.points, scan.points)
    assert named.no_returns is None


def test_beams_without_echo(recorded):
    """Distances that are 0 in the packets; and beams that are blanked there are found in their direction."""
    from scipy.spatial import cKDTree

    messages, _ = recorded("vlp32")
    message = messages[0]
    before = scan_from_velodyne_scan(message)
    distances = np.stack([p.data[:1200].reshape(12, 100)[:, 4:].reshape(12, 32, 3) for p in message.packets])
    silent = np.count_nonzero((distances[..., 0] == 0) & (distances[..., 1] == 0))
    assert 0.97 * silent < len(before.no_returns) <= silent
    rng = np.random.default_rng(0)
    for packet in message.packets:
        packet.data = packet.data.copy()
        blocks = packet.data[:1200].reshape(12, 100)[:, 4:].reshape(12, 32, 3)  # a view
        blocks[rng.random((12, 32)) < 0.05, :2] = 0
    after = scan_from_velodyne_scan(message)
    old, new = ({tuple(row) for row in scan.points[:, :3].tolist()} for scan in (before, after))
    assert new < old
    lost = np.array(sorted(old - new))
    assert len(lost) > 1000
    lost /= np.linalg.norm(lost, axis=1, keepdims=True)
    distance, _ = cKDTree(after.no_returns).query(lost)
    assert np.quantile(distance, 0.95) < np.radians(0.15)


def test_the_stamp_may_be_of_the_last_packet(recorded):
    messages, _ = recorded("vlp16")
    first = scan_from_velodyne_scan(messages[0], no_returns=False)
    messages[0].header.stamp = messages[0].packets[-1].stamp
    last = scan_from_velodyne_scan(messages[0], no_returns=False)
    np.testing.assert_allclose(last.time + last.stamp, first.time + first.stamp, atol=1e-6)
    assert last.time.min() < -0.09
    for packet in messages[0].packets:  # drivers that stamp no packets
        packet.stamp = SimpleNamespace(sec=0, nanosec=0)
    unset = scan_from_velodyne_scan(messages[0], no_returns=False)
    np.testing.assert_allclose(unset.time, first.time, atol=1e-6)


def test_packets_that_name_no_model(recorded):
    messages, _ = recorded("vlp16")
    message = messages[0]
    for packet in message.packets:
        packet.data = np.concatenate([packet.data[:-2], np.uint8([0x41, 0x22])])
    with pytest.raises(
        OgmError, match=r"last bytes of no known model [(]4122[)]: give as model one of VLP-16, Puck LITE"
    ):
        scan_from_velodyne_scan(message)
    assert len(scan_from_velodyne_scan(message, "vlp16")) > 10_000
    with pytest.raises(ValueError, match="no model 'OS1': give one of VLP-16") as caught:
        scan_from_velodyne_scan(message, "OS1")
    assert not isinstance(caught.value, OgmError)
    with pytest.raises(OgmError, match="VelodyneScan of velodyne at .* HDL-64E, which has individual angles"):
        scan_from_velodyne_scan(message, "HDL-64E S2")
    message.packets[1].data = message.packets[1].data[:-1]
    refused("151 packets, wanted some, of 1206 bytes each", scan_from_velodyne_scan, message, "VLP-16", error=OgmError)
    message.packets = []
    refused("has 0 packets", scan_from_velodyne_scan, message, error=OgmError)


def test_every_model_is_one_of_the_library():
    import velodyne_decoder

    for name in VELODYNE_MODELS.values():
        assert hasattr(velodyne_decoder.Model, name)


def test_calibrations(recorded, tmp_path):
    messages, _ = recorded("vlp16")
    (tmp_path / "angles.yaml").write_text("no calibration")
    with pytest.raises(OgmError, match=r"angles.yaml is no calibration of a Velodyne"):
        scan_from_velodyne_scan(messages[0], calibration=tmp_path / "angles.yaml")
    import velodyne_decoder

    of_model = velodyne_decoder.get_bundled_calibration("VLP-16.yml")
    of_model.write(str(tmp_path / "angles.yaml"))
    given = scan_from_velodyne_scan(messages[0], calibration=tmp_path / "angles.yaml")
    plain = scan_from_velodyne_scan(messages[0])
    np.testing.assert_array_equal(given.points[:, [0, 1, 3]], plain.points[:, [0, 1, 3]])
    assert 0.01 < np.abs(given.points - plain.points).max() < 0.012  # the lasers' heights in the sensor, 11.2 mm


@each("name, model, turns", [("hdl32", "HDL32E", 2), ("vlp16_gps", "VLP16", 3)])
def test_captures(name, model, turns, real):
    import velodyne_decoder

    path = real(f"velodyne_pcap/sample_velodyne_{name}.pcap")
    scans = list(scans_from_pcap(path))
    assert len(scans) == turns
    config = velodyne_decoder.Config(model=getattr(velodyne_decoder.Model, model), timestamp_first_packet=True)
    by_library = [one.points for one in velodyne_decoder.read_pcap(path, config)]
    every = {row.tobytes() for points in by_library for row in np.ascontiguousarray(points[:, :3])}
    ours = [row.tobytes() for scan in scans for row in np.ascontiguousarray(scan.points[:, :3])]
    assert sum(row in every for row in ours) > 0.999 * len(ours)
    for scan, points in zip(scans, by_library, strict=False):
        assert abs(len(scan) - len(points)) < 0.02 * len(points)
        assert 0.09 < scan.time.max() - scan.time.min() < 0.12
    assert np.diff([scan.stamp for scan in scans]) == pytest.approx(0.1, abs=0.02)
    assert len(list(scans_from_pcap(path, model, no_returns=False))) == turns


def capture(path, packets, sources=("192.168.1.201",), link=1):
    """Write packets of UDP, by turns from several sensors, as tcpdump does."""
    with open(path, "wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, link))
        for k, data in enumerate(packets):
            udp = struct.pack(">HHHH", 2368, 2368, 8 + len(data), 0) + data
            source = bytes(map(int, sources[k % len(sources)].split(".")))
            ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0) + source + b"\xff" * 4 + udp
            ethernet = b"\xff" * 6 + b"\1\2\3\4\5\6" + b"\x08\x00" + ip
            sll = struct.pack(">HHH8sH", 0, 1, 6, b"", 0x0800) + ip
            sll2 = struct.pack(">HHiHBB8s", 0x0800, 0, 1, 1, 0, 6, b"") + ip
            raw = {1: ethernet, 113: sll, 276: sll2, 0: struct.pack("<I", 2) + ip}.get(link, ip)
            file.write(struct.pack("<IIII", 1000 + k // 1000, k % 1000 * 1000, len(raw), len(raw)) + raw)


def packets_of(messages):
    return [packet.data.tobytes() for message in messages for packet in message.packets]


def test_what_is_left_at_the_end_is_no_scan(recorded, tmp_path, caplog):
    packets = packets_of(recorded("vlp16")[0])
    path = tmp_path / "drive.pcap"
    caplog.set_level(logging.INFO)
    capture(path, [*packets[:380], b"other", b"\0" * 512])
    scans = list(scans_from_pcap(path))
    assert [scan.stamp for scan in scans] == pytest.approx([1000, 1000.151], abs=0.003)
    assert "at the end are no complete turn" in caplog.text
    capture(path, packets[:302])
    assert len(list(scans_from_pcap(path))) == 2
    capture(path, packets[:100])
    refused("drive.pcap has no complete turn of the sensor, only 23", list, scans_from_pcap(path), error=OgmError)


@each("link", [1, 113, 276, 101, 12, 228, 0])  # Ethernet, the "any" device of Linux (two versions), IP alone, loopback
def test_captures_of_all_link_layers(link, tmp_path):
    path = tmp_path / "drive.pcap"
    firings = [np.full(600, 100 * n % 36000, "<u2").tobytes() + b"\0\0\0\0\x37\x22" for n in range(725)]
    packets = [b"\xff\xee" + one[:2] + one[4:] for one in firings]
    damaged = [one[:-1] + b"\x99" if n == 7 else one for n, one in enumerate(packets)]
    capture(path, damaged, link=link)
    assert len(list(scans_from_pcap(path, no_returns=False))) == 2


def test_captures_of_other_link_layers_are_refused(tmp_path):
    capture(tmp_path / "drive.pcap", [b"x"], link=127)
    refused(
        "capture of link layer 127, wanted Ethernet", list, scans_from_pcap(tmp_path / "drive.pcap"), error=OgmError
    )


def test_several_sensors_in_one_capture(recorded, tmp_path):
    packets = packets_of(recorded("vlp16")[0])
    twice = [packet for packet in packets for _ in range(2)]
    path = tmp_path / "drive.pcap"
    capture(path, twice, ("10.0.0.1", "10.0.0.2"))
    with pytest.raises(OgmError, match="several sensors, 10.0.0.1:2368 and 10.0.0.2:2368: give one as source"):
        list(scans_from_pcap(path))
    several = list(scans_from_pcap(path, source="10.0.0.2:2368"))
    capture(path, packets)
    alone = list(scans_from_pcap(path))
    assert len(several) == len(alone) == 3
    for one, other in zip(several, alone, strict=True):
        np.testing.assert_array_equal(one.points, other.points)
    with pytest.raises(OgmError, match="no packets of 1206 bytes from 10.0.0.9:1"):
        list(scans_from_pcap(path, source="10.0.0.9:1"))


def test_captures_that_are_none_or_cut(recorded, tmp_path, caplog):
    path = tmp_path / "drive.pcap"
    refused(r"drive.pcap", list, scans_from_pcap(path), error=FileNotFoundError)
    for content in (b"", b"x" * 10, b"x" * 500):
        path.write_bytes(content)
        refused("drive.pcap is no network capture", list, scans_from_pcap(path), error=OgmError)
    capture(path, [])
    refused("no packets of 1206 bytes, as sent by a Velodyne", list, scans_from_pcap(path), error=OgmError)
    capture(path, packets_of(recorded("vlp16")[0]))
    whole = path.read_bytes()
    frame = 16 + 14 + 28 + 1206
    for cut in (24 + 320 * frame + 7, 24 + 320 * frame + 600):  # within a header, within a packet
        path.write_bytes(whole[:cut])
        assert len(list(scans_from_pcap(path))) == 2
    path.write_bytes(whole[: 24 + 320 * frame + 7])
    caplog.clear()
    list(scans_from_pcap(path))
    assert "drive.pcap is cut short" in caplog.text
