"""Compilation of kernels in a second process, which halves the time of a first call on two cores.

The kernels of the default model and of its maps take half a minute of a core, once per installation. While a command
compiles the kernels of its current step, another process compiles the longest kernels of later steps: `ogm.jit` lets
one process compile each kernel, and the others load it from disk.
"""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

from ogm.jit import is_compiled

Kernels = list[tuple[Any, tuple[Any, ...]]]


def main_kernels(job: str) -> Kernels:
    """Return the longest kernels of a job with example arguments.

    Parameters
    ----------
    job : {"scan", "map", "dynamic map"}
        Mapping a scan by `RayISM`; fusing into an `EvidentialMapper`; fusing into a `DynamicMapper`.

    Returns
    -------
    list of (kernel, arguments)
        Only the types of the arguments matter.
    """
    f1, f2, f3 = (np.zeros((1,) * n, np.float32) for n in (1, 2, 3))
    i1, i2, d1, d2 = np.zeros(1, np.int32), np.zeros((1, 1), np.int32), np.zeros(1), np.zeros((1, 1))
    if job == "scan":
        from ogm.geometric.kernels import arguments as a
        from ogm.geometric.kernels.belief import clear_sectors
        from ogm.geometric.kernels.chain import ray_step

        points, limits, cells = a.Points(f1, f1, f1), a.RayLimits(f2, f2), a.Cells(0.0, 0.0, 1.0)
        polar = a.PolarGrid(1.0, 1, 1, 1, *(np.zeros((1, 1), np.int16) for _ in range(3)))
        breaks = a.Breaks(np.zeros((1, 1), np.int8), f2, i2, i2, f2, np.zeros(1, np.bool_), 1)
        numbers, i3 = a.RayNumbers(*(1.0,) * len(a.RayNumbers._fields)), np.zeros((1, 1, 1), np.int32)
        ground, shown = a.Surface(f2, *np.zeros(3, np.float32)), np.zeros(0, np.uint8)
        rays, work = a.Rays(f1, f1, f1, i1, i1), a.WorkSpace(i1, f1, f1, f1, f1, i1, i1, f1, i2, i3, f2)
        given = points, f2, f1, cells, numbers, polar, ground, shown, limits, rays, breaks, work
        sectors = rays, points, limits, polar, cells, breaks, f1, numbers, (0, 1, 0), work
        return [(clear_sectors, sectors), (ray_step, (0, (0, 1, 0), a.RayScan(*given)))]
    if job == "map":
        from ogm.fusion.kernels import BeliefLayers, Memory, evidential_update
        from ogm.fusion.lookup import ScanLookup

        f3.flags.writeable = False
        layers, memory = BeliefLayers(f2, f2, d2), Memory(1.0, 1.0, 1.0, 1.0, False, False, 0.0, 0.0)
        return [(evidential_update, (layers, (0, 0), ScanLookup(f3, d2, 1), 1.0, memory, 0, 1.0))]
    from ogm.fusion.dynamic.groups import Groups, find_groups
    from ogm.fusion.dynamic.matching_kernels import MatchNumbers, match_groups

    b2, b3 = np.zeros((1, 1), np.uint8), np.zeros((1, 1, 1), np.uint8)
    numbers_of_match = MatchNumbers(1, 1.0, 1.0, 1.0, 1.0, 1.0, 1, 1)
    matched = b2, Groups(i2, i1, i1, i1), b3, d1, d2, numbers_of_match
    return [(match_groups, matched), (find_groups, (b2, b2, 1, 1))]


def compile_kernels(*jobs: str) -> None:
    """Compile the longest kernels of jobs in this process."""
    from numba import typeof

    for job in jobs:
        for kernel, arguments in main_kernels(job):
            kernel.compile(tuple(map(typeof, arguments)))


@contextmanager
def compiled_ahead(*jobs: str) -> Iterator[None]:
    """Compile the longest kernels of jobs in another process during the block, unless all are on disk.

    Parameters
    ----------
    jobs : str
        See `main_kernels`.
    """
    kernels = [kernel for job in jobs for kernel, _ in main_kernels(job)]
    if (os.cpu_count() or 1) < 2 or all(map(is_compiled, kernels)):
        yield
        return
    code = f"from ogm.models.compilation import compile_kernels; compile_kernels(*{jobs!r})"
    quiet = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = None
    with suppress(OSError):  # no memory for another process: this process compiles all kernels
        process = subprocess.Popen([sys.executable, "-c", code], **quiet)  # type: ignore[call-overload]
    try:
        yield
    finally:
        if process is not None:
            process.terminate()
            process.wait()
