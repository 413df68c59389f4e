"""The report of an evaluation that people look at: one HTML file that needs nothing else, no network either."""

import json
import os
import re
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources
from typing import Any
from xml.etree.ElementTree import Element

from ogm.cli.charts import chart_data, clean, grouped, headline
from ogm.cli.markup import ARROWS, counted, element, html, listed, metric_title, plain_table, told
from ogm.cli.verdict import verdict
from ogm.cli.views import ERRORS, HEIGHTS, STATES, Shade, height_colours
from ogm.files import atomic_write

__all__ = ["write_page"]

Record = Mapping[str, Any]
Views = Mapping[int, Mapping[str, bytes]]
MOST = 13_500_000  # bytes of pictures, so that the page stays under 15 MB
STATES_OF_CELLS = ("unknown", "free", "occupied")
CONFUSION = "confusion [truth][call], unknown free occupied"
SHORT = 120  # characters of a nested fact that are shown without being asked for


def write_page(
    path: str | os.PathLike[str], record: Record, views: Views | None = None, most: int = MOST
) -> None:
    """Write a record of `ogm evaluate` as one HTML page, whole or not at all.

    Parameters
    ----------
    path : path
        Its folder must exist.
    record : dict
        What `ogm.cli.report` wrote as JSON.
    views : dict of int to dict of str to bytes, optional
        Pictures of some of the frames by their numbers, see `ogm.cli.views.frame_view`.
    most : int
        Bytes that the pictures may take in the page. Of more, frames are left out evenly, and the page says so.

    Raises
    ------
    ValueError
        If there are pictures of a frame that the record does not have.
    """
    found = views or {}
    views = _fitting(found, most)
    if strange := sorted(set(found) - set(range(len(record["frames"])))):
        raise ValueError(
            f"there are pictures of frame {strange[0]}, but the record has {len(record['frames'])} frames; "
            "number them as the record does"
        )
    files = resources.files("ogm") / "data"
    parts = {
        "title": html(clean(record["title"])),
        "css": (files / "report.css").read_text("utf-8"),
        "js": (files / "report.js").read_text("utf-8"),
        "subtitle": html(_subtitle(record)),
        "intervals": html(clean(record.get("intervals", "95 %, bootstrap over frames"))),
        "verdict": html(*verdict(record)),
        "scores": html(*_scores(record)),
        "confusions": html(_confusions(record)),
        "shown": html(_shown(record, found, views)),
        "legend": html(*_legends(views)),
        "run": html(*_run(record)),
        "data": _json(chart_data(record, views)),
        "views": "\n".join(_view(number, views[number]) for number in sorted(views)),
    }
    template = (files / "report.html").read_text("utf-8")
    page = re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], template)
    with atomic_write(path) as file:
        file.write(page.encode("utf-8", "replace"))


def _fitting(views: Views, most: int) -> Views:
    """Return pictures of as many frames as fit, evenly spread."""
    size = sum(len(data) for pictures in views.values() for data in pictures.values()) * 4 / 3  # in base64
    if size <= most:
        return views
    numbers, count = sorted(views), max(1, int(len(views) * most / size))
    places = {round(k * (len(numbers) - 1) / max(count - 1, 1)) for k in range(count)}
    return {number: views[number] for place, number in enumerate(numbers) if place in places}


def _shown(record: Record, found: Views, kept: Views) -> str:
    said = f"Pictures of {len(kept)} of {counted(len(record['frames']), 'frame')}"
    left = len(found) - len(kept)
    return f"{said}; those of {left} more were left out to keep the page small." if left else f"{said}."


def _view(number: int, pictures: Mapping[str, bytes]) -> str:
    found = {name: f"data:{_kind(data)};base64,{b64encode(data).decode()}" for name, data in pictures.items()}
    return f'<script type="application/json" id="view-{number}">{_json(found)}</script>'


def _kind(data: bytes) -> str:
    return "image/png" if data.startswith(b"\x89PNG") else "image/webp"


