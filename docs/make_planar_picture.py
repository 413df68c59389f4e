"""Make the picture of `PlanarISM` in docs/geometric.md: ``python docs/make_planar_picture.py``."""

from pathlib import Path

import numpy as np

from ogm import GridSpec, Mount, Scan, plot
from ogm.geometric import PlanarISM, plane_text

PICTURE = Path(__file__).parent / "pictures" / "planar.png"
WALLS = np.array(  # x, y of both ends [m]: a room with a door, a table leg, and a pane of glass on the right
    [
        [-2.0, -2.0, 4.0, -2.0], [4.0, -2.0, 4.0, -0.6], [4.0, 0.4, 4.0, 3.0], [4.0, 3.0, -2.0, 3.0],
        [-2.0, 3.0, -2.0, -2.0], [6.0, -3.0, 6.0, 3.0], [2.0, 0.8, 2.03, 0.85], [1.0, 1.8, 1.6, 2.0],
    ]
)  # fmt: skip
PANE = (0.2, 1.4)  # [m] x of the glass in the wall at y = -2, whose beams have no echo


def cast(azimuth: np.ndarray) -> np.ndarray:
    """Return the range of the nearest wall along each beam from (0, 0) [m]."""
    x, y, p, q = WALLS[:, :, np.newaxis].transpose(1, 0, 2)
    c, s, u, v = np.cos(azimuth), np.sin(azimuth), p - x, q - y
    along, share = (x * v - y * u) / (c * v - s * u), (x * s - y * c) / (c * v - s * u)
    return np.where((along > 0) & (share >= 0) & (share <= 1), along, np.inf).min(axis=0)


azimuth = np.deg2rad(np.arange(-180, 180, 0.5) + 0.1)
reach = cast(azimuth) + np.random.default_rng(0).normal(0, 0.01, azimuth.size)
unit = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1)
end = unit * reach[:, np.newaxis]
silent = (abs(end[:, 1] + 2) < 0.1) & (end[:, 0] > PANE[0]) & (end[:, 0] < PANE[1])
scan = Scan(end[~silent].astype(np.float32), no_returns=unit[silent].astype(np.float32), max_range=8.0, kind="planar")
spec, mount = GridSpec.centered(9.0, 6.0, 0.05, center=(2.0, 0.5)), Mount(0.3, ego_footprint=(0, 0, 0, 0))
grid = PlanarISM(spec, mount)(scan)
points = plot.points_panel(
    scan.points, spec, f"{len(azimuth)} beams, {silent.sum()} without echo", -mount.sensor_height
)
plot.save_picture(PICTURE, points, grid, titles=["", f"PlanarISM, {plane_text(scan, mount)}"])
