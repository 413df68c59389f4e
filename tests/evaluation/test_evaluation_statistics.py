"""Evaluations from sums, intervals over drives and paired comparisons."""

import math
from itertools import product
from typing import Any

import numpy as np
import pytest
from cases import each, refused

from ogm.evaluation import Evaluation, FrameInfo, compare_paired, mean_interval, ratio_interval
from ogm.grid import GridSpec
from ogm.metrics import ConfusionSums, accumulate, score

SPEC = GridSpec.centered(length=7, width=7, resolution=1)
EVEN = np.full(4, 0.25)
SHAPES = {  # distributions of the values of a metric, of scipy.stats
    "normal": ("norm", 10),
    "share, mean 0.2": ("beta", 2, 8),
    "share, mean 0.1": ("beta", 1, 9),
    "share, mean 0.95": ("beta", 19, 1),
    "error, lognormal": ("lognorm", 0.7),
}
ALIKE = ((0.2, 0.8), (0.7, 0.5))  # share of the variance between drives, correlation of neighbours within one
CASES = [  # drives, frames of a drive, shape, share between drives, correlation
    *((drives, (10, 100), shape, *alike) for drives, shape, alike in product((5, 12, 24), SHAPES, ALIKE)),
    *((1, (n, n), shape, 0.0, lag) for n, shape, (_, lag) in product((100, 200), SHAPES, ALIKE)),
]


def sums(frames: int, methods: int = 2) -> list[list[ConfusionSums]]:
    return [[one_frame(10 * k + m) for m in range(methods)] for k in range(frames)]


def one_frame(seed: int) -> ConfusionSums:
    """Return the sums of random masses and states."""
    rng = np.random.default_rng(seed)
    mass = rng.dirichlet((1, 1, 1), SPEC.shape)[..., :2].astype(np.float32)
    return accumulate(mass, rng.integers(0, 4, SPEC.shape).astype(np.uint8))


def test_an_evaluation_is_its_frames_scores_and_their_sums() -> None:
    rows = sums(3)
    result = Evaluation.from_sums(["a", "b"], SPEC, ((row, EVEN) for row in rows), map(FrameInfo, "123"))
    assert (result.methods, result.spec, len(result.frames)) == (("a", "b"), SPEC, 3)
    for m, name in enumerate("ab"):
        for k in range(3):
            assert score(rows[k][m])["kl_e10"] == result.of(name, "kl_e10")[k]
        together = rows[0][m].plus(rows[1][m]).plus(rows[2][m])
        assert result.micro(name) == pytest.approx(score(together), nan_ok=True)
    assert result.truth.tolist() == [[0.25] * 4] * 3


def test_frames_of_a_drive_are_grouped_and_others_stand_alone() -> None:
    infos = [FrameInfo("1", "north"), FrameInfo("2", "north"), FrameInfo("3"), FrameInfo("4"), FrameInfo("5")]
    result = Evaluation.from_sums(["a"], SPEC, ((row, EVEN) for row in sums(5, 1)), infos)
    assert result.drives == ["north", "north", "frame 2", "frame 3", "frame 4"]
    assert result.interval("a", "brier") == mean_interval(result.of("a", "brier"), list("nnabc"))
    rows = Evaluation.from_sums(["a", "b"], SPEC, ((row, EVEN) for row in sums(5)), infos)
    paired = compare_paired(rows.of("b", "brier"), rows.of("a", "brier"), "lower", list("nnabc"))
    assert rows.compare("b", "a")["brier"] == paired


# --- Coverage ---------------------------------------------------------------------------------------


def distribution(shape: str) -> Any:
    from scipy import stats

    name, *parameters = SHAPES[shape]
    return getattr(stats, name)(*parameters)


