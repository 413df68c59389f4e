"""Trees, bushes, hedges and grass: loose clouds of small leaf cards, between which some rays pass."""

from typing import NamedTuple

import numpy as np
import shapely
from numpy.random import Generator
from numpy.typing import ArrayLike
from shapely import Polygon
from shapely.geometry.base import BaseGeometry

from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import SUNK, Floats, HeightAt, Mesh, empty, loft, merge, quads, triangles

TUFTS = 4000  # largest number of tufts on a lawn


class Species(NamedTuple):
    """Shape of a kind of tree; pairs are lower and upper bounds."""

    share: float  # share of all trees
    height: tuple[float, float]  # [m]
    slimness: tuple[float, float]  # crown radius over crown height
    bare: tuple[float, float]  # share of the height below the crown
    taper: float  # 0: a ball, 1: a cone
    depth: tuple[float, float]  # mean number of leaf cards on a ray through the middle of the crown
    clumps: int  # branch ends with clusters of leaves


SPECIES = (
    Species(0.34, (7.0, 13.0), (0.42, 0.55), (0.24, 0.34), 0.15, (0.8, 1.4), 16),  # lime, maple
    Species(0.20, (5.0, 8.0), (0.36, 0.50), (0.30, 0.42), 0.10, (1.0, 1.7), 10),  # young street tree
    Species(0.14, (8.0, 14.0), (0.28, 0.36), (0.16, 0.26), 0.25, (0.8, 1.1), 18),  # birch: airy
    Species(0.10, (9.0, 15.0), (0.13, 0.18), (0.08, 0.14), 0.20, (1.1, 1.8), 14),  # poplar, columnar oak
    Species(0.12, (5.0, 13.0), (0.20, 0.30), (0.03, 0.10), 1.0, (1.2, 1.9), 22),  # spruce
    Species(0.10, (3.0, 5.0), (0.45, 0.60), (0.28, 0.40), 0.0, (1.0, 1.8), 8),  # fruit tree
)


def tree(rng: Generator, *, clearance: float = 0.0) -> Mesh:
    """Make a tree: trunk, branches and a loose crown.

    The number of leaf cards on a ray through the middle of the crown is about Poisson with the species' mean `depth`,
    so the crown stops the ray with a probability of about ``1 - exp(-depth)``, 0.5 to 0.9.

    Parameters
    ----------
    rng : Generator
        Generator of species, size and shape.
    clearance : float
        Smallest height of leaves above the ground [m]: 4.5 for crowns over a road.

    Returns
    -------
    Mesh
        At most 700 triangles; origin at the base, z up.
    """
    share = np.array([kind.share for kind in SPECIES])
    if clearance > 1:  # conifers have low branches
        share[[kind.taper == 1.0 for kind in SPECIES]] = 0.0
    kind = SPECIES[int(rng.choice(len(SPECIES), p=share / share.sum()))]
    height = rng.uniform(*kind.height)
    bottom = max(height * rng.uniform(*kind.bare), clearance)
    height = max(height, bottom + 2.5)
    crown = height - bottom
    radius = min(crown * rng.uniform(*kind.slimness), 4.5)
    middle = np.array([*rng.normal(0, 0.06 * radius, 2), bottom + crown / 2])

    # The trunk bends slightly; branches lead from it to the clusters of leaves.
    girth = np.clip(0.016 * height * rng.uniform(0.8, 1.4), 0.05, 0.28)
    top = middle + [0, 0, crown * (0.42 if kind.taper == 1.0 else 0.2)]
    knee = np.array([*(0.5 * middle[:2] + rng.normal(0, 0.05, 2)), bottom])
    line = np.array([[0, 0, -SUNK], [0, 0, 0.25], knee, top])
    trunk = loft(line[:, None] + girth * np.array([1.5, 1.05, 0.85, 0.2])[:, None, None] * _ring(7), M.BARK)
    tips = middle + _within_crown(rng, kind.clumps, kind.taper, shell=0.75) * [radius, radius, crown / 2]
    start = np.clip(rng.uniform(0.0, 0.6, len(tips)), 0, 1)[:, None]
    branches = _sticks(knee + start * (top - knee), tips, 0.3 * girth) if kind.taper < 1.0 else empty()

    # A ray along a mean chord crosses count * area / (2 pi radius r_z) cards of random direction.
    silhouette = np.pi * radius * crown / 2 * (1 - 0.45 * kind.taper)
    count = int(np.clip(125 * silhouette**0.5, 300, 700 - len(trunk.triangles) - len(branches.triangles)))
    area = 2 * silhouette * rng.uniform(*kind.depth) / count
    gathered = rng.integers(len(tips), size=count)
    spread = np.clip(rng.normal(0, 0.24, (count, 3)), -0.4, 0.4) * [radius, radius, crown / 2]
    free = _within_crown(rng, count, kind.taper, shell=0.6) * [radius, radius, crown / 2] + middle
    centers = np.where((rng.random(count) < 0.45)[:, None], tips[gathered] + spread, free)
    leaves = _cards(rng, centers, np.sqrt(area * rng.uniform(0.4, 1.6, count)), lowest=max(bottom, 0.05))
    return merge([trunk, branches, leaves])


