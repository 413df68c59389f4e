"""Street network in the plane, cross-sections of streets, and helpers for lines and polygons."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import shapely
from numpy.random import Generator
from numpy.typing import ArrayLike
from scipy.sparse.csgraph import connected_components
from shapely import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Floats
from ogm.simulation.town.graph import MARGIN, Grid, bent_grid, broad_line, chains_of, dead_ends, grid_edges, thinned

Rural = Callable[[tuple[str, ...], Floats], tuple[str, ...]]  # districts and middles of their meshes to new districts
SPACING = 96.0  # [m] approximate distance between parallel streets


class Profile(NamedTuple):
    """Cross-section of a kind of street; lengths in metres, right and left of its direction.

    The centre line of a street divides the forward lanes (right of it) from the others.
    """

    kind: str
    forward: int
    back: int
    lane: float  # width of a lane
    speed: float  # limit [m/s]
    median: float  # width of the raised strip in the middle
    cycle: float  # width of the cycle lanes
    parking: tuple[float, float]  # width of the parking lanes
    verge: float  # grass between kerb and sidewalk
    sidewalk: tuple[float, float]
    surface: M
    kerb: float  # height of the kerb

    @property
    def right(self) -> float:
        """Distance from the dividing line to the right kerb [m]."""
        return self.median / 2 + self.forward * self.lane + self.cycle + self.parking[0] + GUTTER

    @property
    def left(self) -> float:
        """Distance from the dividing line to the left kerb [m]."""
        back = self.back * self.lane + self.cycle * (self.back > 0)
        return self.median / 2 + back + self.parking[1] + GUTTER

    @property
    def walks(self) -> tuple[float, float]:
        """Offsets of the sidewalks' middles to the left of the dividing line [m], right sidewalk first."""
        right, left = self.sidewalk
        return -self.right - self.verge - right / 2, self.left + self.verge + left / 2


GUTTER = 0.3  # [m] between the outermost lane and the kerb
_FIELDS = (
    Profile("arterial", 2, 2, 3.4, 16.7, 2.4, 0.0, (0.0, 0.0), 2.6, (2.6, 2.6), M.ASPHALT, 0.14),
    Profile("main", 1, 1, 3.3, 13.9, 0.0, 1.6, (2.2, 2.2), 0.0, (3.4, 3.4), M.ASPHALT, 0.12),
    Profile("avenue", 1, 1, 3.3, 13.9, 0.0, 0.0, (2.2, 0.0), 2.2, (2.6, 2.2), M.ASPHALT, 0.12),
    Profile("residential", 1, 1, 3.0, 8.3, 0.0, 0.0, (2.1, 0.0), 0.0, (1.9, 1.9), M.WORN_ASPHALT, 0.10),
    Profile("green", 1, 1, 3.0, 8.3, 0.0, 0.0, (0.0, 2.1), 1.8, (1.8, 1.8), M.ASPHALT, 0.10),
    Profile("oneway", 1, 0, 3.4, 8.3, 0.0, 0.0, (2.1, 0.0), 0.0, (2.4, 2.2), M.COBBLES, 0.09),
    Profile("narrow", 1, 0, 3.3, 8.3, 0.0, 0.0, (2.1, 2.1), 0.0, (1.8, 2.0), M.WORN_ASPHALT, 0.11),
    Profile("industrial", 1, 1, 3.6, 13.9, 0.0, 0.0, (2.6, 0.0), 1.4, (1.8, 1.5), M.WORN_ASPHALT, 0.15),
    Profile("lane", 1, 1, 2.8, 5.6, 0.0, 0.0, (0.0, 2.0), 0.0, (1.5, 1.5), M.ASPHALT, 0.08),
    Profile("country", 1, 1, 3.1, 16.7, 0.0, 0.0, (0.0, 0.0), 0.8, (0.7, 0.7), M.ASPHALT, 0.02),
)
PROFILES = {profile.kind: profile for profile in _FIELDS}


@dataclass(frozen=True, eq=False)
class Street:
    """A street between two crossings.

    Attributes
    ----------
    start, end : int
        First and last crossing.
    line : (M, 2) float64
        Dividing line with about 1 m between points [m].
    along : (M,) float64
        Distance along the line from the start to each point [m].
    normals : (M, 2) float64
        Unit vectors to the left at each point.
    profile : Profile
        Cross-section of the street.
    district : str
        District of the street.
    """

    start: int
    end: int
    line: Floats
    along: Floats
    normals: Floats
    profile: Profile
    district: str

    @property
    def length(self) -> float:
        """Length of the dividing line [m]."""
        return float(self.along[-1])

    def at(self, along: ArrayLike, left: ArrayLike = 0.0) -> Floats:
        """Return points (..., 2) at distances from the start and offsets to the left [m]."""
        along, left = np.broadcast_arrays(np.asarray(along, float), np.asarray(left, float))
        return np.asarray(interpolated(along, self.along, self.line) + self.normal(along) * left[..., None])

    def normal(self, along: ArrayLike) -> Floats:
        """Return unit vectors (..., 2) to the left at distances from the start."""
        normal = interpolated(np.asarray(along, float), self.along, self.normals)
        return np.asarray(normal / np.linalg.norm(normal, axis=-1, keepdims=True))

    def band(self, start: float, end: float, right: float, left: float) -> Polygon:
        """Return the strip between two distances from the start, and between two offsets to the left [m]."""
        along = np.linspace(start, end, max(2, int((end - start) / 3.0) + 2))
        return Polygon(np.concatenate([self.at(along, right), self.at(along[::-1], left)]))

    def middle(self, right: float, left: float) -> LineString:
        """Return the line midway between an offset to the right and an offset to the left, both positive."""
        return LineString(self.line + self.normals * (left - right) / 2)


