"""Poses: what is written is what is read, every kind holds the same, and errors of damaged files name the line."""

import gzip
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given, settings
from hypothesis import strategies as st

from ogm.io import Poses, read_calibration, read_poses, write_poses
from ogm.pose import Trajectory, inverse, pose
from ogm.storage.files import OgmError

T_CAMERA_SENSOR = np.array([[0, -1, 0, 0.05], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1.0]])


def drive(count: int = 12) -> Trajectory:
    """Give a drive along a curve, x forward, with all six degrees of freedom used."""
    k = np.arange(count)
    poses = [pose(k, 0.1 * k * k, 0.01 * k, roll=0.01 * k, pitch=-0.02, yaw=0.1 * k) for k in k]
    return Trajectory(1317617735.123456 + 0.1 * k, poses)


def rows(poses: np.ndarray, numbers: list[int] | None = None) -> str:
    """Write poses as KITTI does (or KITTI-360, with frame numbers)."""
    starts = [""] * len(poses) if numbers is None else [f"{n} " for n in numbers]
    lines = [" ".join(f"{v:.12e}" for v in T[:3].ravel()) for T in poses]
    return "".join(f"{start}{line}\n" for start, line in zip(starts, lines, strict=True))


def test_kitti_and_kitti_360_and_full_matrices_hold_the_same(tmp_path: Path) -> None:
    poses, numbers = drive().poses, list(range(3, 27, 2))
    (tmp_path / "kitti.txt").write_text(rows(poses))
    (tmp_path / "kitti360.txt").write_text("# a comment\n\n" + rows(poses, numbers))
    full = [f"{n} " + " ".join(map(repr, T.ravel().tolist())) + "\n" for n, T in zip(numbers, poses, strict=True)]
    (tmp_path / "full.txt").write_text("".join(full))
    kitti, kitti360, matrices = (read_poses(tmp_path / f) for f in ("kitti.txt", "kitti360.txt", "full.txt"))
    for read in (kitti, kitti360, matrices):
        np.testing.assert_allclose(read.poses, poses, atol=1e-11)
        assert read.stamps is None
    assert kitti.numbers is None
    assert kitti360.numbers is not None
    assert kitti360.numbers.tolist() == numbers
    assert (kitti.format, kitti360.format, matrices.format) == ("KITTI", "KITTI-360", "KITTI-360 4x4")


@each("ending", [".csv", ".txt", ".tum"])
def test_what_is_written_is_read_again_to_the_last_bit(ending: str, tmp_path: Path) -> None:
    trajectory, path = drive(), tmp_path / f"poses{ending}"
    write_poses(path, trajectory)
    read = read_poses(path)
    np.testing.assert_array_equal(read.stamps, trajectory.stamps)
    np.testing.assert_array_equal(read.poses[:, :3, 3], trajectory.poses[:, :3, 3])
    np.testing.assert_allclose(read.poses, trajectory.poses, atol=1e-14)
    np.testing.assert_array_equal(read.trajectory().stamps, trajectory.stamps)


