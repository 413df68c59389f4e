"""Pillars: every point in its cell, with its features; the kernel and its slow reference agree."""

import logging
from typing import Any

import numpy as np
import pytest
import torch
from cases import each, refused
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ogm.deep import points as module
from ogm.deep.network import NetworkConfig, PillarNetwork
from ogm.deep.pillars import Pillars, cap_pillars, collate, pillarize, pillarize_torch
from ogm.deep.torch_engine import fused
from ogm.grid import GridSpec

SPEC = GridSpec.centered(length=10.24, width=5.12, resolution=0.16)  # 64 x 32 cells
CELLS = SPEC.shape[0] * SPEC.shape[1]
Z = (-1.2, 2.8)  # neither is a float32
EGO = (-0.7, 1.1, -0.3, 0.3)

edges = st.integers(-34, 34).map(lambda k: float(np.float32(k * 0.16)))
limits = st.sampled_from([float(np.float32(v)) for v in (*Z, *EGO)])
odd = st.sampled_from([float(np.float32(v)) for v in ("nan", "inf", "-inf", 1e30, -1e30, 3e38, 1e-40, -0.0)])
numbers = st.one_of(st.floats(-6, 6, width=32), edges, limits, odd)
clouds = st.integers(0, 40).flatmap(lambda n: arrays(np.float32, (n, 4), elements=numbers))


def scan(n: int, seed: int = 0, size: float = 1.0) -> np.ndarray:
    """Give points in and around a part of the grid; some cells have many."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-6, -3, -2, 0), (6, 3, 3, 1), (n, 4))
    points[:, :2] *= size
    return points.astype(np.float32)


def same(one: Pillars, other: Pillars, atol: float = 2e-5) -> None:
    for a, b in zip(one[:3], other[:3], strict=True):
        assert a.dtype == b.dtype
    np.testing.assert_array_equal(one.cells, other.cells)
    np.testing.assert_array_equal(one.lengths, other.lengths)
    np.testing.assert_allclose(one.features, other.features, rtol=0, atol=atol)
    assert one.batch == other.batch


@given(clouds)
@example(np.float32([[0.3, 0.3, z, 0.5] for z in Z]))  # on the limits of height
@example(np.float32([[x, y, 1, 0.5] for x in EGO[:2] for y in (0, *EGO[2:])]))  # the ego outline
@example(np.float32([[x, y, 0, 0] for x in (-5.12, 5.12, 0) for y in (-2.56, 2.56, 0)]))  # on the grid's
@settings(deadline=None, max_examples=80)
def test_the_kernel_is_its_reference(points: np.ndarray) -> None:
    same(pillarize(points, SPEC, Z, EGO), pillarize_torch(torch.from_numpy(points), SPEC, Z, EGO))


@each("size", [1.0, 0.1, 0.001])
def test_the_kernel_is_its_reference_with_a_transform(size: float) -> None:
    points = scan(5000, size=size)
    T = np.eye(4)
    T[:2, :2] = [[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]]
    T[:3, 3] = (0.513, -0.217, 1.83)
    fast = pillarize(points, SPEC, Z, T=T)
    same(fast, pillarize_torch(torch.from_numpy(points), SPEC, Z, T=torch.from_numpy(T).float()))
    assert len(fast.features) > 1000


def test_the_kernels_give_the_same_without_the_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    points = scan(300, size=0.3)
    points[::50, 1] = np.nan
    fast = pillarize(points, SPEC, Z, EGO)
    for name in ("_find_cells", "_sort_by_cell", "_add_offsets"):
        monkeypatch.setattr(module, name, getattr(module, name).py_func)
    same(fast, pillarize(points, SPEC, Z, EGO))


@each("compiled", [True, False])
@each("n", [0, 1, 2000])
def test_the_feature_map_is_the_networks(n: int, compiled: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernel of inference against the layers of training: linear, ReLU, the largest of each pillar."""
    if not compiled:
        monkeypatch.setattr(module, "_fill_maxima", module._fill_maxima.py_func)
        n = min(n, 200)
    torch.manual_seed(0)
    network = fused(PillarNetwork(NetworkConfig(6, ((8, 1),), join="concatenate", up=8), SPEC))
    network.pillar.linear.bias.data.uniform_(-1, 1)
    points = scan(n, size=0.5)
    with torch.inference_mode():
        wanted = network.feature_map(pillarize(points, SPEC, Z)).permute(0, 2, 3, 1)
    weight, bias = (value.detach().numpy() for value in (network.pillar.linear.weight.T, network.pillar.linear.bias))
    sorted_points = module.sort_points(points, SPEC, Z)
    found = module.pillar_maxima(sorted_points, np.ascontiguousarray(weight), bias, SPEC.shape, 8)
    np.testing.assert_allclose(found[..., :6], wanted, rtol=1e-5, atol=1e-5)
    assert not found[..., 6:].any()  # room for other channels


