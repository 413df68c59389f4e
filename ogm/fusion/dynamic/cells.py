"""Kernels of the cells of a dynamic map: the update of free, static and dynamic, and the particles that each gets.

Layers are float32 (nx, ny) in the order of the window. Nothing is checked here.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.evidence.kernels import FLOAT32, RULES
from ogm.fusion.lookup import ScanLookup, look_up
from ogm.jit import kernel, vector

_dempster = RULES["dempster"].cell
LEAST = np.float32(1e-12)  # mass of occupied that is taken for none
FRACTION_BITS = 32  # of the fixed-point numbers in which particles are divided


class Rates(NamedTuple):
    """What happens to beliefs between two scans.

    Attributes
    ----------
    keep_free, keep_static, keep_conflict : float32
        Shares that are left of the masses, and of the conflict layers, [0, 1].
    birth : float32
        Probability that something appears in a cell, [0, 1].
    static_share : float32
        Share of what appears that is taken to be static, [0, 1].
    to_dynamic : float32
        Share of static that becomes dynamic, [0, 1].
    max_known : float32
        The most that free + static + dynamic may be, [0, 1].
    reliability : float32
        Shafer's discount of the scan, [0, 1].
    particle : float32
        What is left of the mass of a particle.
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
        Of dynamic: what particles predicted and the scan confirmed, and what is new.
    to_occupied, to_free : conflict
        Where the map was free and a scan occupied of late, and the reverse, [0, 1].
    """

    free: NDArray[np.float32]
    static: NDArray[np.float32]
    surviving: NDArray[np.float32]
    born: NDArray[np.float32]
    to_occupied: NDArray[np.float32]
    to_free: NDArray[np.float32]


class CellOutput(NamedTuple):
    """What `update_cells` fills.

    Attributes
    ----------
    cells : DynamicCells
    measured : (nx, 2 ny) float32
        The scan's masses (free, occupied) on the cells of the window.
    dynamic : (nx,) float64
        Sums of the new masses of dynamic: by row, so that they do not depend on the number of threads.
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
    """Predict rows of cells, fuse a scan into them, and divide what is occupied into static and dynamic.

    With what is left of static s and the predicted dynamic d, o = s + d: the posterior mass O of occupied holds a part
    b = O p (1 - o) / (o + p (1 - o)) that appeared, p the probability of birth (Nuss et al. 2018, equation 67), and the
    rest is divided as s to d.

    Parameters
    ----------
    old : DynamicCells
        As of the last scan.
    shift : (int, int)
        By how many cells the window has moved since.
    start : (nx * ny + 1,) int32
        Where each cell's predicted particles begin.
    scan : ScanLookup
        Of masses.
    rates : Rates
    rows : (int, int)
        The rows [rows[0], rows[1]).
    out : CellOutput
        These rows are filled.
    """
    new = out.cells
    nx, ny = new.free.shape
    zero, one = np.float32(0), np.float32(1)
    half = np.float32(0.5) * rates.max_known  # of total conflict
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
            nothing = o <= LEAST  # occupied / o would overflow; at the time of the last scan nothing appears
            born = occupied if nothing else occupied * appears / (o + appears)
            share = zero if nothing else (occupied - born) / o
            static = share * s + rates.static_share * born
            new.free[i, j], new.static[i, j] = free, (one - rates.to_dynamic) * static
            new.surviving[i, j] = share * d
            new.born[i, j] = (one - rates.static_share) * born + rates.to_dynamic * static
            new.to_occupied[i, j] = max(rates.keep_conflict * past[2, j], f * zo)
            new.to_free[i, j] = max(rates.keep_conflict * past[3, j], o * zf)
        total = 0.0
        for j in range(ny):  # apart, so that the loop above runs on vector units
            total += new.surviving[i, j] + new.born[i, j]
        out.dynamic[i] = total


@kernel
def forget_hidden_free(cells: DynamicCells, measured: np.ndarray, reach: float) -> None:
    """Bound free by what the scan measures, near dynamic cells that it measures as occupied.

    Parameters
    ----------
    cells : DynamicCells
        After the update by the scan. Free is changed.
    measured : (nx, 2 ny) float32
        The scan's masses (free, occupied).
    reach : float
        Greatest distance of the middles of two cells [cells].
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
    most: int,
    survivors: np.ndarray,
    start: np.ndarray,
) -> None:
    """Divide the particles among the cells by systematic rounding along the grid.

    Parameters
    ----------
    masses : two of (cells,) float32
        Of dynamic: surviving and born.
    mass : float
        Of one particle.
    offset : float
        Of the rounding, [0, 1).
    most : int
        Particles that there is space for, whatever the masses are.
    survivors : (cells,) int32
        Is filled with the number of particles that a cell draws from its old ones.
    start : (cells + 1,) int32
        Is filled with the places of each cell's new particles.
    """
    surviving, born = masses
    scale = 2.0**FRACTION_BITS / mass
    summed = np.int64(offset * 2.0**FRACTION_BITS)  # whole numbers: sums are exact
    at, space = np.int64(0), np.int64(most)
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
