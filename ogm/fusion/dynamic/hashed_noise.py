"""Random numbers without a generator: a hash of two numbers selects from a table of normal quantiles.

They are reproducible and do not depend on the order of computation, so neither on the number of threads.
"""

from collections.abc import Callable
from statistics import NormalDist
from typing import Any

import numpy as np

from ogm.jit import inline

_BITS = 12  # bits of a hash that select one number
_SIZE = 1 << _BITS
_QUANTILES = np.array([NormalDist().inv_cdf((k + 0.5) / _SIZE) for k in range(_SIZE)])
NORMALS = (_QUANTILES / _QUANTILES.std()).astype(np.float32)  # mean 0, standard deviation 1
UNIT = np.float32(1 / _SIZE)  # (index + 1/2) * UNIT is uniform in (0, 1)
_LAST = np.uint64(_SIZE - 1)
# SplitMix64: Steele, Lea and Flood, "Fast splittable pseudorandom number generators" (2014)
_GOLDEN, _FIRST, _SECOND = (np.uint64(n) for n in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))
_S30, _S27, _S31 = np.uint64(30), np.uint64(27), np.uint64(31)
_SHIFTS = np.uint64(0), np.uint64(_BITS), np.uint64(2 * _BITS), np.uint64(3 * _BITS), np.uint64(4 * _BITS)


def _hashed(number: Any, key: Any) -> Any:
    """Return 64 random bits for a number (uint64) and a key."""
    z = (number + key) * _GOLDEN
    z = (z ^ (z >> _S30)) * _FIRST
    z = (z ^ (z >> _S27)) * _SECOND
    return z ^ (z >> _S31)


def _index(h: Any, k: int) -> Any:
    """Return the k-th of the five indices of `NORMALS` in a hash, k from 0 to 4."""
    return (h >> _SHIFTS[k]) & _LAST


hashed: Callable[..., Any] = inline(_hashed)
index: Callable[..., Any] = inline(_index)


def scan_key(seed: int, scan: int) -> np.uint64:
    """Return the key for the random numbers of a scan."""
    words = np.array([seed % 2**64, scan], np.uint64)
    return np.uint64(_hashed(words[1:], _hashed(words[:1], np.uint64(0)))[0])
