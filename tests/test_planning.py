"""Distances, costs, footprints and lines of sight, against brute force, shapely and nav2's search in plain Python."""

import math
from typing import Any

import numpy as np
import pytest
from cases import each, refused
from scipy import ndimage
from scipy.spatial.distance import cdist

from ogm import DynamicGrid, EvidentialGrid, GridSpec
from ogm.fusion import EvidentialMapper
from ogm.planning import collision, costmap, distance_to_obstacles, inflated, ray_is_free
from ogm.planning.footprints import Grid
from ogm.pose import pose
from ogm.state import CellState, predict_state

VEHICLE = (-1.0, 3.5, -0.9, 0.9)


def random_grid(seed: int, shape: tuple[int, int] = (23, 17), occupied: float = 0.03) -> EvidentialGrid:
    """Return a grid of cells that are free, occupied with some share, or unknown, and of masses between."""
    rng = np.random.default_rng(seed)
    state, rest = rng.random(shape), 0.2 * rng.random((*shape, 2))
    mass = np.where((state < occupied)[..., None], (0.0, 0.8), np.where((state > 0.85)[..., None], 0.0, (0.8, 0.0)))
    return EvidentialGrid(GridSpec(0.25, shape, (-3.0, 1.0)), (mass + rest * (0.5, 0.5)).astype(np.float32))


def brute_distance(obstacle: np.ndarray) -> np.ndarray:
    cells = np.argwhere(np.ones_like(obstacle))
    if not obstacle.any():
        return np.full(obstacle.shape, np.inf)
    return cdist(cells, np.argwhere(obstacle)).min(axis=1).reshape(obstacle.shape)


@each("seed, shape, share", [(0, (23, 17), 0.03), (1, (1, 30), 0.1), (2, (30, 1), 0.1), (3, (1, 1), 1.0),
                             (4, (40, 35), 0.002), (5, (20, 20), 0.5), (6, (9, 9), 0.0)])  # fmt: skip
def test_distances_are_those_of_brute_force(seed: int, shape: tuple[int, int], share: float) -> None:
    grid = random_grid(seed, shape, share)
    state = predict_state(grid.mass)
    outside = np.pad(np.zeros(shape, bool), 1, constant_values=True)  # one ring of it holds the nearest place
    for unknown, obstacle in {"obstacle": state != CellState.FREE, "only": state == CellState.UNKNOWN}.items():
        wanted = brute_distance(np.pad(obstacle, 1) | outside)[1:-1, 1:-1] * 0.25
        np.testing.assert_array_equal(distance_to_obstacles(grid, unknown), wanted.astype(np.float32))
    wanted = brute_distance(state == CellState.OCCUPIED) * 0.25
    np.testing.assert_array_equal(distance_to_obstacles(grid, "free"), wanted.astype(np.float32))


def test_distances_of_a_whole_grid_are_those_of_scipy() -> None:
    grid = random_grid(7, (300, 211), 0.01)
    wanted = ndimage.distance_transform_edt(predict_state(grid.mass) != CellState.OCCUPIED, sampling=0.25)
    np.testing.assert_array_equal(distance_to_obstacles(grid, "free"), wanted.astype(np.float32))


def test_an_inflated_grid_has_the_extremes_of_a_disc() -> None:
    grid = random_grid(1)
    for radius in (0.0, 0.2, 0.25, 0.6, 1.3, 9.0):
        found, wanted = inflated(grid, radius), np.zeros((*grid.spec.shape, 2))
        reach = int(radius / 0.25)
        around = np.pad(grid.mass, ((reach, reach), (reach, reach), (0, 0)))  # unknown outside
        disc = np.hypot(*np.mgrid[-reach : reach + 1, -reach : reach + 1]) * 0.25 <= radius
        for i, j in np.ndindex(grid.spec.shape):
            cells = around[i : i + 2 * reach + 1, j : j + 2 * reach + 1][disc]
            wanted[i, j] = cells[:, 0].min(), cells[:, 1].max()
        np.testing.assert_array_equal(found.mass, wanted.astype(np.float32))
        found.check()


# Costs.


