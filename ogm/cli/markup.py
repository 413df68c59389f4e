"""HTML of elements, so that every text is escaped when it is written; and how numbers and lists are said in it."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any
from xml.etree.ElementTree import Element, tostring

__all__ = ["ARROWS", "counted", "element", "html", "listed", "metric_title", "plain_table", "told"]

ARROWS = {"lower": "↓", "higher": "↑", "": ""}


def element(tag: str, *children: Element | str, **attributes: str | None) -> Element:
    """Make an element; attributes that are None are left out, a trailing _ and - for _ as Python needs."""
    kept = {k.rstrip("_").replace("_", "-"): v for k, v in attributes.items() if v is not None}
    element = Element(tag, kept)
    for child in children:
        if not isinstance(child, str):
            element.append(child)
        elif len(element):
            element[-1].tail = (element[-1].tail or "") + child
        else:
            element.text = (element.text or "") + child
    return element


def html(*parts: Element | str) -> str:
    """Write elements and texts as HTML, without those control characters that HTML has no place for."""
    text = tostring(element("x", *parts), "unicode", "html").removeprefix("<x>").removesuffix("</x>")
    return re.sub(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]", "\N{REPLACEMENT CHARACTER}", text)


def told(value: float | None) -> str:
    """Write a number with the digits that a person reads; a dash where there is none."""
    if value is None:
        return "–"
    size = abs(value)
    if size and (size < 1e-3 or size >= 1e5):
        return f"{value:.1e}"
    return f"{value:.3f}" if size < 10 else f"{value:.1f}" if size < 1000 else f"{value:.0f}"


def counted(number: int, what: str) -> str:
    """Write how many of something: "1 frame", "2 frames"."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def listed(words: Sequence[str]) -> str:
    """Write words with commas, or semicolons where they hold commas, and an "and" before the last."""
    comma = "; " if any("," in word for word in words) else ", "
    return " and ".join([comma.join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)


def plain_table(head: Iterable[str], rows: Iterable[Element]) -> Element:
    """Make a table that scrolls where it is too wide."""
    top = element("thead", element("tr", *(element("th", text, scope="col") for text in head)))
    return element("div", element("table", top, element("tbody", *rows), class_="plain"), class_="scroll")


def metric_title(record: Mapping[str, Any], name: str) -> list[Element | str]:
    """Return a metric's title, which says what it is when pointed at, and which way is better."""
    metric = record["metrics"][name]
    better = f", {metric['better']} is better" if metric["better"] else ""
    return [
        element("abbr", metric["title"], title=f"{metric['description']}{better}"),
        f" {ARROWS[metric['better']]}",
    ]
