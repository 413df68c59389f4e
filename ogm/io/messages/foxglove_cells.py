"""Kernel of ``foxglove.Grid``: cells with their masses and their colour, in one pass."""

from typing import Any

import numpy as np

from ogm.jit import kernel

__all__ = ["fill_masses", "warm_up_cells"]


@kernel
def fill_masses(mass: Any, palette: Any, cells: Any, octets: Any) -> None:
    """Fill free, occupied, unknown and the last four octets of the cells (ny, nx, ...): their colour.

    In strips of columns, as the masses (nx, ny, 2) lie the other way round.
    """
    nx, ny = mass.shape[:2]
    last, zero, one, full, half = octets.shape[2] - 4, np.float32(0), np.float32(1), np.float32(255), np.float32(0.5)
    for start in range(0, nx, 16):
        for y in range(ny):
            for x in range(start, min(start + 16, nx)):
                free, occupied = mass[x, y, 0], mass[x, y, 1]
                unknown = max(one - (free + occupied), zero)
                cells[y, x, 0], cells[y, x, 1], cells[y, x, 2] = free, occupied, unknown
                for k in range(3):
                    shade = free * palette[0, k] + occupied * palette[1, k]
                    octets[y, x, last + k] = np.uint8(full * shade + half)
                octets[y, x, last + 3] = np.uint8(full * (one - unknown) + half)


def warm_up_cells() -> None:
    """Compile or load the kernel, before the first map of a live run."""
    cells = np.empty((1, 1, 4), np.float32)
    fill_masses(np.zeros((1, 1, 2), np.float32), np.zeros((2, 3), np.float32), cells, cells.view(np.uint8))
