"""Axes, intensities, times, dropped rows, and the description of a scan."""

import logging

import numpy as np
import pytest
from cases import each, refused

from ogm.datasets import open_dataset
from ogm.io import AXES, describe, estimate_sensor_height, read_points, read_scan, read_scan_file
from ogm.io.ground_plane import plausible_sensor_height
from ogm.scan import Scan
from ogm.storage.files import OgmError


@pytest.fixture
def save(tmp_path):
    def save(array, name="cloud.npy"):
        np.save(tmp_path / name, array)
        return tmp_path / name

    return save


def feather(path, **columns):
    pyarrow, writer = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.feather")
    writer.write_feather(pyarrow.table(columns), path)
    return path


ONES = np.ones(3, np.float32)

# ---- axes


@each("axes", AXES)
def test_axes_never_mirror(axes, save):
    unit = np.column_stack([np.eye(3), np.zeros(3)]).astype(np.float32)
    rotated = read_points(save(unit), axes)[:, :3]
    assert np.linalg.det(rotated) == pytest.approx(1.0)


@each("axes, forward, left", [("flu", "x", "y"), ("kitti", "x", "y"), ("nuscenes", "y", "-x"), ("sustech", "-y", "x")])
def test_named_axes_point_as_in_the_data_set(axes, forward, left, save):
    ways = {"x": [1, 0, 0], "y": [0, 1, 0], "-x": [-1, 0, 0], "-y": [0, -1, 0]}
    points = read_points(save(np.float32([ways[forward], ways[left], [0, 0, 1]])), axes)
    np.testing.assert_array_equal(points[:, :3], np.eye(3))


def test_axes_can_be_given_as_signs_or_as_a_matrix(cloud, save):
    path = save(cloud)
    named = read_points(path, "nuscenes")
    np.testing.assert_array_equal(read_points(path, ("+y", "-x", "+z")), named)
    np.testing.assert_array_equal(read_points(path, np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]])), named)
    np.testing.assert_array_equal(named[:, 0], cloud[:, 1])
    np.testing.assert_array_equal(named[:, 3], cloud[:, 3])


def test_any_rotation_will_do(cloud, save):
    c, s = np.cos(0.3), np.sin(0.3)
    rotation = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    expected = cloud[:, :3] @ rotation.T
    np.testing.assert_allclose(read_points(save(cloud), rotation)[:, :3], expected, atol=1e-4)


@each("axes, message", [
        ("nuscene", "not known"), (("x", "+y", "+z"), "not three of"), (("+x", "+x", "+z"), "orthogonal"),
        (("+x", "+y"), "orthogonal"), (("+x", "-y", "+z"), "reflection"), (np.eye(2), "orthogonal"),
        (None, "axes must be a name.*got None.*give flu"), (3, "axes must be a name.*got 3"),
        (("+x", 1, 2), "no .* matrix of numbers"), ([[1, 0, 0], [0, 1]], "no .* matrix of numbers"),
        (np.eye(3) * 2, "orthogonal"), (np.diag([1.0, 1.0, -1.0]), "reflection"),
    ])  # fmt: skip
def test_axes_that_are_no_rotation_are_refused(axes, message, cloud, save):
    refused(message, read_points, save(cloud), axes)


def test_files_of_nuscenes_are_turned(cloud, tmp_path):
    path = tmp_path / "cloud.pcd.bin"
    path.write_bytes(np.column_stack([cloud, np.zeros(60)]).astype(np.float32).tobytes())
    turned, as_it_is = read_points(path, "nuscenes"), read_points(path, ("+x", "+y", "+z"))
    np.testing.assert_array_equal(turned[:, :2], as_it_is[:, [1, 0]] * [1, -1])
    np.testing.assert_array_equal(read_points(path), turned)
    for paths in (path, tmp_path):
        dataset = open_dataset(paths, sensor_height=1.8)
        assert dataset.recording.axes == "nuscenes"
        np.testing.assert_array_equal(dataset[0].scan.points, turned)


# ---- origin and reach


def test_origin_brings_map_coordinates_home(tmp_path):
    columns = {"x": [500_000.123, 500_010.0], "y": [5_600_000.0, 5_600_001.457], "z": [210.0, 208.5]}
    path = feather(tmp_path / "a.feather", **columns)
    points = read_points(path, ("+y", "-x", "+z"), origin=(500_000.0, 5_600_000.0, 210.0))
    np.testing.assert_allclose(points[:, :3], [[0, -0.123, 0], [1.457, -10, -1.5]], atol=1e-6)
    refused(r"5\.6e\+06 m.*origin", read_points, path)


