"""Conversion of numbers, counts and lists to text and JSON."""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ogm.storage.files import atomic_write


def as_json(value: Any, digits: int = 7) -> Any:
    """Return a record of lists, dicts and rounded numbers for JSON; NaN and infinity become None."""
    if hasattr(value, "_asdict"):
        value = value._asdict()
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): as_json(part, digits) for key, part in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(part, digits) for part in value]
    if not isinstance(value, float):
        return value
    return float(f"{value:.{digits}g}") if math.isfinite(value) else None


def write_record(path: Path, record: Mapping[str, Any], command: str) -> Path:
    """Write a record and its command as JSON, create the folder, and return the path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path, "w") as file:
        json.dump(as_json({"command": clean(command), **record}), file, indent=1, allow_nan=False)
    return path


def clean(text: str) -> str:
    """Replace characters that cannot be encoded, which file names may contain."""
    return text.encode("utf-8", "replace").decode("utf-8")


def format_number(value: float | None) -> str:
    """Return a number with three to four digits; a dash for None."""
    if value is None:
        return "–"
    size = abs(value)
    if size and (size < 1e-3 or size >= 1e5):
        return f"{value:.1e}"
    return f"{value:.3f}" if size < 10 else f"{value:.1f}" if size < 1000 else f"{value:.0f}"


def text_table(heading: str, columns: Mapping[str, Mapping[str, float]]) -> str:
    """Return a table with a row per metric and a column per name; rows without values are only counted."""
    width = max(12, *(len(name) + 2 for name in columns))
    rows = {metric: [column[metric] for column in columns.values()] for metric in next(iter(columns.values()))}
    shown = {metric: row for metric, row in rows.items() if not all(math.isnan(value) for value in row)}
    lines = [f"{heading:28}" + "".join(f"{name:>{width}}" for name in columns)]
    lines += [f"{metric:28}" + "".join(f"{value:>{width}.4f}" for value in row) for metric, row in shown.items()]
    if missing := len(rows) - len(shown):
        lines.append(f"({pluralize(missing, 'metric')} without a value in these frames)")
    return "\n".join(lines)


def pluralize(number: int, noun: str) -> str:
    """Return a number with its noun: "1 frame", "2 frames"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def join_words(words: Sequence[str]) -> str:
    """Join words with commas, or with semicolons if they contain commas, and "and" before the last."""
    comma = "; " if any("," in word for word in words) else ", "
    return " and ".join([comma.join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)
