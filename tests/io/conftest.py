"""A small cloud for every format."""

import numpy as np
import pytest


@pytest.fixture
def cloud() -> np.ndarray:
    """Give 60 points: x, y, z in steps of 1/64 m, intensity in steps of 1/255."""
    rng = np.random.default_rng(3)
    xyz = rng.integers(-4000, 4000, (60, 3)) / 64
    return np.column_stack([xyz, rng.integers(0, 256, 60) / 255]).astype(np.float32)