def bush(rng: Generator) -> Mesh:
    """Make a bush, 0.5 to 2.2 m high, with leaves down to the ground.

    Returns
    -------
    Mesh
        At most 150 triangles; origin at the base, z up.
    """
    height = rng.uniform(0.5, 2.2)
    radius = height * rng.uniform(0.4, 0.75)
    count = int(np.clip(60 + 35 * height, 60, 126))
    area = 2 * np.pi * radius * height / 2 * rng.uniform(1.2, 2.2) / count
    centers = _within_crown(rng, count, 0.0, shell=0.6) * [radius, radius, height / 2] + [0, 0, height * 0.52]
    tips = rng.normal(0, 0.4 * radius, (4, 3)) * [1, 1, 0] + [0, 0, 0.7 * height]
    stems = _sticks(np.tile([0.0, 0.0, -0.1], (4, 1)), tips, 0.02)
    return merge([stems, _cards(rng, centers, np.sqrt(area * rng.uniform(0.5, 1.5, count)), lowest=0.0)])


def hedge(line: ArrayLike, rng: Generator, *, lowest: float = 0.8) -> Mesh:
    """Make a clipped hedge along a line: an uneven core with protruding leaves.

    Parameters
    ----------
    line : (M, 3) array
        Points on the ground along the middle of the hedge [m].
    rng : Generator
        Generator of height (`lowest` to 2.1 m), width (0.5 to 1.0 m) and unevenness.
    lowest : float
        Smallest height of a hedge [m].

    Returns
    -------
    Mesh
        About 30 triangles per metre, in the line's frame.
    """
    points, side = resampled(line, 0.7)
    n = len(points)
    height, half = rng.uniform(lowest, 2.1), rng.uniform(0.25, 0.5)
    bulge = half * rng.uniform(0.5, 0.95, (n, 4))
    crest = height * rng.uniform(0.82, 0.97, (n, 2))
    lift = np.column_stack([np.full(n, -SUNK), crest[:, 0], crest[:, 1], np.full(n, -SUNK)])
    offset = bulge * [1.0, 0.9, -0.9, -1.0]
    sections = points[:, None] + offset[..., None] * side[:, None] + lift[..., None] * [0.0, 0.0, 1.0]
    core = loft(sections, M.FOLIAGE, caps=M.FOLIAGE)
    # Leaves protrude from both sides and the top.
    count = int(17 * (n - 1) * np.clip(np.linalg.norm(points[1] - points[0]), 0.2, 0.7))
    k = rng.integers(n - 1, size=count)
    base = points[k] + rng.random((count, 1)) * (points[k + 1] - points[k])
    high = rng.random(count) < 0.2
    across = np.where(high, rng.uniform(-1, 1, count), rng.choice([-1.0, 1.0], count) * rng.uniform(0.8, 1.05, count))
    up = height * np.where(high, rng.uniform(0.92, 1.0, count), rng.uniform(0.05, 1.0, count))
    centers = base + half * across[:, None] * side[k] + up[:, None] * [0.0, 0.0, 1.0]
    return merge([core, _cards(rng, centers, rng.uniform(0.12, 0.34, count))])


