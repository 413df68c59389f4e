"""Frames become available as they come, or at their stamps; of each sensor the newest waits, older ones are dropped."""

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
    """Frames on their way from the thread that reads to the one that maps; at most one of each sensor waits.

    However slow the mapping is, a frame waits no longer than one frame of every sensor takes. `Scan.sensor` names the
    sensor.

    Attributes
    ----------
    dropped : int
        Frames that a newer one of their sensor replaced before they were mapped, and those of `drop`.
    due : float
        When the frame that was taken last became available, by `time.monotonic` [s].
    """

    def __init__(self) -> None:
        self.dropped = 0
        self.due = 0.0
        self._waiting: dict[str, tuple[Frame, float]] = {}  # in the order of their turns
        self._changed = threading.Condition()
        self._closed = False

    def put(self, frame: Frame, due: float | None = None) -> None:
        """Let a frame wait, whose scan has been read; an older one of its sensor is dropped.

        Parameters
        ----------
        frame : Frame
        due : float, optional
            When it became available, by `time.monotonic` [s]; now by default.
        """
        with self._changed:
            self.dropped += frame.scan.sensor in self._waiting  # whose turn the new one takes
            self._waiting[frame.scan.sensor] = frame, time.monotonic() if due is None else due
            self._changed.notify()

    def drop(self) -> None:
        """Count a frame that is not even read."""
        with self._changed:
            self.dropped += 1

    def close(self) -> None:
        """End the iteration once what waits is taken."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames, each as soon as it is there, until `close`."""
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closed)
                if not self._waiting:
                    return
                frame, self.due = self._waiting.pop(next(iter(self._waiting)))
            yield frame


LEAD = 0.2  # [s] from the start, or a new sequence, to its first frame, which must be read first
LATE = 0.05  # [s] after which frames that are due are dropped unread, until one is not due yet
BACK = 1.0  # [s] by which stamps may go back without being a new recording
_UNREADABLE = (ValueError, TypeError, OSError)


def read_ahead(frames: Iterable[Frame], newest: NewestFrames, stop: Event, on_error: OnError) -> None:
    """Pass frames on as they come, until they end or `stop` is set.

    Parameters
    ----------
    frames : iterable of Frame
    newest : NewestFrames
        What takes them.
    stop : Event
    on_error : function
        Called with every frame that cannot be read, and its error.
    """
    for frame in frames:
        due = time.monotonic()
        if stop.is_set():
            return
        if _read(frame, on_error):
            newest.put(frame, due)


def play(frames: Iterable[Frame], rate: float, newest: NewestFrames, stop: Event, on_error: OnError) -> None:
    """Pass frames on at their stamps, until they end or `stop` is set.

    Each is read before it is due. When reading falls behind, frames that are overdue are dropped unread.

    Parameters
    ----------
    frames : iterable of Frame
        With stamps; their scans are read on demand.
    rate : float
        Speed of the clock: 2 plays twice as fast.
    newest, stop, on_error
        As for `read_ahead`.

    Raises
    ------
    OgmError
        If a frame has no stamp.
    """
    clock, catching_up = _Clock(rate), False
    for frame in frames:
        due = clock.due(frame)
        late = time.monotonic() - due
        catching_up = late > (0.0 if catching_up else LATE)
        if catching_up:
            newest.drop()
            continue
        readable = _read(frame, on_error)
        if stop.wait(max(due - time.monotonic(), 0.0)):
            return
        if readable:
            newest.put(frame, due)


class _Clock:
    """When frames are due; every sequence begins anew."""

    def __init__(self, rate: float) -> None:
        if not 0 < rate < math.inf:
            raise ValueError(f"rate must be above 0 and finite, 1 for real time, got {rate}")
        self.rate = rate
        self.sequence: str | None = None
        self.origin = self.start = self.last = 0.0  # stamp of the first frame, when it is due, and the last stamp

    def due(self, frame: Frame) -> float:
        """Return when a frame is due, by `time.monotonic` [s]."""
        if frame.stamp is None:
            raise OgmError(f"{frame.name} has no stamp, so that it cannot be played at its time: give times or poses")
        if frame.sequence != self.sequence or not self.last - BACK <= frame.stamp <= self.last + MAX_GAP:
            self.sequence, self.origin, self.start = frame.sequence, frame.stamp, time.monotonic() + LEAD
        self.last = frame.stamp
        return self.start + (frame.stamp - self.origin) / self.rate


def _read(frame: Frame, on_error: OnError) -> bool:
    """Read scan and mount of a frame here, not in the mapping thread; return whether they can be read."""
    try:
        frame.scan, frame.mount  # noqa: B018
    except _UNREADABLE as error:
        on_error(frame, error)
        return False
    return True