# ---- rows without a point


def test_rows_without_a_point_are_dropped_counted_and_logged(cloud, save, caplog):
    rows = np.column_stack([cloud, np.arange(60)]).astype(np.float32)
    rows[3, :3] = 0
    rows[4, :3] = -0.0
    rows[5, 1] = np.nan
    rows[6, 2] = -np.inf
    with caplog.at_level(logging.INFO, logger="ogm"):
        scan, facts = read_scan_file(save(rows))
    gone = [3, 4, 5, 6]
    assert facts.dropped == 4
    assert "4 of 60 rows" in caplog.text
    np.testing.assert_array_equal(scan.points, np.delete(cloud, gone, axis=0))
    np.testing.assert_array_equal(scan.ring, np.delete(np.arange(60), gone))


@each("unknown", [np.nan, np.inf, -np.inf])
def test_a_point_of_unknown_intensity_is_a_point(unknown, cloud, save, caplog):
    rows = cloud.copy()
    rows[[7, 9], 3] = unknown
    with caplog.at_level(logging.INFO, logger="ogm"):
        scan, facts = read_scan_file(save(rows))
    assert facts.dropped == 0
    assert "2 of 60 intensities" in caplog.text
    rows[[7, 9], 3] = 0
    np.testing.assert_array_equal(scan.points, rows)


@each("unknown", [np.nan, np.inf])
@each("column, what", [("ring", "rings"), ("time", "times")])
def test_a_column_with_a_gap_is_left_out_and_costs_no_point(column, what, unknown, tmp_path, caplog):
    values = {"ring": np.float32([0, 1, 2]), "time": np.float32([0, 0.05, 0.1])}
    values[column][1] = unknown
    scan, facts = read_scan_file(feather(tmp_path / "a.feather", x=ONES, y=ONES, z=ONES, **values))
    assert len(scan.points) == 3
    assert facts.dropped == 0
    assert getattr(scan, column) is None
    assert (scan.ring is None) != (scan.time is None)
    assert f"1 of 3 points have {what} that are NaN" in caplog.text
    assert [record.levelname for record in caplog.records] == ["WARNING"]


def test_a_row_without_a_point_may_lack_everything(tmp_path, caplog):
    gap = np.float32([1, np.nan, 2])
    scan, facts = read_scan_file(
        feather(tmp_path / "a.feather", x=gap, y=gap, z=gap, intensity=gap / 2, ring=gap, time=gap)
    )
    assert facts.dropped == 1
    np.testing.assert_array_equal(scan.ring, [1, 2])
    np.testing.assert_array_equal(scan.time, [1, 2])
    assert not caplog.records


def test_a_wall_of_unknown_intensity_is_no_beam_without_return(save):
    azimuth, elevation = np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-0.3, 0.1, 8))
    way = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    image = np.concatenate([10 * way, np.full((1, 8, 40), 0.5)]).transpose(1, 2, 0).astype(np.float32)
    image[2, 10:20, 3] = np.nan  # a wall
    image[5, 30:33] = np.nan  # the sky
    scan = read_scan(save(image))
    assert len(scan.points) == 8 * 40 - 3
    assert len(scan.no_returns) == 3


def test_a_point_with_one_or_two_zeros_is_a_point(save):
    rows = np.float32([[0, 0, -1.8], [5, 0, 0], [0, 3, 0]])
    scan, facts = read_scan_file(save(rows))
    assert facts.dropped == 0
    np.testing.assert_array_equal(scan.points[:, :3], rows)


@each("rows", [np.full((5, 4), np.nan), np.zeros((5, 4)), np.empty((0, 4))])
def test_a_file_without_points_gives_none(rows, save):
    scan, facts = read_scan_file(save(rows))
    assert scan.points.shape == (0, 4)
    assert scan.points.dtype == np.float32
    assert facts.dropped == len(rows)
    assert describe(scan, facts)["points"] == "0"


def test_one_point_is_a_cloud(save):
    np.testing.assert_array_equal(read_points(save(np.float32([[1, 2, 3, 0.5]]))), [[1, 2, 3, 0.5]])


def test_the_ego_vehicle_and_what_is_below_ground_are_kept(save):
    rows = np.float32([[0.5, 0, -0.3, 0], [1, 1, -28.0, 0], [-2, 0.5, -1, 0]])
    np.testing.assert_array_equal(read_points(save(rows)), rows)


