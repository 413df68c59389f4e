"""Scans of a moving vehicle fused into maps: mappers, pipelines, resampling, de-skewing, odometry, ego motion.

>>> from ogm.fusion import EvidentialMapper, fuse
>>> for step in fuse(frames, ism, EvidentialMapper(spec, half_life=2.0)):      # doctest: +SKIP
...     print(step.frame.name, step.grid)
"""

from ogm.fusion.bayes import BinaryBayesMapper
from ogm.fusion.egomotion import EgoMotion
from ogm.fusion.mapper import EvidentialMapper
from ogm.fusion.motion import deskew, extrapolate
from ogm.fusion.registration import odometry
from ogm.fusion.resample import coarsen, resample_to, warp
from ogm.fusion.update_gate import PoseJump

__all__ = [
    "BinaryBayesMapper",
    "EgoMotion",
    "EvidentialMapper",
    "PoseJump",
    "coarsen",
    "deskew",
    "extrapolate",
    "odometry",
    "resample_to",
    "warp",
]
