"""Mapping and publishing frames while they are new: `serve`, and `warm_up` before the first of them."""

import copy
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.fusion import FusionStep, Mapper, fuse
from ogm.fusion.pipeline import MAX_TURN, OnError, log_error, turn_within_scan
from ogm.geometric.inputs import explain_nothing, shows_nothing
from ogm.live.playback import NewestFrames, play, read_ahead
from ogm.pose import pose
from ogm.scan import Frame, Mount, Scan, SensorModels

_logger = logging.getLogger(__name__)

Publish = Callable[[FusionStep, Mapper], object]

KEPT = 10_000  # latencies from which quantiles are computed: memory stays flat


class LiveReport(NamedTuple):
    """What `serve` did so far.

    Attributes
    ----------
    seconds : float
        Since it began [s].
    mapped, dropped, failed : int
        Frames: in the map and published; replaced by newer ones before they were mapped; damaged, without pose or
        refused by the mapper.
    p50, p99, worst : float
        Median, 99 % quantile and maximum of the latency of the last 10 000 mapped frames [s]: from when a frame became
        available to when its map was published. NaN if there is none.
    distorted : int
        Mapped frames whose points may be off, since the vehicle turned by more than 2 degrees while the scan was taken:
        `serve` does not de-skew.
    """

    seconds: float
    mapped: int
    dropped: int
    failed: int
    p50: float
    p99: float
    worst: float
    distorted: int = 0

    def __str__(self) -> str:
        counts = f"{self.mapped} mapped, {self.dropped} dropped, {self.failed} failed"
        p50, p99, worst = (f"{1e3 * one:.1f} ms" for one in (self.p50, self.p99, self.worst))
        turned = f"; {self.distorted} distorted by a turn, `ogm fuse --deskew` undoes it" if self.distorted else ""
        return f"{self.seconds:.0f} s: {counts}; latency p50 {p50}, p99 {p99}, worst {worst}{turned}"


def serve(
    frames: Iterable[Frame],
    ism: SensorModels,
    mapper: Mapper,
    publish: Publish,
    *,
    rate: float | None = None,
    duration: float | None = None,
    stop: threading.Event | None = None,
    on_error: OnError = log_error,
    on_report: Callable[[LiveReport], object] = lambda report: None,
    report_every: float = 5.0,
) -> LiveReport:
    """Map frames and publish the map, never falling behind.

    The calling thread takes the frames and reads their scans; another one maps and publishes. Where mapping takes
    longer than a frame lasts, the newest waiting frame of each sensor is mapped, and older ones are dropped. Ctrl-C
    ends it as `stop` does: after the frame that waits.

    Parameters
    ----------
    frames : iterable of Frame
        A data set, `receive_frames`, or a driver's own generator; each needs `T_map_sensor` and `stamp`.
    ism : callable with `spec`, or mapping of str to these
        The sensor model: ``ism(scan) -> EvidentialGrid``.
    mapper : EvidentialMapper or BinaryBayesMapper
        Updated in place.
    publish : function
        Called with a step of `ogm.fusion.fuse` and the mapper after every frame that was fused, in the thread that
        maps: a `FoxglovePublisher`, or what sends the map elsewhere.
    rate : float, optional
        Play recorded frames at their stamps, this many times as fast; by default each is available when the iterable
        gives it.
    duration : float, optional
        When to stop [s]; by default at the end of `frames`.
    stop : threading.Event, optional
        Set from anywhere, it ends `serve`: while it waits for a stamp at once, else with the next frame.
    on_error : function
        Called with every frame that fails, and its error; by default it is logged.
    on_report : function
        Called with a report every few seconds.
    report_every : float
        [s]

    Returns
    -------
    LiveReport
        Of the whole time.

    Raises
    ------
    ValueError
        If `rate`, `duration` or `report_every` is not above 0.
    OgmError
        If a frame that is played has no stamp.
    """
    for name, value in (("duration", duration), ("report_every", report_every)):
        if value is not None and not value > 0:
            raise ValueError(f"{name} must be above 0 s, got {value}")
    stop = stop or threading.Event()
    newest = NewestFrames()
    log = _Log(newest, on_error)

    def map_frames() -> None:
        """Fuse and publish what comes, until there is no more."""
        reported, explained = log.start, False
        last: FusionStep | None = None
        distorted = getattr(frames, "motion_distorted", True)
        try:
            for step in fuse(newest, ism, mapper, on_error=log.failed):
                if step.restart:
                    _logger.warning("%s: %s; the map begins anew", step.frame.name, step.restart)
                if step.grid is None:
                    continue
                if not explained and shows_nothing(step.frame.scan, step.grid):
                    explained = True
                    text = explain_nothing(step.frame.scan, step.grid.spec, step.frame.mount)
                    _logger.warning("%s: %s", step.frame.name, text)
                publish(step, mapper)
                now = time.monotonic()
                turn = turn_within_scan(last, step) if distorted and last is not None else 0.0
                log.mapped(now - newest.due, turn > MAX_TURN)
                last = step
                if now - reported >= report_every:
                    reported = now
                    on_report(log.report())
        except BaseException:
            stop.set()
            raise

    timer = threading.Timer(duration or 0.0, stop.set)
    with ThreadPoolExecutor(1, "ogm-mapping") as pool:
        mapping = pool.submit(map_frames)
        try:
            if duration is not None:
                timer.start()
            if rate is None:
                read_ahead(frames, newest, stop, log.failed)
            else:
                play(frames, rate, newest, stop, log.failed)
        except KeyboardInterrupt:
            stop.set()
        finally:
            timer.cancel()
            newest.close()
    mapping.result()
    return log.report()


