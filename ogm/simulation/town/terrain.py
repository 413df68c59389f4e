"""Heights: hills, bumps, dips and banks, crowned roads, kerbs, as functions of the place."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt, gaussian_filter
from scipy.spatial import cKDTree
from shapely.geometry.base import BaseGeometry

from ogm.simulation.arrays import Floats

CROWN = 0.025  # slope across a road, from its middle to the kerbs
CROWN_REACH = 4.0  # [m] farther from the kerb the road is level
FIELD = 0.5  # [m] step of the rasters that heights are made of
DROPPED = 0.02  # [m] height of a kerb that is let down
STEEPEST = 0.068  # steepest grade of the hills; crown and bumps come on top


@dataclass(frozen=True, eq=False)
class Raster:
    """A square array of values on points `corner` + `step` * (i, j)."""

    values: NDArray[np.float32]
    step: float
    corner: tuple[float, float]

    def __call__(self, x: ArrayLike, y: ArrayLike) -> Floats:
        """Bilinear between the points, as at the edge beyond it."""
        u = np.clip((np.asarray(x, np.float64) - self.corner[0]) / self.step, 0, len(self.values) - 1)
        v = np.clip((np.asarray(y, np.float64) - self.corner[1]) / self.step, 0, self.values.shape[1] - 1)
        i = np.minimum(u.astype(np.int64), len(self.values) - 2)
        j = np.minimum(v.astype(np.int64), self.values.shape[1] - 2)
        u, v = u - i, v - j
        near = self.values[i, j] * (1 - v) + self.values[i, j + 1] * v
        far = self.values[i + 1, j] * (1 - v) + self.values[i + 1, j + 1] * v
        return np.asarray(near * (1 - u) + far * u)


class Drop(NamedTuple):
    """A stretch of kerb let down for wheels: its middle, direction along the kerb, half its length [m]."""

    x: float
    y: float
    along: tuple[float, float]
    half: float

    def share(self, x: Floats, y: Floats) -> Floats:
        """How far the kerb is let down at x, y: 0 not at all, 1 wholly; the sidewalk behind follows as a ramp."""
        dx, dy = x - self.x, y - self.y
        along = abs(dx * self.along[0] + dy * self.along[1])
        across = abs(dx * self.along[1] - dy * self.along[0])
        return np.clip((self.half + 0.7 - along) / 0.7, 0, 1) * np.clip((2.2 - across) / 1.2, 0, 1)


class Terrain(NamedTuple):
    """All that heights are computed from."""

    waves: Floats  # (W, 4) wave numbers along x and y [rad/m], phase, amplitude [m]
    bowls: Floats  # (B, 4) x, y, radius, height of dips (< 0) and humps [m]
    crown: Raster
    bank: Raster
    kerb: Raster

    def base(self, x: Floats, y: Floats) -> Floats:
        """Height of the hills alone [m]."""
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        z = np.zeros(np.broadcast(x, y).shape)
        for kx, ky, phase, amplitude in self.waves:
            z += amplitude * np.sin(kx * x + ky * y + phase)
        for cx, cy, radius, height in self.bowls:
            z += height * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * radius**2))
        return z

    def road(self, x: Floats, y: Floats) -> Floats:
        """Height of the road surface [m]."""
        return self.base(x, y) + self.crown(x, y)

    def land(self, x: Floats, y: Floats, drops: Sequence[Drop] = ()) -> Floats:
        """Height of the land beside the road, kerb included [m]."""
        x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
        kerb = self.kerb(x, y)
        if drops:
            tree = cKDTree(np.stack([x, y], axis=1))
            low = np.zeros(len(x))
            for drop in drops:
                near = np.array(tree.query_ball_point((drop.x, drop.y), drop.half + 3.0), np.int64)
                if len(near) == 0:
                    continue
                low[near] = np.maximum(low[near], drop.share(x[near], y[near]))
            kerb = kerb * (1 - low) + DROPPED * low
        return self.road(x, y) + kerb + self.bank(x, y)


def mask(shape: BaseGeometry, size: float, step: float) -> NDArray[np.bool_]:
    """Which points of a raster from -size/2 to size/2 lie in a shape: (n, n) over x, y."""
    ticks = np.arange(int(round(size / step)) + 1) * step - size / 2
    result = np.zeros((len(ticks), len(ticks)), bool)
    if shape.is_empty:
        return result
    x0, y0, x1, y1 = shape.bounds
    i, j = slice(*np.searchsorted(ticks, (x0, x1 + step))), slice(*np.searchsorted(ticks, (y0, y1 + step)))
    shapely.prepare(shape)
    x, y = np.meshgrid(ticks[i], ticks[j], indexing="ij")
    result[i, j] = shapely.contains_xy(shape, x, y)
    return result


def make_terrain(
    size: float,
    road: BaseGeometry,
    corridor: BaseGeometry,
    kerbs: Sequence[tuple[BaseGeometry, float]],
    banks: Sequence[tuple[Floats, float]],
    dip: tuple[float, float],
    rng: Generator,
) -> Terrain:
    """Draw hills, and fit banks, crowns and kerbs to the streets.

    Parameters
    ----------
    size : float
        Edge of the town [m].
    road, corridor : shapely geometry
        The carriageways, and the streets with their sidewalks.
    kerbs : list of (geometry, height [m])
        How high the kerb is near each street.
    banks : list of (point (2,), height [m])
        How uneven the land is around some points.
    dip : (x, y)
        A place on a road where it dips.
    rng : np.random.Generator
        Draws the hills.
    """
    # Hills: a few long waves, and bumps that a car feels; together no steeper than STEEPEST.
    length = np.concatenate([rng.uniform(170, 420, 5), rng.uniform(70, 130, 3)])
    angle = rng.uniform(0, 2 * np.pi, 8)
    amplitude = length / 100 * np.where(np.arange(8) < 5, 1.0, 0.35) * rng.uniform(0.5, 1.2, 8)
    k = 2 * np.pi / length
    waves = np.stack([k * np.cos(angle), k * np.sin(angle), rng.uniform(0, 2 * np.pi, 8), amplitude], axis=1)
    around = rng.uniform(-0.3, 0.3, (2, 2)) * size
    bowls = np.array([[*dip, 16.0, -0.9], [*around[0], 30.0, 1.5], [*around[1], 25.0, -1.2]])
    flat = Raster(np.zeros((2, 2), np.float32), size, (-size / 2, -size / 2))
    terrain = Terrain(waves, bowls, flat, flat, flat)
    ticks = np.arange(-size / 2, size / 2 + 2, 2.0)
    x, y = np.meshgrid(ticks, ticks, indexing="ij")
    slope = np.hypot(*np.gradient(terrain.base(x, y), 2.0))
    waves[:, 3] *= STEEPEST / slope.max()
    bowls[:, 3] *= STEEPEST / slope.max()
    fine = np.concatenate([rng.uniform(18, 40, 4), rng.uniform(6, 12, 4)])
    angle = rng.uniform(0, 2 * np.pi, 8)
    height = np.where(np.arange(8) < 4, 0.012, 0.003)
    k = 2 * np.pi / fine
    bumps = np.stack([k * np.cos(angle), k * np.sin(angle), rng.uniform(0, 2 * np.pi, 8), height], axis=1)
    # Crown: rises from the kerbs to the middle of the road.
    on_road = mask(road, size, FIELD)
    inside = distance_transform_edt(on_road) * FIELD
    crown = CROWN * np.minimum(gaussian_filter(np.minimum(inside, CROWN_REACH + 1), 1.0), CROWN_REACH)
    crown = np.where(on_road, crown, 0.0)
    # Banks: the land leaves the street's level a few metres behind the sidewalk.
    beyond = distance_transform_edt(~mask(corridor, size, FIELD)) * FIELD
    ramp = np.clip(beyond - 0.5, 0, 9) / 9
    ramp = ramp**2 * (3 - 2 * ramp)
    shape = on_road.shape
    rough = gaussian_filter(rng.standard_normal((shape[0] // 8 + 2, shape[1] // 8 + 2)), 3.0)
    rough = rough / rough.std()
    weight = np.zeros(rough.shape)
    gx, gy = np.meshgrid(*(np.arange(s) * 8 * FIELD - size / 2 for s in rough.shape), indexing="ij")
    far = np.stack([np.hypot(gx - point[0], gy - point[1]) for point, _ in banks])
    weight = gaussian_filter(np.array([height for _, height in banks])[far.argmin(axis=0)], 2.0)
    field = Raster((rough * weight).astype(np.float32), 8 * FIELD, (-size / 2, -size / 2))
    px, py = np.meshgrid(*(np.arange(s) * FIELD - size / 2 for s in shape), indexing="ij")
    bank = ramp * np.clip(field(px, py), -2.5, 2.5)
    # Kerbs: as high as in the profile of the nearest street.
    kerb = np.full(shape, 0.11)
    for area, upright in kerbs:
        kerb[mask(area, size, FIELD)] = upright
    kerb = gaussian_filter(kerb, 4.0)
    corner = (-size / 2, -size / 2)
    return Terrain(
        np.concatenate([waves, bumps]),
        bowls,
        Raster(crown.astype(np.float32), FIELD, corner),
        Raster(bank.astype(np.float32), FIELD, corner),
        Raster(kerb.astype(np.float32), FIELD, corner),
    )
