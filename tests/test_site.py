"""The documentation as a whole: the reference is complete, its examples run, commands and links are real."""

import ast
import doctest
import importlib
import importlib.util
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from cases import each
from typer.main import get_command

import ogm
from ogm.cli import app

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.glob("*.md"), *DOCS.glob("tutorials/*.md")])
INTERNAL = {  # modules with __all__ that are not for users
    *(
        "archive", "cli", "extras", "jit", "locks", "notebook", "pool", "remote", "rotation", "view_layers",
        "geometric.reference", "io.formats",
    ),
    "io.grids",  # its names are in ogm.io
    *("simulation.town", "simulation.traffic"),
}  # fmt: skip


sys.path.insert(0, str(DOCS))  # of modules that those of the site import


def load(file: Path) -> ModuleType:
    """Import a program by its file."""
    spec = importlib.util.spec_from_file_location(file.stem, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[file.stem] = module
    spec.loader.exec_module(module)
    return module


site_pages = load(DOCS / "site_pages.py")
site_links = load(DOCS / "site_links.py")


def test_every_public_module_is_in_the_reference() -> None:
    found = set()
    for path in (ROOT / "ogm").rglob("*.py"):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        if (
            name != "ogm"
            and (path.name == "__init__.py" or path.parent.name == "ogm")
            and "__all__" in path.read_text()
        ):
            found.add(name)
    assert found - {f"ogm.{name}" for name in INTERNAL} <= set(site_pages.MODULES)


@each("module", site_pages.MODULES)
def test_every_public_name_is_on_its_page_with_a_description(module: str) -> None:
    page = site_pages.module_page(module)
    names = importlib.import_module(module).__all__
    assert len(set(names)) == len(names)
    for name in names:
        entry = re.search(rf"^\.\. (\w|:)+:: {name}$|`[\w.]+\.{name}`", page, re.MULTILINE)
        assert entry, name
        if entry[0].startswith(".. py:data"):
            text = page[entry.end() :].split("\n.. ")[0]
            assert re.search(r"^   [^:\s]", text, re.MULTILINE) or ":value:" in text, f"{name} has no comment"
        elif (value := getattr(importlib.import_module(module), name)).__module__.startswith("ogm"):
            assert value.__doc__, name


def test_every_name_of_ogm_itself_is_in_the_reference() -> None:
    page = site_pages.reference_page()
    for name in ogm.__all__:
        target = re.search(rf"`ogm\.{name} <([\w.]+)\.{name}>`", page)
        assert target, name
        assert target[1] in site_pages.MODULES


def python_of(page: Path) -> Iterator[str]:
    """Yield the Python blocks of a page, also interactive ones, or an example."""
    if page.suffix == ".py":
        yield page.read_text()
        return
    for block in re.findall(r"^```python\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE):
        lines = [line[4:] for line in block.splitlines() if line.startswith((">>> ", "... "))]
        yield "\n".join(lines) if ">>>" in block else block


def test_documentation_and_examples_use_public_names() -> None:
    public = {name: importlib.import_module(name).__all__ for name in (*site_pages.MODULES, "ogm")}
    for page in [*PAGES, *(ROOT / "examples").glob("*.py")]:
        for block in python_of(page):
            for node in ast.walk(ast.parse(block)):
                if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "ogm":
                    for alias in node.names:
                        known = (
                            alias.name in public.get(node.module or "", ()) or f"{node.module}.{alias.name}" in public
                        )
                        assert known, f"{page.name}: {node.module}.{alias.name}"


MODULES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for path in sorted((ROOT / "ogm").rglob("*.py"))
    if ">>>" in path.read_text()
]


@each("module", MODULES)
def test_examples_of_the_reference_run(module: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    options = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
    assert doctest.testmod(importlib.import_module(module), optionflags=options).failed == 0


def test_every_page_of_the_reference_has_an_example() -> None:
    for name in site_pages.MODULES:
        module = importlib.import_module(name)
        texts = [module.__doc__, *(getattr(module, one).__doc__ for one in module.__all__)]
        assert any(">>>" in (text or "") for text in texts), name


def test_commands_of_the_documentation_have_the_options_that_they_are_given() -> None:
    top = get_command(app)
    count = 0
    for page in PAGES:
        blocks = re.findall(r"^```console\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
        lines = [
            line
            for block in blocks
            for line in re.findall(r"^\$ (?:\S*/)?ogm (.+)$", block.replace("\\\n", " "), re.MULTILINE)
        ]
        for line in lines:
            command, words = top, shlex.split(line, comments=True)
            while hasattr(command, "commands") and words and not words[0].startswith("-"):
                assert words[0] in command.commands, f"{page.name}: ogm {line}"
                command = command.commands[words.pop(0)]
            options = {name for one in command.params for name in (*one.opts, *one.secondary_opts)} | {"--help"}
            given = {word.partition("=")[0] for word in words if re.match(r"--?[a-z]", word)}
            assert given <= options, f"{page.name}: ogm {line}"
            count += 1
    assert count > 50


def test_every_command_and_option_is_on_the_page_of_the_command_line() -> None:
    page = load(DOCS / "command_page.py").command_page()
    top = get_command(app)
    groups = {f"ogm {name}": command for name, command in top.commands.items()}
    groups |= {f"ogm world {name}": command for name, command in groups.pop("ogm world").commands.items()}
    assert len(groups) > 15
    for name, command in groups.items():
        text = page.partition(f"\n\n{name}\n---")[2].partition(".. _ogm-")[0]
        assert f"   {name} [OPTIONS]" in text
        options = {option for one in command.params for option in one.opts if option.startswith("-")}
        listed = re.findall(r"(?:^\.\. option:: |, )(-[\w-]+)", text, re.MULTILINE)
        assert options <= set(listed), name
    assert "[default: 10.0]" in page


def test_broken_links_of_the_site_are_found(tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text(
        '<h1 id="top"><a href="b.html#here"></a><a href="#top"></a><img src="c.png" alt="c">'
    )
    (tmp_path / "b.html").write_text('<a id="here" href="https://elsewhere.org/x"></a>')
    (tmp_path / "c.png").touch()
    assert list(site_links.broken_links(tmp_path)) == []
    (tmp_path / "b.html").write_text('<a href="d.html"></a><a href="a.html#bottom"></a><img src="c.png">')
    assert list(site_links.broken_links(tmp_path)) == [
        "a.html: b.html#here: b.html has no such anchor",
        "b.html: the picture c.png has no alternative text",
        "b.html: a.html#bottom: a.html has no such anchor",
        "b.html: d.html does not exist",
    ]


def test_the_readme_of_the_package_index_has_absolute_links() -> None:
    index_text, readme = load(ROOT / "setup.py").index_text, (ROOT / "README.md").read_text()
    text = index_text(readme, "https://example.org/ogm", "v1")
    assert "![" in text
    assert "(https://example.org/ogm/raw/v1/docs/pictures/demo.png)" in text
    assert "(https://example.org/ogm/blob/v1/docs/deep.md#limits)" in text
    for found in (text, index_text(readme, None, "v1")):
        assert [link for link in re.findall(r"\]\(([^)]+)\)", found) if not link.startswith("https://")] == []
    assert "![" not in index_text(readme, None, "v1")
    assert readme.index("pip install ogm-toolkit") < readme.index("$ ", readme.index("pip install") + 1)
