"""Curves: their points, and their agreement with the scores."""

import numpy as np
import pytest
from cases import each, refused
from plain import FREE, IGNORE, OCCUPIED, UNKNOWN, lattice_grid

from ogm.evidence import evidence_to_mass
from ogm.grid import GridSpec
from ogm.metrics import (
    METRICS,
    ConfusionSums,
    accumulate,
    distances,
    free_space,
    intervals,
    precision_recall,
    reliability,
    risk_coverage,
    score,
)
from ogm.metrics.counts import RANGES
from ogm.metrics.scores import by_range

SHAPE = (40, 30)
CURVES = (
    reliability,
    lambda counts: reliability(counts, "predicted_known"),
    lambda counts: reliability(counts, "relative"),
    intervals,
    risk_coverage,
    free_space,
    precision_recall,
    lambda counts: precision_recall(counts, 1),
)


@pytest.fixture(params=[0, 1, 2])
def counts(request: pytest.FixtureRequest) -> ConfusionSums:
    return accumulate(*lattice_grid(request.param, SHAPE, coarse=[1, 32, 512][request.param]))


def test_curves_are_short_columns_of_one_length(counts: ConfusionSums) -> None:
    for curve in CURVES:
        columns = curve(counts)
        assert {(c.shape, c.dtype) for c in columns} == {(columns[0].shape, np.dtype(np.float64))}
        assert 1 < len(columns[0]) <= 200
        assert all(np.isfinite(c).all() for c in columns)


def test_curves_without_cells_are_empty() -> None:
    mass, state = lattice_grid(3)
    for nothing in (accumulate(mass, np.full_like(state, IGNORE)), accumulate(mass, np.full_like(state, UNKNOWN))):
        for curve in CURVES:
            assert {len(column) for column in curve(nothing)} == {0}


def test_names_of_curves_that_do_not_exist_are_refused(counts: ConfusionSums) -> None:
    with pytest.raises(ValueError, match="which must be one of all, predicted_known, relative, got 'known'"):
        reliability(counts, "known")  # type: ignore[arg-type]
    refused("tolerance must be 0 or 1 cells, got 2", precision_recall, counts, 2)


def test_reliability_holds_the_calibration_errors(counts: ConfusionSums) -> None:
    scores = score(counts)
    for which, name in (("all", "ece"), ("predicted_known", "ece_called"), ("relative", "ece_relative")):
        predicted, observed, cells = reliability(counts, which)  # type: ignore[arg-type]
        assert np.abs(predicted - observed) @ cells / cells.sum() == pytest.approx(scores[name])


def test_intervals_hold_the_violation(counts: ConfusionSums) -> None:
    belief, plausibility, observed, cells = intervals(counts)
    assert (belief <= plausibility).all()
    outside = np.where(
        observed < belief, belief - observed, np.where(observed > plausibility, observed - plausibility, 0)
    )
    assert outside @ cells / cells.sum() == pytest.approx(score(counts)["interval_violation"])


def test_beliefs_that_are_drawn_from_hold_their_intervals() -> None:
    """Cells that are occupied with a chance between Bel and Pl violate nothing but by chance; shifted ones do."""
    rng = np.random.default_rng(0)
    mass = rng.dirichlet([1, 1, 1], (300, 300))[..., :2]
    chance = mass[..., 1] + rng.random((300, 300)) * (1 - mass.sum(axis=-1))
    state = np.where(rng.random((300, 300)) < chance, OCCUPIED, FREE).astype(np.uint8)
    assert score(accumulate(mass, state))["interval_violation"] < 1e-3
    assert score(accumulate(mass[..., ::-1], state))["interval_violation"] > 0.1


def test_risk_ends_at_the_share_of_wrong_cells_and_its_area_is_the_score(counts: ConfusionSums) -> None:
    coverage, risk, oracle = risk_coverage(counts)
    wrong = counts.unknown_hist[2].sum() / counts.cells[1:].sum()
    assert (coverage[-1], risk[-1], oracle[-1]) == pytest.approx((1, wrong, wrong))
    assert (oracle <= risk + 1e-12).all()
    assert (np.diff(oracle) >= -1e-12).all()
    scores = score(counts)
    assert scores["aurc"] == pytest.approx(risk.mean(), abs=0.01)
    assert scores["ause"] == pytest.approx((risk - oracle).mean(), abs=0.01)


def test_areas_of_the_best_and_the_worst_order_are_the_closed_forms() -> None:
    rng = np.random.default_rng(1)
    state = rng.choice([FREE, OCCUPIED], SHAPE).astype(np.uint8)
    truth = np.stack([state == FREE, state == OCCUPIED], axis=-1)
    wrong = rng.random(SHAPE) < 0.2
    detected = np.where(wrong[..., None], ~truth, truth)
    r = wrong.mean()
    best, worst = r + (1 - r) * np.log(1 - r), r - r * np.log(r)
    for weak, area in ((wrong, best), (~wrong, worst)):
        scores = score(accumulate(detected * np.where(weak, 0.3, 0.9)[..., None], state))
        assert scores["aurc"] == pytest.approx(area)
        assert scores["ause"] == pytest.approx(area - best, abs=1e-12)


