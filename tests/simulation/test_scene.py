"""Laws of casting rays: analytic distances, and a slow twin that casts at everything merged into one."""

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given, settings
from hypothesis import strategies as st

from ogm.pose import pose
from ogm.simulation.materials import Material
from ogm.simulation.mesh import Mesh, box, cylinder, ellipsoid, empty, merge, wall
from ogm.simulation.scene import EGO, NO_MATERIAL, STATIC, Hits, Scene

PLANE = box([-500, -500, -1], [500, 500, 0], Material.ASPHALT)


def sphere(count: int, seed: int = 0) -> np.ndarray:
    """Directions all around, the axes and both verticals among them."""
    rays = np.random.default_rng(seed).normal(size=(count, 3))
    rays = np.concatenate([np.eye(3), -np.eye(3), rays])
    return (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)


def slow_cast(parts: list[Mesh], things: list[int], origin: np.ndarray, rays: np.ndarray) -> Hits:
    """Cast at one scene that holds everything; no glass."""
    from open3d import core, t

    merged = merge(parts)
    scene = t.geometry.RaycastingScene()
    scene.add_triangles(core.Tensor(merged.vertices), core.Tensor(merged.triangles))
    starts = np.broadcast_to(np.asarray(origin, np.float32), rays.shape)
    answer = scene.cast_rays(core.Tensor(np.concatenate([starts, rays], axis=1)))
    distance = answer["t_hit"].numpy()
    hit = np.isfinite(distance)
    triangle = np.where(hit, answer["primitive_ids"].numpy(), 0)
    owner = np.repeat(things, [len(part.triangles) for part in parts])
    return Hits(
        distance,
        np.where(hit, merged.material[triangle], NO_MATERIAL),
        np.where(hit, owner[triangle], STATIC),
        np.where(hit, np.abs((rays * merged.normals[triangle]).sum(axis=1)), 0),
    )


def same(one: Hits, other: Hits) -> None:
    np.testing.assert_allclose(one.distance, other.distance, rtol=1e-6)
    # where two surfaces meet, either may be first
    agree = (one.material == other.material) & (one.object == other.object)
    assert agree.mean() > 0.999
    np.testing.assert_allclose(one.cosine[agree], other.cosine[agree], atol=1e-4)


def test_distances_to_a_plane_are_those_of_geometry() -> None:
    rays = sphere(2000)
    hits = Scene(PLANE, threads=1).cast([1.0, 2.0, 3.0], rays)
    down = rays[:, 2] < -0.01
    np.testing.assert_allclose(hits.distance[down], -3.0 / rays[down, 2], rtol=1e-5)
    np.testing.assert_allclose(hits.cosine[down], -rays[down, 2], atol=1e-5)
    assert (hits.material[down] == Material.ASPHALT).all()
    up = rays[:, 2] > 0
    assert np.isinf(hits.distance[up]).all()
    assert (hits.material[up] == NO_MATERIAL).all()
    assert (hits.cosine[up] == 0).all()
    assert (hits.object == STATIC).all()


def test_distances_inside_a_box_are_those_of_geometry() -> None:
    rays = sphere(2000)
    low, high, origin = np.array([-3.0, -2.0, -1.0]), np.array([5.0, 4.0, 2.5]), np.array([0.5, 0.7, 0.2])
    hits = Scene(box(low, high, Material.BRICK), threads=1).cast(origin, rays)
    with np.errstate(divide="ignore"):
        to_walls = np.where(rays > 0, (high - origin) / rays, np.where(rays < 0, (low - origin) / rays, np.inf))
    np.testing.assert_allclose(hits.distance, to_walls.min(axis=1), rtol=1e-5)


def test_an_empty_scene_gives_nothing() -> None:
    scene = Scene(empty(), threads=1)
    for _ in range(2):
        hits = scene.cast([0, 0, 0], sphere(10))
        assert np.isinf(hits.distance).all()
        assert (hits.material == NO_MATERIAL).all()
        assert (hits.object == STATIC).all()
        scene.place([empty()], empty())
    assert len(scene.cast([0, 0, 0], np.zeros((0, 3), np.float32)).distance) == 0


