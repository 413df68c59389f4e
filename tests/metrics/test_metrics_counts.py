"""Laws of the counts and scores, and their references."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from plain import FREE, IGNORE, OCCUPIED, UNKNOWN

from ogm.evidence import dirichlet_kl, evidence_to_mass
from ogm.metrics import METRICS, accumulate, divergence, evilog_kl, score
from ogm.metrics.ranking import auroc
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


@pytest.mark.parametrize(
    ("evidence", "state", "metric", "value"),
    [
        ((0, 0), FREE, "kl_e1", 0.30685281944),
        ((1, 0), UNKNOWN, "kl_e1", 0.19314718056),
        ((1, 0), OCCUPIED, "kl_e1", 1.0),
        ((0, 0), OCCUPIED, "kl_e10", 7.6021047272),
        ((10, 0), FREE, "kl_e1", 0.886566274057),
        ((0.5, 0.5), UNKNOWN, "kl_e1", 0.0484172947105),
        ((0, 0), UNKNOWN, "kl_e10", 0.0),
        ((0, 0), FREE, "kl_e1_reverse", 0.19314718056),
        ((0, 1), FREE, "kl_e1_reverse", 1.0),
        ((1, 0), UNKNOWN, "kl_e1_reverse", 0.30685281944),
        ((0, 10), UNKNOWN, "kl_e10_reverse", 7.6021047272),
    ],
)
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


def test_evilog_divergence_ignores_false_detections() -> None:
    _, state = random_grid(2)
    everything_is_both = evilog_kl(np.ones((7, 7, 2)), state)
    nothing = evilog_kl(np.zeros((7, 7, 2)), state)
    assert np.nanmax(everything_is_both) < 1e-5
    np.testing.assert_allclose(nothing[(state == FREE) | (state == OCCUPIED)], 16.118, atol=1e-3)


@pytest.mark.parametrize("compiled", [True, False])
def test_special_functions_of_the_table_are_the_special_functions(compiled: bool) -> None:
    from scipy.special import digamma, gammaln

    look_up = divergence._look_up if compiled else getattr(divergence._look_up, "py_func", divergence._look_up)
    x = np.concatenate([[1.0, 2.0, 2.0 - 1e-16, 4.0, 2e5], 1 + np.logspace(-9, 5.3, 300)])
    found = np.array([look_up(float(one), int(one.view(np.int64)), divergence._table()) for one in x])
    np.testing.assert_allclose(found[:, 0], gammaln(x), rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(found[:, 1], digamma(x), rtol=0, atol=1e-11)


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


def test_a_perfect_map_is_perfect() -> None:
    _, state = random_grid(4)
    scores = score(accumulate(dogmatic(state), state))
    ones = ("iou_free", "iou_occupied", "iou_unknown", "iou_free_known", "iou_occupied_known", "auroc_unknown")
    assert [scores[name] for name in ones] == [1.0] * len(ones)
    for name in (
        "ece",
        "ece_called",
        "ece_relative",
        "brier",
        "brier_relative",
        "false_free",
        "missed_occupied",
        "false_occupied",
    ):
        assert scores[name] == 0.0
    assert scores["legacy_kl"] < 1e-5


def test_relative_probability_does_not_depend_on_the_strength_of_evidence() -> None:
    """What is right with evidence 10 has P(occupied) = 1/12 at best: an error of calibration by convention."""
    _, state = random_grid(12)
    for strength in (1.0, 10.0):
        scores = score(accumulate(evidence_to_mass(strength * dogmatic(state)), state))
        assert scores["ece"] == pytest.approx(1 / (strength + 2), rel=1e-6)
        assert scores["ece_relative"] == scores["brier_relative"] == 0.0


@pytest.mark.parametrize(("metric", "strength"), [("kl_e1", 1.0), ("kl_e10", 10.0)])
def test_the_truth_with_its_own_evidence_has_no_divergence(metric: str, strength: float) -> None:
    _, state = random_grid(5)
    scores = score(accumulate(evidence_to_mass(strength * dogmatic(state)), state))
    assert scores[metric] == pytest.approx(0.0, abs=1e-6)
    assert scores[f"{metric}_reverse"] == pytest.approx(0.0, abs=1e-6)
    if metric == "kl_e10":
        assert scores["kl_e1_scaled"] == pytest.approx(0.0, abs=1e-6)


def test_scores_of_a_vacuous_grid() -> None:
    _, state = random_grid(6)
    kept = state[state != IGNORE]
    known = np.mean(kept != UNKNOWN)
    scores = score(accumulate(np.zeros((7, 7, 2), np.float32), state))
    assert scores["kl_e10"] == pytest.approx(known * (10 - np.log(11)))
    assert scores["kl_e1"] == pytest.approx(known * (1 - np.log(2)))
    assert scores["iou_unknown"] == pytest.approx(1 - known)
    assert scores["iou_free"] == scores["iou_occupied"] == scores["iou_occupied_known"] == 0.0
    assert scores["auroc_unknown"] == 0.5
    assert scores["brier"] == 0.25
    assert scores["mean_unknown"] == 1.0
    assert scores["missed_occupied"] == 1.0
    assert np.isnan(scores["ece_called"])


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


def test_the_predicted_state_has_most_mass_and_ties_are_cautious() -> None:
    mass = np.array([[0.5, 0.1], [0.1, 0.5], [0.5, 0.5], [0.5, 0.0], [0.25, 0.375], [0.2, 0.2]])
    assert predict_state(mass).tolist() == [FREE, OCCUPIED, OCCUPIED, UNKNOWN, UNKNOWN, UNKNOWN]


def test_evidence_of_one_predicts_every_cell_unknown() -> None:
    """The EviLOG baseline has no mass above 1/3: by most mass, all its cells are unknown."""
    _, state = random_grid(7)
    scores = score(accumulate(evidence_to_mass(dogmatic(state)), state))
    assert scores["iou_free"] == scores["iou_occupied"] == 0.0
    assert scores["iou_free_known"] == scores["iou_occupied_known"] == scores["auroc_unknown"] == 1.0


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_scores_depend_neither_on_place_nor_on_ignored_cells(seed: int) -> None:
    mass, state = random_grid(seed)
    scores = score(accumulate(mass, state))
    other = mass.copy()
    other[state == IGNORE] = [0.3, 0.6]
    for same in (score(accumulate(other, state)), score(accumulate(mass[::-1, ::-1], state[::-1, ::-1]))):
        assert same == pytest.approx(scores, nan_ok=True)


def test_exchanging_free_and_occupied_exchanges_their_scores() -> None:
    mass, state = random_grid(8)
    swap = np.array([UNKNOWN, OCCUPIED, FREE, IGNORE], np.uint8)
    one, other = score(accumulate(mass, state)), score(accumulate(mass[..., ::-1], swap[state]))
    for a, b in (("iou_free", "iou_occupied"), ("mean_free", "mean_occupied"), ("kl_e10", "kl_e10"), ("ece",) * 2):
        assert one[a] == pytest.approx(other[b])
        assert one[b] == pytest.approx(other[a])


@pytest.mark.parametrize(
    ("states", "without"),
    [
        ((UNKNOWN, FREE), {"iou_occupied_known", "false_free", "missed_occupied"}),
        ((FREE, OCCUPIED), {"auroc_unknown"}),
        ((UNKNOWN,), {"iou_free_known", "ece", "ece_called", "ece_relative", "brier", "false_free"}),
        ((IGNORE,), set(METRICS)),
    ],
)
def test_scores_without_a_cell_are_nan_and_not_zero(states: tuple[int, ...], without: set[str]) -> None:
    state = np.resize(np.array(states, np.uint8), (7, 7))
    mass = np.zeros((7, 7, 2), np.float32)
    mass[..., 0] = 0.7
    scores = score(accumulate(mass, state))
    assert tuple(scores) == tuple(METRICS)
    assert without <= {name for name, value in scores.items() if np.isnan(value)}


def test_pooled_counts_are_those_of_all_cells_together() -> None:
    (a, a_state), (b, b_state) = random_grid(9), random_grid(10)
    heights = [np.random.default_rng(seed).integers(5, 201, a_state.shape).astype(np.uint8) for seed in (11, 12)]
    both = score(accumulate(np.concatenate([a, b]), np.concatenate([a_state, b_state]), None, np.concatenate(heights)))
    parts = [accumulate(a, a_state, None, heights[0]), accumulate(b, b_state, None, heights[1])]
    assert score(parts[0].plus(parts[1])) == pytest.approx(both)


@pytest.mark.parametrize(
    ("mass", "state", "description"),
    [
        (np.zeros((3, 3, 2)), np.zeros((3, 4), np.uint8), "crop the truth"),
        (np.zeros((3, 3, 3)), np.zeros((3, 3), np.uint8), "crop the truth"),
        (np.zeros((3, 3, 2)), np.zeros((3, 3)), "state must be uint8"),
        (np.zeros((3, 3, 2)), np.full((3, 3), 4, np.uint8), "up to 4"),
        (np.full((3, 3, 2), np.nan), np.zeros((3, 3), np.uint8), "nan"),
    ],
)
def test_invalid_masses_and_states_are_refused(mass: NDArray, state: NDArray, description: str) -> None:
    with pytest.raises(ValueError, match=description):
        accumulate(mass, state)


# Ranking


@settings(max_examples=50, deadline=None)
@given(values=st.lists(st.tuples(st.integers(0, 5), st.booleans()), min_size=1, max_size=40))
def test_auroc_is_the_share_of_pairs_in_order(values: list[tuple[int, bool]]) -> None:
    number, positive = np.array([v for v, _ in values]), np.array([p for _, p in values])
    pairs = [(a > b) + 0.5 * (a == b) for a in number[positive] for b in number[~positive]]
    histograms = (np.bincount(number[kind], minlength=6) for kind in (positive, ~positive))
    assert auroc(*histograms) == pytest.approx(np.mean(pairs) if pairs else np.nan, nan_ok=True)


def test_auroc_needs_both_kinds() -> None:
    assert np.isnan(auroc(np.array([1, 2]), np.array([0, 0])))
