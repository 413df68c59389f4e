"""The edge policy: total conflict, certainty, rounding, the last bits of float32."""

from typing import Any

import numpy as np
import pytest
from cases import each, refused
from masses import DTYPES, RULES, rule

from ogm import evidence
from ogm.evidence import powerset

FREE, OCCUPIED, VACUOUS = np.array([1.0, 0]), np.array([0, 1.0]), np.zeros(2)


@each(("policy", "expected"), [("average", (0.5, 0.5)), ("vacuous", (0, 0)), ("nan", (np.nan, np.nan))])
def test_total_conflict_follows_the_policy(policy: Any, expected: tuple) -> None:
    both = np.stack([FREE, OCCUPIED]), np.stack([OCCUPIED, OCCUPIED])
    for combine in (evidence.dempster, evidence.belief_constraint):
        np.testing.assert_array_equal(combine(*both, on_conflict=policy), [expected, (0, 1)])
    closed = evidence.close_world(evidence.conjunctive(*both), on_conflict=policy)
    np.testing.assert_array_equal(closed, [expected, (0, 1)])
    general = powerset.dempster(*map(powerset.from_pair, both), on_conflict=policy)
    np.testing.assert_allclose(general[:, 1:], [(*expected, 1 - sum(expected)), (0, 1, 0)])


def test_total_conflict_may_raise() -> None:
    grid = np.zeros((3, 4, 2))
    other = grid.copy()
    grid[1, 2], other[1, 2] = FREE, OCCUPIED
    for combine in (evidence.dempster, evidence.belief_constraint):
        refused(r"1 cells are in total conflict, the first at \[1, 2\]", combine, grid, other, on_conflict="raise")
        np.testing.assert_array_equal(combine(grid, grid, on_conflict="raise"), grid)
    refused("total conflict", evidence.close_world, np.zeros(3), on_conflict="raise")
    with pytest.raises(ValueError, match="total conflict"):
        powerset.dempster(powerset.from_pair(grid), powerset.from_pair(other), on_conflict="raise")


def test_the_average_is_the_limit_of_two_equal_sources() -> None:
    for unknown in (1e-3, 1e-6, 1e-9, 1e-12):
        near = evidence.dempster(FREE * (1 - unknown), OCCUPIED * (1 - unknown))
        np.testing.assert_allclose(near, (0.5, 0.5), atol=unknown)
    np.testing.assert_array_equal(evidence.dempster(FREE, OCCUPIED), (0.5, 0.5))


def test_total_conflict_in_a_stack_gives_the_mean_in_any_order() -> None:
    for order in ([0, 1, 2], [2, 1, 0], [1, 0, 2]):
        stack = np.stack([FREE, OCCUPIED, OCCUPIED])[order]
        np.testing.assert_allclose(evidence.dempster(stack, axis=0), (1 / 3, 2 / 3))
        uncertain = np.concatenate([stack, [(0.1, 0.3), VACUOUS]])[[3, *order, 4]]
        np.testing.assert_allclose(evidence.dempster(uncertain, axis=0), (1 / 3, 2 / 3))


def test_near_total_conflict_in_float32_divides_by_what_survives() -> None:
    """1 - conflict would be 0.559 instead of one half here, and infinite a decade further."""
    almost_free = np.array([1 - 1e-7, 1e-7], np.float32)
    almost_occupied = almost_free[::-1].copy()
    np.testing.assert_allclose(evidence.dempster(almost_free, almost_occupied), (0.5, 0.5), atol=1e-3)
    tiny = np.array([1, 1e-8], np.float32)
    np.testing.assert_allclose(evidence.dempster(tiny, tiny[::-1].copy()), (0.5, 0.5), atol=1e-3)


@each("dtype", DTYPES)
def test_many_conflicting_sources_neither_underflow_nor_explode(dtype: Any) -> None:
    stack = np.array([[0.9, 0.05], [0.05, 0.9]] * 500, dtype)
    np.testing.assert_allclose(evidence.dempster(stack, axis=0), (0.5, 0.5), atol=1e-3)
    np.testing.assert_allclose(evidence.murphy(stack, axis=0), (0.5, 0.5), atol=1e-3)
    evidence.check_mass(evidence.conjunctive(stack, axis=0))