def test_one_point_by_hand() -> None:
    point = np.float32([[0.5, -0.9, 0.3, 0.25]])  # cell: floor(5.62 / 0.16) = 35, floor(1.66 / 0.16) = 10
    pillars = pillarize(point, SPEC)
    assert pillars.cells.tolist() == [35 * 32 + 10]
    assert pillars.lengths.tolist() == [1]
    middle = (35.5 * 0.16 - 5.12, 10.5 * 0.16 - 2.56)
    wanted = [0.5, -0.9, 0.3, 0.25, 0, 0, 0, 0.5 - middle[0], -0.9 - middle[1]]
    np.testing.assert_allclose(pillars.features.numpy(), [wanted], atol=1e-6)


def test_every_point_stands_in_its_cell() -> None:
    points = scan(4000)
    pillars = pillarize(points, SPEC, Z)
    features, lengths, cells, batch = pillars[:4]
    inside = (np.abs(points[:, 0]) < 5.12) & (np.abs(points[:, 1]) < 2.56)
    inside &= (points[:, 2] >= Z[0]) & (points[:, 2] < Z[1])
    assert len(features) == lengths.sum() == inside.sum()
    assert features.dtype == torch.float32
    assert lengths.dtype == cells.dtype == torch.int64
    assert batch == 1
    assert (cells.diff() > 0).all()  # ascending, and no cell twice
    assert lengths.min() >= 1
    assert features[:, 7:].abs().max() <= 0.08 + 1e-6
    for part in features.split(lengths.tolist()):
        np.testing.assert_allclose(part[:, 4:7].sum(0), 0, atol=1e-4)


def test_half_a_turn_of_the_points_is_half_a_turn_of_the_pillars() -> None:
    points = scan(3000, size=0.4)
    there = pillarize(points, SPEC)
    turned = pillarize((points * np.float32([-1, -1, 1, 1]))[::-1], SPEC)
    np.testing.assert_array_equal(turned.cells.flip(0), CELLS - 1 - there.cells)
    np.testing.assert_array_equal(turned.lengths.flip(0), there.lengths)
    signs = torch.tensor([-1, -1, 1, 1, -1, -1, 1, -1, -1])
    np.testing.assert_allclose(turned.features.flip(0) * signs, there.features, atol=2e-6)


def test_a_transform_of_the_grid_moves_pillars_by_whole_cells() -> None:
    points = scan(1000, size=0.5)
    T = np.eye(4)
    T[:2, 3] = (3 * 0.16, -2 * 0.16)
    there, moved = pillarize(points, SPEC), pillarize(points, SPEC, T=T)
    np.testing.assert_array_equal(moved.cells, there.cells + 3 * 32 - 2)
    np.testing.assert_allclose(moved.features[:, 2:], there.features[:, 2:], atol=2e-6)


@each("n", [0, 1])
def test_empty_and_one_point_scans(n: int) -> None:
    points = np.zeros((n, 4), np.float32)
    for pillars in (pillarize(points, SPEC), pillarize_torch(torch.from_numpy(points), SPEC)):
        assert pillars.features.shape == (n, 9)
        assert pillars.lengths.shape == pillars.cells.shape == (n,)


def test_points_far_away_or_of_the_ego_vehicle_are_left_out() -> None:
    points = np.float32([[1e30, 0, 0, 0], [0, -3e38, 0, 0], [0, 0, 1e9, 0], [5.13, 0, 0, 0], [0, 0, 0, 0]])
    assert len(pillarize(points, SPEC).features) == 1
    assert len(pillarize(points, SPEC, ego_footprint=EGO).features) == 0


