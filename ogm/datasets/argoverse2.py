"""Argoverse 2: one log of the sensor data set, from the upper of its two lidars."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from ogm.datasets.layout import FrameRef, HdMap, Layout, RawFrame
from ogm.io import estimate_sensor_height, read_scan
from ogm.io.argoverse2 import read_argoverse2
from ogm.pose import pose
from ogm.storage.files import OgmError

__all__ = ["argoverse2"]

_UPPER = 32  # lasers of the upper lidar; the lower one's are counted on
_EGO_ORIGIN = 0.33  # [m] of the vehicle's origin above the ground, where scans show too little of it


def argoverse2(path: Path) -> Layout | None:
    """Find one log of Argoverse 2.

    The paper's vehicle has one lidar of that kind, and rays of both cannot start at one place. Returns of the lower
    one still count for what hides the road.
    """
    if not sorted(path.glob("sensors/lidar/*.feather")):
        return None
    log = read_argoverse2(path)
    if "up_lidar" not in log.lidars:
        raise OgmError(
            f"{path} does not state where its upper lidar is mounted: wanted calibration/egovehicle_SE3_sensor.feather "
            "with up_lidar; that of another log of the data set will do, for the cars are alike"
        )
    origin, city = log.lidars["up_lidar"], log.map
    poses = [log.poses[stamp] @ pose(*origin) for stamp in log.stamps]

    def read(n: int) -> RawFrame:
        sweep = read_scan(log.sweeps[n], axes="argoverse")
        if sweep.ring is None:
            raise OgmError(f"{log.sweeps[n]} has no laser_number, which tells the two lidars apart")
        every = sweep.points - np.array([*origin, 0], np.float32)
        upper = replace(sweep, points=every).select(sweep.ring < _UPPER)
        return RawFrame(upper, all_points=every)

    def hd_map(n: int) -> HdMap:
        assert city is not None
        return HdMap(city.outlines(poses[n]), lambda xyz: city.ground(xyz, poses[n]))

    def height(n: int) -> float:
        """Estimate it from both lidars: the lower one sees ground around the car that the upper one does not."""
        ground = estimate_sensor_height(read_scan(log.sweeps[n], axes="argoverse").points)
        return float(origin[2] + (_EGO_ORIGIN if ground is None else ground))

    rows = zip(log.stamps, poses, strict=True)
    return Layout(
        "Argoverse 2 log",
        tuple(FrameRef(str(stamp), path.name, stamp * 1e-9, T) for stamp, T in rows),
        read,
        "boxes (annotations.feather), or a map (map/)",
        None if log.annotations is None else (lambda n: log.boxes(n).moved(pose(*-origin))),
        None if city is None else hd_map,
        view="seen from the upper lidar",
        sensor_height=height,
        stamped=True,
        motion_distorted=False,
    )
