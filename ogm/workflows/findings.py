"""Findings about a drive: records of what spoils its map, with the way out."""

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

SEVERITIES = ("wrong map", "lost data", "note")


class Finding(NamedTuple):
    """A property of a drive that its map suffers from, or that is worth knowing.

    Attributes
    ----------
    severity : {"wrong map", "lost data", "note"}
    kind : str
        Subject: "tilt", "height", "ego returns", ...
    text : str
        The property, with numbers.
    way : str
        Option or command that mends it; "" for none.
    """

    severity: str
    kind: str
    text: str
    way: str = ""

    def __str__(self) -> str:
        return f"{self.kind}: {self.text}" + (f"; {self.way}" if self.way else "")


def by_severity(findings: Iterable[Finding]) -> list[Finding]:
    """Return findings, the worst first, each once."""
    return sorted(dict.fromkeys(findings), key=lambda finding: SEVERITIES.index(finding.severity))


def counted(count: int, total: int, noun: str = "scan") -> str:
    """Return a count in words: all 5 scans, 2 of 5 scans, 1 scan."""
    plural = f"{noun}{'s' * (total != 1)}"
    return f"{count} of {total} {plural}" if count < total else f"all {total} {plural}" if total > 1 else f"1 {noun}"


def listed(items: Sequence[str], most: int = 5) -> str:
    """Return some items in words, and how many more there are."""
    more = f" and {len(items) - most} more" if len(items) > most else ""
    return ", ".join(items[:most]) + more


def without_numbers(text: str) -> str:
    """Return a text with 0 for every number: the same for errors of one kind."""
    return re.sub(r"[0-9.eE+-]*[0-9]", "0", text)