def _json(value: Any) -> str:
    """Return JSON that cannot end the script it stands in: ASCII, and no "<"."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _subtitle(record: Record) -> str:
    data = record["data"]
    counts = f"{counted(len(record['models']), 'method')} on {counted(len(record['frames']), 'frame')}"
    return f"{counts} of {clean(data['name'])} ({data['kind']}), {record['date']}"


# The tables of scores


def _scores(record: Record) -> Iterable[Element]:
    """Tabulate every metric of every method: the headline ones first, the rest folded."""
    first = headline(record["metrics"])
    yield element("div", _table(record, first, "macro"), class_="scroll")
    yield from _reasons(record, first)
    for title, names in grouped(record["metrics"]).items():
        table = element("div", _table(record, names, "macro"), class_="scroll")
        yield element("details", element("summary", title), table, *_reasons(record, names))
    pooled: list[Element] = []
    for title, names in grouped(record["metrics"]).items():
        pooled += [element("h3", title), element("div", _table(record, names, "micro"), class_="scroll")]
    yield element(
        "details", element("summary", "Every metric of all frames' cells together (micro averages)"), *pooled
    )
    description = [
        element(
            "div",
            element("dt", *metric_title(record, name)),
            element("dd", record["metrics"][name]["description"]),
        )
        for name in record["metrics"]
    ]
    yield element(
        "details",
        element("summary", "What each metric is"),
        element("dl", *description, class_="description"),
    )


def _table(record: Record, names: Sequence[str], kind: str) -> Element:
    head = [element("th", element("button", "method", type="button"), scope="col")]
    for name in names:
        metric = record["metrics"][name]
        better = f"; {metric['better']} is better" if metric["better"] else ""
        button = element("button", f"{metric['title']} {ARROWS[metric['better']]}", type="button")
        head.append(element("th", button, scope="col", title=f"{metric['description']}{better}"))
    best = {name: _best(record, name, kind) for name in names}
    rows = []
    for number, (method, model) in enumerate(record["models"].items()):
        cells = [element("th", _swatch(number), clean(method), scope="row", data_v=clean(method))]
        for name in names:
            one = model[kind].get(name)
            one = one if isinstance(one, Mapping) else {"value": one, "low": None, "high": None}
            cells.append(_cell(one, best[name], model.get("missing", {}).get(name)))
        rows.append(element("tr", *cells))
    return element(
        "table", element("thead", element("tr", *head)), element("tbody", *rows), class_="scores sortable"
    )


def _best(record: Record, metric: str, kind: str) -> float | None:
    better = record["metrics"][metric]["better"]
    found = [model[kind].get(metric) for model in record["models"].values()]
    values = [v["value"] if isinstance(v, Mapping) else v for v in found]
    kept = [v for v in values if v is not None]
    if not better or not kept or len(values) == 1:
        return None
    return min(kept) if better == "lower" else max(kept)


def _cell(one: Mapping[str, Any], best: float | None, reason: str | None) -> Element:
    value, low, high = one["value"], one["low"], one["high"]
    if value is None:
        return element(
            "td", "–", title=f"no value: {reason or 'no cell speaks for it'}", class_="number none"
        )
    interval = [] if low is None or high is None else [element("small", f"{told(low)} – {told(high)}")]
    mark = "number best" if value == best else "number"
    return element("td", told(value), *interval, class_=mark, data_v=repr(value))


def _reasons(record: Record, names: Sequence[str]) -> Iterable[Element]:
    """Say why metrics have no value, those with the same reason together."""
    found: dict[str, dict[str, list[str]]] = {}
    for method, model in record["models"].items():
        for name in names:
            if reason := model.get("missing", {}).get(name):
                found.setdefault(reason, {}).setdefault(record["metrics"][name]["title"], []).append(
                    clean(method)
                )
    for reason, titles in found.items():
        everyone = all(len(methods) == len(record["models"]) for methods in titles.values())
        whom = "" if everyone else " of " + listed(sorted({m for ms in titles.values() for m in ms}))
        yield element("p", f"– {listed(list(titles))}{whom}: no value, {reason}.", class_="reason")


def _swatch(number: int) -> Element:
    return element("i", class_=f"swatch s{number % 8} d{number // 8 % 5}", aria_hidden="true")


def _confusions(record: Record) -> Element:
    """Tabulate, for every method, what cells of each true state are called."""
    figures = []
    for number, (name, model) in enumerate(record["models"].items()):
        rows = []
        for truth, row in zip(STATES_OF_CELLS, model[CONFUSION], strict=True):
            total = sum(row)
            cells = [
                element(
                    "td",
                    f"{100 * count / total:.1f} %" if total else "–",
                    style=f"--share:{count / total:.3f}" if total else None,
                    class_="right" if truth == call else "wrong",
                    title=f"{count:,} cells that are {truth} and called {call}",
                )
                for call, count in zip(STATES_OF_CELLS, row, strict=True)
            ]
            share = element("td", f"{total:,}", class_="number")
            rows.append(element("tr", element("th", truth, scope="row"), *cells, share))
        head = element(
            "tr",
            element("td"),
            *(element("th", s, scope="col") for s in STATES_OF_CELLS),
            element("th", "cells", scope="col"),
        )
        caption = element("caption", _swatch(number), clean(name))
        table = element("table", caption, element("thead", head), element("tbody", *rows), class_="confusion")
        figures.append(element("div", table, data_method=str(number)))
    return element("div", *figures, class_="tiles wide")


# The legend, and what was run


def _legends(views: Views) -> Iterable[Element]:
    if any("points" in pictures for pictures in views.values()):
        heights = dict(zip(HEIGHTS, height_colours(), strict=True))
        yield _legend(
            "points", {f"{h} m": Shade(colour, "height over the ground") for h, colour in heights.items()}
        )
    yield _legend("truth", STATES)
    beliefs = {name: shade for name, shade in STATES.items() if name != "ignored"}
    yield _legend(
        "masses", {name: shade._replace(description=f"mass of {name}") for name, shade in beliefs.items()}
    )
    yield _legend("errors", dict(reversed(ERRORS.items())))


def _legend(title: str, shades: Mapping[str, Shade]) -> Element:
    entries = []
    for name, shade in shades.items():
        colour = f"background:rgb({','.join(map(str, shade.colour))})"
        description = (
            "" if shade.description == name or title in ("points", "masses") else f": {shade.description}"
        )
        entries.append(
            element(
                "li",
                element("i", style=colour, class_="patch", aria_hidden="true"),
                element("b", name),
                description,
            )
        )
    return element("div", element("h3", title), element("ul", *entries), class_="legend")


def _run(record: Record) -> Iterable[Element]:
    """Say what was run, so that it can be run again."""
    grid, data = record["grid"], record["data"]
    (nx, ny), side, (x, y) = grid["shape"], grid["resolution"], grid["origin"]
    area = f"x {x:g} to {x + nx * side:g} m (forward), y {y:g} to {y + ny * side:g} m (left)"
    facts = {
        "command": element("code", clean(record["command"]), class_="command"),
        "date": record["date"],
        "machine": _facts(record["machine"]),
        "seed": _facts(record["seed"]),
        "intervals": _facts(record.get("intervals", "95 %, bootstrap over frames")),
        "grid": f"{nx} x {ny} cells of {side:g} m: {area}",
        "data": f"{clean(data['name'])} ({data['kind']}), {counted(len(record['frames']), 'frame')}",
        "truth": clean(data["truth"]),
        **{key: _facts(value) for key, value in data.items() if key not in ("kind", "name", "truth")},
        "versions": _facts(record["versions"]),
        "record": record["format"],
    }
    pairs = [
        element("div", element("dt", clean(key)), element("dd", value))
        for key, value in facts.items()
        if value is not None
    ]
    yield element("dl", *pairs, class_="facts")
    rows = []
    for number, (name, model) in enumerate(record["models"].items()):
        weights = model.get("weights")
        said = (
            [clean(weights["file"]), element("code", f" SHA-256 {weights['sha256']}")] if weights else ["–"]
        )
        cells = (element("td", clean(model.get("what") or "")), element("td", *said, class_="weights"))
        rows.append(element("tr", element("th", _swatch(number), clean(name), scope="row"), *cells))
    yield plain_table(("method", "what it is", "weights"), rows)


def _facts(value: Any) -> Element | str:
    """Show whatever a record says: short as text, long folded."""
    if not isinstance(value, Mapping | list | tuple):
        return "–" if value is None else clean(value)
    if isinstance(value, Mapping) and not any(
        isinstance(one, Mapping | list | tuple) for one in value.values()
    ):
        return ", ".join(f"{clean(key)} {clean(one)}" for key, one in value.items())
    text = clean(json.dumps(value, ensure_ascii=False))
    if len(text) < SHORT:
        return text
    return element(
        "details",
        element("summary", "show"),
        element("pre", clean(json.dumps(value, indent=1, ensure_ascii=False))),
    )
