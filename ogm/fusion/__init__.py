"""Scans of a moving vehicle into maps: fusion over time, resampling, ego motion.

>>> from ogm.fusion import EvidentialMapper
>>> mapper = EvidentialMapper(spec, half_life=2.0)                                     # doctest: +SKIP
>>> mapper.update(ism(scan.points), T_map_sensor, stamp=scan.stamp); mapper.grid      # doctest: +SKIP
"""

from ogm.fusion.arrival import PoseJump
from ogm.fusion.bayes import BinaryBayesMapper
from ogm.fusion.deskew import deskew, extrapolate
from ogm.fusion.egomotion import EgoMotion
from ogm.fusion.mapper import EvidentialMapper
from ogm.fusion.odometry import odometry
from ogm.fusion.warp import coarsen, refine, warp

__all__ = [
    "BinaryBayesMapper",
    "EgoMotion",
    "EvidentialMapper",
    "PoseJump",
    "coarsen",
    "deskew",
    "extrapolate",
    "odometry",
    "refine",
    "warp",
]
