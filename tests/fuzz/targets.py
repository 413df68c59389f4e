"""What is fuzzed: every reader of the library, each with a small file that it reads.

A target is a function that gets a folder for scratch files and returns a `Target`. The seeds are made by the library's
own writers, or from what formats are made of; nothing is recorded.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

__all__ = ["Target", "check_grid", "check_poses", "check_scan", "cloud", "every_target"]


class Target(NamedTuple):
    """A reader, the files that it is fed, and which of them are changed: all by default.

    `read` gets the folder with the files, and if `in_memory`, the bytes of the only file.
    """

    files: dict[str, bytes]
    read: Callable[[Any], object]
    changed: tuple[str, ...] = ()
    in_memory: bool = False


Maker = Callable[[Path], Target]


def every_target() -> dict[str, Maker]:
    """Return the targets by name."""
    import seed_carmen
    import seed_datasets
    import seed_grids
    import seed_logs
    import seed_messages
    import seed_networks
    import seed_points
    import seed_worlds

    modules = (
        *(seed_points, seed_grids, seed_datasets, seed_logs, seed_carmen, seed_messages, seed_networks),
        seed_worlds,
    )
    return {name: maker for module in modules for name, maker in module.TARGETS.items()}


def cloud(count: int = 24) -> np.ndarray:
    """Return points (N, 4) float32."""
    rng = np.random.default_rng(3)
    xyz = rng.integers(-4000, 4000, (count, 3)) / 64
    return np.column_stack([xyz, rng.integers(0, 256, count) / 255]).astype(np.float32)


# ---- what a result must be, whatever the file was


def check_scan(scan: Any) -> None:
    """Fail if a scan breaks what `Scan` states."""
    n = len(scan.points)
    assert scan.points.shape == (n, 4), "shape of the points"
    assert scan.points.dtype == np.float32, "type of the points"
    assert np.isfinite(scan.points).all(), "points not finite"
    assert ((scan.points[:, 3] >= 0) & (scan.points[:, 3] <= 1)).all(), "intensity outside of [0, 1]"
    beams = scan.no_returns
    assert beams is None or not scan.kind or (np.abs((beams**2).sum(axis=1) - 1) < 1e-4).all(), "beams without echo"
    assert scan.ring is None or scan.ring.shape == (n,), "rings"
    assert scan.time is None or (scan.time.shape == (n,) and np.isfinite(scan.time).all()), "times"
    assert scan.stamp is None or np.isfinite(scan.stamp), "stamp"


def check_grid(grid: Any) -> None:
    """Fail if the masses of a grid are none."""
    if not hasattr(grid, "mass"):
        assert all(layer.shape == grid.spec.shape for layer in grid.layers.values()), "layers"
        return
    mass = grid.mass
    assert mass.shape[:2] == grid.spec.shape, "shape of the masses"
    assert np.isfinite(mass).all(), "masses not finite"
    assert (mass >= -1e-6).all(), "masses below 0"
    assert (mass.sum(-1) <= 1 + 1e-5).all(), "masses above 1"


def check_poses(T: Any) -> None:
    """Fail if transforms (..., 4, 4) are not rigid."""
    T = np.asarray(T).reshape(-1, 4, 4)
    assert np.isfinite(T).all(), "pose not finite"
    R = T[:, :3, :3]
    assert (np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)) < 1e-2).all(), "no rotation"
