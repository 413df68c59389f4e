"""Which scans make the truth of which, on which ground, where the ego vehicle was, and what a class means to a car."""

import numpy as np
import pytest
from cases import each

from ogm import GridSpec
from ogm.datasets import truth_from_neighbours
from ogm.datasets.frames import kinds_of
from ogm.datasets.neighbours import choose_neighbours, ego_path_cells, find_ground
from ogm.io.labels import LabelledPoints
from ogm.io.range_images import NUSCENES_ELEVEN
from ogm.io.semantic_kitti import SEMANTIC_KITTI, SEMANTIC_KITTI_TRAINING
from ogm.pose import pose
from ogm.scan import Boxes
from ogm.state import CellState
from ogm.truth import TRUTH_SPEC, Kind

FREE, OCCUPIED, IGNORE = CellState.FREE, CellState.OCCUPIED, CellState.IGNORE

SMALL = GridSpec.centered(8.0, 8.0, 0.5)
NONE = Boxes.empty()


def along(count: int, step: float = 1.0) -> np.ndarray:
    return np.column_stack([step * np.arange(count), np.zeros(count), np.zeros(count)])


def test_a_scan_is_no_neighbour_of_itself() -> None:
    stamps = 0.1 * np.arange(6)
    for n in range(6):
        found = choose_neighbours(n, stamps, along(6), later=False)
        assert found == [k for k in range(6) if k != n]
        assert choose_neighbours(n, stamps, along(6), later=True) == list(range(n + 1, 6))


def test_far_scans_are_no_neighbours() -> None:
    stamps = 0.1 * np.arange(100)
    assert choose_neighbours(50, stamps, along(100, 30.0), later=False) == [49, 51]
    assert choose_neighbours(0, 40.0 * np.arange(5), along(5, 0.0), later=False) == []


def test_of_many_scans_some_are_chosen_from_the_first_to_the_last() -> None:
    found = choose_neighbours(500, 0.02 * np.arange(1000), along(1000, 0.02), later=False)
    assert len(found) == 40
    assert (found[0], found[-1]) == (0, 999)
    assert 500 not in found
    assert np.diff(found).max() <= 27


def test_cells_on_the_path_of_the_ego_vehicle() -> None:
    stood = ego_path_cells(np.array([pose(), pose(x=10, yaw=np.pi / 2), pose(x=500)]))
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


def test_neighbours_show_what_stands_and_what_is_free() -> None:
    truth = truth_from_neighbours([street((2.1, 1.1))] * 3, SMALL, NONE)
    assert at(truth, 2.1, 1.1) == OCCUPIED
    assert np.mean(truth.state == FREE) > 0.9


def test_the_ground_may_climb() -> None:
    """One metre in ten: at the end of the grid it lies 0.4 m higher than below the sensor, as an obstacle would."""
    scan = street((-3.1, 1.1))
    scan[:, 2] += 0.1 * scan[:, 0]
    truth = truth_from_neighbours([scan] * 3, SMALL, NONE)
    assert np.mean(truth.state == FREE) > 0.9
    assert at(truth, -3.1, 1.1) == OCCUPIED


def test_the_scan_itself_only_contradicts() -> None:
    neighbours = [street((2.1, 1.1))] * 3
    now = street((-2.1, -1.1))  # what stood there left, and something came
    truth = truth_from_neighbours(neighbours, SMALL, NONE, own=now)
    assert at(truth, 2.1, 1.1) == IGNORE
    assert at(truth, -2.1, -1.1) == IGNORE
    same = truth_from_neighbours(neighbours, SMALL, NONE, own=street((2.1, 1.1)))
    assert (same.state == truth_from_neighbours(neighbours, SMALL, NONE).state).all()


def test_cells_under_moving_boxes_are_ignored() -> None:
    truth = truth_from_neighbours([street()] * 3, SMALL, Boxes([2.0, 1.0, -0.9], [2.0, 1.0, 1.8], 0.0))
    assert at(truth, 2.0, 1.0) == at(truth, 2.8, 1.2) == IGNORE
    assert at(truth, -2.0, -1.0) == FREE


def test_labelled_ground_and_a_maps_ground_are_taken_as_given() -> None:
    """A hedge 0.5 m high over all of the street: labels and map know that it is no ground, heights do not."""
    hedge = street()
    hedge[:, 2] += 0.5
    clouds = [np.concatenate([street(), hedge])] * 3
    labels = [np.repeat([True, False], len(hedge))] * 3
    labelled = truth_from_neighbours(clouds, SMALL, NONE, is_ground=labels)
    mapped = truth_from_neighbours(clouds, SMALL, NONE, map_ground=lambda xyz: np.full(len(xyz), -1.8))
    assert np.mean(labelled.state == OCCUPIED) > 0.9
    assert np.mean(mapped.state == OCCUPIED) > 0.9
    unknown = truth_from_neighbours(clouds, SMALL, NONE, map_ground=lambda xyz: np.full(len(xyz), np.nan))
    assert (unknown.state == IGNORE).all()


def test_cars_walls_and_ghosts_are_no_ground() -> None:
    rng = np.random.default_rng(0)
    road = np.column_stack([rng.uniform(-20, 20, (40_000, 2)), rng.normal(-1.8, 0.02, 40_000)])
    road[:, 2] += 0.05 * road[:, 0]  # it climbs by 5 %
    at_car = (np.abs(road[:, 0] - 8) < 2.2) & (np.abs(road[:, 1]) < 1.0)
    car = np.column_stack([rng.uniform(5.8, 10.2, 800), rng.uniform(-1, 1, 800), rng.uniform(-1.0, 0, 800)])
    wall = np.column_stack([rng.uniform(-20, 20, 2000), np.full(2000, 15.0), rng.uniform(-1.5, 2, 2000)])
    ghosts = np.column_stack([rng.uniform(-20, 20, (200, 2)), rng.uniform(-6, -3.5, 200)])
    parts = [road[~at_car], car, wall, ghosts]
    found = np.split(find_ground(np.concatenate(parts)), np.cumsum([len(part) for part in parts]))
    assert found[0].mean() > 0.97
    assert found[1].mean() < 0.02
    assert found[2].mean() < 0.1
    assert not found[3].any()
    assert find_ground(np.empty((0, 3))).shape == (0,)


@each("names, ground, plants, nothing", [
        (SEMANTIC_KITTI, {40, 44, 48, 49, 60, 72}, {70}, {0, 1}),
        (SEMANTIC_KITTI_TRAINING, {9, 10, 11, 12, 17}, {15}, {0}),
        (NUSCENES_ELEVEN, {0, 1}, {4}, {10}),
    ])  # fmt: skip
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
