"""The hint that kernels are going to be compiled."""

import importlib.util
import logging
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from ogm.jit import log_compilation

SOURCE = """
from ogm.jit import kernel

@kernel
def twice(x):
    return 2 * x
"""


def load(path: Path) -> Any:
    """Import a module from a file, afresh."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_compilation_is_logged_where_nothing_is_cached(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "kernels_of_a_test.py"
    path.write_text(SOURCE)
    first = load(path)
    if not hasattr(first.twice, "stats"):
        pytest.skip("numba's compiler is switched off")
    with caplog.at_level(logging.INFO):
        log_compilation(first.twice)
        log_compilation(first.twice)
        assert [(r.levelname, r.name) for r in caplog.records] == [("INFO", "kernels_of_a_test")]
        assert "compiling kernels, once per environment" in caplog.text
        caplog.clear()
        assert first.twice(3) == 6
        again = load(path)  # as in the next process: not in memory, but on disk
        assert not again.twice.signatures
        log_compilation(again.twice)
        assert not caplog.records
        assert again.twice(3) == 6
        assert again.twice.stats.cache_hits


MERGE = """
import numpy as np
from ogm.world import kernels
tile = np.ones((7, 8, 8), np.uint16)
kernels.merge(tile, tile.copy(), 0, 0.9)
stats = getattr(kernels._merge, "stats", None)  # None where numba's compiler is switched off
print(sum(stats.cache_misses.values()) if stats else 0)
"""


def test_the_next_process_finds_kernels_on_disk() -> None:
    """A kernel that holds another in its closure has a name of its own in each process, and is compiled in each."""
    missed = [int(subprocess.run([sys.executable, "-c", MERGE], capture_output=True, check=True).stdout) for _ in "ab"]
    assert missed[1] == 0
