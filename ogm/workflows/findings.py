"""Findings about a drive: problems of its data, with their remedies."""

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

SEVERITIES = ("wrong map", "lost data", "note")


class Finding(NamedTuple):
    """A property of a drive that spoils its map, or is worth knowing.

    Attributes
    ----------
    severity : {"wrong map", "lost data", "note"}
    kind : str
        Subject: "tilt", "height", "ego returns", ...
    text : str
        The property, with numbers.
    remedy : str
        Option or command that fixes it, or "".
    """

    severity: str
    kind: str
    text: str
    remedy: str = ""

    def __str__(self) -> str:
        return f"{self.kind}: {self.text}" + (f"; {self.remedy}" if self.remedy else "")


def by_severity(findings: Iterable[Finding]) -> list[Finding]:
    """Return the distinct findings, the worst first."""
    return sorted(dict.fromkeys(findings), key=lambda finding: SEVERITIES.index(finding.severity))


def counted(count: int, total: int, noun: str = "scan") -> str:
    """Return a count in words: all 5 scans, 2 of 5 scans, 1 scan."""
    plural = f"{noun}{'s' * (total != 1)}"
    return f"{count} of {total} {plural}" if count < total else f"all {total} {plural}" if total > 1 else f"1 {noun}"


def listed(items: Sequence[str], limit: int = 5) -> str:
    """Return the first items as text, and the number of the others."""
    more = f" and {len(items) - limit} more" if len(items) > limit else ""
    return ", ".join(items[:limit]) + more


def without_numbers(text: str) -> str:
    """Replace every number in a text by 0, so that errors of the same kind are equal."""
    return re.sub(r"[0-9.eE+-]*[0-9]", "0", text)
