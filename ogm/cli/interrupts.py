"""Handling of SIGINT and SIGTERM: both raise KeyboardInterrupt; the exit status depends on the signal."""

import signal
import sys
import time
from types import FrameType
from typing import Any

RETRY = 0.05  # [s] after which a lost interrupt is raised again
ECHO = 0.2  # [s] in which a repeated signal is ignored: `timeout` sends SIGTERM twice

received: list[int] = []
_last = -ECHO


def watch_signals() -> None:
    """Let SIGTERM raise KeyboardInterrupt as SIGINT does, and record the signals received."""
    for number in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(number) is not signal.SIG_IGN:  # ignored under nohup, or in the background of a script
            signal.signal(number, _interrupt)
    sys.unraisablehook = _raise_again


def _interrupt(number: int, frame: FrameType | None) -> None:
    global _last
    now = time.monotonic()
    if now - _last >= ECHO:
        _last = now
        received.append(number)
        raise KeyboardInterrupt


def _raise_again(unraisable: Any) -> None:
    """Interrupt again after `RETRY`: an interrupt in a callback, such as a finaliser, is lost.

    After a signal, other errors of callbacks are not printed: worker processes with the same signal cause some.
    """
    if received and isinstance(unraisable.exc_value, KeyboardInterrupt) and hasattr(signal, "setitimer"):
        signal.signal(signal.SIGALRM, signal.default_int_handler)
        signal.setitimer(signal.ITIMER_REAL, RETRY)
    elif not received:
        sys.__unraisablehook__(unraisable)
