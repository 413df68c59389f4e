"""The report's page: one HTML file without external files or network access."""

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
MAX_BYTES = 13_500_000  # of pictures, so that the page stays under 15 MB
SHORT = 120  # characters of a nested fact that is shown unfolded
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]")  # characters that HTML does not allow


def write_page(path: str | os.PathLike[str], record: Record, pictures: Pictures, max_bytes: int = MAX_BYTES) -> None:
    """Write the record of an evaluation as a single HTML page, in one step.

    Parameters
    ----------
    path : path
        Its folder must exist.
    record : dict
        See `ogm.evaluation.report.evaluation_record`.
    pictures : dict of int to dict of str to bytes
        Pictures of some frames by number, see `ogm.evaluation.frame_pictures.draw_frame`.
    max_bytes : int
        Greatest size of the pictures in the page. If they are larger, frames are left out evenly, as the page states.
    """
    kept, files = _fitting(pictures, max_bytes), resources.files("ogm") / "data"
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


def _fitting(pictures: Pictures, max_bytes: int) -> Pictures:
    """Return the pictures of evenly spread frames that fit into a size."""
    size = sum(len(data) for frame in pictures.values() for data in frame.values()) * 4 / 3  # in base64
    if size <= max_bytes:
        return pictures
    numbers, count = sorted(pictures), max(1, int(len(pictures) * max_bytes / size))
    places = {round(k * (len(numbers) - 1) / max(count - 1, 1)) for k in range(count)}
    return {number: pictures[number] for place, number in enumerate(numbers) if place in places}


def _url(picture: bytes) -> str:
    return f"data:image/webp;base64,{b64encode(picture).decode()}"


def _json(value: Any) -> Markup:
    """Return JSON without "<", which could end the script around it."""
    text = json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c"))  # noqa: S704


def _reasons(record: Record, names: Sequence[str]) -> list[tuple[list[str], Sequence[str], str]]:
    """Return groups of metrics without a value: titles, methods (empty for all), and the common reason."""
    found: dict[tuple[str, tuple[str, ...]], list[str]] = {}
    for name in names:
        causes = {method: facts["missing"].get(name) for method, facts in record["methods"].items()}
        for reason in dict.fromkeys(filter(None, causes.values())):
            methods = tuple(method for method, cause in causes.items() if cause == reason)
            found.setdefault((reason, methods), []).append(record["metrics"][name]["title"])
    count = len(record["methods"])
    return [(titles, methods if len(methods) < count else (), reason) for (reason, methods), titles in found.items()]


def _legends(pictures: Pictures) -> dict[str, list[tuple[str, tuple[int, int, int], str]]]:
    """Return name, colour and meaning of each class, by kind of picture."""
    found = {}
    if any("points" in frame for frame in pictures.values()):
        found["points"] = [(height, colour, "") for height, colour in height_legend().items()]
    states = [(name, *shade) for name, shade in true_states().items()]
    found["truth"] = [(name, colour, "" if text == name else text) for name, colour, text in states]
    found["masses"] = [(name, colour, "") for name, colour, _ in states if name != "ignored"]
    if any(name.startswith("motion") for frame in pictures.values() for name in frame):
        found["motion in 1 s"] = [(name, colour, "") for name, colour in ARROWS.items()]
    found["errors"] = [(name, *shade) for name, shade in reversed(ERRORS.items())]
    return found


def _short(value: Any) -> str | None:
    """Return a fact as a short text, or None if the text is too long."""
    if not isinstance(value, Mapping | list | tuple):
        return "–" if value is None else str(value)
    if isinstance(value, Mapping) and not any(isinstance(part, Mapping | list) for part in value.values()):
        return ", ".join(f"{key} {part}" for key, part in value.items())
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) < SHORT else None
