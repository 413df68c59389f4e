"""What holds for every score: symmetries, extremes, perfect maps, reasons for what is missing, bad input."""

import math

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from plain import FREE, IGNORE, OCCUPIED, UNKNOWN, lattice_grid

from ogm.evidence import evidence_to_mass
from ogm.grid import GridSpec
from ogm.metrics import METRICS, ConfusionSums, accumulate, distances, score
from ogm.metrics.scores import by_range, reasons

SPEC = GridSpec.centered(length=70, width=70, resolution=10)
SWAP = np.array([UNKNOWN, OCCUPIED, FREE, IGNORE], np.uint8)
SWAPPED = {  # scores that become each other's when free and occupied change places
    "iou_free": "iou_occupied",
    "iou_free_known": "iou_occupied_known",
    "false_free": "false_occupied",
    "conflict_free": "conflict_occupied",
    "mean_free": "mean_occupied",
}
ONE_SIDED = {  # scores of one of the two only
    "missed_occupied", "missed_obstacles", "free_recall_1", "free_recall_01", "ap_occupied", "ap_occupied_near",
    "interval_violation",
}  # fmt: skip
FRACTIONS = {
    name
    for name in METRICS
    if not name.startswith(("kl_", "legacy_kl", "nll", "map_score"))
}  # fmt: skip


FROM = [name for name in METRICS if name.startswith("from")]  # scores that leave low obstacles out


def truth_as_mass(state: NDArray[np.uint8], strength: float = math.inf) -> NDArray[np.float32]:
    evidence = np.stack([state == FREE, state == OCCUPIED], axis=-1).astype(np.float32)
    return evidence if math.isinf(strength) else evidence_to_mass(strength * evidence)