def nav2_cost(distance: float, resolution: float, inscribed: float, scaling: float) -> int:
    """Return what nav2's ``InflationLayer::computeCost`` does; the distance is in cells."""
    if distance == 0:
        return 254
    if distance * resolution <= inscribed:
        return 253
    return int(252 * math.exp(-1.0 * scaling * (distance * resolution - inscribed)))


def nav2_inflation(costs: np.ndarray, side: float, radii: tuple[float, float], scaling: float, **flags: bool) -> Any:
    """Return what nav2's ``InflationLayer::updateCosts`` makes: cells by increasing distance, from bins."""
    reach, (nx, ny), costs = max(0, math.ceil(radii[1] / side)), costs.shape, costs.copy()
    bins: list[list[tuple[int, int, int, int]]] = [[] for _ in range(reach * reach + 1)]  # by squared distance
    for i, j in np.ndindex(nx, ny):
        if costs[i, j] == 254 or (flags.get("around_unknown") and costs[i, j] == 255):
            bins[0].append((i, j, i, j))
    seen = np.zeros_like(costs, bool)
    for cells in bins if reach else []:
        for i, j, source_i, source_j in cells:  # which grow meanwhile
            if seen[i, j]:
                continue
            seen[i, j] = True
            cost = nav2_cost(math.hypot(i - source_i, j - source_j), side, radii[0], scaling)
            takes = cost > 0 if flags.get("inflate_unknown") else cost >= 253
            costs[i, j] = cost if costs[i, j] == 255 and takes else max(costs[i, j], cost)
            for p, q in ((i - 1, j), (i, j - 1), (i + 1, j), (i, j + 1)):
                square = (p - source_i) ** 2 + (q - source_j) ** 2
                if 0 <= p < nx and 0 <= q < ny and not seen[p, q] and square <= reach * reach:
                    bins[square].append((p, q, source_i, source_j))
    return costs


@each("unknown, flags", [("unknown", {}), ("inflated", {"inflate_unknown": True}),
                         ("obstacle", {"around_unknown": True}), ("free", {})])  # fmt: skip
def test_costs_are_those_of_nav2(unknown: str, flags: dict[str, bool]) -> None:
    numbers = [(0.25, 0.7, 5.0), (0.0, 0.1, 10.0), (0.3, 3.0, 1.0), (0.5, 1.1, 2.6), (0.0, 20.0, 0.0), (0.5, 0.5, 3.0)]
    for seed, (inscribed, inflation, scaling) in enumerate(numbers):
        grid = random_grid(seed)
        start = np.array([0 if unknown == "free" else 255, 0, 254], np.uint8)[predict_state(grid.mass)]
        found = costmap(grid, inscribed, inflation, scaling, unknown)
        by_search = nav2_inflation(start, 0.25, (inscribed, inflation), scaling, **flags)
        differs = found != by_search  # its search misses the nearest obstacle of 1 in 9,000 cells
        assert differs.sum() <= 1
        assert (found[differs] > by_search[differs]).all()
        distance = brute_distance((start == 254) | ((start == 255) & (unknown == "obstacle")))
        table = [nav2_cost(math.sqrt(n), 0.25, inscribed, scaling) for n in range(math.ceil(inflation / 0.25) ** 2 + 1)]
        around = np.append(table, 0)[np.minimum(np.round(distance**2), len(table)).astype(int)]
        takes = around > 0 if unknown == "inflated" else around >= 253
        wanted = np.where((start == 255) & takes, around, np.maximum(start, around))
        np.testing.assert_array_equal(found, wanted)


def test_a_map_without_inflation_has_the_costs_of_its_states() -> None:
    grid, empty = random_grid(0), EvidentialGrid.vacuous(GridSpec(0.5, (3, 2), (0.0, 0.0)))
    np.testing.assert_array_equal(costmap(grid, 0, 0), np.array([255, 0, 254])[predict_state(grid.mass)])
    for unknown, cost in {"unknown": 255, "inflated": 255, "obstacle": 254, "free": 0}.items():
        assert (costmap(empty, 0.1, 1.0, unknown=unknown) == cost).all()


