import inspect

import numpy as np
import pytest
import shapely
from cases import each
from numpy.testing import assert_array_equal
from shapely import Polygon

from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Mesh
from ogm.simulation.town import furniture, plants, structures
from ogm.simulation.town.buildings import building
from ogm.simulation.town.footprints import STYLES, split_front

pytestmark = pytest.mark.slow  # frozen code: test_dataset.py compares what samples hold
LINE = np.array([[0.0, 0.0, 0.0], [6.0, 0.0, 0.3], [10.0, 2.0, 0.5]])
LENGTH = 6.0 + np.hypot(4.0, 2.0)
PIECES = {
    "guard_rail": lambda rng: structures.guard_rail(LINE),
    "low_wall": lambda rng: structures.low_wall(LINE, rng),
    "fence": lambda rng: structures.fence(LINE, rng),
    "gantry": lambda rng: structures.gantry(14.0, rng),
    "bridge": lambda rng: structures.bridge(20.0, 4.0, rng),
} | {
    name: piece
    for module in (furniture, structures)
    for name, piece in inspect.getmembers(module, inspect.isfunction)
    if piece.__module__ == module.__name__ and list(inspect.signature(piece).parameters) == ["rng"]
}
ON_A_POINT = sorted(set(PIECES) - {"guard_rail", "low_wall", "fence", "gantry", "bridge"})
PLANTS = {
    "tree": plants.tree,
    "bush": plants.bush,
    "hedge": lambda rng: plants.hedge(LINE, rng),
    "grass": lambda rng: plants.grass_tufts(shapely.box(0, 0, 20, 5), level, rng),
}


def level(x, y):
    return np.zeros(np.shape(x))


def hill(x, y):
    return 3.0 + 0.06 * np.asarray(x) + 0.03 * np.asarray(y)


def first_hits(mesh, origins, directions):
    from open3d import core, t

    scene = t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(core.Tensor(mesh.vertices), core.Tensor(mesh.triangles))
    rays = np.concatenate(np.broadcast_arrays(origins, directions), axis=1).astype(np.float32)
    answer = scene.cast_rays(core.Tensor(rays), nthreads=1)
    distance, triangle = answer["t_hit"].numpy(), answer["primitive_ids"].numpy().astype(np.int64)
    hit = np.isfinite(distance)
    material = np.full(len(hit), 255)
    material[hit] = mesh.material[triangle[hit]]
    return distance, material


def plot(width, depth):
    return Polygon([(0, 0), (width, 0), (width, depth), (0, depth)])  # the street lies below it


def houses(style, count=4, height_at=hill):
    rng = np.random.default_rng(3)
    lot = shapely.box(0, 0, 30.0 * count, 40)
    footprints = split_front(lot, [[0, 0], [30.0 * count, 0]], style, rng)
    return [(footprint, building(footprint, style, height_at, rng)) for footprint in footprints]


def sound(mesh: Mesh):
    assert np.isfinite(mesh.vertices).all()
    assert mesh.vertices.dtype == np.float32
    assert mesh.triangles.max() < len(mesh.vertices)
    assert len(mesh.triangles) == len(mesh.material)
    assert set(mesh.material.tolist()) <= {int(m) for m in M}


# All things


@each("make", [*PIECES.values(), *PLANTS.values()])
def test_same_generator_same_thing(make):
    for a, b in zip(make(np.random.default_rng(5)), make(np.random.default_rng(5)), strict=True):
        assert_array_equal(a, b)


# Houses


@each("style", STYLES)
def test_houses_stand_in_the_ground_on_their_footprint(style):
    for footprint, mesh in houses(style):
        sound(mesh)
        corners = np.array(footprint.exterior.coords)
        assert mesh.vertices[:, 2].min() < hill(*corners.T).min() - 0.3
        assert mesh.vertices[:, 2].max() > hill(*corners.T).max() + 2.0
        low = mesh.vertices[mesh.vertices[:, 2] < hill(*corners.T).max() + 1.5]
        away = shapely.distance(footprint, shapely.points(low[:, :2].astype(float)))
        assert away.max() < 2.2  # steps at most


