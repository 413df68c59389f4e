"""Files of scans: their order, names, numbers, times and poses."""

from pathlib import Path

import numpy as np
import pytest
from cases import each

from ogm.datasets import frame_numbers
from ogm.datasets.scans import drive_of, in_order, pose_files, poses_of, scan_name, scan_paths


def test_names_are_sorted_by_their_numbers_and_counted_by_the_last() -> None:
    names = [scan_name(path) for path in in_order(Path(f"s2_{n}.pcd.xz") for n in (10, 9, 100))]
    assert names == ["s2_9", "s2_10", "s2_100"]
    numbers = frame_numbers(names)
    assert numbers is not None
    assert numbers.tolist() == [9, 10, 100]
    assert frame_numbers(["1317617735.5", "1317617736.2"]) is None  # a clock's
    assert frame_numbers(["a", "b"]) is None
    assert frame_numbers([]).tolist() == []


def test_a_name_keeps_its_dots_but_no_ending_of_a_format() -> None:
    assert scan_name(Path("n__LIDAR_TOP__15.pcd.bin")) == "n__LIDAR_TOP__15"
    assert scan_name(Path("1317617735.5.pcd.gz")) == "1317617735.5"
    assert scan_name(Path("scan.v2")) == "scan.v2"
    assert scan_name(Path(".bin")) == ".bin"


def test_scans_are_found_by_their_endings(tmp_path) -> None:
    for name in ("2.bin", "1.pcd.xz", "3.pcd.bin", "4.txt", "5.npy", "x.ply.gz"):
        (tmp_path / name).touch()
    (tmp_path / "6.bin").mkdir()
    assert [scan_name(path) for path in scan_paths(tmp_path)] == ["1", "2", "x"]
    assert scan_paths(tmp_path / "nowhere") == []


def test_scans_come_by_number(tmp_path) -> None:
    for name in ("10.bin", "9.pcd", "2.bin.xz"):
        (tmp_path / name).touch()
    assert [scan_name(path) for path in scan_paths(tmp_path)] == ["2", "9", "10"]


@each("first, unit", [(7, 0.1), (1_317_042_145_964, 1e-3), (1317042145964389, 1e-6), (1317042145964389445, 1e-9)])
def test_names_of_scans_tell_the_time(first, unit) -> None:
    scans = [Path(f"{first + round(k * 0.2 / unit):010}.bin") for k in range(3)]
    stamps = [ref.stamp for ref, _ in drive_of("d", scans)]
    np.testing.assert_allclose(np.diff(stamps), 0.2, atol=1e-6)
    assert [ref.stamp for ref, _ in drive_of("d", [Path(name) for name in "abc"])] == pytest.approx([0, 0.1, 0.2])


def test_poses_are_found_by_number_or_in_order(tmp_path) -> None:
    row = "1 0 0 {} 0 1 0 0 0 0 1 0"
    assert poses_of(pose_files(tmp_path), ["5", "7"]) == [None, None]
    (tmp_path / "poses.txt").write_text(row.format(1) + "\n" + row.format(2) + "\n")
    first, second = poses_of(pose_files(tmp_path), ["5", "7"])
    assert (first[0, 3], second[0, 3]) == (1, 2)
    (tmp_path / "derived").mkdir()  # comes first
    (tmp_path / "derived" / "poses.txt").write_text("7 " + row.format(3) + "\n9 " + row.format(4) + "\n")
    first, second = poses_of(pose_files(tmp_path), ["5", "7"])
    assert first is None
    assert second[0, 3] == 3
