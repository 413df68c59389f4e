"""The words of the field: coined words stay out of the package and its documentation, and phrases stay rare."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

from cases import each

ROOT = Path(__file__).parents[1]
# today's word (regular expression, whole word) -> the field's term
COINED = {
    r"level_say|_say_span|say of a|the say": "ray weight, visibility weight; clip below clearance",
    r"p_pass": "p_miss",
    r"p_false": "p_false_alarm",
    r"missing_weight": "no_return_weight",
    r"marked_reliability": "free_reliability_at_hits",
    r"own vehicle|own_box|own_points|own_frame": "ego vehicle, ego_footprint, to_vehicle_frame",
    r"mirror images?": "multipath, ghost returns",
    r"foot": "ground_point",
    r"called|call of a cell": "predict_state, predicted",
    r"Tally|tally": "ConfusionSums, accumulate",
    r"likelier|surprise|doubt": "confusion_by_probability, log_loss, unknown_hist",
    r"says": "description, states",
    r"same_cells": "resample_to",
    r"judging|judged?|Judged": "runner, evaluate, FrameResult",
    r"Archive": "ResultCache",
    r"class (Scans|Stored)|(Scans|Stored)\(": "SingleScanMethod, PrecomputedGrids",
    r"measured_route": "estimate_trajectory",
    r"in_house_axes": "to_flu",
    r"unbend|bent": "deskew, motion-distorted",
    r"complaints|tidy": "stderr, report_errors",
    r"told|is told by": "format_number; is given by",
    r"manieth": "every N-th",
    r"foreign grids": "external, precomputed grids",
    r"Arrival": "CheckedScan",
    r"what came leaves|leaving": "dynamic decay",
    r"HAIR": "EPS_CELL",
    r"settle|nobody": "finalize_truth, unobserved",
    r"CANVAS|canvas": "TRUTH_SPEC, truth extent; feature map",
    r"Shot|Seen": "FrameRef, RawFrame",
    r"seen_in|limited": "training_ranges, cap_pillars",
    r"_follow|_nothing|bearings": "update_ema, nonfinite_loss_error, sensor_coords",
    r"the house|house's|rooms?|doors?|floor \d": "module, package, interface, layer",
}
# Legitimate uses: pattern of the line -> reason
ALLOWED = {
    r"(is|are|be|not|when) called|called (with|when|once|at|by|for|first|in)": "functions are called",
    r"^docs/(build|deep_tables|reproduction_sentences)\.py:.*[\"'][^\"']*called": "keys of the records, written before",
    r"\bbearings\b": "a key of the shipped weights",
    r"^docs/(geometric\.md|make_planar_picture\.py):.*\b(room|door)\b": "what a planar laser measures indoors",
    r"^ogm/simulation/town/.*([Hh]ouse|[Dd]oor)": "buildings of the simulator's towns",
}
PATTERNS = (
    "ogm/**/*.py", "ogm/data/report.*", "docs/*.md", "docs/*.py", "README.md", "pyproject.toml", "CONTRIBUTING.md"
)  # fmt: skip


def test_coined_words_are_gone() -> None:
    coined, allowed = re.compile(rf"(?<![\w-])(?:{'|'.join(COINED)})(?![\w-])"), re.compile("|".join(ALLOWED))
    lines = [
        (f"{path.relative_to(ROOT)}:{number}", line)
        for pattern in PATTERNS
        for path in sorted(ROOT.glob(pattern))
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if coined.search(line)
    ]
    found = [
        f"{place}: {line.strip()[:80]}: write "
        + next(term for word, term in COINED.items() if re.search(rf"(?<![\w-])(?:{word})(?![\w-])", line))
        for place, line in lines
        if not allowed.search(f"{place}: {line}")
    ]
    assert lines, "nothing was read"
    assert not found, "\n".join(found)


RATES = {  # pattern -> most per 1,000 words of docstrings of a package; xarray, SciPy, zarr, rasterio have at most
    r"\bwhat\b": 0.4,  # 0.24
    r"\b(those|that) (of|with|where|which)\b|\bthose that\b": 0.3,  # 0.11
    r"\bwhere (they|it|there|none|that|nothing)\b": 0.2,  # 0.04
    r"\bas (of|for|those)\b": 0.15,  # 0.12
    r"\b(is|are|has|have|makes?|gives?) none\b|\bnone (is|of|where)\b": 0.6,  # 0.6
    r"\b(anew|of late|besides?|but for|at hand|so many|on the way|all that|nothing of|perhaps)\b": 0.1,  # 0.06
    r"\b(the|that|this|each|small|other|good|new|own|large|larger|longer|shorter|finer|of|as|last|right) ones?\b": 0.9,
    r"\bdata sets?\b": 0.0,  # 0.04
    r"\b(whoever|whatever)\b": 0.0,
}
SPARE = 1  # occurrences that a small package may have anyway
PACKAGES = sorted(path.name for path in (ROOT / "ogm").iterdir() if (path / "__init__.py").is_file())


def docstrings(folder: Path, pattern: str) -> Iterator[str]:
    """Yield the docstrings of some files without code and examples."""
    for path in folder.glob(pattern):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Module | ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
                text = re.sub(r"(?m)^\s*>>>.*$|^\s*\.\.\. .*$", "", ast.get_docstring(node) or "")
                yield re.sub(r"``[^`]*``|`[^`]*`", " X ", text)


@each("package", ["", *PACKAGES])
def test_phrases_of_docstrings_are_rare(package: str) -> None:
    texts = list(docstrings(ROOT / "ogm" / package, "**/*.py" if package else "*.py"))
    words = sum(len(re.findall(r"[A-Za-z']+", text)) for text in texts)
    assert words > 500
    found = {rate: [text for text in texts for _ in re.findall(rate, text, re.IGNORECASE)] for rate in RATES}
    frequent = {rate: places for rate, places in found.items() if len(places) > max(RATES[rate] * words / 1000, SPARE)}
    assert frequent == {}
    assert [text for text in texts if re.match(r"(What|Of|Where|That|Who)\b", text.strip())] == []
