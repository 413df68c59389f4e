"""Checks of the scans of a drive: ranges, times, ground."""

import hashlib
import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from statistics import median

import numpy as np
from numpy.typing import NDArray

from ogm.io import Axes
from ogm.io.ground_plane import SIDES, GroundPlane, ground_plane, ground_side
from ogm.io.scan_table import axes_text, rotation_to_flu
from ogm.scan import Scan
from ogm.workflows.findings import Finding, counted, without_numbers
from ogm.workflows.value_checks import ValueChecks

_STEP = 17  # every 17th point is used for elevations and values; a power of 2 would always select the same ring
_SATURATED = 0.02  # [m] below the greatest range
_GAP = 0.5  # [m] below the saturated points, with less than half as many points
_MAX_SHARE = 0.01  # of the points at one range; a greater share is no measured distance
_RING = math.sin(math.radians(3))  # spread of elevations there, more than of one beam on level ground
_NEAR = 0.2  # [m], nearer than any lidar measures
_MAX_MEDIAN = 300.0  # [m] median range, greater than of any lidar
_FLAT = math.radians(1.5)  # spread of elevations of a planar lidar
_MAX_TILT = math.radians(3)  # more than the average slope of roads
_MAX_HEIGHT_ERROR = 0.2  # [m] between a stated height and the ground
_FEW = 0.1  # of the usual number of points


