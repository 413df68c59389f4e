"""The scores against their definitions in plain Python, scikit-learn, scipy, torch and the evidence algebra."""

import numpy as np
import pytest
from cases import each
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from plain import FREE, IGNORE, OCCUPIED, UNKNOWN, lattice_grid, plain_scores
from scipy import ndimage

from ogm import evidence
from ogm.metrics import METRICS, accumulate, score
from ogm.state import predict_state

COUNTED_ELSEWHERE = {
    "iou_free", "iou_occupied", "iou_unknown", "iou_free_known", "iou_occupied_known", "ece_called", "legacy_accuracy",
    *(name for name in METRICS if name.startswith("from")),
}  # fmt: skip


def check(mass: NDArray, state: NDArray) -> None:
    found, wanted = score(accumulate(mass, state)), plain_scores(mass, state)
    assert set(wanted) == set(METRICS) - COUNTED_ELSEWHERE
    for name, value in wanted.items():
        near = 1e-4 if name in ("aurc", "ause") else 1e-7
        assert found[name] == pytest.approx(value, rel=near, abs=near, nan_ok=True), name


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31), coarse=st.sampled_from([1, 64, 512]))
def test_scores_are_their_definitions(seed: int, coarse: int) -> None:
    check(*lattice_grid(seed, coarse=coarse))


@each("states", [(UNKNOWN,), (FREE,), (OCCUPIED,), (UNKNOWN, OCCUPIED), (FREE, OCCUPIED), (IGNORE,)])
def test_scores_are_their_definitions_where_states_are_missing(states: tuple[int, ...]) -> None:
    mass, _ = lattice_grid(1, coarse=64)
    check(mass, np.resize(np.array(states, np.uint8), (7, 7)))


@each(("free", "occupied"), [(0, 0), (1, 0), (0, 1), (0.5, 0.5), (0.25, 0.25)])
def test_scores_are_their_definitions_where_all_cells_are_alike(free: float, occupied: float) -> None:
    _, state = lattice_grid(2)
    check(np.full((7, 7, 2), [free, occupied], np.float32), state)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31), highest=st.sampled_from([8, 30, 200]))
def test_scores_without_low_obstacles_are_those_of_a_truth_that_ignores_them(seed: int, highest: int) -> None:
    mass, state = lattice_grid(seed)
    height = np.random.default_rng(seed).integers(5, highest + 1, state.shape).astype(np.uint8)
    found = score(accumulate(mass, state, None, height))
    for least in (10, 50):
        low = (state == OCCUPIED) & (height < least)
        wanted = score(accumulate(mass, np.where(low, np.uint8(IGNORE), state)))
        for name in ("iou_free", "iou_occupied", "false_free", "missed_occupied"):
            value = wanted[name] if ((state == OCCUPIED) & ~low).any() else np.nan
            assert found[f"from{least}_{name}"] == pytest.approx(value, nan_ok=True), (least, name)


# Independent libraries

SHAPE = (30, 25)


@pytest.fixture(params=["lattice", "ties", "any"])
def grid(request: pytest.FixtureRequest) -> tuple[NDArray, NDArray, float]:
    """Masses, states, and how far a histogram may be from the exact value."""
    mass, state = lattice_grid(5, SHAPE, coarse=256 if request.param == "ties" else 1)
    if request.param == "any":
        mass = np.random.default_rng(0).dirichlet([0.5, 0.4, 0.6], SHAPE)[..., :2].astype(np.float32)
    return mass, state, 2e-3 if request.param == "any" else 1e-9