def random_world(rng: np.random.Generator) -> tuple[list[Mesh], list[Mesh], Mesh]:
    """Static and moving things: beside, behind (where the pseudo-azimuth wraps), below and straight overhead."""
    static = [PLANE]
    for _ in range(8):
        x, y = rng.uniform(-60, 60, 2)
        static.append(box([x, y, 0], [x + rng.uniform(1, 9), y + rng.uniform(1, 9), rng.uniform(1, 9)], Material.BRICK))
    moving = [
        ellipsoid([*rng.uniform(-40, 40, 2), rng.uniform(0, 3)], rng.uniform(0.3, 3, 3), Material.PAINT_DARK)
        for _ in range(12)
    ]
    angle = rng.uniform(0, 2 * np.pi)
    moving += [
        ellipsoid([rng.uniform(1, 30), 0, 1.5], [0.5, 0.7, 1], Material.PAINT_LIGHT),  # dead ahead, where 0 is
        ellipsoid([rng.uniform(-30, -1), 0, 1.5], [0.5, 0.7, 1], Material.PAINT_LIGHT),
        box([-2, -3, 4.5], [3, 2, 5], Material.CONCRETE),  # overhead
        box([8, 8, 0], [28, 8.3, 4], Material.PAINT_LIGHT).moved(pose(yaw=angle)),  # long, close by
        wall(20 * np.stack([np.cos(k := np.arange(7)), np.sin(k), 0 * k], 1), 3.0, Material.TARPAULIN),  # around
        cylinder([0, 0, 0], [0, 0, 1.2], 0.3, Material.METAL_POLE),  # below
    ]
    own = box([-2, -0.9, 0.2], [2.2, 0.9, 1.45], Material.EGO_VEHICLE).moved(pose(yaw=angle))
    return static, moving, own


@each("seed", range(8))
def test_moving_and_static_things_apart_are_hit_as_if_they_were_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    static, moving, own = random_world(rng)
    origin = np.array([*rng.uniform(-0.5, 0.5, 2), rng.uniform(1.6, 2.5)])
    if seed == 0:
        origin[:2] = 0
    rays = sphere(30_000, seed)
    scene = Scene(merge(static), threads=2)
    scene.place(moving, own)
    fast = scene.cast(origin, rays)
    slow = slow_cast([*static, *moving, own], [STATIC] * len(static) + [*range(len(moving)), EGO], origin, rays)
    same(fast, slow)
    assert {EGO, STATIC, 14} < set(fast.object.tolist())
    # rays of different origins, which take another way through the code
    same(scene.cast(np.tile(origin, (len(rays), 1)), rays), slow)


@settings(max_examples=40, deadline=None)
@given(st.tuples(*[st.floats(-8, 8)] * 9), st.tuples(*[st.floats(-2, 2)] * 3))
def test_no_triangle_is_overlooked(corners: tuple[float, ...], origin: tuple[float, ...]) -> None:
    triangle = Mesh(
        np.array(corners, np.float32).reshape(3, 3), np.array([[0, 1, 2]], np.uint32), np.array([3], np.uint8)
    )
    inside = np.random.default_rng(1).dirichlet([1, 1, 1], 300) @ triangle.vertices
    way = inside - np.array(origin)
    length = np.linalg.norm(way, axis=1, keepdims=True)
    rays = (way / np.maximum(length, 1e-9)).astype(np.float32)[length[:, 0] > 1e-3]
    scene = Scene(empty(), threads=1)
    scene.place([triangle])
    shared = scene.cast(origin, rays)
    each = scene.cast(np.tile(origin, (len(rays), 1)), rays)
    np.testing.assert_array_equal(shared.distance, each.distance)
    np.testing.assert_array_equal(shared.object, each.object)


def test_the_next_frame_replaces_the_last() -> None:
    scene = Scene(PLANE, threads=1)
    ahead = np.array([[1, 0, 0]], np.float32)
    for distance in (5.0, 9.0):
        scene.place([box([distance, -1, 0], [distance + 1, 1, 2], Material.BRICK)])
        assert scene.cast([0, 0, 1], ahead).distance[0] == pytest.approx(distance)
    scene.place([])
    assert np.isinf(scene.cast([0, 0, 1], ahead).distance[0])


def test_a_pose_turns_the_rays() -> None:
    static, moving, own = random_world(np.random.default_rng(3))
    T = pose(0.4, -0.2, 2.0, roll=0.05, pitch=-0.1, yaw=2.0)
    rays = sphere(5000)
    scene = Scene(merge(static), threads=1)
    scene.place(moving, own)
    turned = scene.cast(T[:3, 3], (rays @ T[:3, :3].T).astype(np.float32))
    same(scene.cast(T, rays), turned)


