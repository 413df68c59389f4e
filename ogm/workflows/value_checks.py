"""Checks of values of points in a drive: intensities, rings, and repaired or dropped values."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from statistics import median

import numpy as np

from ogm.scan import Scan
from ogm.workflows.findings import Finding, counted

_SATURATED = 0.1  # share of the points at the greatest intensity; a greater share is not of reflectors only
_MAX_FACTOR = 10.0  # between the intensities of two scans of one scale
_MIN_SCANS = 3  # scans with other intensities
_MAX_RINGS = 256
_ORDERED = 0.8  # least share of neighbouring rings in the order of elevation
_MIN_RINGS = 8  # to check their order: lines of other sensors cross
_REPAIRED = {  # notices of scans, see `ogm.io.notices`: severity, subject, property, way out
    "far points": ("lost data", "points", "have points beyond 100 km, which are dropped", ""),
    "surplus bytes": ("lost data", "points", "have bytes after their points, which are ignored", ""),
    "unknown intensities": ("note", "intensities", "have intensities that are no number, which become 0", ""),
    "decibels": (
        "note", "intensities", "have negative intensities (decibels?), with the range scaled to 0 to 1",
        "--intensity-max sets the intensity scaled to 1",
    ),
    "wrong rings": ("note", "rings", "have rings that are no whole numbers from 0 to 65535, which are left out", ""),
    "unknown rings": ("note", "rings", "have rings that are no numbers, which are left out", ""),
    "wrong times": ("note", "times", "have single wrong times, which are replaced by times of points around", ""),
    "unknown times": ("lost data", "times", "have times that are no numbers, which are left out", ""),
    "times of no sweep": ("lost data", "times", "have times of no sweep, which are left out", "--time-unit sets them"),
    "doubled fields": ("note", "fields", "have a field twice; the first is used", ""),
    "unknown ranges": ("note", "ranges", "have ranges of 0, too near or no number; their beams are unknown", ""),
    "range limits": ("note", "ranges", "state no greatest range, so that beams without echo are not free", ""),
    "wrong angles": ("lost data", "angles", "have an angle_increment and an angle_max that contradict each other", ""),
    "wrong intensities": ("note", "intensities", "have another number of intensities than of ranges", ""),
    "times of no scan": ("lost data", "times", "have a time_increment of no scan, which is left out", ""),
    "damaged packets": ("lost data", "damage", "have packets that cannot be read", ""),
}  # fmt: skip


@dataclass
class ValueChecks:
    """Intensities and rings of the added scans."""

    scans: int = 0
    same: int = 0  # scans with equal intensities in all points
    bright: list[float] = field(default_factory=list)  # 95th percentile of a scan's intensities
    saturated: list[float] = field(default_factory=list)  # share of a scan's points with intensity 1
    rings: list[int] = field(default_factory=list)  # number of different rings in scans with rings
    unordered: int = 0  # scans with rings that do not rise or fall with elevation

    def add(self, scan: Scan, some: slice) -> None:
        """Add a scan; values are taken from the points `some`."""
        self.scans += 1
        intensity = scan.points[some, 3]
        if intensity.min() == intensity.max():
            self.same += 1
        else:
            self.bright.append(float(np.percentile(intensity, 95)))
            self.saturated.append(float(np.mean(intensity >= 1.0)))
        if scan.ring is None:
            return
        self.rings.append(len(np.unique(scan.ring)))
        self.unordered += not _is_ordered(scan, some)

    def findings(self, notices: Mapping[str, int]) -> Iterator[Finding]:
        """Yield findings about values.

        Parameters
        ----------
        notices : mapping of str to int
            Number of scans with a notice of each kind, see `ogm.io.notices.one_notice_per_kind`.
        """
        for kind, (severity, subject, text, way) in _REPAIRED.items():
            if count := min(notices.get(kind, 0), self.scans):
                yield Finding(severity, subject, f"{counted(count, self.scans)} {text}", way)
        if not self.scans:
            return
        yield from self._check_intensities()
        yield from self._check_rings(any("rings" in kind for kind in notices))

    def _check_intensities(self) -> Iterator[Finding]:
        if self.same == self.scans:
            yield Finding("note", "intensities", "all are the same, so that models cannot use them")
            return
        way = "--ism ray uses no intensities"
        if self.same >= _MIN_SCANS:
            text = f"{counted(self.same, self.scans)} have the same in all points, the others vary"
            yield Finding("lost data", "intensities", text, way)
        values = sorted(self.bright)
        factors = [b / max(a, 1e-6) for a, b in zip(values[_MIN_SCANS - 1 :], values[_MIN_SCANS:], strict=False)]
        factors = factors[: max(len(values) - 2 * _MIN_SCANS + 1, 0)]  # between groups of at least `_MIN_SCANS` scans
        if factors and (factor := max(factors)) > _MAX_FACTOR:
            dark = factors.index(factor) + _MIN_SCANS
            text = f"their scale changes: in {counted(dark, self.scans)} they are at least {factor:.0f} times smaller"
            yield Finding("lost data", "intensities", text, way)
        if self.saturated and (share := median(self.saturated)) > _SATURATED:
            text = f"{100 * share:.0f} % of the points have the greatest intensity: they are saturated"
            yield Finding("note", "intensities", text, f"--intensity-max sets the intensity scaled to 1; {way}")

    def _check_rings(self, left_out: bool) -> Iterator[Finding]:
        effect = "maps do not need rings, training on such scans does (lost layers)"
        if not self.rings:
            if not left_out:
                yield Finding("note", "rings", f"points have no rings; {effect}")
            return
        if (lacking := self.scans - len(self.rings)) and not left_out:
            yield Finding("note", "rings", f"{counted(lacking, self.scans)} have no rings; {effect}")
        number, greatest = median(self.rings), max(self.rings)
        if number == 1:
            yield Finding("note", "rings", f"all points of a scan have the same ring; {effect}")
        elif greatest > _MAX_RINGS:
            text = f"up to {greatest} in a scan, but lidars have at most {_MAX_RINGS}: check the field; {effect}"
            yield Finding("note", "rings", text)
        elif self.unordered > self.scans / 2:
            text = f"their numbers do not follow elevation in {counted(self.unordered, self.scans)}; {effect}"
            yield Finding("note", "rings", text)


def _is_ordered(scan: Scan, some: slice) -> bool:
    """Return whether the median elevation of the rings rises or falls with their number; True for few rings."""
    if scan.ring is None:
        return True
    ring, xyz = scan.ring[some], scan.points[some, :3]
    elevation = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
    order = np.lexsort((elevation, ring))
    _, first, count = np.unique(ring[order], return_index=True, return_counts=True)
    medians = elevation[order][first + count // 2]
    if not _MIN_RINGS <= len(medians) <= _MAX_RINGS:
        return True
    rising = np.mean(np.diff(medians) > 0)
    return bool(max(rising, 1 - rising) >= _ORDERED)
