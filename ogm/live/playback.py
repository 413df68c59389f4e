"""Playback of frames as they arrive or at their stamps, with a queue of the newest frame per sensor."""

import math
import threading
import time
from collections.abc import Iterable, Iterator
from threading import Event

from ogm.fusion.pipeline import OnError
from ogm.fusion.update_gate import MAX_GAP
from ogm.scan import Frame
from ogm.storage.files import OgmError


class NewestFrames:
    """Queue between the reading and the mapping thread, with at most one frame per sensor (`Scan.sensor`).

    A frame thus waits at most for the mapping of one frame of every sensor.

    Attributes
    ----------
    dropped : int
        Number of frames replaced by a newer frame of their sensor before mapping, or counted by `drop`.
    due : float
        Time at which the last mapped frame became available, by `time.monotonic` [s].
    """

    def __init__(self) -> None:
        self.dropped = 0
        self.due = 0.0
        self._waiting: dict[str, tuple[Frame, float]] = {}  # in the order of mapping
        self._changed = threading.Condition()
        self._closed = False

    def put(self, frame: Frame, due: float | None = None) -> None:
        """Queue a frame with its scan already read; an older frame of its sensor is dropped.

        Parameters
        ----------
        frame : Frame
        due : float, optional
            Time at which it became available, by `time.monotonic` [s]; by default now.
        """
        with self._changed:
            self.dropped += frame.scan.sensor in self._waiting  # the new frame takes its position in the queue
            self._waiting[frame.scan.sensor] = frame, time.monotonic() if due is None else due
            self._changed.notify()

    def drop(self) -> None:
        """Count a frame that was dropped unread."""
        with self._changed:
            self.dropped += 1

    def close(self) -> None:
        """End the iteration after the waiting frames."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames as soon as they are queued, until `close`."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if not self._waiting:
                    return
                frame, self.due = self._waiting.pop(next(iter(self._waiting)))
            yield frame


LEAD = 0.2  # [s] between the start of a sequence and its first frame, to read the frame
MAX_DELAY = 0.05  # [s] after which overdue frames are dropped unread, until a frame is on time
MAX_STEP_BACK = 1.0  # [s] by which stamps may decrease within a recording
_UNREADABLE = (ValueError, TypeError, OSError)


def read_ahead(frames: Iterable[Frame], newest: NewestFrames, stop: Event, on_error: OnError) -> None:
    """Queue frames as they arrive, until they end or `stop` is set.

    Parameters
    ----------
    frames : iterable of Frame
    newest : NewestFrames
        Queue.
    stop : Event
    on_error : function
        Called with each unreadable frame and its error.
    """
    for frame in frames:
        due = time.monotonic()
        if stop.is_set():
            return
        if _read(frame, on_error):
            newest.put(frame, due)


def play(frames: Iterable[Frame], rate: float, newest: NewestFrames, stop: Event, on_error: OnError) -> None:
    """Queue frames at their stamps, until they end or `stop` is set.

    Frames are read before they are due. If reading falls behind, overdue frames are dropped unread.

    Parameters
    ----------
    frames : iterable of Frame
        Frames with stamps; their scans are read on demand.
    rate : float
        Speed of the clock: 2 plays twice as fast.
    newest, stop, on_error
        See `read_ahead`.

    Raises
    ------
    OgmError
        If a frame has no stamp.
    """
    clock, catching_up = _Clock(rate), False
    for frame in frames:
        due = clock.due(frame)
        late = time.monotonic() - due
        catching_up = late > (0.0 if catching_up else MAX_DELAY)
        if catching_up:
            newest.drop()
            continue
        readable = _read(frame, on_error)
        if stop.wait(max(due - time.monotonic(), 0.0)):
            return
        if readable:
            newest.put(frame, due)


class _Clock:
    """Clock of a playback, restarted for each sequence."""

    def __init__(self, rate: float) -> None:
        if not 0 < rate < math.inf:
            raise ValueError(f"rate must be above 0 and finite, 1 for real time, got {rate}")
        self.rate = rate
        self.sequence: str | None = None
        self.origin = self.start = self.last = 0.0  # [s] stamp and due time of the first frame, and the last stamp

    def due(self, frame: Frame) -> float:
        """Return the time at which a frame is due, by `time.monotonic` [s]."""
        if frame.stamp is None:
            raise OgmError(f"{frame.name} has no stamp, so that it cannot be played at its time: give times or poses")
        if frame.sequence != self.sequence or not self.last - MAX_STEP_BACK <= frame.stamp <= self.last + MAX_GAP:
            self.sequence, self.origin, self.start = frame.sequence, frame.stamp, time.monotonic() + LEAD
        self.last = frame.stamp
        return self.start + (frame.stamp - self.origin) / self.rate


def _read(frame: Frame, on_error: OnError) -> bool:
    """Read scan and mount of a frame in this thread; return whether they are readable."""
    try:
        frame.scan, frame.mount  # noqa: B018
    except _UNREADABLE as error:
        on_error(frame, error)
        return False
    return True