@each("style", STYLES)
def test_walls_stop_rays_at_eye_level(style):
    for footprint, mesh in houses(style, height_at=level):
        if M.METAL_SHEET in mesh.material and mesh.vertices[:, 2].min() > 1 or footprint.area < 60:
            continue
        ring = np.array(footprint.exterior.coords)
        a, b = ring[0], ring[1]
        out = np.array([b[1] - a[1], a[0] - b[0]]) / np.linalg.norm(b - a)
        at = a + np.linspace(0.1, 0.9, 40)[:, None] * (b - a)
        origins = np.column_stack([at + 4 * out, np.full(40, 1.5)])
        distance, _ = first_hits(mesh, origins, np.append(-out, 0.0)[None])
        if (distance > 20).mean() > 0.5:  # a filling station or an open pavilion
            assert style in ("arterial", "park")
            continue
        stopped = distance < 4 + 1.7
        assert stopped.mean() > 0.5  # all but a passage
        assert distance.min() > 4 - 2.3


@each("style", ["centre", "suburb", "arterial"])
def test_what_stands_out_hangs_above_two_and_a_half_metres(style):
    balconies = 0
    for seed in range(25):
        rng = np.random.default_rng(seed)
        mesh = building(plot(18, 12), style, hill, rng)
        corners = mesh.vertices[mesh.triangles]
        before = corners[..., 1].max(axis=1) < -0.32
        stone = (mesh.material == M.STONE) & (corners[..., 2].max(axis=1) < hill(9, 0) + 2)
        assert (corners[before & stone, 1] > -2.2).all()  # steps
        hanging = corners[before & ~stone]
        above = hanging[..., 2] - hill(hanging[..., 0], hanging[..., 1])
        assert (above > 2.5).all()
        balconies += len(hanging) > 0
    assert balconies > 3


@each("style", STYLES)
def test_courtyards_slopes_and_odd_outlines_are_built(style):
    court = Polygon([(0, 0), (40, 0), (40, 35), (0, 35)], [[(12, 12), (28, 12), (28, 24), (12, 24)]])
    outlines = [
        court,
        Polygon([(0, 0), (9, 1), (12, 8), (5, 12), (-2, 7)]),
        Polygon([(0, 0), (20, 0), (20, 5), (12, 5), (12, 15), (0, 15)]).reverse(),
        shapely.Point(50, 50).buffer(7, quad_segs=4),
        shapely.box(0, 0, 2.1, 2.0),
        shapely.box(0, 0, 30, 1.4),
        Polygon([(0, 0), (10, 0), (4, 7)]),
    ]
    for outline in outlines:
        for seed in range(2):
            mesh = building(outline, style, lambda x, y: 0.2 * x - 0.1 * y, np.random.default_rng(seed))
            sound(mesh)
    distance, _ = first_hits(
        building(court, "industrial", level, np.random.default_rng(0)),
        np.array([[20, 18, 50.0]]),
        np.array([[0, 0, -1.0]]),
    )
    assert np.isinf(distance).all()  # the courtyard is open to the sky


@each("style", STYLES)
@each("angle", [0.0, 130.0])
def test_footprints_lie_in_the_lot_apart_and_face_the_street(style, angle):
    lot = Polygon([(0, 0), (90, 0), (86, 37), (30, 45), (2, 30)])
    lot = shapely.affinity.rotate(lot, angle, origin=(0, 0))
    front = np.array(lot.exterior.coords)[:2]
    street = shapely.LineString(front)
    made = 0
    for seed in range(8):
        footprints = split_front(lot, front, style, np.random.default_rng(seed))
        made += len(footprints)
        for k, footprint in enumerate(footprints):
            assert footprint.is_valid
            assert footprint.exterior.is_ccw
            assert footprint.difference(lot.buffer(0.1)).area < 1e-6
            edge = np.diff(np.array(footprint.exterior.coords)[:2], axis=0)[0]
            turn = front[1] - front[0]
            assert edge @ turn > 0.9 * np.linalg.norm(edge) * np.linalg.norm(turn)
            assert all(footprint.intersection(other).area < 0.5 for other in footprints[:k])
    assert made
    if style == "centre":
        assert min(street.distance(f) for f in footprints) < 3


# Plants


