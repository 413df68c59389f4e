"""The documentation runs, its table of rules is proven by tests, and the package stays light."""

import doctest
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
from masses import RULES

import ogm.evidence
from ogm.evidence import kinds, map_rules, multinomial, opinion, powerset

PAGE = Path(__file__).parents[2] / "docs" / "evidence.md"


def test_the_page_runs() -> None:
    result = doctest.testfile(str(PAGE), module_relative=False)
    assert result.attempted > 30
    assert result.failed == 0


def test_docstrings_run() -> None:
    for module in (ogm.evidence, kinds, map_rules, multinomial, opinion, powerset):
        assert doctest.testmod(module).failed == 0


def test_the_table_of_rules_is_proven_by_the_tests() -> None:
    rows = {
        cells[0].strip(" `"): [cell.strip() for cell in (*cells[1:4], cells[7])]
        for cells in (line.strip("|").split("|") for line in PAGE.read_text().splitlines())
        if len(cells) == 8 and cells[0].strip().startswith("`")
    }
    word = {True: "yes", False: "no"}

    def result(name: str) -> str:
        masses = getattr(ogm.evidence, name)(np.array([0.5, 0.2]), np.array([0.1, 0.6])).round(4)
        return f"({', '.join(f'{mass:g}' for mass in masses)})"

    expected = {
        name: [word[laws.associative], word[laws.vacuous_is_neutral], word[laws.idempotent], result(name)]
        for name, laws in RULES.items()
    }
    assert rows == expected


def test_the_page_names_every_function() -> None:
    text = PAGE.read_text()
    missing = [name for name in ogm.evidence.__all__ if not re.search(rf"\b{name}\b", text)]
    assert not missing


def test_every_export_has_documentation() -> None:
    for module in (ogm.evidence, multinomial, powerset):
        assert sorted(module.__all__) == list(module.__all__)
        for name in module.__all__:
            assert getattr(module, name).__doc__, name


def test_computing_loads_no_heavy_package() -> None:
    code = """
import sys, numpy as np
from ogm import evidence
a = np.array([0.5, 0.2])
evidence.dempster(a, a), evidence.dirichlet_kl(a, a), evidence.mass_to_evidence(a), evidence.cautious(a, a)
assert not {"torch", "numba", "matplotlib", "open3d", "pandas", "mpmath"} & set(sys.modules)
"""
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True)
