"""Metrics of motion: perfect and empty input, a plain reference, sums, cells that are left out, bad input."""

import math

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given, settings
from hypothesis import strategies as st
from moving_scenes import LABELS, SPEC, motionless, perfect, scene

from ogm.dynamic_grid import DynamicGrid
from ogm.metrics import MOTION_METRICS, MotionSums, accumulate_motion, distances, motion_curve, score_motion
from ogm.metrics.motion import moving_score, object_kinds
from ogm.metrics.motion_scores import motion_by_range
from ogm.state import Motion

SEEDS = st.integers(0, 2**31)


@settings(max_examples=10, deadline=None)
@given(SEEDS)
def test_the_truth_scores_one_and_0_m_s(seed: int) -> None:
    _, motion, occupied = scene(seed)
    speed = np.hypot(*np.moveaxis(motion.velocity, -1, 0))
    motion.velocity[speed < 0.3] = 0
    found = score_motion(accumulate_motion(perfect(motion, occupied), motion, occupied, LABELS))
    assert list(found) == list(MOTION_METRICS)
    if not (occupied & (speed > 1)).any():
        return
    best = {"higher": 1.0, "lower": 0.0}
    for name, value in found.items():
        if MOTION_METRICS[name].better and not math.isnan(value):
            assert value == pytest.approx(best[MOTION_METRICS[name].better], abs=1e-6), name
    assert found["inside_50"] == found["inside_95"] == 1


@settings(max_examples=10, deadline=None)
@given(SEEDS)
def test_a_grid_in_which_nothing_moves_is_at_chance(seed: int) -> None:
    _, motion, occupied = scene(seed)
    sums = accumulate_motion(motionless(occupied), motion, occupied, LABELS)
    static, moving = sums.score_hist.sum(axis=1)
    found = score_motion(sums)
    if not moving or not static:
        return
    assert found["motion_ap"] == pytest.approx(moving / (moving + static))
    assert found["motion_recall"] == found["motion_iou"] == found["static_moving"] == 0
    assert found["normalised_mean"] == pytest.approx(1)
    assert math.isnan(found["velocity_rmse"])
    assert found["velocity_known"] == 0


def plain(grid: DynamicGrid, motion: Motion, occupied: np.ndarray, kind: str | None = None) -> dict[str, float]:
    """The scores from their definitions, one cell after the other."""
    from scipy.stats import chi2

    rows = []
    for i, j in np.ndindex(*grid.spec.shape):
        true = motion.velocity[i, j].astype(float)
        speed = math.hypot(*true)
        if not occupied[i, j] or math.isnan(speed) or 0.3 <= speed <= 1:
            continue
        free, static, dynamic = grid.mass[i, j].astype(float)
        velocity = grid.velocity[i, j].astype(float)
        known = not np.isnan(velocity).any()
        score = dynamic / (static + dynamic) * min(math.hypot(*velocity), 2) if known and dynamic else 0.0
        error = velocity - true
        estimated = velocity if score > 0.6 else np.zeros(2)
        nees = error @ np.linalg.inv(grid.covariance[i, j].astype(float)) @ error if known else math.nan
        label = LABELS[motion.box[i, j]] if motion.box[i, j] >= 0 else ""
        rows.append((speed > 1, score, known, math.hypot(*error), math.hypot(*(estimated - true)), speed, nees, label))
    moving = [row for row in rows if row[0] and kind in (None, row[-1])]
    static = [row for row in rows if not row[0]]
    right, wrong = (sum(row[1] > 0.6 for row in some) for some in (moving, static))
    known = [row for row in moving if row[2]]
    ordered = sorted(rows, key=lambda row: -row[1])
    hits = np.cumsum([row[0] for row in ordered])
    average = sum(hits[k] / (k + 1) for k, row in enumerate(ordered) if row[0]) / max(hits[-1], 1)
    return {
        "motion_ap": average,
        "motion_iou": right / (len(moving) + wrong),
        "static_moving": wrong / len(static),
        "recall": right / len(moving),
        "velocity_known": len(known) / len(moving),
        "velocity_rmse": math.sqrt(np.mean([row[3] ** 2 for row in known])),
        "velocity_median": float(np.median([row[3] for row in known])),
        "normalised_mean": float(np.mean([row[4] / row[5] for row in moving])),
        "normalised_median": float(np.median([row[4] / row[5] for row in moving])),
        "inside_50": float(np.mean([row[6] <= chi2.ppf(0.5, 2) for row in known])),
        "inside_95": float(np.mean([row[6] <= chi2.ppf(0.95, 2) for row in known])),
        "static_motion_mean": float(np.mean([row[4] for row in static])),
    }


@each("seed", [1, 2, 4])
def test_scores_follow_their_definitions(seed: int) -> None:
    grid, motion, occupied = scene(seed)
    found = score_motion(accumulate_motion(grid, motion, occupied, LABELS))
    for name, value in plain(grid, motion, occupied).items():
        near = 0.05 if name.endswith("median") else 0.01 if name == "motion_ap" else 1e-6
        assert found["motion_recall" if name == "recall" else name] == pytest.approx(value, rel=near), name


