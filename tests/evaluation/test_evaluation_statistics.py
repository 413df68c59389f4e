"""Evaluations from sums, bootstrap intervals and paired comparisons over frames."""

import numpy as np
import pytest
from scipy import stats

from ogm.evaluation import Evaluation, FrameInfo, bootstrap_mean, bootstrap_ratio, compare_paired
from ogm.grid import GridSpec
from ogm.metrics import ConfusionSums, accumulate, score

SPEC = GridSpec.centered(length=7, width=7, resolution=1)
EVEN = np.full(4, 0.25)


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


def test_wilcoxon_is_that_of_scipy_and_leaves_ties_out() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(0, 1, 30), rng.normal(0.3, 1, 30)
    for better in ("lower", "higher"):
        assert compare_paired(a, b, better, rng).p == pytest.approx(stats.wilcoxon(a, b).pvalue)
    equal = np.concatenate([a, np.arange(5)]), np.concatenate([b, np.arange(5)])
    assert compare_paired(*equal, "lower", rng).p == pytest.approx(stats.wilcoxon(a, b).pvalue)


@pytest.mark.parametrize("frames", [1, 4, 8])
def test_wilcoxon_of_wins_alone_is_the_chance_of_a_coin(frames: int) -> None:
    rng = np.random.default_rng(1)
    gains = 1 + np.arange(frames)
    assert compare_paired(gains, np.zeros(frames), "higher", rng).p == pytest.approx(2 / 2**frames)


def test_wilcoxon_without_a_difference_is_nan() -> None:
    rng = np.random.default_rng(2)
    assert np.isnan(compare_paired([1.0, 2.0], [1.0, 2.0], "lower", rng).p)
    assert np.isnan(compare_paired([np.nan], [1.0], "lower", rng).p)


def test_of_few_frames_the_interval_is_too_narrow_and_p_is_not() -> None:
    """Without any difference one interval of seven leaves out zero at six frames, as docs/evaluation.md has it."""
    rng = np.random.default_rng(8)
    nothing = np.zeros(6)
    found = [compare_paired(rng.normal(0, 1, 6), nothing, "higher", rng, 400) for _ in range(800)]
    out = np.array([one.difference.low > 0 or one.difference.high < 0 for one in found])
    small = np.array([one.p < 0.05 for one in found])
    assert pytest.approx(out.mean(), abs=0.03) == 1 / 7
    assert (out & small).mean() < 0.06


def test_drives_are_drawn_whole() -> None:
    """Frames that repeat their drive's value tell no more than one frame per drive."""
    rng = np.random.default_rng(3)
    drives = rng.normal(0, 1, 20)
    groups = np.repeat([f"drive {k}" for k in range(20)], 30)
    alone = bootstrap_mean(drives, np.random.default_rng(4))
    whole = bootstrap_mean(np.repeat(drives, 30), np.random.default_rng(4), groups=list(groups))
    frames = bootstrap_mean(np.repeat(drives, 30), np.random.default_rng(4))
    # drives are sorted by name, so that it is the same draw of other drives: the widths agree, not the ends
    assert whole.value == pytest.approx(alone.value)
    assert whole.high - whole.low == pytest.approx(alone.high - alone.low, rel=0.1)
    assert frames.high - frames.low < 0.3 * (whole.high - whole.low)


def test_ratios_over_drives_weigh_their_frames() -> None:
    a, b = np.array([1.0, 2.0, 3.0, np.nan]), np.array([2.0, 2.0, 2.0, 5.0])
    five = [f"{letter}{drive}" for drive in range(5) for letter in ("x", "x", "y", "y")]
    found = bootstrap_ratio(np.tile(a, 5), np.tile(b, 5), np.random.default_rng(5), groups=five)
    assert found.value == pytest.approx(1.0)
    assert 0.75 <= found.low < 1.0 < found.high <= 1.5  # of drives of one kind alone it is 3 / 4 and 3 / 2


def test_few_frames_or_drives_have_no_interval() -> None:
    rng = np.random.default_rng(6)
    values = [3.0, 2.0, 4.0, 3.0, 3.0]
    for one in (bootstrap_mean(values[:4], rng), bootstrap_mean(values * 4, rng, groups=list("abcd") * 5)):
        assert one.value == 3.0
        assert np.isnan([one.low, one.high]).all()
    assert bootstrap_mean(values, rng).low < 3.0 < bootstrap_mean(values, rng).high


def test_groups_are_one_per_frame() -> None:
    rng = np.random.default_rng(7)
    with pytest.raises(ValueError, match="groups must name the drive of each of 2 frames, got 1"):
        bootstrap_mean([1.0, 2.0], rng, groups=["a"])
    with pytest.raises(ValueError, match="groups must name"):
        compare_paired([1.0, 2.0], [1.0, 2.0], "lower", rng, groups=["a"])


def test_wins_ties_and_losses_are_counted_in_the_better_direction() -> None:
    rng = np.random.default_rng(0)
    a, b = np.array([1.0, 2.0, 3.0, np.nan, 5.0]), np.array([2.0, 2.0, 2.0, 1.0, 6.0])
    one = compare_paired(a, b, "lower", rng)
    assert (one.frames, one.wins, one.ties, one.losses) == (4, 2, 1, 1)
    other = compare_paired(a, b, "higher", rng)
    assert (other.wins, other.ties, other.losses) == (1, 1, 2)
    assert one.difference.value == pytest.approx(-0.25)
    assert one.ratio.value == pytest.approx(11 / 12)
    of_many = compare_paired(np.tile(a, 3), np.tile(b, 3), "lower", rng).ratio
    assert of_many.low < 11 / 12 < of_many.high


def test_bootstrap_finds_the_standard_error() -> None:
    rng = np.random.default_rng(1)
    values = rng.normal(3.0, 1.0, 400)
    interval = bootstrap_mean(values, rng)
    assert interval.value == pytest.approx(values.mean())
    assert interval.high - interval.low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.1)


def test_bootstrap_is_paired_and_repeats_with_its_seed() -> None:
    values = np.random.default_rng(2).gamma(1.0, 1.0, 50)
    exact = bootstrap_ratio(0.4 * values, values, np.random.default_rng(3))
    assert exact == pytest.approx((0.4, 0.4, 0.4))
    one, again = (bootstrap_mean(values, np.random.default_rng(4)) for _ in range(2))
    assert one == again


def test_bootstrap_without_values_is_nan() -> None:
    rng = np.random.default_rng(5)
    assert np.isnan(bootstrap_mean(np.full(3, np.nan), rng)).all()
    assert np.isnan(bootstrap_ratio([1.0, 2.0], [0.0, 0.0], rng)).all()
    with pytest.raises(ValueError, match="one value per frame"):
        compare_paired([1.0], [1.0, 2.0], "lower", rng)
    with pytest.raises(ValueError, match='better must be "lower" or "higher"'):
        compare_paired([1.0], [1.0], "", rng)
    with pytest.raises(ValueError, match="resamples must be at least 1"):
        bootstrap_mean([1.0], rng, resamples=0)
