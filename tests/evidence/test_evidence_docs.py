"""The documentation runs, its pictures exist, and its table of rules is proven by tests."""

import doctest
import importlib
import re
from pathlib import Path

import pytest
from masses import RULES

import ogm.evidence

PAGE = Path(__file__).parents[2] / "docs" / "evidence.md"


def test_the_page_runs() -> None:
    result = doctest.testfile(str(PAGE), module_relative=False)
    assert result.attempted > 50
    assert result.failed == 0


@pytest.mark.parametrize("name", ["ogm.evidence", "ogm.evidence.powerset"])
def test_docstrings_run(name: str) -> None:
    assert doctest.testmod(importlib.import_module(name)).failed == 0


def test_pictures_exist() -> None:
    pictures = re.findall(r"pictures/(\w+\.png)", PAGE.read_text())
    assert len(pictures) >= 14
    for picture in pictures:
        assert (PAGE.parent / "pictures" / picture).is_file(), picture


def test_the_table_of_rules_is_proven_by_the_tests() -> None:
    rows = {
        cells[0].strip(" `"): [cell.strip() for cell in cells[1:4]]
        for cells in (line.strip("|").split("|") for line in PAGE.read_text().splitlines())
        if len(cells) == 7 and cells[0].strip().startswith("`")
    }
    word = {True: "yes", False: "no"}
    expected = {
        name: [word[laws.associative], word[laws.vacuous_is_neutral], word[laws.idempotent]]
        for name, laws in RULES.items()
    }
    assert rows == expected


def test_the_page_names_every_function() -> None:
    text = PAGE.read_text()
    missing = [name for name in ogm.evidence.__all__ if not re.search(rf"\b{name}\b", text)]
    assert not missing
