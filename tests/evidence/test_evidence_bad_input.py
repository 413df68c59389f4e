"""Errors state the fault, its place, the value and the way out. Nothing is repaired silently."""

from typing import Any

import numpy as np
import pytest
import torch
from masses import RULES, pair, rule

from ogm import evidence
from ogm.evidence import powerset

GOOD = pair((0.5, 0.2, 0.3))
OF_ONE = {
    name: getattr(evidence, name)
    for name in (
        "unknown",
        "mass_to_evidence",
        "mass_to_probability",
        "pignistic",
        "plausibility_transform",
        "mass_to_log_odds",
        "maximize_uncertainty",
        "vacuity",
        "dissonance",
        "nonspecificity",
        "specificity",
        "yager_entropy",
        "pignistic_entropy",
        "jirousek_shenoy_entropy",
        "deng_entropy",
    )
} | {
    "discount": lambda mass: evidence.discount(mass, 0.5),
    "discount_evidence": lambda mass: evidence.discount_evidence(mass, 0.5),
    "discount_over_time": lambda mass: evidence.discount_over_time(mass, 1.0, 1.0),
    "contextual_discount": lambda mass: evidence.contextual_discount(mass, 0.5, 0.5),
    "trust_discount": lambda mass: evidence.trust_discount(mass, mass),
    "opinion": evidence.Opinion.from_mass,
}
OF_TWO = {name: rule(name) for name in RULES if name != "bold"} | {
    name: getattr(evidence, name)
    for name in (
        "conflict",
        "conflict_direction",
        "degree_of_conflict",
        "jousselme_distance",
        "multiplication",
        "comultiplication",
        "cumulative_unfusion",
        "trust_discount",
        "trust_discount_opposite",
    )
}
BAD = {
    "too much": ([0.7, 0.4], "is \\[0.7, 0.4\\]"),
    "negative": ([-0.1, 0.4], "is \\[-0.1, 0.4\\]"),
    "nan": ([np.nan, 0.4], "is \\[nan, 0.4\\]"),
    "infinite": ([0.0, np.inf], "is \\[0.0, inf\\]"),
}


@pytest.mark.parametrize("function", OF_ONE.values(), ids=OF_ONE)
@pytest.mark.parametrize(("values", "found"), BAD.values(), ids=BAD)
def test_values_outside_the_simplex_are_refused(function: Any, values: list, found: str) -> None:
    with pytest.raises(ValueError, match=f"tolerance 1e-12.*{found}.*renormalize"):
        function(np.array(values))


@pytest.mark.parametrize("function", OF_TWO.values(), ids=OF_TWO)
@pytest.mark.parametrize(("values", "found"), BAD.values(), ids=BAD)
def test_rules_refuse_either_argument(function: Any, values: list, found: str) -> None:
    for arguments in ((GOOD, np.array(values)), (np.array(values), GOOD)):
        with pytest.raises(ValueError, match=found):
            function(*arguments)


def test_the_worst_cell_is_named() -> None:
    grid = np.zeros((3, 4, 2), np.float32)
    grid[0, 1], grid[2, 3] = (0.6, 0.5), (0.9, 0.9)
    with pytest.raises(ValueError, match=r"tolerance 1e-06.*worst of the 2 cells.*mass\[2, 3, :\]"):
        evidence.check_mass(grid)
    with pytest.raises(ValueError, match=r"a\[2, 3, :\]"):
        evidence.dempster(grid, grid)
    evidence.check_mass(grid, tolerance=0.9)


def test_rounding_is_tolerated_and_no_more() -> None:
    for dtype, inside, outside in [(np.float32, 5e-7, 3e-6), (np.float64, 5e-13, 3e-12)]:
        evidence.check_mass(np.array([0.5 + inside, 0.5], dtype))
        evidence.dempster(np.array([0.5 + inside, 0.5], dtype), np.array([0.1, -inside], dtype))
        with pytest.raises(ValueError, match="tolerance"):
            evidence.check_mass(np.array([0.5 + outside, 0.5], dtype))
        with pytest.raises(ValueError, match="tolerance"):
            evidence.check_mass(np.array([0.5, -outside], dtype))


def test_check_mass_reads_tensors_and_triples() -> None:
    evidence.check_mass(torch.tensor([0.5, 0.2]))
    evidence.check_mass(np.array([0.5, 0.2, 0.3]))
    with pytest.raises(ValueError, match=r"mass\[1, :\]"):
        evidence.check_mass(torch.tensor([[0.5, 0.2], [0.9, 0.9]], requires_grad=True))
    with pytest.raises(ValueError, match="nan"):
        evidence.check_mass(torch.tensor([torch.nan, 0.2]))
    with pytest.raises(ValueError, match="must be non-negative"):
        evidence.conjunctive(np.array([0.5, 0.2, 0.4]), GOOD)


