"""Frames, a data set and a network of the small world of `walls`."""

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from walls import BEAMS, frame, sample

from ogm.deep.network import NetworkConfig
from ogm.grid import GridSpec
from ogm.scan import Frame
from ogm.simulation.store import SHARD, Store


@pytest.fixture(autouse=True)
def nothing_logged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let each test log what an earlier one of this process has logged."""
    monkeypatch.setattr("ogm.deep.ism._warned", set())


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Let torch compute in one thread."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def frames() -> list[Frame]:
    return [frame(number) for number in range(12)]


@pytest.fixture(scope="session")
def store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of ten samples in each of two parts."""
    path = tmp_path_factory.mktemp("data") / "walls"
    made = Store.create(path, {"seed": 1}, {"training": SHARD, "validation": SHARD}, [BEAMS], {"ogm": "test"})
    for split in ("training", "validation"):
        made.write(split, 0, [sample(k, split) for k in range(SHARD)])
    return path


@pytest.fixture(scope="session")
def small() -> GridSpec:
    return GridSpec.centered(length=30.72, width=20.48, resolution=0.64)  # 48 x 32 cells


@pytest.fixture(scope="session")
def tiny() -> NetworkConfig:
    scale = (15.0, 10.0, 2.0, 0.5, 0.2, 0.2, 0.3, 0.3, 0.3)
    return NetworkConfig(pillar=8, blocks=((8, 1), (8, 1), (8, 1)), join="add", bearings=True, scale=scale)