def test_float64_points_beyond_float32_are_left_out_in_silence() -> None:
    points = np.array([[1e300, 0, 0, 0], [0.1, 0.1, 0.1, 0.1]])
    assert len(pillarize(points, SPEC).features) == 1


def test_points_that_are_no_numbers_are_left_out_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    points = scan(100, size=0.3)
    clean = pillarize(points, SPEC)
    broken = np.repeat(points[:4], 1, axis=0)
    broken[range(4), range(4)] = [np.nan, np.inf, -np.inf, np.nan]
    with caplog.at_level(logging.WARNING, "ogm.deep.points"):
        same(pillarize(np.concatenate([broken, points]), SPEC), clean)
    assert "dropped 4 of 104 points" in caplog.text


def test_points_without_intensity_have_none() -> None:
    points = scan(100)
    bare = pillarize(points[:, :3], SPEC)
    points[:, 3] = 0
    same(bare, pillarize(points, SPEC), atol=0)


@each("points, error, message", [
        ([[0.0, 0.0, 0.0, 0.0]], TypeError, "got list"), (None, TypeError, "got NoneType"),
        (np.zeros((5, 4), int), TypeError, "got dtype int64"),
        (np.zeros((5, 4), complex), TypeError, "got dtype complex128"),
        (np.zeros((5, 4), object), TypeError, "got dtype object"), (np.zeros((5, 2)), ValueError, r"got \(5, 2\)"),
        (np.zeros((5, 8)), ValueError, r"points\[:, :4\]"), (np.zeros(4), ValueError, r"got \(4,\)"),
        (np.zeros((1, 5, 4)), ValueError, r"got \(1, 5, 4\)"),
    ])  # fmt: skip
def test_arrays_that_are_no_points_are_refused(points: Any, error: type[Exception], message: str) -> None:
    refused(message, pillarize, points, SPEC, error=error)


def test_a_matrix_that_is_no_transform_is_refused() -> None:
    refused(r"T must be .* got shape \(3, 3\)", pillarize, scan(5), SPEC, T=np.eye(3))


def test_a_batch_is_its_scans_one_after_the_other() -> None:
    scans = [pillarize(scan(n, seed=n), SPEC) for n in (200, 0, 1, 300)]
    batch = collate(scans, CELLS)
    assert batch.batch == 4
    first = 0
    for number, one in enumerate(scans):
        here = batch.cells // CELLS == number
        np.testing.assert_array_equal(batch.cells[here] - number * CELLS, one.cells)
        np.testing.assert_array_equal(batch.lengths[here], one.lengths)
        np.testing.assert_array_equal(batch.features[first : first + len(one.features)], one.features)
        first += len(one.features)
    assert first == len(batch.features)
    assert (batch.cells.diff() > 0).all()


def test_the_papers_limits_hold_and_are_seeded() -> None:
    whole = pillarize(scan(4000, size=0.5), SPEC)
    assert whole.lengths.max() > 5
    assert len(whole.lengths) > 200
    some = cap_pillars(whole, np.random.default_rng(3), most_pillars=200, most_points=5)
    assert len(some.cells) == len(some.lengths) == 200
    assert some.lengths.max() == 5
    assert len(some.features) == some.lengths.sum()
    assert (some.cells.diff() > 0).all()
    same(some, cap_pillars(whole, np.random.default_rng(3), 200, 5), atol=0)
    other = cap_pillars(whole, np.random.default_rng(4), 200, 5)
    assert other.cells.tolist() != some.cells.tolist()


def test_the_limits_keep_points_of_the_right_pillars_unchanged() -> None:
    whole = pillarize(scan(4000, size=0.5), SPEC)
    some = cap_pillars(whole, np.random.default_rng(0), most_pillars=200, most_points=5)
    of = dict(zip(whole.cells.tolist(), whole.features.split(whole.lengths.tolist()), strict=True))
    for cell, part in zip(some.cells.tolist(), some.features.split(some.lengths.tolist()), strict=True):
        there = {tuple(row) for row in of[cell].tolist()}
        here = [tuple(row) for row in part.tolist()]
        assert len(set(here)) == len(here) == min(5, len(there))
        assert there.issuperset(here)


def test_limits_that_are_not_reached_change_nothing() -> None:
    for n in (0, 1, 500):
        whole = pillarize(scan(n), SPEC)
        same(cap_pillars(whole, np.random.default_rng(0), 10_000, 100), whole, atol=0)
