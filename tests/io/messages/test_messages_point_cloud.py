"""`scan_from_point_cloud2` and `point_cloud2`."""

import array
from types import SimpleNamespace

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given
from hypothesis import strategies as st

from ogm.io import read_points
from ogm.io.messages import point_cloud2, scan_from_point_cloud2
from ogm.scan import Scan
from ogm.storage.files import OgmError

CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
CLOUD = "sensor_msgs/msg/PointCloud2"
T0 = 1_700_000_000


def stamped(seconds=T0, frame="lidar"):
    sec = int(seconds)
    return SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=round((seconds - sec) * 1e9)), frame_id=frame, seq=0)


def message(columns, *, height=1, big=False, gap=0, padding=0, header=None):
    """Lay columns (name -> array with a type) out in records, `gap` bytes before each field, padded rows."""
    number = len(next(iter(columns.values()))) if columns else 0
    fields, offset = [], 0
    for name, column in columns.items():
        offset += gap
        count = 1 if column.ndim == 1 else column.shape[1]
        fields.append(SimpleNamespace(name=name, offset=offset, datatype=CODES[column.dtype.str[1:]], count=count))
        offset += column.dtype.itemsize * count
    step = offset + gap
    records = np.full((number, step), 0xAB, np.uint8)
    for field, column in zip(fields, columns.values(), strict=True):
        raw = column.astype(column.dtype.newbyteorder(">" if big else "<")).reshape(number, -1)
        records[:, field.offset : field.offset + raw.shape[1] * raw.itemsize] = raw.view(np.uint8).reshape(number, -1)
    width = number // height
    rows = np.full((height, width * step + padding), 0xCD, np.uint8)
    rows[:, : width * step] = records.reshape(height, -1)
    return SimpleNamespace(
        header=header or stamped(), height=height, width=width, fields=fields, is_bigendian=big, point_step=step,
        row_step=rows.shape[1], data=rows.reshape(-1), is_dense=False,
    )  # fmt: skip


def columns(number=60, **more):
    rng = np.random.default_rng(2)
    xyz = {name: rng.integers(-4000, 4000, number).astype("f4") / 64 for name in "xyz"}
    return xyz | more


@given(
    st.permutations(["x", "y", "z", "ring", "intensity", "time", "junk"]), st.sampled_from(["f4", "f8"]),
    st.sampled_from(["u1", "i2", "u2", "i4", "u4", "f4", "f8"]), st.sampled_from(["u4", "i4", "f4", "f8"]),
    st.booleans(), st.integers(0, 5), st.sampled_from([(1, 0), (1, 7), (6, 0), (6, 3)]),
)  # fmt: skip
def test_any_layout_gives_the_same_scan(order, real, whole, clock, big, gap, rows):
    rng = np.random.default_rng(1)
    plain = columns(ring=np.arange(60) % 6, intensity=rng.integers(0, 128, 60), junk=rng.random((60, 3)))
    seconds = np.arange(60) / 512
    typed = {name: plain[name].astype(real) for name in "xyz"}
    typed |= {"ring": plain["ring"].astype(whole), "intensity": plain["intensity"].astype("u1"), "junk": plain["junk"]}
    typed["time"] = (seconds * (1e9 if clock[0] in "iu" else 1)).astype(clock)
    height, padding = rows
    laid = message({name: typed[name] for name in order}, height=height, big=big, gap=gap, padding=padding)
    scan = scan_from_point_cloud2(laid)
    np.testing.assert_array_equal(scan.points[:, :3], np.stack([plain[name] for name in "xyz"], 1))
    np.testing.assert_allclose(scan.points[:, 3], plain["intensity"] / 255, rtol=1e-6)
    np.testing.assert_array_equal(scan.ring, plain["ring"])
    np.testing.assert_allclose(scan.time, seconds, atol=1e-9)
    assert scan.stamp == T0
    assert scan.doppler is None
    assert scan.points.flags.owndata
    assert not np.shares_memory(scan.time, laid.data)


@each("ros", [1, 2])
def test_rosbags_carries_scans_there_and_back(ros, sent):
    rng = np.random.default_rng(0)
    scan = Scan(
        np.c_[rng.normal(0, 20, (50, 3)), rng.random(50)].astype(np.float32), stamp=T0 + 0.123456789,
        time=np.linspace(-0.05, 0.05, 50), ring=np.arange(50) % 16, doppler=rng.normal(size=50),
        rcs=rng.normal(size=50),
    )  # fmt: skip
    arrived = sent(point_cloud2(scan, frame_id="lidar"), CLOUD, ros)
    assert arrived.header.frame_id == "lidar"
    back = scan_from_point_cloud2(arrived)
    for name in ("points", "ring", "doppler", "rcs", "stamp"):
        np.testing.assert_array_equal(getattr(back, name), getattr(scan, name))
    np.testing.assert_allclose(back.time, scan.time, atol=1e-8)


