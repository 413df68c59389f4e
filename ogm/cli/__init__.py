"""The command line ``ogm``. Its packages load with the first use of `app` or `main`, which handles interrupts."""

import gc
import os
import signal
import sys
from contextlib import suppress
from typing import Any

from ogm.cli.interrupts import received, watch_signals

__all__ = ["app", "main"]


def main() -> None:
    """Run the command line. SIGINT and SIGTERM end it with the status 130 and 143."""
    code: Any = 0
    early = False  # interrupted outside a command
    try:
        watch_signals()
        gc.disable()  # the objects that packages make while they load stay
        import logging

        from ogm.cli.commands import app
        from ogm.cli.console import SafeFormatter

        gc.freeze()
        gc.enable()
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(SafeFormatter("ogm: %(message)s"))
        logging.basicConfig(level=logging.WARNING, handlers=[handler])
        app()
    except KeyboardInterrupt:  # before a command began, while packages load
        early = True
    except SystemExit as end:
        code = end.code
        early = isinstance(getattr(end.__context__, "__cause__", None), KeyboardInterrupt)  # typer turns it into this
    except Exception:  # imports can turn an interrupt into another error
        if not received:
            raise
        early = True
    ended = bool(received) and (early or bool(code))
    for number in (signal.SIGINT, signal.SIGTERM):  # `timeout` sends its signal twice
        signal.signal(number, signal.SIG_IGN if ended and number in received else signal.SIG_DFL)
    if early:
        print("ogm: interrupted; nothing was written", file=sys.stderr)
        code = code or 130
    if ended:
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
        os._exit(128 + received[0])  # exit functions of libraries wait for their threads, or fail
    sys.exit(code)


def __getattr__(name: str) -> Any:
    if name != "app":
        raise AttributeError(f"module 'ogm.cli' has no attribute {name!r}")
    from ogm.cli.commands import app

    return app
