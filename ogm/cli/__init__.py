"""The command line ``ogm``: its packages load with the first use of `app` or `main`, where an interrupt is noticed."""

import sys
from typing import Any

__all__ = ["app", "main"]


def main() -> None:
    """Run the command line."""
    try:
        import logging

        from ogm.cli.commands import app
        from ogm.cli.console import SafeFormatter

        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(SafeFormatter("ogm: %(message)s"))
        logging.basicConfig(level=logging.WARNING, handlers=[handler])
        app()
    except KeyboardInterrupt:  # before a command began, while packages load
        print("ogm: interrupted; nothing was written", file=sys.stderr)
        sys.exit(130)


def __getattr__(name: str) -> Any:
    if name != "app":
        raise AttributeError(f"module 'ogm.cli' has no attribute {name!r}")
    from ogm.cli.commands import app

    return app