def high(state: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return heights [cm] that leave no obstacle out."""
    return np.full(state.shape, 150, np.uint8)


# Symmetries


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31), axis=st.sampled_from([(0,), (1,), (0, 1)]), coarse=st.sampled_from([1, 256]))
def test_flipping_both_grids_changes_nothing(seed: int, axis: tuple[int, ...], coarse: int) -> None:
    mass, state = lattice_grid(seed, coarse=coarse)
    away = distances(SPEC)
    one, other = accumulate(mass, state, away), accumulate(np.flip(mass, axis), np.flip(state, axis), away)
    assert score(other) == pytest.approx(score(one), nan_ok=True)
    for name, column in by_range(one).items():
        np.testing.assert_allclose(by_range(other)[name], column, err_msg=name)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_exchanging_free_and_occupied_exchanges_their_scores(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mass = rng.dirichlet([0.5, 0.5, 0.5], (12, 12))[..., :2]
    state = rng.choice(4, size=(12, 12)).astype(np.uint8)
    one, other = score(accumulate(mass, state)), score(accumulate(mass[..., ::-1], SWAP[state]))
    both = SWAPPED | {b: a for a, b in SWAPPED.items()}
    for name in METRICS.keys() - ONE_SIDED:
        near = 1e-3 if name == "ace" else 1e-6  # levels of P are halved upwards
        assert other[both.get(name, name)] == pytest.approx(one[name], rel=near, abs=near, nan_ok=True), name


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_cells_that_the_truth_ignores_have_no_effect(seed: int) -> None:
    mass, state = lattice_grid(seed)
    other = mass.copy()
    other[state == IGNORE] = np.random.default_rng(seed).dirichlet([1, 1, 1], (state == IGNORE).sum())[:, :2]
    assert score(accumulate(other, state)) == pytest.approx(score(accumulate(mass, state)), nan_ok=True)


def test_counts_add_up_to_those_of_the_cells_together() -> None:
    between = (np.zeros((1, 7, 2), np.float32), np.full((1, 7), IGNORE, np.uint8))  # else cells become neighbours
    rows, rng = [lattice_grid(1), between, lattice_grid(2)], np.random.default_rng(11)
    rows = [(mass, state, None, rng.integers(5, 201, state.shape).astype(np.uint8)) for mass, state in rows]
    whole = accumulate(*(None if column[0] is None else np.concatenate(column) for column in zip(*rows, strict=True)))
    for name, one, other in zip(
        ConfusionSums._fields, accumulate(*rows[0]).plus(accumulate(*rows[2])), whole, strict=True
    ):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-7, err_msg=name)


@each("dtype", [np.float32, np.float64])
def test_both_float_types_and_any_layout_are_taken(dtype: type) -> None:
    mass, state = lattice_grid(3)
    height = np.random.default_rng(3).integers(5, 201, state.shape).astype(np.uint8)
    wanted = score(accumulate(mass, state, None, height))
    assert score(accumulate(mass.astype(dtype), state, None, height)) == wanted
    turned = np.asfortranarray(mass.astype(dtype)), np.asfortranarray(state), None, np.asfortranarray(height)
    assert score(accumulate(*turned)) == wanted
    planes = np.ascontiguousarray(np.moveaxis(mass.astype(dtype), -1, 0))
    assert score(accumulate(np.moveaxis(planes, 0, -1), state, None, height)) == wanted


def test_sums_are_small_and_of_numbers() -> None:
    counts = accumulate(*lattice_grid(4), distances(SPEC))
    assert all(one.dtype == np.float64 and one.size < 13_000 for one in counts)
    assert sum(one.nbytes for one in counts) < 500_000


# Perfect maps


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_a_perfect_map_is_perfect_under_every_metric(seed: int) -> None:
    """Dogmatic truth has the best value of every score but the divergences, which ask for the truth's evidence."""
    _, state = lattice_grid(seed, (12, 12))
    best = {"lower": 0.0, "higher": 1.0}
    scores = score(accumulate(truth_as_mass(state), state, None, high(state)))
    for name, metric in METRICS.items():
        if metric.better and not name.startswith("kl_"):
            assert scores[name] == pytest.approx(best[metric.better], abs=1e-6), name


@each(("strength", "names"), [(1.0, ("kl_e1", "kl_e1_reverse")), (10.0, ("kl_e10", "kl_e10_reverse", "kl_e1_scaled"))])
def test_a_divergence_is_zero_for_the_truth_of_its_own_evidence_only(strength: float, names: tuple[str, ...]) -> None:
    """A divergence grows where evidence exceeds that of the truth: its optimum is the evidence of the truth."""
    _, state = lattice_grid(5)
    exact = score(accumulate(truth_as_mass(state, strength), state))
    surer = score(accumulate(truth_as_mass(state, 3 * strength), state))
    dogmatic = score(accumulate(truth_as_mass(state), state))
    for name in names:
        assert exact[name] == pytest.approx(0, abs=1e-6)
        assert 0.01 < surer[name] < dogmatic[name]


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31), share=st.floats(0.1, 0.9))
def test_no_map_is_better_than_the_perfect_one(seed: int, share: float) -> None:
    mass, state = lattice_grid(seed, (12, 12))
    perfect = score(accumulate(truth_as_mass(state), state))
    spoilt = np.where(np.random.default_rng(seed).random((12, 12, 1)) < share, mass, truth_as_mass(state))
    scores = score(accumulate(spoilt.astype(np.float32), state))
    for name, metric in METRICS.items():
        if metric.better and not name.startswith("kl_") and not math.isnan(scores[name]):
            gain = scores[name] - perfect[name]
            assert (gain if metric.better == "higher" else -gain) <= 1e-6, name


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_fractions_are_fractions_and_divergences_are_not_negative(seed: int) -> None:
    scores = score(accumulate(*lattice_grid(seed)))
    assert tuple(scores) == tuple(METRICS)
    for name, value in scores.items():
        if not math.isnan(value):
            low, high = (0, 1) if name in FRACTIONS else (-math.inf, 1) if name == "map_score" else (0, math.inf)
            assert low - 1e-9 <= value <= high + 1e-9, name


# Extremes


