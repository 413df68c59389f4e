"""The values that the EviLOG code reports, and why they are no basis of a ranking."""

import numpy as np
import pytest
from cases import each
from numpy.typing import NDArray
from plain import FREE, IGNORE, OCCUPIED, UNKNOWN, lattice_grid

from ogm.evidence import evidence_to_mass
from ogm.metrics import accumulate, evilog_kl, evilog_published, evilog_unmixed, score


class KerasMean:
    """The metric object of the EviLOG code: a running mean over all updates."""

    def __init__(self) -> None:
        self.total, self.count = 0.0, 0

    def __call__(self, label: NDArray, evidence: NDArray) -> float:
        label, evidence = np.clip(label, 1e-7, 1), np.clip(evidence, 1e-7, 1)
        values = (label * np.log(label / evidence)).sum(axis=-1)
        self.total, self.count = self.total + values.sum(), self.count + values.size
        return float(self.total / self.count)


def frames(count: int = 6) -> list[tuple[NDArray, NDArray, NDArray]]:
    """Evidence of two methods, and the truth's states."""
    rng = np.random.default_rng(0)
    return [
        (rng.gamma(0.5, 4, (7, 7, 2)), rng.gamma(0.2, 0.5, (7, 7, 2)), rng.choice(3, size=(7, 7)).astype(np.uint8))
        for _ in range(count)
    ]


def label(state: NDArray[np.uint8]) -> NDArray[np.float64]:
    return np.stack([state == FREE, state == OCCUPIED], axis=-1).astype(np.float64)


def own_values() -> tuple[list[float], list[float]]:
    pairs = [(evilog_kl(a, s).mean(), evilog_kl(b, s).mean()) for a, b, s in frames()]
    return [a for a, _ in pairs], [b for _, b in pairs]


def test_published_values_are_those_of_a_metric_that_is_not_reset() -> None:
    first, second = own_values()
    published = evilog_published(first, second)
    never = KerasMean()
    for k, (a, b, state) in enumerate(frames()):
        each = KerasMean()
        assert each(label(state), a) == pytest.approx(published.first[k])
        assert each(label(state), b) == pytest.approx(published.second[k])
        assert never(label(state), a) == pytest.approx(published.running_first[k])
        assert never(label(state), b) == pytest.approx(published.running_second[k])


def test_published_values_can_be_separated_again() -> None:
    first, second = own_values()
    published = evilog_published(first, second)
    np.testing.assert_allclose(evilog_unmixed(published.first, published.second), second)


def test_the_published_loser_is_halfway_between_both() -> None:
    """A rival that is k times as bad is published as (1 + k) / 2 times; it never wins by being mixed."""
    published = evilog_published([1.0, 1.0, 1.0], [3.0, 1.0, 0.5])
    assert published.second.tolist() == [2.0, 1.0, 0.75]
    assert published.running_second.tolist() == pytest.approx([2.0, 1.5, 1.25])
    assert ((published.second > published.first) == (np.array([3.0, 1.0, 0.5]) > 1.0)).all()


@each("second", [[1.0], [[1.0, 2.0]], [1.0, float("nan")]])
def test_values_that_do_not_pair_are_refused(second: list) -> None:
    with pytest.raises(ValueError, match="one finite value per frame"):
        evilog_published([1.0, 2.0], second)
    with pytest.raises(ValueError, match="one finite value per frame"):
        evilog_unmixed([1.0, 2.0], second)


def test_the_evilog_divergence_ignores_false_detections() -> None:
    """Evidence for both states everywhere has its best value, and a bad one of every other score."""
    _, state = lattice_grid(1, (12, 12))
    loud = score(accumulate(evidence_to_mass(np.full((12, 12, 2), 100.0)), state))
    honest = score(accumulate(evidence_to_mass(0.9 * label(state)), state))
    assert loud["legacy_kl"] == pytest.approx(0, abs=1e-5)
    assert loud["legacy_kl"] < honest["legacy_kl"]
    for name in ("kl_e10", "kl_e1", "brier", "nll", "aurc", "conflict"):
        assert loud[name] > honest[name]
    for name in ("iou_unknown", "auroc_unknown", "ap_occupied"):
        assert loud[name] < honest[name]


def test_the_evilog_accuracy_is_the_share_of_cells_predicted_unknown() -> None:
    mass, state = lattice_grid(3, (12, 12))
    for grid, share in (
        (np.zeros_like(mass), 1.0),
        (evidence_to_mass(100 * label(state)), (state == UNKNOWN).sum() / (state != IGNORE).sum()),
    ):
        assert score(accumulate(grid, state))["legacy_accuracy"] == pytest.approx(share)
    assert np.isnan(score(accumulate(mass, np.full_like(state, IGNORE)))["legacy_accuracy"])