def test_the_cost_of_a_distance_is_that_of_nav2_to_the_last_bit() -> None:
    """Around one obstacle, for each distance of a long radius and many scalings."""
    for side in (0.05, 0.1, 0.16):
        mass = np.full((70, 60, 2), (1.0, 0.0), np.float32)
        mass[0, 0] = 0.0, 1.0
        grid = EvidentialGrid(GridSpec(side, (70, 60), (0, 0)), mass)
        for scaling in (0.5, 1.0, 3.0, 5.0, 10.0):
            found = costmap(grid, 0.2, 60 * side, scaling)
            for i, j in [(0, 0), *np.argwhere(found > 0)]:
                assert found[i, j] == nav2_cost(math.hypot(i, j), side, 0.2, scaling)
            assert not found[math.ceil(60) + 1 :].any()


# Footprints and lines.


def cells_under(polygon: np.ndarray, spec: GridSpec) -> tuple[np.ndarray, bool]:
    """Return the cells that shapely finds a polygon to touch, and whether it reaches beyond the grid."""
    shapely = pytest.importorskip("shapely")
    shape = shapely.Polygon(polygon) if len(polygon) > 2 else shapely.LineString(polygon)
    x, y = np.meshgrid(*(a.ravel() for a in spec.cell_centers), indexing="ij")
    h = spec.resolution / 2
    x0, x1, y0, y1 = spec.extent
    touched = shapely.intersects(shapely.box(x - h, y - h, x + h, y + h), shape)
    return touched, not shapely.box(x0, y0, x1, y1).contains(shape)


CORNERS = {
    "car": np.array([(-1.0, -0.9), (3.5, -0.9), (3.5, 0.9), (-1.0, 0.9)]),
    "triangle, clockwise": np.array([(2.0, 0.0), (-1.0, -1.0), (-0.5, 1.5)]),
    "u": np.array([(-2, -2), (2, -2), (2, 2), (1.4, 2), (1.4, -1.5), (-1.4, -1.5), (-1.4, 2), (-2, 2)]),
    "crossing itself": np.array([(-1.5, -1.5), (1.5, 1.5), (1.5, -1.5), (-1.5, 1.5)]),
    "needle": np.array([(-2.0, 0.0), (2.0, 0.01), (2.0, 0.0)]),
}


@each("name", CORNERS)
def test_footprints_have_the_extremes_of_the_cells_that_shapely_finds(name: str) -> None:
    rng = np.random.default_rng(len(name))
    mass = rng.dirichlet((1, 1, 1), (31, 27)).astype(np.float32)[..., :2]
    grid = EvidentialGrid(GridSpec(0.25, (31, 27), (-3.0, 1.0)), mass)
    poses = rng.uniform((-4, 0, -4), (6, 9, 4), (60, 3))
    footprint = VEHICLE if name == "car" else CORNERS[name]
    found, beyond_all = collision(grid, footprint, poses), 0
    for k, (x, y, yaw) in enumerate(poses):
        turn = np.array([(math.cos(yaw), -math.sin(yaw)), (math.sin(yaw), math.cos(yaw))])
        touched, beyond = cells_under(CORNERS[name] @ turn.T + (x, y), grid.spec)
        cells = np.append(mass[touched], np.zeros((int(beyond), 2)), axis=0)
        assert found.belief[k] == cells[:, 1].max()
        assert found.plausibility[k] == 1 - cells[:, 0].min().astype(np.float32)
        assert found.unknown[k] == pytest.approx(1 - cells.sum(axis=1).min(), abs=1e-6)
        beyond_all += beyond
    assert 5 < beyond_all < 55


def road(seconds: float = 0.0) -> EvidentialGrid:
    """Return a free road 4 m wide, on which something stands at x = 12 m, or has moved away from there at 2 m/s."""
    mass = np.full((200, 16, 2), (0.9, 0.0), np.float32)
    mass[round((12 + 2 * seconds) / 0.25)] = 0.1, 0.8
    return EvidentialGrid(GridSpec(0.25, (200, 16), (0.0, -2.0)), mass)