# ---- intensity


@each("raw, expected, scale", [
        (np.uint8([0, 51, 255]), [0, 0.2, 1], 255),
        (np.uint16([0, 13107, 65535]), [0, 0.2, 1], 65535),
        (np.float32([0, 0.2, 1]), [0, 0.2, 1], 1),
        (np.float32([0, 51, 2]), [0, 0.2, 2 / 255], 255),
        (np.int32([0, 51, 255]), [0, 0.2, 1], 255),
    ])  # fmt: skip
def test_intensity_scale_follows_type_then_values(raw, expected, scale, tmp_path):
    scan, facts = read_scan_file(feather(tmp_path / "a.feather", x=ONES, y=ONES, z=ONES, intensity=raw))
    np.testing.assert_allclose(scan.points[:, 3], expected, rtol=1e-6)
    assert facts.intensity_max == scale


def test_intensity_max_is_used_as_given(tmp_path, caplog):
    path = feather(tmp_path / "a.feather", x=ONES, y=ONES, z=ONES, intensity=np.float32([0, 500, 3000]))
    with caplog.at_level(logging.INFO, logger="ogm"):
        scan = read_scan(path, intensity_max=1000.0)
    np.testing.assert_allclose(scan.points[:, 3], [0, 0.5, 1])
    assert "1 of 3 intensities lie outside of 0 ... 1000" in caplog.text
    np.testing.assert_allclose(read_points(path, intensity_max=(-500.0, 1500.0))[:, 3], [0.25, 0.5, 1])
    refused("two increasing numbers", read_points, path, intensity_max=(1.0, 1.0))


def test_a_guessed_scale_is_logged_where_it_divides(tmp_path, caplog):
    with caplog.at_level(logging.INFO, logger="ogm"):
        read_scan(feather(tmp_path / "a.feather", x=ONES, y=ONES, z=ONES, intensity=ONES))
        read_scan(feather(tmp_path / "b.feather", x=ONES, y=ONES, z=ONES, intensity=np.uint8([0, 9, 255])))
        read_scan(feather(tmp_path / "c.feather", x=ONES, y=ONES, z=ONES, intensity=9 * ONES), intensity_max=9)
        assert not caplog.records
        read_scan(feather(tmp_path / "d.feather", x=ONES, y=ONES, z=ONES, intensity=9 * ONES))
    assert "intensities are divided by 255; give intensity_max" in caplog.text


@each("raw, expected, scale", [
        (np.float32([0, 500, 3000]), np.float32([0, 500, 3000]) / 65535, 65535),  # photons
        (np.float64([0, 1.01, 0.5]), [0, 1, 0.5], 1),
        (np.r_[np.linspace(0, 1, 400), 1e30, 5.0], np.r_[np.linspace(0, 1, 400), 1, 1], 1),
        (np.float32([-150, -75, 0]), [0, 0.5, 1], 0),  # decibels
        (np.float32([-0.5, 0.25, 1]), [0, 0.25, 1], 1),
        (np.int32([0, 1, 200_000]), [0, 1 / 196_000, 1], 196_000),
    ])  # fmt: skip
def test_unusual_intensities_cost_no_scan(raw, expected, scale, tmp_path):
    ones = np.ones(len(raw), "f4")
    scan, facts = read_scan_file(feather(tmp_path / "a.feather", x=ones, y=ones, z=ones, intensity=raw))
    np.testing.assert_allclose(scan.points[:, 3], expected, atol=0.011)
    assert facts.intensity_max == pytest.approx(scale, rel=0.02, abs=2)


def test_decibels_beside_a_reflectivity_are_not_used(tmp_path):
    both = {"intensity": np.float32([-60, -50, -40]), "reflectivity": np.uint8([0, 51, 255])}
    points = read_points(feather(tmp_path / "a.feather", x=ONES, y=ONES, z=ONES, **both))
    np.testing.assert_allclose(points[:, 3], [0, 0.2, 1], rtol=1e-6)


@each("rows, ending, message", [
        (np.float32([[1, 2, -3, 0.5, 7.5]] * 16), ".bin", "intensities down to -3, .* for five .pcd.bin"),
        (np.float32([[1, 2, -3]] * 16), ".bin", r"intensities down to -3, .* for three .*reshape\(-1, 3\)"),
        (np.float64([[-10.7, 20.3, -1.9, 0.3]] * 16), ".bin", "rows of 4 float32 .* such as float64"),
        (np.float32([[1, 2, 3, 0.5, 7]] * 16), ".bin", "integers as every fifth value: .* name it .pcd.bin"),
        (np.float32([[1, 2, 3, 0.5, 0.1, 7]] * 10), ".pcd.bin", "fifth values from 0.1 to 7, wanted rings"),
        (np.float32([[1, 2, -3, 0.5]] * 10), ".pcd.bin", "fifth values from -3 to 2, wanted rings"),
    ])  # fmt: skip