def test_renormalize_is_the_explicit_repair() -> None:
    wild = np.array([[0.9, 0.9], [-0.1, 0.4], [0.2, 0.3]])
    repaired = evidence.renormalize(wild)
    np.testing.assert_allclose(repaired, [[0.5, 0.5], [0, 0.4], [0.2, 0.3]])
    evidence.check_mass(repaired)
    np.testing.assert_allclose(evidence.renormalize(torch.from_numpy(wild)).numpy(), repaired)
    with pytest.raises(ValueError, match=r"mass\[0, 1\] is nan"):
        evidence.renormalize(np.array([[0.1, np.nan]]))


@pytest.mark.parametrize("function", (OF_ONE | {"check": evidence.check_mass}).values(), ids=[*OF_ONE, "check"])
def test_a_wrong_form_is_refused(function: Any) -> None:
    with pytest.raises(ValueError, match=r"2 states \(free, occupied\).*got shape \(512, 4\)"):
        function(np.zeros((512, 4)))
    with pytest.raises(ValueError, match=r"got shape \(\)"):
        function(np.array(0.5))
    with pytest.raises(TypeError, match="float32 or float64, got int64.*astype"):
        function(np.array([0, 1]))
    with pytest.raises(TypeError, match="float32 or float64, got float16"):
        function(np.zeros(2, np.float16))
    with pytest.raises(TypeError, match="numpy array or a torch tensor, got list"):
        function([0.5, 0.2])


@pytest.mark.parametrize("function", OF_TWO.values(), ids=OF_TWO)
def test_arguments_that_do_not_fit_are_refused(function: Any) -> None:
    with pytest.raises(ValueError, match=r"broadcast, got \(3, 2\) and \(4, 2\)"):
        function(np.zeros((3, 2)), np.zeros((4, 2)))
    with pytest.raises(TypeError, match="one dtype, got float64 and float32"):
        function(GOOD, GOOD.astype(np.float32))
    with pytest.raises(TypeError, match="one library, got numpy and torch"):
        function(GOOD, torch.from_numpy(GOOD))
    with pytest.raises(TypeError, match="one library, got torch and numpy"):
        function(torch.from_numpy(GOOD), GOOD)


@pytest.mark.parametrize("function", [rule(name) for name in RULES if name != "bold"])
def test_a_rule_needs_two_masses_or_an_axis(function: Any) -> None:
    stack = np.zeros((3, 4, 2))
    for arguments in ({}, {"b": stack, "axis": 0}):
        with pytest.raises(TypeError, match=r"rule\(a, b\).*rule\(stack, axis=0\)"):
            function(stack, **arguments)
    for axis in (2, -1, 3, -4):
        with pytest.raises(ValueError, match="leading axis"):
            function(stack, axis=axis)
    with pytest.raises(ValueError, match="at least one source"):
        function(np.zeros((0, 2)), axis=0)


