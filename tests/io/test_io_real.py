"""Real recordings, each with its trap. They lie beside the project; without them, these tests are skipped."""

import lzma

import numpy as np
import pytest
from cases import each

from ogm.io import describe, estimate_sensor_height, read_points, read_scan, read_scan_file

NUSCENES = "nuscenes_n015/*.pcd.bin"
AV2 = "argoverse2_adcf/sensors/lidar/315973157959879000.feather"

# name, axes, points, rows dropped, height of the sensor [m] as its folder's notes give it
SCANS = [
    ("nebula_apache2/vls128/*.pcd", "flu", 208680, 0, 1.98),
    ("nebula_apache2/vlp32/*.pcd", "flu", 26216, 0, None),
    ("nebula_apache2/vlp16/*.pcd", "flu", 14831, 0, None),
    ("autoware_apache2/test.pcd.xz", "flu", 48048, 17488, 1.79),
    ("kitti_object/velodyne/000000.bin", "kitti", 115384, 0, 1.75),
    ("kitti_object/velodyne/000001.bin", "kitti", 120268, 0, 1.75),
    ("kitti_object/velodyne/000002.bin", "kitti", 126891, 0, 1.75),
    ("kitti_odometry_00/000000.bin", "kitti", 124668, 0, 1.80),
    ("kitti_odometry_00/000005.bin.xz", "kitti", 123924, 0, 1.80),
    ("kitti_raw_0005/0000000060.pcd.xz", "kitti", 122942, 1, 1.78),
    (AV2, "argoverse", 100660, 0, 0.33),
    ("argoverse1/*.ply", "argoverse", 91083, 0, 0.33),
    (NUSCENES, "nuscenes", 34688, 0, 1.82),
    ("sustechpoints/lidar/000965.pcd.xz", "sustech", 66781, 0, 1.8),
    ("sustechpoints/lidar/000970.pcd.xz", "sustech", 66899, 0, 1.8),
    ("sustechpoints/lidar/000975.pcd.xz", "sustech", 67153, 0, 1.8),
    ("labelled_range_images/nuscenes/25611.npy.xz", "nuscenes", 19304, 13464, 1.86),
    ("labelled_range_images/semantic_kitti/0.npy.xz", "kitti", 50901, 14635, 1.78),
]


@each("name, axes, number, dropped, height", SCANS)
def test_every_recording_is_read(name, axes, number, dropped, height, real):
    scan, facts = read_scan_file(real(name), axes)
    assert scan.points.shape == (number, 4)
    assert scan.points.dtype == np.float32
    assert facts.dropped == dropped
    assert np.isfinite(scan.points).all()
    assert scan.points[:, 3].min() >= 0
    assert scan.points[:, 3].max() <= 1
    if height is not None:
        assert estimate_sensor_height(scan.points) == pytest.approx(height, abs=0.05)
    assert describe(scan, facts)["points"] == str(number)


def inside(points, centre, size, way):
    """Return which points lie in a box whose length points along `way`."""
    left = np.array([-way[1], way[0]])
    offset = points[:, :3] - centre
    along = np.column_stack([offset[:, :2] @ way, offset[:, :2] @ left, offset[:, 2]])
    return (np.abs(along) <= np.asarray(size) / 2).all(axis=1)


# ---- axes


def test_argoverse2_boxes_hold_exactly_their_points(real):
    feather = pytest.importorskip("pyarrow.feather")
    points = read_points(real(AV2), "argoverse")
    boxes = feather.read_table(real("argoverse2_adcf/annotations.feather")).to_pylist()
    boxes = [box for box in boxes if box["timestamp_ns"] == 315973157959879000]
    assert len(boxes) == 47
    for box in boxes:
        yaw = 2 * np.arctan2(box["qz"], box["qw"])
        centre, size = [[box[f"{a}_m"] for a in names] for names in (("tx", "ty", "tz"), ("length", "width", "height"))]
        found = inside(points, centre, size, np.array([np.cos(yaw), np.sin(yaw)])).sum()
        assert found == box["num_interior_pts"]


# ---- what the reader keeps


