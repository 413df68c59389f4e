"""Records of the benchmarks, and tables and figures of them in Markdown."""

import json
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).resolve().parents[1] / "benchmarks" / "results"
LINKS = "../benchmarks/results"  # of the pages in docs/


@cache
def _read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def record(name: str) -> Any:
    """Return a record."""
    return _read(RESULTS / f"{name}.json")


def find_record(name: str) -> Any:
    """Return a record, or None if there is no such file."""
    return record(name) if (RESULTS / f"{name}.json").is_file() else None


def table(head: Sequence[object], rows: Iterable[Sequence[object]], left: int = 1) -> str:
    """Return a table in Markdown; the first `left` columns are text, the others are numbers."""
    rule = f"|{'---|' * left}{'---:|' * (len(head) - left)}"
    return "\n".join([_row(head), rule, *map(_row, rows)])


def _row(cells: Sequence[object]) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def with_source(name: str, *parts: str) -> str:
    """Return tables and texts with the source of the record below them."""
    return "\n\n".join([*parts, source(name)])


def source(name: str) -> str:
    """Return command, date and machine of a record, a link to it, and the reason why it is outdated."""
    found = record(name)
    facts = found.get("environment", found)
    machine = f"{facts['cpu']}, {facts['cores used']} of {facts['cores']} cores"
    outdated = f" **Outdated:** {found['outdated']}" if "outdated" in found else ""
    return f"*`{facts['command']}`, {facts['date'].split()[0]}, {machine}; {link(name)}.*{outdated}"


def link(name: str) -> str:
    """Return a link to a record."""
    return f"[record]({LINKS}/{name}.json)"


def value(number: float | None, digits: int = 3) -> str:
    """Return a number with some digits; nothing for None."""
    return "" if number is None else f"{number:.{digits}f}"


def percent(share: float) -> str:
    """Return a share in per cent."""
    return f"{100 * share:.1f} %"


def change(interval: Sequence[float]) -> str:
    """Return a difference with its interval, with signs."""
    return "{:+.3f} ({:+.3f} to {:+.3f})".format(*interval)


def half_width(interval: Sequence[float | None], digits: int = 3, factor: float = 1) -> str:
    """Return " ± " and half of an interval that is symmetric, of no line break; nothing without limits."""
    _, low, high = interval
    wide = low is not None and high is not None and high > low
    return f"\xa0±\xa0{factor * (high - low) / 2:.{digits}f}" if wide else ""