def test_numbers_out_of_range_are_refused() -> None:
    calls: list[tuple[Any, str]] = [
        (lambda: evidence.discount(GOOD, 1.5), r"reliability must lie in \[0, 1\], got 1.5"),
        (lambda: evidence.discount(GOOD, np.float64(-0.1)), "got -0.1"),
        (lambda: evidence.discount(GOOD, float("nan")), "got nan"),
        (lambda: evidence.discount(np.zeros((2, 2)), np.array([0.5, 2.0])), r"reliability\[1\] is 2"),
        (
            lambda: evidence.discount(np.zeros((2, 2)), np.ones(3)),
            r"one number per cell, shape \(2,\), got shape \(3,\)",
        ),
        (lambda: evidence.discount_over_time(GOOD, 1.0, 0.0), "half_life must be greater than 0"),
        (lambda: evidence.discount_over_time(GOOD, -1.0, 1.0), "elapsed must lie in"),
        (lambda: evidence.mass_to_probability(GOOD, 1.1), "base_rate must lie in"),
        (lambda: evidence.mass_to_evidence(GOOD, prior_weight=0), "prior_weight must be greater than 0"),
        (lambda: evidence.evidence_to_mass(np.array([[1.0, 2], [-1, 3]])), r"evidence\[1, 0\] is -1"),
        (lambda: evidence.evidence_to_mass(np.array([np.nan, 3])), "evidence.*nan"),
        (lambda: evidence.evidence_to_mass(np.array([np.inf, 3])), "evidence.*inf"),
        (lambda: evidence.alpha_to_evidence(np.array([0.5, 3])), "alpha - prior.*-0.5"),
        (lambda: evidence.log_odds_to_mass(np.array([np.nan])), "NaN"),
        (lambda: evidence.probability_to_mass(np.array(0.9), 0.5), "the mass of this probability"),
        (lambda: evidence.probability_to_mass(np.array(1.9), 0.0), "probability.* must lie in"),
        (lambda: evidence.counts_to_mass(np.array(-1.0), np.array(1.0)), "hits.*must lie in"),
        (lambda: evidence.counts_to_mass(np.array(1.0), np.array(-1.0)), "passes.*must lie in"),
        (lambda: evidence.dempster(GOOD, GOOD, on_conflict="ignore"), "on_conflict must be one of average"),  # type: ignore[arg-type]
        (lambda: evidence.cumulative(GOOD, GOOD, dogmatic_weights=[1]), "2 positive numbers"),
        (lambda: evidence.averaging(GOOD, GOOD, dogmatic_weights=[1, -1]), "2 positive numbers"),
        (lambda: evidence.cumulative_unfusion(np.zeros(2), GOOD), "part must not hold more evidence than fused"),
        (lambda: evidence.cumulative_unfusion(np.array([0.5, 0.2]), np.array([0.1, 0.5])), "more evidence than fused"),
        (lambda: evidence.cumulative_unfusion(np.array([0.2, 0.5]), np.array([0.5, 0.1])), "more evidence than fused"),
        (lambda: evidence.multiplication(GOOD, GOOD, 1.0, 1.0), "must not both be 1"),
        (lambda: evidence.comultiplication(GOOD, GOOD, 0.0, 0.0), "must not both be 0"),
        (lambda: evidence.bold(np.zeros(3), np.zeros(3)), "conflict > 0"),
        (lambda: evidence.bold(GOOD, GOOD), r"3 numbers \(free, occupied, conflict\)"),
        (lambda: evidence.pcr6_plus(np.zeros((9, 2)), axis=0), "at most 8 sources, got 9"),
        (lambda: evidence.consensus_compromise(np.zeros((13, 2)), axis=0), "at most 12 sources, got 13"),
        (lambda: evidence.Opinion.from_mass(np.zeros((3, 2))), r"got shape \(3, 2\)"),
        (lambda: evidence.Opinion(0.5, 0.6), "unknown must lie in"),
        (lambda: evidence.Opinion(0.5, 0.5 + 1e-5), "unknown must lie in"),
        (lambda: evidence.Opinion(0.5, 0.2, 0.2), "free \\+ occupied \\+ unknown must be 1"),
        (lambda: evidence.Opinion(0.5, 0.2, 0.3 + 1e-5), "free \\+ occupied \\+ unknown must be 1"),
        (lambda: evidence.Opinion(float("nan"), 0.6), "must lie in"),
        (lambda: evidence.Opinion(0.5, 0.2, base_rate=2), "base_rate must lie in"),
        (lambda: evidence.Opinion(0.5, 0.2, base_rate=1 + 1e-5), "base_rate must lie in"),
        (lambda: evidence.Opinion(0.5, 0.2, base_rate=-1e-5), "base_rate must lie in"),
    ]
    for call, message in calls:
        with pytest.raises(ValueError, match=message):
            call()


def test_numbers_of_the_wrong_library_are_refused() -> None:
    tensor = torch.from_numpy(GOOD)
    with pytest.raises(TypeError, match="reliability must be a number or come from the library of the mass"):
        evidence.discount(tensor, np.ones(()))
    with pytest.raises(TypeError, match="reliability"):
        evidence.discount(GOOD, torch.ones(()))
    with pytest.raises(TypeError, match="reliability must be a numpy array or a torch tensor, got str"):
        evidence.discount(GOOD, "much")
    for function in (evidence.log_odds_to_mass, lambda p: evidence.probability_to_mass(p, 0.1)):
        with pytest.raises(TypeError, match="float32 or float64"):
            function(np.array([1]))
    with pytest.raises(TypeError, match="hits must be float32 or float64"):
        evidence.counts_to_mass(np.array([1]), np.array([1]))


def test_powerset_refuses_mixed_sources() -> None:
    good = powerset.from_pair(GOOD)
    for other, message in ((good.astype(np.float32), "one dtype"), (torch.from_numpy(good), "one library")):
        with pytest.raises(TypeError, match=message):
            powerset.conjunctive(good, other)  # type: ignore[type-var]


