"""Grids combined cell by cell with the numba rules, as the kernels of maps do."""

from functools import cache
from typing import Any

import numpy as np
from numba import njit

from ogm.evidence.kernels import FLOAT32, FLOAT64, REVISE, RULES, SMOOTH

CELL_RULES = RULES | {"revise": REVISE, "smooth": SMOOTH}


@cache
def _loop(name: str) -> Any:
    cell = CELL_RULES[name].cell

    @njit
    def loop(constants: Any, a: Any, b: Any, out: Any) -> None:
        for i in range(len(a)):
            free, occupied, whole = cell(constants, a[i, 0], a[i, 1], b[i, 0], b[i, 1])
            out[i, 0] = 0.5 if whole == 0 else free / whole
            out[i, 1] = 0.5 if whole == 0 else occupied / whole

    return loop


def combine_cells(name: str, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Combine two arrays of masses by a rule of `CELL_RULES`, (..., 2); total conflict gives (0.5, 0.5)."""
    out = np.empty_like(a)
    constants = FLOAT32 if a.dtype == np.float32 else FLOAT64
    _loop(name)(constants, a.reshape(-1, 2), b.reshape(-1, 2), out.reshape(-1, 2))
    return out
