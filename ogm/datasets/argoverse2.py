"""Argoverse 2: one log of the sensor dataset, from the upper of its two lidars."""

from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.frames import FrameRef, HdMap, RawFrame
from ogm.datasets.recording import Recording
from ogm.io import estimate_sensor_height, read_scan
from ogm.io.argoverse2 import Argoverse2Log, read_argoverse2
from ogm.pose import pose
from ogm.scan import Boxes, Scan
from ogm.storage.files import OgmError

_UPPER_LASERS = 32  # lasers 0 to 31 are the upper lidar's, higher numbers the lower lidar's
_EGO_ORIGIN = 0.33  # [m] height of the vehicle's origin above the ground, for scans that show too little ground


class Argoverse2Recording(Recording):
    """Folder with ``sensors/lidar/*.feather``.

    Only the upper lidar is used, as the paper's vehicle has one lidar and the rays of a scan start at one position.
    Returns of the lower lidar still count as obstacles that hide the road.
    """

    format = "Argoverse 2 log"
    wanted_labels = "boxes (annotations.feather), or a map (map/)"
    view = "seen from the upper lidar"
    known_height = True
    stamped = True
    motion_distorted = False

    def __init__(self, path: Path) -> None:
        self.path = path
        if "up_lidar" not in self.log.lidars:
            raise OgmError(
                f"{path} has no mount of the upper lidar: wanted calibration/egovehicle_SE3_sensor.feather with "
                "up_lidar; copy the file of another log of the dataset, the cars are alike"
            )
        self._origin, stamps = self.log.lidars["up_lidar"], enumerate(self.log.stamps)
        super().__init__(path, [FrameRef(str(stamp), path.name, stamp * 1e-9, self._pose(n)) for n, stamp in stamps])
        labels = {"boxes": self.log.annotations, "map": self.log.map}
        self.labelled = tuple(name for name, content in labels.items() if content is not None)

    @classmethod
    def find(cls, path: Path) -> "Argoverse2Recording | None":
        """Return the sweeps of a log, or None if there are no sweeps."""
        return cls(path) if sorted(path.glob("sensors/lidar/*.feather")) else None

    @cached_property
    def log(self) -> Argoverse2Log:
        """Tables and map of the log, some 10 MB."""
        return read_argoverse2(self.path)

    def _pose(self, n: int) -> NDArray[np.float64]:
        return self.log.poses[self.log.stamps[n]] @ pose(*self._origin)

    def _sweep(self, n: int) -> Scan:
        return read_scan(self.log.sweeps[n], axes="argoverse")

    def read(self, n: int) -> RawFrame:
        """Read the returns of the upper lidar; `all_points` has the returns of both lidars."""
        sweep = self._sweep(n)
        if sweep.ring is None:
            raise OgmError(f"{self.log.sweeps[n]} has no laser_number, wanted a sweep of the sensor dataset")
        every = sweep.points - np.array([*self._origin, 0], np.float32)
        return RawFrame(replace(sweep, points=every).select(sweep.ring < _UPPER_LASERS), all_points=every)

    def read_boxes(self, n: int) -> Boxes:
        """Return the boxes of the annotations."""
        return self.log.boxes(n).moved(pose(*-self._origin))

    def hd_map(self, n: int) -> HdMap:
        """Return the map around a scan."""
        city, T_city_sensor = self.log.map, self._pose(n)
        assert city is not None
        return HdMap(city.outlines(T_city_sensor), partial(city.ground, T_city_sensor=T_city_sensor))

    def estimate_height(self, n: int) -> float:
        """Estimate the sensor height from both lidars; the lower lidar sees the ground next to the car."""
        ground = estimate_sensor_height(self._sweep(n).points)
        return float(self._origin[2] + (_EGO_ORIGIN if ground is None else ground))
