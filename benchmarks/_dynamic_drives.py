"""A dynamic map over a drive, against the truth of every frame: motion, times to detection, predictions."""

import copy
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from _dynamic_filters import Reading
from _fusion_drives import PAPER
from numpy.typing import NDArray

from ogm import Boxes, EvidentialGrid, Frame
from ogm.dynamic_grid import DynamicGrid
from ogm.grid import GridSpec
from ogm.metrics import MotionSums, PredictionSums, accumulate_motion, accumulate_prediction, detection_times, distances
from ogm.metrics.detection_time import Detection, ObjectCells, object_cells
from ogm.metrics.motion import MOVING
from ogm.state import Motion, Truth

HORIZONS = (0.5, 1.0, 2.0)  # [s]
EVERY = 0.5  # [s] from one prediction to the next
WARM_UP = 9  # scans of a drive before the first that is evaluated
SAME = 0.02  # [s] by which the stamp of a later frame may miss the time of a prediction
OCCUPIED = 0.5  # mass above which the scan shows a cell as occupied
DISTANCE = distances(PAPER)


class Snapshot(NamedTuple):
    """Truth and scan of a frame on the cells of `PAPER`; the same for all maps.

    Attributes
    ----------
    frame : Frame
    pose : (4, 4) float64
        Takes the cells to the map.
    truth : Truth
        With motion, of all cells around.
    motion : Motion
        On `PAPER`, NaN beyond what is evaluated.
    occupied : (512, 352) bool
        What the scan shows.
    """

    frame: Frame
    pose: NDArray[np.float64]
    truth: Truth
    motion: Motion
    occupied: NDArray[np.bool_]


class DriveSums(NamedTuple):
    """Sums of one map over one drive; predictions by horizon: the map's own, and without motion."""

    motion: MotionSums
    detections: list[Detection]
    predicted: dict[float, PredictionSums]
    standing: dict[float, PredictionSums]


def snapshots(
    frames: Sequence[Frame], poses: NDArray[np.float64], grids: Sequence[EvidentialGrid], within: float = np.inf
) -> list[Snapshot]:
    """Return truth and scans of the frames of a drive; motion is evaluated up to a distance [m]."""
    found = []
    for frame, pose, grid in zip(frames, poses, grids, strict=True):
        motion = frame.truth.crop(PAPER).motion
        velocity = np.where((within >= DISTANCE)[..., None], motion.velocity, np.float32(np.nan))
        occupied = grid.occupied > OCCUPIED
        found.append(Snapshot(frame, pose, frame.truth, Motion(velocity, motion.box), occupied))
    return found


