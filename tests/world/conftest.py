"""Places for world maps: a folder, and a bucket of a real S3 server on this machine."""

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ogm.grid import EvidentialGrid, GridSpec

Place = Callable[[], dict[str, Any]]
_numbers = itertools.count()


@pytest.fixture(params=["folder", pytest.param("s3", marks=pytest.mark.slow)])
def place(request: pytest.FixtureRequest, tmp_path: Path) -> Place:
    """Give arguments for `WorldMap.create` and `WorldMap.open`: each call a new place."""
    if request.param == "folder":
        return lambda: {"url": tmp_path / f"map-{next(_numbers)}"}
    options = request.getfixturevalue("s3")
    return lambda: {"url": f"s3://maps/map-{next(_numbers)}", "storage": options}


@pytest.fixture
def make_grid() -> Callable[..., EvidentialGrid]:
    """Give grids of random masses, with unknown cells."""

    def made(seed: int = 0, shape: tuple[int, int] = (40, 30), resolution: float = 0.5) -> EvidentialGrid:
        rng = np.random.default_rng(seed)
        mass = rng.dirichlet((1, 1, 1), shape)[..., :2].astype(np.float32)
        mass[rng.random(shape) < 0.3] = 0
        half = resolution / 2
        return EvidentialGrid(GridSpec(resolution, shape, (-shape[0] * half, -shape[1] * half)), mass)

    return made
