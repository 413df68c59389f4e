"""Work of an evaluation: frames by all methods, in this process or in independent parts."""

import copy
import pickle
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.evaluation.cache import FrameResult, ResultCache
from ogm.evaluation.frame_pictures import draw_motion
from ogm.evaluation.methods import FusedMethod, Method, MethodRunner
from ogm.evaluation.motion import Predictions, compare_motion
from ogm.grid import GridSpec
from ogm.metrics import accumulate, distances
from ogm.pose import transform_points
from ogm.scan import Frame
from ogm.storage.workers import deaths_explained, work_off

NO_TRUTH = "evaluate labelled data, or compare methods with each other by evaluate_agreement (`--agreement`)"
_BATCH = 20  # independent frames of one part

Draw = Callable[..., dict[str, bytes]]
Progress = Callable[[Iterable[int]], Iterable[int]]


@dataclass(frozen=True)
class FrameTask:
    """Evaluation of frames by all methods.

    Parameters
    ----------
    methods : dict of str to method
    spec : GridSpec
        Evaluated cells.
    dataset : sequence of Frame
    draw : function, optional
        Draws the pictures of a frame, see `ogm.evaluation.frame_pictures.draw_frame`.
    """

    methods: Mapping[str, Method]
    spec: GridSpec
    dataset: Sequence[Frame]
    draw: Draw | None

    def run(
        self, numbers: Sequence[int], progress: Progress = iter, cache: ResultCache | None = None
    ) -> Iterator[tuple[int, FrameResult | None]]:
        """Evaluate frames in order in this process; yield each number with its result, or None if it is cached."""
        runner = MethodRunner(self.methods, self.spec)
        wanted, away, predictions = set(numbers), distances(self.spec), Predictions()
        for number in progress(self.to_read(numbers)):
            frame = self.dataset[number]
            runner.update(frame, evaluated=number in wanted)
            if number in wanted:
                result = self._evaluate(runner, predictions, frame, away)
                if cache is not None:
                    cache.save(number, result)
                yield number, None if cache is not None else result
            for place, method in runner.dynamic.items():
                predictions.predict(place, method, frame)

    def share_out(
        self, numbers: Sequence[int], progress: Progress, cache: ResultCache | None, workers: int, scheduler: str | None
    ) -> Iterator[tuple[int, FrameResult | None]]:
        """Evaluate frames with processes on this machine or a Dask cluster; yield as `run`, in any order."""
        if cache is not None:
            cache = copy.copy(cache)
            cache.folder = cache.folder.resolve()
        try:
            packed = _Packed(pickle.dumps((self, cache)))
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise TypeError(
                f"methods and dataset must be picklable for other processes ({error}): give functions and classes of "
                "modules, no lambdas, or use one worker"
            ) from error
        parts = self._parts(numbers)
        ticks = iter(progress([number for part in parts for number in part]))
        next(ticks, None)  # shows the bar before the first part is done
        with closing(work_off(packed, parts, workers, scheduler)) as done, deaths_explained("frames"):
            for k, found in done:
                for _ in islice(ticks, len(parts[k])):
                    pass
                yield from found

    def _evaluate(
        self, runner: MethodRunner, predictions: Predictions, frame: Frame, away: NDArray[Any]
    ) -> FrameResult:
        """Return the result of the runner's last frame."""
        spec = self.spec
        if frame.truth is None:
            raise ValueError(f"frame {frame.name} has no truth to compare with; {NO_TRUTH}")
        truth = frame.truth.crop(spec)
        state = truth.state
        masses = [grid.mass for grid in runner.grids().values()]
        sums = tuple(accumulate(mass, state, away, truth.height_cm) for mass in masses)
        shares = np.bincount(state.ravel(), minlength=4) / state.size
        dynamic = runner.dynamic_grids()
        moved = truth.motion if dynamic else None
        motion = {}
        if moved is not None:
            for k, (grid, occupied) in dynamic.items():
                predicted = predictions.compare(k, frame, truth, occupied)
                motion[k] = compare_motion(grid, occupied, moved, frame.boxes, predicted)
        pictures: dict[str, bytes] = {}
        if self.draw is not None:
            points, ground_z = _points(frame)
            pictures = self.draw(points, state, masses, spec, ground_z)
            if moved is not None:
                pictures |= {f"motion {k}": draw_motion(dynamic[k][0], moved) for k in motion}
        return FrameResult(sums, shares, pictures, motion)

    @property
    def _fuses(self) -> bool:
        return any(isinstance(method, FusedMethod) for method in self.methods.values())

    def to_read(self, numbers: Sequence[int]) -> list[int]:
        """Return the frames to read: the given frames, and for fused methods all earlier frames of their sequences."""
        if not self._fuses:
            return list(numbers)
        last = {self.dataset[k].sequence: k for k in numbers}
        return [k for k in range(len(self.dataset)) if k <= last.get(self.dataset[k].sequence, -1)]

    def _parts(self, numbers: Sequence[int]) -> list[list[int]]:
        """Return the frames in independent parts: sequences for fused methods, else batches."""
        if not self._fuses:
            size = max(1, min(_BATCH, len(numbers) // 8))
            return [list(numbers[k : k + size]) for k in range(0, len(numbers), size)]
        parts: dict[str, list[int]] = {}
        for k in numbers:
            parts.setdefault(self.dataset[k].sequence, []).append(k)
        return list(parts.values())


@dataclass(frozen=True)
class _Packed:
    """A pickled task with its cache, unpickled once per worker."""

    data: bytes

    def __call__(self, part: list[int]) -> list[tuple[int, FrameResult | None]]:
        with _one_at_a_time:
            task, cache = _unpacked(self.data)
            return list(task.run(part, cache=cache))


_unpacked = lru_cache(1)(pickle.loads)
_one_at_a_time = threading.Lock()  # threads of a Dask worker share one set of methods


def _points(frame: Frame) -> tuple[NDArray[Any] | None, float]:
    """Return points in the levelled vehicle frame, and the ground's z there."""
    try:
        scan, mount = frame.scan, frame.mount
    except ValueError:  # a folder of truth grids has no scans
        return None, 0.0
    return transform_points(mount.T_vehicle_points, scan.points), mount.ground_point[2]