def test_scores_of_a_vacuous_grid() -> None:
    _, state = lattice_grid(6)
    scores = score(accumulate(np.zeros((7, 7, 2), np.float32), state))
    share = (state == OCCUPIED).sum() / ((state == OCCUPIED) | (state == FREE)).sum()
    known = np.mean(state[state != IGNORE] != UNKNOWN)
    wanted = {
        "nll": math.log(2), "map_score": 0, "brier": 0.25, "brier_expected": 0.25 + 1 / 12, "entropy": 1,
        "dissonance": 0, "conflict": 0, "false_free": 0, "false_occupied": 0, "missed_occupied": 1,
        "missed_obstacles": 1, "free_recall_1": 0, "free_recall_01": 0, "ap_occupied": share, "auroc_unknown": 0.5,
        "fpr95_unknown": 1, "aurc": 0.5, "ause": 0, "ace": abs(0.5 - share), "ece": abs(0.5 - share),
        "interval_violation": 0, "legacy_accuracy": 1, "iou_unknown": 1 - known, "iou_free": 0, "iou_occupied": 0,
        "iou_occupied_known": 0, "mean_unknown": 1, "kl_e10": known * (10 - math.log(11)),
        "kl_e1": known * (1 - math.log(2)),
    }  # fmt: skip
    assert {name: scores[name] for name in wanted} == pytest.approx(wanted)


def test_a_dogmatic_grid_that_is_wrong_everywhere_is_worst_and_finite() -> None:
    _, state = lattice_grid(7)
    scores = score(accumulate(truth_as_mass(SWAP[state]), state, None, high(state)))
    wanted = {
        "nll": -math.log(1e-5), "map_score": 1 + math.log2(1e-5), "brier": 1, "conflict": 1, "false_free": 1,
        "false_occupied": 1, "missed_occupied": 1, "aurc": 1, "ause": 0, "ece": 1, "interval_violation": 1,
        "iou_free": 0, "iou_occupied": 0, "iou_unknown": 1, "free_recall_1": 0, "entropy": (state == UNKNOWN).mean()
        / (state != IGNORE).mean(),
    }  # fmt: skip
    assert {name: scores[name] for name in wanted} == pytest.approx(wanted, abs=1e-9)
    assert scores["ace"] > 1 - 1 / 15  # in one of the 15 bins both kinds of errors meet and cancel
    assert all(math.isfinite(value) for value in scores.values())


@each(("states", "missing"), [
        ((IGNORE,), dict.fromkeys(METRICS, "the truth ignores every cell")),
        (
            (FREE, OCCUPIED),
            dict.fromkeys(
                ("iou_unknown", "auroc_unknown", "aupr_unknown", "aupr_known", "fpr95_unknown"),
                "the truth has no unknown cell",
            ),
        ),
        (
            (UNKNOWN, FREE),
            dict.fromkeys(
                ("iou_occupied", "iou_occupied_known", "false_free", "missed_occupied", "missed_obstacles",
                 "conflict_free", "free_recall_1", "free_recall_01", "ap_occupied", "ap_occupied_near"),
                "the truth has no occupied cell",
            ) | dict.fromkeys(FROM, "the truth has no obstacle of this height, or no heights"),
        ),
        (
            (UNKNOWN, OCCUPIED),
            dict.fromkeys(
                ("iou_free", "iou_free_known", "from10_iou_free", "from50_iou_free", "false_occupied",
                 "conflict_occupied", "free_recall_1", "free_recall_01", "ap_occupied", "ap_occupied_near"),
                "the truth has no free cell",
            ),
        ),
    ])  # fmt: skip
def test_what_is_missing_has_a_reason(states: tuple[int, ...], missing: dict[str, str]) -> None:
    state = np.resize(np.array(states, np.uint8), (7, 7))
    assert reasons(accumulate(np.full((7, 7, 2), [0.7, 0.0]), state, None, high(state))) == missing


