"""The cache of compiled kernels: right after a change of any source, shared by processes and installations."""

import importlib.util
import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import typeof

import ogm
from ogm import GridSpec, Mount, jit
from ogm.fusion import EvidentialMapper
from ogm.fusion.dynamic.matching import MatchSettings, match_velocities
from ogm.fusion.dynamic.scan_history import ScanCells
from ogm.geometric import RayISM
from ogm.models.compilation import main_kernels

SOURCE = """
from ogm.jit import kernel

@kernel
def twice(x):
    return 2 * x
"""
KERNELS = """
from ogm import helper
from ogm.jit import kernel

@kernel
def result(x):
    return helper.scaled(x)
"""
HELPER = """
from ogm.jit import kernel
{}
@kernel
def scaled(x):
    return x * {}
"""
PROBE = "import ogm.kernels as k; print(k.result(3), sum(k.result.stats.cache_misses.values()))"
Run = Callable[..., list[str]]


def load(path: Path) -> Any:
    """Import a module from a file, afresh."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """Give a function that writes a package of a kernel and its helper, and calls the kernel in a new process."""

    def written(factor: int, *, root: str = "a", comment: str = "", cache: Path = tmp_path / "cache") -> list[str]:
        package = tmp_path / root / "ogm"
        package.mkdir(parents=True, exist_ok=True)
        (package / "__init__.py").touch()
        shutil.copy(Path(ogm.__file__).with_name("jit.py"), package)
        (package / "kernels.py").write_text(KERNELS)
        (package / "helper.py").write_text(HELPER.format(comment, factor))
        for path in package.iterdir():  # of the same time and size after a change: numba's own cache looks at these
            os.utime(path, (1e9, 1e9))
        environment = os.environ | {"PYTHONPATH": str(tmp_path / root), "NUMBA_CACHE_DIR": str(cache)}
        environment["PYTHONDONTWRITEBYTECODE"] = "1"  # bytecode too is found by time and size
        command = [sys.executable, "-W", "error", "-c", PROBE]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
        return done.stdout.split()

    if not hasattr(jit.kernel(lambda: 0), "stats"):
        pytest.skip("numba's compiler is switched off")
    return written


@pytest.mark.slow
def test_a_changed_helper_in_another_file_is_compiled_anew(run: Run) -> None:
    assert run(2) == ["6", "1"]
    assert run(2) == ["6", "0"]
    assert run(5) == ["15", "1"]


@pytest.mark.slow
def test_another_clone_of_the_same_sources_takes_the_same_kernels(run: Run) -> None:
    assert run(2, root="a") == ["6", "1"]
    assert run(2, root="b") == ["6", "0"]


@pytest.mark.slow
def test_folders_of_old_versions_are_removed(run: Run, tmp_path: Path) -> None:
    for version in range(jit.KEPT_VERSIONS + 1):
        run(version)
    folders = sorted(path.name.rpartition("-")[0] for path in (tmp_path / "cache" / "ogm").iterdir())
    assert folders == sorted(["ogm.helper", "ogm.kernels"] * jit.KEPT_VERSIONS)
    assert run(version) == [str(3 * version), "0"]


def test_a_folder_that_cannot_be_written_costs_only_time(run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").touch()  # a folder cannot be made here, whoever runs this
    assert run(2, cache=tmp_path / "file")[0] == "6"


def test_compilation_is_logged_where_nothing_is_cached(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "kernels_of_a_test.py"
    path.write_text(SOURCE + f"# {tmp_path}")  # no source that was compiled before
    first = load(path)
    if not hasattr(first.twice, "stats"):
        pytest.skip("numba's compiler is switched off")
    with caplog.at_level(logging.INFO):
        jit.log_compilation(first.twice)
        jit.log_compilation(first.twice)
        assert [(r.levelname, r.name) for r in caplog.records] == [("INFO", "kernels_of_a_test")]
        assert "compiling kernels, once per environment" in caplog.text
        caplog.clear()
        assert first.twice(3) == 6
        again = load(path)  # as in the next process: not in memory, but on disk
        assert not again.twice.signatures
        jit.log_compilation(again.twice)
        assert not caplog.records
        assert again.twice(3) == 6
        assert again.twice.stats.cache_hits


SLOW = """
import sys, time
from ogm import kernels as k
compiled = k.result._compiler.compile
k.result._compiler.compile = lambda *given: (time.sleep(0.5), compiled(*given))[1]  # long enough to meet
k.result(3)
print(sum(k.result.stats.cache_misses.values()))
"""


@pytest.mark.slow
def test_of_two_processes_one_compiles(run: Run, tmp_path: Path) -> None:
    run(2)
    shutil.rmtree(tmp_path / "cache")
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "a"), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    command = [sys.executable, "-c", SLOW]
    both = [subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE) for _ in "ab"]
    assert sorted(int(one.communicate()[0]) for one in both) == [0, 1]


MERGE = """
import numpy as np
from ogm.world import kernels
tile = np.ones((7, 8, 8), np.uint16)
kernels.merge(tile, tile.copy(), 0, 0.9)
stats = getattr(kernels._merge, "stats", None)  # None where numba's compiler is switched off
print(sum(stats.cache_misses.values()) if stats else 0)
"""


@pytest.mark.slow
def test_the_next_process_finds_kernels_on_disk() -> None:
    """A kernel that holds another in its closure has a name of its own in each process, and is compiled in each."""
    missed = [int(subprocess.run([sys.executable, "-c", MERGE], capture_output=True, check=True).stdout) for _ in "ab"]
    assert missed[1] == 0


def test_kernels_are_compiled_ahead_for_the_types_that_they_are_called_with() -> None:
    """Else another process would compile in vain."""
    if not hasattr(jit.kernel(lambda: 0), "stats"):
        pytest.skip("numba's compiler is switched off")
    spec, points = GridSpec.centered(length=20.0, width=20.0, resolution=0.5), np.zeros((64, 4), np.float32)
    points[:, 0], points[:, 2] = np.linspace(3, 8, 64), np.repeat([-1.8, 0.0], 32)
    EvidentialMapper(spec).update(RayISM(spec, Mount(1.8))(points), np.eye(4), stamp=0.0)
    now, before = np.zeros((2, 40, 40), bool)
    now[10:14, 10:14] = before[10:14, 8:12] = True
    nothing = np.zeros(now.shape, bool)
    scans = ScanCells(now, nothing, 0.0), [ScanCells(before, nothing, 0.1)]
    assert match_velocities(scans[0], now, scans[1], 0.16, MatchSettings()).valid.any()
    for job in ("scan", "map", "dynamic map"):
        for kernel, arguments in main_kernels(job):
            assert tuple(map(typeof, arguments)) in kernel.signatures, kernel.__name__