def parts(mass: NDArray, state: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """P(occupied) and what is true on known cells, and the unknown of all cells as float64."""
    free, occupied = np.moveaxis(mass.astype(np.float64), -1, 0)
    known = (state == FREE) | (state == OCCUPIED)
    return (0.5 * (1 + occupied - free))[known], state[known] == OCCUPIED, 1 - free - occupied


def test_ranking_of_unknown_is_that_of_scikit_learn(grid: tuple[NDArray, NDArray, float]) -> None:
    from sklearn import metrics as sk

    mass, state, near = grid
    kept = state != IGNORE
    unknown, truth = parts(mass, state)[2][kept], state[kept] == UNKNOWN
    scores = score(accumulate(mass, state))
    false, found, _ = sk.roc_curve(truth, unknown, drop_intermediate=False)
    for name, wanted in {
        "auroc_unknown": sk.roc_auc_score(truth, unknown),
        "aupr_unknown": sk.average_precision_score(truth, unknown),
        "aupr_known": sk.average_precision_score(~truth, -unknown),
        "fpr95_unknown": false[found >= 0.95].min(),
    }.items():
        assert scores[name] == pytest.approx(wanted, abs=near), name


@pytest.mark.slow
def test_probability_scores_are_those_of_scikit_learn(grid: tuple[NDArray, NDArray, float]) -> None:
    from sklearn import metrics as sk

    mass, state, near = grid
    p, y, _ = parts(mass, state)
    scores = score(accumulate(mass, state))
    assert scores["brier"] == pytest.approx(sk.brier_score_loss(y, p), rel=1e-6)
    assert scores["nll"] == pytest.approx(sk.log_loss(y, np.clip(p, 1e-5, 1 - 1e-5)), abs=2e-5)
    assert scores["ap_occupied"] == pytest.approx(sk.average_precision_score(y, p), abs=near)


def test_confusion_and_overlap_are_those_of_scikit_learn(grid: tuple[NDArray, NDArray, float]) -> None:
    from sklearn import metrics as sk

    mass, state, _ = grid
    kept = state != IGNORE
    counts, truth, predicted = accumulate(mass, state), state[kept], predict_state(mass)[kept]
    assert counts.confusion.tolist() == sk.confusion_matrix(truth, predicted, labels=[0, 1, 2]).tolist()
    scores = score(counts)
    overlaps = sk.jaccard_score(truth, predicted, labels=[UNKNOWN, FREE, OCCUPIED], average=None)
    assert [scores[f"iou_{s}"] for s in ("unknown", "free", "occupied")] == pytest.approx(overlaps.tolist())
    assert scores["legacy_accuracy"] == pytest.approx(sk.accuracy_score(np.zeros_like(predicted), predicted))


def test_scores_of_evidence_are_those_of_the_evidence_algebra(grid: tuple[NDArray, NDArray, float]) -> None:
    from scipy import stats

    mass, state, _ = grid
    mass = mass.astype(np.float64)
    kept, scores = state != IGNORE, score(accumulate(mass, state))
    assert scores["entropy"] == pytest.approx(evidence.pignistic_entropy(mass[kept]).mean())
    p = evidence.mass_to_probability(mass[kept])
    assert scores["entropy"] == pytest.approx(stats.entropy(np.stack([p, 1 - p]), base=2).mean())
    assert scores["dissonance"] == pytest.approx(evidence.dissonance(mass[kept]).mean())
    known = (state == FREE) | (state == OCCUPIED)
    truth = np.stack([state == FREE, state == OCCUPIED], axis=-1)[known].astype(np.float64)
    assert scores["conflict"] == pytest.approx(evidence.conflict(mass[known], truth).mean())
    appeared, gone = evidence.conflict_direction(mass[known], truth).T
    assert scores["conflict_free"] == pytest.approx(appeared.sum() / (state == OCCUPIED).sum())
    assert scores["conflict_occupied"] == pytest.approx(gone.sum() / (state == FREE).sum())
    assert scores["mean_unknown"] == pytest.approx(evidence.vacuity(mass[kept]).mean(), abs=1e-12)


@pytest.mark.slow
def test_expected_brier_is_the_mean_over_beta_densities() -> None:
    import torch

    mass, state = lattice_grid(8, SHAPE)
    mass = (0.99 * mass).astype(np.float64)
    known = (state == FREE) | (state == OCCUPIED)
    e, y = (torch.from_numpy(evidence.mass_to_evidence(mass[known])), torch.from_numpy(state[known] == OCCUPIED))
    beta = torch.distributions.Beta(1 + e[:, 1], 1 + e[:, 0])
    wanted = ((beta.mean - y.double()) ** 2 + beta.variance).mean()
    found = score(accumulate(mass, state))["brier_expected"]
    assert found == pytest.approx(wanted.item())


@each("strength", [1.0, 10.0])
def test_divergences_are_those_of_torch(strength: float) -> None:
    import torch

    mass, state = lattice_grid(9, SHAPE)
    kept = state != IGNORE
    alpha = torch.from_numpy(1 + np.minimum(evidence.mass_to_evidence(mass[kept].astype(float), min_unknown=2e-5), 1e5))
    truth = np.stack([state == FREE, state == OCCUPIED], axis=-1)[kept] * strength + 1.0
    grid, true = (torch.distributions.Dirichlet(a) for a in (alpha, torch.from_numpy(truth)))
    scores = score(accumulate(mass, state))
    for name, pair in ((f"kl_e{strength:g}", (grid, true)), (f"kl_e{strength:g}_reverse", (true, grid))):
        wanted = torch.distributions.kl_divergence(*pair).mean().item()
        assert scores[name] == pytest.approx(wanted, rel=1e-6)


def test_obstacles_are_the_components_that_scipy_labels() -> None:
    rng = np.random.default_rng(10)
    mass, _ = lattice_grid(10, SHAPE)
    state = rng.choice(4, size=SHAPE, p=[0.4, 0.3, 0.2, 0.1]).astype(np.uint8)
    mass *= rng.random(SHAPE)[..., None] < 0.3
    p = np.where(state == IGNORE, 0, 0.5 * (1 + mass[..., 1] - mass[..., 0]))
    labels, count = ndimage.label(state == OCCUPIED, np.ones((3, 3)))
    best = ndimage.maximum(ndimage.maximum_filter(p, 3, mode="constant"), labels, np.arange(1, count + 1))
    counts = accumulate(mass, state)
    assert counts.obstacles.tolist() == [count, np.count_nonzero(best <= 0.5)]
    assert 0 < counts.obstacles[1] < count
