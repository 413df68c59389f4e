"""The report's page: one HTML file that needs no other file and no network."""

import json
import os
import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from ogm.evaluation.chart_data import chart_data, group_metrics, headline
from ogm.evaluation.frame_pictures import ERRORS, HEIGHTS, STATES, height_colours
from ogm.evaluation.summary import summarize
from ogm.evaluation.text import clean, format_number, join_words, pluralize
from ogm.files import atomic_write

__all__ = ["write_page"]

Record = Mapping[str, Any]
Pictures = Mapping[int, Mapping[str, bytes]]
MOST = 13_500_000  # bytes of pictures, so that the page stays under 15 MB
SHORT = 120  # characters of a nested fact that is shown unfolded
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")  # characters that HTML does not allow


def write_page(
    path: str | os.PathLike[str], record: Record, pictures: Pictures | None = None, most: int = MOST
) -> None:
    """Write the record of an evaluation as one HTML page, whole or not at all.

    Parameters
    ----------
    path : path
        Its folder must exist.
    record : dict
        See `ogm.evaluation.report.evaluation_record`.
    pictures : dict of int to dict of str to bytes, optional
        Of some frames by their numbers, see `ogm.evaluation.frame_pictures.draw_frame`.
    most : int
        Bytes that the pictures may take in the page. Of more, frames are left out evenly, and the page states it.

    Raises
    ------
    ValueError
        If there are pictures of a frame that the record does not have.
    """
    found = pictures or {}
    if unknown := sorted(set(found) - set(range(len(record["frames"])))):
        raise ValueError(
            f"there are pictures of frame {unknown[0]}, but the record has {len(record['frames'])} frames; number "
            "them as the record does"
        )
    kept, record = _fitting(found, most), clean(record)
    files = resources.files("ogm") / "data"
    text = _environment().from_string((files / "report.html").read_text("utf-8")).render(
        record=record,
        methods=record["methods"],
        metrics=record["metrics"],
        headline=headline(record["metrics"]),
        groups=group_metrics(record["metrics"]),
        summary=summarize(record),
        best=lambda kind, metric: _best(record, kind, metric),
        reasons=lambda names: _reasons(record, names),
        legends=_legends(kept),
        found=len(found),
        kept=len(kept),
        pictures={number: _as_urls(kept[number]) for number in sorted(kept)},
        charts=chart_data(record, kept),
        css=Markup((files / "report.css").read_text("utf-8")),  # noqa: S704
        js=Markup((files / "report.js").read_text("utf-8")),  # noqa: S704
    )  # fmt: skip
    with atomic_write(path) as file:
        file.write(_CONTROL.sub("\N{REPLACEMENT CHARACTER}", text).encode("utf-8", "replace"))


def _environment() -> Environment:
    """Return Jinja2 with the page's filters; all texts are escaped."""
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    environment.filters |= {"number": format_number, "words": join_words, "plural": pluralize}
    environment.filters |= {"json": _json, "short": _short, "pretty": _pretty}
    return environment


def _fitting(pictures: Pictures, most: int) -> Pictures:
    """Return pictures of as many frames as fit, evenly spread."""
    size = sum(len(data) for one in pictures.values() for data in one.values()) * 4 / 3  # in base64
    if size <= most:
        return pictures
    numbers, count = sorted(pictures), max(1, int(len(pictures) * most / size))
    places = {round(k * (len(numbers) - 1) / max(count - 1, 1)) for k in range(count)}
    return {number: pictures[number] for place, number in enumerate(numbers) if place in places}


def _as_urls(pictures: Mapping[str, bytes]) -> dict[str, str]:
    kinds = {name: "png" if data.startswith(b"\x89PNG") else "webp" for name, data in pictures.items()}
    return {name: f"data:image/{kinds[name]};base64,{b64encode(data).decode()}" for name, data in pictures.items()}


def _json(value: Any) -> Markup:
    """Return JSON that cannot end the script that holds it: ASCII, and no "<"."""
    return Markup(json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c"))  # noqa: S704


def _best(record: Record, kind: str, metric: str) -> float | None:
    """Return the best value of a metric over methods; None where there is nothing to compare."""
    better = record["metrics"][metric]["better"]
    found = [one[kind][metric] for one in record["methods"].values()]
    values = [one["value"] if isinstance(one, Mapping) else one for one in found]
    kept = [value for value in values if value is not None]
    if not better or not kept or len(values) == 1:
        return None
    return min(kept) if better == "lower" else max(kept)


def _reasons(record: Record, names: Sequence[str]) -> list[tuple[list[str], list[str], str]]:
    """Return why metrics have no value: titles, methods (none where all are meant), the common reason."""
    found: dict[str, dict[str, list[str]]] = {}
    for method, one in record["methods"].items():
        for name in names:
            if reason := one.get("missing", {}).get(name):
                found.setdefault(reason, {}).setdefault(record["metrics"][name]["title"], []).append(method)
    rows = []
    for reason, titles in found.items():
        every = all(len(methods) == len(record["methods"]) for methods in titles.values())
        methods = [] if every else sorted({name for names in titles.values() for name in names})
        rows.append((list(titles), methods, reason))
    return rows


def _legends(pictures: Pictures) -> dict[str, list[tuple[str, tuple[int, int, int], str]]]:
    """Return name, colour and meaning of what the pictures show, by kind of picture."""
    found = {}
    if any("points" in one for one in pictures.values()):
        heights = zip(HEIGHTS, height_colours(), strict=True)
        found["points"] = [(f"{h} m", colour, "") for h, colour in heights]
    states = [(name, *shade) for name, shade in STATES.items()]
    found["truth"] = [(name, colour, "" if text == name else text) for name, colour, text in states]
    found["masses"] = [(name, colour, "") for name, colour, _ in states if name != "ignored"]
    found["errors"] = [(name, *shade) for name, shade in reversed(ERRORS.items())]
    return found


def _short(value: Any) -> str | None:
    """Return a fact as a short text; None if it is too long."""
    if not isinstance(value, Mapping | list | tuple):
        return "–" if value is None else str(value)
    if isinstance(value, Mapping) and not any(isinstance(one, Mapping | list) for one in value.values()):
        return ", ".join(f"{key} {one}" for key, one in value.items())
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) < SHORT else None


def _pretty(value: Any) -> str:
    return json.dumps(value, indent=1, ensure_ascii=False)
