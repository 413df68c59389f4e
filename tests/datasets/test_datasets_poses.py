"""Poses of files matched with frames, and poses estimated from scans."""

import pickle
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest
from cases import refused
from wall_drive import write_kitti, write_scans

from ogm.datasets import Dataset, open_dataset, with_odometry, with_poses
from ogm.io import read_poses, write_poses
from ogm.pose import Trajectory, inverse, pose, transform_points
from ogm.state import CellState

FRAMES = 8
POSES = np.array([pose(0.4 * k, 0.05 * k, yaw=0.02 * k) for k in range(FRAMES)])
STAMPS = np.arange(FRAMES) / 10


def world() -> np.ndarray:
    rng = np.random.default_rng(0)
    points = rng.uniform(-20, 20, (5000, 4))
    points[:, 2], points[:, 3] = -1.7, 0.5
    return points


def scanned(T: np.ndarray) -> np.ndarray:
    return transform_points(inverse(T), world()).astype(np.float32)


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scans(tmp_path_factory.mktemp("drive"), world(), POSES, "scan_{}.bin", 5)


def kitti(path: Path, poses: np.ndarray = POSES, first: int | None = 5) -> Path:
    return write_kitti(path, poses, first)


def placed(dataset: Dataset) -> np.ndarray:
    return np.array([frame.T_map_sensor for frame in dataset])


def test_all_formats_of_poses_give_the_same_frames(scans: Path, tmp_path: Path) -> None:
    write_poses(tmp_path / "tum.txt", Trajectory(STAMPS, POSES))
    write_poses(tmp_path / "ours.csv", Trajectory(STAMPS, POSES), np.arange(FRAMES) + 5)
    kitti(tmp_path / "numbered.txt")
    kitti(tmp_path / "plain.txt", first=None)
    kitti(tmp_path / "whole.txt", np.concatenate([POSES[[0] * 5], POSES, POSES[-1:]]), None)
    for name, how, first in (
        ("numbered.txt", "by frame number", 0.5),
        ("tum.txt", "in their order", 0.0),
        ("ours.csv", "by frame number", 0.0),
        ("plain.txt", "in their order", 0.5),
        ("whole.txt", "row by frame number", 0.5),
    ):
        dataset = with_poses(open_dataset(scans), tmp_path / name)
        assert f"8 scans, {14 if 'whole' in name else 8} poses of {name}" in dataset.facts["poses"]
        assert how in dataset.facts["poses"]
        np.testing.assert_allclose(placed(dataset), POSES, atol=1e-9)
        assert [frame.stamp for frame in dataset] == pytest.approx(STAMPS + first)
        assert dataset.sequences == {scans.name: list(range(FRAMES))}
        assert dataset.trajectory is not None
        np.testing.assert_allclose(dataset.trajectory.poses, POSES, atol=1e-9)


def test_the_rate_counts_scans_without_stamps(scans: Path, tmp_path: Path) -> None:
    dataset = with_poses(open_dataset(scans), kitti(tmp_path / "p.txt"), rate=5.0)
    assert [frame.stamp for frame in dataset] == pytest.approx(2 * (STAMPS + 0.5))
    refused("`rate` must be above 0", with_poses, open_dataset(scans), tmp_path / "p.txt", rate=0.0)


def test_poses_are_interpolated_to_the_stamps_of_the_scans(tmp_path: Path) -> None:
    """Scans with stamps between poses with stamps; the last scan is beyond."""
    folder = tmp_path / "drive"
    folder.mkdir()
    start, seen = 1_700_000_000.0, []
    for k in range(5):
        stamp = start + 0.1 * k + 0.05
        scanned(pose(0.5 * (k + 0.5))).tofile(folder / f"{round(1e6 * stamp):016d}.bin")
    known = Trajectory(start + 0.1 * np.arange(5), np.array([pose(0.5 * k) for k in range(5)]))
    write_poses(tmp_path / "tum.txt", known)

    def noted(numbers: Iterable[int]) -> Iterable[int]:
        seen.extend(numbers)
        return seen

    dataset = with_poses(open_dataset(folder), tmp_path / "tum.txt", progress=noted)
    assert "4 of 5 scans have a pose" in dataset.facts["poses"]
    assert seen == [0, 1, 2, 3, 4]
    assert dataset[4].T_map_sensor is dataset[4].stamp is None
    assert placed(dataset[:4])[:, 0, 3] == pytest.approx(0.5 * (np.arange(4) + 0.5), abs=1e-5)
    assert len(dataset.trajectory) == 5  # more than the scans


def test_poses_far_apart_tell_nothing_about_what_lies_between(tmp_path: Path) -> None:
    scanned(pose()).tofile(tmp_path / "1700000005000000.bin")
    write_poses(tmp_path / "p.csv", Trajectory(1.7e9 + np.array([0.0, 10.0]), POSES[:2]))
    refused("at most 2 s apart", with_poses, open_dataset(tmp_path / "1700000005000000.bin"), tmp_path / "p.csv")