@each("fuse", [evidence.cumulative, evidence.averaging, evidence.weighted])
def test_dogmatic_masses_are_averaged(fuse: Any) -> None:
    np.testing.assert_allclose(fuse(FREE, OCCUPIED), (0.5, 0.5))
    np.testing.assert_allclose(fuse(np.array([0.3, 0.7]), OCCUPIED), (0.15, 0.85))
    np.testing.assert_allclose(fuse(np.array([0.3, 0.7]), np.array([0.1, 0.2])), (0.3, 0.7))
    stack = np.array([[1.0, 0], [0, 1], [0.2, 0.3]])
    np.testing.assert_allclose(fuse(stack, axis=0), (0.5, 0.5))
    np.testing.assert_allclose(fuse(stack, axis=0, dogmatic_weights=[3, 1, 1]), (0.75, 0.25))
    np.testing.assert_allclose(fuse(FREE, OCCUPIED, dogmatic_weights=[3, 1]), (0.75, 0.25))


@each("fuse", [evidence.cumulative, evidence.averaging, evidence.weighted])
@each("dtype", DTYPES)
def test_a_mass_is_dogmatic_up_to_rounding(fuse: Any, dtype: Any) -> None:
    """1 - f - o of these is a few 1e-17 or 1e-8, of either sign, and not zero."""
    shares = np.arange(1, 110, dtype=float)[:, None]
    dogmatic = np.concatenate([shares, 110 - shares], axis=1) / 110
    np.testing.assert_allclose(
        fuse(dogmatic.astype(dtype), np.broadcast_to(OCCUPIED, dogmatic.shape).astype(dtype)),
        (dogmatic + OCCUPIED) / 2,
        atol=1e-6,
    )


def test_base_rates_of_vacuous_and_dogmatic_masses_are_averaged() -> None:
    for fuse in (evidence.cumulative_base_rate, evidence.confidence_base_rate):
        assert fuse([1, 1], [0.2, 0.6]) == pytest.approx(0.4)
        assert fuse([0, 1], [0.2, 0.6]) == pytest.approx(0.2)
        assert fuse([0.5, 0.5, 0.5], [0.2, 0.6, 0.1]) == pytest.approx(0.3)
        vectors = [np.array([0.1, 0.2, 0.7]), np.array([0.3, 0.2, 0.5])]
        np.testing.assert_allclose(fuse([np.array([[0.5], [1]])] * 2, vectors), [(0.2, 0.2, 0.6)] * 2)
    assert evidence.cumulative_base_rate([0, 0], [0.2, 0.6]) == pytest.approx(0.4)
    with_vacuous = evidence.cumulative_base_rate([0.2, 0.5, 1], [0.2, 0.6, 0.9])
    assert with_vacuous == pytest.approx(float(evidence.cumulative_base_rate([0.2, 0.5], [0.2, 0.6])))


def test_unfusing_certainty_from_certainty_leaves_the_question_open() -> None:
    np.testing.assert_array_equal(evidence.cumulative_unfusion(OCCUPIED, OCCUPIED), VACUOUS)
    np.testing.assert_allclose(evidence.cumulative_unfusion(np.array([0.1, 0.9]), np.array([0.1, 0.9])), VACUOUS)
    np.testing.assert_allclose(evidence.cumulative_unfusion(OCCUPIED, np.array([0, 0.5])), OCCUPIED)
    np.testing.assert_allclose(evidence.cumulative_unfusion(np.array([0.2, 0.5]), VACUOUS), (0.2, 0.5))


@each("dtype", DTYPES)
def test_cautious_reads_certainty_as_almost_certain(dtype: Any) -> None:
    certain = np.array([0, 1], dtype)
    result = evidence.cautious(certain, certain)
    np.testing.assert_allclose(result, (0, 1), atol=2e-6)
    np.testing.assert_allclose(evidence.cautious(certain, certain[::-1].copy()), (0.5, 0.5), atol=1e-6)
    evidence.check_mass(evidence.cautious(np.array([0.5, 0.5], dtype), certain))


def test_consensus_compromise_jumps_at_agreement() -> None:
    """The published formula divides zero by zero at agreement; a hair beside it, it gives something else."""
    mass = np.array([0.2, 0.4])
    np.testing.assert_allclose(evidence.consensus_compromise(mass, mass), mass)
    near = evidence.consensus_compromise(mass, np.array([0.2, 0.400001]))
    np.testing.assert_allclose(near, (0.2, 0.64), atol=1e-4)