def test_rows_of_another_length_are_no_points(rows, ending, message, tmp_path):
    path = tmp_path / f"a{ending}"
    path.write_bytes(rows.tobytes())
    refused(message, read_points, path)


def test_intensities_of_a_known_format_may_be_larger(tmp_path):
    (tmp_path / "a.bin").write_bytes(np.float32([[1, 2, 3, 51], [1, 2, 3, 1]]).tobytes())
    np.testing.assert_allclose(read_points(tmp_path / "a.bin")[:, 3], [0.2, 1 / 255], rtol=1e-6)
    assert read_points(tmp_path / "a.bin", intensity_max=102)[0, 3] == 0.5


def test_a_point_absurdly_far_costs_itself_alone(cloud, save):
    rows = cloud.copy()
    rows[3, 1], rows[5, 0], rows[7, 2] = 3e30, -2e5, np.finfo(np.float32).max
    scan, facts = read_scan_file(save(rows))
    assert facts.dropped == 3
    np.testing.assert_array_equal(scan.points, np.delete(cloud, [3, 5, 7], axis=0))


# ---- ring and time


@each("wrong", [0, -1e-9, np.nan, np.inf])
def test_a_scale_and_a_unit_are_positive_numbers(wrong, save):
    path = save(np.ones((1, 3)))
    for option in ("intensity_max", "time_unit"):
        refused(f"{option} must be above 0", read_points, path, **{option: wrong})


@each("origin", [(0, 0), (0, 0, np.nan)])
def test_an_origin_is_three_numbers(origin, save):
    refused("origin must be", read_points, save(np.ones((1, 3))), origin=origin)


@each("ring", [-1.0, 0.5, 70_000.0])
def test_wrong_rings_are_left_out(ring, save, caplog):
    assert read_scan(save(np.float32([[1, 2, 3, 0, 4], [1, 2, 3, 0, ring]]))).ring is None
    assert "are not all integers from 0 to 65535; all rings are left out" in caplog.text


@each("name, times, expected, stamp", [
        ("a", np.float32([0.0, 0.05, 0.1]), [0, 0.05, 0.1], None),
        ("a", np.float64([-0.1, -0.05, 0.0]), [-0.1, -0.05, 0], None),
        ("a", np.int32([0, 50_000_000, 100_000_000]), [0, 0.05, 0.1], None),
        ("a", np.float64([1e9 + 0.1, 1e9, 1e9 + 0.05]), [0.1, 0, 0.05], 1e9),
        ("a", np.uint64([10**18, 10**18 + 10**8, 10**18]), [0, 0.1, 0], 1e9),
        ("315973157959879000", np.int32([0, 10**8, 0]), [0, 0.1, 0], 315973157.959879),
        ("n015__LIDAR_TOP__1532402927647951", np.int32([0, 10**8, 0]), [0, 0.1, 0], 1532402927.647951),
        ("0000000060", np.int32([0, 10**8, 0]), [0, 0.1, 0], None),
        ("12345678901234567", np.int32([0, 10**8, 0]), [0, 0.1, 0], None),
    ])  # fmt: skip
def test_times_count_from_the_stamp(name, times, expected, stamp, tmp_path):
    scan = read_scan(feather(tmp_path / f"{name}.feather", x=ONES, y=ONES, z=ONES, timestamp=times))
    assert scan.time.dtype == np.float64
    np.testing.assert_allclose(scan.time, expected, atol=1e-6)
    assert scan.stamp == (None if stamp is None else pytest.approx(stamp, abs=1e-6))


def timed(path, times):
    return feather(path / "a.feather", x=ONES, y=ONES, z=ONES, timestamp=times)


SWEEP = np.linspace(0, 0.1, 101)  # [s]


