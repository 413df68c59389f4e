"""Truth of recordings, made of boxes, classes, a map's road, and neighbouring scans."""

from collections.abc import Sequence
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.compat import rows
from ogm.datasets.layout import EGO, Footprint, FrameRef
from ogm.datasets.neighbours import choose_neighbours, ego_path_cells, truth_from_neighbours
from ogm.pose import inverse, transform_points
from ogm.scan import Boxes
from ogm.state import CellState, Truth
from ogm.truth import (
    MARGIN,
    MIN_RETURNS,
    TRUTH_SPEC,
    boxes_over_points,
    cells_in_areas,
    cells_in_box,
    cells_in_boxes,
    combine_truths,
    count_returns,
    free_road,
    moving_tracks,
    truth_from_boxes,
    truth_from_points,
    truth_from_road,
    widen_boxes,
)

if TYPE_CHECKING:
    from ogm.datasets.reader import FrameReader

__all__ = ["SOURCES", "LabelledTruth"]

SOURCES = ("boxes", "classes", "map", "aggregated")
_ABOVE_BOTTOM = 0.15  # [m] what is higher above a box's bottom is a return from the object, not from the road
_AT_MOVING_POINTS = 0.3  # [m] around points whose class tells that they move, neighbours do not decide
_FEW = 3  # neighbouring scans, below which one is enough to know a cell; else two must agree

_DESCRIPTIONS = {
    "boxes": f"occupied: all cells of boxes with {MIN_RETURNS} returns or more in this scan (with fewer: never free)",
    "classes": "free and occupied: cells in which this scan hit labelled ground, or an obstacle 0.05 to 2 m above it",
    "map": "free: drivable area of the map that is in sight and where nothing stands",
    "aggregated": "free and occupied: what {which} scans agree on and this one does not contradict, {movers}",
}


