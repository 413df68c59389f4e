"""The drop policy of live maps: of each sensor the newest scan waits, older ones are dropped and counted."""

import threading
import time
from collections.abc import Iterator

from ogm.scan import Frame


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
