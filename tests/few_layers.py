"""Rooms, halls, streets and crowds, and the scans of lidars of few layers in them, cast by NumPy."""

from typing import NamedTuple

import numpy as np

Wall = tuple[float, float, float, float, float]  # x, y of both ends, height [m]
MOUNTS = (0.2, 0.3, 0.5, 1.0, 2.0)  # [m] heights of sensors


class Scene(NamedTuple):
    """Walls and cylinders on level ground, beyond which a slope may rise."""

    walls: list[Wall]
    cylinders: list[tuple[float, float, float, float]] = []  # x, y, radius, height [m]
    slope: float = 0.0  # rise over run of ground ahead
    slope_start: float = 3.0  # [m] where it begins


def box(x: float, y: float, length: float, width: float, height: float) -> list[Wall]:
    """Return the walls of a box, or of a room, around (x, y)."""
    x0, x1, y0, y1 = x - length / 2, x + length / 2, y - width / 2, y + width / 2
    ends = (x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)
    return [(*a, *b, height) for a, b in zip(ends, ends[1:], strict=False)]


def _crowd() -> list[tuple[float, float, float, float]]:
    run, angle = 2 + 0.35 * (7 * np.arange(220) % 19), 2.39996 * np.arange(220)
    return [(r * np.cos(a), r * np.sin(a), 0.25, 1.75) for r, a in zip(run, angle, strict=True)]


STREET: list[Wall] = [(-150, -6.5, 150, -6.5, 8), (-150, 8.5, 150, 8.5, 8)]
SCENES = {
    "room of 8 x 6 m": Scene(box(0.7, 0.4, 8, 6, 3)),
    "room of 16 x 12 m": Scene(box(1.3, -2.1, 16, 12, 3)),
    "room of 32 x 24 m": Scene(box(3.1, 1.7, 32, 24, 4)),
    "hall": Scene(
        box(2.2, 3.3, 60, 40, 6)
        + [w for x in range(-22, 27, 8) for y in range(-14, 17, 6) for w in box(x + 0.3, y + 0.1, 0.6, 0.6, 3)]
    ),
    "street": Scene(STREET),
    "street with cars": Scene(
        STREET
        + [w for x, y in ((-22, -4.5), (-9, -4.5), (6, -4.5), (13, 6.5), (18, 6.5)) for w in box(x, y, 4.2, 1.8, 1.5)]
    ),
    "tunnel": Scene([(-150, -2.2, 150, -2.2, 3), (-150, 1.8, 150, 1.8, 3)]),
    "crowd": Scene([], _crowd()),
}
LAYERS = {  # elevations [deg]
    "1, level": [0.0],
    "1, half a degree down": [-0.5],
    "1, one degree down": [-1.0],
    "2": [-1.0, 1.0],
    "2, down": [-1.5, -0.5],
    "4": [-1.2, -0.4, 0.4, 1.2],
    "4, down": [-2.4, -1.6, -0.8, 0.0],
    "8": list(np.arange(-7, 8, 2.0)),
    "8, narrow": list(np.arange(-1.4, 1.5, 0.4)),
    "16": list(np.arange(-15, 16, 2.0)),
}


def cast(
    scene: Scene, elevations: list[float], height: float, azimuths: int = 720, noise: float = 0.02
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of a scan within 60 m, (N, 4), in the frame of the sensor, and which lie on ground.

    Parameters
    ----------
    scene : Scene
    elevations : list of float
        Of the layers [deg].
    height : float
        Height of the sensor [m].
    azimuths : int
    noise : float
        Standard deviation of ranges [m].
    """
    a, e = (axis.ravel() for axis in np.meshgrid(np.arange(azimuths) * 2 * np.pi / azimuths + 0.003, elevations))
    c, s, rise = np.cos(a), np.sin(a), np.tan(np.radians(e))
    with np.errstate(divide="ignore", invalid="ignore"):
        run = np.where(rise < -1e-9, -height / rise, np.inf)
        beyond = c * run > scene.slope_start
        on_slope = -(height + scene.slope * scene.slope_start) / (rise - scene.slope * c)
        run = np.where((scene.slope != 0) & (c > 0) & beyond & (on_slope > 0), on_slope, run)
        is_ground = np.isfinite(run)

        def stop(r: np.ndarray, where: np.ndarray, top: float) -> None:
            z = height + r * rise
            nearer = where & (r > 0) & (z >= 0) & (z <= top) & (r < run)
            run[nearer], is_ground[nearer] = r[nearer], False

        for x0, y0, x1, y1, top in scene.walls:
            across = c * (y1 - y0) - s * (x1 - x0)
            along = (x0 * s - y0 * c) / across
            stop((x0 * (y1 - y0) - y0 * (x1 - x0)) / across, (along >= 0) & (along <= 1), top)
        for x, y, radius, top in scene.cylinders:
            middle = c * x + s * y
            square = radius**2 - (x * x + y * y - middle**2)
            stop(middle - np.sqrt(square), square > 0, top)
    seen = run < 60
    run = run[seen] + np.random.default_rng(0).normal(0, noise, seen.sum())
    points = np.stack([run * c[seen], run * s[seen], run * rise[seen], np.full(len(run), 0.3)], axis=1)
    return points.astype(np.float32), is_ground[seen]
