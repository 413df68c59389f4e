"""Country between streets: banks and ditches along the road, and the vegetation of the land behind them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from numpy.random import Generator
from scipy.ndimage import gaussian_filter
from shapely import Polygon
from shapely.geometry.base import BaseGeometry

from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Floats, HeightAt, Mesh, empty, quads
from ogm.simulation.recipe import Country
from ogm.simulation.town.ground import Raster, mask, raster
from ogm.simulation.town.layout import TownLayout
from ogm.simulation.town.network import area, polygons
from ogm.simulation.town.plants import grass_tufts, points_in
from ogm.simulation.town.yard import Yard

STEP = 2.0  # [m] spacing of the rasters of banks
BLEND = 3.0  # [m] width of the transition between banks
MIN_SHARE = 0.7  # smallest factor of a bank's height along the road
VARIATION = 12.0  # [m] length scale of that factor


class BankProfile(NamedTuple):
    """Cross-section along a road: heights [m] at distances from its edge [m], linear between them."""

    distance: tuple[float, ...]
    height: tuple[float, ...]

    @property
    def width(self) -> float:
        """Distance from the road beyond which the land is level [m]."""
        return self.distance[-1]


class CountryField(NamedTuple):
    """Country in a mesh between streets.

    Attributes
    ----------
    profile : BankProfile
        Cross-section of banks and ditches.
    reach : Raster
        Weight of the cross-section, 0 to 1.
    bank, land : shapely geometry
        Strip of the cross-section, and the land behind it.
    cover, use : str
        Vegetation of strip and land: keys of `COVERS` and `USES`.
    """

    profile: BankProfile
    reach: Raster
    bank: BaseGeometry
    land: BaseGeometry
    cover: str
    use: str


# Shares of the vegetation of banks, and of the land behind them.
COVERS = {"bare": 0.3, "high grass": 0.4, "bushes": 0.3}
USES = {"ploughed": 0.18, "crops": 0.14, "meadow": 0.26, "scrub": 0.2, "wood": 0.22}
_KINDS = {"ditch": 0.3, "rise": 0.22, "fall": 0.2, "ditch and rise": 0.2, "level": 0.08}
_SURFACES = {"ploughed": M.SOIL, "crops": M.SOIL, "wood": M.SOIL}


def turn_rural(styles: Sequence[str], faces: Floats, country: Country, rng: Generator) -> tuple[str, ...]:
    """Return the districts of a town with country in its outer part on one side."""
    count = round(len(styles) * rng.uniform(*country.share))
    angle = rng.uniform(0, 2 * np.pi)
    far = faces @ [np.cos(angle), np.sin(angle)] + rng.normal(0, 0.15 * np.ptp(faces), len(faces))
    result = list(styles)
    for k in np.argsort(-far, kind="stable")[:count].tolist():
        result[k] = "country"
    return tuple(result)


def draw_profile(country: Country, rng: Generator) -> BankProfile:
    """Draw banks and ditches with slopes within `Country.slope`, even if lowered by `MIN_SHARE`."""
    low, high = country.slope

    def slope() -> float:
        return float(np.exp(rng.uniform(np.log(low / MIN_SHARE), np.log(high))))

    kind = str(rng.choice(list(_KINDS), p=list(_KINDS.values())))
    distance, height = [float(rng.uniform(*country.shoulder))], [0.0]

    def go(change: float) -> None:
        """Add a change of height at a random slope."""
        distance.append(distance[-1] + abs(change) / slope())
        height.append(height[-1] + change)

    def level(width: float) -> None:
        distance.append(distance[-1] + width)
        height.append(height[-1])

    if kind.startswith("ditch"):
        depth = float(rng.uniform(*country.ditch))
        go(-depth)
        level(rng.uniform(0.3, 1.2))
        go(depth + (float(rng.uniform(*country.bank)) if kind == "ditch and rise" else 0.0))
    elif kind in ("rise", "fall"):
        go(float(rng.uniform(*country.bank)) * (1.0 if kind == "rise" else -1.0))
    level(1.0)
    return BankProfile(tuple(distance), tuple(height))


def lay_fields(plan: TownLayout, built: BaseGeometry, country: Country, rng: Generator) -> list[CountryField]:
    """Return the fields of a town outside `built`, and add their surfaces and breaklines to the layout."""
    styles, faces = plan.network.grid.styles, plan.network.grid.faces
    frame = shapely.box(*(np.array([-1, -1, 1, 1]) * plan.size / 2))
    cells = shapely.get_parts(shapely.voronoi_polygons(shapely.MultiPoint(faces), extend_to=frame))
    free = shapely.difference(area(shapely.union_all([b.shape for b in plan.blocks])), built.buffer(1.0))
    open_land = mask(free.buffer(STEP), plan.size, STEP)
    fields = []
    for k, style in enumerate(styles):
        if style != "country":
            continue
        cell = cells[int(np.argmax(shapely.contains_xy(cells, *faces[k])))]
        profile = draw_profile(country, rng)
        inside = (mask(shapely.intersection(cell, frame), plan.size, STEP) & open_land).astype(float)
        reach = raster(gaussian_filter(inside, BLEND / STEP), STEP, plan.size)
        near = plan.corridor.buffer(profile.width, quad_segs=4)
        ours = area(shapely.intersection(free, shapely.intersection(cell, frame)))
        land = area(shapely.difference(ours, near)).buffer(-0.3)
        bank = area(shapely.intersection(ours, near)).difference(plan.corridor.buffer(0.3))
        cover, use = (str(rng.choice(list(of), p=list(of.values()))) for of in (COVERS, USES))
        for away in profile.distance:
            edge = shapely.boundary(plan.corridor.buffer(away, quad_segs=3).simplify(0.05))
            plan.lines.append(shapely.intersection(edge, cell.buffer(3 * BLEND)))
        plan.pave(land, _SURFACES.get(use, M.GRASS))
        fields.append(CountryField(profile, reach, bank, land, cover, use))
    return fields


class CountryBank:
    """Height of the land above the road, with the banks and ditches of fields."""

    def __init__(self, bank: HeightAt, fields: Sequence[CountryField], plan: TownLayout, rng: Generator) -> None:
        self.bank, self.fields = bank, fields
        rings = shapely.get_parts(shapely.boundary(plan.corridor))
        pairs = [np.stack([c[:-1], c[1:]], axis=1) for c in map(shapely.get_coordinates, rings)]
        self._edge = shapely.STRtree(shapely.linestrings(np.concatenate(pairs)))
        count = int(plan.size // STEP) + 2
        noise = gaussian_filter(rng.standard_normal((count, count)), VARIATION / STEP)
        share = MIN_SHARE + (1 - MIN_SHARE) * np.clip(0.5 + 0.5 * noise / noise.std(), 0, 1)
        self._share = raster(share, STEP, plan.size)

    def __call__(self, x: Floats, y: Floats) -> Floats:
        """Return the heights [m]."""
        z = np.asarray(self.bank(x, y), np.float64).copy()
        reach = np.stack([field.reach(x, y) for field in self.fields])
        (near,) = np.nonzero(reach.max(axis=0) > 1e-3)
        points = shapely.points(x[near], y[near])
        index, away = self._edge.query_nearest(points, return_distance=True, all_matches=False)
        distance = np.zeros(len(near))
        distance[index[0]] = away
        for field, share in zip(self.fields, reach[:, near], strict=True):
            z[near] += share * self._share(x[near], y[near]) * np.interp(distance, *field.profile)
        return z


def plant_fields(fields: Sequence[CountryField], yard: Yard) -> None:
    """Add the vegetation of fields and their banks."""
    rng = yard.rng
    for field in fields:
        if field.cover == "high grass":
            yard.meshes.append(high_grass(field.bank, yard.height, rng, density=rng.uniform(1.5, 4.0)))
        elif field.cover == "bushes":
            yard.scatter(field.bank, yard.bushes, rng.uniform(5, 15), 0.4)
        else:
            _tufts(field.bank, yard, 1.0)
        _PLANT[field.use](field.land, yard)


def _tufts(shape: BaseGeometry, yard: Yard, density: float) -> None:
    for part in polygons(shape):
        yard.meshes.append(grass_tufts(part, yard.height, yard.rng, density=density))


def _ploughed(land: BaseGeometry, yard: Yard) -> None:
    for part in polygons(land):
        yard.meshes.append(furrows(part, yard.height, yard.rng))


def _crops(land: BaseGeometry, yard: Yard) -> None:
    tall = yard.rng.uniform(0.35, 1.3)
    for part in polygons(land):
        yard.meshes.append(crops(part, yard.height, yard.rng, tall=tall))


def _meadow(land: BaseGeometry, yard: Yard) -> None:
    if yard.rng.random() < 0.5:
        yard.meshes.append(high_grass(land, yard.height, yard.rng, density=yard.rng.uniform(0.8, 2.5)))
    else:
        _tufts(land, yard, 0.6)
    yard.scatter(land, yard.trees, 500, 1.5)


def _scrub(land: BaseGeometry, yard: Yard) -> None:
    yard.scatter(land, yard.bushes, yard.rng.uniform(8, 25), 0.5)
    yard.scatter(land, yard.trees, 180, 1.0)
    yard.meshes.append(high_grass(land, yard.height, yard.rng, density=0.8))


def _wood(land: BaseGeometry, yard: Yard) -> None:
    near = land.intersection(shapely.box(*(np.array([-1, -1, 1, 1]) * 0.45 * yard.size)))
    yard.scatter(near, yard.trees, yard.rng.uniform(12, 22), 0.8)
    yard.scatter(near, yard.bushes, yard.rng.uniform(20, 50), 0.6)
    _tufts(near, yard, 0.3)


_PLANT = {"ploughed": _ploughed, "crops": _crops, "meadow": _meadow, "scrub": _scrub, "wood": _wood}


MAX_CLUMPS = 30_000  # in a field


def high_grass(shape: BaseGeometry, height_at: HeightAt, rng: Generator, *, density: float) -> Mesh:
    """Make high grass of FOLIAGE, 0.3 to 1.2 m, which counts as an obstacle.

    Parameters
    ----------
    shape : shapely geometry
        Area of the grass [m].
    height_at : callable
        Function of the ground height [m] at x, y [m].
    rng : Generator
        Generator of positions and sizes.
    density : float
        Clumps per square metre; each is 0.2 to 0.6 m wide.
    """
    x, y = points_in(shape, density, MAX_CLUMPS, rng)
    usual = rng.uniform(0.4, 1.0)
    return _clumps(x, y, height_at, usual * rng.uniform(0.6, 1.2, len(x)), rng)


def crops(shape: Polygon, height_at: HeightAt, rng: Generator, *, tall: float) -> Mesh:
    """Make a crop of uniform height `tall` [m] in rows 0.7 m apart."""
    ways, middle, half = _axes(shape, rng)
    across, along = np.meshgrid(np.arange(-half, half, 0.7), np.arange(-half, half, 0.55), indexing="ij")
    along = along + rng.uniform(-0.15, 0.15, along.shape)
    x, y = (middle + np.stack([across.ravel(), along.ravel()], axis=1) @ ways).T
    kept = shapely.contains_xy(shape, x, y)
    if np.count_nonzero(kept) > MAX_CLUMPS:
        kept &= rng.random(len(x)) < MAX_CLUMPS / np.count_nonzero(kept)
    x, y = x[kept], y[kept]
    return _clumps(x, y, height_at, tall * rng.uniform(0.85, 1.1, len(x)), rng)


def furrows(shape: Polygon, height_at: HeightAt, rng: Generator) -> Mesh:
    """Make a ploughed field of SOIL: uneven ridges 0.03 to 0.12 m high and 0.5 to 0.9 m apart."""
    ways, middle, half = _axes(shape, rng)
    gap, high = 0.5 * rng.uniform(0.5, 0.9), rng.uniform(0.03, 0.12)
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


def _axes(shape: Polygon, rng: Generator) -> tuple[Floats, Floats, float]:
    """Return unit vectors across and along a field's rows, (2, 2), its centroid, and half its diagonal [m]."""
    angle = rng.uniform(0, np.pi)
    c, s = np.cos(angle), np.sin(angle)
    half = 0.5 * float(np.hypot(*np.ptp(np.array(shape.bounds).reshape(2, 2), axis=0)))
    return np.array([[c, s], [-s, c]]), np.array(shape.centroid.coords[0]), half


def _clumps(x: Floats, y: Floats, height_at: HeightAt, tall: Floats, rng: Generator) -> Mesh:
    """Make a leaning, tapering leaf of random direction at each position."""
    if not len(x):
        return empty()
    base = np.stack([x, y, np.asarray(height_at(x, y), np.float64) - 0.03], axis=1)
    angle = rng.uniform(0, 2 * np.pi, len(x))
    across = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1) * rng.uniform(0.1, 0.3, (len(x), 1))
    lean = np.stack([*(0.15 * tall * rng.normal(0, 1, (2, len(x)))), tall], axis=1)
    corners = np.stack([base - across, base + across, base + 0.7 * across + lean, base - 0.7 * across + lean], 1)
    return quads(corners, M.FOLIAGE)
