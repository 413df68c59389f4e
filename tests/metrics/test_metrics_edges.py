"""The edges of bins, thresholds and kinds with one cell."""

import numpy as np
import pytest
from plain import FREE, OCCUPIED, UNKNOWN

from ogm.metrics import RANGES, ConfusionSums, accumulate, by_range, free_space, reasons, score
from ogm.metrics.ranking import auroc, average_precision, false_positive_rate


@pytest.mark.parametrize(
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


@pytest.mark.parametrize("wrong", [0.25, 0.0])
def test_one_free_and_one_occupied_cell_make_a_curve(wrong: float) -> None:
    counts = accumulate(np.array([[[0.75, 0.0], [wrong, 0.5]]]), np.array([[FREE, OCCUPIED]], np.uint8))
    false_free, recall, threshold = free_space(counts)
    assert [recall[false_free == 0].max(), false_free[-1]] == [1, 1]
    assert threshold[(false_free == 0) & (recall == 1)].max() == pytest.approx(0.75, abs=1 / 4096)
    scores = score(counts)
    assert scores["free_recall_1"] == scores["free_recall_01"] == scores["ap_occupied"] == 1


@pytest.mark.parametrize(
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


@pytest.mark.parametrize(
    ("states", "missing"),
    [((FREE,), "unknown"), ((OCCUPIED,), "unknown"), ((FREE, OCCUPIED), "unknown"), ((UNKNOWN,), "known")],
)
def test_reasons_name_the_kinds_of_cells_that_are_missing(states: tuple[int, ...], missing: str) -> None:
    counts = accumulate(np.full((1, 6, 2), 0.3), np.resize(np.array(states, np.uint8), (1, 6)))
    assert reasons(counts)["auroc_unknown"] == f"the truth has no {missing} cell"


@pytest.mark.parametrize(("name", "cells"), [("free_recall_1", 100), ("free_recall_01", 1000)])
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
