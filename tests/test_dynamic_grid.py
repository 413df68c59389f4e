"""DynamicGrid: checks, what is derived, layers and back."""

import numpy as np
import pytest
from cases import refused
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
    refused("no layer 'velocity_y'", DynamicGrid.from_layers, LayeredGrid(SPEC, layers), error=KeyError)


def test_grids_are_equal_if_all_numbers_are() -> None:
    grid = street()
    assert grid == street()
    assert grid != grid.to_evidential()
    refused("unhashable", hash, grid, error=TypeError)
    for name in ("mass", "velocity", "covariance"):
        parts = {one: getattr(grid, one).copy() for one in ("mass", "velocity", "covariance")}
        parts[name][SPEC.index(9.0, 1.0)] *= 0.5
        assert grid != DynamicGrid(SPEC, **parts)


def test_a_grid_is_printed_on_one_line() -> None:
    assert repr(street()) == (
        "DynamicGrid(64 x 48 cells of 0.5 m, x -16 to 16 m, y -12 to 12 m: "
        "free 46.7%, static 4.9%, dynamic 2.6%, unknown 45.8%)"
    )


def test_what_is_no_grid_is_refused() -> None:
    grid = street()
    parts = {one: getattr(grid, one) for one in ("mass", "velocity", "covariance")}
    for name, value, message in (
        ("mass", grid.mass[..., :2], r"mass must have shape \(64, 48, 3\)"),
        ("velocity", grid.velocity[:5], "velocity must have shape"),
        ("covariance", grid.covariance[..., 0], "covariance must have shape"),
        ("mass", grid.mass * 2, "mass"),
        ("mass", grid.mass * np.float32(np.nan), "nan"),
        ("mass", -grid.mass, "mass"),
    ):
        refused(message, DynamicGrid, SPEC, **parts | {name: value})
    refused("must be a float array", DynamicGrid, SPEC, **parts | {"mass": grid.mass.astype(int)}, error=TypeError)