def test_neither_threads_nor_batches_change_a_bit() -> None:
    static, moving, own = random_world(np.random.default_rng(5))
    moving[0] = moving[0].painted(Material.CAR_GLASS)
    rays = sphere(200_000)
    results = []
    for threads in (1, 2, 3):
        scene = Scene(merge(static), threads=threads)
        scene.place(moving, own)
        results.append(scene.cast([0, 0, 2], rays, salt=7))
        starts = range(0, len(rays), 37_000)
        parts = [scene.cast([0, 0, 2], rays[k : k + 37_000], salt=7, number=k) for k in starts]
        results.append(Hits(*(np.concatenate(column) for column in zip(*parts, strict=True))))
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(a, b)


def test_glass_lets_its_share_through_and_no_more_than_three_panes() -> None:
    share = Material.CAR_GLASS.optics.transmission
    panes = [wall([[5.0 + k, -50, -50], [5.0 + k, 50, -50]], 100, Material.CAR_GLASS) for k in range(4)]
    back = wall([[20.0, -50, -50], [20.0, 50, -50]], 100, Material.BRICK)
    rays = np.tile(np.array([1, 0, 0], np.float32), (20_000, 1))
    for count, static in ((1, True), (2, False), (3, False), (4, True)):
        scene = Scene(merge([*panes[:count], back]) if static else back, threads=2)
        if not static:
            scene.place(panes[:count])
        hits = scene.cast([0, 0, 0], rays, salt=count)
        through = (hits.distance == 20).mean()
        expected = share**count if count <= 3 else 0
        assert through == pytest.approx(expected, abs=0.015)
        assert (hits.material[hits.distance == 20] == Material.BRICK).all()
        stopped = [(hits.distance == 5 + k).mean() for k in range(count)]
        assert sum(stopped) + through == pytest.approx(1)
        assert stopped[0] == pytest.approx(1 - share, abs=0.015)


def test_an_object_behind_glass_is_that_object() -> None:
    scene = Scene(empty(), threads=1)
    pane = wall([[5.0, -5, -5], [5.0, 5, -5]], 10, Material.CAR_GLASS)
    scene.place([pane, box([7, -5, -5], [8, 5, 5], Material.CLOTH_DARK)])
    hits = scene.cast([0, 0, 0], np.tile(np.array([1, 0, 0], np.float32), (2000, 1)))
    assert set(zip(hits.object.tolist(), hits.distance.tolist(), hits.material.tolist(), strict=True)) == {
        (0, 5.0, int(Material.CAR_GLASS)),
        (1, 7.0, int(Material.CLOTH_DARK)),
    }


def test_bad_input_is_refused_with_a_reason() -> None:
    scene = Scene(PLANE, threads=1)
    rays = sphere(4)
    refused("threads", Scene, PLANE, threads=-1)
    refused("NaN", Scene, PLANE._replace(vertices=PLANE.vertices * np.float32(np.nan)))
    refused("the 0 vertices of the mesh", Scene, PLANE._replace(vertices=PLANE.vertices[:0]))
    refused("one material per triangle", Scene, PLANE._replace(material=PLANE.material[:3]))
    refused("float32", scene.cast, [0, 0, 0], rays.astype(np.float64), error=TypeError)
    refused("shape", scene.cast, [0, 0, 0], rays[:, :2])
    refused("origin", scene.cast, np.zeros((5, 3)), rays)
    refused("NaN", scene.cast, [0, np.nan, 0], rays)
    refused("rotation", scene.cast, np.diag([2.0, 1, 1, 1]), rays)


@each("change, message", [
        ({"vertices": PLANE.vertices.astype(np.float64)}, "vertices must be float32"),
        ({"vertices": PLANE.vertices[:, :2]}, r"vertices .* \(N, 3\)"),
        ({"triangles": PLANE.triangles.astype(np.int64)}, "triangles must be uint32"),
        ({"material": PLANE.material.astype(np.int64)}, "material must be uint8"),
        ({"material": PLANE.material[:, None]}, r"material .* \(N,\)"),
    ])  # fmt: skip
def test_meshes_of_other_types_are_refused(change: dict, message: str) -> None:
    refused(message, Scene, PLANE._replace(**change), error=TypeError, threads=1)
    with pytest.raises(TypeError, match=message):
        Scene(PLANE, threads=1).place([PLANE._replace(**change)])