def test_points_in_the_frame_of_the_vehicle_stay_there(real):
    feather = pytest.importorskip("pyarrow.feather")
    scan = read_scan(real(AV2), "argoverse")
    calibration = feather.read_table(real("argoverse2_adcf/calibration*/egovehicle_SE3_sensor.feather")).to_pylist()
    (upper,) = (sensor for sensor in calibration if sensor["sensor_name"] == "up_lidar")
    place = np.array([upper["tx_m"], upper["ty_m"], upper["tz_m"]])
    assert place[2] > 1.6

    def spread(origin):  # of the elevation of each of the upper sensor's lasers [degree]
        x, y, z = (scan.points[:, :3] - origin).T
        elevation = np.degrees(np.arctan2(z, np.hypot(x, y)))
        rings = (elevation[scan.ring == ring] for ring in range(32))
        return np.median([np.percentile(np.abs(ring - np.median(ring)), 75) for ring in rings])

    assert spread(place) < 0.01
    assert spread(np.zeros(3)) > 1.0


# ---- what the files hide


def test_zero_padding_behind_the_points_is_no_points(real):
    path = real("kitti_raw_0005/0000000060.pcd.xz")
    data = lzma.decompress(path.read_bytes())
    start = data.index(b"DATA binary\n") + 12
    stored = np.frombuffer(data, "<f4", 122943 * 4, start).reshape(-1, 4)
    padding = data[start + stored.nbytes :]
    assert len(padding) > 3000
    assert not any(padding)
    scan, facts = read_scan_file(path)
    assert facts.dropped == np.count_nonzero(~stored[:, :3].any(axis=1)) == 1
    np.testing.assert_array_equal(scan.points, stored[stored[:, :3].any(axis=1)])


def test_wrong_padding_fields_are_seen_through(real):
    path = real("sustechpoints/lidar/000965.pcd.xz")
    data = lzma.decompress(path.read_bytes())
    layout = {"names": ["xyz", "i", "t", "ring"], "formats": ["3<f4", "<f4", "<f8", "<u2"]}
    layout |= {"offsets": [0, 16, 24, 32], "itemsize": 48}
    stored = np.frombuffer(data, np.dtype(layout), 66781, data.index(b"DATA binary\n") + 12)
    scan, facts = read_scan_file(path)
    assert facts.fields == ("x", "y", "z", "intensity", "timestamp", "ring")
    np.testing.assert_array_equal(scan.points[:, :3], stored["xyz"])
    np.testing.assert_allclose(scan.points[:, 3], stored["i"] / 255, rtol=1e-6)
    np.testing.assert_array_equal(scan.ring, stored["ring"])
    assert set(scan.ring) == set(range(40))
    assert scan.stamp == stored["t"].min() == pytest.approx(1820.302, abs=1e-3)
    assert 0 == scan.time.min() < scan.time.max() < 0.1


def test_stamps_follow_each_other(real):
    stamps = [read_scan(real(f"sustechpoints/lidar/{frame}.pcd.xz")).stamp for frame in ("000965", "000970", "000975")]
    np.testing.assert_allclose(np.diff(stamps), 0.5, atol=0.01)


@each("name, stamp", [
        (NUSCENES, 1532402927.647951), (AV2, 315973157.959879), ("argoverse1/*.ply", 315971347.819783),
        ("nebula_apache2/vls128/*.pcd", 1585897255.376374), ("kitti_raw_0005/0000000060.pcd.xz", None),
    ])  # fmt: skip
def test_stamps_are_those_of_the_names(name, stamp, real):
    assert read_scan(real(name), "nuscenes").stamp == (None if stamp is None else pytest.approx(stamp, abs=1e-6))


@each("name, lasers", [(NUSCENES, 32), (AV2, 64), ("argoverse1/*.ply", 32), ("nebula_apache2/vlp16/*.pcd", 15)])
def test_lasers_are_counted(name, lasers, real):
    assert len(set(read_scan(real(name), "nuscenes").ring)) == lasers


def test_zeros_of_an_organised_cloud_are_beams_without_a_return(real):
    scan, facts = read_scan_file(real("autoware_apache2/test.pcd.xz"))
    assert facts.shape == (64, 1024)
    assert len(scan.no_returns) == facts.dropped == 64 * 1024 - len(scan.points)
    np.testing.assert_allclose(np.linalg.norm(scan.no_returns, axis=1), 1, atol=1e-6)
    elevation = np.degrees(np.arcsin(scan.no_returns[:, 2]))
    assert -21 < elevation.min() < elevation.max() < 23
    assert np.median(elevation) > 8  # nearly all point to the sky