def test_powerset_refuses_what_is_no_mass_function() -> None:
    good = powerset.from_pair(GOOD)
    calls: list[tuple[Any, str]] = [
        (lambda: powerset.conjunctive(np.zeros(3), np.zeros(3)), "2\\^K numbers"),
        (lambda: powerset.conjunctive(np.zeros(128), np.zeros(128)), "at most 6 states are supported, got 7"),
        (lambda: powerset.conjunctive(good, np.eye(8)[7]), "one frame, got 4 and 8"),
        (lambda: powerset.conjunctive(np.array([0, 0.5, 0.5, 0.5]), good), r"sum to 1.*a\[:\].*0.5"),
        (lambda: powerset.conjunctive(good, np.array([[0, -0.5, 1, 0.5]])), r"non-negative.*b\[0, :\]"),
        (lambda: powerset.mass_to_belief(np.array([np.nan, 0, 1, 0])), "nan"),
        (lambda: powerset.to_pair(np.array([0.5, 0, 0.5, 0])), "no place for conflict, got up to 0.5"),
        (lambda: powerset.to_pair(np.eye(8)[7]), "frame of 2 states"),
        (lambda: powerset.subset(6), "numbers from 0 to 5"),
        (lambda: powerset.coarsen(np.eye(8)[7], [(0,), (1,)]), "partition of the states 0 to 2"),
        (lambda: powerset.coarsen(np.eye(8)[7], [(0,), (1, 1, 2)]), "partition"),
        (lambda: powerset.coarsen(np.eye(8)[7], [(0, 1, 2), ()]), "partition"),
        (lambda: powerset.refine(good, [(0,), (1,), (2,)]), "one group per state, 2, got 3"),
        (lambda: powerset.refine(good, [(0, 1, 2, 3), (4, 5, 6)]), "at most 6 states"),
        (lambda: powerset.contextual_discount(good, [0.5]), "one reliability per state, 2, got 1"),
        (lambda: powerset.dempster(good, good, on_conflict="ignore"), "on_conflict"),  # type: ignore[arg-type]
    ]
    for call, message in calls:
        with pytest.raises(ValueError, match=message):
            call()
    with pytest.raises(TypeError, match="float32 or float64"):
        powerset.mass_to_belief(np.array([0, 0, 1, 0]))
    powerset.check_powerset(torch.tensor([0.0, 0.5, 0.25, 0.25]))
    with pytest.raises(ValueError, match="sum to 1"):
        powerset.check_powerset(torch.tensor([0.5, 0.5, 0.25, 0.25]))
    powerset.check_powerset(np.zeros((0, 4)))


def test_dirichlet_refuses_what_is_no_density() -> None:
    good = np.array([1.0, 2.0])
    for bad, message in [
        (np.array([0.0, 1]), r"alpha\[0\] is 0"),
        (np.array([np.nan, 1]), r"alpha\[0\] is nan"),
        (np.array([[1, 1], [1, np.inf]]), r"alpha\[1, 1\] is inf"),
        (np.array([1.0]), "at least 2 states"),
    ]:
        for function in (evidence.dirichlet_entropy, lambda alpha: evidence.dirichlet_kl(alpha, good)):
            with pytest.raises(ValueError, match=message):
                function(bad)
    with pytest.raises(ValueError, match="same number of states"):
        evidence.dirichlet_kl(good, np.ones(3))
    with pytest.raises(ValueError, match="broadcast"):
        evidence.dirichlet_kl(np.ones((3, 2)), np.ones((4, 2)))
    with pytest.raises(TypeError, match="float32 or float64"):
        evidence.dirichlet_entropy(np.array([1, 2]))


def test_bold_names_the_cell_without_conflict() -> None:
    triples = np.full((3, 4, 3), 0.2)
    without = triples.copy()
    without[1, 2] = (0.5, 0.2, 0)
    message = r"source 1 has none in 1 cells, the first at \[1, 2\]"
    with pytest.raises(ValueError, match=message):
        evidence.bold(triples, without)
    with pytest.raises(ValueError, match=message):
        powerset.bold(powerset.from_pair(triples), powerset.from_pair(without))


@pytest.mark.parametrize("name", ["multiplication", "comultiplication"])
def test_base_rates_that_divide_by_zero_are_refused_in_arrays_too(name: str) -> None:
    rate = 1.0 if name == "multiplication" else 0.0
    rates = np.array([0.5, rate])
    grid = np.stack([GOOD, GOOD])
    for first, second in [(rate, rate), (rates, rates), (rate, rates), (rates, rate)]:
        with pytest.raises(ValueError, match="base rates must not both be"):
            getattr(evidence, name)(grid, grid, first, second)
    assert np.isfinite(getattr(evidence, name)(grid, grid, rates, 0.5).mass).all()


@pytest.mark.parametrize("function", [evidence.vacuity, evidence.check_mass, evidence.renormalize])
def test_masked_arrays_are_refused(function: Any) -> None:
    with pytest.raises(TypeError, match=r"must not be a masked array.*filled\(0\)"):
        function(np.ma.masked_array([[0.1, 0.2]]))
    with pytest.raises(TypeError, match="b must not be a masked array"):
        evidence.dempster(GOOD, np.ma.masked_array(GOOD))


def test_tensors_of_two_devices_are_refused() -> None:
    here = torch.tensor(GOOD)
    with pytest.raises(TypeError, match="a and b must be on one device, got cpu and meta"):
        evidence.dempster(here, here.to("meta"))
