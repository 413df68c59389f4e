"""Kernels for cells of a dynamic map: the update of free, static and dynamic, and the number of particles per cell.

Layers are float32 (nx, ny) in the order of the window. The kernels check nothing.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.evidence.kernels import FLOAT32, RULES
from ogm.fusion.lookup import ScanLookup, look_up
from ogm.jit import kernel, vector

_dempster = RULES["dempster"].cell
NEGLIGIBLE = np.float32(1e-12)  # mass of occupied that is treated as 0
FRACTION_BITS = 32  # of fixed-point numbers of particles


class Rates(NamedTuple):
    """Changes of beliefs between two scans.

    Attributes
    ----------
    keep_free, keep_static, keep_conflict : float32
        Remaining shares of the masses and of the conflict layers, [0, 1].
    birth : float32
        Probability that something appears in a cell, [0, 1].
    static_share : float32
        Share of new occupied mass that is static, [0, 1].
    to_dynamic : float32
        Share of static that becomes dynamic, [0, 1].
    max_known : float32
        Upper bound of free + static + dynamic, [0, 1].
    reliability : float32
        Shafer's discount of the scan, [0, 1].
    particle : float32
        Remaining mass of a particle.
    """

    keep_free: np.float32
    keep_static: np.float32
    keep_conflict: np.float32
    birth: np.float32
    static_share: np.float32
    to_dynamic: np.float32
    max_known: np.float32
    reliability: np.float32
    particle: np.float32


class DynamicCells(NamedTuple):
    """Layers of a dynamic map, each (nx, ny) float32; dynamic is surviving + born.

    Attributes
    ----------
    free, static : mass
    surviving, born : mass
        Parts of dynamic: predicted by particles and confirmed by the scan; newly appeared.
    to_occupied, to_free : conflict
        Recent conflict, [0, 1]: the map was free and a scan occupied, and the reverse.
    """

    free: NDArray[np.float32]
    static: NDArray[np.float32]
    surviving: NDArray[np.float32]
    born: NDArray[np.float32]
    to_occupied: NDArray[np.float32]
    to_free: NDArray[np.float32]


class CellOutput(NamedTuple):
    """Output of `update_cells`.

    Attributes
    ----------
    cells : DynamicCells
    measured : (nx, 2 ny) float32
        Masses (free, occupied) of the scan at the cells of the window.
    dynamic : (nx,) float64
        Sums of the new dynamic masses by row, so that they do not depend on the number of threads.
    """

    cells: DynamicCells
    measured: NDArray[np.float32]
    dynamic: NDArray[np.float64]


def no_cells(shape: tuple[int, int]) -> DynamicCells:
    """Return layers of unknown cells."""
    return DynamicCells(*np.zeros((len(DynamicCells._fields), *shape), np.float32))


@vector
def update_cells(
    old: DynamicCells,
    shift: tuple[int, int],
    start: np.ndarray,
    scan: ScanLookup,
    rates: Rates,
    rows: tuple[int, int],
    out: CellOutput,
) -> None:
    """Predict rows of cells, fuse a scan into them, and divide occupied into static and dynamic.

    With the remaining static s and the predicted dynamic d, o = s + d: the posterior mass O of occupied contains a new
    part b = O p (1 - o) / (o + p (1 - o)), with the probability of birth p (Nuss et al. 2018, equation 67). The rest is
    divided in the ratio of s to d.

    Parameters
    ----------
    old : DynamicCells
        State after the last scan.
    shift : (int, int)
        Shift of the window since the last scan [cells].
    start : (nx * ny + 1,) int32
        First predicted particle of each cell.
    scan : ScanLookup
        Masses of the scan.
    rates : Rates
    rows : (int, int)
        The rows [rows[0], rows[1]).
    out : CellOutput
        Output, of which these rows are filled.
    """
    new = out.cells
    nx, ny = new.free.shape
    zero, one = np.float32(0), np.float32(1)
    half = np.float32(0.5) * rates.max_known  # each mass after total conflict
    past = np.zeros((4, ny), np.float32)
    first, last = min(max(0, -shift[1]), ny), max(min(ny, ny - shift[1]), 0)
    for i in range(rows[0], rows[1]):
        row = i + shift[0]
        past[:] = 0
        if 0 <= row < nx:
            for j in range(first, last):
                at = j + shift[1]
                past[0, j], past[1, j] = old.free[row, at], old.static[row, at]
                past[2, j], past[3, j] = old.to_occupied[row, at], old.to_free[row, at]
        z = out.measured[i]
        z[:] = 0
        look_up(z, scan.values, scan.affine, scan.samples, i, ny)
        for j in range(ny):
            c = i * ny + j
            s = rates.keep_static * past[1, j]
            d = max(min(rates.particle * np.float32(start[c + 1] - start[c]), rates.max_known - s), zero)
            o = s + d
            f = max(min(rates.keep_free * past[0, j], rates.max_known - o), zero)
            zf, zo = rates.reliability * z[2 * j], rates.reliability * z[2 * j + 1]
            free, occupied, whole = _dempster(FLOAT32, f, o, zf, zo)
            scale = rates.max_known / max(rates.max_known * whole, free + occupied)
            free = half if whole == zero else free * scale
            occupied = half if whole == zero else occupied * scale
            appears = rates.birth * (one - o)
            no_prior = o <= NEGLIGIBLE  # occupied / o would overflow; at the time of the last scan `appears` is 0
            born = occupied if no_prior else occupied * appears / (o + appears)
            share = zero if no_prior else (occupied - born) / o
            static = share * s + rates.static_share * born
            new.free[i, j], new.static[i, j] = free, (one - rates.to_dynamic) * static
            new.surviving[i, j] = share * d
            new.born[i, j] = (one - rates.static_share) * born + rates.to_dynamic * static
            new.to_occupied[i, j] = max(rates.keep_conflict * past[2, j], f * zo)
            new.to_free[i, j] = max(rates.keep_conflict * past[3, j], o * zf)
        total = 0.0
        for j in range(ny):  # a separate loop, so that the loop above runs on vector units
            total += new.surviving[i, j] + new.born[i, j]
        out.dynamic[i] = total


@kernel
def forget_hidden_free(cells: DynamicCells, measured: np.ndarray, reach: float) -> None:
    """Limit free near measured dynamic cells to the mass that the scan measures.

    Parameters
    ----------
    cells : DynamicCells
        Cells after the update by the scan. Free is changed in place.
    measured : (nx, 2 ny) float32
        Masses (free, occupied) of the scan.
    reach : float
        Greatest distance between cell centres [cells].
    """
    nx, ny = cells.free.shape
    half = np.float32(0.5)
    for i in range(nx):
        for j in range(ny):
            dynamic = cells.surviving[i, j] + cells.born[i, j]
            if measured[i, 2 * j + 1] <= half or dynamic <= cells.static[i, j]:
                continue
            for k in range(max(i - int(reach), 0), min(i + int(reach) + 1, nx)):
                wide = int(math.sqrt(reach * reach - (k - i) ** 2))
                for n in range(max(j - wide, 0), min(j + wide + 1, ny)):
                    cells.free[k, n] = min(cells.free[k, n], measured[k, 2 * n])


@kernel
def share_particles(
    masses: tuple[np.ndarray, np.ndarray],
    mass: float,
    offset: float,
    capacity: int,
    survivors: np.ndarray,
    start: np.ndarray,
) -> None:
    """Divide the particles among the cells by systematic rounding along the grid.

    Parameters
    ----------
    masses : two of (cells,) float32
        Surviving and born parts of dynamic.
    mass : float
        Mass of a particle.
    offset : float
        Offset of the rounding, [0, 1).
    capacity : int
        Upper bound of the number of particles.
    survivors : (cells,) int32
        Output: number of particles that a cell draws from its old ones.
    start : (cells + 1,) int32
        Output: first new particle of each cell.
    """
    surviving, born = masses
    scale = 2.0**FRACTION_BITS / mass
    summed = np.int64(offset * 2.0**FRACTION_BITS)  # integers: sums are exact
    at, space = np.int64(0), np.int64(capacity)
    for c in range(len(survivors)):
        start[c] = at
        survivors[c] = 0
        r, b = surviving[c], born[c]
        if r > 0 or b > 0:
            summed += np.int64(r * scale)
            kept = min(max(summed >> FRACTION_BITS, at), space)
            survivors[c] = kept - at
            summed += np.int64(b * scale)
            at = min(max(summed >> FRACTION_BITS, kept), space)
    start[len(survivors)] = at