def crown_hits(mesh, rng):
    leaves = mesh.vertices[mesh.triangles[mesh.material == M.FOLIAGE]].reshape(-1, 3)
    middle = np.median(leaves, axis=0)
    half = np.ptp(np.percentile(leaves, [3, 97], axis=0), axis=0) / 2
    angle = rng.uniform(0, 2 * np.pi, 800)
    way = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    side = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    off = 0.6 * rng.uniform(-1, 1, (2, 800, 1))
    target = middle + off[0] * half[0] * side + off[1] * half[2] * np.array([0, 0, 1.0])
    distance, _ = first_hits(mesh, target - 40 * way, way)
    return np.isfinite(distance).mean()


def test_a_ray_through_a_crown_is_stopped_with_a_probability_of_half_to_nine_tenths():
    rng = np.random.default_rng(0)
    stopped = [crown_hits(plants.tree(np.random.default_rng(seed)), rng) for seed in range(40)]
    assert min(stopped) > 0.45
    assert max(stopped) < 0.92
    assert 0.6 < np.mean(stopped) < 0.8


def test_trees_are_rooted_within_budget_and_of_many_sizes():
    heights = []
    for seed in range(60):
        tree = plants.tree(np.random.default_rng(seed))
        sound(tree)
        assert set(tree.material.tolist()) == {M.FOLIAGE, M.BARK}
        assert 250 <= len(tree.triangles) <= 700
        assert tree.vertices[:, 2].min() == pytest.approx(-plants.SUNK)
        foot = tree.vertices[tree.vertices[:, 2] < 0.1]
        assert np.linalg.norm(foot[:, :2], axis=1).max() < 6
        heights.append(tree.vertices[:, 2].max())
    assert min(heights) < 6
    assert max(heights) > 10


@each("clearance", [0.0, 2.5, 4.5])
def test_no_leaf_hangs_below_the_clearance(clearance):
    for seed in range(20):
        tree = plants.tree(np.random.default_rng(seed), clearance=clearance)
        leaves = tree.vertices[tree.triangles[tree.material == M.FOLIAGE]]
        assert leaves[..., 2].min() > clearance - 1e-4
        assert len(tree.triangles) <= 700


# Furniture


@each("name", ON_A_POINT)
def test_furniture_stands_on_its_foot(name):
    for seed in range(12):
        mesh = PIECES[name](np.random.default_rng(seed))
        sound(mesh)
        z = mesh.vertices[:, 2]
        assert -0.5 <= z.min() <= 0.0
        assert 0.3 < z.max() < 11
        assert len(mesh.triangles) <= (240 if name == "bike_rack" else 130)
        assert not set(mesh.material.tolist()) & {M.ASPHALT, M.PAVING, M.GRASS, M.EGO_VEHICLE}


@each("name", ["lamp", "traffic_light", "gantry", "bridge"])
def test_what_reaches_over_the_road_is_higher_than_four_and_a_half_metres(name):
    for seed in range(20):
        mesh = PIECES[name](np.random.default_rng(seed))
        y = np.abs(mesh.vertices[:, 1])
        road = y > 0.65 if name in ("lamp", "traffic_light") else y < {"gantry": 6.5, "bridge": 8.0}[name]
        assert (mesh.vertices[road, 2] > 4.5).all()
        if name in ("gantry", "bridge"):
            assert road.any()
            starts = np.stack(np.meshgrid(-30.0, np.linspace(-6, 6, 25), [0.5, 2.0, 4.4]), -1).reshape(-1, 3)
            assert np.isinf(first_hits(mesh, starts, np.array([[1.0, 0.0, 0.0]]))[0]).all()


@each("name", ["sign", "gantry", "shelter", "barrier"])
def test_signs_are_retroreflective_on_the_front_only(name):
    seen = 0
    for seed in range(20):
        mesh = PIECES[name](np.random.default_rng(seed))
        plates = mesh.vertices[mesh.triangles[mesh.material == M.SIGN]].reshape(-1, 3)
        if not len(plates):
            continue
        low, high = plates.min(axis=0), plates.max(axis=0)
        y, z = (g.ravel() for g in np.meshgrid(np.linspace(low[1], high[1], 40), np.linspace(low[2], high[2], 40)))
        front = np.column_stack([np.full(1600, 30.0), y, z])
        behind = np.column_stack([np.full(1600, -30.0), y, z])
        ahead = np.array([[-1.0, 0.0, 0.0]])
        assert (first_hits(mesh, front, ahead)[1] == M.SIGN).sum() > 20
        assert not (first_hits(mesh, behind, -ahead)[1] == M.SIGN).any()
        seen += 1
    assert seen > 5
