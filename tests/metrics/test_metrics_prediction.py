"""Metrics of predictions and times to detection: perfect input, standing still, tolerance, a plain reference."""

import math

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given, settings
from hypothesis import strategies as st
from moving_scenes import SPEC, motionless, perfect, scene

from ogm.dynamic_grid import DynamicGrid
from ogm.metrics import PREDICTION_METRICS, PredictionSums, accumulate_prediction, detection_times, score_prediction
from ogm.metrics.detection_time import ObjectCells, object_cells
from ogm.state import CellState, Motion, Truth

SEEDS = st.integers(0, 2**31)


def car(x: int, speed: float = 5.0) -> tuple[Motion, np.ndarray]:
    """Return the motion of a car of 4 x 2 cells, and its cells."""
    velocity, box = np.zeros((*SPEC.shape, 2), np.float32), np.full(SPEC.shape, -1, np.int16)
    velocity[x : x + 4, 5:7, 0], box[x : x + 4, 5:7] = speed, 0
    return Motion(velocity, box), box == 0


def at(x: int) -> tuple[Truth, np.ndarray]:
    motion, cells = car(x)
    state = np.where(cells, CellState.OCCUPIED, CellState.FREE).astype(np.uint8)
    return Truth(SPEC, state, motion=motion), cells


def test_a_perfect_prediction_scores_one_and_standing_still_nothing() -> None:
    (later, cells), (now, here) = at(12), at(5)
    found = score_prediction(accumulate_prediction(perfect(later.motion, cells), later, cells, here))
    assert list(found) == list(PREDICTION_METRICS)
    for name, value in found.items():
        assert value == {"higher": 1.0, "lower": 0.0}[PREDICTION_METRICS[name].better], name
    still = score_prediction(accumulate_prediction(perfect(now.motion, here), later, cells, here))
    assert (still["recall"], still["precision"], still["recall_at_70"], still["brier_moving"]) == (0, 0, 0, 1)
    assert still["brier"] == pytest.approx(16 / cells.size)
    nothing = score_prediction(accumulate_prediction(motionless(here), later, cells))
    assert nothing["recall"] == 0
    assert math.isnan(nothing["precision"])


@each(("shift", "recall", "precision"), [(1, 1, 1), (2, 6 / 8, 6 / 8), (6, 0, 0)])
def test_the_tolerance_is_one_cell(shift: int, recall: float, precision: float) -> None:
    (later, cells), (other, there) = at(12), at(12 + shift)
    found = score_prediction(accumulate_prediction(perfect(other.motion, there), later, cells))
    assert (found["recall"], found["precision"]) == pytest.approx((recall, precision))


@settings(max_examples=15, deadline=None)
@given(SEEDS)
def test_scores_follow_their_definitions(seed: int) -> None:
    grid, motion, occupied = scene(seed)
    state = np.random.default_rng(seed).integers(0, 4, SPEC.shape).astype(np.uint8)
    found = score_prediction(accumulate_prediction(grid, Truth(SPEC, state, motion=motion), occupied))
    speed, (nx, ny) = np.hypot(*np.moveaxis(motion.velocity, -1, 0)), SPEC.shape
    mass = grid.dynamic * np.minimum(np.nan_to_num(grid.speed) / 2, 1)
    mass = np.floor(mass * 1024 + 1e-6) / 1024
    right, predicted, hit, wanted, errors = 0, 0, 0, 0, []
    for i, j in np.ndindex(nx, ny):
        around = slice(max(i - 1, 0), i + 2), slice(max(j - 1, 0), j + 2)
        if speed[i, j] > 1 and occupied[i, j]:
            wanted += 1
            hit += mass[around].max() > 0.25
        if (speed[i, j] > 1 or speed[i, j] < 0.3) and mass[i, j] > 0.25:
            predicted += 1
            right += (speed[around] > 1).any()
        if state[i, j] in (CellState.FREE, CellState.OCCUPIED):
            p = grid.occupied[i, j] + 0.5 * (1 - grid.free[i, j] - grid.occupied[i, j])
            errors.append((float(p) - (state[i, j] == CellState.OCCUPIED)) ** 2)
    assert found["recall"] == pytest.approx(hit / wanted if wanted else math.nan, nan_ok=True)
    assert found["precision"] == pytest.approx(right / predicted if predicted else math.nan, nan_ok=True)
    assert found["brier"] == pytest.approx(np.mean(errors), rel=1e-5)


@settings(max_examples=10, deadline=None)
@given(SEEDS, SEEDS)
def test_sums_of_two_grids_add_up(first: int, second: int) -> None:
    sums = []
    for seed in (first, second):
        grid, motion, occupied = scene(seed)
        state = np.where(occupied, CellState.OCCUPIED, CellState.FREE).astype(np.uint8)
        sums.append(accumulate_prediction(grid, Truth(SPEC, state, motion=motion), occupied))
    both = sums[0].plus(sums[1])
    assert both.reliability[0, :, 0].sum() == 2 * occupied.size
    assert [one.shape for one in PredictionSums.zeros()] == [one.shape for one in both]
    low, high = sorted(score_prediction(one)["brier"] for one in sums)
    assert low - 1e-12 <= score_prediction(both)["brier"] <= high + 1e-12


def test_a_truth_without_motion_is_refused() -> None:
    truth, cells = at(3)
    refused("must have motion", accumulate_prediction, motionless(cells), Truth(SPEC, truth.state), cells)
    refused("occupied must have", accumulate_prediction, motionless(cells), truth, cells[1:])


def sight(speed: float, cells: int, predicted: int, track: str = "a") -> ObjectCells:
    return ObjectCells(np.array([track]), np.array([speed]), np.array([cells]), np.array([predicted]))


def test_time_counts_from_the_first_cell_in_sight() -> None:
    nothing = ObjectCells(np.array([], str), np.zeros(0), np.zeros(0, int), np.zeros(0, int))
    frames = [nothing, sight(5, 3, 0), sight(5, 4, 1), nothing, sight(5, 4, 2), sight(5, 9, 0)]
    (one,) = detection_times((0.1 * k, frame) for k, frame in enumerate(frames))
    assert (one.track, one.stamp, one.seconds, one.scans) == ("a", 0.1, pytest.approx(0.3), 3)
    assert not one.from_rest
    (other,) = detection_times([(0.0, sight(0, 5, 0)), (0.1, sight(0.6, 5, 5)), (0.2, sight(2, 5, 5))])
    assert (other.stamp, other.seconds, other.from_rest) == (0.2, 0, True)


@each("scans", [4, 5, 9])
def test_an_object_that_is_never_detected_counts_if_it_was_long_in_sight(scans: int) -> None:
    found = detection_times((0.1 * k, sight(5, 4, 1)) for k in range(scans))
    assert [one.seconds for one in found] == ([math.inf] if scans >= 5 else [])


def test_cells_of_objects_are_counted_where_the_scan_shows_them() -> None:
    motion, cells = car(3)
    occupied, predicted = np.zeros((2, *SPEC.shape), bool)
    occupied[4:6], predicted[5:, 5] = True, True
    found = object_cells(motion, occupied, predicted, ["car 7"])
    assert [one.tolist() for one in found] == [["car 7"], [5.0], [4], [1]]
    assert len(object_cells(motion, occupied, predicted, [""]).track) == 0
    assert len(object_cells(motion, ~cells, predicted, ["car 7"]).track) == 0
    assert isinstance(found, ObjectCells)
    assert isinstance(perfect(motion, cells), DynamicGrid)
