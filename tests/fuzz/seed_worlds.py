"""Targets: maps in tiles, as folders and as archives: descriptions, tiles, sub-maps of drives, numbers of tiles."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from targets import Target, check_grid, check_poses

from ogm import EvidentialGrid, GridSpec
from ogm.pose import pose
from ogm.scan import Boxes, Frame, LazyFrame, Mount, Scan
from ogm.world import WorldMap, build_world
from ogm.world.drives import drive_names, load_drive
from ogm.world.rendered import Rendered
from ogm.world.tasks import parts_of_tiles, render_tile

SPEC = GridSpec(0.5, (10, 8), (-2.5, -2.0))


def masses(scan: Any = None) -> EvidentialGrid:
    """Return masses of 80 cells."""
    mass = np.random.default_rng(4).dirichlet([1, 1, 1], SPEC.shape)[..., :2].astype(np.float32)
    return EvidentialGrid(SPEC, mass)


class _Model:
    spec = SPEC

    def __call__(self, scan: Scan) -> EvidentialGrid:
        return masses()


def _frames() -> list[Frame]:
    parts: Any = (lambda: Scan(np.ones((1, 4), np.float32)), lambda: Mount(1.8), Boxes.empty, lambda: None)
    return [LazyFrame(*parts, T_map_sensor=pose(3.0 * k), stamp=10.0 + k, name=str(k)) for k in range(4)]


def _read(path: Path) -> None:
    """Read all of a map: windows of every level, layers, drives, and what tiles are made of."""
    with WorldMap.open(path) as world:
        tiles = world.tiles()
        for index in tiles[:4]:
            tile = world.layout.spec(world.layout.box_of(index))
            check_grid(world.window(tile))
            layers = world.layers(tile)
            assert (layers["free_to_occupied"] <= 1).all(), "conflict"
            assert (layers["count"] <= 65535).all(), "count"
        check_grid(world.window(SPEC, pose(1.0, yaw=0.3)))
        for level in range(1, min(world.levels, 4)):
            for index in world.store.tiles(level)[:2]:
                check_grid(world.window(world.layout.spec(world.layout.box_of(index), level), level=level))
        drives = [load_drive(world.store, name) for name in drive_names(world.store)]
        for drive in drives:
            check_poses([one.pose for one in drive.submaps] or [np.eye(4)])
        parts = parts_of_tiles(world.store, drives)
        numbers = Rendered(world.store) if drives else None
        for index in list(parts)[:3]:
            render_tile(world.store, index, parts[index][:3])
            assert numbers is None or numbers.mark(index) >= 0, "numbers"


def _map(form: str, options: dict[str, Any], folder: Path) -> Target:
    url = folder / "map"
    with WorldMap.create(url, 0.5, 16, min_unknown=0.02, **options) as world:
        if "drives" in form:
            build_world(world, {"a": _frames(), "b": _frames()[:2]}, _Model(), length=4.0)
        else:
            world.integrate(masses(), pose(1.0, yaw=0.2), stamp=12.0)
            world.integrate(masses(), pose(9.0, 9.0), stamp=13.0)
        world.build_overviews()
        if form == "zip":
            world.copy_to(folder / "map.zip")
    if form == "zip":
        return Target({"map.zip": (folder / "map.zip").read_bytes()}, lambda files: _read(files / "map.zip"))
    files = {str(path.relative_to(url)): path.read_bytes() for path in sorted(url.rglob("*")) if path.is_file()}
    return Target(files, _read)


TARGETS: dict[str, Callable[[Path], Target]] = {
    "world": partial(_map, "plain", {}),
    "world-float32": partial(_map, "plain", {"dtype": "float32"}),
    "world-drives": partial(_map, "drives", {}),
    "world-zip": partial(_map, "zip", {}),
}