@each("times, stamp", [
        (1.7e18 + 1e9 * SWEEP, 1.7e9),  # as the driver of Livox writes them
        (1e9 * SWEEP, None),
        ((1e6 * SWEEP).astype("f4"), None),
        (1.2e11 + 1e9 * SWEEP, 120.0),  # since power-on
        (7.2e9 + 1e6 * SWEEP, 7200.0),
        (1e3 * SWEEP, None),
        ((2**32 - 6e7 + 1e9 * SWEEP).astype("u8").astype("u4"), None),  # a counter of ns begins anew
        ((3600 - 0.04 + SWEEP) % 3600, 3599.96),  # a clock of an hour
        (np.round((3600 - 0.04 + SWEEP) % 3600 * 1e6), 3599.96),
    ])  # fmt: skip
def test_times_of_any_clock_and_unit_count_from_the_earliest(times, stamp, tmp_path):
    ones = np.ones(len(times), "f4")
    scan = read_scan(feather(tmp_path / "a.feather", x=ones, y=ones, z=ones, timestamp=times))
    first = 0.0 if stamp is None and times.dtype != np.uint32 else scan.time.min()
    np.testing.assert_allclose(scan.time - first, SWEEP, atol=1e-6)
    assert scan.stamp == (None if stamp is None else pytest.approx(stamp))


@each("wrong", [np.nan, np.inf, 0.0, -1e9, 1e300])
@each("clock", [1.7e9, 40.0, 3.5])
def test_a_single_wrong_time_costs_its_point_alone_its_time(wrong, clock, tmp_path, caplog):
    ones, times = np.ones(101, "f4"), clock + SWEEP
    times[[0, 50, 51]] = wrong
    scan = read_scan(feather(tmp_path / "a.feather", x=ones, y=ones, z=ones, timestamp=times))
    expected = np.clip(SWEEP, 0.001, None)
    np.testing.assert_allclose(scan.time - scan.time.min(), expected - 0.001, atol=1e-6)
    assert "3 of 101 times are NaN or far from the others" in caplog.text


@each("times", [np.uint64([0, 10**10 + 1, 2 * 10**10]), np.float64([3, 60, 600e9]), np.float32([5, np.nan, np.nan])])
def test_times_of_no_sweep_are_left_out(times, tmp_path, caplog):
    path = timed(tmp_path, times)
    scan = read_scan(path)
    assert scan.time is None
    assert len(scan) == 3
    assert "left out" in caplog.text
    if np.isfinite(times).all():
        assert read_scan(path, time_unit=1e-9).time is not None


def test_whole_microseconds_are_remarked_unless_their_unit_is_given(tmp_path, caplog):
    path = timed(tmp_path, np.uint32([4_000_000_000, 4_000_050_000, 4_000_100_000]))
    scan = read_scan(path, time_unit=1e-6)
    np.testing.assert_allclose(scan.time, [0, 0.05, 0.1])
    assert scan.stamp == 4000.0
    assert not caplog.records
    read_scan(path)
    assert "give time_unit (1e-6: microseconds)" in caplog.text


def test_times_of_one_value_and_of_ten_seconds_are_a_sweep(tmp_path, caplog):
    np.testing.assert_allclose(read_scan(timed(tmp_path, np.uint32([7, 7, 7]))).time, 7e-9)
    np.testing.assert_array_equal(read_scan(timed(tmp_path, np.float32([0, 5, 10]))).time, [0, 5, 10])
    assert not caplog.records


def test_a_long_recording_is_read_if_its_unit_is_given(tmp_path):
    scan = read_scan(timed(tmp_path, np.float64([3, 60, 600])), time_unit=1.0)
    np.testing.assert_array_equal(scan.time, [3, 60, 600])


# ---- names of fields


def test_of_two_fields_with_one_meaning_the_first_counts(tmp_path, caplog):
    fields = {"Intensity": ONES / 2, "scalar_intensity": ONES, "time": 0 * ONES, "Time": ONES}
    scan = read_scan(feather(tmp_path / "a.feather", x=ONES, y=ONES, z=ONES, **fields))
    np.testing.assert_array_equal(scan.points[:, 3], 0.5)
    np.testing.assert_array_equal(scan.time, 0)
    assert "Intensity, scalar_intensity, time, Time, which differ only in case or scalar_" in caplog.text


@each("place, intensity, ring, time", [
        ("xyz", "Intensity", "Ring", "Timestamp"),
        ("XYZ", "INTENSITY", "scalar_ring", "scalar_GpsTime"),
        ("xyz", "Reflectivity", "Ring", "scalar_GpsTime"),
        ("XYZ", "scalar_Intensity", "scalar_ring", "Timestamp"),
    ])  # fmt: skip
