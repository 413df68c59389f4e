"""Truth of recordings from boxes, classes, map and neighbouring scans, and motion of labelled objects."""

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.frames import EGO
from ogm.datasets.neighbours import choose_neighbours, ego_path_cells, truth_from_neighbours
from ogm.datasets.recording import Recording
from ogm.extras import import_extra
from ogm.grid import GridSpec
from ogm.pose import inverse, transform_points
from ogm.scan import Boxes
from ogm.state import CellState, Motion, Truth
from ogm.storage.files import OgmError
from ogm.truth import TRUTH_SPEC, Kind, cells_in_boxes, motion_of_boxes, truth_from_boxes, truth_from_road
from ogm.truth.boxes import (
    MIN_RETURNS,
    boxes_over_points,
    cells_in_areas,
    cells_in_footprint,
    count_returns,
    moving_tracks,
)
from ogm.truth.motion import NEEDED, REACH, BoxMotion, track_motion
from ogm.truth.points import truth_from_points
from ogm.truth.scans import MARGIN, combine_truths, ignore_cells

SOURCES = ("boxes", "classes", "map", "aggregated")
ABOVE_BOTTOM = 0.15  # [m] returns lower than this above a box's bottom may be of the road
_MOVING_MARGIN = 0.3  # [m] cells within this distance of points of a moving class take no state from neighbours
_MIN_NEIGHBOURS = 3  # scans; with fewer neighbours one scan makes a cell known, otherwise two must agree
_MAX_KEPT = 128  # truths in memory, about 0.4 MB each

_DESCRIPTIONS = {
    "boxes": f"occupied: all cells of boxes with {MIN_RETURNS} returns or more in this scan (with fewer: never free)",
    "classes": "free and occupied: cells in which this scan hit labelled ground, or an obstacle 0.05 to 2 m above it",
    "map": "free: visible drivable area of the map without obstacles",
    "aggregated": "free and occupied: states on which {which} scans agree and which this one does not contradict, "
    "{movers}, heights above {ground}",
}