def test_unknown_cells_alone_leave_what_is_about_unknown() -> None:
    found = reasons(accumulate(np.full((7, 7, 2), [0.7, 0.0]), np.full((7, 7), UNKNOWN, np.uint8)))
    assert found["auroc_unknown"] == "the truth has no known cell"
    assert found["free_recall_1"] == "the truth has no free and no occupied cell"
    assert found["brier"] == found["ece_called"] == "the truth has no known cell"
    assert found["iou_free"] == found["iou_free_known"] == "the truth has no free cell"
    assert not {"kl_e10", "iou_unknown", "entropy", "mean_free", "legacy_kl"} & set(found)


def test_a_vacuous_grid_has_no_calibration_of_predicted_states() -> None:
    _, state = lattice_grid(8)
    found = reasons(accumulate(np.zeros((7, 7, 2)), state, None, high(state)))
    assert found == {"ece_called": "the grid predicts every known cell as unknown"}


def test_without_heights_no_obstacle_is_left_out_in_silence() -> None:
    found = score(accumulate(*lattice_grid(8)))
    assert {name for name, value in found.items() if math.isnan(value)} == set(FROM)


@settings(max_examples=25, deadline=None)
@given(states=st.lists(st.integers(0, 3), min_size=1, max_size=6), mass=st.sampled_from([(0, 0), (1, 0), (0.2, 0.7)]))
def test_what_is_nan_has_a_reason_and_nothing_else_has(states: list[int], mass: tuple[float, float]) -> None:
    counts = accumulate(np.full((1, len(states), 2), mass, np.float64), np.array([states], np.uint8))
    assert reasons(counts).keys() == {name for name, value in score(counts).items() if math.isnan(value)}


def test_a_grid_without_cells_has_no_scores() -> None:
    assert all(math.isnan(v) for v in score(accumulate(np.zeros((0, 7, 2)), np.zeros((0, 7), np.uint8))).values())


# Bad input


def test_bad_input_is_refused() -> None:
    mass, state = np.zeros((3, 3, 2), np.float32), np.zeros((3, 3), np.uint8)
    for value, message in (
        (math.nan, "nan"),
        (math.inf, "inf"),
        (-math.inf, "-inf"),
        (-0.01, "must be non-negative .* worst of the 1 cells .*-0.00999"),
        (1.01, "sum to at most 1 .*1.00999.*; evidence becomes masses by"),
    ):
        spoilt = mass.copy()
        spoilt[1, 2, 0] = value
        refused(message, accumulate, spoilt, state)
    refused("worst of the 9 cells", accumulate, mass + np.float32(0.6), state)
    refused("nan", accumulate, np.full((3, 3, 2), np.nan), state)
    for shape in ((3, 2), (9, 2)):
        refused(r"shape \(nx, ny, 2\)", accumulate, np.zeros(shape, np.float32), state)
    for dtype in (np.float16, np.int64, np.complex128, bool, object):
        refused("mass must be float32 or float64, got", accumulate, mass.astype(dtype), state, error=TypeError)
    refused("crop the truth", accumulate, mass, np.zeros((3, 4), np.uint8))
    refused("crop the truth", accumulate, np.zeros((3, 3, 3)), state)
    refused("state must be uint8", accumulate, mass, np.zeros((3, 3)))
    refused("up to 4", accumulate, mass, state + np.uint8(4))
    for distance, message in (
        (np.zeros((3, 4), np.float32), "a float array of shape"),
        (np.zeros((3, 3), np.int64), "must be a float array"),
        (np.full((3, 3), -1.0), "at least 0 m, got -1"),
        (np.full((3, 3), np.nan), "at least 0 m, got nan"),
    ):
        refused(message, accumulate, mass, state, distance)
    refused("height_cm must have the cells' shape", accumulate, mass, state, None, np.zeros((3, 4), np.uint8))


def test_rounding_is_tolerated() -> None:
    mass = np.zeros((3, 3, 2), np.float32)
    mass[1, 2, 0], mass[0, 0] = 1 + 5e-7, -5e-7
    assert score(accumulate(mass, np.zeros((3, 3), np.uint8)))["mean_free"] == pytest.approx(1 / 9)
