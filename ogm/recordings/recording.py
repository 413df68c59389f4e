"""Real recordings as sequences of frames: points, and what is true around them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from ogm.io import estimate_sensor_height
from ogm.pose import inverse, transform_points
from ogm.recordings.around import choose_others, stood_here, truth_from_others
from ogm.recordings.layout import Layout, Seen
from ogm.scan import Boxes
from ogm.state import CellState, Truth
from ogm.truth import (
    MARGIN,
    MIN_RETURNS,
    TRUTH_SPEC,
    boxes_over_points,
    cells_in_areas,
    cells_in_boxes,
    cells_in_footprint,
    combine_truths,
    count_returns,
    free_road,
    ignore_cells,
    moving_tracks,
    truth_from_boxes,
    truth_from_points,
    truth_from_road,
)

__all__ = ["SOURCES", "Frame", "Recording"]

SOURCES = ("boxes", "classes", "map", "aggregated")
OTHERS = ("all", "later")
ABOVE_BOTTOM = 0.15  # [m] what is higher above a box's bottom is a return from the object, not from the road
HEIGHTS = 5  # scans of a drive whose median tells its sensor's height
AT_MOVING_POINTS = 0.3  # [m] around points whose class says that they move, other scans do not judge cells
FEW = 3  # other scans, below which one is enough to know a cell; else two must agree
KEPT_SCANS, KEPT_TRUTHS = 64, 128  # in memory: some 2 MB and 0.4 MB each

_SAYS = {
    "boxes": f"occupied: all cells of boxes with {MIN_RETURNS} returns or more in this scan (with fewer: never free)",
    "classes": "free and occupied: cells in which this scan hit labelled ground, or an obstacle 0.05 to 2 m above it",
    "map": "free: drivable area of the map that is in sight and where nothing stands",
    "aggregated": "free and occupied: what {which} scans agree on and this one does not contradict, {movers}",
}


@dataclass(frozen=True, eq=False)
class Frame:
    """One scan of a recording. Points, objects and truth are read and made when they are first asked for.

    Attributes
    ----------
    name : str
        Of the scan's file, without its endings.
    sequence : str
        The drive that it belongs to: frames of one sequence share a map frame, and one sensor height.
    stamp : float
        When it was taken [s]; NaN where the recording does not say.
    T_map_sensor : (4, 4) float64 or None
        The sensor's pose; None where the recording does not say.
    """

    name: str
    sequence: str
    stamp: float
    T_map_sensor: NDArray[np.float64] | None
    recording: "Recording"
    number: int

    @cached_property
    def points(self) -> NDArray[np.float32]:
        """The scan, (N, 4): x forward, y left, z up [m] from the sensor, intensity [0, 1]; without the own vehicle."""
        return self.recording._seen(self.number).points

    @cached_property
    def objects(self) -> Boxes | None:
        """The boxes around it, in the sensor's frame; None where the recording has none."""
        return self.recording._objects(self.number)

    @cached_property
    def T_vehicle_sensor(self) -> NDArray[np.float64]:
        """(4, 4) float64: the sensor stands upright over the vehicle's origin, [2, 3] above the ground [m]."""
        T = np.eye(4)
        T[2, 3] = self.recording._height(self.sequence)
        return T

    @cached_property
    def truth(self) -> Truth:
        """What is there, on `ogm.truth.TRUTH_SPEC` in the sensor's frame: free, occupied or to be ignored."""
        return self.recording._truth(self.number)

    def __repr__(self) -> str:
        return f"Frame({self.name!r} of {self.recording.name})"


