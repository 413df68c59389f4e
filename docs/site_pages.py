"""Pages of the site that are made of other things: the reference, the gallery, files that lie outside of docs/."""

import ast
import importlib
import inspect
import re
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from types import ModuleType

from command_page import command_page
from record_tables import table

# The public modules, by topic: what stands in their `__all__` is public, all else may change.
REFERENCE: dict[str, tuple[str, ...]] = {
    "Types that everything shares": (
        *("ogm.scan", "ogm.grid", "ogm.state", "ogm.dynamic_grid", "ogm.pose"),
        *("ogm.storage.files", "ogm.storage.limits", "ogm.unknown_cause"),
    ),
    "Evidence": ("ogm.evidence", "ogm.evidence.map_rules", "ogm.evidence.multinomial", "ogm.evidence.powerset"),
    "Sensor models": ("ogm.models", "ogm.geometric", "ogm.deep", "ogm.calibration", "ogm.geometric.doppler"),
    "Maps over time": ("ogm.fusion", "ogm.planning", "ogm.workflows", "ogm.live", "ogm.world"),
    "Data": (
        *("ogm.datasets", "ogm.io", "ogm.io.messages", "ogm.io.transforms", "ogm.io.logs", "ogm.truth"),
        *("ogm.io.kitti", "ogm.io.semantic_kitti", "ogm.io.nuscenes", "ogm.io.argoverse2", "ogm.io.sustech"),
        *("ogm.io.radarscenes", "ogm.io.range_images"),
    ),
    "Evaluation": ("ogm.evaluation", "ogm.metrics"),
    "Pictures": ("ogm.plot", "ogm.plot.colours", "ogm.plot.movie", "ogm.plot.overview", "ogm.plot.viewer"),
    "Training": tuple(f"ogm.deep.{name}" for name in ("training", "recipe", "losses", "data", "export", "engines")),
    "Simulation": tuple(
        f"ogm.simulation.{name}"
        for name in (
            *("plan", "recipe", "dataset", "sample", "store", "sensors", "robot_sensors", "lidar", "mounts", "radars"),
            *("radar", "scene", "hand_built_scenes", "mesh", "materials"),
        )
    ),
}
MODULES = tuple(name for modules in REFERENCE.values() for name in modules)
# Files outside of docs/ that are pages of the site, too: name of the page -> file.
OUTSIDE = {
    "changelog": "CHANGELOG.md",
    "contributing": "CONTRIBUTING.md",
    "code_of_conduct": "CODE_OF_CONDUCT.md",
    "security": "SECURITY.md",
    "benchmarks": "benchmarks/README.md",
    "realism": "benchmarks/results/realism.md",
    "realism_gen2": "benchmarks/results/realism_gen2.md",
}
# Pages whose pictures begin the gallery: maps.
MAPS_FIRST = ("index", "fusion", "dynamic", "world", "planners", "geometric", "deep", "simulation")
NOTE = ".. Made by docs/site_pages.py at every build.\n"


def heading(text: str, line: str) -> str:
    """Return a heading in reStructuredText."""
    return f"{text}\n{line * len(text)}\n"


def documented(value: object) -> bool:
    """Return whether a value has a docstring of its own: a class or a function of the package."""
    return (inspect.isclass(value) or inspect.isroutine(value)) and value.__module__.startswith("ogm")


@cache
def places() -> dict[int, tuple[str, str]]:
    """Return module and name under which each class and function is documented: the first module that names it."""
    found: dict[int, tuple[str, str]] = {}
    for module in map(importlib.import_module, MODULES):
        for name in module.__all__:
            if documented(value := getattr(module, name)):
                found.setdefault(id(value), (module.__name__, name))
    return found


def groups_of(module: ModuleType, names: Iterable[str]) -> dict[str, list[str]]:
    """Return the names by the module that defines them, under the first words of its docstring."""
    found: dict[str, list[str]] = {}
    constants = []
    for name in names:
        value = getattr(module, name)
        if not documented(value):
            constants.append(name)
            continue
        origin = inspect.getmodule(value)
        text = (inspect.getdoc(origin) or "") if origin is not module else ""
        title = re.split(r"[:.;](?:\s|$)", text, maxsplit=1)[0].replace("`", "").replace("\n", " ")
        found.setdefault("" if title == name else title, []).append(name)
    own = {"": found.pop("")} if "" in found else {}  # first, or they would stand under the heading of others
    return own | found | ({"Constants and types": constants} if constants else {})


