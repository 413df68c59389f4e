"""Footprints of houses side by side along a street."""

from collections.abc import Iterator, Sequence

import numpy as np
import shapely
from numpy.random import Generator
from numpy.typing import ArrayLike
from shapely import Polygon

from ogm.simulation.mesh import Floats
from ogm.simulation.town.network import area, polygons


def split_front(lot: Polygon, front: ArrayLike, style: str, rng: Generator) -> list[Polygon]:
    """Place the footprints of houses in a lot, side by side along its street front.

    Parameters
    ----------
    lot : Polygon
        Building area [m].
    front : (2, 2) array
        Two points on the street side; the lot may be on either side of their line.
    style : str
        One of `STYLES`: closed rows, detached houses with garages, halls, large buildings, or pavilions.
    rng : Generator
        Generator of widths, depths, setbacks, recesses and gaps.

    Returns
    -------
    list of Polygon
        Counter-clockwise footprints without overlap; **the first edge faces the street**, as `building` requires.
        Empty if nothing fits.
    """
    ends = np.asarray(front, np.float64)
    if lot.is_empty or lot.area < 6.0:
        return []
    # A frame with x along the street and y into the lot.
    along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    inward = np.array([-along[1], along[0]])
    if (np.array([lot.centroid.x, lot.centroid.y]) - ends[0]) @ inward < 0:
        inward = -inward
    axes = np.stack([along, inward])
    local = shapely.transform(lot, lambda p: (p - ends[0]) @ axes.T)
    kept: list[Polygon] = []
    taken = Polygon()
    for shape, smallest in _PLACERS[style](local, rng):
        for part in polygons(area(shape.intersection(local)).difference(taken))[:1]:
            piece = Polygon(part.simplify(0.05).exterior)
            if piece.area >= smallest and not piece.buffer(-1.0).is_empty:
                kept.append(front_first(shapely.transform(piece, lambda p: p @ axes + ends[0]), -inward))
                taken = taken.union(piece)
    return kept


Placed = Iterator[tuple[Polygon, float]]


def _rectangle(x: float, y: float, width: float, depth: float) -> Polygon:
    return shapely.box(x, y, x + width, y + depth)


def _row(lot: Polygon, rng: Generator) -> Placed:
    """Yield a closed row of houses with small setbacks, recesses in the front, rear wings, and rare gaps."""
    x0, y0, x1, y1 = lot.bounds
    x, setback = x0, rng.choice([0.0, 0.0, 1.5])
    while x1 - x > 4:
        width = rng.uniform(8.0, 20.0)
        if x1 - x - width < 7.0:
            width = x1 - x
        y = y0 + setback + rng.choice([0.0, 0.0, 0.0, rng.uniform(0.2, 2.5)])
        depth = min(rng.uniform(10.5, 14.0), y1 - y)
        shape = _rectangle(x, y, width, depth)
        kind = rng.random()
        if kind < 0.25 and width > 11:  # a recess, as for an entrance court
            wide = rng.uniform(3.0, 0.4 * width)
            shape = shape.difference(_rectangle(x + rng.uniform(0.2, 0.5) * width, y - 1, wide, 1 + rng.uniform(1, 3)))
        elif kind < 0.5 and width > 9 and y1 - y > depth + 6:
            wing = rng.uniform(5.0, min(8.0, 0.6 * width))
            side = x if rng.random() < 0.5 else x + width - wing
            shape = shape.union(_rectangle(side, y + depth - 1, wing, rng.uniform(4, min(14, y1 - y - depth))))
        yield shape, 30.0
        x += width + (rng.uniform(2.5, 6.0) if rng.random() < 0.07 else 0.0)


def _detached(lot: Polygon, rng: Generator) -> Placed:
    """Yield detached houses in gardens, with adjacent garages."""
    if rng.random() < 0.35:
        yield from _terraces(lot, rng)
        return
    x0, y0, x1, y1 = lot.bounds
    setback = rng.uniform(1.0, 4.5)
    x = x0 + rng.uniform(1.0, 3.0)
    while x1 - x > 8:
        width = min(rng.uniform(8.5, 13.0), x1 - x - 1.5)
        if rng.random() < 0.2:
            width = min(1.7 * width, x1 - x - 1.5)  # semi-detached
        y = y0 + setback + rng.uniform(-0.8, 1.5)
        depth = min(rng.uniform(8.0, 11.0), y1 - y - 1.0)
        if depth < 5:
            break
        shape = _rectangle(x, y, width, depth)
        kind = rng.random()
        if kind < 0.3 and width > 9.5:  # L-shaped
            shape = shape.difference(_rectangle(x + 0.6 * width, y - 1, width, 1 + rng.uniform(1.2, 3.0)))
        yield shape, 35.0
        x += width
        if rng.random() < 0.75:
            gap, wide = rng.choice([0.0, 0.0, rng.uniform(0.8, 1.6)]), rng.uniform(3.0, 6.0)
            yield _rectangle(x + gap, y + rng.uniform(0.0, 4.0), wide, 6.0), 15.0
            x += gap + wide
        x += rng.uniform(1.0, 3.5)


