"""Readers that fail in every way that the run must notice: each of them on one in four inputs, or on one in eight."""

import ctypes
import time
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
from targets import Target

from ogm.storage.files import OgmError


def _when(share: int, fail: Callable[[], object]) -> Callable[[Path], Target]:
    """Return a target that fails on some inputs, refuses some and reads the others."""

    def read(data: bytes) -> None:
        number = zlib.crc32(data)
        if data != _SEED and number % share == 0:
            fail()
        elif data != _SEED and number % 2:
            raise OgmError("refused")

    return lambda folder: Target({"a": _SEED}, read, in_memory=True)


def _endless() -> None:
    while True:
        time.process_time()


def _missing_key() -> None:
    raise KeyError("undocumented")


_SEED = bytes(range(200))


def every_target() -> dict[str, Callable[[Path], Target]]:
    """Return the targets by name."""
    return {
        "good": _when(10**12, bool),
        "crash": _when(4, lambda: ctypes.string_at(0)),
        "leaves": _when(4, lambda: __import__("os")._exit(7)),
        "hang": _when(8, _endless),
        "memory": _when(4, lambda: np.ones(2**25)),  # 256 MB
        "huge": _when(4, lambda: np.zeros(2**40)),  # 8 TB
        "undocumented": _when(4, _missing_key),
    }