class LabelledTruth:
    """Makes the truth of the frames of a layout. Called with the number of a frame, it returns a `Truth`.

    Parameters
    ----------
    reader : FrameReader
    wanted : sequence of str
        Some of `SOURCES`; all that there are where empty.
    others : {"all", "later"}
    """

    def __init__(self, reader: "FrameReader", wanted: Sequence[str], others: str) -> None:
        self.reader, self.layout, self._later = reader, reader.layout, others == "later"
        there = self._there()
        missing = [one for one in wanted if one not in there]
        if missing:
            raise ValueError(self._lacking(there, missing))
        self.sources = tuple(one for one in SOURCES if one in (wanted or there))
        self._moving_tracks = lru_cache(None)(self._find_moving)

    def __call__(self, n: int) -> Truth:
        """Make the truth of frame n, on `TRUTH_SPEC`: free, occupied, or ignored.

        Raises
        ------
        ValueError
            If the data set has no labels and no poses.
        """
        if not self.sources:
            raise ValueError(self._lacking((), ()))
        parts = []
        boxes, uncertain = None, None
        if "classes" in self.sources:
            parts.append(self._from_classes(n))
        if "map" in self.sources:
            parts.append(self._from_map(n))
        if "aggregated" in self.sources:
            parts.append(self._from_neighbours(n))
        if "boxes" in self.sources and (labelled := self.reader.boxes(n)) is not None:
            around = rows(labelled)
            returns = count_returns(self._points(n), around + [0, 0, 0, 0, 0, _ABOVE_BOTTOM, 0])
            boxes = truth_from_boxes(around, returns, TRUTH_SPEC)
            uncertain = cells_in_boxes(around[returns < MIN_RETURNS], TRUTH_SPEC)
        ego = np.zeros(TRUTH_SPEC.shape, bool)
        ego[cells_in_box(_row(self._ego), TRUTH_SPEC)] = True
        return combine_truths(parts, boxes=boxes, uncertain=uncertain, unobserved=ego)

    @property
    def description(self) -> str:
        """What the truth is made of, in one sentence; "this scan" is the frame's own. "" where there is no truth."""
        if not self.sources:
            return ""
        which = "later" if self._later else "other"
        labelled = self.layout.boxes is not None or self.layout.classes
        movers = "labelled objects that move taken out" if labelled else "without labels of what moves"
        parts = [_DESCRIPTIONS[one].format(which=which, movers=movers) for one in self.sources]
        end = "ignored: everything else, and where these contradict each other (boxes win)"
        view = f" ({self.layout.view})" if self.layout.view else ""
        return f"{self.layout.format}{view}; {'; '.join(parts)}; {end}."

    # --- Parts ---------------------------------------------------------------------------------------

    def _there(self) -> tuple[str, ...]:
        layout = self.layout
        posed = [frame.sequence for frame in layout.frames if frame.T_map_sensor is not None]
        there = {
            "boxes": layout.boxes is not None,
            "classes": layout.classes,
            "map": layout.hd_map is not None,
            "aggregated": len(posed) > len(set(posed)),
        }
        return tuple(name for name in SOURCES if there[name])

    def _lacking(self, there: Sequence[str], missing: Sequence[str]) -> str:
        path, layout = self.reader.path, self.layout
        if there:
            way_out = f"has {', '.join(there)}. give truth=({', '.join(map(repr, there))},) or less"
        else:
            way_out = (
                f"looked for: {layout.labels}. add them, or give a folder that has them; poses of the scans are "
                "enough for aggregated truth"
            )
        lacks = f"no {' and '.join(missing)} to make truth of" if missing else "nothing to make truth of"
        return f"{path} ({layout.format}) has {lacks}; {way_out}"

    @property
    def _ego(self) -> Footprint:
        return self.layout.ego_footprint or EGO

    def _points(self, n: int) -> NDArray[np.float32]:
        return self.reader.scan(n).points

    def _frame(self, n: int) -> FrameRef:
        return self.layout.frames[n]

    def _find_moving(self, sequence: str) -> frozenset[str]:
        """Return the tracks of a sequence that move."""
        stamps: list[float] = []
        places: list[NDArray[np.float64]] = []
        tracks: list[str] = []
        for n in self.reader.groups[sequence]:
            frame, boxes = self._frame(n), self.reader.boxes(n)
            if frame.T_map_sensor is not None and frame.stamp is not None and boxes is not None:
                stamps += [frame.stamp] * len(boxes)
                places += [boxes.moved(frame.T_map_sensor).center[:, :2]]
                tracks += boxes.track
        return frozenset(moving_tracks(stamps, np.concatenate(places), tracks) if tracks else ())

    def _moving_boxes(self, n: int) -> Boxes:
        """Return the boxes of objects that move, in scan n and its frame, and of those without a track."""
        boxes = self.reader.boxes(n)
        if boxes is None:
            return Boxes.empty()
        moving = self._moving_tracks(self._frame(n).sequence)
        return boxes.select(np.array([not track or track in moving for track in boxes.track], bool))

    # --- Truth ---------------------------------------------------------------------------------------

    def _from_classes(self, n: int) -> Truth:
        raw = self.reader.raw(n)
        kinds = np.zeros(0, np.uint8) if raw.kinds is None else raw.kinds
        return truth_from_points(raw.scan.points, kinds, TRUTH_SPEC, own=_row(self._ego))

    def _from_map(self, n: int) -> Truth:
        """Free where one may drive. Where the map has no ground, it is taken to be as low as under the vehicle."""
        if self.layout.hd_map is None:
            raise ValueError(f"{self.reader.path} has no map")
        hd_map, raw, boxes = self.layout.hd_map(n), self.reader.raw(n), self.reader.boxes(n)
        low = -self.reader.height(n)
        x, y = np.broadcast_arrays(*TRUTH_SPEC.cell_centers)
        ground = hd_map.ground(np.stack([x.ravel(), y.ravel(), np.full(x.size, low)], axis=1)).reshape(x.shape)
        points = raw.scan.points if raw.all_points is None else raw.all_points
        below = hd_map.ground(points[:, :3].astype(np.float64))
        road = free_road(
            cells_in_areas(hd_map.outlines, TRUTH_SPEC),
            np.where(np.isnan(ground), low, ground),
            points,
            points[:, 2] - np.where(np.isnan(below), low, below),
            TRUTH_SPEC,
            boxes=() if boxes is None else rows(boxes),
            own_reach=self._ego[1],
        )
        return truth_from_road(road, TRUTH_SPEC)

    def _from_neighbours(self, n: int) -> Truth:
        """Return what neighbouring scans of the sequence agree on around scan n."""
        frame, frames = self._frame(n), self.layout.frames
        truth = Truth(TRUTH_SPEC, np.full(TRUTH_SPEC.shape, np.uint8(CellState.IGNORE)))
        if frame.T_map_sensor is None:
            return truth
        members = [k for k in self.reader.groups[frame.sequence] if frames[k].T_map_sensor is not None]
        poses = np.array([frames[k].T_map_sensor for k in members])
        stamps = np.array([frames[k].stamp for k in members], np.float64)
        back = inverse(frame.T_map_sensor) @ poses  # from each scan to this one
        chosen = choose_neighbours(members.index(n), stamps, poses[:, :3, 3], later=self._later)
        if not chosen:
            return truth
        clouds = []
        for k in chosen:
            raw = self.reader.raw(members[k])
            moving = rows(self._moving_boxes(members[k]).widened(MARGIN))
            kept = ~boxes_over_points(raw.scan.points, moving)
            if raw.moving is not None:
                kept &= ~raw.moving
            clouds.append(transform_points(back[k], raw.scan.points[kept]))
        truth = truth_from_neighbours(
            clouds,
            self.reader.height(n),
            TRUTH_SPEC,
            rows(self._moving_boxes(n)),
            min_scans=1 if len(chosen) < _FEW else 2,
            own=self._points(n),
        )
        state, moving_points = truth.state.copy(), self.reader.raw(n).moving
        if moving_points is not None and moving_points.any():
            state[_near(self._points(n)[moving_points])] = CellState.IGNORE
        # Where the ego vehicle was, at any time, nothing stands that stays: somebody followed it
        state[ego_path_cells(back) & (state == CellState.OCCUPIED)] = CellState.IGNORE
        return Truth(TRUTH_SPEC, state)


def _row(box: Footprint) -> NDArray[np.float64]:
    """Return a footprint as x, y, yaw, length, width."""
    x0, x1, y0, y1 = box
    return np.array([(x0 + x1) / 2, (y0 + y1) / 2, 0.0, x1 - x0, y1 - y0])


def _near(points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the cells that lie near points."""
    from scipy.ndimage import binary_dilation

    result = np.zeros(TRUTH_SPEC.shape, bool)
    inside = TRUTH_SPEC.contains(points[:, 0], points[:, 1])
    result[TRUTH_SPEC.index(points[inside, 0], points[inside, 1])] = True
    reach = int(np.ceil(_AT_MOVING_POINTS / TRUTH_SPEC.resolution))
    return np.asarray(binary_dilation(result, iterations=reach))
