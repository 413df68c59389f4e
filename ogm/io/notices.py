"""Notices of repaired or left-out data: one line per drive instead of one per scan."""

import logging
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_counts: ContextVar[Counter[str] | None] = ContextVar("counts", default=None)


def notice(log: logging.Logger, kind: str, text: str, *values: object, level: int = logging.WARNING) -> None:
    """Log a line; inside `one_notice_per_kind` only the first of its kind.

    Parameters
    ----------
    log : Logger
    kind : str
        Notices of one kind differ only in their scan.
    text : str
    *values : object
        Arguments of `text`, see ``logging``.
    level : int
        Level of ``logging``.
    """
    counts = _counts.get()
    if counts is not None:
        counts[kind] += 1
        if counts[kind] > 1:
            return
        text += " (further scans of this drive with the same problem are not listed)"
    log.log(level, text, *values)


@contextmanager
def one_notice_per_kind(counts: Counter[str]) -> Iterator[None]:
    """Log the first notice of each kind, and count all.

    Parameters
    ----------
    counts : Counter
        Number of notices by kind so far, updated in place. A drive keeps one counter for all its scans.
    """
    token = _counts.set(counts)
    try:
        yield
    finally:
        _counts.reset(token)
