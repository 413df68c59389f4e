"""Slow references: what the kernels compute, in plain Python.

They follow the definitions (one ray after the other, one cell after the other, float64) and take none of the
kernels' short cuts. Tests compare the two, and `benchmarks/speed.py` times one against the other.
"""

from ogm.geometric.reference.breaks import Beam, Break, classify, find_breaks, profiles_of
from ogm.geometric.reference.causes import planar_causes, ray_causes
from ogm.geometric.reference.ground import ground_map, lower_envelope
from ogm.geometric.reference.height_band import height_band_mass, line_cells
from ogm.geometric.reference.heights import terrain
from ogm.geometric.reference.planar import planar_mass
from ogm.geometric.reference.ray import ray_grid_mass, silence_reliability

__all__ = [
    "Beam", "Break", "classify", "find_breaks", "ground_map", "height_band_mass", "line_cells", "lower_envelope",
    "planar_causes", "planar_mass", "profiles_of", "ray_causes", "ray_grid_mass", "silence_reliability", "terrain",
]  # fmt: skip
