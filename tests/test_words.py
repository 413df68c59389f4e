"""The words of the field: coined words stay out of the package and its documentation."""

import re
from pathlib import Path

import pytest

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
    r"^docs/(build|reproduction_sentences)\.py:.*[\"'][^\"']*called": "keys of the records, written before",
    r"\bbearings\b": "a key of the shipped weights",
    r"^ogm/simulation/town/.*([Hh]ouse|[Dd]oor)": "buildings of the simulator's towns",
}
FILES = sorted(
    path
    for pattern in (
        "ogm/**/*.py",
        "ogm/data/report.*",
        "docs/*.md",
        "docs/*.py",
        "README.md",
        "pyproject.toml",
        "CONTRIBUTING.md",
    )
    for path in ROOT.glob(pattern)
)


LINES = [
    (f"{path.relative_to(ROOT)}:{number}", line)
    for path in FILES
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
]


@pytest.mark.parametrize("word", COINED, ids=lambda word: word.split("|")[0])
def test_coined_words_are_gone(word: str) -> None:
    coined = re.compile(rf"(?<![\w-])(?:{word})(?![\w-])")
    allowed = re.compile("|".join(ALLOWED))
    found = [
        f"{place}: {line.strip()[:80]}"
        for place, line in LINES
        if coined.search(line) and not allowed.search(f"{place}: {line}")
    ]
    assert not found, f"write {COINED[word]} instead:\n" + "\n".join(found)
