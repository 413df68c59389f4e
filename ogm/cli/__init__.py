"""The command line ``ogm``: its packages load with the first use of `app` or `main`, where an interrupt is noticed."""

import signal
import sys
from typing import Any

from ogm.cli.interrupts import received, watch_signals

__all__ = ["app", "main"]


def main() -> None:
    """Run the command line. SIGINT and SIGTERM end it with the status 130 and 143."""
    code: Any = 0
    try:
        watch_signals()
        import logging

        from ogm.cli.commands import app
        from ogm.cli.console import SafeFormatter

        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(SafeFormatter("ogm: %(message)s"))
        logging.basicConfig(level=logging.WARNING, handlers=[handler])
        app()
    except KeyboardInterrupt:  # before a command began, while packages load
        print("ogm: interrupted; nothing was written", file=sys.stderr)
        code = 130
    except SystemExit as end:
        code = end.code
        if isinstance(getattr(end.__context__, "__cause__", None), KeyboardInterrupt):  # typer's, outside of a command
            print("ogm: interrupted; nothing was written", file=sys.stderr)
    except Exception:  # an import can make an error of its own of an interrupt
        if not received:
            raise
        print("ogm: interrupted; nothing was written", file=sys.stderr)
        code = 130
    for number in (signal.SIGINT, signal.SIGTERM):  # all is done
        signal.signal(number, signal.SIG_DFL)
    sys.exit(128 + received[0] if received and code else code)


def __getattr__(name: str) -> Any:
    if name != "app":
        raise AttributeError(f"module 'ogm.cli' has no attribute {name!r}")
    from ogm.cli.commands import app

    return app
