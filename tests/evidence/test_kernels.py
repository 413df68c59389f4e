"""Numba twins against the plain rules, compiled and not."""

import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from masses import DTYPES, arrays_of_masses, rule, tolerance

from ogm import evidence
from ogm.evidence import kernels

NAMES = ["dempster", "yager", "cumulative"]
laws = settings(max_examples=30, deadline=None)
reliabilities = st.integers(0, 10).map(lambda n: n / 10)


def plain(name: str, a: np.ndarray, b: np.ndarray, reliability: float) -> np.ndarray:
    return rule(name)(evidence.discount(a, reliability), b)


@pytest.mark.parametrize("name", NAMES)
@laws
@given(masses=arrays_of_masses(2), reliability=reliabilities)
def test_kernels_are_the_plain_rules(name: str, masses: Any, reliability: float) -> None:
    a, b = masses
    expected = plain(name, a, b, reliability)
    before = a.copy(), b.copy()
    result = getattr(kernels, name)(a, b, reliability=reliability)
    assert (result.dtype, result.shape) == (a.dtype, a.shape)
    np.testing.assert_allclose(result, expected, atol=tolerance(a))
    np.testing.assert_array_equal((a, b), before)


@pytest.mark.parametrize("name", NAMES)
@laws
@given(masses=arrays_of_masses(2), reliability=reliabilities)
def test_kernels_work_in_place_and_into_a_buffer(name: str, masses: Any, reliability: float) -> None:
    a, b = masses
    expected = getattr(kernels, name)(a, b, reliability=reliability)
    buffer = np.empty_like(a)
    assert getattr(kernels, name)(a, b, reliability=reliability, out=buffer) is buffer
    np.testing.assert_array_equal(buffer, expected)
    assert getattr(kernels, name)(a, b, reliability=reliability, out=a) is a
    np.testing.assert_allclose(a, expected, atol=tolerance(a) / 100)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_kernels_treat_a_whole_grid(name: str, dtype: Any) -> None:
    a, b = np.random.default_rng(0).dirichlet([0.2, 0.2, 0.2], (2, 61, 37)).astype(dtype)[..., :2].copy()
    a[::7], b[::5], a[::3], b[::4] = (1, 0), (0, 1), (0, 0), (0.25, 0.75)
    result = getattr(kernels, name)(a, b, reliability=0.9)
    np.testing.assert_allclose(result, plain(name, a, b, 0.9), atol=tolerance(a))
    np.testing.assert_allclose(getattr(kernels, name)(a, b), rule(name)(a, b), atol=tolerance(a))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_nan_stays_in_its_cell(name: str, dtype: Any) -> None:
    a, b = np.full((2, 40, 2), 0.25, dtype)
    a[7], b[21, 0], b[33, 1] = np.nan, np.nan, np.nan
    for out in (None, a.copy()):
        result = getattr(kernels, name)(a if out is None else out, b, out=out)
        broken = np.isnan(result).any(-1)
        np.testing.assert_array_equal(np.flatnonzero(broken), (7, 21, 33))
        assert np.isnan(result[broken]).all()


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_loops_do_the_same_without_compiling_them(name: str, dtype: Any) -> None:
    a, b = np.random.default_rng(0).dirichlet([1, 1, 1], (2, 9)).astype(dtype)[..., :2].copy()
    a[0], b[0], a[1], b[1] = (1, 0), (0, 1), (0, 0), (0, 0)
    expected = plain(name, a, b, 0.9)
    out = np.empty_like(a)
    getattr(kernels, f"_{name}_into").py_func(a.reshape(-1), b.reshape(-1), 0.9, out.reshape(-1))
    np.testing.assert_allclose(out, expected, atol=tolerance(a))
    getattr(kernels, f"_{name}_in_place").py_func(a.reshape(-1), b.reshape(-1), 0.9)
    np.testing.assert_allclose(a, expected, atol=tolerance(a))


def test_everything_does_the_same_without_a_compiler() -> None:
    code = """
import numpy as np
from ogm import evidence
from ogm.evidence import kernels
a, b = np.random.default_rng(0).dirichlet([1, 1, 1], (2, 9)).astype(np.float32)[..., :2].copy()
a[0], b[0], b[1] = (1, 0), (0, 1), (0, 0)
for name in ("dempster", "yager", "cumulative"):
    expected = getattr(evidence, name)(evidence.discount(a, 0.9), b)
    np.testing.assert_allclose(getattr(kernels, name)(a, b, reliability=0.9), expected, atol=1e-6)
    np.testing.assert_allclose(getattr(kernels, name)(a.copy(), b, reliability=0.9), expected, atol=1e-6)
    np.testing.assert_allclose(
        getattr(kernels, name)(a, b), getattr(evidence, name)(a, b), atol=1e-6
    )
"""
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True, env=environment)


@pytest.mark.parametrize("name", NAMES)
def test_kernels_refuse_what_does_not_fit(name: str) -> None:
    kernel = getattr(kernels, name)
    good = np.zeros((3, 2), np.float32)
    with pytest.raises(TypeError, match="a must be a numpy array, got list"):
        kernel([0.5, 0.2], good)
    with pytest.raises(TypeError, match="float32.*as b, float64"):
        kernel(good, good.astype(float))
    with pytest.raises(TypeError, match="int64"):
        kernel(good.astype(int), good.astype(int))
    with pytest.raises(ValueError, match=r"2 states \(free, occupied\).*got shape \(3, 3\)"):
        kernel(np.zeros((3, 3)), np.zeros((3, 3)))
    with pytest.raises(ValueError, match=r"one shape, got \(3, 2\) and, as b, \(4, 2\)"):
        kernel(good, np.zeros((4, 2), np.float32))
    with pytest.raises(ValueError, match=r"one shape.*as out, \(4, 2\)"):
        kernel(good, good, out=np.zeros((4, 2), np.float32))
    with pytest.raises(ValueError, match="C-contiguous; pass np.ascontiguousarray"):
        kernel(np.zeros((6, 2), np.float32)[::2], good)
    with pytest.raises(ValueError, match=r"reliability must lie in \[0, 1\], got 1.5"):
        kernel(good, good, reliability=1.5)
    for several in (np.array([0.5, 0.5]), [0.5], None):
        with pytest.raises(TypeError, match="reliability must be one number.*use evidence.discount"):
            kernel(good, good, reliability=several)
    frozen = good.copy()
    frozen.flags.writeable = False
    with pytest.raises(ValueError, match="out must be writeable"):
        kernel(good, good.copy(), out=frozen)
    with pytest.raises(ValueError, match="out must be writeable"):
        kernel(frozen, good.copy(), out=frozen)
    assert kernel(frozen, frozen).shape == (3, 2)


@pytest.mark.parametrize("name", NAMES)
def test_kernels_refuse_memory_that_overlaps(name: str) -> None:
    kernel = getattr(kernels, name)
    memory, other = np.random.default_rng(0).dirichlet([1, 1, 1], (2, 11)).astype(np.float32)[..., :2].copy()
    with pytest.raises(ValueError, match="out must be a itself or share no memory with it"):
        kernel(memory[:-1], other[:-1], out=memory[1:])
    with pytest.raises(ValueError, match="out must not share memory with b"):
        kernel(other, memory, out=memory)
    with pytest.raises(ValueError, match="out must not share memory with b"):
        kernel(other[1:], memory[:-1], out=memory[1:])
    expected = kernel(memory, other)
    np.testing.assert_allclose(kernel(memory, other, out=memory[:]), expected, atol=1e-7)  # a by another name
    np.testing.assert_allclose(memory, expected, atol=1e-7)