@each("dtype", DTYPES)
def test_consensus_compromise_keeps_what_dogmatic_sources_agree_on(dtype: Any) -> None:
    for certain in (FREE, OCCUPIED, np.array([0.75, 0.25])):
        for others in ([VACUOUS], [VACUOUS, VACUOUS], [0.4 * certain], [0.9 * certain, VACUOUS]):
            stack = np.array([certain, *others, certain], dtype)
            np.testing.assert_allclose(evidence.consensus_compromise(stack, axis=0), certain, atol=1e-7)
    conflicting = np.array([FREE, VACUOUS, OCCUPIED, OCCUPIED], dtype)
    np.testing.assert_allclose(evidence.consensus_compromise(conflicting, axis=0), (1 / 3, 2 / 3), atol=1e-7)


@each("dogmatic", [2, 3, 4])
def test_consensus_compromise_of_dogmatic_sources_is_a_limit(dogmatic: int) -> None:
    """The published formula, at sources whose residues give 1e-6 to the unknown, instead of 0/0."""
    rng = np.random.default_rng(dogmatic)
    floor = rng.dirichlet([1, 1, 3], 200)[:, :2]  # the source without residue
    share = rng.random((dogmatic, 200, 1))
    residue = (1 - floor.sum(-1, keepdims=True)) * np.concatenate([share, 1 - share], axis=-1)
    uncertain = floor + rng.random((200, 1)) * np.stack([residue[0, :, 0] * 0.9, 0 * share[0, :, 0]], axis=-1)
    stack, near = (np.concatenate([[floor, uncertain], floor + rest]) for rest in (residue, residue * (1 - 1e-6)))
    result = evidence.consensus_compromise(stack, axis=0)
    np.testing.assert_allclose(result, evidence.consensus_compromise(near, axis=0), atol=1e-3)
    np.testing.assert_allclose(result, stack[2:].mean(0), atol=1e-12)


def test_consensus_compromise_of_many_almost_certain_sources_in_float32() -> None:
    """The product of their unknowns, 1e-60, is 0 in float32."""
    stack = np.array([[1 - 1e-6, 0]] * 10 + [[0, 0], [0, 1 - 1e-6]])
    expected = evidence.consensus_compromise(stack, axis=0)
    np.testing.assert_allclose(evidence.consensus_compromise(stack.astype(np.float32), axis=0), expected, atol=1e-2)
    assert expected[0] == pytest.approx(10 / 11, abs=1e-3)


def test_evidence_of_dogmatic_masses() -> None:
    np.testing.assert_array_equal(evidence.mass_to_evidence(np.array([0.3, 0.7])), (np.inf, np.inf))
    np.testing.assert_array_equal(evidence.mass_to_evidence(OCCUPIED), (0, np.inf))
    np.testing.assert_allclose(evidence.mass_to_evidence(OCCUPIED, min_unknown=2e-5), (0, 1e5))
    np.testing.assert_allclose(evidence.mass_to_evidence(np.array([0.25, 0.75]), min_unknown=2e-5), (25e3, 75e3))


@each("dtype", DTYPES)
def test_float32_carries_an_evidence_of_1e5_to_one_percent(dtype: Any) -> None:
    given = np.array([3e4, 7e4], dtype)
    there_and_back = evidence.mass_to_evidence(evidence.evidence_to_mass(given))
    np.testing.assert_allclose(there_and_back, given, rtol=1e-2)


@each("dtype", DTYPES)
@each("name", ["dempster", "yager", "cumulative", "averaging", "weighted"])
def test_rounding_does_not_leave_the_simplex_in_hundreds_of_steps(name: str, dtype: Any) -> None:
    rng = np.random.default_rng(3)
    state = np.zeros((20, 2), dtype)
    for _ in range(300):
        scan = rng.dirichlet([0.3, 0.3, 0.3], 20).astype(dtype)[:, :2]
        scan[rng.random(20) < 0.1] = (1, 0)
        state = rule(name)(state, scan)
    evidence.check_mass(state)


@each("name", RULES)
def test_rules_take_views_and_single_masses_and_change_no_argument(name: str) -> None:
    combine, open_world = rule(name), RULES[name].open_world
    a, b = np.random.default_rng(0).dirichlet([1, 1, 1, 1], (2, 4, 5))[..., :2]
    before, expected = (a.copy(), b.copy()), combine(a, b)
    np.testing.assert_allclose(combine(a[::-1], b[::-1])[::-1], expected, atol=1e-15)
    np.testing.assert_allclose(combine(np.asfortranarray(a), np.asfortranarray(b)), expected, atol=1e-15)
    np.testing.assert_allclose(combine(a, b[0, 0]), combine(a, np.broadcast_to(b[0, 0], a.shape)), atol=1e-15)
    np.testing.assert_array_equal((a, b), before)
    assert open_world or not combine(VACUOUS, VACUOUS).any()
