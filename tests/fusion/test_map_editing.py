"""Laws of maps that go on: continued, merged, cut and on other cells."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from cases import each
from random_grids import layers, noise

from ogm.evidence import dempster, normalized_cautious, revise
from ogm.fusion import EvidentialMapper
from ogm.grid import CombinedGrid, EvidentialGrid, GridSpec, PartialGrid
from ogm.io import PlacedGrid, read_placed_grid, write_grid
from ogm.pose import pose

SPEC = GridSpec.centered(length=12.8, width=9.6, resolution=0.2)  # 64 x 48
WORLD = GridSpec(0.2, (100, 80), (-8.0, -8.0))
SCANS = 8


def cautious(masses: Any) -> Any:
    return normalized_cautious(*masses)


def scan(k: int, kinds: str) -> EvidentialGrid:
    """Return a grid of one model (o), of two (t) or in a plane (p), by the letter of its number."""
    grid, kind = noise(SPEC, k), kinds[k % len(kinds)]
    if kind == "t":
        return CombinedGrid.of_parts(SPEC, [grid.mass, noise(SPEC, k + 100).mass], cautious)
    return PartialGrid.of(SPEC, (2, 3), grid.mass[:20, :30], in_plane=True) if kind == "p" else grid


def drive(mapper: EvidentialMapper, numbers: range, kinds: str = "o") -> EvidentialMapper:
    for k in numbers:
        mapper.update(scan(k, kinds), pose(0.37 * k, -0.21 * k, yaw=0.1 * k), stamp=100 + 0.4 * k)
    return mapper


@each("kinds", ["o", "t", "p", "po", "tp"])
@each("rule, half_life, window, ending", [
    (revise, 2.0, "rolling", ".npz"), (dempster, (0.7, 1.5), "fixed", ".npz"),
    (normalized_cautious, math.inf, "rolling", ".nc"),
])  # fmt: skip
def test_continuing_gives_the_map_of_one_run(
    tmp_path: Path, kinds: str, rule: Any, half_life: Any, window: Any, ending: str
) -> None:
    """Bit for bit: masses, conflict, and what the map forgets meanwhile."""
    settings: dict[str, Any] = {"rule": rule, "half_life": half_life, "window": window}
    whole = drive(EvidentialMapper(WORLD if window == "fixed" else SPEC, **settings), range(4), kinds)
    path = tmp_path / f"map{ending}"
    write_grid(path, PlacedGrid(whole.grid, stamp=whole.stamp, layers=whole.layers))
    continued = EvidentialMapper.from_grid(read_placed_grid(path), **settings)
    assert continued.spec == whole.spec
    np.testing.assert_array_equal(continued.grid.mass, whole.grid.mass)
    for mapper in (whole, continued):
        drive(mapper, range(4, SCANS), kinds)
    np.testing.assert_array_equal(continued.grid.mass, whole.grid.mass)
    np.testing.assert_array_equal(layers(continued), layers(whole))
    unread = drive(EvidentialMapper(WORLD if window == "fixed" else SPEC, **settings), range(SCANS), kinds)
    np.testing.assert_allclose(continued.grid.mass, unread.grid.mass, atol=1e-5)
