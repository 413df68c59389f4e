"""The report's page: one HTML file that needs no other file and no network."""

import json
import os
import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from functools import partial
from importlib import resources
from typing import Any

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from ogm.evaluation.chart_data import HEADLINE, chart_data, group_metrics
from ogm.evaluation.frame_pictures import ARROWS, ERRORS, height_legend, true_states
from ogm.evaluation.motion import MOTION_HEADLINE, group_motion
from ogm.evaluation.summary import best_value, summarize
from ogm.evaluation.text import format_number, join_words, pluralize
from ogm.storage.files import atomic_write

Record = Mapping[str, Any]
Pictures = Mapping[int, Mapping[str, bytes]]
MOST = 13_500_000  # bytes of pictures, so that the page stays under 15 MB
SHORT = 120  # characters of a nested fact that is shown unfolded
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")  # characters that HTML does not allow


def write_page(path: str | os.PathLike[str], record: Record, pictures: Pictures, most: int = MOST) -> None:
    """Write the record of an evaluation as one HTML page, whole or not at all.

    Parameters
    ----------
    path : path
        Its folder must exist.
    record : dict
        See `ogm.evaluation.report.evaluation_record`.
    pictures : dict of int to dict of str to bytes
        Of some frames by their numbers, see `ogm.evaluation.frame_pictures.draw_frame`.
    most : int
        Bytes that the pictures may take in the page. Of more, frames are left out evenly, and the page states it.
    """
    kept, files = _fitting(pictures, most), resources.files("ogm") / "data"
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=StrictUndefined)
    environment.filters |= {"number": format_number, "words": join_words, "plural": pluralize}
    environment.filters |= {"json": _json, "short": _short, "pretty": partial(json.dumps, indent=1, ensure_ascii=False)}
    text = environment.from_string((files / "report.html").read_text("utf-8")).render(
        record=record,
        methods=record["methods"],
        metrics=record["metrics"],
        headline=HEADLINE,
        groups=group_metrics(record["metrics"]),
        summary=summarize(record),
        best=lambda kind, metric: best_value(record, metric, kind),
        reasons=lambda names: _reasons(record, names),
        legends=_legends(kept),
        found=len(pictures),
        kept=len(kept),
        pictures={number: {name: _url(data) for name, data in kept[number].items()} for number in sorted(kept)},
        motion_headline=MOTION_HEADLINE,
        motion_groups=group_motion(record.get("motion")),
        charts=chart_data(record, kept),
        css=Markup((files / "report.css").read_text("utf-8")),  # noqa: S704
        js=Markup((files / "report.js").read_text("utf-8")),  # noqa: S704
    )  # fmt: skip
    with atomic_write(path) as file:
        file.write(_CONTROL.sub("\N{REPLACEMENT CHARACTER}", text).encode("utf-8", "replace"))


def _fitting(pictures: Pictures, most: int) -> Pictures:
    """Return pictures of as many frames as fit, evenly spread."""
    size = sum(len(data) for one in pictures.values() for data in one.values()) * 4 / 3  # in base64
    if size <= most:
        return pictures
    numbers, count = sorted(pictures), max(1, int(len(pictures) * most / size))
    places = {round(k * (len(numbers) - 1) / max(count - 1, 1)) for k in range(count)}
    return {number: pictures[number] for place, number in enumerate(numbers) if place in places}


def _url(picture: bytes) -> str:
    return f"data:image/webp;base64,{b64encode(picture).decode()}"


def _json(value: Any) -> Markup:
    """Return JSON that cannot end the script that holds it: without "<"."""
    text = json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c"))  # noqa: S704


def _reasons(record: Record, names: Sequence[str]) -> list[tuple[list[str], Sequence[str], str]]:
    """Return why metrics have no value: titles, methods (none where all are meant), the common reason."""
    found: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for name in names:
        of = {method: reason for method, one in record["methods"].items() if (reason := one["missing"].get(name))}
        for reason in dict.fromkeys(of.values()):
            methods = tuple(method for method, other in of.items() if other == reason)
            found.setdefault((reason, methods), []).append(record["metrics"][name]["title"])
    count = len(record["methods"])
    return [(titles, methods if len(methods) < count else (), reason) for (reason, methods), titles in found.items()]


def _legends(pictures: Pictures) -> dict[str, list[tuple[str, tuple[int, int, int], str]]]:
    """Return name, colour and meaning of what the pictures show, by kind of picture."""
    found = {}
    if any("points" in one for one in pictures.values()):
        found["points"] = [(height, colour, "") for height, colour in height_legend().items()]
    states = [(name, *shade) for name, shade in true_states().items()]
    found["truth"] = [(name, colour, "" if text == name else text) for name, colour, text in states]
    found["masses"] = [(name, colour, "") for name, colour, _ in states if name != "ignored"]
    if any(name.startswith("motion") for one in pictures.values() for name in one):
        found["motion in 1 s"] = [(name, colour, "") for name, colour in ARROWS.items()]
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