def comment(module: str, name: str) -> str:
    """Return the comment at the definition of a constant, in the module or where that imports it from."""
    source = inspect.getsource(importlib.import_module(module))
    lines = source.splitlines()
    body = ast.parse(source).body
    for node in [*body, *(one for top in body if isinstance(top, ast.If) for one in top.body)]:  # if TYPE_CHECKING:
        if isinstance(node, ast.ImportFrom) and node.module and name in {one.name for one in node.names}:
            return comment(node.module, name)
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        if name in {one.id for target in targets if target for one in ast.walk(target) if isinstance(one, ast.Name)}:
            above = []
            while lines[(number := node.lineno - 2 - len(above))].startswith("# "):
                above.insert(0, lines[number][2:])
            found = re.search(r"[^\"']  # ([^\"']+)$", lines[node.lineno - 1])
            return found[1] if found else " ".join(above)
    return ""


def constant(module: ModuleType, name: str) -> str:
    """Return the directive of a constant, with its value where that is short."""
    value = getattr(module, name)
    shown = repr(value)
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        shown = f"{{{', '.join(f'{key!r}: ...' for key in value)}}}"
    text = f".. py:data:: {name}\n"
    text += f"   :value: {shown}\n" if len(shown) <= 200 and "\n" not in shown and " at 0x" not in shown else ""
    return text + f"\n   {comment(module.__name__, name).replace('|', 'or')}\n"


def entry(module: ModuleType, name: str) -> str:
    """Return the directive that documents a name."""
    value = getattr(module, name)
    if not documented(value):
        return constant(module, name)
    return f".. {'autoclass' if inspect.isclass(value) else 'autofunction'}:: {name}\n"


def module_page(name: str) -> str:
    """Return the page of a module: its docstring, a table of each group of names, then each name."""
    module = importlib.import_module(name)
    parts = [NOTE, heading(name, "="), f".. automodule:: {name}\n   :no-members:\n", f".. currentmodule:: {name}\n"]
    groups = groups_of(module, module.__all__)
    for title, found in groups.items():
        here = [one for one in found if places().get(id(getattr(module, one)), (name, one)) == (name, one)]
        there = ["{}.{}".format(*places()[id(getattr(module, one))]) for one in found if one not in here]
        parts += [heading(title, "-")] if len(groups) > 1 and title else []
        listed = [one for one in here if documented(getattr(module, one))]
        parts += [".. autosummary::\n\n" + "".join(f"   {one}\n" for one in listed)] if len(listed) > 1 else []
        parts += [entry(module, one) for one in here]
        parts += ["Also here: " + ", ".join(f"`{one}`" for one in there) + ".\n"] if there else []
    return "\n".join(parts)


def reference_page() -> str:
    """Return the first page of the reference: where each name of `ogm` itself is, and the modules."""
    ogm = importlib.import_module("ogm")
    rows = []
    for name in ogm.__all__:
        module, _ = places().get(id(getattr(ogm, name)), (getattr(ogm, name).__module__, name))
        rows.append(f":py:obj:`ogm.{name} <{module}.{name}>`")
    text = (
        "All public names: those of ``ogm`` itself and those on the pages below. What is not listed may change without "
        "notice; what is listed follows the :doc:`policy of deprecation <../project>`.\n"
    )
    parts = [NOTE, heading("API reference", "="), text, heading("Names of ogm itself", "-"), ",\n".join(rows) + ".\n"]
    for title, modules in REFERENCE.items():
        lines = [f"* :doc:`{name}`: {first_line(importlib.import_module(name))}\n" for name in modules]
        pages = "".join(f"   {name}\n" for name in modules)
        parts += [heading(title, "-"), "".join(lines), f".. toctree::\n   :hidden:\n\n{pages}"]
    return "\n".join(parts)


def first_line(module: ModuleType) -> str:
    """Return the first sentence of the docstring of a module."""
    return " ".join((inspect.getdoc(module) or "").split("\n\n")[0].split())