class RecordedTruth:
    """Maker of the truth of the frames of a recording; recent truths are kept, but not pickled.

    Parameters
    ----------
    recording : Recording
    wanted : sequence of str
        Some of `SOURCES`; empty for every available source.
    others : {"all", "later"}
        Neighbouring scans to use, see `open_dataset`.
    """

    def __init__(self, recording: Recording, wanted: Sequence[str] = (), others: str = "all") -> None:
        if unknown := [name for name in wanted if name not in SOURCES]:
            raise ValueError(f"truth must be some of {', '.join(SOURCES)}, got {', '.join(map(repr, unknown))}")
        self.recording, self._options = recording, (tuple(wanted), others)
        there = self._there()
        if missing := [name for name in wanted if name not in there]:
            raise ValueError(
                f"{recording.path} ({recording.format}) has no {' and '.join(missing)} to make truth of; it has "
                f"{', '.join(there) or 'no labels'}: give `truth={','.join(there)}` or less"
            )
        self.sources = tuple(name for name in SOURCES if name in (wanted or there))
        self._later = others == "later"
        self._moving_tracks = lru_cache(None)(self._find_moving)
        self._made = lru_cache(_MAX_KEPT)(self._make)

    def __reduce__(self) -> tuple[Any, ...]:
        return RecordedTruth, (self.recording, *self._options)

    def truth(self, n: int) -> Truth:
        """Return the truth of frame n on `TRUTH_SPEC`, with free, occupied and ignored cells.

        Raises
        ------
        OgmError
            If the recording has no labels and no poses.
        """
        if not self.sources:
            path, kind, wanted = self.recording.path, self.recording.format, self.recording.wanted_labels
            raise OgmError(
                f"{path} ({kind}) has no labels and no poses to make truth of; wanted {wanted}: add them, or give a "
                "folder that has them. Poses of the scans are enough for aggregated truth. Without truth, "
                "`ogm evaluate --agreement` compares methods with each other"
            )
        return self._made(n)

    @property
    def description(self) -> str:
        """Sources of the truth, in one sentence; "" if there is no truth. "This scan" is the frame's scan."""
        if not self.sources:
            return ""
        recording, labelled = self.recording, self.recording.labelled
        which = "later" if self._later else "other"
        objects = "boxes" in labelled or "classes" in labelled
        movers = "without labelled moving objects" if objects else "without labels of moving objects"
        ground = "the map's ground" if "map" in labelled else "the lowest returns per square metre"
        ground = "labelled ground" if "classes" in labelled else ground
        parts = [_DESCRIPTIONS[name].format(which=which, movers=movers, ground=ground) for name in self.sources]
        end = "ignored: all other cells, and contradictions between these (boxes win)"
        view = f" ({recording.view})" if recording.view else ""
        return f"{recording.format}{view}; {'; '.join(parts)}; {end}."

    def _there(self) -> tuple[str, ...]:
        posed = [ref.sequence for ref in self.recording.frames if ref.T_map_sensor is not None]
        neighbours = self.recording.aggregated and len(posed) > len(set(posed))
        there = (*self.recording.labelled, *(["aggregated"] if neighbours else []))
        return tuple(name for name in SOURCES if name in there)

    def _make(self, n: int) -> Truth:
        makers = {"classes": self._from_classes, "map": self._from_map, "aggregated": self._from_neighbours}
        parts = [makers[name](n) for name in self.sources if name in makers]
        labelled, boxes, uncertain = self.recording.boxes(n), None, None
        if "boxes" in self.sources and labelled is not None:
            returns = count_returns(self.recording.scan(n).points, labelled, above_bottom=ABOVE_BOTTOM)
            boxes = truth_from_boxes(labelled, returns, TRUTH_SPEC)
            uncertain = cells_in_boxes(labelled.select(returns < MIN_RETURNS), TRUTH_SPEC)
        return combine_truths(parts, boxes=boxes, uncertain=uncertain, unobserved=self._ego_cells())

    def _ego_cells(self) -> NDArray[np.bool_]:
        return cells_in_footprint(self.recording.ego_footprint or EGO, TRUTH_SPEC)

    # --- Parts ---------------------------------------------------------------------------------------

    def _from_classes(self, n: int) -> Truth:
        raw = self.recording.raw(n)
        kinds = np.zeros(0, np.uint8) if raw.kinds is None else raw.kinds
        return truth_from_points(raw.scan.points, kinds, TRUTH_SPEC, unobserved=self._ego_cells())

    def _from_map(self, n: int) -> Truth:
        """Return the free road of the map; cells without map ground get the ground height under the vehicle."""
        hd_map, raw = self.recording.hd_map(n), self.recording.raw(n)
        low = -self.recording.height(n)
        x, y = np.broadcast_arrays(*TRUTH_SPEC.cell_centers)
        ground = hd_map.ground(np.stack([x.ravel(), y.ravel(), np.full(x.size, low)], axis=1)).reshape(x.shape)
        points = raw.scan.points if raw.all_points is None else raw.all_points
        below = hd_map.ground(points[:, :3].astype(np.float64))
        return truth_from_road(
            cells_in_areas(hd_map.outlines, TRUTH_SPEC),
            np.where(np.isnan(ground), low, ground),
            points,
            points[:, 2] - np.where(np.isnan(below), low, below),
            TRUTH_SPEC,
            boxes=self.recording.boxes(n),
            min_range=(self.recording.ego_footprint or EGO)[1],
        )

    def _from_neighbours(self, n: int) -> Truth:
        """Return the truth on which neighbouring scans of the sequence agree around scan n."""
        recording, frame = self.recording, self.recording.frames[n]
        nothing = Truth(TRUTH_SPEC, np.full(TRUTH_SPEC.shape, np.uint8(CellState.IGNORE)))
        if frame.T_map_sensor is None:
            return nothing
        members = [k for k in self.recording.groups[frame.sequence] if recording.frames[k].T_map_sensor is not None]
        poses = np.array([recording.frames[k].T_map_sensor for k in members])
        stamps = np.array([recording.frames[k].stamp for k in members], np.float64)
        T_here_other = inverse(frame.T_map_sensor) @ poses
        if not (chosen := choose_neighbours(members.index(n), stamps, poses[:, :3, 3], later=self._later)):
            return nothing
        clouds, is_ground = [], []
        for k in chosen:
            raw = self.recording.raw(members[k])
            kept = ~boxes_over_points(raw.scan.points, self._moving_boxes(members[k]).widened(MARGIN))
            if raw.moving is not None:
                kept &= ~raw.moving
            clouds.append(transform_points(T_here_other[k], raw.scan.points[kept]))
            if raw.kinds is not None:
                is_ground.append(raw.kinds[kept] == Kind.GROUND)
        here = self.recording.raw(n)
        truth = truth_from_neighbours(
            clouds,
            TRUTH_SPEC,
            self._moving_boxes(n),
            own=here.scan.points,
            is_ground=is_ground or None,
            map_ground=recording.hd_map(n).ground if "map" in recording.labelled else None,
            min_scans=1 if len(chosen) < _MIN_NEIGHBOURS else 2,
        )
        if here.moving is not None and here.moving.any():
            truth = ignore_cells(truth, _near(here.scan.points[here.moving]))
        # No static object is in the path of the ego vehicle: occupied cells there are of road users that followed it
        return ignore_cells(truth, ego_path_cells(T_here_other) & (truth.state == CellState.OCCUPIED))

    def _find_moving(self, sequence: str) -> frozenset[str]:
        """Return the names of the moving tracks of a sequence."""
        stamps, boxes = [], []
        for n in self.recording.groups[sequence]:
            ref = self.recording.frames[n]
            if ref.T_map_sensor is not None and ref.stamp is not None:
                stamps.append(ref.stamp)
                boxes.append(self.recording.read_boxes(n).moved(ref.T_map_sensor))
        return moving_tracks(stamps, boxes)

    def _moving_boxes(self, n: int) -> Boxes:
        """Return the boxes of moving objects and of objects without a track, in the frame of scan n."""
        if (boxes := self.recording.boxes(n)) is None:
            return Boxes.empty()
        moving = self._moving_tracks(self.recording.frames[n].sequence)
        return boxes.select([not track or track in moving for track in boxes.track])