@each("seed", range(3))
def test_points_of_the_curves_are_those_of_their_thresholds(seed: int) -> None:
    mass, state = lattice_grid(seed, SHAPE, coarse=16)
    counts = accumulate(mass, state)
    free = mass[..., 0].astype(float)
    p = 0.5 * (1 + mass[..., 1].astype(float) - free)
    for false_free, recall, threshold in zip(*free_space(counts), strict=True):
        assert false_free == pytest.approx((free[state == OCCUPIED] >= threshold).mean())
        assert recall == pytest.approx((free[state == FREE] >= threshold).mean())
    for precision, recall, threshold in zip(*precision_recall(counts), strict=True):
        predicted = state[((state == FREE) | (state == OCCUPIED)) & (p >= threshold)]
        assert recall == pytest.approx((p[state == OCCUPIED] >= threshold).mean())
        assert precision == pytest.approx((predicted == OCCUPIED).mean() if len(predicted) else 1.0)
    false_free, recall, threshold = free_space(counts)
    assert (np.diff(false_free) >= 0).all()
    assert (np.diff(recall) >= 0).all()
    assert (np.diff(threshold) <= 0).all()
    assert (false_free[-1], recall[-1]) == (1, 1)


@each(
    ("ahead", "there", "within_one", "exact"),
    [
        (0, OCCUPIED, (1, 1), (1, 1)),
        (1, FREE, (1, 1), (0, 0)),
        (1, UNKNOWN, (1, 1), (1, 0)),  # for precision nothing is detected, but the obstacle is found
        (1, IGNORE, (1, 0), (1, 0)),
        (2, FREE, (0, 0), (0, 0)),
    ],
)
def test_a_detection_may_be_one_cell_off(
    ahead: int, there: int, within_one: tuple[int, int], exact: tuple[int, int]
) -> None:
    """One occupied cell, and one certain detection `ahead` cells farther, where truth is `there`; the rest is free."""
    state = np.full((7, 7), FREE, np.uint8)
    state[3, 3] = OCCUPIED
    state[3 + ahead, 3] = there
    mass = np.zeros((7, 7, 2), np.float32)
    mass[..., 0] = 0.5
    mass[3 + ahead, 3] = [0, 0.9]
    for tolerance, wanted in ((0, exact), (1, within_one)):
        precision, recall, threshold = precision_recall(accumulate(mass, state), tolerance)
        sure = np.flatnonzero(threshold > 0.3)[-1]  # all points beyond lie where nothing changes
        assert (precision[sure], recall[sure]) == wanted


def test_scores_by_range_are_those_of_the_cells_in_the_range() -> None:
    spec = GridSpec.centered(length=81.92, width=56.32, resolution=1.28)
    mass, state = lattice_grid(5, spec.shape, coarse=4)
    away = distances(spec)
    found = by_range(accumulate(mass, state, away))
    for k, (near, far) in enumerate(zip(RANGES[:-1], RANGES[1:], strict=True)):
        inside = (away >= near) & (away < far)
        alone = accumulate(mass, np.where(inside, state, IGNORE).astype(np.uint8))
        assert found["cells"][k] == alone.cells.sum()
        assert [found["free_cells"][k], found["occupied_cells"][k]] == alone.cells[1:].tolist()
        wanted = score(alone)
        for name in found.keys() & METRICS.keys():
            assert found[name][k] == pytest.approx(wanted[name], nan_ok=True), name
    assert found["cells"].sum() == (state != IGNORE).sum()
    assert len(found.keys() & METRICS.keys()) == 8


def test_ranges_without_cells_or_distances_are_nan() -> None:
    mass, state = lattice_grid(6)
    for counts in (accumulate(mass, state), accumulate(mass, state, np.full((7, 7), 99.0, np.float32))):
        found = by_range(counts)
        assert all(len(column) == len(RANGES) - 1 for column in found.values())
        assert np.isnan(found["false_free"][:-1]).all()
        assert found["cells"][:-1].tolist() == [0, 0, 0, 0]


def test_distances_are_those_of_the_middles_of_the_cells() -> None:
    spec = GridSpec.centered(length=6, width=4, resolution=2, center=(10, 0))
    np.testing.assert_allclose(distances(spec), np.hypot([[8], [10], [12]], [[-1, 1]]).astype(np.float32), rtol=1e-6)
    assert distances(spec).dtype == np.float32


def test_free_recall_keeps_its_bound() -> None:
    """Of a thousand occupied cells with rising Bel(free), one may be taken for free at 0.1 %, ten at 1 %."""
    state = np.full((2, 1000), FREE, np.uint8)
    state[0] = OCCUPIED
    mass = np.zeros((2, 1000, 2))
    mass[..., 0] = (np.arange(1000) + 0.5) / 1000
    scores = score(accumulate(mass, state))
    assert (scores["free_recall_01"], scores["free_recall_1"]) == pytest.approx((0.001, 0.01))
    mass[0] *= 0.5
    scores = score(accumulate(mass, state))
    assert (scores["free_recall_01"], scores["free_recall_1"]) == pytest.approx((0.5, 0.505), abs=0.002)
    mass[..., 0] = 1.0
    assert score(accumulate(mass, state))["free_recall_1"] == 0.0


def test_histograms_come_near_the_exact_equal_mass_error() -> None:
    rng = np.random.default_rng(2)
    mass = evidence_to_mass(rng.gamma(0.5, 6, (200, 150, 2)).astype(np.float32))
    state = rng.choice([FREE, OCCUPIED], (200, 150), p=[0.8, 0.2]).astype(np.uint8)
    p = (0.5 * (1 + mass[..., 1] - mass[..., 0])).ravel()
    order = np.argsort(p)
    gaps = (p - (state.ravel() == OCCUPIED))[order].reshape(15, -1).mean(axis=1)
    assert score(accumulate(mass, state))["ace"] == pytest.approx(np.abs(gaps).mean(), abs=1e-4)