def gallery_page(docs: Path) -> str:
    """Return a page with every picture of the other pages, its description, and where it stands."""
    parts = ["# Gallery\n\nEvery picture of these pages, with the page that explains it.\n"]
    seen: set[str] = set()
    pages = {path.stem: path for path in sorted(docs.glob("*.md"))}
    for path in [pages.pop(name) for name in MAPS_FIRST] + list(pages.values()):
        text = path.read_text(encoding="utf-8")
        title = re.search(r"^# (.+)$", text, re.MULTILINE)
        found = {name: words for words, name in re.findall(r"!\[([^\]]+)\]\(pictures/([^)]+)\)", text)}
        found = {name: words for name, words in found.items() if name not in seen}
        if found and title:
            seen.update(found)
            parts += [f"## [{title[1]}](../{path.name})\n", ":::{container} gallery\n"]
            parts += [f"![{words}](../pictures/{name})\n" for name, words in found.items()]
            parts += [":::\n"]
    return "\n".join(parts)


def metrics_page() -> str:
    """Return the page with the table of the metrics."""
    from ogm.metrics import METRICS

    rows = [
        [f"`{name}`", one.title, one.better or "-", one.description.replace("|", "∣")]
        for name, one in METRICS.items()
        if not name.startswith("from")
    ]
    lower = {"from10_": "0.10 m, such as low kerbs,", "from50_": "0.50 m, such as kerbs, low walls and plants,"}
    place = 1 + next(k for k, row in enumerate(rows) if row[0] == "`missed_obstacles`")
    rows[place:place] = [
        [f"`{prefix}...`", METRICS[f"{prefix}iou_free"].title.replace("IoU free", "..."), "",
         f"{', '.join(name.removeprefix(prefix) for name in METRICS if name.startswith(prefix))} without occupied "
         f"cells whose obstacle is lower than {low}"]
        for prefix, low in lower.items()
    ]  # fmt: skip
    text = "# Metrics\n\nKeys of `ogm.metrics.METRICS`; definitions of [terms](../evaluation.md#metrics).\n\n"
    return text + table(["key", "title", "better", "definition"], rows, left=4) + "\n"


def with_links(text: str, folder: Path, docs: Path, below: str) -> str:
    """Return Markdown whose links to pages lead to pages of the site, seen from a folder below docs/ ("" or "../")."""
    pages = {(docs.parent / file).resolve(): f"generated/{name}.md" for name, file in OUTSIDE.items()}

    def replaced(found: re.Match[str]) -> str:
        link, _, anchor = found[1].partition("#")
        target = (folder / link).resolve()
        if not link or ":" in link or not target.is_file():
            return found[0]
        place = pages.get(target) or (
            target.relative_to(docs).as_posix()
            if target.is_relative_to(docs)
            else f"../{target.relative_to(docs.parent)}"
        )
        return f"]({below}{place}{'#' + anchor if anchor else ''})"

    return re.sub(r"\]\(([^)\s]+)\)", replaced, text)


def write_pages(docs: Path) -> None:
    """Write the pages where they differ, so that a second build reads only what has changed."""
    folder = docs / "generated"
    folder.mkdir(exist_ok=True)
    made = {"reference.rst": reference_page(), "gallery.md": gallery_page(docs)}
    made["metrics.md"] = metrics_page()
    made["commands.rst"] = NOTE + "\n" + command_page()
    made |= {f"{name}.rst": module_page(name) for name in MODULES}
    for name, file in OUTSIDE.items():
        path = docs.parent / file
        text = path.read_text(encoding="utf-8")
        if not text.startswith("# "):  # a part of a page: its headings go up
            title = f"# {name.replace('_', ' ').capitalize()}\n\nSimulated and recorded scans: "
            title += "[how they were compared](../simulation.md#how-close-to-the-real-thing).\n\n"
            text = title + re.sub("^###", "##", text, flags=re.MULTILINE)
        made[f"{name}.md"] = with_links(text, path.parent, docs, "../")
    for path in folder.iterdir():
        if path.name not in made:
            path.unlink()
    for name, text in made.items():
        path = folder / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
