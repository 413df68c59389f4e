"""DynamicGrid: checks, what is derived, layers and back."""

import numpy as np
import pytest
from moving import SPEC, street

from ogm import DynamicGrid, EvidentialGrid, LayeredGrid


def test_masses_are_consistent() -> None:
    grid = street()
    np.testing.assert_allclose(grid.free + grid.static + grid.dynamic + grid.unknown, 1, atol=1e-6)
    assert isinstance(grid.to_evidential(), EvidentialGrid)
    np.testing.assert_array_equal(grid.to_evidential().occupied, grid.occupied)


def test_speed_and_heading_are_those_of_the_velocity() -> None:
    grid = street()
    ahead, coming = SPEC.index(9.0, 1.0), SPEC.index(9.0, 3.0)
    assert grid.speed[ahead] == 8.0
    assert grid.heading[ahead] == 0.0
    assert grid.heading[coming] == pytest.approx(np.pi)
    assert np.isnan(grid.speed[SPEC.index(0.0, 0.0)])


def test_layers_hold_all_of_it() -> None:
    grid = street()
    assert DynamicGrid.from_layers(grid.to_layers()) == grid
    layers = dict(grid.to_layers().layers)
    del layers["velocity_y"]
    with pytest.raises(KeyError, match="no layer 'velocity_y'"):
        DynamicGrid.from_layers(LayeredGrid(SPEC, layers))


def test_grids_are_equal_if_all_numbers_are() -> None:
    grid = street()
    assert grid == street()
    assert grid != grid.to_evidential()
    with pytest.raises(TypeError, match="unhashable"):
        hash(grid)
    for name in ("mass", "velocity", "covariance"):
        parts = {one: getattr(grid, one).copy() for one in ("mass", "velocity", "covariance")}
        parts[name][SPEC.index(9.0, 1.0)] *= 0.5
        assert grid != DynamicGrid(SPEC, **parts)


def test_a_grid_is_printed_on_one_line() -> None:
    assert repr(street()) == (
        "DynamicGrid(64 x 48 cells of 0.5 m, x -16 to 16 m, y -12 to 12 m: "
        "free 46.7%, static 4.9%, dynamic 2.6%, unknown 45.8%)"
    )


@pytest.mark.parametrize(
    ("name", "change", "error", "message"),
    [
        ("mass", lambda one: one[..., :2], ValueError, r"mass must have shape \(64, 48, 3\)"),
        ("velocity", lambda one: one[:5], ValueError, "velocity must have shape"),
        ("covariance", lambda one: one[..., 0], ValueError, "covariance must have shape"),
        ("mass", lambda one: one.astype(int), TypeError, "must be a float array"),
        ("mass", lambda one: one * 2, ValueError, "mass"),
        ("mass", lambda one: one * np.float32(np.nan), ValueError, "nan"),
        ("mass", lambda one: -one, ValueError, "mass"),
    ],
)
def test_what_is_no_grid_is_refused(name: str, change, error: type, message: str) -> None:
    grid = street()
    parts = {one: getattr(grid, one) for one in ("mass", "velocity", "covariance")}
    parts[name] = change(parts[name])
    with pytest.raises(error, match=message):
        DynamicGrid(SPEC, **parts)
