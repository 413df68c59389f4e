"""Shapes that street furniture is put together from, with the origin at the base and z up."""

import numpy as np
from numpy.typing import ArrayLike

from ogm.simulation.arrays import Floats
from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Mesh, box, cylinder, loft, quads

SUNK = 0.3  # [m] feet reach this far into the ground, so that they stand on a slope as well


def upright(x: float, y: float, z: float, yaw: float = 0.0) -> Floats:
    """Return the transform (4, 4) of a piece that stands upright at a place."""
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = x, y, z
    return T


def pole(
    height: float,
    radius: float,
    material: M = M.METAL_POLE,
    *,
    x: float = 0.0,
    y: float = 0.0,
    end_radius: float | None = None,
    sides: int = 6,
) -> Mesh:
    """Make an upright pole that reaches into the ground."""
    return cylinder([x, y, -SUNK], [x, y, height], radius, material, end_radius=end_radius, sides=sides)


def rod(
    low: float, high: float, radius: float, material: M, end: float | None = None, sides: int = 8, *, caps: bool = True
) -> Mesh:
    """Make an upright cylinder or cone between two heights, with another radius at its upper `end` if given."""
    return cylinder([0, 0, low], [0, 0, high], radius, material, end_radius=end, sides=sides, caps=caps)


def block(center: ArrayLike, size: ArrayLike, material: M) -> Mesh:
    """Make a box around its middle."""
    center, half = np.asarray(center, np.float64), np.asarray(size, np.float64) / 2
    return box(center - half, center + half, material)


def extruded(profile: ArrayLike, ends: tuple[float, float], material: M, axis: int = 0) -> Mesh:
    """Make a prism: a profile (P, 2) of y, z between two x, or with `axis` 1 of x, z between two y."""
    p = np.asarray(profile, np.float64)
    sections = [np.insert(p, axis, end, axis=1) for end in ends]
    return loft(sections, material, caps=material)


def regular(radius: float, sides: int, turn: float = 0.0) -> Floats:
    """Return a regular outline (sides, 2) in y, z around the middle."""
    angles = turn + 2 * np.pi * np.arange(sides) / sides
    return radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)


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


def tube(line: Floats, radius: float, material: M) -> Mesh:
    """Make a three-sided tube along a line that lies in an upright plane across x."""
    ahead = np.gradient(line, axis=0)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    out = np.cross([1.0, 0.0, 0.0], ahead)
    across = np.array([[1.0, 0.0, 0.0]])
    ring = [out, 0.87 * across - 0.5 * out, -0.87 * across - 0.5 * out]
    return loft(np.stack([line + radius * r for r in ring], axis=1), material)


def signal_head(at: Floats) -> list[Mesh]:
    """Make the three lamps of a signal with their backing board; `at` is the lower edge's middle."""
    square = np.array([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1.0]])
    body = block(at + [0, 0, 0.45], [0.2, 0.28, 0.9], M.PLASTIC_DARK)
    board = quads(at + [-0.06, 0, 0.45] + square * [1, 0.28, 0.6], M.PLASTIC_DARK)
    return [body, board, *(quads(at + [0.105, 0, z] + 0.1 * square, M.LAMP) for z in (0.16, 0.45, 0.74))]
