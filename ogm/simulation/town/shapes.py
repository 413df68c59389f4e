"""Shapes that street furniture is put together from, with the origin at the base and z up."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from ogm.simulation.arrays import Floats
from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Mesh, box, cylinder, loft

SUNK = 0.3  # [m] feet reach this far into the ground, so that they stand on a slope as well


def upright(x: float, y: float, z: float, yaw: float = 0.0) -> Floats:
    """Return the transform (4, 4) of a piece that stands upright at a place."""
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = x, y, z
    return T


def pole(
    top: float,
    radius: float,
    material: M = M.METAL_POLE,
    at: Sequence[float] = (0, 0),
    end: float | None = None,
    sides: int = 6,
) -> Mesh:
    """Make an upright pole at x, y that reaches into the ground, with another radius at its upper `end` if given."""
    return cylinder([*at, -SUNK], [*at, top], radius, material, end_radius=end, sides=sides)


def rod(
    low: float, high: float, radius: float, material: M, end: float | None = None, sides: int = 8, *, caps: bool = True
) -> Mesh:
    """Make an upright cylinder or cone between two heights, with another radius at its upper `end` if given."""
    return cylinder([0, 0, low], [0, 0, high], radius, material, end_radius=end, sides=sides, caps=caps)


def triangles(corners: ArrayLike, material: int) -> Mesh:
    """Make triangles (N, 3, 3) that share no corners."""
    vertices = np.asarray(corners, np.float32).reshape(-1, 3)
    faces = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
    return Mesh(vertices, faces, np.full(len(faces), material, np.uint8))


def block(center: ArrayLike, size: ArrayLike, material: M) -> Mesh:
    """Make a box around its middle."""
    center, half = np.asarray(center, np.float64), np.asarray(size, np.float64) / 2
    return box(center - half, center + half, material)


def extruded(profile: ArrayLike, ends: tuple[float, float], material: M, axis: int = 0) -> Mesh:
    """Make a prism: a profile (P, 2) of y, z between two x, or with `axis` 1 of x, z between two y."""
    p = np.asarray(profile, np.float64)
    sections = [np.insert(p, axis, end, axis=1) for end in ends]
    return loft(sections, material, caps=material)


def panel(width: float, tall: float) -> Floats:
    """Return a rectangle's outline (4, 2) in y, z around the middle."""
    return 0.5 * np.array([[-width, -tall], [width, -tall], [width, tall], [-width, tall]])


def plate(outline: Floats, z: float, radius: float) -> list[Mesh]:
    """Make a plate before a pole of that radius: retroreflective front towards +x, bare metal 2 cm behind it."""
    fan = np.array([(0, k, k + 1) for k in range(1, len(outline) - 1)], np.uint32)
    parts = []
    for x, material in ((radius + 0.03, M.SIGN), (radius + 0.01, M.METAL_SHEET)):
        vertices = np.column_stack([np.full(len(outline), x), outline[:, 0], outline[:, 1] + z])
        parts.append(Mesh(vertices.astype(np.float32), fan, np.full(len(fan), material, np.uint8)))
    return parts


def strip(start: ArrayLike, end: ArrayLike, half: ArrayLike) -> Floats:
    """Return the corners (4, 3) of a flat bar between two points, `half` its half width as a vector."""
    a, b, h = (np.asarray(v, np.float64) for v in (start, end, half))
    return np.stack([a - h, a + h, b + h, b - h])