def grass_tufts(polygon: Polygon, height_at: HeightAt, rng: Generator, *, density: float = 1.0) -> Mesh:
    """Make tufts of long grass of GRASS, which roughen the ground but are no obstacles.

    Parameters
    ----------
    polygon : Polygon
        Area of the tufts [m].
    height_at : callable
        Function of the ground height [m] at x, y [m].
    rng : Generator
        Generator of positions and sizes.
    density : float
        Tufts per square metre, at most 4000 in total.

    Returns
    -------
    Mesh
        Two triangles per tuft, 0.05 to 0.3 m high.
    """
    x, y = (column[:TUFTS] for column in points_in(polygon, density, TUFTS, rng))
    if not len(x):
        return empty()
    base = np.stack([x, y, np.asarray(height_at(x, y), np.float64)], axis=1)
    tall = rng.uniform(0.05, 0.3, len(x)) * rng.uniform(0.4, 1.0)
    angle = rng.uniform(0, 2 * np.pi, len(x))
    across = 0.5 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1) * (0.04 + 0.6 * tall)[:, None]
    lean = np.stack([*(0.3 * tall * rng.normal(0, 1, (2, len(x)))), tall], axis=1)
    base[:, 2] -= 0.03
    corners = np.stack([base - across, base + across, base + 0.6 * across + lean, base - 0.6 * across + lean], 1)
    return quads(corners, M.GRASS)


def points_in(shape: BaseGeometry, density: float, limit: int, rng: Generator) -> tuple[Floats, Floats]:
    """Draw uniform points x, y in a shape, `density` per square metre and about `limit` at most."""
    count = min(int(shape.area * density), limit)
    if count == 0:
        return np.zeros(0), np.zeros(0)
    x0, y0, x1, y1 = shape.bounds
    tries = int(count * (x1 - x0) * (y1 - y0) / shape.area)
    x, y = rng.uniform(x0, x1, tries), rng.uniform(y0, y1, tries)
    shapely.prepare(shape)
    inside = shapely.contains_xy(shape, x, y)
    return x[inside], y[inside]


def _within_crown(rng: Generator, count: int, taper: float, *, shell: float) -> Floats:
    """Draw points in the unit ball, or in a cone (taper 1); ``shell=1`` draws them on its surface."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    ball = direction * rng.random((count, 1)) ** (1 / 3 * (1 - 0.7 * shell))
    z = 1 - 2 * np.sqrt(rng.random(count))  # the cross-section of a cone increases towards its base
    ring = (1 - z) / 2 * np.sqrt(rng.random(count)) ** (1 - shell)
    around = rng.uniform(0, 2 * np.pi, count)
    if taper == 1.0:
        return np.stack([ring * np.cos(around), ring * np.sin(around), z], axis=1)
    ball[:, :2] *= (1 - taper * (ball[:, 2:] + 1) / 2) * (1 + 0.5 * taper)
    return ball


def _cards(rng: Generator, centers: Floats, size: Floats, lowest: float = -np.inf) -> Mesh:
    """Make a triangle of random direction and area size² at each centre, shifted to at least `lowest`."""
    count = len(centers)
    u, v = rng.normal(size=(2, count, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v -= np.sum(u * v, axis=1, keepdims=True) * u
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    side = (1.52 * size)[:, None]  # of an equilateral triangle with this area
    stretch = rng.uniform(0.75, 1.33, (count, 1))
    u, v = u * side * stretch, v * side / stretch
    corners = centers[:, None] + np.stack([-0.5 * u - 0.289 * v, 0.5 * u - 0.289 * v, 0.577 * v], axis=1)
    corners[..., 2] += np.maximum(lowest - corners[..., 2].min(axis=1), 0)[:, None]
    return triangles(corners, M.FOLIAGE)


def _ring(sides: int) -> Floats:
    """Return a level regular outline (sides, 3) of radius 1."""
    angles = 2 * np.pi * np.arange(sides) / sides
    return np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)


def _sticks(start: Floats, end: Floats, radius: float) -> Mesh:
    """Make thin three-sided branches between pairs of points."""
    ring = radius * _ring(3)
    wide, narrow = start[:, None] + ring, end[:, None] + 0.3 * ring
    return quads(np.stack([wide, np.roll(wide, -1, axis=1), np.roll(narrow, -1, axis=1), narrow], axis=2), M.BARK)


def resampled(line: ArrayLike, step: float) -> tuple[Floats, Floats]:
    """Return points about `step` apart along a line, and unit vectors to the left in the horizontal plane."""
    points = np.asarray(line, np.float64)
    run = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1))])
    keep = np.concatenate([[True], np.diff(run) > 1e-6])
    at = np.linspace(0, run[-1], max(int(np.ceil(run[-1] / step)), 1) + 1)
    new = np.stack([np.interp(at, run[keep], points[keep, k]) for k in range(3)], axis=1)
    ahead = np.gradient(new[:, :2], axis=0)
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    return new, np.stack([-ahead[:, 1], ahead[:, 0], 0 * at], axis=1)
