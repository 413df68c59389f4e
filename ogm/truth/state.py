"""The extent of truth grids, and short names of the states of cells."""

from ogm.grid import GridSpec
from ogm.state import CellState, Truth

__all__ = ["FREE", "IGNORE", "OCCUPIED", "TRUTH_SPEC", "UNKNOWN", "Truth"]

UNKNOWN, FREE, OCCUPIED, IGNORE = CellState

TRUTH_SPEC = GridSpec.centered(
    length=99.84, width=99.84, resolution=0.16
)  # 624 x 624: any rotation of the paper's grid fits
