"""What tests of data sets share: samples that need neither a town nor Open3D."""

from collections.abc import Callable

import pytest
from stand_in import SMALL, TALL, stand_in

from ogm.simulation.sample import Beams, SimulatedSample


@pytest.fixture(scope="session")
def make_sample() -> Callable[..., SimulatedSample]:
    """Give `stand_in`."""
    return stand_in


@pytest.fixture(scope="session")
def beams() -> tuple[Beams, Beams]:
    """Give the lidars of `stand_in`."""
    return SMALL, TALL
