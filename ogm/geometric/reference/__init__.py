"""Slow reference implementations of the kernels in plain Python.

They follow the definitions (ray by ray, cell by cell, in float64) without the optimisations of the kernels. Tests
compare the results, and `benchmarks/speed.py` compares the times.
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