def test_poses_have_the_axes_of_the_scans(tmp_path: Path) -> None:
    """The same drive by a sensor whose y points forward, and what `write_poses` made of its poses."""
    turn = pose(yaw=np.pi / 2)  # takes forward, left, up to the file's axes
    for k in range(FRAMES):
        transform_points(turn, scanned(POSES[k])).astype(np.float32).tofile(tmp_path / f"{k + 5}.bin")
    kitti(tmp_path / "turned.txt", POSES @ inverse(turn))
    write_poses(tmp_path / "used.csv", Trajectory(STAMPS, POSES))
    dataset = open_dataset(tmp_path, axes=("+y", "-x", "+z"))
    for name in ("turned.txt", "used.csv"):
        np.testing.assert_allclose(placed(with_poses(dataset, tmp_path / name)), POSES, atol=1e-9)


def test_poses_of_the_vehicle_place_the_sensor(scans: Path, tmp_path: Path) -> None:
    dataset = open_dataset(scans, sensor_position=(1.0, 0.0, 1.6))
    found = with_poses(dataset, kitti(tmp_path / "p.txt"))
    np.testing.assert_allclose(placed(found), POSES @ pose(1.0, 0.0, 1.6), atol=1e-9)
    np.testing.assert_allclose(found.trajectory.poses, placed(found))


def test_a_part_of_a_drive_gets_its_own_poses(scans: Path, tmp_path: Path) -> None:
    part = with_poses(open_dataset(scans)[:3], kitti(tmp_path / "p.txt"))
    assert len(part) == 3
    np.testing.assert_allclose(placed(part), POSES[:3], atol=1e-9)
    other = pickle.loads(pickle.dumps(part[1:]))
    np.testing.assert_allclose(placed(other), POSES[1:3], atol=1e-9)
    assert (other.facts, other[0].stamp) == (part.facts, part[1].stamp)
    assert len(other.trajectory) == 3


def test_with_poses_a_drive_has_aggregated_truth(scans: Path, tmp_path: Path) -> None:
    assert open_dataset(scans).description == ""
    dataset = with_poses(open_dataset(scans), kitti(tmp_path / "p.txt"))
    assert "scans agree" in dataset.description
    truth, points = dataset[4].truth, scanned(POSES[4])
    state = truth.state[truth.spec.index(points[:, 0], points[:, 1])]
    assert np.mean(state == CellState.FREE) > 0.95  # cells with a point of the flat ground, which all scans share
    assert truth.shares().occupied == 0


def test_poses_that_cannot_be_matched_are_refused(scans: Path, tmp_path: Path) -> None:
    dataset = open_dataset(scans)
    refused("has 3 poses for 8 scans", with_poses, dataset, kitti(tmp_path / "short.txt", POSES[:3], None))
    with pytest.raises(ValueError, match=r"which has the frame numbers 90 ... 97; the scans have 5 ... 12"):
        with_poses(dataset, kitti(tmp_path / "other.txt", first=90))
    camera = POSES.copy()
    camera[:, :3, 3] = np.arange(FRAMES)[:, None] * [0, 0, 1]
    refused("`calibration=calib.txt`", with_poses, dataset, kitti(tmp_path / "camera.txt", camera))


def test_odometry_needs_no_poses(real: Callable[[str], Path]) -> None:
    pytest.importorskip("kiss_icp")
    folder, seen = real("kitti_odometry_00"), []
    dataset = open_dataset([folder / name for name in ("000002.bin.xz", "000000.bin", "000001.bin.xz")])

    def noted(numbers: Iterable[int]) -> Iterable[int]:
        for number in numbers:
            seen.append(number)
            yield number

    found = with_odometry(dataset, "kiss-icp", progress=noted)
    assert (found.facts["poses"], seen) == ("3 of 3 scans, estimated by kiss-icp", [0, 1, 2])
    theirs = read_poses(folder / "derived" / "poses_lidar_gicp.txt")
    assert np.abs(placed(found)[:, :2, 3] - theirs.poses[:3, :2, 3]).max() < 0.2
    assert [frame.stamp for frame in found] == pytest.approx([0.0, 0.1, 0.2])
    refused("magic", with_odometry, dataset, "magic")


def test_odometry_leaves_out_what_cannot_be_registered(real: Callable[[str], Path], tmp_path: Path) -> None:
    pytest.importorskip("kiss_icp")
    folder = real("kitti_odometry_00")
    for name in ("000000.bin", "000001.bin.xz"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    (tmp_path / "000002.bin").write_bytes(b"xyz")
    np.zeros((10, 4), np.float32).tofile(tmp_path / "000003.bin")
    files = sorted(tmp_path.iterdir())
    found = with_odometry(open_dataset(files))
    assert found.facts["poses"] == "2 of 4 scans, estimated by kiss-icp"
    assert [frame.T_map_sensor is None for frame in found] == [False, False, True, True]
