"""Errors state the fault, its place, the value and the way out. Nothing is repaired silently."""

import numpy as np
import torch
from cases import refused
from masses import RULES, pair, rule

from ogm import evidence
from ogm.evidence import powerset

GOOD = pair((0.5, 0.2, 0.3))
OF_ONE = {
    name: getattr(evidence, name)
    for name in [
        "unknown", "mass_to_evidence", "mass_to_probability", "pignistic", "plausibility_transform",
        "mass_to_log_odds", "maximize_uncertainty", "vacuity", "dissonance", "nonspecificity", "specificity",
        "yager_entropy", "pignistic_entropy", "jirousek_shenoy_entropy", "deng_entropy",
    ]
} | {
    "discount": lambda mass: evidence.discount(mass, 0.5),
    "discount_evidence": lambda mass: evidence.discount_evidence(mass, 0.5),
    "discount_over_time": lambda mass: evidence.discount_over_time(mass, 1.0, 1.0),
    "contextual_discount": lambda mass: evidence.contextual_discount(mass, 0.5, 0.5),
    "trust_discount": lambda mass: evidence.trust_discount(mass, mass),
    "opinion": evidence.Opinion.from_mass,
}  # fmt: skip
OF_TWO = {name: rule(name) for name in RULES} | {
    name: getattr(evidence, name)
    for name in [
        "conflict", "conflict_direction", "degree_of_conflict", "jousselme_distance", "multiplication",
        "comultiplication", "cumulative_unfusion", "trust_discount", "trust_discount_opposite",
    ]
}  # fmt: skip
BAD = (
    ([0.7, 0.4], r"is \[0.7, 0.4\]"),
    ([-0.1, 0.4], r"is \[-0.1, 0.4\]"),
    ([np.nan, 0.4], r"is \[nan, 0.4\]"),
    ([0.0, np.inf], r"is \[0.0, inf\]"),
)


def test_values_outside_the_simplex_are_refused() -> None:
    for values, found in BAD:
        for function in OF_ONE.values():
            refused(f"tolerance 1e-12.*{found}.*renormalize", function, np.array(values))
        for function in OF_TWO.values():
            refused(found, function, GOOD, np.array(values))
            refused(found, function, np.array(values), GOOD)


def test_the_worst_cell_is_named() -> None:
    grid = np.zeros((3, 4, 2), np.float32)
    grid[0, 1], grid[2, 3] = (0.6, 0.5), (0.9, 0.9)
    refused(r"tolerance 1e-06.*worst of the 2 cells.*mass\[2, 3, :\]", evidence.check_mass, grid)
    refused(r"a\[2, 3, :\]", evidence.dempster, grid, grid)
    evidence.check_mass(grid, tolerance=0.9)


def test_rounding_is_tolerated_and_no_more() -> None:
    for dtype, inside, outside in [(np.float32, 5e-7, 3e-6), (np.float64, 5e-13, 3e-12)]:
        evidence.check_mass(np.array([0.5 + inside, 0.5], dtype))
        evidence.dempster(np.array([0.5 + inside, 0.5], dtype), np.array([0.1, -inside], dtype))
        refused("tolerance", evidence.check_mass, np.array([0.5 + outside, 0.5], dtype))
        refused("tolerance", evidence.check_mass, np.array([0.5, -outside], dtype))


def test_check_mass_reads_tensors_and_triples() -> None:
    evidence.check_mass(torch.tensor([0.5, 0.2]))
    evidence.check_mass(np.array([0.5, 0.2, 0.3]))
    refused(r"mass\[1, :\]", evidence.check_mass, torch.tensor([[0.5, 0.2], [0.9, 0.9]], requires_grad=True))
    refused("nan", evidence.check_mass, torch.tensor([torch.nan, 0.2]))
    refused("must be non-negative", evidence.conjunctive, np.array([0.5, 0.2, 0.4]), GOOD)


def test_renormalize_is_the_explicit_repair() -> None:
    wild = np.array([[0.9, 0.9], [-0.1, 0.4], [0.2, 0.3]])
    repaired = evidence.renormalize(wild)
    np.testing.assert_allclose(repaired, [[0.5, 0.5], [0, 0.4], [0.2, 0.3]])
    evidence.check_mass(repaired)
    np.testing.assert_allclose(evidence.renormalize(torch.from_numpy(wild)).numpy(), repaired)
    refused(r"mass\[0, 1\] is nan", evidence.renormalize, np.array([[0.1, np.nan]]))


def test_a_wrong_form_is_refused() -> None:
    for function in (*OF_ONE.values(), evidence.check_mass):
        refused(r"2 states \(free, occupied\).*got shape \(512, 4\)", function, np.zeros((512, 4)))
        refused(r"got shape \(\)", function, np.array(0.5))
        for mass, message in (
            (np.zeros(2, np.float16), "float32 or float64, got float16"),
            ("dense", "a list or an Opinion, got str|float32 or float64, got <U5|array or a torch tensor, got str"),
        ):
            refused(message, function, mass, error=TypeError)