def test_fields_are_known_in_any_capitals(place, intensity, ring, time, tmp_path):
    x, y, z = place
    columns = {x: ONES, y: 2 * ONES, z: 3 * ONES, intensity: ONES / 2, ring: np.uint8([4, 5, 6]), time: ONES}
    scan, facts = read_scan_file(feather(tmp_path / "a.feather", **columns))
    np.testing.assert_array_equal(scan.points, [[1, 2, 3, 0.5]] * 3)
    np.testing.assert_array_equal(scan.ring, [4, 5, 6])
    np.testing.assert_array_equal(scan.time, ONES)
    assert facts.fields == tuple(columns)


@each("double", ["X", "scalar_x", "scalar_Y"])
def test_two_fields_of_one_meaning_are_refused(double, tmp_path):
    columns = {"x": ONES, "y": ONES, "z": ONES, double: ONES}
    refused(
        f"fields ., {double}, which differ only in case or scalar_, wanted one of each",
        read_scan,
        feather(tmp_path / "a.feather", **columns),
    )


def test_fields_of_no_meaning_may_differ_in_capitals_only(tmp_path):
    scan, facts = read_scan_file(feather(tmp_path / "a.feather", x=ONES, y=ONES, z=ONES, a=ONES, A=ONES))
    assert facts.fields == ("x", "y", "z", "a", "A")


def test_other_fields_are_named_but_not_needed(tmp_path):
    scan, facts = read_scan_file(
        feather(tmp_path / "a.feather", x=ONES, y=ONES, z=ONES, label=["a", "b", "c"], rgb=ONES)
    )
    assert facts.fields == ("x", "y", "z", "rgb")
    assert scan.ring is None
    assert scan.time is None
    assert facts.intensity_max is None


# ---- description


def test_a_scan_has_one_ring_per_point():
    refused(r"ring must be \(5,\).*got shape \(4,\)", Scan, np.zeros((5, 4), np.float32), ring=np.zeros(4, np.uint16))


def test_a_description_has_what_is_there(cloud, save):
    image = np.column_stack([cloud, np.zeros(60)]).reshape(6, 10, 5)
    image[0, 0] = 0
    facts = describe(*read_scan_file(save(image, "1600000000000000.npy")))
    assert facts["points"] == "59"
    assert facts["raster"] == "6 x 10"
    assert facts["dropped"] == "1 rows without a point"
    assert facts["stamp"] == "1600000000.000000 s"
    assert facts["x"].endswith(" m")
    assert "rings" not in facts
    assert "ground" not in facts


# ---- height of the sensor


def road(rng, height, slope=0.0, number=20_000):
    xy = rng.uniform(-30, 30, (number, 2))
    z = -height + slope * xy[:, 0] + rng.normal(0, 0.02, number)
    return np.column_stack([xy, z, np.zeros(number)]).astype(np.float32)


@each("height", [0.33, 1.0, 1.73, 2.5])
@each("slope", [0.0, 0.04, -0.05])
def test_height_is_that_of_the_road_below(height, slope):
    rng = np.random.default_rng(5)
    points = road(rng, height, slope)
    walls = rng.uniform([4, -9, -height], [5, 9, 3], (8000, 3))  # many more points, but few square metres
    hull = rng.normal([0, 0, -0.4], [0.8, 0.4, 0.1], (5000, 3))
    underground = rng.uniform([-10, -10, -28], [10, 10, -5], (10, 3))
    other = np.concatenate([walls, hull, underground])
    points = np.concatenate([points, np.column_stack([other, np.zeros(len(other))])])
    assert estimate_sensor_height(points) == pytest.approx(height, abs=0.05)


def test_height_is_unknown_without_a_road():
    rng = np.random.default_rng(6)
    assert estimate_sensor_height(np.empty((0, 4), np.float32)) is None
    assert estimate_sensor_height(road(rng, 1.7, number=50)) is None
    assert estimate_sensor_height(rng.uniform(-10, 10, (500, 4))) is None
    stairs = road(rng, 1.7)
    stairs[stairs[:, 0] > -3, 2] = -np.floor(stairs[stairs[:, 0] > -3, 0])
    assert estimate_sensor_height(stairs) is None


def test_a_height_of_no_sensor_is_refused_with_the_way_out():
    for height in (0.5, 1.73, 5.0):
        assert plausible_sensor_height(height) == height
    for height in (0.37, 0.49, 5.1, -1.0, np.nan):
        message = f"a.feather, estimated from points, is {height:.2f} m, .* vehicle frame give `sensor_position`"
        refused(message, plausible_sensor_height, height, "a.feather", error=OgmError)
