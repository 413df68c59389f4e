"""The rules of one cell in numba against the rules on arrays, compiled and not."""

from typing import Any

import numpy as np
from cases import each
from cells import CELL_RULES, combine_cells
from hypothesis import given, settings
from masses import arrays_of_masses, tolerance

from ogm import evidence
from ogm.evidence.kernels import RULES

laws = settings(max_examples=30, deadline=None)
every_rule = each("name", CELL_RULES)


def test_the_table_holds_rules_of_the_package() -> None:
    assert list(RULES) == ["dempster", "yager", "cumulative", "cautious"]
    for name, rule in CELL_RULES.items():
        assert rule.arrays is getattr(evidence, name)


@laws
@given(masses=arrays_of_masses(2))
@every_rule
def test_cell_rules_are_the_array_rules(name: str, masses: Any) -> None:
    a, b = (mass.astype(np.float32) for mass in masses)
    result = combine_cells(name, a, b)
    assert result.dtype == np.float32
    np.testing.assert_allclose(result, CELL_RULES[name].arrays(a, b), atol=tolerance(a))


@every_rule
def test_cell_rules_are_the_array_rules_on_a_grid(name: str) -> None:
    a, b = np.random.default_rng(0).dirichlet([0.2, 0.2, 0.2], (2, 61, 37)).astype(np.float32)[..., :2].copy()
    a[::7], b[::5], a[::3], b[::4] = (1, 0), (0, 1), (0, 0), (0.25, 0.75)
    np.testing.assert_allclose(combine_cells(name, a, b), CELL_RULES[name].arrays(a, b), atol=tolerance(a))


@every_rule
def test_nan_stays_in_its_cell(name: str) -> None:
    a, b = np.full((2, 40, 2), 0.25, np.float32)
    a[7], b[21], b[33] = np.nan, np.nan, np.nan
    result = combine_cells(name, a, b)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(result).any(-1)), (7, 21, 33))
    assert np.isnan(result[[7, 21, 33]]).all()