def test_kinds_are_those_of_the_labels() -> None:
    words = ["Car", "vehicle.bicycle", "BICYCLIST", "motorcycle", "human.pedestrian.adult", "Person_sitting", "dog"]
    kinds = ["vehicle", "cyclist", "cyclist", "cyclist", "pedestrian", "pedestrian", "other"]
    from ogm.metrics.motion import KINDS

    assert [KINDS[k] for k in object_kinds(words)] == kinds
    grid, motion, occupied = scene(2)
    found = score_motion(accumulate_motion(grid, motion, occupied, LABELS))
    speeds = np.hypot(*np.moveaxis(motion.velocity, -1, 0))
    for label, kind in (("Car", "vehicle"), ("Cyclist", "cyclist"), ("Pedestrian", "pedestrian")):
        if not (occupied & (speeds > 1) & (motion.box == LABELS.index(label))).any():
            assert math.isnan(found[f"{kind}_recall"])
            continue
        wanted = plain(grid, motion, occupied, label)
        for name in ("recall", "velocity_rmse", "normalised_mean"):
            assert found[f"{kind}_{name}"] == pytest.approx(wanted[name], rel=1e-6)


@settings(max_examples=10, deadline=None)
@given(SEEDS)
def test_sums_of_parts_are_those_of_the_whole(seed: int) -> None:
    grid, motion, occupied = scene(seed)
    left = np.zeros(SPEC.shape, bool)
    left[:12] = True
    whole = accumulate_motion(grid, motion, occupied, LABELS, distances(SPEC))
    parts = [accumulate_motion(grid, motion, occupied & side, LABELS, distances(SPEC)) for side in (left, ~left)]
    for name, a, b in zip(MotionSums._fields, whole, parts[0].plus(parts[1]), strict=True):
        if name != "body":  # of an object that both parts show
            np.testing.assert_allclose(a, b, err_msg=name)
    assert [one.shape for one in MotionSums.zeros()] == [one.shape for one in whole]
    assert whole.range_cells[..., 0].sum() == whole.score_hist.sum()
    np.testing.assert_allclose(motion_by_range(whole)["static_cells"].sum(), whole.cells[-1, 0])


@settings(max_examples=10, deadline=None)
@given(SEEDS, st.sampled_from([0, 1, 2, 3]))
def test_turning_grid_and_truth_changes_nothing(seed: int, quarter: int) -> None:
    grid, motion, occupied = scene(seed)
    c, s = [(1, 0), (0, 1), (-1, 0), (0, -1)][quarter]
    turn = np.array([[c, -s], [s, c]], np.float32)
    other = DynamicGrid(SPEC, grid.mass, grid.velocity @ turn.T, turn @ grid.covariance @ turn.T)
    turned = Motion(motion.velocity @ turn.T, motion.box)
    a, b = (
        score_motion(accumulate_motion(one, truth, occupied, LABELS))
        for one, truth in ((grid, motion), (other, turned))
    )
    assert a == pytest.approx(b, rel=1e-3, abs=1e-3, nan_ok=True)


def test_cells_of_unknown_motion_and_slow_ones_are_left_out() -> None:
    grid, motion, occupied = scene(1)
    velocity = np.zeros((*SPEC.shape, 2), np.float32)
    velocity[..., 0] = np.where(np.arange(SPEC.shape[1]) % 2, np.nan, 0.6)
    sums = accumulate_motion(grid, Motion(velocity, motion.box), occupied, LABELS)
    assert not any(one.any() for one in sums)
    assert all(math.isnan(value) for value in score_motion(sums).values())
    assert len(motion_curve(sums).recall) == 0


def test_cells_of_moving_objects_in_sight_are_compared_with_free() -> None:
    box, velocity = np.full(SPEC.shape, -1, np.int16), np.zeros((*SPEC.shape, 2), np.float32)
    box[2:6, 2:4], box[10:14, 2:4] = 0, 1
    velocity[box >= 0] = 3, 0
    occupied = np.zeros(SPEC.shape, bool)
    occupied[2, 2] = True  # the scan shows the first object alone
    mass = np.zeros((*SPEC.shape, 3), np.float32)
    mass[2:4, 2:4] = 0.2, 0.3, 0.3
    mass[4, 2:4] = 0.7, 0.0, 0.1
    mass[10:14, 2:4, 0] = 1
    nothing = motionless(occupied)
    grid = DynamicGrid(SPEC, mass, nothing.velocity, nothing.covariance)
    found = score_motion(accumulate_motion(grid, Motion(velocity, box), occupied))
    assert (found["moving_occupied"], found["moving_free"]) == (0.5, 0.25)


def test_the_score_is_belief_times_speed_up_to_2_m_s() -> None:
    mass = np.zeros((*SPEC.shape, 3), np.float32)
    mass[:4, 0] = [(0.5, 0.0, 0.5), (0.0, 0.6, 0.2), (0.0, 0.4, 0.0), (0.0, 0.0, 0.5)]
    velocity = np.full((*SPEC.shape, 2), np.nan, np.float32)
    velocity[[0, 1, 3], 0] = [(3, 4), (0, 1), (0.3, 0.4)]
    grid = DynamicGrid(SPEC, mass, velocity, np.full((*SPEC.shape, 2, 2), np.nan, np.float32))
    np.testing.assert_allclose(moving_score(grid)[:5, 0], [2, 0.25, 0, 0.5, 0], rtol=1e-6)


def test_the_curve_ends_at_all_cells_and_falls_in_threshold() -> None:
    grid, motion, occupied = scene(1)
    sums = accumulate_motion(grid, motion, occupied, LABELS)
    recall, precision, threshold = motion_curve(sums)
    assert recall[-1] == 1
    assert precision[-1] == pytest.approx(sums.cells[0, 0] / sums.score_hist.sum())
    assert (np.diff(recall) >= 0).all()
    assert (np.diff(threshold) < 0).all()


def test_other_cells_and_missing_labels_are_refused() -> None:
    grid, motion, occupied = scene(1)
    refused("occupied must have the grid's cells", accumulate_motion, grid, motion, occupied[1:], LABELS)
    refused("an entry for box 3 of motion.box, got 2", accumulate_motion, grid, motion, occupied, LABELS[:2])
