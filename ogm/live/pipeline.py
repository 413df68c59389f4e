"""Mapping and publishing frames in real time: `serve`, and `warm_up` to compile kernels before."""

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
from ogm.live.memory import release_free_memory
from ogm.live.playback import NewestFrames, play, read_ahead
from ogm.pose import pose
from ogm.scan import Frame, Mount, Scan, SensorModels

_logger = logging.getLogger(__name__)

Publish = Callable[[FusionStep, Mapper], object]

MAX_LATENCIES = 10_000  # stored for quantiles, so that memory is bounded
RELEASE_EVERY = 10.0  # [s] between calls of `release_free_memory`


class LiveReport(NamedTuple):
    """Counts and latencies of `serve`.

    Attributes
    ----------
    seconds : float
        Time since the start [s].
    mapped, dropped, failed : int
        Numbers of frames: mapped and published; replaced by newer frames before mapping; damaged, without pose or
        rejected by the mapper.
    p50, p99, worst : float
        Median, 99 % quantile and maximum of the latency of the last 10 000 mapped frames, from the arrival of a frame
        to the publication of its map [s]. NaN without mapped frames.
    distorted : int
        Number of mapped frames during which the vehicle turned by more than 2 degrees, so that points may be
        displaced: `serve` does not de-skew.
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
        p50, p99, worst = (f"{1e3 * latency:.1f} ms" for latency in (self.p50, self.p99, self.worst))
        turned = f"; {self.distorted} distorted by a turn, `ogm fuse --deskew` corrects it" if self.distorted else ""
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
    """Map frames and publish the map without falling behind.

    The calling thread reads the frames and their scans; another thread maps and publishes. If mapping is slower than
    the frames, the newest waiting frame of each sensor is mapped, and older frames are dropped. Ctrl-C ends the run as
    `stop` does, after the waiting frame.

    Parameters
    ----------
    frames : iterable of Frame
        Frames with `T_map_sensor` and `stamp`: a dataset, `receive_frames`, or a driver's generator.
    ism : callable with `spec`, or mapping of str to these
        Sensor model: ``ism(scan) -> EvidentialGrid``.
    mapper : EvidentialMapper or BinaryBayesMapper
        Updated in place.
    publish : function
        Called in the mapping thread after each fused frame, with the step of `ogm.fusion.fuse` and the mapper, such as
        a `FoxglovePublisher`.
    rate : float, optional
        Speed of playback at the frames' stamps, 1 for real time; by default frames are available when the iterable
        yields them.
    duration : float, optional
        Time after which to stop [s]; by default at the end of `frames`.
    stop : threading.Event, optional
        Event that ends `serve`: immediately while it waits for a stamp, else at the next frame.
    on_error : function
        Called with each failed frame and its error; by default the error is logged.
    on_report : function
        Called with a report every `report_every` seconds.
    report_every : float
        Interval between reports [s].

    Returns
    -------
    LiveReport
        Report of the whole run.

    Raises
    ------
    ValueError
        If `rate`, `duration` or `report_every` is not above 0.
    OgmError
        If a frame to play has no stamp.
    """
    for name, value in (("duration", duration), ("report_every", report_every)):
        if value is not None and not value > 0:
            raise ValueError(f"{name} must be above 0 s, got {value}")
    stop = stop or threading.Event()
    newest = NewestFrames()
    log = _Log(newest, on_error)

    def map_frames() -> None:
        """Fuse and publish frames until the end."""
        reported, released, explained = log.start, log.start, False
        last: FusionStep | None = None
        distorted = getattr(frames, "motion_distorted", True)
        try:
            for step in fuse(newest, ism, mapper, on_error=log.failed):
                if step.restart:
                    _logger.warning("%s: %s; a new map begins", step.frame.name, step.restart)
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
                if now - released >= RELEASE_EVERY:
                    released = now
                    release_free_memory()
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
    """Map a frame a few times and discard the map, to compile or load kernels; return the time.

    Parameters
    ----------
    ism : callable with `spec`, or mapping of str to these
    mapper : EvidentialMapper or BinaryBayesMapper
        Not changed.
    frame : Frame, optional
        Frame with a pose, similar to the frames to map; by default level ground 1.8 m below the sensor.

    Returns
    -------
    float
        Time [s].
    """

    def fail(frame: Frame, error: Exception) -> None:
        raise error

    start = time.perf_counter()
    spare = copy.deepcopy(mapper)
    spare.reset()
    if frame is None:
        frame = Frame(Scan(_level_ground(1.8)), Mount(1.8), T_map_sensor=pose(z=1.8), stamp=0.0)
    for _ in fuse([frame] * 4, ism, spare, on_error=fail):  # engines of networks prepare themselves in three
        _ = spare.grid
    return time.perf_counter() - start


class _Log:
    """Counts and latencies of a run; frames may fail in both threads."""

    def __init__(self, newest: NewestFrames, on_error: OnError) -> None:
        self.start = time.monotonic()
        self._newest, self._on_error = newest, on_error
        self._latencies: deque[float] = deque(maxlen=MAX_LATENCIES)
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
    """Return the points of 32 lasers on level ground, (N, 4)."""
    azimuth = np.linspace(-np.pi, np.pi, 360, endpoint=False)
    distance = height / np.tan(np.deg2rad(np.linspace(3, 30, 32)))
    x, y = np.outer(distance, np.cos(azimuth)).ravel(), np.outer(distance, np.sin(azimuth)).ravel()
    return np.column_stack([x, y, np.full(x.size, -height), np.zeros(x.size)]).astype(np.float32)