def two_methods(case: tuple, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return values of two equally good methods, (2, frames), and the drive of each frame."""
    from scipy.stats import norm

    drives, (low, high), shape, between, lag = case
    apart = np.abs(np.subtract.outer(np.arange(high), np.arange(high)))
    root = np.linalg.cholesky(between + (1 - between) * lag**apart)  # of the covariance of a drive's frames
    normal = rng.standard_normal((2, drives, high)) @ root.T
    normal[1] = 0.8 * normal[0] + 0.6 * normal[1]
    drive, frame = np.nonzero(np.arange(high) < rng.integers(low, high + 1, drives)[:, None])
    return distribution(shape).ppf(norm.cdf(normal[:, drive, frame])), drive


def assert_covers(case: tuple, repeats: int) -> None:
    """Check that 93 to 97 % of the intervals hold the truth, and 3 to 7 % of p are small, but for chance."""
    from scipy.stats import norm

    rng, truth, held = np.random.default_rng(0), distribution(case[2]).mean(), []
    for _ in range(repeats):
        (a, b), drives = two_methods(case, rng)
        mean, alone, pair = mean_interval(a, drives), mean_interval(a), compare_paired(a, b, "lower", drives)
        holds = [one.low <= right <= one.high for one, right in ((mean, truth), (pair.ratio, 1.0), (alone, truth))]
        held.append([*holds, pair.p < 0.05])
    chance = norm.ppf(0.999) * np.sqrt(0.05 * 0.95 / repeats)
    of_mean, of_ratio, as_independent, small = np.mean(held, axis=0)
    for share in (of_mean, of_ratio):
        assert 0.93 - chance < share < 0.97 + chance, (case, share)
    assert 0.03 - chance < small < 0.07 + chance, (case, small)
    assert as_independent < 0.9, (case, as_independent)


def test_intervals_over_drives_hold_the_truth_as_often_as_they_promise() -> None:
    assert_covers((12, (10, 100), "share, mean 0.1", 0.4, 0.7), 400)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=str)
def test_intervals_hold_the_truth_whatever_the_metric(case: tuple) -> None:
    assert_covers(case, 4000)


# --- Laws -------------------------------------------------------------------------------------------


def test_independent_frames_of_a_normal_metric_have_the_interval_of_the_textbook() -> None:
    values = np.random.default_rng(1).normal(-3.0, 1.0, 40)
    from scipy import stats

    expected = stats.t.interval(0.95, 39, values.mean(), stats.sem(values))
    assert mean_interval(values) == pytest.approx((values.mean(), *expected))
    other = np.random.default_rng(2).normal(-3.2, 1.0, 40)
    assert compare_paired(values, other, "lower").p == pytest.approx(stats.ttest_rel(values, other).pvalue)


def test_drives_count_and_not_their_frames() -> None:
    """Frames that repeat their drive's value tell no more than one frame per drive."""
    values = np.random.default_rng(3).normal(0, 1, 20)
    names = [f"drive {k}" for k in range(20)]
    repeated, drives = np.repeat(values, 30), [name for name in names for _ in range(30)]
    alone = mean_interval(values)
    assert mean_interval(repeated, drives) == pytest.approx(alone)
    assert mean_interval(repeated).high - mean_interval(repeated).low < 0.3 * (alone.high - alone.low)
    shuffled = np.random.default_rng(4).permutation(600)
    assert mean_interval(repeated[shuffled], np.array(drives)[shuffled]) == pytest.approx(alone)


def test_one_drive_that_has_nearly_all_frames_makes_the_interval_wider() -> None:
    values = np.random.default_rng(5).normal(0.5, 0.1, 6)
    even = mean_interval(np.repeat(values, 10), np.repeat(np.arange(6), 10))
    lengths = [10, 10, 10, 10, 10, 100]
    uneven = mean_interval(np.repeat(values, lengths), np.repeat(np.arange(6), lengths))
    assert uneven.high - uneven.low > 1.5 * (even.high - even.low)


def test_limits_of_shares_and_errors_stay_where_values_can_be() -> None:
    shares = np.array([0.0, 0.0, 0.001, 0.0, 0.04, 0.0])
    low, high = mean_interval(shares)[1:]
    assert 0 < low < shares.mean() < high < 1
    mirrored = mean_interval(1 - shares)
    assert (1 - mirrored.high, 1 - mirrored.low) == pytest.approx((low, high))
    errors = 30 * shares
    assert mean_interval(errors).low > 0
    a, b = np.array([[1.0, 2.0, 3.0, 5.0], [2.0, 2.0, 4.0, 5.0]])
    there, back = ratio_interval(a, b), ratio_interval(b, a)
    assert (1 / back.high, 1 / back.low) == pytest.approx(there[1:])


def test_the_interval_of_a_difference_and_p_agree() -> None:
    rng = np.random.default_rng(6)
    agreed = set()
    for _ in range(50):
        one = compare_paired(rng.normal(0.5, 1, 12), rng.normal(0, 1, 12), "lower", list("aabbccddeeff"))
        apart = one.difference.low > 0 or one.difference.high < 0
        assert apart == (one.p < 0.05)
        agreed.add(apart)
    assert agreed == {True, False}


def test_ratios_weigh_frames() -> None:
    a, b = np.array([1.0, 2.0, 3.0, np.nan]), np.array([2.0, 2.0, 2.0, 5.0])
    drives = [f"{letter}{drive}" for drive in range(5) for letter in ("x", "x", "y", "y")]
    found = ratio_interval(np.tile(a, 5), np.tile(b, 5), drives)
    assert found.value == pytest.approx(1.0)
    assert 0.75 < found.low < 1.0 < found.high < 1.5  # of drives of one kind alone it is 3 / 4 and 3 / 2


@each("kind", ["errors", "differences", "shares"])
def test_the_interval_of_a_ratio_is_that_of_a_jackknife_over_uneven_drives(kind: str) -> None:
    """Written out: one drive less at a time, on logarithms, as they are, or on log-odds."""
    from scipy.stats import t

    rng, drives = np.random.default_rng(10), np.array(list("aaabbbbbccddddddddeeeeffffff"))
    first, second = rng.gamma(2.0, 1.0, (2, len(drives)))
    there, back = math.log, math.exp
    if kind == "differences":
        first -= 1.5
        there = back = float
    elif kind == "shares":
        first, second = rng.uniform(0.0, 0.4, len(drives)), np.ones(len(drives))
        there, back = (lambda p: math.log(p / (1 - p))), (lambda z: 1 / (1 + math.exp(-z)))
    without = [there(first[drives != one].sum() / second[drives != one].sum()) for one in "abcdef"]
    middle = sum(without) / 6
    error = math.sqrt(5 / 6 * sum((value - middle) ** 2 for value in without))
    effective = len(drives) ** 2 / sum((drives == one).sum() ** 2 for one in "abcdef")
    reach = t.ppf(0.975, effective - 1) * error
    value = first.sum() / second.sum()
    expected = value, back(there(value) - reach), back(there(value) + reach)
    assert ratio_interval(first, second, drives) == pytest.approx(expected)
    gaps = np.where(rng.random(40) < 0.5, np.nan, 1.0)  # frames that lack one of the two count for nothing
    more = [np.concatenate(pair) for pair in ((first, gaps), (second, gaps * np.nan), (drives, ["g"] * 40))]
    assert ratio_interval(*more) == pytest.approx(expected)


def test_wins_ties_and_losses_are_counted_in_the_better_direction() -> None:
    a, b = np.array([1.0, 2.0, 3.0, np.nan, 5.0]), np.array([2.0, 2.0, 2.0, 1.0, 6.0])
    one = compare_paired(a, b, "lower")
    assert (one.frames, one.wins, one.ties, one.losses) == (4, 2, 1, 1)
    other = compare_paired(a, b, "higher")
    assert (other.wins, other.ties, other.losses) == (1, 1, 2)
    assert one.difference.value == pytest.approx(-0.25)
    assert one.ratio.value == pytest.approx(11 / 12)


# --- Without limits ---------------------------------------------------------------------------------


@each("drives", [["one"] * 99, ["one"] * 60 + ["two"] * 60, list("abc") * 40, ["a"] * 200 + list("bcd")])
def test_few_drives_have_no_interval(drives: list[str]) -> None:
    values = np.random.default_rng(7).uniform(size=len(drives))
    one = compare_paired(values, values[::-1], "lower", drives)
    for found in (mean_interval(values, drives), one.difference, one.ratio):
        assert np.isfinite(found.value)
        assert np.isnan(found[1:]).all()
    assert np.isnan(one.p)


def test_four_drives_or_a_hundred_frames_of_one_have_an_interval() -> None:
    values = np.random.default_rng(8).uniform(size=100)
    for found in (mean_interval(values, ["one"] * 100), mean_interval(values, list("abcd") * 25)):
        assert found.low < found.value < found.high


def test_a_value_that_rests_on_one_drive_has_no_limits() -> None:
    found = mean_interval([0.0, 0.0, 0.0, 0.0, 0.3])
    assert found.value == pytest.approx(0.06)
    assert np.isnan(found[1:]).all()


def test_without_spread_the_limits_are_the_value() -> None:
    values = np.random.default_rng(9).gamma(1.0, 1.0, 50)
    assert ratio_interval(0.4 * values, values) == pytest.approx((0.4, 0.4, 0.4))
    assert mean_interval(np.zeros(8)) == (0.0, 0.0, 0.0)
    assert compare_paired(values + 1, values, "lower").p == 0.0
    equal = compare_paired(values, values, "lower")
    assert (equal.ties, equal.difference.value) == (50, 0.0)
    assert np.isnan(equal.p)


def test_without_values_all_is_nan() -> None:
    assert np.isnan(mean_interval(np.full(3, np.nan))).all()
    assert np.isnan(ratio_interval([1.0, 2.0], [0.0, 0.0])).all()
    none = compare_paired([np.nan], [1.0], "lower")
    assert none.frames == 0
    assert np.isnan([*none.difference, *none.ratio, none.p]).all()


def test_unfit_arguments_are_refused() -> None:
    refused("one value per frame", compare_paired, [1.0], [1.0, 2.0], "lower")
    refused('better must be "lower" or "higher"', compare_paired, [1.0], [1.0], "")
    message = "drives must have a name for each of 2 frames, got 1"
    refused(message, mean_interval, [1.0, 2.0], ["a"])
    refused("drives must have a name", compare_paired, [1.0, 2.0], [1.0, 2.0], "lower", ["a"])
