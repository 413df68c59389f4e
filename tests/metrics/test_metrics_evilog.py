"""The metrics of the EviLOG code, and why they are no basis of a ranking."""

import numpy as np
import pytest
from numpy.typing import NDArray
from plain import FREE, IGNORE, OCCUPIED, UNKNOWN, lattice_grid

from ogm.evidence import evidence_to_mass
from ogm.metrics import accumulate, score


def label(state: NDArray[np.uint8]) -> NDArray[np.float64]:
    return np.stack([state == FREE, state == OCCUPIED], axis=-1).astype(np.float64)


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
