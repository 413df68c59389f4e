"""GridSpec, EvidentialGrid and LayeredGrid: geometry, checks, files."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given, settings
from hypothesis import strategies as st

from ogm import DynamicGrid, EvidentialGrid, GridSpec, LayeredGrid, Mount
from ogm.geometric import RadarISM

SPEC = GridSpec(resolution=0.5, shape=(6, 4), origin=(-1.0, -2.0))


def random_grid(seed: int = 0, spec: GridSpec = SPEC) -> EvidentialGrid:
    mass = np.random.default_rng(seed).dirichlet([1, 1, 1], spec.shape)[..., :2].astype(np.float32)
    return EvidentialGrid(spec, mass)


def test_centered_gives_the_papers_grid() -> None:
    spec = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
    assert spec.shape == (512, 352)
    np.testing.assert_allclose(spec.extent, (-40.96, 40.96, -28.16, 28.16), atol=1e-12)
    assert GridSpec.centered() == spec


def test_centered_refuses_broken_lengths_and_names_whole_ones() -> None:
    message = r"length 10.0 m is 62.5 cells .* use 9.92 m or 10.08 m"
    refused(message, GridSpec.centered, length=10.0, width=1.6, resolution=0.16)


@each("resolution", [0.1, 0.2, 0.16, 0.32, 0.3, 1.0, 7.0, 100.0])
def test_default_extents_follow_the_resolution(resolution: float) -> None:
    """Whole cells, centred, and as close to the paper's 81.92 m x 56.32 m as whole cells come."""
    spec = GridSpec.centered(resolution=resolution)
    assert spec.resolution == resolution
    if resolution < 50:
        assert abs(spec.length - 81.92) <= resolution / 2 + 1e-9
        assert abs(spec.width - 56.32) <= resolution / 2 + 1e-9
    x0, x1, y0, y1 = spec.extent
    assert (x0 + x1, y0 + y1) == pytest.approx((0, 0), abs=1e-9)
    assert min(spec.shape) >= 1


def test_only_defaults_are_rounded() -> None:
    assert GridSpec.centered(length=80.0, resolution=0.1).shape == (800, 563)
    message = r"width 56.32 m is 563.2 cells .* use 56.3 m or 56.4 m"
    refused(message, GridSpec.centered, width=56.32, resolution=0.1)


def test_impossible_specs_are_refused() -> None:
    nan, inf = float("nan"), float("inf")
    for resolution in (0.0, -1.0, nan, inf, 10**400, 1e300, 1e30, 5e-324, 1e-9):
        refused("^resolution", GridSpec, resolution, (2, 2), (0, 0))
    for shape in (
        *((0, 2), (2.5, 2), (2, 2, 2), (2,), (2**14, 2**14 + 1), (2**14 + 1, 2**14)),
        *((inf, 3), (3, nan), (10**400, 3)),
    ):
        refused("shape", GridSpec, 1.0, shape, (0, 0))
    for origin in ((0, 0, 0), (inf, 0), (10**400, 0)):
        refused("origin", GridSpec, 1.0, (2, 2), origin)
    for size in (0.0, -1.0, nan, inf):
        refused("^resolution must be positive and finite", GridSpec.centered, 8.0, 8.0, size)
        refused("width must be positive and finite", GridSpec.centered, 8.0, size, 1.0)
    for factor in (0, -1, 0.5, 1.5, nan, inf):
        refused("factor must be a positive whole number", SPEC.refined, factor)
    assert GridSpec(1.0, (2**14, 2**14), (0, 0)).length == 2**14  # the largest, of 2**28 cells


def test_specs_beyond_sense_are_refused() -> None:
    for spec in ((1e6, (2**14, 3), (0, 0)), (1.0, (2, 2), (1e11, 0)), (1.0, (2, 2), (0, -1e300))):
        refused("grids must lie within 1e.10 m", GridSpec, *spec)
    for resolution in (1e-6, 1e6):
        assert (
            RadarISM(GridSpec.centered(3 * resolution, 3 * resolution, resolution), Mount(1.0))(
                np.zeros((2, 4))
            ).free.max()
            <= 1
        )


def test_extents_are_whole_cells_to_a_millionth() -> None:
    assert GridSpec.centered(0.3, 1000 + 9e-4, 0.1 + 0.2 - 0.2).shape == (3, 10000)
    for length in (1 + 1.2e-6, 1000 + 2e-3, 0.9999):
        refused("not a whole number", GridSpec.centered, length, 8.0, 1.0)


def test_grids_lie_around_their_center_and_may_be_one_cell() -> None:
    assert GridSpec.centered(4.0, 2.0, 0.5, center=(10.0, -3.0)).extent == (8.0, 12.0, -4.0, -2.0)
    assert GridSpec.centered(resolution=1000.0).shape == (1, 1)
    assert GridSpec.centered(1.0, 1.0, 1.0).shape == (1, 1)


