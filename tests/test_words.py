"""The words of the field: coined words stay out of the package and its documentation, and phrases stay rare."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

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


RATES = {  # pattern -> most per 1,000 words of docstrings; at most in xarray, SciPy, scikit-learn, zarr, rasterio
    r"\bwhat\b": 5.4,  # 0.24
    r"\b(those|that) (of|with|where|which)\b|\bthose that\b": 2.75,  # 0.11
    r"\bwhere (they|it|there|none|that|nothing)\b": 2.05,  # 0.04
    r"\bas (of|for|those)\b": 0.85,  # 0.12
    r"\b(is|are|has|have|makes?|gives?) none\b|\bnone (is|of|where)\b": 1.4,  # 0.6
    r"\b(anew|of late|besides?|but for|at hand|so many|on the way|all that|nothing of|perhaps)\b": 1.55,  # 0.06
    r"\b(the|that|this|each|small|other|good|new|own|large|larger|longer|shorter|finer|of|as|last|right) ones?\b": 2.25,
    r"\bdata sets?\b": 1.4,  # 0.04
    r"\b(whoever|whatever|whose)\b": 1.65,  # 0.25
}
MAX_FIRST_LINES = 104  # docstrings that begin with What, Of, Where, That or Who


def docstrings() -> Iterator[str]:
    """Yield the docstrings of the package without code and examples."""
    for path in (ROOT / "ogm").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Module | ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
                text = re.sub(r"(?m)^\s*>>>.*$|^\s*\.\.\. .*$", "", ast.get_docstring(node) or "")
                yield re.sub(r"``[^`]*``|`[^`]*`", " X ", text)


def test_phrases_of_docstrings_are_rare() -> None:
    texts = list(docstrings())
    words = sum(len(re.findall(r"[A-Za-z']+", text)) for text in texts)
    assert words > 50_000
    rates = {rate: 1000 * sum(len(re.findall(rate, text, re.IGNORECASE)) for text in texts) / words for rate in RATES}
    assert {rate: value for rate, value in rates.items() if value > RATES[rate]} == {}
    assert sum(bool(re.match(r"(What|Of|Where|That|Who)\b", text.strip())) for text in texts) <= MAX_FIRST_LINES
