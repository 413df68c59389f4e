"""Logs of a small drive."""

from collections.abc import Callable
from pathlib import Path

import pytest
from small_drive import drive

from ogm.io.logs import LogWriter


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    """Give a function that writes the drive with the library's own writer."""

    def make(name: str, compression: str = "", points: int = 4000) -> Path:
        with LogWriter(tmp_path / name, compression) as log:
            for topic, kind, message, stamp in drive(points):
                log.write(topic, kind, message, stamp)
        return tmp_path / name

    return make