class Recording(Sequence[Frame]):
    """The frames of a real recording, with truth; made by `open_recording`.

    Attributes
    ----------
    name : str
        Of the folder or file.
    format : str
        What it is, in words.
    path : Path
    sources : tuple of str
        What the truth is made of: some of `SOURCES`.
    """

    def __init__(self, layout: Layout, path: Path, truth: Iterable[str] = (), others: str = "all") -> None:
        self.name, self.path, self.format = path.name, path, layout.format
        self._layout, self._later = layout, others == "later"
        wanted = (truth,) if isinstance(truth, str) else tuple(truth)
        if others not in OTHERS:
            raise ValueError(f"others must be one of {', '.join(OTHERS)}, got {others!r}")
        strangers = [one for one in wanted if one not in SOURCES]
        if strangers:
            raise ValueError(f"truth must be of {', '.join(SOURCES)}, got {', '.join(map(repr, strangers))}")
        there = self._sources()
        missing = [one for one in wanted if one not in there]
        if not there or missing:
            what = " and ".join(missing) if missing else "nothing that says what is true in it"
            has = f"has {', '.join(there)}" if there else f"looked for: {layout.looked_for}"
            way_out = (
                f"give truth=({', '.join(map(repr, there))},) or less"
                if there
                else "add them, or give a folder that has them; poses of the scans are enough for aggregated truth"
            )
            lacks = f"has no {what} to make truth of" if missing else f"has {what}"
            raise ValueError(f"{path} ({layout.format}) {lacks}; {has}. {way_out}")
        self.sources = tuple(one for one in SOURCES if one in (wanted or there))
        self._asked: dict[str, Any] = {"truth": wanted, "others": others}
        self._members: dict[str, list[int]] = {}
        for n, shot in enumerate(layout.shots):
            self._members.setdefault(shot.sequence, []).append(n)
        self._seen = lru_cache(KEPT_SCANS)(self._read)
        self._truth = lru_cache(KEPT_TRUTHS)(self._make_truth)
        self._moving = lru_cache(None)(self._find_moving)
        self._height = lru_cache(None)(self._find_height)

    def __len__(self) -> int:
        return len(self._layout.shots)

    @overload
    def __getitem__(self, n: int) -> Frame: ...
    @overload
    def __getitem__(self, n: slice) -> tuple[Frame, ...]: ...
    def __getitem__(self, n: int | slice) -> Frame | tuple[Frame, ...]:
        """Return a frame, or several; nothing is read yet."""
        if isinstance(n, slice):
            return tuple(self[k] for k in range(*n.indices(len(self))))
        k = range(len(self))[n]
        return Frame(*self._layout.shots[k], recording=self, number=k)

    def __repr__(self) -> str:
        return (
            f"Recording({self.name!r}: {len(self)} frames, {self.format}; truth of {', '.join(self.sources)})"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        """Go to another process as a path: it is opened there again."""
        from ogm.recordings import open_recording

        return partial(open_recording, self.path, **self._asked), ()

    @property
    def truth_description(self) -> str:
        """What the truth is made of, in one sentence; it says "this scan" where the judged scan itself is used."""
        which = "later" if self._later else "other"
        labelled = self._layout.objects is not None or self._layout.classes
        movers = "labelled objects that move taken out" if labelled else "though nobody labelled what moves"
        parts = [_SAYS[one].format(which=which, movers=movers) for one in self.sources]
        end = "to be ignored: everything else, and where these contradict each other (boxes win)"
        view = f" ({self._layout.view})" if self._layout.view else ""
        return f"{self.format}{view}; {'; '.join(parts)}; {end}."

    # --- Parts ---------------------------------------------------------------------------------------

    def _sources(self) -> tuple[str, ...]:
        one, posed = (
            self._layout,
            [shot.sequence for shot in self._layout.shots if shot.T_map_sensor is not None],
        )
        there = {
            "boxes": one.objects is not None,
            "classes": one.classes,
            "map": one.plan is not None,
            "aggregated": len(posed) > len(set(posed)),
        }
        return tuple(name for name in SOURCES if there[name])

    def _read(self, n: int) -> Seen:
        """Read a scan without the own vehicle."""
        seen = self._layout.read(n)
        kept = self._not_own(seen.points)
        return Seen(
            np.ascontiguousarray(seen.points[kept], np.float32),
            None if seen.kinds is None else seen.kinds[kept],
            None if seen.moving is None else seen.moving[kept],
            None if seen.around is None else seen.around[self._not_own(seen.around)],
        )

    def _not_own(self, points: NDArray[np.float32]) -> NDArray[np.bool_]:
        x, y = self._layout.own
        return (np.abs(points[:, 0]) > x) | (np.abs(points[:, 1]) > y)

    def _objects(self, n: int) -> Boxes | None:
        return None if self._layout.objects is None else self._layout.objects(n)

    def _find_height(self, sequence: str) -> float:
        """Return the sensor's height above ground: the median of some scans, for the vehicle stays the same."""
        members = self._members[sequence]
        chosen = np.unique(np.round(np.linspace(0, len(members) - 1, HEIGHTS)).astype(int))
        known = self._layout.heights
        found = [
            known(members[k]) if known else estimate_sensor_height(self._layout.read(members[k]).points)
            for k in chosen
        ]
        heights = [one for one in found if one is not None]
        if not heights:
            raise ValueError(
                f"no scan of {sequence} in {self.path} shows the ground around the sensor, so its height is not known: "
                "leave this drive out"
            )
        return float(np.median(heights))

    def _find_moving(self, sequence: str) -> frozenset[str]:
        """Return the tracks of a drive that move."""
        stamps: list[float] = []
        boxes: list[Boxes] = []
        for n in self._members[sequence]:
            T, objects = self._layout.shots[n].T_map_sensor, self._objects(n)
            if T is not None and objects is not None:
                stamps.append(self._layout.shots[n].stamp)
                boxes.append(objects.moved(T))
        return moving_tracks(stamps, boxes)

    def _moving_boxes(self, n: int) -> Boxes:
        """Return the boxes of objects that move, in scan n and its frame; and of those that nobody can follow."""
        objects = self._objects(n)
        if objects is None:
            return Boxes.empty()
        moving = self._moving(self._layout.shots[n].sequence)
        return objects.select([not track or track in moving for track in objects.track])

    # --- Truth ---------------------------------------------------------------------------------------

    def _make_truth(self, n: int) -> Truth:
        parts = []
        boxes, uncertain = None, None
        if "classes" in self.sources:
            parts.append(self._from_classes(n))
        if "map" in self.sources:
            parts.append(self._from_map(n))
        if "aggregated" in self.sources:
            parts.append(self._from_others(n))
        if "boxes" in self.sources and (objects := self._objects(n)) is not None:
            returns = count_returns(self._seen(n).points, objects, above_bottom=ABOVE_BOTTOM)
            boxes = truth_from_boxes(objects, returns, TRUTH_SPEC)
            uncertain = cells_in_boxes(objects.select(returns < MIN_RETURNS), TRUTH_SPEC)
        return combine_truths(parts, boxes=boxes, uncertain=uncertain, unobserved=self._ego_cells())

    def _ego_cells(self) -> NDArray[np.bool_]:
        x, y = self._layout.own
        return cells_in_footprint((-x, x, -y, y), TRUTH_SPEC)

    def _from_classes(self, n: int) -> Truth:
        seen = self._seen(n)
        kinds = np.zeros(0, np.uint8) if seen.kinds is None else seen.kinds
        return truth_from_points(seen.points, kinds, TRUTH_SPEC, unobserved=self._ego_cells())

    def _from_map(self, n: int) -> Truth:
        """Free where one may drive. Where the map has no ground, it is taken to be as low as under the vehicle."""
        if self._layout.plan is None:
            raise ValueError(f"{self.path} has no map")
        plan, seen, objects = self._layout.plan(n), self._seen(n), self._objects(n)
        low = -self._height(self._layout.shots[n].sequence)
        x, y = np.broadcast_arrays(*TRUTH_SPEC.cell_centers)
        floor = plan.ground(np.stack([x.ravel(), y.ravel(), np.full(x.size, low)], axis=1)).reshape(x.shape)
        around = seen.points if seen.around is None else seen.around
        below = plan.ground(around[:, :3].astype(np.float64))
        road = free_road(
            cells_in_areas(plan.outlines, TRUTH_SPEC),
            np.where(np.isnan(floor), low, floor),
            around,
            around[:, 2] - np.where(np.isnan(below), low, below),
            TRUTH_SPEC,
            boxes=objects,
            min_range=self._layout.own[0],
        )
        return truth_from_road(road, TRUTH_SPEC)

    def _from_others(self, n: int) -> Truth:
        """Say what other scans of the drive know about the cells around scan n."""
        shot = self._layout.shots[n]
        truth = Truth(TRUTH_SPEC, np.full(TRUTH_SPEC.shape, np.uint8(CellState.IGNORE)))
        if shot.T_map_sensor is None:
            return truth
        members = [k for k in self._members[shot.sequence] if self._layout.shots[k].T_map_sensor is not None]
        poses = np.array([self._layout.shots[k].T_map_sensor for k in members])
        stamps = np.array([self._layout.shots[k].stamp for k in members])
        back = inverse(shot.T_map_sensor) @ poses  # from each scan to the judged one
        others = choose_others(members.index(n), stamps, poses[:, :3, 3], later=self._later)
        if not others:
            return truth
        clouds = []
        for k in others:
            seen = self._seen(members[k])
            kept = ~boxes_over_points(seen.points, self._moving_boxes(members[k]).widened(MARGIN))
            if seen.moving is not None:
                kept &= ~seen.moving
            clouds.append(transform_points(back[k], seen.points[kept]))
        truth = truth_from_others(
            clouds,
            self._height(shot.sequence),
            TRUTH_SPEC,
            self._moving_boxes(n),
            min_scans=1 if len(others) < FEW else 2,
            judged=self._seen(n).points,
        )
        moving = self._seen(n).moving
        if moving is not None and moving.any():
            truth = ignore_cells(truth, _near(self._seen(n).points[moving]))
        # Where the own vehicle stood, at any time, nothing does that stays: somebody followed it
        return ignore_cells(truth, stood_here(back) & (truth.state == CellState.OCCUPIED))


def _near(points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the cells that lie near points."""
    from scipy.ndimage import binary_dilation

    result = np.zeros(TRUTH_SPEC.shape, bool)
    inside = TRUTH_SPEC.contains(points[:, 0], points[:, 1])
    result[TRUTH_SPEC.index(points[inside, 0], points[inside, 1])] = True
    reach = int(np.ceil(AT_MOVING_POINTS / TRUTH_SPEC.resolution))
    return np.asarray(binary_dilation(result, iterations=reach))
