"""States of cells: what masses predict, and crops of the truth."""

import math

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given, settings
from hypothesis import strategies as st

from ogm import CellState, GridSpec, Truth
from ogm.state import PARTICIPANT, predict_state

UNKNOWN, FREE, OCCUPIED, IGNORE = CellState
SPEC = GridSpec(0.5, (40, 30), (-12.0, -7.0))


def random_truth(seed: int = 0, spec: GridSpec = SPEC) -> Truth:
    return Truth(spec, np.random.default_rng(seed).integers(0, 4, spec.shape).astype(np.uint8))


@each(
    ("free", "occupied", "state"),
    [
        (0.0, 0.0, UNKNOWN),
        (0.6, 0.1, FREE),
        (0.1, 0.6, OCCUPIED),
        (0.3, 0.3, UNKNOWN),
        (0.5, 0.0, UNKNOWN),  # a tie with unknown
        (0.0, 0.5, UNKNOWN),
        (0.25, 0.5, OCCUPIED),
        (0.5, 0.5, OCCUPIED),  # a tie of free and occupied
        (0.4375, 0.4375, OCCUPIED),
        (1.0, 0.0, FREE),
    ],
)
def test_the_greatest_mass_is_predicted(free: float, occupied: float, state: CellState) -> None:
    assert predict_state(np.array([free, occupied], np.float32)) == state


@given(st.floats(0, 1, width=32), st.floats(0, 1, width=32), st.sampled_from([np.float32, np.float64]))
@settings(max_examples=200, deadline=None)
def test_prediction_is_the_argmax_in_float64(a: float, b: float, dtype: type) -> None:
    free, occupied = (float(dtype(a)), float(dtype(b * (1 - a))))
    unknown = 1 - free - occupied
    got = predict_state(np.array([[free, occupied]], dtype))
    assert got.dtype == np.uint8
    assert got.shape == (1,)
    want = max((unknown, 2, UNKNOWN), (occupied, 1, OCCUPIED), (free, 0, FREE))[2]  # the number decides ties
    assert got[0] == want


def slow_crop(truth: Truth, spec: GridSpec, yaw: float, dx: float, dy: float) -> np.ndarray:
    """Cell by cell: the state where the cell's middle was before the scene turned and moved."""
    c, s = math.cos(yaw), math.sin(yaw)
    state = np.full(spec.shape, IGNORE, np.uint8)
    for i, j in np.ndindex(*spec.shape):
        x = spec.origin[0] + (i + 0.5) * spec.resolution - dx
        y = spec.origin[1] + (j + 0.5) * spec.resolution - dy
        u = math.floor((c * x + s * y - truth.spec.origin[0]) / truth.spec.resolution + 1e-9)
        v = math.floor((c * y - s * x - truth.spec.origin[1]) / truth.spec.resolution + 1e-9)
        if 0 <= u < truth.spec.shape[0] and 0 <= v < truth.spec.shape[1]:
            state[i, j] = truth.state[u, v]
    return state


@given(
    st.integers(0, 99),
    st.floats(-7, 7) | st.sampled_from([0.0, math.pi / 2, math.pi, -math.pi / 2]),
    st.floats(-9, 9) | st.sampled_from([0.0, 0.25, 0.5]),
    st.floats(-9, 9) | st.sampled_from([0.0, 0.25, 0.5]),
    st.sampled_from([0.25, 0.5, 0.8]),
)
@settings(max_examples=100, deadline=None)
def test_a_crop_equals_the_loop_over_cells(seed: int, yaw: float, dx: float, dy: float, resolution: float) -> None:
    truth, spec = random_truth(seed), GridSpec(resolution, (21, 17), (-5.0, -4.0))
    cut = truth.crop(spec, yaw, dx, dy)
    assert cut.spec == spec
    np.testing.assert_array_equal(cut.state, slow_crop(truth, spec, yaw, dx, dy))


def test_a_crop_without_motion_is_a_slice_and_beyond_the_edge_ignored() -> None:
    truth, square = random_truth(3), GridSpec.centered(10.0, 10.0, 0.5)
    turned = random_truth(4, square).crop(square, math.pi / 2)
    np.testing.assert_array_equal(turned.state, np.rot90(random_truth(4, square).state))
    inner = truth.crop(GridSpec(0.5, (10, 6), (-2.0, -1.0)))
    np.testing.assert_array_equal(inner.state, truth.state[20:30, 12:18])
    outer = truth.crop(GridSpec(0.5, (42, 32), (-12.5, -7.5)))
    np.testing.assert_array_equal(outer.state[1:-1, 1:-1], truth.state)
    frame = np.ones((42, 32), bool)
    frame[1:-1, 1:-1] = False
    assert (outer.state[frame] == IGNORE).all()


def test_mirroring_twice_changes_nothing_and_once_exchanges_left_and_right() -> None:
    truth = random_truth(5)
    once = truth.mirrored()
    x, y = 3.3, -6.1
    cell, other = truth.spec.index(x, y), once.spec.index(x, -y)
    assert truth.state[cell] == once.state[other]
    assert once.spec.extent == pytest.approx((-12, 8, -8, 7))
    np.testing.assert_array_equal(once.mirrored().state, truth.state)
    assert once.mirrored().spec == truth.spec


def test_shares_sum_to_one_and_the_grid_holds_what_is_known() -> None:
    truth = Truth(GridSpec(1.0, (2, 2), (0.0, 0.0)), np.array([[0, 1], [2, 3]], np.uint8))
    assert truth.shares() == (0.25, 0.25, 0.25, 0.25)
    assert truth.known.tolist() == [[False, True], [True, False]]
    assert truth.ignored.tolist() == [[False, False], [False, True]]
    assert truth.grid.mass.tolist() == [[[0, 0], [1, 0]], [[0, 1], [0, 0]]]
    np.testing.assert_array_equal(predict_state(truth.grid.mass)[truth.known], truth.state[truth.known])


def test_kerbs_get_the_given_state_and_nothing_else_changes() -> None:
    state = np.array([[OCCUPIED, OCCUPIED, OCCUPIED, FREE, UNKNOWN]], np.uint8)
    height = np.array([[15, 16, PARTICIPANT, 0, 0]], np.uint8)
    truth = Truth(GridSpec(1.0, (1, 5), (0.0, 0.0)), state, height)
    assert truth.kerbs.tolist() == [[True, False, False, False, False]]
    assert truth.with_kerbs("free").with_kerbs("occupied").state.tolist() == state.tolist()
    for name, want in (("ignore", IGNORE), ("unknown", UNKNOWN), (FREE, FREE), ("occupied", OCCUPIED)):
        changed = truth.with_kerbs(name)
        assert changed.state.tolist() == [[want, *state[0, 1:]]]
        np.testing.assert_array_equal(changed.height_cm, height)
    plain = random_truth()
    assert not plain.kerbs.any()
    assert plain.with_kerbs("ignore") is plain
    refused("one of unknown, free, occupied, ignore, got 'low'", truth.with_kerbs, "low")


def test_what_is_no_truth_is_refused() -> None:
    refused("uint8 array, got int64; convert", Truth, SPEC, np.zeros((40, 30), np.int64), error=TypeError)
    refused("uint8 array, got list", Truth, SPEC, [[0]], error=TypeError)
    refused(r"shape \(30, 40\), but the spec has \(40, 30\)", Truth, SPEC, np.zeros((30, 40), np.uint8))
    refused("3 ignore, got 4", Truth, SPEC, np.full((40, 30), 4, np.uint8))
    for name in ("yaw", "dx", "dy"):
        refused("must be finite", random_truth().crop, SPEC, **{name: math.nan})
