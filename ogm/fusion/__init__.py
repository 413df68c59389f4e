"""Maps from the scans of a moving vehicle: mappers, pipelines, resampling, de-skewing, odometry, ego motion.

>>> from ogm.fusion import EvidentialMapper, fuse
>>> for step in fuse(frames, ism, EvidentialMapper(spec, half_life=2.0)):      # doctest: +SKIP
...     print(step.frame.name, step.grid)
"""

from ogm.fusion.bayes import BinaryBayesMapper
from ogm.fusion.dynamic.mapper import DynamicMapper
from ogm.fusion.dynamic.objects import Objects, find_objects
from ogm.fusion.dynamic.prediction import predict_dynamic
from ogm.fusion.ego.deskewing import deskew
from ogm.fusion.ego.registration import odometry
from ogm.fusion.ego.scan_matching import match_scans
from ogm.fusion.elevation import ElevationMapper
from ogm.fusion.evidential import EvidentialMapper
from ogm.fusion.factory import covering_window, echo_window, make_mapper, rolling_window
from ogm.fusion.map_editing import crop, merge, resampled
from ogm.fusion.mapper import Mapper
from ogm.fusion.pipeline import FusionStep, fuse, map_scans, update_map
from ogm.fusion.resample import resample_to, warp
from ogm.fusion.update_gate import PoseJump, StampJump

__all__ = [
    "BinaryBayesMapper", "DynamicMapper", "ElevationMapper", "EvidentialMapper", "FusionStep", "Mapper", "Objects",
    "PoseJump", "StampJump", "covering_window", "crop", "deskew", "echo_window", "find_objects", "fuse", "make_mapper",
    "map_scans", "match_scans", "merge", "odometry", "predict_dynamic", "resample_to", "resampled", "rolling_window",
    "update_map", "warp",
]  # fmt: skip
