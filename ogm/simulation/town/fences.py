"""Fences that rays pass through, garden walls, gates and guard rails, all of thin real geometry along a line."""

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from ogm.simulation.arrays import Floats
from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Mesh, loft, merge, quads, sheet
from ogm.simulation.town.plants import resampled
from ogm.simulation.town.shapes import SUNK


def fence(line: ArrayLike, rng: Generator) -> Mesh:
    """Build a fence that rays pass through: pickets, iron bars, welded mesh, rails; or a closed one of boards.

    Parameters
    ----------
    line : (M, 3) array
        Points on the ground along the fence [m]; it follows their height.
    rng : Generator
        Chooses kind, height (0.8 to 2.2 m) and gaps.

    Returns
    -------
    Mesh
        At most 25 triangles per metre (and a few for the posts), in the line's frame.
    """
    kind = rng.random()
    if kind < 0.3:
        return _pickets(line, rng.uniform(0.8, 1.3), rng.uniform(0.13, 0.17), rng.uniform(0.07, 0.1))
    if kind < 0.55:
        return bars(line, rng.uniform(1.0, 2.0), rng.uniform(0.12, 0.15), rng.uniform(0.016, 0.025), M.METAL_POLE)
    if kind < 0.8:
        return _mesh_fence(line, rng.uniform(1.0, 2.2), rng)
    if kind < 0.9:
        return _rails(line, rng.uniform(0.9, 1.3))
    return _boards(line, rng.uniform(1.6, 2.0), M.WOOD)


def screen(line: ArrayLike, rng: Generator, material: M = M.WOOD) -> Mesh:
    """Build a closed fence of boards or metal sheets along a line (M, 3), 1.6 to 2.0 m high."""
    return _boards(line, rng.uniform(1.6, 2.0), material)


def low_wall(line: ArrayLike, rng: Generator, *, lowest: float = 0.4) -> Mesh:
    """Build a garden wall along a line (M, 3): `lowest` to 1.9 m high, 0.2 to 0.4 m thick, some with a coping."""
    points, side = resampled(line, 3.0)
    material = rng.choice([M.BRICK, M.STONE, M.CONCRETE, M.PLASTER_LIGHT])
    low = lowest < 1.0 and rng.random() < 0.6
    height = rng.uniform(lowest, 1.0) if low else rng.uniform(max(lowest, 1.4), 1.9)
    half = rng.uniform(0.1, 0.2)
    edge, down, up = half * side, np.array([0, 0, 2 * SUNK]), np.array([0, 0, height])
    shape = [points - edge - down, points + edge - down, points + edge + up, points - edge + up]
    parts = [loft(np.stack(shape, axis=1), material, caps=material)]
    if rng.random() < 0.5:
        wide, lid = (half + 0.05) * side, up + [0, 0, 0.08]
        cap = [points - wide + up, points + wide + up, points + wide + lid, points - wide + lid]
        parts.append(loft(np.stack(cap, axis=1), M.STONE, caps=M.STONE))
    return merge(parts)


def guard_rail(line: ArrayLike) -> Mesh:
    """Make a guard rail: a W-shaped beam 0.45 to 0.75 m above the line's points (M, 3), on posts.

    Returns
    -------
    Mesh
        About 8 triangles per metre; no thicker than 0.2 m.
    """
    points, side = resampled(line, 2.0)
    profile = [(0.0, 0.44), (0.08, 0.52), (0.0, 0.6), (0.08, 0.68), (0.0, 0.76)]
    rails = [points + y * side + [0, 0, z] for y, z in profile]
    beam = [sheet(a, b, M.METAL_SHEET) for a, b in zip(rails[:-1], rails[1:], strict=True)]
    base = points - 0.05 * side
    ahead = np.stack([side[:, 1], -side[:, 0], side[:, 2]], axis=1)
    posts = [_uprights(base, -SUNK, 0.72, 0.05 * ahead), _uprights(base, -SUNK, 0.72, 0.06 * side)]
    return merge([*beam, quads(np.concatenate(posts), M.METAL_POLE)])