def test_mcap_and_genpy_read_what_we_write(by_mcap, ros1_class, stores):
    scan = Scan(np.array([[1, 2, 3, 0.5], [-4, 5, 6, 1]], np.float32), stamp=12.5, ring=[7, 8])
    plain = point_cloud2(scan, frame_id="front")
    ros1 = ros1_class(CLOUD)().deserialize(bytes(stores[1].serialize_ros1(plain, CLOUD)))
    for arrived in (by_mcap(plain, CLOUD), ros1):
        assert [field.name for field in arrived.fields] == ["x", "y", "z", "intensity", "ring"]
        records = np.frombuffer(arrived.data, np.dtype("f4,f4,f4,f4,u2"))
        assert records.tolist() == [(1, 2, 3, 0.5, 7), (-4, 5, 6, 1, 8)]
        back = scan_from_point_cloud2(arrived)
        np.testing.assert_array_equal(back.points, scan.points)
        assert back.stamp == 12.5


def test_an_empty_scan(sent):
    empty = Scan(np.empty((0, 4), np.float32), stamp=1.0, time=[], ring=[])
    back = scan_from_point_cloud2(sent(point_cloud2(empty, frame_id="a"), CLOUD))
    assert back.points.shape == (0, 4)
    assert back.ring.shape == back.time.shape == (0,)
    bare = message({})
    assert len(scan_from_point_cloud2(bare)) == 0


def test_bytes_come_in_many_shapes():
    wanted = scan_from_point_cloud2(message(columns())).points
    data = message(columns()).data
    other = message(columns())
    for form in (bytes(data), bytearray(data), array.array("B", data.tobytes()), data.tolist(), data.view(np.int8)):
        other.data = form
        np.testing.assert_array_equal(scan_from_point_cloud2(other).points, wanted)
    other.data = "text"
    refused("data that are no bytes, but str", scan_from_point_cloud2, other, error=OgmError)


def test_rows_without_a_point_are_dropped_with_all_they_have():
    given = columns(ring=np.arange(60, dtype="u2"), t=np.arange(60, dtype="u4"))
    given["x"][3], given["y"][10], given["z"][11] = np.nan, np.inf, -np.inf
    for name in "xyz":
        given[name][20] = 0
    kept = np.setdiff1d(np.arange(60), [3, 10, 11, 20])
    for big in (False, True):
        scan = scan_from_point_cloud2(message(given, big=big), time_unit=1e-9)
        np.testing.assert_array_equal(scan.ring, kept)
        np.testing.assert_allclose(scan.time, kept * 1e-9)
        assert np.isfinite(scan.points).all()


def sweep(unit, kind, base=0.0, number=64):
    """Give times of a sweep of 0.1 s, and them as a message has them."""
    seconds = np.arange(number) / 640
    if kind[0] in "iu":
        return seconds, np.round(round(base / unit) + np.round(seconds / unit)).astype(kind)
    return seconds, ((base + seconds) / unit).astype(kind)


@each("unit, kind, base, given, late, tolerance", [
        (1.0, "f4", 0.0, None, 0.0, 1e-7),  # Velodyne, since the stamp
        (1e-9, "u4", 0.0, None, 0.0, 1e-9),  # Ouster, Livox
        (1e-6, "u4", 0.0, 1e-6, 0.0, 1e-6),
        (1e-3, "f8", 0.0, 1e-3, 0.0, 1e-9),
        (1.0, "f8", -0.1, None, -0.1, 1e-9),  # the stamp is of the sweep's end
        (1e-9, "i4", -0.1, None, -0.1, 1e-9),
        (1.0, "f8", T0, None, 0.0, 1e-6),  # Hesai, RoboSense: a clock's time
        (1.0, "f8", T0 - 0.1, None, -0.1, 1e-6),
        (1e-9, "f8", T0, None, 0.0, 1e-6),  # livox_ros_driver2
        (1e-3, "f8", T0 + 0.05, None, 0.05, 1e-6),
    ])  # fmt: skip
