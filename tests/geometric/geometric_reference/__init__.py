"""Slow reference implementations of the kernels in plain Python.

They follow the definitions (ray by ray, cell by cell, in float64) without the optimisations of the kernels.
"""

from geometric_reference.breaks import Beam, classify, find_breaks, profiles_of
from geometric_reference.causes import planar_causes, ray_causes
from geometric_reference.ground import ground_map, lower_envelope, pull_push
from geometric_reference.heights import terrain
from geometric_reference.planar import planar_mass
from geometric_reference.ray import ray_grid_mass, silence_reliability

__all__ = [
    "Beam", "classify", "find_breaks", "ground_map", "lower_envelope", "planar_causes", "planar_mass", "profiles_of",
    "pull_push", "ray_causes", "ray_grid_mass", "silence_reliability", "terrain",
]  # fmt: skip