def _uprights(base: Floats, low: float, high: float, half: Floats) -> Floats:
    """Return the corners (N, 4, 3) of upright flat bars at feet (N, 3), with half widths `half` (N, 3)."""
    a, b = base + [0, 0, low], base + [0, 0, high]
    return np.stack([a - half, a + half, b + half, b - half], axis=1)


def _crossed(base: Floats, side: Floats, high: float, radius: float) -> Floats:
    """Return posts, each of two crossed upright bars, so that they are seen from everywhere."""
    ahead = np.stack([side[:, 1], -side[:, 0], side[:, 2]], axis=1)
    return np.concatenate([_uprights(base, -SUNK, high, radius * (ahead + s * side)) for s in (-1, 1)])


def _along(line: ArrayLike, spacing: float) -> tuple[Floats, Floats]:
    """Return the middles of pieces of a line and the unit direction of the line there."""
    points, side = resampled(line, spacing)
    middles = (points[1:] + points[:-1]) / 2
    mean = (side[1:] + side[:-1]) / 2
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-9)
    return middles, np.stack([mean[:, 1], -mean[:, 0], mean[:, 2]], axis=1)


def _between(points: Floats, z: float, half: float) -> Floats:
    """Return level bars (N - 1, 4, 3) from point to point, upright faces around the height z."""
    low, high = points + [0, 0, z - half], points + [0, 0, z + half]
    return np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)


def _pickets(line: ArrayLike, height: float, spacing: float, width: float) -> Mesh:
    """Build a wooden fence of upright laths."""
    feet, ahead = _along(line, spacing)
    points, side = resampled(line, 2.4)
    laths = _uprights(feet, 0.06, height, 0.5 * width * ahead)
    rails = [_between(points - 0.04 * side, z * height, 0.035) for z in (0.25, 0.8)]
    return quads(np.concatenate([laths, *rails, _crossed(points - 0.06 * side, side, height, 0.035)]), M.WOOD)


def bars(line: ArrayLike, height: float, spacing: float, width: float, material: M) -> Mesh:
    """Build a fence of upright iron bars between two rails; the bars' flat faces are turned in turns."""
    feet, ahead = _along(line, spacing)
    points, side = resampled(line, 2.4)
    turn = (-1.0) ** np.arange(len(feet))[:, None]
    left = np.stack([-ahead[:, 1], ahead[:, 0], ahead[:, 2]], axis=1)
    bars = _uprights(feet, 0.08, height, 0.35 * width * (ahead + turn * left) * 1.4)
    rails = [_between(points, z, 0.02) for z in (0.12, height - 0.1)]
    return quads(np.concatenate([bars, *rails, _crossed(points, side, height, 0.03)]), material)


def _mesh_fence(line: ArrayLike, height: float, rng: Generator) -> Mesh:
    """Build a fence of welded mesh: wires of 8 to 12 mm, every fourth of the real ones but as much thicker."""
    points, side = resampled(line, 2.5)
    feet, ahead = _along(line, rng.uniform(0.2, 0.3))
    wires = [_between(points, z, rng.uniform(0.005, 0.008)) for z in np.arange(0.08, height, 0.16)]
    rods = _uprights(feet, 0.05, height, 0.005 * ahead)
    return quads(np.concatenate([*wires, rods, _crossed(points, side, height, 0.028)]), M.METAL_POLE)


def _rails(line: ArrayLike, height: float) -> Mesh:
    """Build a paddock fence: two or three broad rails on posts."""
    points, side = resampled(line, 2.2)
    rails = [_between(points + 0.05 * side, z * height, 0.06) for z in (0.35, 0.65, 0.95)]
    return quads(np.concatenate([*rails, _crossed(points, side, height, 0.05)]), M.WOOD)


def _boards(line: ArrayLike, height: float, material: M) -> Mesh:
    """Build a closed screen of boards set to and fro."""
    feet, ahead = _along(line, 0.2)
    points, side = resampled(line, 2.0)
    turn = 0.02 * (-1.0) ** np.arange(len(feet))[:, None]
    left = np.stack([-ahead[:, 1], ahead[:, 0], ahead[:, 2]], axis=1)
    boards = _uprights(feet + turn * left, 0.04, height, 0.105 * ahead)
    return quads(np.concatenate([boards, _crossed(points, side, height, 0.045)]), material)
