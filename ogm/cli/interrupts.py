"""SIGINT and SIGTERM: both raise KeyboardInterrupt, and which of them it was decides the exit status."""

import signal
import sys
import time
from types import FrameType
from typing import Any

LATER = 0.05  # [s] after which an interrupt that was lost is raised again
ECHO = 0.2  # [s] in which a second signal is the same: `timeout` sends SIGTERM twice

received: list[int] = []
_last = -ECHO


def watch_signals() -> None:
    """Let SIGTERM raise KeyboardInterrupt as SIGINT does, and take down which came."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:  # as under nohup, or in the background of a script
            signal.signal(number, _interrupt)
    sys.unraisablehook = _raise_again


def _interrupt(number: int, frame: FrameType | None) -> None:
    global _last
    now = time.monotonic()
    if now - _last >= ECHO:
        _last = now
        received.append(number)
        raise KeyboardInterrupt


def _raise_again(what: Any) -> None:
    """Interrupt once more, a moment later: errors of a callback, such as that of a weak reference, are lost.

    After a signal, other errors of callbacks are not printed: processes that got the same signal cause some.
    """
    if received and isinstance(what.exc_value, KeyboardInterrupt) and hasattr(signal, "setitimer"):
        signal.signal(signal.SIGALRM, signal.default_int_handler)
        signal.setitimer(signal.ITIMER_REAL, LATER)
    elif not received:
        sys.__unraisablehook__(what)
