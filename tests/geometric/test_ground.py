"""Ground estimates: on made hills, and on real scans where they are at hand."""

import geometric_reference as reference
import numpy as np
import pytest
from cases import each, refused
from geometric_reference import pull_push

from ogm import GridSpec, Mount, read_points
from ogm.geometric import RayISM, flat_ground, ground_height, local_ground, patchwork_ground
from ogm.geometric.kernels.surface import fill

SPEC = GridSpec.centered(60.0, 60.0, 1.0)
GROUND_POINT = (0.0, 0.0, -1.8)


def hill(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A road that climbs 8 % ahead, falls 10 % behind and is banked to the left."""
    return -1.8 + 0.08 * np.maximum(x, 0) + 0.10 * np.minimum(x, 0) + 0.03 * y


def scene(seed: int = 0, noise: float = 0.02) -> tuple[np.ndarray, np.ndarray]:
    """Points on the hill and on cars, walls and crowns above it; and which are ground."""
    rng = np.random.default_rng(seed)
    run, azimuth = 2.5 * 12 ** rng.random(40_000), rng.uniform(0, 2 * np.pi, 40_000)
    x, y = run * np.cos(azimuth), run * np.sin(azimuth)
    above = np.zeros(len(x))
    car = (np.abs((x % 9) - 4) < 2) & (np.abs(np.abs(y) - 5) < 0.9)
    above[car] = rng.uniform(0.4, 1.5, car.sum())
    wall = np.abs(np.abs(y) - 20) < 0.3
    above[wall] = rng.uniform(0, 6, wall.sum())
    crown = np.hypot(x - 12, y - 12) < 3
    above[crown] = rng.uniform(3, 6, crown.sum())
    z = hill(x, y) + above + rng.normal(0, noise, len(x))
    return np.stack([x, y, z], 1).astype(np.float32), above < 0.05


def test_local_ground_follows_slopes_under_cars_walls_and_crowns() -> None:
    xyz, is_ground = scene()
    above = xyz[:, 2] - ground_height(local_ground(xyz, SPEC, GROUND_POINT), SPEC, xyz)
    assert np.abs(above[is_ground]).mean() < 0.04
    assert (above[is_ground] < 0.15).mean() > 0.99
    assert (above[~is_ground & (xyz[:, 2] - hill(xyz[:, 0], xyz[:, 1]) > 0.3)] > 0.15).mean() > 0.99
    flat = xyz[:, 2] - ground_height(flat_ground(xyz, SPEC, GROUND_POINT), SPEC, xyz)
    assert (flat[is_ground] < 0.15).mean() < 0.7  # the plane fails here, which is why there is a local estimate


@each("depth", [0.6, 3.0, 20.0])
def test_ghost_returns_below_ground_do_not_pull_it_down(depth: float) -> None:
    xyz, is_ground = scene()
    rng = np.random.default_rng(1)
    stray = rng.uniform((8, -14, 0), (10, -12, 0), (60, 3))
    stray[:, 2] = hill(stray[:, 0], stray[:, 1]) - depth - rng.uniform(0, 0.5, 60)
    both = np.concatenate([xyz, stray.astype(np.float32)])
    above = xyz[:, 2] - ground_height(local_ground(both, SPEC, GROUND_POINT), SPEC, xyz)
    assert (np.abs(above[is_ground]) < 0.15).mean() > 0.985


@each("edge", ["front", "back", "left", "right"])
def test_strays_in_the_outermost_cells_are_dropped(edge: str) -> None:
    """The sensor stands at one end of a long grid, and the stray return at the other, 1 m under the road."""
    length, width = (40, 12) if edge in ("front", "back") else (12, 40)
    spec = GridSpec(
        1.0, (length, width), {"front": (-1, -6), "back": (-39, -6), "left": (-6, -1), "right": (-6, -39)}[edge]
    )
    x, y = (axis.ravel() for axis in np.broadcast_arrays(*spec.cell_centers))
    road = np.stack([x, y, np.full(len(x), -1.8)], 1).astype(np.float32)
    far = {"front": (38.5, 0.5), "back": (-38.5, 0.5), "left": (0.5, 38.5), "right": (0.5, -38.5)}[edge]
    away = np.abs(road[:, :2] - far).max(axis=1) > 0.1  # the stray is all that its cell holds
    both = np.concatenate([road[away], np.array([[*far, -2.8]], np.float32)])
    np.testing.assert_allclose(local_ground(both, spec, GROUND_POINT), -1.8, atol=0.05)


def test_a_few_strays_under_a_thin_layer_of_road_do_not_lower_it() -> None:
    """Twenty returns 0.4 m under three hundred of the road, in one cell near the car."""
    xyz, is_ground = scene(noise=0.01)
    rng = np.random.default_rng(3)
    cell = rng.uniform((5.0, 1.0, 0), (6.0, 2.0, 0), (320, 3))
    cell[:, 2] = hill(cell[:, 0], cell[:, 1]) + rng.normal(0, 0.01, 320)
    cell[:20, 2] -= 0.38
    both = np.concatenate([xyz, cell.astype(np.float32)])
    above = cell[20:, 2] - ground_height(local_ground(both, SPEC, GROUND_POINT), SPEC, cell[20:].astype(np.float32))
    assert (np.abs(above) < 0.1).mean() > 0.95


def test_returns_that_no_road_leads_down_to_are_not_ground() -> None:
    """A cell near the car with both road and deep strays keeps its road."""
    xyz, _ = scene()
    stray = np.array([[6.5, 0.5, -5.0], [6.6, 0.4, -4.0]], np.float32)
    height = local_ground(np.concatenate([xyz, stray]), SPEC, GROUND_POINT)
    np.testing.assert_allclose(height, local_ground(xyz, SPEC, GROUND_POINT), atol=1e-6)


def test_neither_the_order_of_points_nor_copies_of_them_change_the_ground() -> None:
    """Copies count only as weights, of up to 8, where cells without returns are filled."""
    xyz, _ = scene()
    once = local_ground(xyz, SPEC, GROUND_POINT)
    shuffled = np.random.default_rng(4).permutation(xyz)
    np.testing.assert_allclose(local_ground(shuffled, SPEC, GROUND_POINT), once, atol=1e-4)
    is_seen = np.zeros(SPEC.shape, bool)
    near = xyz[np.abs(xyz[:, 2] - hill(*xyz[:, :2].T)) < 0.1]
    near = near[SPEC.contains(near[:, 0], near[:, 1])]
    is_seen[SPEC.index(near[:, 0], near[:, 1])] = True
    copies = local_ground(np.repeat(xyz, 5, axis=0), SPEC, GROUND_POINT)
    np.testing.assert_allclose(copies[is_seen], once[is_seen], atol=1e-4)


def test_ground_without_returns_does_not_rise_faster_than_a_road() -> None:
    """A road at -1.8 m and, 8 m beside it, a terrace 2 m up: between them the slope limit holds."""
    rng = np.random.default_rng(5)
    xy = rng.uniform((-25, -4), (25, 4), (40_000, 2))
    xy = np.concatenate([xy, rng.uniform((-25, 12), (25, 25), (20_000, 2))])
    xyz = np.column_stack([xy, np.where(xy[:, 1] > 8, 0.2, -1.8)]).astype(np.float32)
    height = local_ground(xyz, SPEC, GROUND_POINT)
    across = height[SPEC.index(0.0, 0.0)[0], slice(*SPEC.index(0.0, [3.5, 12.5])[1])]
    assert (across <= -1.8 + 0.25 * np.arange(len(across)) + 1e-4).all()
    assert across[-2] > -0.5  # and it does rise


def test_a_ground_point_or_a_map_that_the_kernels_cannot_take_is_refused() -> None:
    point = np.zeros((1, 3), np.float32)
    refused("must lie inside the grid", local_ground, point, SPEC, (99.0, 0.0, 0.0))
    refused("2 x 2 cells", local_ground, point, GridSpec(1.0, (1, 5), (-0.5, -2.0)), (0.0, 0.0, 0.0))
    at = np.array([(0.2, 0.7, 0.0), (5.0, 2.6, 0.0)], np.float32)
    for shape in ((1, 1), (1, 3), (3, 1)):
        height = ground_height(np.full(shape, 3, np.float32), GridSpec(1.0, shape, (0.0, 0.0)), at)
        np.testing.assert_array_equal(height, [3, 3])


@each("seed", range(4))
@pytest.mark.parametrize("shape", [(12, 9), (2, 2), (2, 7), (13, 2)])
def test_local_ground_equals_its_reference(seed: int, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(seed)
    spec = GridSpec(1.0, shape, (-shape[0] / 2, -shape[1] / 2))
    xy = rng.uniform((-7, -5), (7, 5), (250, 2))
    above = rng.choice([0, 0, 0, 0.5, 1.5, 3, -0.35, -1, -9], 250)
    xyz = np.column_stack([xy, hill(*xy.T) + above + rng.normal(0, 0.02, 250)]).astype(np.float32)
    ground_point = (0.3, -0.2, -1.8)
    fast = local_ground(xyz, spec, ground_point)
    slow = reference.ground_map(xyz, ground_point, spec, 0.25, 0.15, 0.4, 0.25)
    np.testing.assert_allclose(fast, slow, atol=1e-4)


@each(
    ("lowest", "layer", "above", "height"),
    [(1, 10, 0, -1.75), (1, 9, 0, -2.0), (2, 20, 2, -1.75), (2, 20, 3, -2.0), (2, 19, 0, -2.0)],
)
def test_a_layer_above_the_lowest_is_the_ground_from_ten_times_the_returns(
    lowest: int, layer: int, above: int, height: float
) -> None:
    z = np.repeat(np.float32([-2.0, -1.75 + 1e-4, -1.4]), (lowest, layer, above))
    xyz = np.column_stack([np.full((len(z), 2), 0.5), z]).astype(np.float32)
    spec, ground_point = GridSpec(1.0, (2, 2), (0.0, 0.0)), (0.5, 0.5, -1.8)
    slow = reference.ground_map(xyz, ground_point, spec, 0.25, 0.15, 0.4, 0.25)
    for estimate in (local_ground(xyz, spec, ground_point), slow):
        np.testing.assert_allclose(estimate, height, atol=1e-3)


@each(
    "shape", [(1, 1), (1, 2), (2, 1), (1, 3), (1, 9), (8, 1), (2, 2), (2, 3), (3, 2), (3, 3), (5, 4), (7, 17), (16, 9)]
)
def test_missing_heights_are_filled_as_the_slow_version_does(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(shape[0] * 100 + shape[1])
    for share in (0.0, 0.05, 0.3, 0.9):
        height = rng.uniform(-2, 3, shape).astype(np.float32)
        weight = np.where(rng.random(shape) < share, rng.integers(1, 9, shape), 0).astype(np.float32)
        height[weight == 0] = 0
        filled, weight_before = height.copy(), weight.copy()
        fill(filled, weight, np.float32(-1.8))
        np.testing.assert_array_equal(weight, weight_before)
        slow = pull_push(height.astype(float), weight.astype(float), -1.8)
        np.testing.assert_allclose(filled, slow, atol=1e-5)
        known = weight > 0
        np.testing.assert_array_equal(filled[known], height[known])
        if known.any():  # means of what is known
            assert (filled >= height[known].min() - 1e-5).all()
            assert (filled <= height[known].max() + 1e-5).all()
        else:
            np.testing.assert_array_equal(filled, np.float32(-1.8))


def test_kerbs_do_not_break_the_ground_on_either_side() -> None:
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-25, 25, (2, 60_000))
    z = np.where(np.abs(y) > 4, 0.14, 0.0) - 1.8 + rng.normal(0, 0.01, len(x))
    xyz = np.stack([x, y, z], 1).astype(np.float32)
    above = z - ground_height(local_ground(xyz, SPEC, GROUND_POINT), SPEC, xyz)
    assert np.abs(above[np.abs(y) < 3]).mean() < 0.03
    assert np.abs(above[np.abs(y) > 6]).mean() < 0.03
    assert np.abs(above).max() < 0.2  # the step itself is shared out over a metre: kerbs are not marked reliably


def test_without_points_the_ground_is_the_plane_under_the_sensor() -> None:
    for estimate in (flat_ground, local_ground):
        height = estimate(np.empty((0, 3), np.float32), SPEC, GROUND_POINT)
        assert height.shape == SPEC.shape
        np.testing.assert_allclose(height, -1.8, atol=1e-6)


def test_a_wall_next_to_the_sensor_is_not_ground() -> None:
    wall = np.array([(4.0, y, z) for y in np.linspace(-3, 3, 50) for z in (0.0, 0.5)], np.float32)
    above = wall[:, 2] - ground_height(local_ground(wall, SPEC, GROUND_POINT), SPEC, wall)
    assert (above > 0.5).all()


def test_ground_height_is_bilinear_and_holds_its_edge() -> None:
    spec = GridSpec(1.0, (2, 2), (0.0, 0.0))
    height = np.array([[0.0, 1.0], [2.0, 3.0]], np.float32)
    at = np.array([(0.5, 0.5), (1.5, 1.5), (1.0, 1.0), (0.5, 1.0), (-9, -9), (9, 9)], np.float32)
    np.testing.assert_allclose(ground_height(height, spec, at), [0, 3, 1.5, 0.5, 0, 3])


def test_patchwork_adapter_agrees_with_the_plane_where_it_is_one() -> None:
    pytest.importorskip("pypatchworkpp")
    xyz, _ = scene()
    xyz[:, 2] -= hill(xyz[:, 0], xyz[:, 1]).astype(np.float32) + np.float32(1.8)
    height = patchwork_ground(xyz, SPEC, GROUND_POINT)
    near = np.hypot(*np.broadcast_arrays(*SPEC.cell_centers)) < 15
    assert np.abs(height[near] + 1.8).mean() < 0.01
    shifted = patchwork_ground(xyz + np.float32([0, 0, 1.8]), SPEC, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(shifted, height + 1.8, atol=0.02)
    small = GridSpec(1.0, (30, 14), (-20.0, -6.0))  # there are returns beyond all its edges
    beside = SPEC.index(-19.5, -5.5)
    part = height[beside[0] : beside[0] + 30, beside[1] : beside[1] + 14]
    np.testing.assert_allclose(patchwork_ground(xyz, small, GROUND_POINT), part, atol=0.02)


def test_ray_model_takes_any_ground() -> None:
    spec = GridSpec.centered(40.0, 40.0, 0.5)
    xyz, _ = scene()
    points = np.pad(xyz, ((0, 0), (0, 1)))
    local = RayISM(spec, Mount(1.8))(points)
    flat = RayISM(spec, Mount(1.8), ground=flat_ground)(points)
    ahead = (slice(spec.index(12, 0)[0], None), slice(*spec.index(0, [-3.0, 3.0])[1]))
    assert (flat.occupied[ahead] > 0.5).mean() > 0.5  # 8 % of 12 m is a metre: the plane sees a wall
    assert (local.occupied[ahead] > 0.5).mean() < 0.1


@each(("cell", "side"), [(1.0, 1.0), (0.1, 0.5), (3.0, 3.0), (50.0, 50.0)])
def test_the_map_of_the_ground_covers_the_grid_with_cells_that_are_no_finer(cell: float, side: float) -> None:
    seen = []

    def keep(xyz: np.ndarray, spec: GridSpec, ground_point: tuple) -> np.ndarray:
        seen.append(spec)
        return flat_ground(xyz, spec, ground_point)

    spec = GridSpec(0.5, (13, 9), (-2.0, -1.5))  # 6.5 m x 4.5 m
    RayISM(spec, Mount(1.8), ground=keep, ground_cell=cell)(np.zeros((1, 4), np.float32))
    (coarse,) = seen
    assert (coarse.resolution, coarse.origin) == (side, spec.origin)
    for n, length in zip(coarse.shape, (6.5, 4.5), strict=True):
        assert n == max(2, int(np.ceil(length / side)))


def test_slope_of_a_real_road_is_not_an_obstacle(real) -> None:
    """SUSTechPOINTS: the road rises around the car; its plane estimate would mark it."""
    points = read_points(real("sustechpoints/lidar/000970.pcd.xz"), axes="sustech")
    spec = GridSpec.centered(81.92, 56.32, 0.16)
    local, flat = RayISM(spec, Mount(1.8))(points), RayISM(spec, Mount(1.8), ground=flat_ground)(points)
    road = (slice(spec.index(15, 0)[0], spec.index(25, 0)[0]), slice(*spec.index(0, [-10.0, 10.0])[1]))
    assert (flat.occupied[road] > 0.5).mean() > 2 * (local.occupied[road] > 0.5).mean()
    assert (local.free[road] > 0.5).mean() > 0.5
