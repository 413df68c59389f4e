"""SIGINT and SIGTERM: both raise KeyboardInterrupt, and which of them it was decides the exit status."""

import signal
import time
from types import FrameType

__all__ = ["received", "watch_signals"]

ECHO = 1.0  # [s] in which a second signal is the same: `timeout` sends SIGTERM twice

received: list[int] = []
_last = -ECHO


def watch_signals() -> None:
    """Let SIGTERM raise KeyboardInterrupt as SIGINT does, and take down which came."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:  # as under nohup, or in the background of a script
            signal.signal(number, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> None:
    global _last
    now = time.monotonic()
    if now - _last >= ECHO:
        _last = now
        received.append(number)
        raise KeyboardInterrupt
