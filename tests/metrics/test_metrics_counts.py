"""Counts and scores, and their references: divergences, sums, ranking, edges of bins and thresholds."""

import numpy as np
import pytest
from cases import each
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from plain import FREE, IGNORE, OCCUPIED, UNKNOWN
from scipy import special

from ogm.evidence import dirichlet_kl, evidence_to_mass
from ogm.metrics import ConfusionSums, accumulate, divergence, free_space, score
from ogm.metrics.areas import auroc, average_precision, false_positive_rate
from ogm.metrics.counts import RANGES
from ogm.metrics.evilog import evilog_kl
from ogm.metrics.scores import by_range, reasons
from ogm.state import predict_state


def random_grid(seed: int, shape: tuple[int, ...] = (7, 7)) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Masses of all kinds, also vacuous and nearly dogmatic ones, and states."""
    rng = np.random.default_rng(seed)
    evidence = rng.gamma(0.3, 20, (*shape, 2)) * (rng.random((*shape, 2)) < 0.8)
    mass = (evidence / (evidence.sum(axis=-1, keepdims=True) + 2)).astype(np.float32)
    return mass, rng.choice(4, size=shape, p=[0.4, 0.3, 0.2, 0.1]).astype(np.uint8)


def alphas(mass: NDArray, state: NDArray, strength: float) -> tuple[NDArray, NDArray]:
    """Parameters of the grid's densities and of the truth's, the plain way."""
    mass = mass.astype(np.float64)
    rest = np.maximum(1 - mass.sum(axis=-1, keepdims=True), 2e-5)
    truth = np.stack([state == FREE, state == OCCUPIED], axis=-1) * strength
    return 1 + 2 * mass / rest, 1.0 + truth


def dogmatic(state: NDArray[np.uint8]) -> NDArray[np.float32]:
    return np.stack([state == FREE, state == OCCUPIED], axis=-1).astype(np.float32)


# Divergences


@each(("evidence", "state", "metric", "value"), [
    ((0, 0), FREE, "kl_e1", 0.30685281944), ((1, 0), UNKNOWN, "kl_e1", 0.19314718056),
    ((1, 0), OCCUPIED, "kl_e1", 1.0), ((0, 0), OCCUPIED, "kl_e10", 7.6021047272),
    ((10, 0), FREE, "kl_e1", 0.886566274057), ((0.5, 0.5), UNKNOWN, "kl_e1", 0.0484172947105),
    ((0, 0), UNKNOWN, "kl_e10", 0.0), ((0, 0), FREE, "kl_e1_reverse", 0.19314718056),
    ((0, 1), FREE, "kl_e1_reverse", 1.0), ((1, 0), UNKNOWN, "kl_e1_reverse", 0.30685281944),
    ((0, 10), UNKNOWN, "kl_e10_reverse", 7.6021047272),
])  # fmt: skip
def test_divergence_has_the_value_of_sixty_digits(
    evidence: tuple[float, float], state: int, metric: str, value: float
) -> None:
    mass = np.array([[evidence]]) / (sum(evidence) + 2)
    found = score(accumulate(mass, np.array([[state]], np.uint8)))[metric]
    assert found == pytest.approx(value, rel=1e-7, abs=1e-8)


def test_a_dogmatic_cell_counts_as_evidence_of_1e5() -> None:
    alpha = np.array([1 + 1e5, 1.0])
    for state, truth, low, high in ((FREE, (11.0, 1.0), 8, 9), (OCCUPIED, (1.0, 11.0), 115, 130)):
        mass = np.array([[[1.0, 0.0]]], np.float32)
        found = score(accumulate(mass, np.array([[state]], np.uint8)))["kl_e10"]
        assert found == pytest.approx(float(dirichlet_kl(alpha, np.array(truth))), rel=1e-7)
        assert low < found < high


def test_evilog_divergence_is_that_of_keras() -> None:
    evidence, state = np.array([[0.6, 0.4], [0.4, 0.6]]), np.array([OCCUPIED, UNKNOWN], np.uint8)
    assert evilog_kl(evidence, state).mean() == pytest.approx(0.45814305, abs=1e-8)


def test_special_functions_of_the_table_are_the_special_functions() -> None:
    x = np.concatenate([[1.0, 2.0, 2.0 - 1e-16, 4.0, 2e5], 1 + np.logspace(-9, 5.3, 300)])
    table, bits = divergence._table(), x.view(np.int64)
    found = np.array([divergence._look_up(float(one), int(n), table) for one, n in zip(x, bits, strict=True)])
    np.testing.assert_allclose(found[:, 0], special.gammaln(x), rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(found[:, 1], special.digamma(x), rtol=0, atol=1e-11)


# Counts


def test_sums_are_those_of_every_cell() -> None:
    mass, state = random_grid(3, (15, 12))
    counts = accumulate(mass, state)
    evidence = alphas(mass, state, 1.0)[0] - 1
    predicted, rest = predict_state(mass), 1 - mass.sum(axis=-1, dtype=np.float64)
    by_probability = np.where(mass[..., 0] > mass[..., 1], FREE, np.where(mass[..., 1] > mass[..., 0], OCCUPIED, 0))
    for truth in (UNKNOWN, FREE, OCCUPIED):
        here = state == truth
        assert counts.cells[truth] == here.sum()
        np.testing.assert_allclose(counts.mass[truth], mass[here].sum(axis=0, dtype=np.float64))
        for k, (scale, strength) in enumerate([(1.0, 1.0), (1.0, 10.0), (0.1, 1.0)]):
            expected = dirichlet_kl(1 + scale * evidence, alphas(mass, state, strength)[1])[here].sum()
            assert counts.to_truth[k, truth] == pytest.approx(expected, rel=1e-9, abs=1e-7)
        for k, strength in enumerate([1.0, 10.0]):
            expected = dirichlet_kl(alphas(mass, state, strength)[1], 1 + evidence)[here].sum()
            assert counts.from_truth[k, truth] == pytest.approx(expected, rel=1e-9, abs=1e-7)
        assert counts.evilog_kl[truth] == pytest.approx(evilog_kl(evidence, state)[here].sum(), rel=1e-9)
        assert counts.confusion[truth].tolist() == np.bincount(predicted[here], minlength=3).tolist()
        found = counts.confusion_by_probability[truth].tolist()
        assert found == np.bincount(by_probability[here], minlength=3).tolist()
        assert counts.detections[truth].tolist() == (mass[here] > 0.5).sum(axis=0).tolist()
    known = (state == FREE) | (state == OCCUPIED)
    p, y = mass[known][:, 1] + rest[known] / 2, state[known] == OCCUPIED
    assert counts.squared_error[0] == pytest.approx(((p - y) ** 2).sum())
    both = mass[known].sum(axis=-1, dtype=np.float64)
    relative = np.where(both > 0, mass[known][:, 1] / np.where(both > 0, both, 1), 0.5)
    assert counts.squared_error[1] == pytest.approx(((relative - y) ** 2).sum())
    everywhere, certain = np.ones_like(y), predicted[known] != UNKNOWN
    for k, (kept, value) in enumerate([(everywhere, p), (certain, p), (everywhere, relative)]):
        place = np.minimum((value[kept] * 15).astype(int), 14)
        assert counts.reliability[k, :, 0].tolist() == np.bincount(place, minlength=15).tolist()
        np.testing.assert_allclose(counts.reliability[k, :, 1], np.bincount(place, value[kept], 15))
        np.testing.assert_allclose(counts.reliability[k, :, 2], np.bincount(place, y[kept], 15))


def test_relative_probability_does_not_depend_on_the_strength_of_evidence() -> None:
    """What is right with evidence 10 has P(occupied) = 1/12 at best: an error of calibration by convention."""
    _, state = random_grid(12)
    for strength in (1.0, 10.0):
        scores = score(accumulate(evidence_to_mass(strength * dogmatic(state)), state))
        assert scores["ece"] == pytest.approx(1 / (strength + 2), rel=1e-6)
        assert scores["ece_relative"] == scores["brier_relative"] == 0.0


def test_hand_drawn_cells_are_counted_by_hand() -> None:
    state = np.array([[FREE, FREE, FREE], [OCCUPIED, OCCUPIED, UNKNOWN], [UNKNOWN, IGNORE, IGNORE]], np.uint8)
    mass = np.array(
        [
            [[0.9, 0.0], [0.3, 0.1], [0.0, 0.8]],
            [[0.0, 0.9], [0.625, 0.125], [0.0, 0.0]],
            [[0.75, 0.0], [0.0, 1.0], [1.0, 0.0]],
        ],
        np.float32,
    )
    counts = accumulate(mass, state)
    assert counts.confusion.tolist() == [[1, 1, 0], [1, 1, 1], [0, 1, 1]]
    scores = score(counts)
    assert scores["iou_free"] == pytest.approx(1 / 5)
    assert scores["iou_occupied"] == pytest.approx(1 / 3)
    assert scores["iou_unknown"] == pytest.approx(1 / 3)
    assert scores["iou_free_known"] == pytest.approx(2 / 4)
    assert scores["iou_occupied_known"] == pytest.approx(1 / 3)
    assert scores["false_free"] == scores["missed_occupied"] == 0.5
    assert scores["false_occupied"] == pytest.approx(1 / 3)
    # unknown of unknown cells: 1.0, 0.25; of known ones: 0.1, 0.6, 0.2, 0.1, 0.25
    assert scores["auroc_unknown"] == pytest.approx((5 + 3.5) / 10)
    # P(occupied) of known cells: 0.05, 0.4, 0.9, 0.95, 0.25, of which 0.95 and 0.25 are occupied
    assert scores["ece"] == pytest.approx((0.05 + 0.4 + 0.9 + 0.05 + 0.75) / 5)
    assert scores["ece_called"] == pytest.approx((0.05 + 0.9 + 0.05 + 0.75) / 4)
    assert scores["brier"] == pytest.approx((0.05**2 + 0.4**2 + 0.9**2 + 0.05**2 + 0.75**2) / 5)


# Ranking


@settings(max_examples=50, deadline=None)
@given(values=st.lists(st.tuples(st.integers(0, 5), st.booleans()), min_size=1, max_size=40))
def test_auroc_is_the_share_of_pairs_in_order(values: list[tuple[int, bool]]) -> None:
    number, positive = np.array([v for v, _ in values]), np.array([p for _, p in values])
    pairs = [(a > b) + 0.5 * (a == b) for a in number[positive] for b in number[~positive]]
    histograms = (np.bincount(number[kind], minlength=6) for kind in (positive, ~positive))
    assert auroc(*histograms) == pytest.approx(np.mean(pairs) if pairs else np.nan, nan_ok=True)


# Edges of bins, thresholds and kinds with one cell


@each(
    ("distance", "place"),
    [(0, 0), (9.999, 0), (10, 1), (12.5, 1), (19.999, 1), (20, 2), (30, 3), (39.999, 3), (40, 4), (1e4, 4)],
)
def test_ranges_are_of_10_m_and_a_cell_on_an_edge_is_in_the_farther(distance: float, place: int) -> None:
    counts = accumulate(np.array([[[0.8, 0.1]]]), np.array([[OCCUPIED]], np.uint8), np.array([[float(distance)]]))
    table = by_range(counts)
    assert np.flatnonzero(table["cells"]).tolist() == [place]
    assert table["false_free"][place] == 1
    assert len(RANGES) == len(table["cells"]) + 1
    assert RANGES[place] <= distance < RANGES[place + 1]


@each("wrong", [0.25, 0.0])
def test_one_free_and_one_occupied_cell_make_a_curve(wrong: float) -> None:
    counts = accumulate(np.array([[[0.75, 0.0], [wrong, 0.5]]]), np.array([[FREE, OCCUPIED]], np.uint8))
    false_free, recall, threshold = free_space(counts)
    assert [recall[false_free == 0].max(), false_free[-1]] == [1, 1]
    assert threshold[(false_free == 0) & (recall == 1)].max() == pytest.approx(0.75, abs=1 / 4096)
    scores = score(counts)
    assert scores["free_recall_1"] == scores["free_recall_01"] == scores["ap_occupied"] == 1


@each(
    ("positive", "negative", "area", "precision", "false"),
    [
        ([0, 1], [1, 0], 1, 1, 0),
        ([1, 0], [0, 1], 0, 0.5, 1),
        ([0, 0, 1], [0, 0, 1], 0.5, 0.5, 1),
        ([0, 5, 0, 95], [4, 0, 4, 0], 39 / 40, 0.95 + 0.05 * 100 / 104, 0),  # 95 % are found at the highest level
        ([0, 6, 0, 94], [4, 0, 4, 0], 0.97, 0.94 + 0.06 * 100 / 104, 0.5),
        ([1, 1], [0, 0], np.nan, np.nan, np.nan),
        ([0, 0], [1, 1], np.nan, np.nan, np.nan),
    ],
)
def test_rankings_of_few_cells_are_those_by_hand(
    positive: list[int], negative: list[int], area: float, precision: float, false: float
) -> None:
    p, n = np.array(positive), np.array(negative)
    found = auroc(p, n), average_precision(p, n), false_positive_rate(p, n)
    assert found == pytest.approx((area, precision, false), nan_ok=True)


def test_cells_without_belief_in_free_make_a_curve() -> None:
    counts = accumulate(np.array([[[0.0, 0.5], [0.0, 0.5]]]), np.array([[FREE, OCCUPIED]], np.uint8))
    false_free, recall, _ = free_space(counts)
    assert [false_free[0], recall[0], false_free[-1], recall[-1]] == [0, 0, 1, 1]
    assert score(counts)["free_recall_1"] == 0


@each(
    ("states", "missing"),
    [((FREE,), "unknown"), ((OCCUPIED,), "unknown"), ((FREE, OCCUPIED), "unknown"), ((UNKNOWN,), "known")],
)
def test_reasons_name_the_kinds_of_cells_that_are_missing(states: tuple[int, ...], missing: str) -> None:
    counts = accumulate(np.full((1, 6, 2), 0.3), np.resize(np.array(states, np.uint8), (1, 6)))
    assert reasons(counts)["auroc_unknown"] == f"the truth has no {missing} cell"


@each(("name", "cells"), [("free_recall_1", 100), ("free_recall_01", 1000)])
def test_bounds_of_false_free_are_a_hundredth_and_a_thousandth(name: str, cells: int) -> None:
    """One occupied cell with Bel(free) = 0.9: with one cell fewer than the bound allows for, no cell may exceed it."""
    of_free = np.array([0.95] * 3 + [0.85] * 7)
    for occupied, recall in ((cells - 1, 0.3), (cells, 1.0)):
        free = np.concatenate([of_free, [0.9], np.zeros(occupied - 1)])
        state = np.where(np.arange(len(free)) < 10, FREE, OCCUPIED).astype(np.uint8)[None]
        mass = np.stack([free, 0 * free], axis=-1)[None]
        counts = accumulate(mass, state, np.full(state.shape, 15.0))
        assert score(counts)[name] == pytest.approx(recall)
        assert by_range(counts)[name][1] == pytest.approx(recall)


def test_sums_have_the_documented_shapes() -> None:
    shapes = {name: one.shape for name, one in ConfusionSums.zeros()._asdict().items()}
    by_truth = ("cells", "evilog_kl", "log_loss", "entropy", "dissonance", "squared_error")
    assert [shapes.pop(name) for name in by_truth] == [(3,)] * 6
    assert shapes == {
        **{"mass": (3, 2), "to_truth": (3, 3), "from_truth": (2, 3), "confusion": (3, 3), "detections": (3, 2)},
        **{"confusion_by_probability": (3, 3), "reliability": (3, 15, 3), "intervals": (15, 4), "obstacles": (2,)},
        **{"unknown_hist": (3, 4097), "p_occupied_hist": (3, 4097), "p_occupied_hist_tol1": (3, 4097)},
        **{"bel_free_hist": (2, 4097), "range_confusion": (5, 3, 3), "range_detections": (5, 3, 2)},
        "range_bel_free_hist": (5, 2, 1025),
        **{"high_confusion": (2, 3), "high_detections": (2, 2)},
    }
