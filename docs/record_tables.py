"""Records of the benchmarks, whether they are outdated, and tables and figures of them in Markdown."""

import json
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
RESULTS = BENCHMARKS / "results"
LINKS = "../benchmarks/results"  # of the pages in docs/
TIMES = ("deep_speed", "evaluation_speed", "fusion_speed", "growth", "live", "soak")  # records of times and memory


@cache
def _read(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def record(name: str) -> Any:
    """Return a record."""
    return _read(RESULTS / f"{name}.json")


def find_record(name: str) -> Any:
    """Return a record, or None if there is no such file."""
    return record(name) if (RESULTS / f"{name}.json").is_file() else None


def outdated(name: str) -> str:
    """Return why a record does not describe the shipped models, or "" if it does.

    A record is outdated if one of its models, or the map of one of its rules, has another fingerprint today, or if it
    has none: see `environment` in benchmarks/_run.py. Models with weights of their own are not compared. Nor are the
    shipped networks in records of times, which do not depend on the weights.
    """
    found = list(_environments(record(name)))
    if any("checksums" not in one for one in found):
        return "measured before records held checksums of models."
    recorded = {(model, tuple(facts["fingerprint"])) for one in found for model, facts in one["checksums"].items()}
    if not recorded:
        return ""
    sys.path.append(str(BENCHMARKS))
    from _fingerprints import SHIPPED, same

    compared = {*SHIPPED} - ({"lite", "combined"} if name in TIMES else set())
    changed = sorted({f"`{model}`" for model, numbers in recorded if model in compared and not same(model, numbers)})
    return f"since then the results of {', '.join(changed)} have changed." if changed else ""


def _environments(part: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Yield the environments of a record of benchmarks/: its own, and those of its parts."""
    if str(part.get("command")).startswith("python benchmarks/"):
        yield part
    for one in part.values():
        if isinstance(one, Mapping):
            yield from _environments(one)


def mark(name: str) -> str:
    """Return the mark of an outdated record, for the end of a line; "" if it is not."""
    why = outdated(name)
    return f" **Outdated:** {why}" if why else ""


def marked(name: str, text: str) -> str:
    """Return a table with the mark of its record below it."""
    return f"{text}\n\n{mark(name).strip()}".strip()


def table(head: Sequence[object], rows: Iterable[Sequence[object]], left: int = 1) -> str:
    """Return a table in Markdown; the first `left` columns are text, the others are numbers."""
    rule = f"|{'---|' * left}{'---:|' * (len(head) - left)}"
    return "\n".join([_row(head), rule, *map(_row, rows)])


def once(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return rows with the first cell empty where it equals that of the row above."""
    return [["" if k and rows[k - 1][0] == row[0] else row[0], *row[1:]] for k, row in enumerate(rows)]


def _row(cells: Sequence[object]) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def verdicts(name: str, head: str) -> str:
    """Return the table of the limits of a record, reached or missed."""
    rows = [
        [
            one["what"],
            f"{one['got']:.3g} {one['unit']}".strip(),
            f"{one['wanted']:g}",
            "" if one["met"] else "**missed**",
        ]
        for one in record(name)["verdicts"]
    ]
    return table([head, "measured", "limit", ""], rows)


def with_command(name: str, *parts: str) -> str:
    """Return tables and texts with the command, the date and the machine of the record below them."""
    found = record(name)
    facts = found.get("environment", found)
    cpu = re.sub(r"\((R|TM)\)| Processor| @.*", "", facts["cpu"])
    cores = "1 core" if facts["cores used"] == 1 else f"{facts['cores used']} cores"
    return "\n\n".join([*parts, f"*`{facts['command']}`, {facts['date'].split()[0]}, {cpu}, {cores}.*{mark(name)}"])


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
