"""Which scans judge which, who stood where, and what a class means to a car."""

from pathlib import Path

import numpy as np
import pytest

from ogm import GridSpec
from ogm.io import NUSCENES_ELEVEN, SEMANTIC_KITTI, SEMANTIC_KITTI_TRAINING, LabelledPoints
from ogm.pose import pose
from ogm.recordings import truth_from_others
from ogm.recordings.around import choose_others, stood_here
from ogm.recordings.layout import drive, kinds_of, pose_files, poses_of, scans_in, stem
from ogm.truth import TRUTH_SPEC, FREE, IGNORE, OCCUPIED, Kind

SMALL = GridSpec.centered(8.0, 8.0, 0.5)
NONE = np.empty((0, 7))


def along(count: int, step: float = 1.0) -> np.ndarray:
    return np.column_stack([step * np.arange(count), np.zeros(count), np.zeros(count)])


def test_a_scan_never_judges_itself() -> None:
    stamps = 0.1 * np.arange(6)
    for n in range(6):
        others = choose_others(n, stamps, along(6), later=False)
        assert others == [k for k in range(6) if k != n]
        assert choose_others(n, stamps, along(6), later=True) == list(range(n + 1, 6))


def test_far_scans_judge_nothing() -> None:
    stamps = 0.1 * np.arange(100)
    assert choose_others(50, stamps, along(100, 30.0), later=False) == [49, 51]
    assert choose_others(0, 40.0 * np.arange(5), along(5, 0.0), later=False) == []


def test_of_many_scans_some_are_chosen_from_the_first_to_the_last() -> None:
    others = choose_others(500, 0.02 * np.arange(1000), along(1000, 0.02), later=False)
    assert len(others) == 40
    assert (others[0], others[-1]) == (0, 999)
    assert 500 not in others
    assert np.diff(others).max() <= 27


def test_where_the_own_vehicle_stood() -> None:
    stood = stood_here(np.array([pose(), pose(x=10, yaw=np.pi / 2), pose(x=500)]))
    area = np.count_nonzero(stood) * TRUTH_SPEC.resolution**2
    assert area == pytest.approx(2 * 5.0 * 2.2, rel=0.05)
    for x, y in ((2.3, 1.0), (-2.3, -1.0), (9.2, 2.3), (10.8, -2.3)):
        assert stood[TRUTH_SPEC.index(x, y)]
    for x, y in ((2.9, 0.0), (0.0, 1.4), (12.0, 0.0)):
        assert not stood[TRUTH_SPEC.index(x, y)]


def street(*standing: tuple[float, float]) -> np.ndarray:
    """Scan a street 1.8 m below the sensor; something 1 m high stands at some places."""
    x, y = np.meshgrid(np.arange(-3.9, 4, 0.2), np.arange(-3.9, 4, 0.2), indexing="ij")
    ground = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -1.8), np.zeros(x.size)])
    posts = [[px, py, -1.8 + z, 0] for px, py in standing for z in (0.4, 0.7, 0.9)]
    return np.concatenate([ground, np.array(posts).reshape(-1, 4)]).astype(np.float32)


def at(truth, x: float, y: float) -> int:
    return int(truth.state[truth.spec.index(x, y)])


def test_others_say_what_stands_and_what_is_free() -> None:
    truth = truth_from_others([street((2.1, 1.1))] * 3, 1.8, SMALL, NONE)
    assert at(truth, 2.1, 1.1) == OCCUPIED
    assert np.mean(truth.state == FREE) > 0.9


def test_the_ground_may_climb() -> None:
    """One metre in ten: at the end of the grid it lies 0.4 m above the foot, where something would be an obstacle."""
    scan = street((-3.1, 1.1))
    scan[:, 2] += 0.1 * scan[:, 0]
    truth = truth_from_others([scan] * 3, 1.8, SMALL, NONE)
    assert np.mean(truth.state == FREE) > 0.9
    assert at(truth, -3.1, 1.1) == OCCUPIED


def test_the_scan_itself_only_raises_doubt() -> None:
    others = [street((2.1, 1.1))] * 3
    now = street((-2.1, -1.1))  # what stood there left, and something came
    truth = truth_from_others(others, 1.8, SMALL, NONE, judged=now)
    assert at(truth, 2.1, 1.1) == IGNORE
    assert at(truth, -2.1, -1.1) == IGNORE
    same = truth_from_others(others, 1.8, SMALL, NONE, judged=street((2.1, 1.1)))
    assert (same.state == truth_from_others(others, 1.8, SMALL, NONE).state).all()


def test_cells_under_moving_boxes_are_not_judged_by_others() -> None:
    truth = truth_from_others([street()] * 3, 1.8, SMALL, np.array([[2.0, 1.0, 0, 2.0, 1.0, -1.8, 0]]))
    assert at(truth, 2.0, 1.0) == at(truth, 2.8, 1.2) == IGNORE
    assert at(truth, -2.0, -1.0) == FREE


@pytest.mark.parametrize(
    ("names", "ground", "plants", "nothing"),
    [
        (SEMANTIC_KITTI, {40, 44, 48, 49, 60, 72}, {70}, {0, 1}),
        (SEMANTIC_KITTI_TRAINING, {9, 10, 11, 12, 17}, {15}, {0}),
        (NUSCENES_ELEVEN, {0, 1}, {4}, {10}),
    ],
)
def test_what_a_class_is_to_a_car(names, ground, plants, nothing) -> None:
    numbers = np.array(sorted(names))
    kinds = kinds_of(LabelledPoints(np.zeros((len(numbers), 4), np.float32), numbers, names))
    for number, kind in zip(numbers, kinds, strict=True):
        wanted = (
            Kind.GROUND if number in ground
            else Kind.PLANT if number in plants
            else Kind.OTHER if number in nothing
            else Kind.OBSTACLE
        )  # fmt: skip
        assert kind == wanted, names[number]


def test_scans_are_found_by_their_endings(tmp_path) -> None:
    for name in ("2.bin", "1.pcd.xz", "3.pcd.bin", "4.txt", "5.npy", "x.ply.gz"):
        (tmp_path / name).touch()
    (tmp_path / "6.bin").mkdir()
    assert [stem(path) for path in scans_in(tmp_path)] == ["1", "2", "x"]
    assert scans_in(tmp_path / "nowhere") == []


def test_scans_come_by_number(tmp_path) -> None:
    for name in ("10.bin", "9.pcd", "2.bin.xz"):
        (tmp_path / name).touch()
    assert [stem(path) for path in scans_in(tmp_path)] == ["2", "9", "10"]


@pytest.mark.parametrize(
    ("first", "unit"),
    [(7, 0.1), (1_317_042_145_964, 1e-3), (1317042145964389, 1e-6), (1317042145964389445, 1e-9)],
)
def test_names_of_scans_tell_the_time(first, unit) -> None:
    scans = [Path(f"{first + round(k * 0.2 / unit):010}.bin") for k in range(3)]
    stamps = [shot.stamp for shot in drive("d", scans, [None] * 3)]
    np.testing.assert_allclose(np.diff(stamps), 0.2, atol=1e-6)
    words = [Path(f"{word}.bin") for word in "abc"]
    assert [shot.stamp for shot in drive("d", words, [None] * 3)] == pytest.approx([0, 0.1, 0.2])


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