class StreetNetwork(NamedTuple):
    """Crossings and streets."""

    grid: Grid
    streets: tuple[Street, ...]
    heads: list[int]  # nodes at dead ends, with space to turn


def make_network(size: float, rng: Generator, rural: Rural | None = None) -> StreetNetwork:
    """Draw the streets of a town of `size` metres; `rural` converts some of its districts to country."""
    n = max(3, int((size - 2 * MARGIN) // SPACING) + 1)
    nodes = bent_grid(n, size, rng)
    edges = grid_edges(n)
    # Middles and districts of the meshes.
    at = nodes.reshape(n, n, 2)
    faces = (at[:-1, :-1] + at[1:, :-1] + at[:-1, 1:] + at[1:, 1:]).reshape(-1, 2) / 4
    styles = _districts(n - 1, faces, rng)
    if rural is not None:
        styles = rural(styles, faces)
    # Broad road, roundabout, dead ends.
    broad = broad_line(n, int(rng.integers(4)))
    inner = [i * n + j for i in range(1, n - 1) for j in range(1, n - 1)]
    free = [k for k in inner if not any(k in edge and edge in broad for edge in edges)]
    roundabout = n * n // 2 if n == 3 else int(rng.choice(free))
    kept = [edge for edge in edges if edge in broad or roundabout in edge or rng.random() > 0.16]
    grid = Grid(nodes, faces, styles, broad, roundabout)
    grid, edges, heads = dead_ends(grid, thinned(edges, kept, n * n), n // 3 + 1)
    chains = chains_of(edges, len(grid.nodes), {roundabout, *heads})
    return StreetNetwork(grid, _streets(grid, chains, heads, rng), heads)


def _districts(m: int, faces: Floats, rng: Generator) -> tuple[str, ...]:
    """Return the district of each mesh: dense centre, a park next to it, industry in a corner, suburbs elsewhere."""
    if m == 2:
        quiet = "park" if rng.random() < 0.5 else "industrial"
        return tuple(str(s) for s in rng.permutation(["centre", "centre", "suburb", quiet]))
    styles = np.full(m * m, "suburb", dtype=object)
    far = np.linalg.norm(faces - rng.uniform(-0.12, 0.12, 2) * np.ptp(faces), axis=1)
    order = np.argsort(far, kind="stable")
    dense = max(2, round(m * m * rng.uniform(0.4, 0.52)))
    styles[order[:dense]] = "centre"
    corner = faces[order[-1 - int(rng.integers(2))]]
    near = np.argsort(np.linalg.norm(faces - corner, axis=1), kind="stable")
    styles[near[: max(2, round(m * m * rng.uniform(0.1, 0.16)))]] = "industrial"
    green = [int(k) for k in order[dense - 1 :] if styles[k] != "industrial"]
    styles[rng.choice(green[: len(green) // 2 + 1])] = "park"
    return tuple(str(s) for s in styles)


def _streets(grid: Grid, chains: list[list[int]], heads: list[int], rng: Generator) -> tuple[Street, ...]:
    """Return streets along chains of nodes, with curved lines and cross-sections."""
    kinds: list[str] = []
    districts = [grid.district(grid.nodes[chain].mean(axis=0)) for chain in chains]
    for chain, district in zip(chains, districts, strict=True):
        ends, pairs = {chain[0], chain[-1]}, zip(chain[:-1], chain[1:], strict=True)
        round_it, dead_end = grid.roundabout in ends, not ends.isdisjoint(heads)
        if not round_it and any({(a, b), (b, a)} & grid.broad for a, b in pairs):
            kinds.append("arterial")
        elif dead_end or round_it:
            kinds.append("industrial" if district == "industrial" else "lane" if dead_end else "avenue")
        else:
            kinds.append(str(rng.choice(_CHOICES[district])))
    _one_way(chains, kinds, grid.roundabout, heads, rng)
    streets = []
    for chain, kind, district in zip(chains, kinds, districts, strict=True):
        line = _bend(grid.nodes[chain], rng)
        tangent = np.gradient(line, axis=0)
        tangent[[0, -1]] = line[1] - line[0], line[-1] - line[-2]
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        normals = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
        streets.append(Street(chain[0], chain[-1], line, way_along(line), normals, PROFILES[kind], district))
    return tuple(streets)


_CHOICES = {
    "centre": ["main", "avenue", "oneway", "narrow", "narrow", "residential"],
    "suburb": ["residential", "residential", "residential", "narrow", "green", "avenue"],
    "industrial": ["industrial"],
    "park": ["green", "avenue"],
    "country": ["country"],
}


def _one_way(chains: list[list[int]], kinds: list[str], roundabout: int, heads: list[int], rng: Generator) -> None:
    """Choose directions of one-way streets, and make them two-way if the network would be unreachable otherwise."""
    single = [k for k, kind in enumerate(kinds) if PROFILES[kind].back == 0]
    for k in single:
        if roundabout in (chains[k][0], chains[k][-1]) or chains[k][0] == chains[k][-1]:
            kinds[k] = "residential"
        elif rng.random() < 0.5:
            chains[k].reverse()
    for k in single:
        if PROFILES[kinds[k]].back == 0 and not _reachable(chains, kinds, heads):
            chains[k].reverse()
            if not _reachable(chains, kinds, heads):
                kinds[k] = "residential"


def _reachable(chains: list[list[int]], kinds: list[str], heads: list[int]) -> bool:
    """Return whether every directed street is reachable from every other, with U-turns at dead ends only."""
    arcs = [(k, chain[0], chain[-1]) for k, chain in enumerate(chains)]
    arcs += [(k, chain[-1], chain[0]) for k, chain in enumerate(chains) if PROFILES[kinds[k]].back]
    step = np.array([[b == c and (k != m or b in heads) for m, c, _ in arcs] for k, _, b in arcs])
    return bool(connected_components(step, connection="strong")[0] == 1 and step.any(axis=1).all())


def _bend(points: Floats, rng: Generator) -> Floats:
    """Return a smooth line through a chain of crossings, straight near its ends, with a bend or an S-curve between."""
    control = [points[0]]
    last = len(points) - 2
    for k, (a, b) in enumerate(zip(points[:-1], points[1:], strict=True)):
        length = float(np.linalg.norm(b - a))
        across = np.array([a[1] - b[1], b[0] - a[0]]) / length
        sway = rng.uniform(-1, 1) * min(4.0, 0.035 * length) if length > 60 else 0.0
        other = sway * rng.choice([-1.0, 0.0, 1.0])
        bends = [(0.32, 0.0), (0.44, sway), (0.56, other), (0.68, 0.0)]
        between = bends[(1 if k > 0 else 0) : (3 if k < last else 4)]
        control += [a + t * (b - a) + offset * across for t, offset in between]
        control.extend(_corner(a, b, points[k + 2]) if k < last else [b])
    line = np.array(control)
    for _ in range(5):  # repeated corner cutting converges to a quadratic B-spline
        cut = np.stack([0.75 * line[:-1] + 0.25 * line[1:], 0.25 * line[:-1] + 0.75 * line[1:]], axis=1)
        line = np.concatenate([line[:1], cut.reshape(-1, 2), line[-1:]])
    return evenly(line)


def way_along(line: Floats) -> Floats:
    """Return the distance along a line from its start to each of its points."""
    return np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


def interpolated(at: Floats, way: Floats, values: Floats) -> Floats:
    """Interpolate values (M, K), given at the distances `way` along a line, at the distances `at`: (..., K)."""
    return np.stack([np.interp(at, way, column) for column in values.T], axis=-1)


def evenly(line: Floats) -> Floats:
    """Resample a line to about 1 m between points, with unchanged ends."""
    way = way_along(line)
    return interpolated(np.linspace(0, way[-1], max(2, int(round(way[-1])) + 1)), way, line)


def turn(before: Floats, after: Floats) -> float:
    """Return the angle from one direction to another, positive to the left [rad]."""
    return float(np.arctan2(before[0] * after[1] - before[1] * after[0], before @ after))


def _corner(a: Floats, b: Floats, c: Floats) -> list[Floats]:
    """Return points of an arc that rounds corner b between a and c, with the largest radius that fits."""
    u, w = (b - a) / np.linalg.norm(b - a), (c - b) / np.linalg.norm(c - b)
    angle = turn(u, w)
    if abs(angle) < 0.1:
        return [b]
    reach = min(23.0, 0.36 * float(np.linalg.norm(b - a)), 0.36 * float(np.linalg.norm(c - b)))
    radius = reach / np.tan(abs(angle) / 2)
    start, side = b - reach * u, np.sign(angle) * np.array([-u[1], u[0]])
    return [start + radius * (np.sin(t) * u + (1 - np.cos(t)) * side) for t in np.linspace(0, abs(angle), 9)]


def polygons(shape: BaseGeometry) -> list[Polygon]:
    """Return the polygons of a geometry, largest first."""
    parts = [part for part in shapely.get_parts(shape) if isinstance(part, Polygon) and part.area > 0]
    return sorted(parts, key=lambda part: -part.area)


def area(shape: BaseGeometry) -> BaseGeometry:
    """Return the polygons of a geometry, without lines and points of shapes that only touch.

    Overlays reject such mixtures as operands.
    """
    return shapely.union_all(polygons(shape))


def inside(line: BaseGeometry, shape: BaseGeometry) -> list[LineString]:
    """Return the parts of a line within a shape, without points of contact."""
    parts = shapely.get_parts(shapely.intersection(line, area(shape)))
    return [part for part in parts if isinstance(part, LineString)]
