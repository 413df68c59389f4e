"""Livox ``CustomMsg``: bytes of ROS 1 and ROS 2, and objects."""

import contextlib
import struct
from types import SimpleNamespace

import numpy as np
from cases import each, refused
from hypothesis import given
from hypothesis import strategies as st

from ogm.io.messages import scan_from_livox
from ogm.storage.files import OgmError

KIND = "livox_ros_driver2/msg/CustomMsg"
T0 = 1_700_000_000


def custom(stores, number, frame="livox_frame", stamp=(T0, 500_000_000), timebase=T0 * 10**9 + 500_000_000, ros=2):
    rng = np.random.default_rng(number)
    store = stores[ros]
    point = store.types["livox_ros_driver2/msg/CustomPoint"]
    xyz = rng.normal(0, 20, (number, 3)).astype(np.float32)
    points = [
        point(k * 5000, *map(float, xyz[k]), int(rng.integers(256)), int(rng.integers(64)), k % 6)
        for k in range(number)
    ]
    header = SimpleNamespace(seq=9, stamp=SimpleNamespace(sec=stamp[0], nanosec=stamp[1]), frame_id=frame)
    return SimpleNamespace(header=header, timebase=timebase, point_num=number, lidar_id=1,
                           rsvd=np.zeros(3, np.uint8), points=points)  # fmt: skip


@each("number, frame", [(0, ""), (1, "a"), (2, "ab"), (2, "abc"), (501, "livox_frame")])  # all ways to be aligned
def test_bytes_and_objects_are_the_same_scan(number, frame, stores):
    message = custom(stores, number, frame)
    cdr = bytes(stores[2].serialize_cdr(message, KIND))
    big = bytes(stores[2].serialize_cdr(message, KIND, little_endian=False))
    ros1 = bytes(stores[1].serialize_ros1(message, KIND))
    expected = scan_from_livox(stores[2].deserialize_cdr(cdr, KIND))
    assert expected.stamp == T0 + 0.5
    np.testing.assert_array_equal(
        expected.points[:, :3], np.float32([[p.x, p.y, p.z] for p in message.points]).reshape(-1, 3)
    )
    np.testing.assert_allclose(expected.points[:, 3], [p.reflectivity / 255 for p in message.points], rtol=1e-6)
    np.testing.assert_array_equal(expected.ring, [p.line for p in message.points])
    np.testing.assert_allclose(expected.time, [p.offset_time * 1e-9 for p in message.points], atol=1e-9)
    for raw in (cdr, big, ros1, memoryview(cdr), np.frombuffer(ros1, np.uint8)):
        scan = scan_from_livox(raw)
        assert scan.stamp == expected.stamp
        for name in ("points", "ring", "time"):
            np.testing.assert_array_equal(getattr(scan, name), getattr(expected, name))


def test_padding_at_the_end_is_none_of_the_last_point(stores):
    raw = bytes(stores[2].serialize_cdr(custom(stores, 3), KIND))
    assert len(scan_from_livox(raw + b"\0")) == 3


def test_the_time_base_and_the_stamp(stores):
    later = custom(stores, 4, stamp=(T0, 600_000_000))  # the header has the end of the sweep
    np.testing.assert_allclose(scan_from_livox(later).time, np.arange(4) * 5e-6 - 0.1, atol=3e-7)
    other = custom(stores, 4, timebase=123 * 10**9)  # the sensor counts since it was switched on
    assert scan_from_livox(other).stamp == T0 + 0.5
    np.testing.assert_allclose(scan_from_livox(other).time, np.arange(4) * 5e-6, atol=1e-12)
    unset = custom(stores, 4, stamp=(0, 0))
    assert scan_from_livox(unset).stamp == T0 + 0.5
    np.testing.assert_allclose(scan_from_livox(unset).time, np.arange(4) * 5e-6, atol=1e-12)


def test_points_at_the_origin_are_dropped(stores):
    message = custom(stores, 5)
    message.points[2].x = message.points[2].y = message.points[2].z = 0.0
    scan = scan_from_livox(bytes(stores[2].serialize_cdr(message, KIND)))
    assert scan.ring.tolist() == [0, 1, 3, 4]
    assert scan.time.tolist() == [0.0, 5e-6, 15e-6, 20e-6]


@given(st.data())
def test_what_is_cut_or_no_message_is_refused(stores, data):
    message = custom(stores, 7)
    write = data.draw(st.sampled_from(["cdr", "ros1"]))
    raw = bytes(stores[2].serialize_cdr(message, KIND) if write == "cdr" else stores[1].serialize_ros1(message, KIND))
    cut = raw[: data.draw(st.integers(0, len(raw) - 1))]
    refused(f"{len(cut)} bytes are no Livox CustomMsg", scan_from_livox, cut, error=OgmError)


@given(st.binary(max_size=200))
def test_any_bytes_give_a_scan_or_an_error(raw):
    with contextlib.suppress(OgmError):
        scan_from_livox(raw)


def test_a_count_beyond_the_bytes_takes_no_memory(stores):
    raw = bytearray(stores[2].serialize_cdr(custom(stores, 3), KIND))
    at = raw.index(struct.pack("<I", 3), 40)
    for count in (2**31, 2**32 - 1):
        raw[at : at + 4] = struct.pack("<I", count)
        raw[at + 8 : at + 12] = struct.pack("<I", count)
        refused("no Livox CustomMsg", scan_from_livox, raw, error=OgmError)
