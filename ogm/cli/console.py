"""What all commands share: where they print, and how they complain."""

import functools
from collections.abc import Callable, Mapping
from typing import ParamSpec, TypeVar

import typer
from rich.console import Console
from rich.table import Table

P = ParamSpec("P")
R = TypeVar("R")

out = Console(highlight=False)
stderr = Console(stderr=True, highlight=False, soft_wrap=True)


def report_errors(command: Callable[P, R]) -> Callable[P, R]:
    """Turn the errors a user can cause into one line and exit code 2."""

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return command(*args, **kwargs)
        except (ValueError, TypeError, OSError, ImportError, MemoryError) as error:
            stderr.print(f"ogm: {one_line(error)}", markup=False)
            raise typer.Exit(2) from None
        except KeyboardInterrupt:
            stderr.print("ogm: interrupted; files that were finished are whole, no other was written")
            raise typer.Exit(130) from None

    return run


def one_line(error: BaseException) -> str:
    """Say an error in one line."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if isinstance(error, MemoryError) and (type(error) is not MemoryError or not error.args):
        return "out of memory: use a coarser --resolution, a smaller grid or fewer points"
    return " ".join(str(error).split()) or type(error).__name__


def print_facts(facts: Mapping[str, str]) -> None:
    """Print names and values in two columns."""
    table = Table(box=None, show_header=False, pad_edge=False)
    for name, value in facts.items():
        table.add_row(name, value)
    out.print(table, markup=False)
