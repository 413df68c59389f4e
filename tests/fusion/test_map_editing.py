"""Laws of maps that go on: continued, merged, cut and on other cells."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import each, refused
from moving import street
from random_grids import layers, noise

from ogm.evidence import cautious, dempster, revise
from ogm.fusion import EvidentialMapper, crop, merge, resampled
from ogm.grid import CombinedGrid, EvidentialGrid, GridSpec, LayeredGrid, PartialGrid
from ogm.io import PlacedGrid, read_placed_grid, write_grid
from ogm.pose import pose

SPEC = GridSpec.centered(length=12.8, width=9.6, resolution=0.2)  # 64 x 48
WORLD = GridSpec(0.2, (100, 80), (-8.0, -8.0))
SCANS = 8


def cautiously(masses: Any) -> Any:
    return cautious(*masses)


def scan(k: int, kinds: str) -> EvidentialGrid:
    """Return a grid of one model (o), of two (t) or in a plane (p), by the letter of its number."""
    grid, kind = noise(SPEC, k), kinds[k % len(kinds)]
    if kind == "t":
        return CombinedGrid.of_parts(SPEC, [grid.mass, noise(SPEC, k + 100).mass], cautiously)
    return PartialGrid.of(SPEC, (2, 3), grid.mass[:20, :30], in_plane=True) if kind == "p" else grid


def drive(mapper: EvidentialMapper, numbers: range, kinds: str = "o") -> EvidentialMapper:
    for k in numbers:
        mapper.update(scan(k, kinds), pose(0.37 * k, -0.21 * k, yaw=0.1 * k), stamp=100 + 0.4 * k)
    return mapper


@each("kinds, rule, half_life, window, ending", [
    ("o", dempster, (0.7, 1.5), "fixed", ".npz"), ("t", revise, 2.0, "rolling", ".npz"),
    ("p", revise, 2.0, "rolling", ".nc"), ("po", cautious, math.inf, "rolling", ".tif"),
    ("tp", revise, math.inf, "fixed", ".npz"),
])  # fmt: skip
def test_continuing_gives_the_map_of_one_run(
    tmp_path: Path, kinds: str, rule: Any, half_life: Any, window: Any, ending: str
) -> None:
    """Bit for bit: masses, conflict, and what the map forgets meanwhile."""
    settings: dict[str, Any] = {"rule": rule, "half_life": half_life, "window": window}
    whole, unread = (EvidentialMapper(WORLD if window == "fixed" else SPEC, **settings) for _ in range(2))
    drive(whole, range(4), kinds)
    path = tmp_path / f"map{ending}"
    write_grid(path, PlacedGrid(whole.grid, stamp=whole.stamp, layers=whole.layers))
    continued = EvidentialMapper.from_grid(read_placed_grid(path), **settings)
    assert continued.spec.shape == whole.spec.shape
    assert continued.spec.origin == pytest.approx(whole.spec.origin, abs=1e-9)
    np.testing.assert_array_equal(continued.grid.mass, whole.grid.mass)
    for mapper in (whole, continued):
        drive(mapper, range(4, SCANS), kinds)
    np.testing.assert_array_equal(continued.grid.mass, whole.grid.mass)
    np.testing.assert_array_equal(layers(continued), layers(whole))
    np.testing.assert_allclose(continued.grid.mass, drive(unread, range(SCANS), kinds).grid.mass, atol=1e-5)


def test_a_map_without_unknown_can_change() -> None:
    certain = EvidentialGrid(SPEC, np.full((*SPEC.shape, 2), (1.0, 0.0), np.float32))
    mapper = EvidentialMapper.from_grid(certain, rule=dempster, half_life=math.inf)
    assert mapper.grid == certain
    for k in range(20):
        mapper.update(EvidentialGrid(SPEC, np.full_like(certain.mass, (0.0, 0.6))), np.eye(4), stamp=k / 10)
    assert mapper.grid.occupied.min() > 0.9


def test_a_map_of_a_single_model_goes_on_beside_several() -> None:
    """Until the first scan it is as it was; vacuous scans of two models leave it."""
    saved = noise(SPEC)
    mapper = EvidentialMapper.from_grid(saved, half_life=math.inf, window="fixed", min_unknown=0)
    nothing = np.zeros((*SPEC.shape, 2), np.float32)
    mapper.update(CombinedGrid.of_parts(SPEC, [nothing, nothing], cautiously), np.eye(4))
    np.testing.assert_allclose(mapper.grid.mass, saved.mass, atol=1e-6)


def test_a_map_of_another_place_or_kind_is_not_continued() -> None:
    far, from_grid = pose(500.0, 0.0), EvidentialMapper.from_grid
    refused("has no cell in the window", from_grid, noise(SPEC), SPEC, T_map_vehicle=far)
    refused("wanted masses", from_grid, LayeredGrid(SPEC, {"slope": np.zeros(SPEC.shape)}))
    refused("rotated by", from_grid, PlacedGrid(noise(SPEC), pose(yaw=1.0)))


def with_layers(grid: EvidentialGrid, seed: int = 0) -> PlacedGrid:
    numbers = np.random.default_rng(seed).random((3, *grid.spec.shape)).astype(np.float32)
    numbers[2][numbers[0] < 0.3] = np.nan
    named = dict(zip(("free_to_occupied", "occupied_to_free", "slope"), numbers, strict=True))
    return PlacedGrid(grid, stamp=float(seed), layers=LayeredGrid(grid.spec, named))


def test_a_map_merged_with_itself_is_itself() -> None:
    placed = with_layers(noise(SPEC))
    merged = merge(placed, placed)
    np.testing.assert_allclose(merged.grid.mass, placed.grid.mass, atol=1e-6)
    assert (merged.layers, merged.grid.spec) == (placed.layers, SPEC)
    layered = merge(placed.layers, placed.layers).grid
    assert layered == placed.layers


@each("T", [pose(3.0, -1.2), pose(2.0, 5.0, yaw=math.pi / 2), pose(-9.0, 0.4, yaw=math.pi)])
@each("rule", [cautious, dempster, revise])
def test_merging_by_a_transform_is_mapping_with_transformed_poses(T: np.ndarray, rule: Any) -> None:
    options: dict[str, Any] = {"half_life": math.inf, "window": "fixed", "min_unknown": 0}
    first, second, both = (EvidentialMapper(WORLD, rule, **options) for _ in range(3))
    steps = [(noise(SPEC, 1), pose(0.2)), (noise(SPEC, 2), pose(-1.0, 0.6))]
    for mapper, (grid, place) in zip((first, second), steps, strict=True):
        mapper.update(grid, place)
    both.update(steps[0][0], steps[0][1])
    both.update(steps[1][0], T @ steps[1][1])
    merged = merge(PlacedGrid(first.grid, layers=first.conflict), PlacedGrid(second.grid), T, rule=rule)
    np.testing.assert_allclose(resampled(merged, WORLD).grid.mass, both.grid.mass, atol=1e-5)
    assert merged.grid.spec.shape >= WORLD.shape


def test_merged_maps_keep_the_greater_conflict_and_the_values_of_the_first() -> None:
    shifted = replace(SPEC, origin=(SPEC.origin[0] + 2.0, SPEC.origin[1]))  # by ten cells
    a, b = with_layers(noise(SPEC), 1), with_layers(noise(shifted, 5), 2)
    merged = merge(a, b)
    assert merged.grid.spec == GridSpec(0.2, (74, 48), SPEC.origin)
    assert merged.stamp == 2.0
    conflict, slope = merged.layers["free_to_occupied"], merged.layers["slope"]
    inside = slice(10, 64), slice(None)
    both = np.maximum(a.layers["free_to_occupied"][10:], b.layers["free_to_occupied"][:54])
    np.testing.assert_array_equal(conflict[inside], both)
    np.testing.assert_array_equal(conflict[64:], b.layers["free_to_occupied"][54:])
    first, second = a.layers["slope"][10:], b.layers["slope"][:54]
    np.testing.assert_array_equal(slope[inside], np.where(np.isnan(first), second, first))
    refused("maps of one kind", merge, a, a.layers)
    refused("different coordinate reference systems", merge, replace(a, crs="EPSG:25832"), replace(b, crs="EPSG:25833"))
    refused("wanted a map of masses or layers, got a DynamicGrid", merge, street(), street(), error=TypeError)


def test_a_cut_keeps_all_of_its_cells(tmp_path: Path) -> None:
    placed, area = with_layers(noise(SPEC)), (-2.1, 1.0, 0.0, 99.0)
    part = crop(placed, area)
    assert part.grid.spec.extent == pytest.approx((-2.2, 1.0, 0.0, 4.8))
    np.testing.assert_array_equal(part.grid.mass, placed.grid.mass[21:37, 24:])
    np.testing.assert_array_equal(part.layers["slope"], placed.layers["slope"][21:37, 24:])
    assert crop(street(), street().spec.extent).grid == street()
    for empty in ((1.0, 1.0, 0.0, 1.0), (50.0, 60.0, 0.0, 1.0)):
        refused("touches no cell of the map", crop, placed, empty)


def test_other_cells_have_the_greatest_conflict_and_the_value_at_their_centre() -> None:
    placed = with_layers(noise(SPEC))
    coarse = resampled(placed, 0.6)
    assert coarse.grid.spec == GridSpec(0.6, (22, 16), SPEC.origin)
    conflict = np.pad(placed.layers["free_to_occupied"], ((0, 2), (0, 0))).reshape(22, 3, 16, 3)
    np.testing.assert_array_equal(coarse.layers["free_to_occupied"], conflict.max(axis=(1, 3)))
    np.testing.assert_array_equal(coarse.layers["slope"][:21], placed.layers["slope"][1::3, 1::3])
