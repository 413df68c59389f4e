"""Checks of the values of the points of a drive: intensities, rings, and values that were repaired or left out."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from statistics import median

import numpy as np

from ogm.scan import Scan
from ogm.workflows.findings import Finding, counted

_SATURATED = 0.1  # share of the points at the greatest intensity, above which it is none of reflectors alone
_FACTOR = 10.0  # between the intensities of two scans of one scale, at most
_FEW = 3  # scans whose intensities differ from the others'
_MAX_RINGS = 256
_ORDERED = 0.8  # of neighbouring rings that must follow each other in elevation
_MIN_RINGS = 8  # whose order is checked: lines of other sensors cross
_REPAIRED = {  # notices of scans, see `ogm.io.notices`: severity, subject, property, way out
    "far points": ("lost data", "points", "have points beyond 100 km, which are dropped", ""),
    "surplus bytes": ("lost data", "points", "have bytes after their points, which are ignored", ""),
    "unknown intensities": ("note", "intensities", "have intensities that are no number, which become 0", ""),
    "decibels": (
        "note", "intensities", "have negative intensities (decibels?), whose range becomes 0 to 1",
        "--intensity-max sets the one that means 1",
    ),
    "wrong rings": ("note", "rings", "have rings that are no whole numbers from 0 to 65535, which are left out", ""),
    "unknown rings": ("note", "rings", "have rings that are no numbers, which are left out", ""),
    "wrong times": ("note", "times", "have single times that are wrong; their points get times of those around", ""),
    "unknown times": ("lost data", "times", "have times that are no numbers, which are left out", ""),
    "times of no sweep": ("lost data", "times", "have times of no sweep, which are left out", "--time-unit sets them"),
    "doubled fields": ("note", "fields", "have a field twice, of which the first counts", ""),
    "unknown ranges": ("note", "ranges", "have ranges of 0, too near or no number, whose beams are unknown", ""),
    "range limits": ("note", "ranges", "state no greatest range, so that beams without echo are not free", ""),
    "wrong angles": ("lost data", "angles", "have an angle_increment and an angle_max that contradict each other", ""),
    "wrong intensities": ("note", "intensities", "have another number of intensities than of ranges", ""),
    "times of no scan": ("lost data", "times", "have a time_increment of no scan, which is left out", ""),
    "damaged packets": ("lost data", "damage", "have packets that cannot be read", ""),
}  # fmt: skip


@dataclass
class ValueChecks:
    """Intensities and rings of the scans that were added so far."""

    scans: int = 0
    same: int = 0  # scans whose intensities are all the same
    bright: list[float] = field(default_factory=list)  # intensity that 95 % of a scan's points do not exceed
    saturated: list[float] = field(default_factory=list)  # share of a scan's points with intensity 1
    rings: list[int] = field(default_factory=list)  # number of different rings, of scans that have them
    unordered: int = 0  # scans whose rings do not rise or fall with elevation

    def add(self, scan: Scan, some: slice) -> None:
        """Add a scan, of which some points are enough to know their values."""
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
            Number of scans with a notice, by its kind, see `ogm.io.notices.one_notice_per_kind`.
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
        way = "--ism ray uses none"
        if self.same >= _FEW:
            text = f"{counted(self.same, self.scans)} have the same in all points, the others have not"
            yield Finding("lost data", "intensities", text, way)
        values = sorted(self.bright)
        factors = [b / max(a, 1e-6) for a, b in zip(values[_FEW - 1 :], values[_FEW:], strict=False)]
        factors = factors[: max(len(values) - 2 * _FEW + 1, 0)]  # between two groups of `_FEW` scans at least
        if factors and (factor := max(factors)) > _FACTOR:
            dark = factors.index(factor) + _FEW
            text = f"their scale changes: in {counted(dark, self.scans)} they are at least {factor:.0f} times smaller"
            yield Finding("lost data", "intensities", text, way)
        if self.saturated and (share := median(self.saturated)) > _SATURATED:
            text = f"{100 * share:.0f} % of the points have the greatest one: they are saturated"
            yield Finding("note", "intensities", text, f"--intensity-max sets the one that means 1, {way}")

    def _check_rings(self, left_out: bool) -> Iterator[Finding]:
        effect = "maps need none, training on such scans does (lost layers)"
        if not self.rings:
            if not left_out:
                yield Finding("note", "rings", f"points have none; {effect}")
            return
        if (lacking := self.scans - len(self.rings)) and not left_out:
            yield Finding("note", "rings", f"{counted(lacking, self.scans)} have none; {effect}")
        number, many = median(self.rings), max(self.rings)
        if number == 1:
            yield Finding("note", "rings", f"all points of a scan have the same; {effect}")
        elif many > _MAX_RINGS:
            text = f"up to {many} in a scan, but lidars have at most {_MAX_RINGS}: is the field another one? {effect}"
            yield Finding("note", "rings", text)
        elif self.unordered > self.scans / 2:
            text = f"their numbers do not follow elevation in {counted(self.unordered, self.scans)}; {effect}"
            yield Finding("note", "rings", text)


def _is_ordered(scan: Scan, some: slice) -> bool:
    """Return whether the median elevation of the rings rises or falls with their number, where these are many."""
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