def test_times_under_all_their_names_and_units(unit, kind, base, given, late, tolerance):
    seconds, raw = sweep(unit, kind, base)
    for name in ("time", "t", "timestamp", "offset_time", "time_offset", "Time"):
        scan = scan_from_point_cloud2(message(columns(64) | {name: raw}), time_unit=given)
        assert scan.stamp == T0
        np.testing.assert_allclose(scan.time, seconds + late, atol=tolerance)


def test_times_of_another_clock_count_from_the_earliest():
    seconds, raw = sweep(1.0, "f8", 4321.0)
    scan = scan_from_point_cloud2(message(columns(64) | {"timestamp": raw}))
    assert scan.stamp == T0
    np.testing.assert_allclose(scan.time, seconds, atol=1e-9)
    unset = scan_from_point_cloud2(message(columns(64) | {"timestamp": raw}, header=stamped(0)))
    assert unset.stamp == 4321.0
    np.testing.assert_allclose(unset.time, seconds, atol=1e-9)


@each("start", [0.0, 0.25, 5.0, 9.5, 123.0])
def test_simulated_time_that_begins_at_zero(start):
    seconds, raw = sweep(1.0, "f8", start)
    scan = scan_from_point_cloud2(message(columns(64) | {"timestamp": raw}, header=stamped(start)))
    assert scan.stamp == start
    np.testing.assert_allclose(scan.time, seconds, atol=1e-9)
    relative = scan_from_point_cloud2(message(columns(64) | {"t": seconds}, header=stamped(start)))
    np.testing.assert_allclose(relative.time, seconds, atol=1e-9)


def test_times_of_another_clock_may_count_in_any_unit():
    for unit in (1.0, 1e-3, 1e-6, 1e-9):
        seconds, raw = sweep(unit, "f8")
        scan = scan_from_point_cloud2(message(columns(64) | {"time": 120 / unit + raw}))
        assert scan.stamp == 1_700_000_000.0
        np.testing.assert_allclose(scan.time, seconds - seconds.min(), atol=1e-6)


def test_fields_of_radars():
    radar = {"doppler": np.arange(60, dtype="f4"), "RCS": np.full(60, -3.0, "f4")}
    scan = scan_from_point_cloud2(message(columns() | radar))
    np.testing.assert_array_equal(scan.doppler, np.arange(60))
    np.testing.assert_array_equal(scan.rcs, -3)
    for name in ("velocity", "range_rate", "doppler_velocity", "radial_velocity"):
        assert scan_from_point_cloud2(message(columns() | {name: radar["doppler"]})).doppler[7] == 7
    radar["doppler"][3], radar["RCS"][4] = np.inf, np.nan  # unknown at one detection
    scan = scan_from_point_cloud2(message(columns() | radar))
    assert np.flatnonzero(np.isnan(scan.doppler)).tolist() == [3]
    assert np.flatnonzero(np.isnan(scan.rcs)).tolist() == [4]


def test_axes_and_intensity():
    given = columns(intensity=np.full(60, 30.0, "f4"))
    scan = scan_from_point_cloud2(message(given), axes="nuscenes", intensity_max=60)
    np.testing.assert_array_equal(scan.points[:, 0], given["y"])
    np.testing.assert_array_equal(scan.points[:, 1], -given["x"])
    np.testing.assert_array_equal(scan.points[:, 3], 0.5)


def raster(rows=16, width=128):
    elevation, azimuth = np.radians(np.linspace(-20, 10, rows))[:, None], np.linspace(3, -3, width)[None]
    way = np.stack(np.broadcast_arrays(
        np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)), -1)  # fmt: skip
    returned = np.random.default_rng(3).random((rows, width)) > 0.2
    return way.astype("f4"), returned


@each("nothing", [0.0, np.nan])
def test_beams_without_echo_of_organised_clouds(nothing):
    way, returned = raster()
    xyz = np.where(returned[..., None], 7 * way, nothing).astype("f4").reshape(-1, 3)
    laid = message(dict(zip("xyz", xyz.T, strict=True)), height=16, padding=9)
    scan = scan_from_point_cloud2(laid)
    assert len(scan) == returned.sum()
    np.testing.assert_allclose(scan.no_returns, way[~returned], atol=2e-6)
    assert scan_from_point_cloud2(laid, no_returns=False).no_returns is None
    laid.height, laid.width = 1, 16 * 128
    laid.data, laid.row_step = laid.data.reshape(16, -1)[:, :-9].reshape(-1), 0
    assert scan_from_point_cloud2(laid).no_returns is None