def test_cell_centers_are_the_middles() -> None:
    x, y = GridSpec(0.5, (2, 3), (1.0, -1.0)).cell_centers
    assert x.tolist() == [[1.25], [1.75]]
    assert y.tolist() == [[-0.75, -0.25, 0.25]]


def test_a_spec_keeps_plain_numbers() -> None:
    spec = GridSpec(np.float32(1), (np.int64(2), 3.0), (0, np.float32(1)))  # type: ignore[arg-type]
    assert repr(spec) == "GridSpec(resolution=1.0, shape=(2, 3), origin=(0.0, 1.0))"


def test_index_floors_and_never_truncates() -> None:
    ix, iy = SPEC.index([-1.0, -0.51, -1.01, 1.99, 2.0], [-2.0, -1.51, -2.01, -0.01, 0.0], unbounded=True)
    assert ix.tolist() == [0, 0, -1, 5, 6]
    assert iy.tolist() == [0, 0, -1, 3, 4]
    assert SPEC.contains([0.0, 0.0, 0.0], [-2.0, -0.001, 0.0]).tolist() == [True, True, False]
    assert SPEC.contains([-1.0, -1.01, 1.99, 2.0], [-2.0, -2.0, -0.01, 0.0]).tolist() == [True, False, True, False]


@each(("x", "y"), [(-1.01, -1.0), ([0.0, 2.0], -1.0), (0.0, 0.0), (np.nan, -1.0), (0.0, [[-1.0, np.inf]])])
def test_no_number_of_a_cell_stands_for_a_point_outside(x: Any, y: Any) -> None:
    """A cell of number -1 would be the last one of an array."""
    refused(r"1 of \d points lie outside the grid, the first at .* m: .*`contains`", SPEC.index, x, y)
    if np.isfinite(x).all() and np.isfinite(y).all():
        cells = np.stack(np.broadcast_arrays(*SPEC.index(x, y, unbounded=True)))
        assert ((cells < 0) | (cells >= np.array(SPEC.shape).reshape(2, *[1] * (cells.ndim - 1)))).any()
    else:
        refused("outside the grid", SPEC.index, x, y, unbounded=True)


@given(st.floats(0.05, 2), st.integers(1, 40), st.integers(1, 40), st.floats(-50, 50), st.floats(-50, 50))
@settings(max_examples=100, deadline=None)
def test_cell_centers_lie_in_their_cells(resolution: float, nx: int, ny: int, x: float, y: float) -> None:
    spec = GridSpec(resolution, (nx, ny), (x, y))
    cx, cy = spec.cell_centers
    ix, iy = spec.index(*np.broadcast_arrays(cx, cy))
    np.testing.assert_array_equal(ix, np.arange(nx)[:, None] * np.ones((1, ny), int))
    np.testing.assert_array_equal(iy, np.arange(ny)[None, :] * np.ones((nx, 1), int))
    assert spec.contains(cx, cy).all()
    for over_x, over_y in ((nx, 0), (0, ny), (-nx, 0), (0, -ny)):
        assert not spec.contains(cx + over_x * resolution, cy + over_y * resolution).any()


def test_spec_is_hashable_and_refines() -> None:
    assert len({SPEC, GridSpec(0.5, (6, 4), (-1.0, -2.0)), SPEC.refined(2)}) == 2
    assert SPEC.refined(2).extent == SPEC.extent


def test_the_three_masses_sum_to_one() -> None:
    grid = random_grid()
    np.testing.assert_allclose(grid.free + grid.occupied + grid.unknown, 1, atol=1e-6)
    np.testing.assert_allclose(grid.probability, grid.occupied + grid.unknown / 2, atol=1e-6)
    np.testing.assert_allclose(grid.evidence, 2 * grid.mass / grid.unknown[..., None], rtol=1e-4)


def test_what_is_derived_follows_a_change_in_place() -> None:
    grid, none = EvidentialGrid.vacuous(SPEC), np.full((*SPEC.shape, 2, 2), np.nan, np.float32)
    moving = DynamicGrid(SPEC, np.zeros((*SPEC.shape, 3), np.float32), none[..., 0], none)
    assert grid.unknown.all()
    assert moving.unknown.all()
    grid.mass[..., 1] = moving.mass[..., 2] = 1
    assert not grid.unknown.any()
    assert not moving.unknown.any()
    assert moving.occupied.all()


def test_at_returns_the_opinion_of_the_cell() -> None:
    grid = random_grid()
    opinion = grid.at(x=0.3, y=-0.6)
    assert opinion.free == pytest.approx(float(grid.mass[2, 2, 0]))
    assert opinion.occupied == pytest.approx(float(grid.mass[2, 2, 1]))
    refused("outside the grid", grid.at, x=2.0, y=0.0)