def test_our_format_explains_itself_and_keeps_frame_numbers(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    write_poses(path, drive(), numbers=np.arange(100, 112))
    text = path.read_text()
    assert text.startswith("# ogm.poses/1: T_map_sensor")
    assert "\nstamp,x,y,z,qx,qy,qz,qw,number\n" in text
    read = read_poses(path)
    assert read.numbers is not None
    assert read.numbers.tolist() == list(range(100, 112))
    assert read.format == "ogm.poses/1"


def test_columns_of_a_csv_may_stand_in_any_order(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("stamp, qw, qx, qy, qz, x, y, z\n1.5, 1, 0, 0, 0, 7, 8, 9\n")
    read = read_poses(path)
    np.testing.assert_array_equal(read.poses, [pose(7, 8, 9)])
    assert read.format == "csv"


def test_camera_poses_become_those_of_the_lidar(tmp_path: Path) -> None:
    lidar = drive().poses
    lidar = inverse(lidar[0]) @ lidar
    path = tmp_path / "00.txt"
    path.write_text(rows(T_CAMERA_SENSOR @ lidar @ inverse(T_CAMERA_SENSOR)))
    np.testing.assert_allclose(read_poses(path, T_camera_sensor=T_CAMERA_SENSOR).poses, lidar, atol=1e-10)


def test_camera_poses_without_calibration_are_refused(tmp_path: Path) -> None:
    camera = np.array([pose(0.02 * k, 0, k, pitch=0.01 * k) for k in range(5)])
    path = tmp_path / "00.txt"
    path.write_text(rows(camera))
    refused(r"read_calibration\('calib.txt'\)", read_poses, path)
    np.testing.assert_allclose(read_poses(path, T_camera_sensor=np.eye(4)).poses, camera, atol=1e-10)


def test_a_vehicle_that_stands_is_no_camera(tmp_path: Path) -> None:
    path = tmp_path / "still.txt"
    path.write_text(rows(np.array([pose(z=0.01 * (k % 2)) for k in range(20)])))
    assert len(read_poses(path)) == 20


def test_times_come_from_stamps_or_frame_numbers_or_the_count() -> None:
    poses = drive(3).poses
    stamps, numbers = np.array([1.0, 2.0, 4.0]), np.array([10, 11, 15])
    np.testing.assert_array_equal(Poses(poses, stamps, numbers).trajectory(rate=10).stamps, stamps)
    np.testing.assert_allclose(Poses(poses, None, numbers).trajectory(rate=10).stamps, [1.0, 1.1, 1.5])
    np.testing.assert_allclose(Poses(poses).trajectory(rate=5).stamps, [0, 0.2, 0.4])
    with pytest.raises(ValueError, match="give the scan rate"):
        Poses(poses).trajectory()
    with pytest.raises(ValueError, match="above 0"):
        Poses(poses).trajectory(rate=0)


def test_rounded_rotations_become_true_ones(tmp_path: Path) -> None:
    exact = drive().poses
    path = tmp_path / "rounded.txt"
    path.write_text("".join(" ".join(f"{v:.3f}" for v in T[:3].ravel()) + "\n" for T in exact))
    read = read_poses(path).poses
    np.testing.assert_allclose(np.swapaxes(read[:, :3, :3], 1, 2) @ read[:, :3, :3], [np.eye(3)] * 12, atol=1e-14)
    np.testing.assert_allclose(read, exact, atol=1e-3)
    (tmp_path / "rounded.tum").write_text("0.5 1 2 3 0 0 0.7071 0.7071\n")
    np.testing.assert_allclose(read_poses(tmp_path / "rounded.tum").poses[0], pose(1, 2, 3, yaw=np.pi / 2), atol=1e-12)


def test_packed_files_windows_line_ends_and_byte_order_marks_are_read(tmp_path: Path) -> None:
    text = "\ufeff# comment\r\n" + rows(drive().poses).replace("\n", "\r\n") + "\r\n"
    (tmp_path / "poses.txt.gz").write_bytes(gzip.compress(text.encode()))
    np.testing.assert_allclose(read_poses(tmp_path / "poses.txt.gz").poses, drive().poses, atol=1e-11)


IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0"
CSV = "stamp,x,y,z,qx,qy,qz,qw\n"


@each("name, content, message", [
        ("a.txt", "", "is empty"),
        ("a.txt", "# nothing\n\n", "holds no pose"),
        ("a.csv", CSV, "holds no pose"),
        ("a.txt", b"\x00\x01\xff\xfe" * 50, "no text"),
        ("a.txt", b"\xff\xd8\xff\xe0" * 50, "no text"),
        ("a.txt", "1 2 3\n", "line 1 .* 3 columns, wanted 8"),
        ("a.txt", f"{IDENTITY}\n{IDENTITY} 1\n", r"line 2 .* must be finite numbers of shape \(12,\)"),
        ("a.txt", f"{IDENTITY}\n{IDENTITY[:-1]}x\n", "line 2 .* must be numbers"),
        ("a.txt", f"{IDENTITY}\n{IDENTITY[:-1]}nan\n", "line 2 .* must be finite"),
        ("a.txt", f"# x\n{IDENTITY}\n2 0 0 0 0 2 0 0 0 0 2 0\n", "line 3 .*rigid"),
        ("a.txt", "-1 0 0 0 0 1 0 0 0 0 1 0\n", "line 1 .*mirror"),
        ("a.txt", "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 2\n", "last row of the pose in line 1"),
        ("a.txt", f"1 {IDENTITY}\n1 {IDENTITY}\n", "numbers must increase, but line 1 .* has 1 and the next has 1"),
        ("a.txt", f"0.5 {IDENTITY}\n", "frame number, got 0.5"),
        ("a.txt", "1 0 0 0 0 0 0 0\n", "line 1 .* length 1, got 0"),
        ("a.txt", "1 0 0 0 0 0 0 1.02\n", "length 1, got 1.02"),
        ("a.txt", "1 0 0 0 0 0 0 1\n" * 2, "stamps must increase, but line 1 .* has 1.0 and the next has 1.0"),
        ("a.txt", "2 0 0 0 0 0 0 1\n# x\n1 0 0 0 0 0 0 1\n", "line 1 .* has 2.0 and the next has 1.0"),
        ("a.txt", "1317617735123456789 0 0 0 0 0 0 1\n", "divide nanoseconds"),
        ("a.csv", "1,0,0,0,0,0,0,1\n", "header"),
        ("a.csv", "stamp,x,y,z,qx,qy,qz\n", "header"),
        ("a.csv", CSV + "1,0,0,0,0,0,0\n", r"line 2 .* of shape \(8,\)"),
        ("a.csv", "# ogm.poses/2: ...\n" + CSV, "newer release"),
    ])  # fmt: skip
def test_errors_of_damaged_files_name_the_line(name: str, content: str | bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    refused(message, read_poses, path, error=OgmError)


def test_a_missing_file_is_missing(tmp_path: Path) -> None:
    refused("there is no file", read_poses, tmp_path / "poses.txt", error=FileNotFoundError)


@settings(deadline=None, max_examples=60)
@given(st.binary(max_size=300) | st.text("0123456789.- \n,#einfa", max_size=300))
def test_junk_is_poses_or_an_ogm_error(tmp_path_factory: pytest.TempPathFactory, junk: bytes | str) -> None:
    path = tmp_path_factory.getbasetemp() / "junk.txt"
    path.write_bytes(junk if isinstance(junk, bytes) else junk.encode())
    try:
        read = read_poses(path)
    except OgmError:
        return
    assert np.isfinite(read.poses).all()


def test_our_own_files_need_no_calibration(tmp_path: Path) -> None:
    write_poses(tmp_path / "poses.csv", drive())
    refused("leave T_camera_sensor out", read_poses, tmp_path / "poses.csv", T_camera_sensor=T_CAMERA_SENSOR)


@each("name, numbers, message", [
        ("poses.json", None, "name it .csv"),
        ("poses.txt", np.arange(12), "no frame numbers"),
        ("poses.csv", np.arange(11), "12 increasing integers"),
        ("poses.csv", np.arange(12.0), "12 increasing integers"),
        ("poses.csv", np.zeros(12, int), "12 increasing integers"),
    ])  # fmt: skip
def test_what_cannot_be_written_is_refused(name: str, numbers: np.ndarray, message: str, tmp_path: Path) -> None:
    refused(message, write_poses, tmp_path / name, drive(), numbers)
    assert not list(tmp_path.iterdir())


def text_of(T: np.ndarray) -> str:
    return " ".join(map(repr, T.ravel().tolist()))


def test_calibrations_of_all_recordings_are_read(tmp_path: Path) -> None:
    path, T, rectify = tmp_path / "calib.txt", T_CAMERA_SENSOR, pose(yaw=0.01)[:3, :3]
    path.write_text(f"P0: {'1 ' * 12}\nTr: {text_of(T[:3])}\n")
    np.testing.assert_array_equal(read_calibration(path), T)
    turned = pose(yaw=0.01) @ T
    path.write_text(f"R0_rect: {text_of(rectify)}\nTr_velo_to_cam: {text_of(T[:3])}\nTr_imu_to_velo: {text_of(T[:3])}")
    np.testing.assert_allclose(read_calibration(path), turned, atol=1e-15)
    path.write_text(f"R_rect {text_of(rectify)}\nTr_velo_cam {text_of(T[:3])}\n")
    np.testing.assert_allclose(read_calibration(path), turned, atol=1e-15)
    path.write_text(f"calib_time: 15-Mar-2012 11:37:16\nR: {text_of(T[:3, :3])}\nT: {text_of(T[:3, 3])}\n")
    np.testing.assert_array_equal(read_calibration(path), T)


@each("text, message", [
        ("P0: 1 2 3\n", "no entry Tr, Tr_velo_to_cam"),
        ("Tr: 1 2 3\n", r"entry Tr of .* numbers of shape \(12,\), got \['1', '2', '3'\]"),
        (f"Tr: {IDENTITY[:-1]}x\n", "entry Tr of .* must be numbers"),
        ("Tr: 2 0 0 0 0 1 0 0 0 0 1 0\n", "rigid"),
    ])  # fmt: skip
def test_damaged_calibrations_are_named(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "calib.txt"
    path.write_text(text)
    refused(message, read_calibration, path, error=OgmError)


@each("folder, numbers, path_length", [
        ("kitti_odometry_00", range(6), 3.58),
        ("kitti_raw_0005", range(60, 84), 9.0),
        ("sustechpoints", (965, 970, 975), 5.54),
    ])  # fmt: skip
def test_derived_poses_are_read(real: Callable[[str], Path], folder: str, numbers: range, path_length: float) -> None:
    read = read_poses(real(folder) / "derived" / "poses_lidar_gicp.txt")
    assert read.numbers is not None
    assert read.numbers.tolist() == list(numbers)
    length = np.linalg.norm(np.diff(read.poses[:, :3, 3], axis=0), axis=1).sum()
    assert length == pytest.approx(path_length, abs=0.3)
    np.testing.assert_allclose(read.trajectory(rate=10).stamps, np.array(numbers) / 10, rtol=1e-12)


def test_the_calibration_of_a_recording_points_the_camera_forward(real: Callable[[str], Path]) -> None:
    T = read_calibration(real("kitti_raw_0005") / "calib_2011_09_26.txt")
    np.testing.assert_allclose(T[:3, :3], T_CAMERA_SENSOR[:3, :3], atol=0.02)


def test_g2o_has_the_poses_of_its_vertices(tmp_path: Path) -> None:
    from scipy.spatial.transform import Rotation

    trajectory = drive()
    quaternions = Rotation.from_matrix(trajectory.poses[:, :3, :3]).as_quat()
    rows = [
        f"VERTEX_SE3:QUAT {3 * k} " + " ".join(map(repr, [*T[:3, 3].tolist(), *q.tolist()]))
        for k, (T, q) in enumerate(zip(trajectory.poses, quaternions, strict=True))
    ]
    edges = ["# a comment", "FIX 0", "EDGE_SE3:QUAT 0 3 1 0 0 0 0 0 1 " + "1 " * 21, "VERTEX_TRACKXYZ 99 1 2 3"]
    (tmp_path / "graph.g2o").write_text("\n".join(rows[::-1] + edges) + "\n")
    found = read_poses(tmp_path / "graph.g2o")
    assert found.numbers is not None
    assert found.stamps is None
    assert found.format == "g2o"
    assert found.numbers.tolist() == [3 * k for k in range(len(rows))]
    np.testing.assert_allclose(found.poses, trajectory.poses, atol=1e-12)


def test_flat_g2o_lies_in_the_plane(tmp_path: Path) -> None:
    (tmp_path / "graph.g2o").write_text("VERTEX_SE2 7 1.5 -2.0 0.75\nVERTEX_SE2 9 0 0 -3.0\n")
    found = read_poses(tmp_path / "graph.g2o")
    np.testing.assert_allclose(found.poses, [pose(1.5, -2.0, yaw=0.75), pose(yaw=-3.0)], atol=1e-12)


@each("line, wanted", [
        ("VERTEX_SE2 1 2 3", "line 2 of .* and 3 finite numbers"), ("VERTEX_SE2 1 2 3 nan", "finite"),
        ("VERTEX_SE2 one 2 3 4", "an integer"), ("VERTEX_SE2", "an integer"),
        ("VERTEX_SE2 -4 2 3 4", "from 0"), ("VERTEX_SE2 0 2 3 4", "repeats the vertex 0 of line 1"),
        ("VERTEX_SE3:QUAT 1 0 0 0 0 0 0 2", "quaternion of length 1"),
    ])  # fmt: skip
def test_damaged_g2o_is_refused(tmp_path: Path, line: str, wanted: str) -> None:
    (tmp_path / "graph.g2o").write_text(f"VERTEX_SE2 0 0 0 0\n{line}\n")
    refused(wanted, read_poses, tmp_path / "graph.g2o", error=OgmError)
    (tmp_path / "edges.g2o").write_text("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    refused("has no vertex", read_poses, tmp_path / "edges.g2o", error=OgmError)