def test_the_first_doubtful_pose_is_where_the_vehicle_touches_the_obstacle() -> None:
    x = np.arange(2.0, 20.0, 0.5)
    poses = np.array([pose(a, yaw=0.0) for a in x])
    found = collision(road(), VEHICLE, poses)
    assert x[found.first_doubtful or 0] == 8.5  # its front is then at 12 m
    np.testing.assert_allclose(found.belief[:13], 0.0)
    np.testing.assert_allclose(found.plausibility[:13], 0.1, atol=1e-6)
    np.testing.assert_allclose(found.plausibility[13:20], 0.9, atol=1e-6)
    assert collision(road(), VEHICLE, poses[:13]).first_doubtful is None
    assert collision(road(), VEHICLE, poses, max_plausibility=0.05).first_doubtful == 0
    same = collision(road(), np.array(CORNERS["car"]), [(a, 0.0, 0.0) for a in x])
    np.testing.assert_array_equal(same.plausibility, found.plausibility)
    beside = collision(road(), VEHICLE, [(5.0, 1.5, 0.0)])  # half a metre of it is beyond the grid
    assert (beside.unknown, beside.plausibility, beside.first_doubtful) == ([1.0], [1.0], 0)


def test_a_path_is_checked_with_the_map_at_the_time_of_each_pose() -> None:
    asked = []

    def predicted(seconds: float) -> Grid:
        asked.append(seconds)
        grid, nan = road(seconds), np.full((200, 16, 2), np.float32(np.nan))
        mass = np.insert(grid.mass, 1, 0, axis=-1)
        return DynamicGrid(grid.spec, mass, nan, np.full((200, 16, 2, 2), np.float32(np.nan)))

    x, seconds = np.array([2.0, 4.0, 6.0, 8.0, 10.6]), np.array([0.0, 1.0, 1.0, 2.0, 1.0])
    found = collision(predicted, VEHICLE, np.stack([x, 0 * x, 0 * x], axis=1), seconds)
    assert asked == [0.0, 1.0, 2.0]
    assert found.first_doubtful == 4  # the front at 14.1 m, where it stands after 1 s
    np.testing.assert_allclose(found.plausibility, [0.1, 0.1, 0.1, 0.1, 0.9], atol=1e-6)


def test_a_line_is_free_where_all_of_its_cells_are() -> None:
    grid = random_grid(3, occupied=0.02)
    rng = np.random.default_rng(0)
    ends = rng.uniform((-3.5, 0.5), (3.0, 5.5), (200, 2, 2))
    found = ray_is_free(grid, ends[:, 0], ends[:, 1])
    for k, line in enumerate(ends):
        touched, beyond = cells_under(line, grid.spec)
        assert found[k] == (not beyond and grid.free[touched].min() >= 0.5), line
    assert 10 < found.sum() < 190
    from_one = ray_is_free(grid, ends[0, 0], ends[:, 1])
    assert from_one.shape == (200,)
    assert from_one[0] == found[0]
    assert ray_is_free(grid, (0.1, 2.1), (0.1, 2.1)).shape == ()


# Opinions at points.


def test_opinions_are_those_of_the_cells_and_unknown_outside() -> None:
    grid = random_grid(5)
    points = np.random.default_rng(1).uniform((-4, 0), (4, 7), (3, 100, 2))
    inside = grid.spec.contains(points[..., 0], points[..., 1])
    found = grid.opinion_at(points)
    assert found.shape == (3, 100, 3)
    np.testing.assert_array_equal(found[inside][:, :2], grid.at(*points[inside].T))
    np.testing.assert_array_equal(found[~inside], np.tile(np.float32([0, 0, 1]), ((~inside).sum(), 1)))
    np.testing.assert_allclose(found.sum(axis=-1), 1, atol=1e-6)
    assert 50 < inside.sum() < 250
    assert grid.opinion_at((100.0, 0.0)).unknown == 1
    assert grid.opinion_at((-2.9, 1.1)) == grid.at(-2.9, 1.1)


