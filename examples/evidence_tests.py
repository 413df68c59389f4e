"""Evidence algebra as unit tests, with gradients: ``pytest evidence_tests.py``."""

import numpy as np
import torch

from ogm import CellState, evidence
from ogm.evidence import Opinion

LIDAR, RADAR, MAP = Opinion(free=0.1, occupied=0.6), Opinion(free=0.05, occupied=0.4), Opinion(free=0.7, occupied=0.1)


def test_rules_take_and_return_opinions() -> None:
    both = evidence.dempster(LIDAR, RADAR)
    assert both.occupied > max(LIDAR.occupied, RADAR.occupied)
    assert np.allclose(evidence.dempster(LIDAR, RADAR, MAP), evidence.dempster(both, MAP))  # in any order
    np.testing.assert_allclose(evidence.dempster([0.1, 0.6], [0.05, 0.4]), both.mass)
    assert np.allclose(LIDAR + RADAR, evidence.cumulative(LIDAR, RADAR))


def test_the_map_contradicts_both_sensors() -> None:
    blame = evidence.degree_of_falsity(LIDAR, RADAR, MAP)
    assert blame.argmax() == 2
    trust = evidence.reconciling_reliability(LIDAR, RADAR, MAP, remaining_conflict=0.1)[2]
    both = evidence.dempster(LIDAR, RADAR)
    assert evidence.conflict(evidence.trust_discount(MAP, trust), both) <= 0.1 + 1e-12


def test_decisions_are_cautious() -> None:
    dear = {"cost_false_free": 20.0, "cost_abstention": 0.5}
    assert evidence.decide(MAP) == CellState.FREE
    assert evidence.decide(MAP, **dear) == CellState.UNKNOWN  # no decision: free could be wrong
    assert evidence.decide(Opinion(0.99, 0.0), **dear) == CellState.FREE


def test_kl_divergence_both_ways() -> None:
    there, back = evidence.kl_divergence(LIDAR, RADAR), evidence.kl_divergence(RADAR, LIDAR)
    assert min(there, back) > 0
    assert there != back


def test_gradients() -> None:
    masses = [torch.tensor(one.mass, requires_grad=True) for one in (LIDAR, RADAR, MAP)]
    for rule in (evidence.dempster, evidence.yager, evidence.cumulative, evidence.averaging, evidence.weighted):
        assert torch.autograd.gradcheck(rule, masses)
