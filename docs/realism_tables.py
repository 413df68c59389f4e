"""Tables of a record of `benchmarks/realism.py`, beside the record.

    python docs/realism_tables.py benchmarks/results/realism.json

Writes benchmarks/results/realism.md.
"""

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from record_tables import table

PUBLISHED = {"free": "25 to 36", "occupied": "0.9 to 2.5", "unknown": "63 to 74"}  # [%] of labels that were published


def realism_tables(record: Mapping[str, Any]) -> str:
    """Return the statistics of simulated scans beside those of real ones, and the shares of the truth."""
    parts = []
    for sensor, group in record["sensors"].items():
        sets = list(group["scans"])
        rows = [["scans", *group["scans"].values(), group["simulated scans"], ""]]
        for name, one in group["statistics"].items():
            real = (_digits(one["real"].get(key)) for key in sets)
            rows.append([name, *real, _spread(one["simulated"]), one["verdict"]])
        head = ["", *sets, "simulated, median (10 % to 90 %)", ""]
        parts += [f"### {sensor}", table(head, rows, left=len(head))]
    rows = [
        [name, PUBLISHED.get(name, ""), _digits(one["label"]), _spread(one["simulated"])]
        for name, one in record["truth"].items()
    ]
    head = ["cells [%]", "published labels", "one published label", "aimed, median (10 % to 90 %)"]
    return "\n\n".join([*parts, "### Truth", table(head, rows, left=4)]) + "\n"


def _spread(ends: Mapping[str, float]) -> str:
    """Return a median and its ends."""
    return f"{_digits(ends['median'])} ({_digits(ends['p10'])} to {_digits(ends['p90'])})"


def _digits(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.1f}" if abs(value) >= 9.95 else f"{value:.2g}"


if __name__ == "__main__":
    place = Path(sys.argv[1])
    place.with_suffix(".md").write_text(realism_tables(json.loads(place.read_text())))