def warm_up(ism: SensorModels, mapper: Mapper, frame: Frame | None = None) -> float:
    """Map a frame for nothing, so that kernels are compiled, or loaded, before the first scan; return how long it took.

    Parameters
    ----------
    ism : callable with `spec`, or mapping of str to these
    mapper : EvidentialMapper or BinaryBayesMapper
        Stays as it is.
    frame : Frame, optional
        With a pose, like those that will come; by default a level ground seen from 1.8 m, without pose or echo of
        anything else.

    Returns
    -------
    float
        [s]
    """

    def fail(frame: Frame, error: Exception) -> None:
        raise error

    start = time.perf_counter()
    spare = copy.deepcopy(mapper)
    spare.reset()
    if frame is None:
        frame = Frame(Scan(_level_ground(1.8)), Mount(1.8), T_map_sensor=pose(z=1.8), stamp=0.0)
    for _ in fuse([frame, frame], ism, spare, on_error=fail):
        pass
    return time.perf_counter() - start


class _Log:
    """Counts and latencies of a run. Frames may fail in both threads."""

    def __init__(self, newest: NewestFrames, on_error: OnError) -> None:
        self.start = time.monotonic()
        self._newest, self._on_error = newest, on_error
        self._latencies: deque[float] = deque(maxlen=KEPT)
        self._mapped = self._failed = self._distorted = 0
        self._lock = threading.Lock()

    def mapped(self, latency: float, distorted: bool) -> None:
        self._mapped += 1
        self._distorted += distorted
        self._latencies.append(latency)

    def failed(self, frame: Frame, error: Exception) -> None:
        with self._lock:
            self._failed += 1
        self._on_error(frame, error)

    def report(self) -> LiveReport:
        found = np.array(self._latencies if self._latencies else [np.nan])
        p50, p99, worst = np.percentile(found, (50, 99, 100)).tolist()
        seconds = time.monotonic() - self.start
        return LiveReport(seconds, self._mapped, self._newest.dropped, self._failed, p50, p99, worst, self._distorted)


def _level_ground(height: float) -> NDArray[np.float32]:
    """Return the points of 32 lasers on a level ground, (N, 4)."""
    azimuth = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    distance = height / np.tan(np.deg2rad(np.linspace(3, 30, 32)))
    x, y = np.outer(distance, np.cos(azimuth)).ravel(), np.outer(distance, np.sin(azimuth)).ravel()
    return np.column_stack([x, y, np.full(x.size, -height), np.zeros(x.size)]).astype(np.float32)