def test_an_echo_straight_above_does_not_spoil_the_raster():
    way, returned = raster()
    returned[-1, 5] = True
    xyz = np.where(returned[..., None], 7 * way, 0)
    xyz[-1, 5] = 0, 0, 3
    scan = scan_from_point_cloud2(message(dict(zip("xyz", xyz.astype("f4").reshape(-1, 3).T, strict=True)), height=16))
    np.testing.assert_allclose(scan.no_returns, way[~returned], atol=2e-6)


def field(offset, datatype=7, count=1, name="t"):
    return SimpleNamespace(name=name, offset=offset, datatype=datatype, count=count)


def wrong(**changes):
    broken = message(columns())
    for name, value in changes.items():
        setattr(broken, name, value)
    return broken


@each("broken, error", [
        (wrong(width=61), r"720 bytes, wanted 1 rows of 61 points of 12 bytes"),
        (wrong(data=np.zeros(719, np.uint8)), "719 bytes"),
        (wrong(height=2), "2 rows of 60 points"),
        (wrong(height=2, width=30, row_step=100, data=np.zeros(200, np.uint8)), "row_step 100"),
        (wrong(point_step=0), "point_step 0"),
        (wrong(width=-1), "width -1"),
        (wrong(fields=[]), "fields none, wanted x, y, z"),
        (wrong(fields=message(columns()).fields[:2]), "fields x, y, wanted x, y, z"),
        (wrong(fields=[*message(columns()).fields[:2], field(9, name="z")]),
         "has z at byte 9, 1 times 4 bytes, wanted it inside of point_step 12"),
        (wrong(fields=[*message(columns()).fields[:2], field(0, count=4, name="z")]), "4 times 4"),
        (wrong(fields=[*message(columns()).fields[:2], field(0, 0, name="z")]), "datatype 0"),
        (wrong(fields=[*message(columns()).fields, *message(columns()).fields]), "wanted one of each"),
        (message({name: np.full(3, 1e6, "f4") for name in "xyz"}), "coordinates up to 1e[+]06 m"),
        (wrong(header=SimpleNamespace(stamp=3.0, frame_id="a")), "a stamp must have sec and nanosec"),
        (SimpleNamespace(), "PointCloud2 must have a header with stamp and frame_id, got SimpleNamespace"),
    ])  # fmt: skip
def test_wrong_messages_are_refused_in_words(broken, error):
    with pytest.raises(OgmError, match=error) as caught:
        scan_from_point_cloud2(broken)
    assert str(caught.value).count("PointCloud2") <= 1


@each("broken", [field(13), field(-4), field(0, count=4), field(0, 0), field(0, 99), field(2**31, name="intensity")])
def test_a_damaged_field_that_is_not_needed_is_left_out(broken, caplog):
    given = message(columns(ring=np.arange(60, dtype="u2")))
    given.fields.append(broken)
    scan = scan_from_point_cloud2(given)
    np.testing.assert_array_equal(scan.points[:, :3], np.column_stack(list(columns().values())[:3]))
    np.testing.assert_array_equal(scan.ring, np.arange(60))
    assert scan.time is None
    assert "the field is left out" in caplog.text


def test_options_that_make_no_sense():
    for option in ({"axes": "up"}, {"intensity_max": 0}, {"time_unit": -1}):
        with pytest.raises(ValueError, match=next(iter(option))) as caught:
            scan_from_point_cloud2(message(columns()), **option)
        assert not isinstance(caught.value, OgmError)


def test_old_habits_of_drivers():
    """A count of 0 for 1, padding fields, ROS 1 stamps and a slash before the frame."""
    given = message(columns())
    given.fields[0].count = 0
    given.fields.append(field(0, 2, 4, "_"))
    given.fields.append(field(4, 2, 4, "_"))
    given.header = SimpleNamespace(seq=4, stamp=SimpleNamespace(secs=5, nsecs=250_000_000), frame_id="/velodyne")
    scan = scan_from_point_cloud2(given)
    assert scan.stamp == 5.25
    np.testing.assert_array_equal(scan.points[:, 0], columns()["x"])


def test_a_real_scan_goes_through_unchanged(real, sent):
    points = read_points(real("kitti_object/velodyne/000000.bin"), "kitti")
    back = scan_from_point_cloud2(sent(point_cloud2(Scan(points), frame_id="velodyne", stamp=3.0), CLOUD, 1))
    np.testing.assert_array_equal(back.points, points)
    assert back.stamp == 3.0
