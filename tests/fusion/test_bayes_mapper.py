"""The classical filter: what it shares with Dempster's rule, and what it cannot represent."""

import math

import numpy as np
import pytest
from cases import each
from random_grids import noise, uniform

from ogm import evidence as rules
from ogm.evidence import mass_to_log_odds, mass_to_probability, plausibility_transform
from ogm.fusion import BinaryBayesMapper, EvidentialMapper
from ogm.grid import EvidentialGrid, GridSpec
from ogm.pose import pose

SPEC = GridSpec.centered(length=6.4, width=4.8, resolution=0.2)
WIDE = (1e-6, 1 - 1e-6)


def test_one_scan_gives_its_own_probability():
    mapper = BinaryBayesMapper(SPEC, limits=WIDE)
    mapper.update(noise(SPEC, 0), np.eye(4))
    np.testing.assert_allclose(mapper.probability, noise(SPEC, 0).probability, atol=1e-5)
    np.testing.assert_allclose(mapper.grid.probability, mapper.probability, atol=1e-6)


def test_matched_by_plausibility_it_is_dempsters_rule_without_ignorance():
    """Cobb and Shenoy: Dempster's rule adds the log-odds of the plausibility transform."""
    bayes = BinaryBayesMapper(SPEC, match="plausibility", limits=WIDE)
    dempster = EvidentialMapper(SPEC, rules.dempster, math.inf, min_unknown=0)
    for k in range(4):
        for mapper in (bayes, dempster):
            mapper.update(noise(SPEC, k), pose(0.3 * k, yaw=0.1 * k))
    np.testing.assert_allclose(bayes.probability, plausibility_transform(dempster.grid.mass), atol=1e-3)


def test_log_odds_add_and_stop_at_the_limits():
    mapper = BinaryBayesMapper(SPEC, limits=(0.2, 0.9))
    for _ in range(3):
        mapper.update(uniform(SPEC, 0.0, 0.5), np.eye(4))  # probability 3/4, log-odds log 3
    assert mapper.probability[3, 4] == pytest.approx(0.9, abs=1e-6)
    other = BinaryBayesMapper(SPEC, limits=WIDE)
    for _ in range(3):
        other.update(uniform(SPEC, 0.0, 0.5), np.eye(4))
    assert other.probability[3, 4] == pytest.approx(27 / 28, abs=1e-6)


@each("match", ["pignistic", "plausibility"])
def test_kernel_equals_its_slow_reference(match):
    mapper = BinaryBayesMapper(SPEC, half_life=1.0, match=match, limits=(0.05, 0.97))
    low, high = (math.log(p / (1 - p)) for p in (0.05, 0.97))
    expected = np.zeros(SPEC.shape)
    for k in range(5):
        mapper.update(noise(SPEC, k), np.eye(4), stamp=0.3 * k)
        mass = noise(SPEC, k).mass.astype(np.float64)
        if match == "plausibility":
            log_odds = mass_to_log_odds(mass)
        else:
            p = mass_to_probability(mass)
            log_odds = np.log(p / (1 - p))
        log_odds = np.clip(log_odds, -max(-low, high), max(-low, high))
        expected = np.clip(expected * (0.5**0.3 if k else 1) + log_odds, low, high)
    np.testing.assert_allclose(mapper.probability, 1 / (1 + np.exp(-expected)), atol=1e-5)


@each("rate", [5, 10, 20])
def test_forgetting_does_not_depend_on_the_rate(rate):
    mapper = BinaryBayesMapper(SPEC, half_life=2.0, limits=WIDE)
    mapper.update(uniform(SPEC, 0.0, 0.8), np.eye(4), stamp=0)
    for k in range(1, 2 * rate + 1):
        mapper.update(EvidentialGrid.vacuous(SPEC), np.eye(4), stamp=k / rate)
    assert mapper.probability[0, 0] == pytest.approx(1 / (1 + math.exp(-math.log(9) / 2)), abs=1e-5)


def test_with_forget_observed_only_observed_cells_are_forgotten():
    mapper = BinaryBayesMapper(SPEC, half_life=1.0, forget="observed", limits=WIDE)
    mapper.update(uniform(SPEC, 0.0, 0.5), np.eye(4), stamp=0)
    half = np.zeros((*SPEC.shape, 2), np.float32)
    half[:16] = 0.0, 0.5
    mapper.update(EvidentialGrid(SPEC, half), np.eye(4), stamp=1)
    np.testing.assert_allclose(mapper.probability[16:], 0.75, atol=1e-5)
    np.testing.assert_allclose(mapper.probability[:16], 1 / (1 + 3**-1.5), atol=1e-5)


def test_it_cannot_separate_contradicted_from_unobserved_cells_and_the_evidential_map_can():
    never = uniform(SPEC, 0.0, 0.0)
    torn = [uniform(SPEC, 0.6, 0.0), uniform(SPEC, 0.0, 0.6)]
    bayes, evidential = BinaryBayesMapper(SPEC), EvidentialMapper(SPEC, rules.dempster, math.inf)
    unseen = EvidentialMapper(SPEC, half_life=math.inf)
    unseen.update(never, np.eye(4))
    for grid in torn:
        bayes.update(grid, np.eye(4))
        evidential.update(grid, np.eye(4))
    np.testing.assert_allclose(bayes.probability, 0.5, atol=1e-6)
    np.testing.assert_allclose(bayes.grid.unknown, 1.0, atol=1e-6)  # as if unobserved
    np.testing.assert_allclose(evidential.grid.probability, 0.5, atol=1e-6)
    assert evidential.grid.unknown.max() < 0.3
    assert evidential.conflict["free_to_occupied"].min() > 0.3
    assert unseen.grid.unknown.min() == 1.0
    assert not any(layer.any() for layer in unseen.conflict.layers.values())


def test_it_scrolls_views_and_resets_as_the_evidential_map_does():
    mapper = BinaryBayesMapper(SPEC, half_life=2.0)
    mapper.update(noise(SPEC, 0), pose(10.0, -3.0), stamp=5.0)
    assert mapper.spec.contains(10.0, -3.0)
    assert mapper.view(SPEC).spec == SPEC
    late = pose(10.02, -3.0)
    mapper.update(noise(SPEC, 1), late, stamp=4.8)
    assert (mapper.stamp, mapper.scans) == (5.0, 2)
    mapper.reset()
    assert (mapper.stamp, mapper.T_map_vehicle, mapper.scans) == (None, None, 0)
    assert (mapper.probability == 0.5).all()


def test_dogmatic_scans_stay_finite():
    mapper = BinaryBayesMapper(SPEC)
    mapper.update(uniform(SPEC, 1.0, 0.0), np.eye(4))
    assert np.isfinite(mapper.probability).all()
    mapper.update(uniform(SPEC, 0.5, 0.5), np.eye(4))
    np.testing.assert_allclose(mapper.probability, 0.12, atol=1e-6)
