"""Targets: files of grids."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from targets import Target, check_grid

from ogm import DynamicGrid, EvidentialGrid, GridSpec, LayeredGrid
from ogm.io import PlacedGrid, read_any_grid, read_placed_grid, write_grid
from ogm.planning import costmap
from ogm.pose import pose

SPEC = GridSpec(0.16, (8, 6), (0.0, 0.0))


def evidential() -> EvidentialGrid:
    """Return masses of 48 cells."""
    mass = np.random.default_rng(1).dirichlet([1, 1, 1], SPEC.shape)[..., :2].astype(np.float32)
    return EvidentialGrid(SPEC, mass)


def dynamic() -> DynamicGrid:
    """Return masses and velocities of 48 cells."""
    rng = np.random.default_rng(1)
    mass = rng.dirichlet([1, 1, 1, 1], SPEC.shape)[..., :3].astype(np.float32)
    covariance = np.tile(np.eye(2, dtype=np.float32), (*SPEC.shape, 1, 1))
    return DynamicGrid(SPEC, mass, rng.normal(0, 1, (*SPEC.shape, 2)).astype(np.float32), covariance)


def layered() -> LayeredGrid:
    """Return two layers of 48 cells."""
    return LayeredGrid(SPEC, {"height": np.ones(SPEC.shape, np.float32), "conflict": np.zeros(SPEC.shape, np.float32)})


def _files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def _written(name: str, make: Callable[[], Any], options: dict[str, Any], folder: Path) -> Target:
    if name.endswith(".npy"):
        np.save(folder / name, make().mass)
    else:
        write_grid(folder / name, make(), **options)
    area = SPEC if name.endswith((".npy", ".png")) else None

    def read(files: Path) -> None:
        if make is turned:
            check_grid(read_placed_grid(files / name, area).grid)
        else:
            check_grid(read_any_grid(files / name, area))

    return Target(_files(folder), read)


def placed() -> PlacedGrid:
    """Return the masses with a place in a frame, and a layer."""
    grid = evidential()
    return PlacedGrid(grid, pose(z=0.5), "odom", 12.5, layers=LayeredGrid(grid.spec, {"height": grid.occupied}))


def costs() -> LayeredGrid:
    """Return costs of 48 cells."""
    return LayeredGrid(SPEC, {"cost": costmap(evidential(), SPEC.resolution, 4 * SPEC.resolution)})


def turned() -> PlacedGrid:
    """Return the masses, turned."""
    return PlacedGrid(evidential(), pose(1.0, 2.0, yaw=0.5), "odom", 12.5, "EPSG:25832")


_WRITTEN: dict[str, tuple[str, Callable[[], Any], dict[str, Any]]] = {
    "grid-npz": ("a.npz", evidential, {}),
    "grid-npz-placed": ("p.npz", placed, {}),
    "grid-npz-dynamic": ("a.npz", dynamic, {}),
    "grid-npz-layered": ("a.npz", layered, {}),
    "grid-npy": ("a.npy", evidential, {}),
    "grid-png": ("a.png", evidential, {}),
    **{f"grid-yaml-{mode}": ("a.yaml", evidential, {"mode": mode}) for mode in ("trinary", "scale", "raw")},
    "grid-tif": ("a.tif", evidential, {}),
    "grid-tif-dynamic": ("a.tif", dynamic, {}),
    "grid-tif-turned": ("a.tif", turned, {}),
    "grid-nc": ("a.nc", evidential, {}),
    "grid-nc-dynamic": ("a.nc", dynamic, {}),
    "grid-zarr": ("a.zarr", evidential, {}),
    "grid-zarr-dynamic": ("a.zarr", dynamic, {}),
    "grid-mcap": ("a.mcap", placed, {"message": "occupancy-grid"}),
    "grid-mcap-foxglove": ("a.mcap", placed, {"message": "foxglove-grid"}),
    "grid-mcap-map": ("a.mcap", placed, {"message": "grid-map"}),
    "grid-mcap-costmap": ("a.mcap", costs, {"message": "costmap"}),
    "grid-db3": ("a.db3", placed, {"message": "grid-map"}),
    "grid-bag": ("a.bag", placed, {"message": "grid-map"}),
}
TARGETS = {name: partial(_written, *given) for name, given in _WRITTEN.items()}