def test_opinions_between_centres_are_means() -> None:
    grid = random_grid(6)
    x, y = np.meshgrid(*(a.ravel() for a in grid.spec.cell_centers), indexing="ij")
    centres = np.stack([x, y], axis=-1)
    np.testing.assert_allclose(grid.opinion_at(centres, "bilinear")[..., :2], grid.mass, atol=1e-6)
    between = grid.opinion_at(centres[:-1, :-1] + (0.125, 0.0625), "bilinear")
    m = grid.mass
    wanted = 0.375 * (m[:-1, :-1] + m[1:, :-1]) + 0.125 * (m[:-1, 1:] + m[1:, 1:])
    np.testing.assert_allclose(between[..., :2], wanted, atol=1e-6)
    border = grid.opinion_at(centres[0] - (0.125, 0.0), "bilinear")
    np.testing.assert_allclose(border[:, :2], grid.mass[0] / 2, atol=1e-6)  # half of it is from outside


def test_a_mapper_answers_for_the_whole_map_frame() -> None:
    grid = random_grid(2)
    mapper = EvidentialMapper(grid.spec, window="fixed")
    mapper.update(grid, np.eye(4), stamp=0.0)
    points = np.random.default_rng(1).uniform((-4, 0), (4, 7), (50, 2))
    np.testing.assert_array_equal(mapper.opinion_at(points), mapper.grid.opinion_at(points))
    np.testing.assert_array_equal(mapper.opinion_at([[99.0, 0.0]]), [[0, 0, 1]])


@each("message, call, arguments, options", [
    ("unknown must be one of obstacle, free, only", distance_to_obstacles, (), {"unknown": "none"}),
    ("unknown must be one of", costmap, (0.1, 0.5), {"unknown": "only"}),
    ("inscribed_radius must be 0 m or more and finite, got -1", costmap, (-1, 0.5), {}),
    ("inflation_radius must be 0 m or more and finite, got nan", costmap, (0.0, math.nan), {}),
    ("inflation_radius must be at least inscribed_radius, 0.5 m, got 0.4", costmap, (0.5, 0.4), {}),
    ("cost_scaling must be 0 or more", costmap, (0.5, 0.5, math.inf), {}),
    ("radius must be 0 m or more", inflated, (-0.1,), {}),
    ("footprint must be .*got shape", collision, ((1, 2, 3), [(0, 0, 0)]), {}),
    (r"footprint must be \(x_min, x_max, y_min, y_max\)", collision, ((1, -2, 3, 4), [(0, 0, 0)]), {}),
    ("footprint must be finite, got nan", collision, ((math.nan, 2, 3, 4), [(0, 0, 0)]), {}),
    ("poses must be .*got shape", collision, (VEHICLE, [(0, 0)]), {}),
    ("max_plausibility must be in", collision, (VEHICLE, [(0, 0, 0)]), {"max_plausibility": 2}),
    ("give a function as `grid`, mapper.predicted", collision, (VEHICLE, [(0, 0, 0)], [0.0]), {}),
    ("a and b must have x and y", ray_is_free, ((0, 0, 0), (1, 1, 1)), {}),
    ("points must have x and y on their last axis", EvidentialGrid.opinion_at, ((0, 0, 0),), {}),
    ("points must be finite", EvidentialGrid.opinion_at, ((0, math.inf),), {}),
    ("method must be nearest or bilinear, got 'cubic'", EvidentialGrid.opinion_at, ((0, 0), "cubic"), {}),
])  # fmt: skip
def test_impossible_questions_are_refused(message: str, call: Any, arguments: Any, options: dict[str, Any]) -> None:
    refused(message, call, random_grid(0), *arguments, **options)


def test_what_holds_no_masses_is_refused() -> None:
    for call in (distance_to_obstacles, lambda grid: costmap(grid, 0.1, 0.2), lambda grid: inflated(grid, 1)):
        refused("wanted an EvidentialGrid or a DynamicGrid, got EvidentialMapper: give mapper.grid", call,
                EvidentialMapper(GridSpec.centered()), error=TypeError)  # fmt: skip
    refused("give `seconds`", collision, lambda seconds: road(), VEHICLE, [(0, 0, 0)])
    refused("one number for each of 1 poses", collision, lambda seconds: road(), VEHICLE, [(0, 0, 0)], [0, 1])
