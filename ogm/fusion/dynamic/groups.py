"""Groups of neighbouring occupied cells, and the capped distance to the nearest occupied cell."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.jit import inline, kernel, vector


class Groups(NamedTuple):
    """Groups of occupied cells.

    Attributes
    ----------
    label : (nx, ny) int32
        Number of a cell's group, from 1; 0 for none.
    x, y : (cells,) int32
        Indices of the cells, sorted by group.
    start : (G + 1,) int32
        Group g + 1 has the cells start[g] to start[g + 1].
    """

    label: np.ndarray
    x: np.ndarray
    y: np.ndarray
    start: np.ndarray


@inline
def find_root(parent: NDArray[np.integer], k: int) -> int:
    """Return the root of element k of a union-find forest, and shorten its path."""
    while parent[k] != k:
        parent[k] = parent[parent[k]]
        k = parent[k]
    return k


@kernel
def find_groups(occupied: NDArray[np.uint8], candidates: NDArray[np.uint8], link: int, min_cells: int) -> Groups:
    """Find the groups of occupied cells that contain a candidate.

    Two cells are in one group if neither their rows nor their columns are more than `link` apart.

    Parameters
    ----------
    occupied, candidates : (nx, ny) uint8
        0 or 1.
    link, min_cells : int
        Greatest gap, and least size of a group [cells].

    Returns
    -------
    Groups
        Groups in the order of their first cells, row by row.
    """
    nx, ny = occupied.shape
    max_runs = nx * (ny // (link + 1) + 1)
    first, last = np.empty(max_runs, np.int32), np.empty(max_runs, np.int32)  # columns of a run's ends
    count, parent = np.empty(max_runs, np.int32), np.empty(max_runs, np.int32)
    chosen = np.zeros(max_runs, np.uint8)
    row_start = np.zeros(nx + 1, np.int32)
    runs = 0
    for i in range(nx):  # cells of a row with gaps of at most `link` are a run
        begin = runs
        for j in range(ny):
            if occupied[i, j]:
                if runs == begin or j - last[runs - 1] > link:
                    first[runs], count[runs], parent[runs] = j, 0, runs
                    runs += 1
                last[runs - 1] = j
                count[runs - 1] += 1
                chosen[runs - 1] |= candidates[i, j]
        row_start[i + 1] = runs
        for above in range(max(i - link, 0), i):
            other, end = row_start[above], row_start[above + 1]
            for run in range(begin, runs):
                while other < end and last[other] < first[run] - link:
                    other += 1
                at = other
                while at < end and first[at] <= last[run] + link:
                    a, b = find_root(parent, at), find_root(parent, run)
                    parent[max(a, b)] = min(a, b)
                    at += 1
    size = np.zeros(runs, np.int32)
    for run in range(runs):
        root = find_root(parent, run)
        size[root] += count[run]
        chosen[root] |= chosen[run]
    number = np.zeros(runs, np.int32)
    groups = 0
    for run in range(runs):
        if parent[run] == run and chosen[run] and size[run] >= min_cells:
            groups += 1
            number[run] = groups
    start = np.zeros(groups + 1, np.int32)
    for run in range(runs):
        if number[run]:
            start[number[run]] = start[number[run] - 1] + size[run]
    return _collect(occupied, (row_start, first, last, parent, number), start)


@kernel
def _collect(occupied: NDArray[np.uint8], runs: tuple[NDArray[np.int32], ...], start: NDArray[np.int32]) -> Groups:
    """Return the groups with their labels and cells."""
    row_start, first, last, parent, number = runs
    label = np.zeros(occupied.shape, np.int32)
    x, y = np.empty(start[-1], np.int32), np.empty(start[-1], np.int32)
    filled = start.copy()
    for i in range(occupied.shape[0]):
        for run in range(row_start[i], row_start[i + 1]):
            group = number[find_root(parent, run)]
            if group == 0:
                continue
            for j in range(first[run], last[run] + 1):
                if occupied[i, j]:
                    label[i, j] = group
                    x[filled[group - 1]], y[filled[group - 1]] = i, j
                    filled[group - 1] += 1
    return Groups(label, x, y, start)


LEVELS = 100  # steps between distance 0 and the cap
MAX_CAP = 11  # [cells] so that the sum of two squares fits in 8 bits


@vector
def capped_distance(mask: NDArray[np.uint8], cap: float, out: NDArray[np.uint8]) -> None:
    """Fill `out` (nx, ny) uint8 with the distance to the nearest occupied cell, in steps of cap / `LEVELS`.

    Exact Euclidean transform by Meijster's two passes: squared distances along rows, then the minimum over rows of
    these plus the squared row distance. Distances beyond the cap need no value, so both passes visit few neighbours, in
    8 bits.

    Parameters
    ----------
    mask : (nx, ny) uint8
        0 or 1.
    cap : float
        Greatest distance [cells], at most `MAX_CAP`.
    """
    nx, ny = mask.shape
    reach = int(np.ceil(cap))
    limit = np.uint8(reach * reach)
    table = np.empty(256, np.uint8)
    for square in range(256):
        table[square] = np.uint8(np.floor(min(np.sqrt(square), cap) / cap * LEVELS + 0.5))
    along = np.empty((nx, ny), np.uint8)
    line = np.full(ny + 2 * reach, limit, np.uint8)
    for i in range(nx):
        for j in range(ny):
            line[reach + j] = limit * (np.uint8(1) - mask[i, j])
        row = along[i]
        for j in range(ny):
            row[j] = line[reach + j]
        for s in range(1, reach):
            _lower(row, line[reach - s :], np.uint8(s * s))
            _lower(row, line[reach + s :], np.uint8(s * s))
    least = np.empty(ny, np.uint8)
    for i in range(nx):
        for j in range(ny):
            least[j] = along[i, j]
        for s in range(1, reach):
            if i >= s:
                _lower(least, along[i - s], np.uint8(s * s))
            if i + s < nx:
                _lower(least, along[i + s], np.uint8(s * s))
        for j in range(ny):
            out[i, j] = table[least[j]]


@vector
def _lower(least: NDArray[np.uint8], values: NDArray[np.uint8], square: np.uint8) -> None:
    for j in range(least.size):
        value = np.uint8(values[j] + square)
        least[j] = value if value < least[j] else least[j]
