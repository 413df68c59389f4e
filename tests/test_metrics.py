"""Evaluations of models over samples, and paired comparisons."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from ogm.grid import EvidentialGrid, GridSpec
from ogm.metrics import (
    METRICS,
    accumulate,
    bootstrap_mean,
    bootstrap_ratio,
    evaluate,
    model_for,
    paired,
    resample_to,
    score,
)
from ogm.state import Truth

SPEC = GridSpec.centered(length=7, width=7, resolution=1)


def random_grid(seed: int, shape: tuple[int, ...] = (7, 7)) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Masses of all kinds, also vacuous and nearly dogmatic ones, and states."""
    rng = np.random.default_rng(seed)
    evidence = rng.gamma(0.3, 20, (*shape, 2)) * (rng.random((*shape, 2)) < 0.8)
    mass = (evidence / (evidence.sum(axis=-1, keepdims=True) + 2)).astype(np.float32)
    return mass, rng.choice(4, size=shape, p=[0.4, 0.3, 0.2, 0.1]).astype(np.uint8)


# Pairs of models


def test_wins_ties_and_losses_are_counted_in_the_better_direction() -> None:
    rng = np.random.default_rng(0)
    a, b = np.array([1.0, 2.0, 3.0, np.nan, 5.0]), np.array([2.0, 2.0, 2.0, 1.0, 6.0])
    one = paired(a, b, "lower", rng)
    assert (one.frames, one.wins, one.ties, one.losses) == (4, 2, 1, 1)
    other = paired(a, b, "higher", rng)
    assert (other.wins, other.ties, other.losses) == (1, 1, 2)
    assert one.difference.value == pytest.approx(-0.25)
    assert one.ratio.value == pytest.approx(11 / 12)
    of_many = paired(np.tile(a, 3), np.tile(b, 3), "lower", rng).ratio
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
        paired([1.0], [1.0, 2.0], "lower", rng)
    with pytest.raises(ValueError, match='better must be "lower" or "higher"'):
        paired([1.0], [1.0], "", rng)
    with pytest.raises(ValueError, match="resamples must be at least 1"):
        bootstrap_mean([1.0], rng, resamples=0)


# Models over samples


@dataclass
class Scan:
    """A sample: its points say how much mass of free to give to all cells."""

    points: NDArray[np.float32]
    truth: Truth
    T_vehicle_sensor: NDArray[np.float64]


@dataclass
class Flat:
    """A model that calls all cells free, with a mass that grows with the points and its height."""

    spec: GridSpec
    height: float = 1.0

    def __call__(self, points: NDArray[np.float32]) -> EvidentialGrid:
        mass = np.zeros((*self.spec.shape, 2), np.float32)
        mass[..., 0] = len(points) * self.height / 100
        return EvidentialGrid(self.spec, mass)


def scans() -> list[Scan]:
    wide = GridSpec.centered(length=9, width=9, resolution=1)
    result = []
    for k, height in enumerate((1.0, 2.0, 1.0)):
        T = np.eye(4)
        T[:3, 3] = [0.4, 0.1 * k, height]
        _, state = random_grid(20 + k, wide.shape)
        result.append(Scan(np.zeros((10 * (k + 1), 4), np.float32), Truth(wide, state), T))
    return result


def test_evaluation_has_every_model_in_every_frame() -> None:
    samples = scans()
    result = evaluate({"flat": Flat(SPEC), "high": Flat(SPEC, 3.0)}, samples)
    assert (result.models, result.frames, result.spec) == (("flat", "high"), 3, SPEC)
    for k, sample in enumerate(samples):
        state = sample.truth.crop(SPEC).state
        expected = score(accumulate(Flat(SPEC, 3.0)(sample.points).mass, state))
        assert {m: result.of("high", m)[k] for m in METRICS} == pytest.approx(expected, nan_ok=True)
        np.testing.assert_allclose(result.truth[k], np.bincount(state.ravel(), minlength=4) / 49)
    np.testing.assert_allclose(result.of("flat", "mean_free"), [0.1, 0.2, 0.3], rtol=1e-6)
    assert result.macro("flat")["mean_free"] == pytest.approx(0.2)
    assert result.micro("flat")["mean_free"] == pytest.approx(
        (result.of("flat", "mean_free") @ (1 - result.truth[:, 3])) / (1 - result.truth[:, 3]).sum()
    )


def test_comparison_says_who_wins() -> None:
    result = evaluate({"flat": Flat(SPEC), "high": Flat(SPEC, 3.0)}, scans())
    compared = result.compare("high", "flat", np.random.default_rng(0))
    assert set(compared) == {name for name, metric in METRICS.items() if metric.better}
    assert (compared["false_free"].wins, compared["false_free"].ties, compared["false_free"].losses) == (
        0,
        1,
        2,
    )
    assert result.interval("high", "kl_e10", np.random.default_rng(0)).value == result.macro("high")["kl_e10"]
    with pytest.raises(KeyError, match="no model 'deep' here, only flat, high"):
        result.of("deep", "ece")
    with pytest.raises(KeyError, match="no metric 'iou'"):
        result.of("flat", "iou")


def test_a_model_is_made_for_every_change_of_the_mount_without_its_shift() -> None:
    seen = []

    def model(T: NDArray[np.float64]) -> Flat:
        seen.append(T)
        return Flat(SPEC, T[2, 3])

    samples = scans()
    result = evaluate({"flat": model}, [samples[0], *samples])
    assert [T[:3, 3].tolist() for T in seen] == [[0, 0, 1], [0, 0, 2], [0, 0, 1]]
    np.testing.assert_allclose(result.of("flat", "mean_free"), [0.1, 0.1, 0.4, 0.3], rtol=1e-6)
    assert samples[1].T_vehicle_sensor[0, 3] == 0.4
    assert model_for(model, samples[1]).height == 2.0


def test_coarser_cells_of_the_same_area_are_repeated() -> None:
    coarse = GridSpec.centered(length=8, width=4, resolution=2)
    mass = np.random.default_rng(0).dirichlet([1, 1, 1], coarse.shape)[..., :2].astype(np.float32)
    fine = resample_to(EvidentialGrid(coarse, mass), coarse.refined(2))
    assert fine.spec == coarse.refined(2)
    for ix, iy in np.ndindex(8, 4):
        assert fine.mass[ix, iy].tolist() == mass[ix // 2, iy // 2].tolist()
    assert resample_to(fine, fine.spec) is fine


@pytest.mark.parametrize(
    "spec",
    [
        GridSpec.centered(length=8, width=8, resolution=1),
        GridSpec.centered(length=6, width=6, resolution=1),
        GridSpec.centered(length=7, width=7, resolution=1, center=(1, 0)),
        GridSpec.centered(length=7, width=7, resolution=7),
    ],
)
def test_grids_of_other_areas_are_refused_and_both_are_named(spec: GridSpec) -> None:
    with pytest.raises(ValueError, match=r"7 x 7 cells of 1 m over .*, but judged are .* cells of"):
        resample_to(Flat(SPEC)(np.zeros((0, 4), np.float32)), spec)


def test_nothing_to_judge_is_told() -> None:
    with pytest.raises(ValueError, match="no models to judge"):
        evaluate({}, scans())
    with pytest.raises(ValueError, match="no samples to judge"):
        evaluate({"flat": Flat(SPEC)}, [])