class Recorder:
    """A mapper that is compared with the truth after each update, with the interface of the mapper.

    Parameters
    ----------
    mapper : object
        With `update` and `dynamic_view`; predictions need `dynamic_grid`, and `predicted` unless nothing moves on.
    drive : list of Snapshot
    readings : dict of str to Reading
        How the map is read, by the names of the results; predictions are of the first alone.
    """

    def __init__(self, mapper: Any, drive: Sequence[Snapshot], readings: Mapping[str, Reading]) -> None:
        self.mapper, self._drive, self._readings = mapper, drive, readings
        self._sums = {name: MotionSums.zeros() for name in readings}
        self._objects: dict[str, list[tuple[float, ObjectCells]]] = {name: [] for name in readings}
        self._forecasts = {kind: {h: PredictionSums.zeros() for h in HORIZONS} for kind in ("own", "standing")}
        self._made: list[tuple[int, str, float, DynamicGrid, NDArray[np.bool_]]] = []
        self._next, self._k = -np.inf, -1

    grid = property(lambda self: self.mapper.grid)

    def view(self, spec: GridSpec) -> EvidentialGrid:
        """Return the mapper's view."""
        return self.mapper.view(spec)

    def update(self, grid: EvidentialGrid, T_map_sensor: NDArray[np.float64], *, stamp: float) -> None:
        """Update the mapper and compare it."""
        self.mapper.update(grid, T_map_sensor, stamp=stamp)
        self.compare(stamp)

    def compare(self, stamp: float) -> None:
        """Compare the mapper with the next frame of the drive."""
        self._k += 1
        here = self._drive[self._k]
        seen = self.mapper.dynamic_view(PAPER)
        boxes = Boxes.empty() if here.frame.boxes is None else here.frame.boxes
        for name, (read, predicted) in self._readings.items():
            grid_read = read(seen)
            moving = predicted(grid_read)
            if self._k >= WARM_UP:
                sums = accumulate_motion(grid_read, here.motion, here.occupied, boxes.label, DISTANCE, moving)
                self._sums[name] = self._sums[name].plus(sums)
            self._objects[name].append((stamp, object_cells(here.motion, here.occupied, moving, boxes.track)))
        if hasattr(type(self.mapper), "dynamic_grid"):
            self._compare_predictions(here)
            if self._k >= WARM_UP and stamp >= self._next - SAME:
                self._next = stamp + EVERY
                self._predict(here)

    def _predict(self, here: Snapshot) -> None:
        times = {other.frame.stamp - here.frame.stamp: k for k, other in enumerate(self._drive) if k > self._k}
        read = next(iter(self._readings.values())).grid
        now = read(self.mapper.dynamic_grid)
        moves = self._on_map(here, now.spec)[2]
        for horizon in HORIZONS:
            at = [k for seconds, k in times.items() if abs(seconds - horizon) <= SAME]
            for k in at[:1]:
                self._made.append((k, "standing", horizon, now, moves))
                if hasattr(type(self.mapper), "predicted"):
                    self._made.append((k, "own", horizon, read(self.mapper.predicted(horizon)), moves))

    def _compare_predictions(self, here: Snapshot) -> None:
        ready = [one for one in self._made if one[0] == self._k]
        self._made = [one for one in self._made if one[0] > self._k]
        cache: dict[GridSpec, Any] = {}
        for _, kind, horizon, grid, moving_before in ready:
            if grid.spec not in cache:
                cache[grid.spec] = self._on_map(here, grid.spec)
            truth, occupied, _ = cache[grid.spec]
            sums = accumulate_prediction(grid, truth, occupied, moving_before)
            self._forecasts[kind][horizon] = self._forecasts[kind][horizon].plus(sums)

    @staticmethod
    def _on_map(here: Snapshot, spec: GridSpec) -> tuple[Truth, NDArray[np.bool_], NDArray[np.bool_]]:
        """Return truth, cells that the scan shows, and cells that move, on cells of the map."""
        yaw, (x, y) = float(np.arctan2(here.pose[1, 0], here.pose[0, 0])), here.pose[:2, 3].tolist()
        around = Truth(PAPER, here.truth.crop(PAPER).state, motion=here.motion)
        truth = around.crop(spec, yaw, x, y)
        shown = Truth(PAPER, here.occupied.astype(np.uint8)).crop(spec, yaw, x, y).state == 1
        speed = np.hypot(truth.motion.velocity[..., 0], truth.motion.velocity[..., 1])
        return truth, shown, speed > MOVING

    def results(self) -> dict[str, DriveSums]:
        """Return the sums of the drive by reading."""
        found, first = {}, next(iter(self._readings))
        nothing = {h: PredictionSums.zeros() for h in HORIZONS}
        for name in self._readings:
            own, standing = (one if name == first else nothing for one in self._forecasts.values())
            found[name] = DriveSums(self._sums[name], detection_times(self._objects[name]), own, standing)
        return found


def over_drive(
    mapper: Any, drive: Sequence[Snapshot], grids: Sequence[EvidentialGrid], readings: Mapping[str, Reading]
) -> dict[str, DriveSums]:
    """Run a map over a drive and return its sums by reading."""
    recorder = Recorder(mapper, drive, readings)
    for here, grid in zip(drive, grids, strict=True):
        recorder.update(grid, here.pose, stamp=here.frame.stamp)
    return recorder.results()


def with_layers(frames: Sequence[Frame], share: int) -> Iterator[Frame]:
    """Yield frames with every `share`-th layer of their scans, of scans whose points are sorted by layer."""
    for frame in frames:
        if share == 1:
            yield frame
            continue
        other = copy.copy(frame)
        scan = frame.scan
        angle = np.arctan2(scan.points[:, 1], scan.points[:, 0]) % (2 * np.pi)
        ring = np.concatenate([[0], np.cumsum(np.diff(angle) < -np.pi)]) if scan.ring is None else scan.ring
        object.__setattr__(other, "scan", scan.select(ring % share == 0))
        yield other
