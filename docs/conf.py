"""Settings of the documentation site: ``./run docs`` builds it."""

import inspect
import re
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

from site_links import broken_links  # noqa: E402
from site_pages import with_links, write_pages  # noqa: E402
from sphinx.addnodes import desc_annotation, desc_sig_name  # noqa: E402
from sphinx.util.logging import getLogger  # noqa: E402

import ogm  # noqa: E402

project = "ogm"
author = "the ogm developers"
copyright = "2026, the ogm developers. Apache-2.0"  # noqa: A001
version = release = ogm.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["_build", "pictures"]
smartquotes_action = "qe"  # quotes and ellipses: the two hyphens of --option stay
default_role = "py:obj"  # `name` in a docstring links where there is such a name
nitpicky = False  # types of other packages are no links: the site is built without a network

myst_heading_anchors = 4  # the anchors of GitHub: #what-it-reaches
myst_enable_extensions = ["attrs_inline", "colon_fence", "html_image"]

autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_default_options = {"members": True}
autodoc_preserve_defaults = True
autosummary_generate = False  # a page per package, written by site_pages.py
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_param = False  # types in docstrings are words, not links
napoleon_use_ivar = True
suppress_warnings = ["ref.python"]  # a word of a type that is also the name of several attributes
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88

html_theme = "pydata_sphinx_theme"
html_title = f"ogm {version}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_favicon = "static/icon.svg"
html_context = {"default_mode": "auto"}
html_show_sourcelink = False
html_copy_source = False
html_theme_options = {
    "navigation_with_keys": False,
    "show_prev_next": True,
    "navbar_align": "left",
    "header_links_before_dropdown": 7,
    "show_toc_level": 2,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}
html_sidebars = {"start": []}

write_pages(HERE)


def escape_formulas(app: object, what: str, name: str, value: object, options: object, lines: list[str]) -> None:
    """Keep |x| and ** of formulas in docstrings from being read as markup, and attributes of one line together."""
    kept = re.compile(r"``.*?``|`[^`]+`|(?<![\w)*])\*\*(?=\S)[^*]+\*\*(?!\w)|(\||\*\*)")  # code, bold, formula
    lines[:] = [
        line if line.startswith((">>>", "...")) else kept.sub(lambda one: "\\" * bool(one[1]) + one[0], line)
        for line in lines
    ]
    if "Attributes" in lines:
        start = lines.index("Attributes")
        lines[start:] = [
            line.replace(", ", ",", line.partition(" : ")[0].count(", ")) if " : " in line else line
            for line in lines[start:]
        ]


def keep_colons(app: object, what: str, name: str, value: object, options: object, lines: list[str]) -> None:
    """Undo for properties what napoleon makes of "Summary: details", a type and a text."""
    if what == "property" and any(line.startswith(":type:") for line in lines):
        lines[:] = (inspect.getdoc(value) or "").splitlines()
        escape_formulas(app, what, name, value, options, lines)


ARRAY_LIKE = re.compile(
    r"_?Buffer \| _SupportsArray\[dtype\[Any\]\] \| _NestedSequence\[_SupportsArray\[dtype\[Any\]\]\] \| complex \| "
    r"bytes \| str \| _NestedSequence\[complex \| bytes \| str\]"
)


def as_in_the_source(app: object, what: str, name: str, value: object, options: object, *signature: str | None) -> Any:
    """Return arguments and result of a function with the short names of types, and defaults that can be parsed."""
    return tuple(shown(text) if text else text for text in signature)


def shown(text: str) -> str:
    """Return types and defaults of a signature, short."""
    text = re.sub(r"~(?:numpy|typing|collections\.abc)\.(?:\w+\.)*(?=\w)", "", text)
    text = re.sub(r"ndarray\[tuple\[Any, \.\.\.\], dtype\[(\w+)\]\]", r"NDArray[\1]", ARRAY_LIKE.sub("ArrayLike", text))
    text = re.sub(r"\d+\.\d{9,}", lambda number: f"{float(number[0]):.4g}", text)  # angles, in radians
    text = re.sub(r"\(LidarMount\(.*?\)\)(?=,)", "...", text)
    return re.sub(r"<(?:function|class) '?([\w.]+)'?(?: at 0x\w+)?>", r"\1", text).replace("<factory>", "...")


def shorten_types(app: object, page: Any, name: str) -> None:
    """Write the types of properties as those of functions."""
    for node in page.findall(desc_annotation):
        if (short := shown(node.astext())) != node.astext():
            node.children = [desc_sig_name("", short)]


def skip_fields(app: object, what: str, name: str, value: object, skip: bool, options: object) -> bool | None:
    """Leave out the fields of named tuples, and functions that are defaults of fields: their class describes them."""
    default = what == "class" and inspect.isfunction(value) and "." not in value.__qualname__
    return True if default or type(value).__name__ == "_tuplegetter" else None


def lead_to_pages(app: object, name: str, source: list[str]) -> None:
    """Make links to files outside of docs/ lead to their pages of the site."""
    if not name.startswith("generated/"):
        source[0] = with_links(source[0], (HERE / name).parent, HERE, "../" * name.count("/"))


def check_links(app: Any, error: Exception | None) -> None:
    """Warn of links that lead nowhere; with ``-W`` the build fails."""
    if error is None and app.builder.name == "html":
        for line in broken_links(Path(app.outdir)):
            getLogger(__name__).warning(line)


def setup(app: Any) -> None:
    """Connect the functions above."""
    app.connect("autodoc-process-docstring", escape_formulas, priority=100)  # before napoleon
    app.connect("autodoc-process-docstring", keep_colons, priority=900)  # after it
    app.connect("autodoc-process-signature", as_in_the_source)
    app.connect("doctree-resolved", shorten_types)
    app.connect("autodoc-skip-member", skip_fields)
    app.connect("source-read", lead_to_pages)
    app.connect("build-finished", check_links)