def _terraces(lot: Polygon, rng: Generator) -> Placed:
    """Yield rows of narrow houses behind small front gardens."""
    x0, y0, x1, y1 = lot.bounds
    x, y = x0 + rng.uniform(0.3, 1.5), y0 + rng.uniform(0.8, 4.0)
    width, depth = rng.uniform(6.6, 8.5), min(rng.uniform(9.0, 11.5), y1 - y - 1.0)
    left = int(rng.integers(4, 9))  # houses left in this row
    while x1 - x > width + 0.3 and depth > 5:
        yield _rectangle(x, y + rng.choice([0.0, 0.0, 0.8]), width, depth), 35.0
        x, left = x + width, left - 1
        if left == 0:
            x, left = x + rng.uniform(2.0, 4.0), int(rng.integers(4, 9))


def _halls(lot: Polygon, rng: Generator) -> Placed:
    """Yield halls behind yards, some with an office at the front."""
    for x, y, width, depth in _yards(
        lot, rng, (1.0, 4.0, 12, 20.0, 55.0, 2), (1.5, 5.0, 10.0, 18.0, 40.0, 8), (4.0, 10.0)
    ):
        shape = _rectangle(x, y, width, depth)
        if rng.random() < 0.4 and width > 24:
            shape = shape.difference(_rectangle(x + 0.65 * width, y - 1, width, 1 + 0.4 * depth))
        if rng.random() < 0.4:
            yield _rectangle(x + 1, y - 4.5, 9.0, 4.5), 30.0
        yield shape, 80.0


def _large(lot: Polygon, rng: Generator) -> Placed:
    """Yield offices, markets and filling stations along an arterial road."""
    for x, y, width, depth in _yards(
        lot, rng, (1.0, 5.0, 10, 16.0, 42.0, 1), (0.5, 4.0, 9.0, 12.0, 24.0, 7), (3.0, 9.0)
    ):
        shape = _rectangle(x, y, width, depth)
        if rng.random() < 0.35:
            at = rng.uniform(0.2, 0.6)
            shape = shape.difference(_rectangle(x + at * width, y - 1, 0.25 * width, 1 + rng.uniform(1.5, 4.0)))
        yield shape, 60.0


def _yards(
    lot: Polygon, rng: Generator, across: Sequence[float], deep: Sequence[float], gap: tuple[float, float]
) -> Iterator[tuple[float, float, float, float]]:
    """Yield x, y, width and depth of large houses behind yards.

    `across` has the range of the first x, the smallest remaining length, the range of widths, and the margin. `deep`
    has the bounds of two ranges of setbacks, the range of depths, and the smallest depth. `gap` is the range of gaps.
    """
    first, second, least, narrow, wide, margin = across
    near, middle, far, shallow, deepest, smallest = deep
    x0, y0, x1, y1 = lot.bounds
    x = x0 + rng.uniform(first, second)
    while x1 - x > least:
        width = min(rng.uniform(narrow, wide), x1 - x - margin)
        y = y0 + rng.choice([rng.uniform(near, middle), rng.uniform(middle, far)])
        depth = min(rng.uniform(shallow, deepest), y1 - y - margin)
        if depth < smallest:
            return
        yield x, y, width, depth
        x += width + rng.uniform(*gap)


def _pavilions(lot: Polygon, rng: Generator) -> Placed:
    """Yield kiosks and pavilions at large distances."""
    x0, y0, x1, y1 = lot.bounds
    x = x0 + rng.uniform(0.0, 30.0)
    while x1 - x > 6 and y1 - y0 > 6:
        width, depth = rng.uniform(3.0, 9.0), rng.uniform(3.0, 6.0)
        yield _rectangle(x, y0 + rng.uniform(1.0, 4.0), width, depth), 8.0
        x += width + rng.uniform(25.0, 60.0)


_PLACERS = {"centre": _row, "suburb": _detached, "industrial": _halls, "arterial": _large, "park": _pavilions}
STYLES = tuple(_PLACERS)


def front_first(footprint: Polygon, towards: Floats) -> Polygon:
    """Return a counter-clockwise footprint that starts with the edge facing the street most."""
    footprint = shapely.geometry.polygon.orient(footprint, 1.0)
    ring = np.array(footprint.exterior.coords)[:-1]
    edge = np.roll(ring, -1, axis=0) - ring
    length = np.linalg.norm(edge, axis=1)
    facing = np.stack([edge[:, 1], -edge[:, 0]], axis=1) @ towards / np.maximum(length, 1e-9)
    first = int(np.argmax(length * (facing - 0.5)))
    return Polygon(np.roll(ring, -first, axis=0), footprint.interiors)