@dataclass
class ScanChecks:
    """Properties of the added scans.

    Parameters
    ----------
    interval : float
        Usual time from scan to scan [s]; NaN if unknown.
    """

    interval: float = math.nan
    count: int = 0
    failed: Counter[str] = field(default_factory=Counter)
    points: list[int] = field(default_factory=list)
    planar: int = 0
    greatest: list[tuple[float, float]] = field(default_factory=list)  # range [m], and share of points at it
    distances: list[float] = field(default_factory=list)  # [m] median range of the points
    near: int = 0  # points nearer than `_NEAR`
    values: ValueChecks = field(default_factory=ValueChecks)
    spans: list[float] = field(default_factory=list)  # [s] between the first and the last point of a scan
    silent: int = 0  # scans with known beams without echo
    repeated: int = 0  # scans with the points of the previous scan
    planes: list[GroundPlane | None] = field(default_factory=list)
    sides: list[str] = field(default_factory=list)  # axes by which the ground is below, if it is on another side
    _hash: str = ""

    def add(self, scan: Scan) -> None:
        """Add a scan."""
        self.count += 1
        self.silent += scan.no_returns is not None
        if scan.kind == "cone":
            return  # a single range
        self.points.append(len(scan))
        if not len(scan):
            return
        xyz = scan.points[:, :3]
        some = np.s_[::_STEP] if len(scan) > 100 * _STEP else np.s_[:]
        reach = np.sqrt(sum(column * column for column in xyz.T))
        farthest = float(reach.max())
        heights = xyz[reach > farthest - _SATURATED, 2] / max(farthest, _NEAR)
        near = int(np.count_nonzero(reach > farthest - _SATURATED - _GAP))
        ring = near < 1.5 * len(heights) and np.ptp(np.percentile(heights, (5, 95))) > _RING
        self.greatest.append((farthest, len(heights) / len(scan) if ring else 0.0))
        self.distances.append(float(np.median(reach[some])))
        self.near += 0 if scan.kind else int(np.count_nonzero(reach < _NEAR))
        elevation = np.arctan2(xyz[some, 2], np.hypot(xyz[some, 0], xyz[some, 1]))
        self.planar += not scan.kind and bool(np.ptp(np.percentile(elevation, (2, 98))) < _FLAT)
        self.values.add(scan, some)
        if scan.time is not None:
            self.spans.append(float(np.ptp(scan.time)))
        content = hashlib.md5(np.ascontiguousarray(xyz[some]).tobytes(), usedforsecurity=False).hexdigest()
        self.repeated += content == self._hash
        self._hash = content

    def add_ground(self, points: NDArray[np.floating], side: float = 1.0) -> GroundPlane | None:
        """Add and return the ground of a scan, by its points (N, 3) in the axes of mapping.

        A depth camera, with another `side` of squares than 1 m, may see no ground, but never on another side.
        """
        plane = ground_plane(points, side)
        axes = ground_side(points) if side == 1 and (plane is None or plane.height <= 0) else None
        self.planes.append(None if axes else plane)
        self.sides += [axes] if axes else []
        return self.planes[-1]

    def findings(self, notices: Mapping[str, int]) -> Iterator[Finding]:
        """Yield findings except those about the ground; for the notices see `ValueChecks.findings`."""
        total = self.count + sum(self.failed.values())
        kinds: dict[str, list[tuple[str, int]]] = {}
        for error, count in self.failed.items():
            kinds.setdefault(without_numbers(error), []).append((error, count))
        for errors in kinds.values():
            count = sum(number for _, number in errors)
            first = "the first: " * (len(errors) > 1)
            yield Finding("lost data", "damage", f"{counted(count, total)} cannot be read: {first}{errors[0][0]}")
        if not self.count:
            return
        usual = median(self.points or [0])
        if few := sum(points < _FEW * usual for points in self.points) if usual else len(self.points):
            text = f"{counted(few, self.count)} have less than a tenth of the usual number of points"
            yield Finding("lost data", "points", text)
        if self.repeated:
            text = f"{counted(self.repeated, self.count)} with the points of the previous scan"
            yield Finding("lost data", "duplicates", text)
        yield from self._check_ranges()
        if self.planar > self.count / 2:
            text = "scans are planar, without ground: walls farther than 4 m per metre of sensor height may become free"
            yield Finding("wrong map", "ground", text, "--ism height-band, for sensors 0.5 m or more above ground")
        yield from self.values.findings(notices)
        yield from self._check_times()
        if not self.silent:
            yield Finding("note", "beams without echo", "unknown: free space ends at the farthest points")

    def saturated(self) -> float | None:
        """Return the range that marks beams without echo [m], else None."""
        ranges = [farthest for farthest, share in self.greatest if share > _MAX_SHARE]
        if not ranges or len(ranges) < len(self.greatest) / 2 or np.ptp(ranges) > _SATURATED:
            return None
        return round(median(ranges), 2)

    def _check_ranges(self) -> Iterator[Finding]:
        if self.distances and (distance := median(self.distances)) > _MAX_MEDIAN:
            text = f"half of the points lie beyond {distance:.3g} m, probably in millimetres or centimetres"
            yield Finding("wrong map", "ranges", text, "write points in metres")
        if (farthest := self.saturated()) is not None:
            share = 100 * median(share for _, share in self.greatest)
            text = f"{share:.0f} % of the points lie at the greatest range, {farthest:g} m: a ring of obstacles"
            yield Finding("wrong map", "ranges", text, f"--max-range {farthest:g} --max-range-no-echo")
        if self.near > _MAX_SHARE * sum(self.points):
            text = f"{self.near} points lie within {_NEAR:g} m of the sensor"
            yield Finding("lost data", "ranges", text, f"--min-range {2 * _NEAR:g}")

    def _check_times(self) -> Iterator[Finding]:
        if not self.spans:
            yield Finding("note", "times", "points have no times, so that --deskew cannot undo the ego motion")
            return
        span = median(self.spans)
        if span > 1.5 * self.interval:
            text = f"they span {span:.3g} s in a scan, but scans are {self.interval:.3g} s apart"
            yield Finding("lost data", "times", text, "--time-unit sets their unit")
        elif span == 0:
            yield Finding("note", "times", "all are equal in a scan, so that --deskew cannot undo the ego motion")
        elif span < 1e-3:
            yield Finding("note", "times", f"they span {1e6 * span:.3g} us in a scan", "--time-unit sets their unit")

    def tilt(self) -> tuple[float, float]:
        """Return roll and pitch of the sensor relative to the ground [rad]; 0 without visible ground."""
        normals = [plane.normal for plane in self.planes if plane is not None]
        x, y, z = np.mean(normals, axis=0) if normals else (0.0, 0.0, 1.0)
        return math.atan2(y, z), math.atan2(-x, math.hypot(y, z))

    def ground_findings(self, height: float | None, stated: str, used: Axes) -> Iterator[Finding]:
        """Yield findings about tilt and height, by the ground in the scans.

        Parameters
        ----------
        height : float or None
            Used height of the sensor [m]; None if unknown.
        stated : str
            Origin of the height as text; "" for a height estimated from the scans.
        used : Axes
            Axes by which the scans were read.
        """
        planes = [plane for plane in self.planes if plane is not None]
        if not self.planes or self.planar > self.count / 2:
            return
        if not planes:
            axes = Counter(self.sides).most_common(1)
            if axes:
                side = SIDES[axes[0][0]]
                wanted = axes_text(rotation_to_flu(axes[0][0].split(",")) @ rotation_to_flu(used))
                remedy = f"--axes={wanted}, of which the last is up; a picture shows which axis is forward"
                yield Finding("wrong map", "axes", f"the ground lies {side} the sensor", remedy)
            else:
                count = counted(len(self.planes), len(self.planes))
                text = f"not found in {count}: heights are relative to --sensor-height"
                yield Finding("lost data", "ground", text, "a sensor that sees ground within 40 m")
            return
        roll, pitch = self.tilt()
        if (tilt := math.acos(math.cos(roll) * math.cos(pitch))) > _MAX_TILT:
            text = f"the ground is inclined by {math.degrees(tilt):.0f} degrees in the axes of the points"
            way = "transforms from base_link, poses, or `ogm check --write vehicle.yaml` and --sensors vehicle.yaml"
            yield Finding("wrong map", "tilt", text, way)
            return
        found = median(plane.height for plane in planes)
        if height is not None and stated and abs(found - height) > max(_MAX_HEIGHT_ERROR, 0.1 * height):
            text = f"the ground lies {found:.2f} m below the sensor, but {stated} {height:.2f} m"
            yield Finding("wrong map", "height", text, f"--sensor-height {found:.2f}")
        if (reach := max(plane.reach for plane in planes)) > 10:
            text = f"{found:.2f} m by ground {reach / 2:g} to {reach:g} m away: check it"
            yield Finding("note", "height", text, "--sensor-height sets it")
