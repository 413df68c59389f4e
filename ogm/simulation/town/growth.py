"""What covers fields: high grass, crops in rows, furrows."""

import numpy as np
import shapely
from numpy.random import Generator
from shapely import Polygon
from shapely.geometry.base import BaseGeometry

from ogm.simulation.arrays import Floats, HeightAt
from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Mesh, empty, quads

MOST = 30_000  # clumps of one field


def high_grass(shape: BaseGeometry, height_at: HeightAt, rng: Generator, *, density: float) -> Mesh:
    """Grow grass that is too high to be driven through unseen, 0.3 to 1.2 m, of the material FOLIAGE.

    Parameters
    ----------
    shape : shapely geometry
        Where it grows [m].
    height_at : callable
        Height of the ground [m] at x, y [m].
    rng : Generator
        Chooses places and sizes.
    density : float
        Clumps per square metre, each 0.2 to 0.6 m wide.
    """
    x, y = _points_in(shape, density, rng)
    usual = rng.uniform(0.4, 1.0)
    return _clumps(x, y, height_at, usual * rng.uniform(0.6, 1.2, len(x)), rng)


def crops(shape: Polygon, height_at: HeightAt, rng: Generator, *, tall: float) -> Mesh:
    """Grow a crop of one height [m] in rows 0.7 m apart."""
    ways, middle = _axes(shape, rng)
    half = 0.5 * float(np.hypot(*np.ptp(np.array(shape.bounds).reshape(2, 2), axis=0)))
    across, along = np.meshgrid(np.arange(-half, half, 0.7), np.arange(-half, half, 0.55), indexing="ij")
    along = along + rng.uniform(-0.15, 0.15, along.shape)
    x, y = (middle + np.stack([across.ravel(), along.ravel()], axis=1) @ ways).T
    kept = shapely.contains_xy(shape, x, y)
    if np.count_nonzero(kept) > MOST:
        kept &= rng.random(len(x)) < MOST / np.count_nonzero(kept)
    x, y = x[kept], y[kept]
    return _clumps(x, y, height_at, tall * rng.uniform(0.85, 1.1, len(x)), rng)


def furrows(shape: Polygon, height_at: HeightAt, rng: Generator) -> Mesh:
    """Plough a field: ridges 0.03 to 0.12 m high and 0.5 to 0.9 m apart, crumbled, of the material SOIL."""
    ways, middle = _axes(shape, rng)
    gap, high = 0.5 * rng.uniform(0.5, 0.9), rng.uniform(0.03, 0.12)
    half = 0.5 * float(np.hypot(*np.ptp(np.array(shape.bounds).reshape(2, 2), axis=0)))
    across, along = np.arange(-half, half, gap), np.arange(-half, half, 0.8)
    u, v = np.meshgrid(across, along, indexing="ij")
    x, y = (middle + np.stack([u.ravel(), v.ravel()], axis=1) @ ways).T
    inside = shapely.contains_xy(shape, x, y).reshape(u.shape)
    z = np.zeros(u.shape)
    z.flat[inside.ravel()] = height_at(x[inside.ravel()], y[inside.ravel()])
    ridge = (np.arange(len(across)) % 2 == 1)[:, None]
    z += 0.02 + high * (0.7 * ridge + 0.3) * rng.uniform(0.2, 1.0, u.shape)
    points = np.stack([x.reshape(u.shape), y.reshape(u.shape), z], axis=-1)
    corners = np.stack([points[:-1, :-1], points[1:, :-1], points[1:, 1:], points[:-1, 1:]], axis=2)
    whole = inside[:-1, :-1] & inside[1:, :-1] & inside[1:, 1:] & inside[:-1, 1:]
    return quads(corners[whole], M.SOIL) if whole.any() else empty()


def _axes(shape: Polygon, rng: Generator) -> tuple[Floats, Floats]:
    """Return unit vectors across and along the rows of a field, (2, 2), and its middle."""
    angle = rng.uniform(0, np.pi)
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, s], [-s, c]]), np.array(shape.centroid.coords[0])


def _points_in(shape: BaseGeometry, density: float, rng: Generator) -> tuple[Floats, Floats]:
    """Draw points evenly, so many per square metre, at most `MOST`."""
    count = min(int(shape.area * density), MOST)
    if count == 0:
        return np.zeros(0), np.zeros(0)
    x0, y0, x1, y1 = shape.bounds
    tries = int(count * (x1 - x0) * (y1 - y0) / shape.area)
    x, y = rng.uniform(x0, x1, tries), rng.uniform(y0, y1, tries)
    shapely.prepare(shape)
    inside = shapely.contains_xy(shape, x, y)
    return x[inside], y[inside]


def _clumps(x: Floats, y: Floats, height_at: HeightAt, tall: Floats, rng: Generator) -> Mesh:
    """Stand a leaning, tapering leaf of a random direction at each place."""
    if not len(x):
        return empty()
    base = np.stack([x, y, np.asarray(height_at(x, y), np.float64) - 0.03], axis=1)
    angle = rng.uniform(0, 2 * np.pi, len(x))
    across = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1) * rng.uniform(0.1, 0.3, (len(x), 1))
    lean = np.stack([*(0.15 * tall * rng.normal(0, 1, (2, len(x)))), tall], axis=1)
    corners = np.stack([base - across, base + across, base + 0.7 * across + lean, base - 0.7 * across + lean], 1)
    return quads(corners, M.FOLIAGE)
