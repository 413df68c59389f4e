"""Check that links, anchors and pictures of the built pages lead somewhere, without a network."""

from collections.abc import Iterator
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

MADE_BY_SPHINX = {"genindex.html", "py-modindex.html", "search.html"}


class PageLinks(HTMLParser):
    """Anchors of a page, what it refers to, and its pictures without a description."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.targets: set[str] = set()
        self.undescribed: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what a tag names and refers to."""
        found = dict(attrs)
        self.anchors.update(name for key in ("id", "name") if (name := found.get(key)))
        self.targets.update(target for key in ("href", "src") if (target := found.get(key)))
        if tag == "img" and not found.get("alt"):
            self.undescribed.add(found.get("src") or "")


def broken_links(folder: Path) -> Iterator[str]:
    """Yield a line for every link of a built site that leads nowhere, and every picture without a description.

    Parameters
    ----------
    folder : path
        With ``index.html``. Links to other sites are not followed.
    """

    @cache
    def read(path: Path) -> PageLinks:
        return PageLinks(path.read_text(encoding="utf-8"))

    for path in sorted(folder.rglob("*.html")):
        name = path.relative_to(folder).as_posix()
        if name.startswith("_static/"):  # templates of the theme
            continue
        for source in sorted(read(path).undescribed):
            yield f"{name}: the picture {source} has no alternative text"
        for target in sorted(read(path).targets):
            link, _, anchor = target.partition("#")
            if name in MADE_BY_SPHINX or ":" in link or link.startswith("//"):
                continue
            place = (path.parent / unquote(link.partition("?")[0])).resolve() if link else path
            if not place.is_file():
                yield f"{name}: {target} does not exist"
            elif anchor and place.suffix == ".html" and unquote(anchor) not in read(place).anchors:
                yield f"{name}: {target}: {place.name} has no such anchor"
