"""Output of all commands: consoles, errors, progress, tables."""

import functools
import logging
import os
import re
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn, track
from rich.table import Table
from rich.text import Text

from ogm.cli.interrupts import received
from ogm.storage.files import DISK_ERRORS, error_text

if TYPE_CHECKING:
    from ogm.grid import GridSpec

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T")

COMPILED = 3.0  # [s]; a longer first call has compiled kernels

_WHOLE = "finished files are complete, no other was written"
_CONTROL = {code: f"\\x{code:02x}" for code in (*range(32), *range(127, 160)) if chr(code) not in "\n\t"}
_CONTROL |= {code: f"\\u{code:04x}" for code in (0x2028, 0x2029, *range(0x202A, 0x202F), *range(0x2066, 0x206A))}


def printable(text: str) -> str:
    """Return a text with control characters written as escapes, since file names can contain terminal commands.

    Marks that change the direction of writing and characters that cannot be encoded are written as escapes, too.
    """
    return text.translate(_CONTROL).encode("utf-8", "backslashreplace").decode()


_OPTIONS = {  # argument of the library: option, first those with another name
    "calibration": "calib", "grids": "out", "learning_rate": "learning-rate", "pictures": "picture",
    "sensors": "sensor", "setups": "sensors",
} | {name: name.replace("_", "-") for name in (
    "axes", "batch", "deskew", "ego_footprint", "every", "first", "frame", "free_thresh", "half_life",
    "intensity_max", "leave_out", "length", "match",
    "max_range", "max_range_no_echo", "min_range", "odometry", "origin", "out",
    "poses", "rate", "resample", "resolution", "resume", "samples", "sensor_height", "sensor_position", "split",
    "time_unit", "topic", "truth", "width", "window", "workers",
)}  # fmt: skip


def with_options(text: str) -> str:
    """Replace arguments in a message of the library, such as `time_unit`, by options of the command line."""
    return re.sub(
        "`([a-z_]+)(?:=([^`]*))?`",
        lambda found: f"--{_OPTIONS[found[1]]}{f' {found[2]}' * bool(found[2])}" if found[1] in _OPTIONS else found[0],
        text,
    )


def complain(text: str) -> None:
    """Print an error or a warning on one line of stderr."""
    stderr.print(f"ogm: {text}", markup=False)


class SafeConsole(Console):
    """Console that passes all text, also in tables, through `printable` and `with_options`."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Return the text as rich's `Text`."""
        return super().render_str(printable(with_options(text)), **options)


class SafeFormatter(logging.Formatter):
    """Formatter that passes log messages through `printable` and `with_options`."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the text of a message."""
        return printable(with_options(super().format(record)))


out: SafeConsole = SafeConsole(highlight=False)
stderr: SafeConsole = SafeConsole(stderr=True, highlight=False, soft_wrap=True)


def chosen_model(name: str | None, spec: "GridSpec", rule: str = "") -> str:
    """Return the name of the sensor model, by default from `default_model`; print why it is not `combined`.

    The default is for all kinds of scans, see `ogm.models.named.for_all_kinds`.
    """
    from ogm.models.named import default_model, for_all_kinds

    if name is not None:
        return name
    usual, reason = default_model(spec, rule)
    if reason:
        stderr.print(f"sensor model {usual}: {reason}", markup=False)
    return for_all_kinds(usual)


def report_errors(command: Callable[P, R]) -> Callable[P, R]:
    """Turn the errors a user can cause into one line and exit code 2, or 1 if the disk is full or broken."""

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return command(*args, **kwargs)
        except (ValueError, TypeError, OSError, ImportError, MemoryError) as error:
            if isinstance(error, ImportError) and _is_interrupt(error):
                stderr.print("ogm: interrupted; nothing was written", markup=False)
                raise typer.Exit(130) from None
            if received:  # worker processes ended by the same signal, and some packages, raise other errors
                stderr.print(f"ogm: interrupted; {_WHOLE}", markup=False)
                raise typer.Exit(130) from None
            complain(error_text(error))
            raise typer.Exit(1 if isinstance(error, OSError) and error.errno in DISK_ERRORS else 2) from None
        except KeyboardInterrupt as interrupt:
            text = str(interrupt) or _WHOLE
            stderr.print(f"ogm: interrupted; {text}", markup=False)
            raise typer.Exit(130) from None

    return run


def _is_interrupt(error: BaseException | None) -> bool:
    """Return whether an import failed by an interrupt: packages in C++ turn it into an ImportError."""
    while error is not None:
        if isinstance(error, KeyboardInterrupt) or "KeyboardInterrupt" in str(error):
            return True
        error = error.__cause__ or error.__context__
    return False


def print_facts(facts: Mapping[str, str]) -> None:
    """Print names and values in two columns."""
    table = Table(box=None, show_header=False, pad_edge=False)
    for name, value in facts.items():
        table.add_row(name, value)
    out.print(table, markup=False)


def ticked(items: Iterable[T], title: str, total: int | None = None) -> Iterable[T]:
    """Iterate with a progress bar, which disappears at the end; `total` is for iterables without a length."""
    return track(items, title, total, console=stderr, transient=True)


def progress_bar() -> Progress:
    """Return a progress bar with counts and remaining time, which disappears at the end."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    return Progress(*columns, console=stderr, transient=True)


def number_table(first: str, *others: str) -> Table:
    """Return an empty table with a left-aligned first column and right-aligned other columns."""
    table = Table(box=None, pad_edge=False)
    table.add_column(Text(printable(first)))
    for heading in others:
        table.add_column(Text(printable(heading)), justify="right", overflow="fold")
    return table


@contextmanager
def first_call() -> Iterator[None]:
    """Show a status while the first call may compile kernels, and print the time if it did."""
    from ogm.models.compilation import compiled_ahead

    start = time.perf_counter()
    with stderr.status("the first call compiles kernels (once per environment) ..."), compiled_ahead("scan"):
        yield
    if (seconds := time.perf_counter() - start) > COMPILED:
        stderr.print(f"ogm: kernels were compiled in {seconds:.0f} s; later calls load them from disk")


def distinct(names: Sequence[str], width: int = 36) -> list[str]:
    """Return names shortened to a width, keeping the part in which they differ."""
    if max(map(len, names), default=0) <= width:
        return list(names)
    common = os.path.commonprefix(list(names)) if len(set(names)) > 1 else ""
    cut = len(common) - 4 if len(common) > 8 else 0
    tails = [f"…{name[cut:]}" if cut else name for name in names]
    half = (width - 1) // 2
    return [name if len(name) <= width else f"{name[:half]}…{name[-half:]}" for name in tails]
