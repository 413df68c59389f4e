"""Real datasets open by their path, and their truth is plausible. Without the datasets, tests are skipped."""

from functools import lru_cache

import numpy as np
import pytest
from cases import each

from ogm.datasets import open_dataset
from ogm.io import read_calibration, read_points
from ogm.io.kitti import read_kitti_tracks
from ogm.state import CellState
from ogm.truth import TRUTH_SPEC, cells_in_boxes

FREE, OCCUPIED, IGNORE = CellState.FREE, CellState.OCCUPIED, CellState.IGNORE

opened = lru_cache(None)(open_dataset)  # what several tests use is read once

RECORDINGS = {  # frames, sources, sensor height [m], shares of free and occupied cells of frame 0: least and most
    "kitti_object": (3, ("boxes",), 1.73, (0, 0), (0, 0.01)),
    "labelled_range_images/nuscenes": (4, ("classes",), 1.85, (0.005, 0.03), (0.001, 0.01)),
    "labelled_range_images/semantic_kitti": (5, ("classes",), 1.76, (0.02, 0.06), (0.003, 0.02)),
    "nuscenes_n015": (1, ("boxes",), 1.83, (0, 0), (0.001, 0.01)),
    "argoverse2_adcf": (1, ("boxes", "map"), 1.98, (0.05, 0.15), (0.01, 0.03)),
    "sustechpoints": (3, ("boxes", "aggregated"), 1.8, (0.005, 0.05), (0.005, 0.03)),
    "kitti_odometry_00": (6, ("aggregated",), 1.79, (0.02, 0.08), (0.005, 0.03)),
}


@each("name", RECORDINGS)
def test_a_dataset_opens_by_its_path_and_its_truth_is_plausible(real, name):
    frames, sources, height, free, occupied = RECORDINGS[name]
    dataset = opened(real(name))
    assert (len(dataset), dataset._truth.sources) == (frames, sources)
    frame = dataset[0]
    assert frame.mount.sensor_height == pytest.approx(height, abs=0.06)
    shares = frame.truth.shares()
    assert free[0] <= shares.free <= free[1]
    assert occupied[0] <= shares.occupied <= occupied[1]
    assert shares.unknown == 0
    assert frame.truth.state[TRUTH_SPEC.index(0.0, 0.0)] == IGNORE


def test_the_truth_of_drive_0005_is_that_of_its_labels(real):
    """With truth of later scans alone, to read few of them: frame 80 of 60 to 83."""
    folder = real("kitti_raw_0005")
    dataset = opened(folder, others="later")
    assert len(dataset) == 24
    assert dataset._truth.sources == ("boxes", "aggregated")
    frame = dataset[20]
    assert frame.name == "0000000080"
    assert frame.mount.sensor_height == pytest.approx(1.76, abs=0.06)
    T = read_calibration(folder / "calib_2011_09_26.txt")
    objects = read_kitti_tracks(folder / "label_02_0000.txt", T)[80]
    assert (frame.boxes.center == objects.center).all()
    assert set(dataset._truth._moving_tracks(frame.sequence)) == {"0", "1"}  # the van and the cyclist ahead
    state = frame.truth.state
    seen = objects.select([name in ("0", "1") for name in objects.track])
    assert (state[cells_in_boxes(seen, TRUTH_SPEC)] == OCCUPIED).all()
    ahead = state[TRUTH_SPEC.index(np.arange(6.0, 9.0, 0.16), np.zeros(19))]
    assert np.mean(ahead == FREE) > 0.8
    first, last = dataset[0].T_map_sensor, dataset[23].T_map_sensor
    assert np.linalg.norm((np.linalg.inv(first) @ last)[:3, 3]) == pytest.approx(9, abs=1)


def test_moving_objects_leave_no_trail_in_sustechpoints(real):
    """Where a car drove in another scan, and none stands now, nothing is occupied by other scans."""
    dataset = open_dataset(real("sustechpoints"), truth=("aggregated",))
    frame, other = dataset[1], dataset[2]
    moving = dataset._truth._moving_tracks(frame.sequence)
    assert len(moving) > 3
    T = np.linalg.inv(frame.T_map_sensor) @ other.T_map_sensor
    there = other.boxes.select([name in moving for name in other.boxes.track])
    left = cells_in_boxes(there.moved(T).widened(-0.15), TRUTH_SPEC)
    left &= ~cells_in_boxes(frame.boxes.widened(0.3), TRUTH_SPEC)
    assert left.sum() > 100
    assert np.mean(frame.truth.state[left] == OCCUPIED) < 0.02


def test_argoverse_is_seen_from_its_upper_lidar(real):
    dataset = opened(real("argoverse2_adcf"))
    frame = dataset[0]
    assert "upper lidar" in dataset.description
    every = read_points(next(real("argoverse2_adcf").glob("sensors/lidar/*.feather")))
    assert 0.4 * len(every) < len(frame.scan.points) < 0.6 * len(every)
    angle = np.degrees(np.arctan2(frame.scan.points[:, 2], np.hypot(*frame.scan.points[:, :2].T)))
    assert len(np.unique(np.round(angle, 1))) < 120  # 32 beams, seen from where they start
    assert len(frame.boxes) == 47
    road = frame.truth.state[TRUTH_SPEC.index(np.arange(-20.0, -4.0, 0.5), np.full(32, 2.0))]
    assert (road == FREE).mean() > 0.9


def test_a_truth_is_that_of_the_scans_own_surroundings(real):
    """Turned by 10 degrees or moved half a metre aside, a scan's obstacles no longer lie on those of the truth."""
    frame = opened(real("kitti_odometry_00"))[0]
    high = frame.scan.points[(frame.scan.points[:, 2] > -1.2) & (frame.scan.points[:, 2] < 0)]
    x, y = high[np.hypot(*high[:, :2].T) < 30][:, :2].T

    def found(dy: float, yaw: float) -> float:
        c, s = np.cos(yaw), np.sin(yaw)
        at = TRUTH_SPEC.index(c * x - s * y, s * x + c * y + dy)
        state = frame.truth.state[at]
        return float((state == OCCUPIED).sum() / ((state == OCCUPIED) | (state == FREE)).sum())

    assert found(0, 0) > 0.97
    assert found(0.5, 0) < 0.6
    assert found(0, np.radians(10)) < 0.7


def test_an_unlabelled_scan_has_no_truth_and_keeps_its_beams_without_echo(real):
    frame = open_dataset(real("autoware_apache2"))[0]
    assert len(frame.scan.no_returns) > 1000
    with pytest.raises(ValueError, match=r"wanted poses .*add them"):
        _ = frame.truth
