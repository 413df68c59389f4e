"""Where the real recordings are, and small clouds in every format."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest


@pytest.fixture
def real() -> Callable[[str], Path]:
    """Give the path of a real recording beside the project, or skip the test."""
    default = Path(__file__).parents[2].parent / "shared" / "data" / "real"
    folder = Path(os.environ.get("OGM_DATA", default))

    def find(name: str) -> Path:
        if not folder.is_dir():
            pytest.skip(f"no real recordings at {folder} (set OGM_DATA to the folder that has them)")
        (path,) = folder.glob(name)
        return path

    return find


@pytest.fixture
def cloud() -> np.ndarray:
    """Give 60 points: x, y, z in steps of 1/64 m, intensity in steps of 1/255."""
    rng = np.random.default_rng(3)
    xyz = rng.integers(-4000, 4000, (60, 3)) / 64
    return np.column_stack([xyz, rng.integers(0, 256, 60) / 255]).astype(np.float32)
