"""The scores against their definitions in plain Python, cell by cell and threshold by threshold."""

import numpy as np
import pytest
from cases import each
from hypothesis import given, settings
from hypothesis import strategies as st
from plain import FREE, IGNORE, OCCUPIED, UNKNOWN, lattice_grid, plain_scores

from ogm.metrics import METRICS, accumulate, counting, counts, divergence, score

COUNTED_ELSEWHERE = {
    "iou_free", "iou_occupied", "iou_unknown", "iou_free_known", "iou_occupied_known", "ece_called", "legacy_accuracy",
    *(name for name in METRICS if name.startswith("from")),
}  # fmt: skip


def check(mass: np.ndarray, state: np.ndarray) -> None:
    found, wanted = score(accumulate(mass, state)), plain_scores(mass, state)
    assert set(wanted) == set(METRICS) - COUNTED_ELSEWHERE
    for name, value in wanted.items():
        near = 1e-4 if name in ("aurc", "ause") else 1e-7
        assert found[name] == pytest.approx(value, rel=near, abs=near, nan_ok=True), name


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31), coarse=st.sampled_from([1, 64, 512]))
def test_scores_are_their_definitions(seed: int, coarse: int) -> None:
    check(*lattice_grid(seed, coarse=coarse))


@each("states", [(UNKNOWN,), (FREE,), (OCCUPIED,), (UNKNOWN, OCCUPIED), (FREE, OCCUPIED), (IGNORE,)])
def test_scores_are_their_definitions_where_states_are_missing(states: tuple[int, ...]) -> None:
    mass, _ = lattice_grid(1, coarse=64)
    check(mass, np.resize(np.array(states, np.uint8), (7, 7)))


@each(("free", "occupied"), [(0, 0), (1, 0), (0, 1), (0.5, 0.5), (0.25, 0.25)])
def test_scores_are_their_definitions_where_all_cells_are_alike(free: float, occupied: float) -> None:
    _, state = lattice_grid(2)
    check(np.full((7, 7, 2), [free, occupied], np.float32), state)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31), highest=st.sampled_from([8, 30, 200]))
def test_scores_without_low_obstacles_are_those_of_a_truth_that_ignores_them(seed: int, highest: int) -> None:
    mass, state = lattice_grid(seed)
    height = np.random.default_rng(seed).integers(5, highest + 1, state.shape).astype(np.uint8)
    found = score(accumulate(mass, state, None, height))
    for least in (10, 50):
        low = (state == OCCUPIED) & (height < least)
        wanted = score(accumulate(mass, np.where(low, np.uint8(IGNORE), state)))
        for name in ("iou_free", "iou_occupied", "false_free", "missed_occupied"):
            value = wanted[name] if ((state == OCCUPIED) & ~low).any() else np.nan
            assert found[f"from{least}_{name}"] == pytest.approx(value, nan_ok=True), (least, name)


@pytest.mark.skipif(not hasattr(counting.count_cells, "py_func"), reason="numba's compiler is switched off")
def test_scores_are_the_same_without_the_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    mass, state = lattice_grid(3, coarse=64)
    away = np.random.default_rng(0).uniform(0, 60, state.shape).astype(np.float32)
    compiled = accumulate(mass, state, away)
    for module, name in (
        (divergence, "_look_up"),
        (divergence, "_sum_divergences"),
        (counting, "nearest_level"),
        (counting, "_predicted"),
    ):
        monkeypatch.setattr(module, name, getattr(module, name).py_func)
    for name in ("count_cells", "count_neighbours", "count_ranges"):
        monkeypatch.setattr(counts, name, getattr(counting, name).py_func)
    for one, other in zip(compiled, accumulate(mass, state, away), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-9)