def test_arguments_that_do_not_fit_are_refused() -> None:
    tensor = torch.from_numpy(GOOD)
    for function in OF_TWO.values():
        refused(r"broadcast, got \(3, 2\) and \(4, 2\)", function, np.zeros((3, 2)), np.zeros((4, 2)))
        refused("the same dtype, got float64 and float32", function, GOOD, GOOD.astype(np.float32), error=TypeError)
        refused("the same library, got numpy and torch", function, GOOD, tensor, error=TypeError)
        refused("the same library, got torch and numpy", function, tensor, GOOD, error=TypeError)


def test_a_rule_needs_two_masses_or_an_axis() -> None:
    stack, usage = np.zeros((3, 4, 2)), r"rule\(a, b\).*rule\(stack, axis=0\)"
    for function in (rule(name) for name in RULES):
        refused(usage, function, stack, error=TypeError)
        refused(usage, function, stack, stack, error=TypeError, axis=0)
        refused(usage, function, error=TypeError)
        for axis in (2, -1, 3, -4):
            refused("leading axis", function, stack, axis=axis)
        refused("at least one source", function, np.zeros((0, 2)), axis=0)


def test_numbers_out_of_range_are_refused() -> None:
    e, halves, certain = evidence, np.array([0.5, 2.0]), np.zeros((2, 2))
    refused(r"reliability must lie in \[0, 1\], got 1.5", e.discount, GOOD, 1.5)
    refused("got -0.1", e.discount, GOOD, np.float64(-0.1))
    refused("got nan", e.discount, GOOD, float("nan"))
    refused(r"reliability\[1\] is 2", e.discount, certain, halves)
    refused(r"one number per cell, shape \(2,\), got shape \(3,\)", e.discount, certain, np.ones(3))
    refused("half_life must be greater than 0", e.discount_over_time, GOOD, 1.0, 0.0)
    refused("elapsed must lie in", e.discount_over_time, GOOD, -1.0, 1.0)
    refused("base_rate must lie in", e.mass_to_probability, GOOD, 1.1)
    refused("prior_weight must be greater than 0", e.mass_to_evidence, GOOD, prior_weight=0)
    refused(r"evidence\[1, 0\] is -1", e.evidence_to_mass, np.array([[1.0, 2], [-1, 3]]))
    refused("evidence.*nan", e.evidence_to_mass, np.array([np.nan, 3]))
    refused("evidence.*inf", e.evidence_to_mass, np.array([np.inf, 3]))
    refused("alpha - prior.*-0.5", e.alpha_to_evidence, np.array([0.5, 3]))
    refused("NaN", e.log_odds_to_mass, np.array([np.nan]))
    refused("the mass of this probability", e.probability_to_mass, np.array(0.9), 0.5)
    refused("probability.* must lie in", e.probability_to_mass, np.array(1.9), 0.0)
    refused("hits.*must lie in", e.counts_to_mass, np.array(-1.0), np.array(1.0))
    refused("passes.*must lie in", e.counts_to_mass, np.array(1.0), np.array(-1.0))
    refused("on_conflict must be one of average", e.dempster, GOOD, GOOD, on_conflict="ignore")
    refused("2 positive numbers", e.cumulative, GOOD, GOOD, dogmatic_weights=[1])
    refused("2 positive numbers", e.averaging, GOOD, GOOD, dogmatic_weights=[1, -1])
    refused("part must not have more evidence than fused", e.cumulative_unfusion, np.zeros(2), GOOD)
    refused("more evidence than fused", e.cumulative_unfusion, np.array([0.5, 0.2]), np.array([0.1, 0.5]))
    refused("more evidence than fused", e.cumulative_unfusion, np.array([0.2, 0.5]), np.array([0.5, 0.1]))
    refused("must not both be 1", e.multiplication, GOOD, GOOD, 1.0, 1.0)
    refused("must not both be 0", e.comultiplication, GOOD, GOOD, 0.0, 0.0)
    refused("at most 8 sources, got 9", e.pcr6_plus, np.zeros((9, 2)), axis=0)
    refused("at most 12 sources, got 13", e.consensus_compromise, np.zeros((13, 2)), axis=0)
    refused(r"shape \(2,\), got \(3, 2\)", e.Opinion.from_mass, np.zeros((3, 2)))
    refused("unknown must lie in", e.Opinion, 0.5, 0.6)
    refused("unknown must lie in", e.Opinion, 0.5, 0.5 + 1e-5)
    refused(r"free \+ occupied \+ unknown must be 1", e.Opinion, 0.5, 0.2, 0.2)
    refused(r"free \+ occupied \+ unknown must be 1", e.Opinion, 0.5, 0.2, 0.3 + 1e-5)
    refused("must lie in", e.Opinion, float("nan"), 0.6)
    for base_rate in (2, 1 + 1e-5, -1e-5):
        refused("base_rate must lie in", e.Opinion, 0.5, 0.2, base_rate=base_rate)