def _near(points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return a mask of the cells within `_MOVING_MARGIN` of points, (nx, ny)."""
    result = np.zeros(TRUTH_SPEC.shape, bool)
    inside = TRUTH_SPEC.contains(points[:, 0], points[:, 1])
    result[TRUTH_SPEC.index(points[inside, 0], points[inside, 1])] = True
    reach = int(np.ceil(_MOVING_MARGIN / TRUTH_SPEC.resolution))
    return np.asarray(import_extra("scipy.ndimage", "evaluate").binary_dilation(result, iterations=reach))


_NEXT = 0.15  # [s] reach of the frames before and after at 10 Hz
_KEPT_FRAMES = 16  # frames in memory, a few kB each


class MotionReader:
    """Reader of the motion of objects in the frames of a recording; results are kept, but not pickled.

    If the dataset states velocities, only yaw rates are computed, from the frames before and after. Otherwise both
    are slopes of the objects' tracks over 0.5 to 0.7 s, see `ogm.truth.motion.track_motion`; the first and the last
    0.3 s of a track then have no motion.

    Parameters
    ----------
    recording : Recording
    """

    def __init__(self, recording: Recording) -> None:
        self.recording = recording
        self._placed = lru_cache(_KEPT_FRAMES)(self._on_map)
        self._found = lru_cache(_KEPT_FRAMES)(self._find)
        self._members = lru_cache(None)(self._of_sequence)

    def __reduce__(self) -> tuple[Any, ...]:
        return MotionReader, (self.recording,)

    def boxes(self, n: int) -> Boxes | None:
        """Return the boxes around a scan, in the sensor's frame, with velocities if they are known."""
        boxes = self.recording.boxes(n)
        if boxes is None or boxes.velocity is not None:
            return boxes
        found = self._found(n)
        return boxes if found is None else replace(boxes, velocity=found.velocity)

    def cells(self, n: int, spec: GridSpec) -> Motion | None:
        """Return the motion of the cells around a scan, or None if the motion of objects is not known.

        Cells under the ego vehicle and outside the labelled view are unknown.
        """
        boxes, found = self.boxes(n), self._found(n)
        if boxes is None or found is None:
            return None
        unknown = cells_in_footprint(self.recording.ego_footprint or EGO, spec)
        if self.recording.view_angle is not None:
            x, y = spec.cell_centers
            unknown |= np.abs(y) > np.tan(self.recording.view_angle) * x
        return motion_of_boxes(boxes, found.yaw_rate, spec, unknown=unknown)

    def _find(self, n: int) -> BoxMotion | None:
        """Return the motion of the boxes of a scan in the sensor's frame, or None without poses or stamps."""
        frame, boxes = self.recording.frames[n], self.recording.boxes(n)
        if boxes is None or frame.stamp is None or frame.T_map_sensor is None or not frame.sequence:
            return None
        reach, needed = (REACH, NEEDED) if boxes.velocity is None else (_NEXT, 0.0)
        members, stamps = self._members(frame.sequence)
        near = np.abs(stamps - frame.stamp) < 1.1 * reach
        around = members[near].tolist()
        placed = [self._placed(k) for k in around]
        found = track_motion(around.index(n), stamps[near].tolist(), placed, reach=reach, needed=needed)
        if boxes.velocity is not None:
            return BoxMotion(boxes.velocity, found.yaw_rate)
        return BoxMotion(found.velocity @ inverse(frame.T_map_sensor)[:2, :2].T, found.yaw_rate)

    def _of_sequence(self, sequence: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return numbers and stamps [s] of the frames of a sequence that have a pose and a stamp."""
        refs = [(k, self.recording.frames[k]) for k in self.recording.groups[sequence]]
        known = [(k, ref.stamp) for k, ref in refs if ref.T_map_sensor is not None and ref.stamp is not None]
        return np.array([k for k, _ in known], np.int64), np.array([stamp for _, stamp in known], np.float64)

    def _on_map(self, n: int) -> Boxes:
        """Return the boxes of a scan in the map's frame."""
        return self.recording.read_boxes(n).moved(np.asarray(self.recording.frames[n].T_map_sensor))