def test_at_takes_arrays_of_points() -> None:
    grid = random_grid()
    cx, cy = (c.ravel() for c in np.broadcast_arrays(*SPEC.cell_centers))
    np.testing.assert_array_equal(grid.at(cx, cy), grid.mass.reshape(-1, 2))
    np.testing.assert_array_equal(grid.at(cx.reshape(6, 4), cy.reshape(6, 4)), grid.mass)
    assert grid.at(np.array([0.3]), np.array([-0.6])).shape == (1, 2)
    assert grid.at(np.array([]), np.array([])).shape == (0, 2)
    points = np.array([0.0, 2.0, 9.0]), np.array([-0.1, -1.0, -0.1])
    refused(r"points lie outside the grid, the first at \(2\.0, -1\.0\) m", grid.at, *points)


def test_a_grid_is_printed_on_one_line() -> None:
    mass = np.zeros((6, 4, 2), np.float32)
    mass[:3, :, 0], mass[3, :, 1] = 0.5, 1.0
    text = repr(EvidentialGrid(SPEC, mass))
    assert text == (
        "EvidentialGrid(6 x 4 cells of 0.5 m, x -1 to 2 m, y -2 to 0 m: free 25.0%, occupied 16.7%, unknown 58.3%)"
    )


def test_grids_are_equal_if_cells_and_masses_are() -> None:
    grid = random_grid(1)
    assert grid == EvidentialGrid(SPEC, grid.mass.copy())
    assert grid != random_grid(2)
    assert grid != EvidentialGrid(GridSpec(0.5, (6, 4), (0.0, -2.0)), grid.mass)
    assert grid != "a grid"
    refused("unhashable", hash, grid, error=TypeError)


def test_numpy_takes_a_grid_for_its_masses() -> None:
    grid = random_grid()
    assert np.asarray(grid) is grid.mass
    np.testing.assert_array_equal(np.asarray(grid, np.float64), grid.mass.astype(np.float64))
    assert not np.shares_memory(np.array(grid), grid.mass)
    assert np.mean(grid) == grid.mass.mean()
    refused("copy", np.asarray, grid, np.float64, copy=False)


def test_layers_are_found_by_name_and_fit_the_cells() -> None:
    height = np.arange(24.0).reshape(6, 4)
    grid = LayeredGrid(SPEC, {"height": height, "speed": np.full((6, 4), np.nan)})
    assert grid["height"].dtype == np.float32
    np.testing.assert_array_equal(grid["height"], height)
    assert np.isnan(grid["speed"]).all()
    assert repr(grid) == "LayeredGrid(6 x 4 cells of 0.5 m, x -1 to 2 m, y -2 to 0 m: height, speed)"
    refused("no layer 'conflict', only height, speed", grid.__getitem__, "conflict", error=KeyError)
    message = r"layer 'height' has shape \(4, 6\), but the spec has \(6, 4\)"
    refused(message, LayeredGrid, SPEC, {"height": height.T})


def test_masses_are_checked_and_kept_as_float32() -> None:
    mass = random_grid().mass
    assert EvidentialGrid(SPEC, mass).mass is mass
    assert EvidentialGrid(SPEC, mass.astype(np.float64)).mass.dtype == np.float32
    assert EvidentialGrid.trusted(SPEC, mass) == EvidentialGrid(SPEC, mass)
    assert (EvidentialGrid.vacuous(SPEC).unknown == 1).all()
    for bad, message in (
        (np.zeros((6, 4, 3), np.float32), "states free and occupied"),
        (np.zeros((4, 6, 2), np.float32), r"\(4, 6\) cells, but the spec has \(6, 4\)"),
        (np.full((6, 4, 2), 0.6, np.float32), "24 cells"),
        (np.full((6, 4, 2), -0.1), "renormalize"),
        (np.full((6, 4, 2), np.nan), "nan"),
    ):
        refused(message, EvidentialGrid, SPEC, bad)
    refused("astype", EvidentialGrid, SPEC, np.zeros((6, 4, 2), np.int32), error=TypeError)
    one = np.zeros((6, 4, 2), np.float32)
    one[3, 1] = 0.9, 0.3
    refused(r"mass\[3, 1, :\], is \[0.8999.*, 0.300", EvidentialGrid, SPEC, one)


def test_save_and_load_lose_nothing(tmp_path: Path) -> None:
    grid = random_grid(spec=GridSpec(0.0625, (31, 17), (-1.03125, 2.2)))
    grid.save(tmp_path / "a.npz")
    assert EvidentialGrid.load(tmp_path / "a.npz") == grid
    with np.load(tmp_path / "a.npz", allow_pickle=False) as data:
        assert data["states"].tolist() == ["free", "occupied"]
        assert set(data.files) == {"format", "states", "axes", "resolution", "origin", "mass", "checksums"}
    layers = LayeredGrid(grid.spec, {"height": grid.free, "": np.full((31, 17), np.nan)})
    layers.save(tmp_path / "b.npz")
    assert LayeredGrid.load(tmp_path / "b.npz") == layers