def test_numbers_of_the_wrong_library_are_refused() -> None:
    wanted = "reliability must be a number or come from the library of the mass"
    refused(wanted, evidence.discount, torch.from_numpy(GOOD), np.ones(()), error=TypeError)
    refused("reliability", evidence.discount, GOOD, torch.ones(()), error=TypeError)
    message = "reliability must be a numpy array or a torch tensor, got str"
    refused(message, evidence.discount, GOOD, "much", error=TypeError)
    refused("float32 or float64", evidence.log_odds_to_mass, np.array([1]), error=TypeError)
    refused("float32 or float64", evidence.probability_to_mass, np.array([1]), 0.1, error=TypeError)
    refused("hits must be float32 or float64", evidence.counts_to_mass, np.array([1]), np.array([1]), error=TypeError)


def test_powerset_refuses_what_is_no_mass_function() -> None:
    good, p = powerset.from_pair(GOOD), powerset
    refused("the same dtype", p.conjunctive, good, good.astype(np.float32), error=TypeError)
    refused("the same library", p.conjunctive, good, torch.from_numpy(good), error=TypeError)
    refused(r"2\^K numbers", p.conjunctive, np.zeros(3), np.zeros(3))
    refused("at most 6 states are supported, got 7", p.conjunctive, np.zeros(128), np.zeros(128))
    refused("one frame, got 4 and 8", p.conjunctive, good, np.eye(8)[7])
    refused(r"sum to 1.*a\[:\].*0.5", p.conjunctive, np.array([0, 0.5, 0.5, 0.5]), good)
    refused(r"non-negative.*b\[0, :\]", p.conjunctive, good, np.array([[0, -0.5, 1, 0.5]]))
    refused("nan", p.mass_to_belief, np.array([np.nan, 0, 1, 0]))
    refused("must not have conflict, got up to 0.5", p.to_pair, np.array([0.5, 0, 0.5, 0]))
    refused("frame of 2 states", p.to_pair, np.eye(8)[7])
    refused("numbers from 0 to 5", p.subset, 6)
    refused("partition of the states 0 to 2", p.coarsen, np.eye(8)[7], [(0,), (1,)])
    refused("partition", p.coarsen, np.eye(8)[7], [(0,), (1, 1, 2)])
    refused("partition", p.coarsen, np.eye(8)[7], [(0, 1, 2), ()])
    refused("one group per state, 2, got 3", p.refine, good, [(0,), (1,), (2,)])
    refused("at most 6 states", p.refine, good, [(0, 1, 2, 3), (4, 5, 6)])
    refused("one reliability per state, 2, got 1", p.contextual_discount, good, [0.5])
    refused("on_conflict", p.dempster, good, good, on_conflict="ignore")
    refused("float32 or float64", p.mass_to_belief, np.array([0, 0, 1, 0]), error=TypeError)
    p.check_powerset(torch.tensor([0.0, 0.5, 0.25, 0.25]))
    refused("sum to 1", p.check_powerset, torch.tensor([0.5, 0.5, 0.25, 0.25]))
    p.check_powerset(np.zeros((0, 4)))


def test_dirichlet_refuses_what_is_no_density() -> None:
    good, entropy, kl = np.array([1.0, 2.0]), evidence.dirichlet_entropy, evidence.dirichlet_kl
    for bad, message in [
        (np.array([0.0, 1]), r"alpha\[0\] is 0"),
        (np.array([np.nan, 1]), r"alpha\[0\] is nan"),
        (np.array([[1, 1], [1, np.inf]]), r"alpha\[1, 1\] is inf"),
        (np.array([1.0]), "at least 2 states"),
    ]:
        refused(message, entropy, bad)
        refused(message, kl, bad, good)
    refused("same number of states", kl, good, np.ones(3))
    refused("broadcast", kl, np.ones((3, 2)), np.ones((4, 2)))
    refused("float32 or float64", entropy, np.array([1, 2]), error=TypeError)


def test_bold_names_the_cell_without_conflict() -> None:
    masses = np.full((3, 4, 4), 0.25)
    without = masses.copy()
    without[1, 2] = (0, 0.5, 0.2, 0.3)
    refused(r"in source 1 it is 0 in 1 cells, the first at \[1, 2\]", powerset.bold, masses, without)


def test_base_rates_that_divide_by_zero_are_refused_in_arrays_too() -> None:
    grid = np.stack([GOOD, GOOD])
    for function, rate in ((evidence.multiplication, 1.0), (evidence.comultiplication, 0.0)):
        rates = np.array([0.5, rate])
        for first, second in [(rate, rate), (rates, rates), (rate, rates), (rates, rate)]:
            refused("base rates must not both be", function, grid, grid, first, second)
        assert np.isfinite(function(grid, grid, rates, 0.5).mass).all()


def test_masked_arrays_and_tensors_of_two_devices_are_refused() -> None:
    masked = np.ma.masked_array([[0.1, 0.2]])
    for function in (evidence.vacuity, evidence.check_mass, evidence.renormalize):
        refused(r"must not be a masked array.*filled\(0\)", function, masked, error=TypeError)
    message = "b must not be a masked array"
    refused(message, evidence.dempster, GOOD, np.ma.masked_array(GOOD), error=TypeError)
    here, message = torch.tensor(GOOD), "a and b must be on the same device, got cpu and meta"
    refused(message, evidence.dempster, here, here.to("meta"), error=TypeError)
