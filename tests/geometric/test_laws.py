"""What every geometric model promises, on scenes small enough to draw by hand."""

import math
from importlib.resources import as_file, files

import numpy as np
import pytest
from cases import each

from ogm import GridSpec, Mount, Scan, read_points
from ogm.geometric import HeightBandISM, RayISM, flat_ground
from ogm.pose import pose

SPEC = GridSpec.centered(7.0, 7.0, 1.0)  # 7 x 7 cells, the sensor in the middle of (3, 3)
HEIGHT = 1.5
MOUNT = Mount(HEIGHT)
NO_POINTS = np.zeros((0, 4), np.float32)
NO_FOOTPRINT = (0.0, 0.0, 0.0, 0.0)


def at(*cells: tuple[float, float, float]) -> np.ndarray:
    """Points by x, y and height above ground."""
    return np.array([(x, y, z - HEIGHT, 0.5) for x, y, z in cells], np.float32).reshape(-1, 4)


def drawing(grid) -> list[str]:
    """The grid as text: row 0 the front, column 0 the left."""
    signs = np.full(grid.spec.shape, ".")
    signs[grid.free > 0.1] = "f"
    signs[grid.occupied > 0.1] = "O"
    return ["".join(row) for row in signs[::-1, ::-1]]


def test_height_band_by_hand() -> None:
    points = at((3, 0, 1.0), (0, 2, 1.9), (-3, -3, 0.6), (0, -2, 0.4), (0, -3, 2.1))
    assert drawing(HeightBandISM(SPEC, MOUNT)(points)) == [
        "...O...",
        "...f...",
        "...f...",
        ".Off...",
        "....f..",
        ".....f.",
        "......O",
    ]


def test_height_band_evidence_is_a_belief() -> None:
    points = at((3, 0, 1.0))
    for evidence, belief in ((1.0, 1 / 3), (10.0, 10 / 12), (2.0, 0.5)):
        grid = HeightBandISM(SPEC, MOUNT, evidence=evidence)(points)
        assert grid.occupied.max() == pytest.approx(belief)
        assert grid.free.max() == pytest.approx(belief)
        assert grid.at(3, 0).occupied == pytest.approx(belief)


def test_height_band_clears_up_to_the_border_for_returns_beyond_and_stops_at_the_first_obstacle() -> None:
    """A return beyond the border whose way is blocked clears nothing behind, its exit cell included."""
    ism = HeightBandISM(SPEC, MOUNT)
    assert drawing(ism(at((9, 0, 1.0))))[:4] == ["...f...", "...f...", "...f...", "...f..."]
    assert drawing(ism(at((9, 0, 1.0), (2, 0, 1.0))))[:4] == [".......", "...O...", "...f...", "...f..."]


def test_the_released_code_never_exceeds_a_third() -> None:
    spec = GridSpec.centered(8.0, 8.0, 0.5)
    ism = HeightBandISM.as_released(spec)
    points = np.array([(3.4, 0.1, 0.0, 0), (3.4, 0.1, 0.4, 0), (2.9, 0.0, 0.0, 0), (-3.2, 1.0, -1.0, 0)], np.float32)
    grid = ism(points)
    assert grid.spec == spec
    assert grid.mass.max() <= 1 / 3 + 1e-6
    assert grid.at(3.4, 0.1).occupied == pytest.approx(0.25 / 2.5, abs=0.02)  # one of four small cells, one free
    assert grid.at(2.9, 0.0).occupied == 0  # nearer than 3 m
    assert grid.at(-3.2, 1.0).occupied > 0


def test_free_cells_lie_before_the_first_hit() -> None:
    """A wall ahead: free before it, marked at it, unknown behind it."""
    spec = GridSpec.centered(20.0, 20.0, 0.25)
    wall = [(6.0, y, z) for y in np.arange(-4, 4, 0.05) for z in np.arange(0.2, 3.0, 0.1)]
    ground = [(x, y, 0.0) for x in np.arange(2.5, 6.0, 0.2) for y in np.arange(-4, 4, 0.1) if abs(y) < 0.6 * x]
    grid = RayISM(spec, MOUNT)(at(*wall, *ground))
    assert grid.at(4.0, 0.5).free > 0.9
    assert grid.at(6.1, 0.0).occupied > 0.75
    behind = grid.mass[spec.index(7.0, 0)[0] :, slice(*spec.index(0, [-3.0, 3.0])[1])]
    assert (behind == 0).all()


def test_ground_returns_clear_and_do_not_mark() -> None:
    spec = GridSpec.centered(20.0, 20.0, 0.5)
    ring = [(6 * math.cos(a), 6 * math.sin(a), 0.0) for a in np.arange(0, 2 * math.pi, 0.002)]
    grid = RayISM(spec, MOUNT)(at(*ring))
    assert grid.occupied.max() == 0
    assert grid.at(6.0, 0.2).free > 0.7
    assert grid.at(7.0, 0.2).free == 0
    band = HeightBandISM(spec, MOUNT)(at(*ring))
    assert (band.mass == 0).all()  # the baseline learns nothing from ground


def test_overhanging_structure_does_not_mark_and_its_rays_still_clear() -> None:
    spec = GridSpec.centered(20.0, 20.0, 0.5)
    bridge = [(5.0, y, z) for y in np.arange(-2, 2, 0.01) for z in (2.2, 4.0)]
    grid = RayISM(spec, Mount(1.9))(at(*bridge) + np.float32([0, 0, HEIGHT - 1.9, 0]))
    assert grid.occupied.max() == 0
    assert grid.at(3.0, 0.2).free < 0.2  # nearly level rays at 1.9 m hardly clear the ground
    assert grid.at(9.0, 0.0).free == 0


def test_a_ray_clears_less_the_higher_it_passes() -> None:
    spec = GridSpec.centered(40.0, 4.0, 0.5)
    ism = RayISM(spec, Mount(1.8), ground=flat_ground)
    fan = np.array([(18.0, y, -1.8, 0) for y in np.linspace(-0.3, 1.8, 4000)], np.float32)
    free = ism(fan).free[spec.index(6.0, 0)[0] : spec.index(17.0, 0)[0], 4]
    assert (np.diff(free) > 0).mean() > 0.9  # the rays come down, and clear more
    np.testing.assert_allclose(free, 1 - 1.8 * (1 - np.arange(6.25, 17, 0.5) / 18) / 2, atol=0.1)


def test_returns_from_the_ego_vehicle_are_dropped_and_its_cells_stay_unknown() -> None:
    spec = GridSpec.centered(20.0, 20.0, 0.25)
    ego = at((1.0, 0.5, 1.4), (-1.2, -0.9, 1.0))
    assert (RayISM(spec, MOUNT)(ego).mass == 0).all()
    assert RayISM(spec, Mount(HEIGHT, ego_footprint=NO_FOOTPRINT))(ego).occupied.max() > 0.5
    assert HeightBandISM(spec, MOUNT)(ego).occupied.max() > 0.5  # the paper's text drops none
    assert (HeightBandISM(spec, MOUNT, drop_ego_returns=True)(ego).mass == 0).all()


def test_returns_far_below_ground_have_no_effect() -> None:
    spec = GridSpec.centered(20.0, 20.0, 0.5)
    assert (RayISM(spec, MOUNT)(at((6.0, 0.3, -3.0), (4.0, 2.0, -25.0))).mass == 0).all()


def test_beams_without_echo_clear_the_ground_they_pass() -> None:
    spec = GridSpec.centered(40.0, 40.0, 0.5)
    ism = RayISM(spec, MOUNT, max_range=15.0, no_return_weight=1.0)
    level = np.array([(math.cos(a), math.sin(a), -0.05) for a in np.linspace(0, 0.2, 400)], np.float32)
    level /= np.linalg.norm(level, axis=1, keepdims=True)
    grid = ism(Scan(NO_POINTS, no_returns=level))
    assert grid.at(10.0, 1.0).free > 0.3
    assert grid.at(18.0, 1.0).free == 0  # beyond max_range
    assert grid.at(-10.0, 1.0).free == 0
    down = np.array([(math.cos(0.1), math.sin(0.1), -0.5)], np.float32).repeat(400, axis=0)
    assert ism(Scan(NO_POINTS, no_returns=down)).at(10.0, 1.0).free == 0  # behind where it met the ground


def test_beams_without_echo_add_the_share_that_their_source_is_reliable() -> None:
    spec = GridSpec.centered(40.0, 40.0, 0.5)
    beams = np.array(
        [(1, a, -0.02 - 0.03 * (k % 7) / 7) for k, a in enumerate(np.linspace(-0.2, 0.2, 900))], np.float32
    )
    beams /= np.linalg.norm(beams, axis=1, keepdims=True)
    road = at(*[(r, a * r, 0.0) for r in (4.0, 12.0) for a in np.arange(-0.2, 0.2, 0.004)])

    def free(weight: float) -> np.ndarray:
        return RayISM(spec, MOUNT, ground=flat_ground, no_return_weight=weight)(Scan(road, no_returns=beams)).free

    alone, together = free(0.0), free(1.0)
    np.testing.assert_array_equal(alone, RayISM(spec, MOUNT, ground=flat_ground)(road).free)
    assert (together - alone).max() > 0.3
    is_capped = together >= 0.97
    np.testing.assert_allclose(free(0.25)[~is_capped], (0.75 * alone + 0.25 * together)[~is_capped], atol=1e-5)


def in_fog(visibility: float) -> Scan:
    """Return a scan of level ground in fog: all echoes up to some distance, none beyond, none from the sky."""
    azimuth, fall = np.meshgrid(np.linspace(-0.4, 0.4, 400), np.linspace(-0.03, 0.4, 80))
    beams = np.stack([np.cos(azimuth), np.sin(azimuth), -fall], -1).reshape(-1, 3)
    reach = np.where(beams[:, 2] < 0, -HEIGHT / np.minimum(beams[:, 2], -1e-9), np.inf)
    echo = reach < visibility
    road = np.pad(beams[echo] * reach[echo, None], ((0, 0), (0, 1))).astype(np.float32)
    return Scan(
        road, no_returns=(beams[~echo] / np.linalg.norm(beams[~echo], axis=1, keepdims=True)).astype(np.float32)
    )


def test_silence_tells_nothing_from_where_the_ground_gives_no_echo() -> None:
    """A lidar that gets no echo of the ground beyond 12 m would get none of an obstacle there."""
    spec = GridSpec.centered(60.0, 40.0, 0.5)
    ism = RayISM(spec, MOUNT, no_return_weight=1.0)
    clear, fog = ism(in_fog(60.0)), ism(in_fog(12.0))
    for x in (5.0, 9.0):
        assert fog.at(x, 1.1).free == pytest.approx(clear.at(x, 1.1).free, abs=0.02)
    assert clear.at(25.0, 1.1).free > 0.8
    assert fog.mass[spec.index(14.0, 0.0)[0] :].max() == 0


def test_where_all_of_the_ground_gives_echoes_silence_has_its_whole_weight() -> None:
    spec, whole = GridSpec.centered(60.0, 40.0, 0.5), in_fog(60.0)
    sky = Scan(whole.points[:0], no_returns=whole.no_returns)  # the same beams, and nothing to compare with
    free = [RayISM(spec, MOUNT, ground=flat_ground)(one).free for one in (whole, sky, Scan(whole.points))]
    assert (free[0] >= free[1] - 1e-6).all()
    assert (free[0] > free[2]).any()


def test_a_black_car_that_swallows_its_beams_is_not_free() -> None:
    """The road returns all around; beams into the car at 8 to 12 m return nothing, and are known to."""
    spec = GridSpec.centered(40.0, 40.0, 0.5)
    azimuth, fall = np.meshgrid(np.arange(-0.3, 0.3, 0.004), np.linspace(0.05, 0.6, 40))
    beams = np.stack([np.cos(azimuth), np.sin(azimuth), -fall], -1).reshape(-1, 3)
    reach = HEIGHT / beams[:, 2] * -1
    height = HEIGHT + beams[:, 2] * 8.0  # where they enter the car
    is_swallowed = (np.abs(beams[:, 1] / beams[:, 0] * 8.0) < 1.0) & (reach > 8.0) & (height < 1.4)
    road = np.pad(beams[~is_swallowed] * reach[~is_swallowed, None], ((0, 0), (0, 1))).astype(np.float32)
    silent = (beams / np.linalg.norm(beams, axis=1, keepdims=True))[is_swallowed].astype(np.float32)
    grid = RayISM(spec, MOUNT)(Scan(road, no_returns=silent))
    car = (slice(spec.index(8.6, 0)[0], spec.index(12.0, 0)[0]), slice(*spec.index(0, [-0.5, 0.5])[1]))
    assert grid.free[car].max() < 0.5
    assert grid.at(6.0, 0.2).free > 0.8
    assert grid.at(10.0, 2.2).free > 0.7


def test_what_hangs_behind_an_obstacle_is_not_called_free() -> None:
    """A platform at 0.75 to 1.25 m stops rays; those under it reach the road behind, which stays unknown for 8 m."""
    spec = GridSpec.centered(60.0, 20.0, 0.25)
    azimuth, fall = np.meshgrid(np.arange(-0.4, 0.4, 0.004), np.linspace(0.02, 0.6, 60))
    slope = -fall.ravel()
    beams = np.stack([np.cos(azimuth), np.sin(azimuth), -fall], -1).reshape(-1, 3)
    stop = np.abs(1.0 - (1.9 + slope * 6.0)) < 0.25
    run = np.where(stop, 6.0, 1.9 / -slope)
    points = np.pad(beams * run[:, None], ((0, 0), (0, 1))).astype(np.float32)
    ism, clear = RayISM(spec, Mount(1.9)), np.pad(beams * (1.9 / -slope)[:, None], ((0, 0), (0, 1)))
    grid, before = ism(points), ism(clear.astype(np.float32))
    assert grid.at(6.1, 0.1).occupied > 0.75
    for x in (7.0, 8.0, 9.0):
        assert before.at(x, 0.1).free > 0.8
        assert grid.at(x, 0.1).free < 0.5 * before.at(x, 0.1).free
    assert grid.at(4.0, 0.1).free == pytest.approx(before.at(4.0, 0.1).free, abs=0.02)
    assert grid.at(15.5, 0.1).free > 0.7


def test_an_obstacle_hides_nothing_before_it() -> None:
    """A sensor at 5 m: a return 1.9 m above ground at 18 m takes nothing from the road at 10 m."""
    spec = GridSpec.centered(60.0, 10.0, 0.5)
    ism = RayISM(spec, Mount(5.0), ground=flat_ground)
    road = [(x, y, -5.0, 0) for x in np.arange(6, 17, 0.25) for y in np.arange(-1, 1, 0.02)]
    roof = [(18.0, y, -3.1, 0) for y in np.arange(-1, 1, 0.02)]
    alone, both = ism(np.array(road, np.float32)), ism(np.array(road + roof, np.float32))
    near = slice(0, spec.index(16.0, 0)[0])
    np.testing.assert_allclose(both.free[near], alone.free[near], atol=1e-5)


def shipped_scan() -> np.ndarray:
    with as_file(files("ogm") / "data" / "vls128_road.pcd.xz") as path:
        return read_points(path)


def test_the_order_of_the_points_does_not_matter() -> None:
    points, ism = shipped_scan(), RayISM(GridSpec.centered(81.92, 56.32, 0.16), Mount(1.98))
    expected = ism(points).mass
    assert (expected > 0.5).any(axis=(0, 1)).all()
    for seed in range(2):
        shuffled = np.random.default_rng(seed).permutation(points)
        np.testing.assert_allclose(ism(shuffled).mass, expected, atol=1e-3)


@each("count", [0, 1, 7, 5000])
def test_threads_do_not_change_a_bit(count: int) -> None:
    rng = np.random.default_rng(count)
    azimuth, run = rng.uniform(0, 2 * math.pi, count), rng.uniform(1, 40, count)
    z = rng.choice([0, 0, 0, 0.15, 0.6, 1.5, 3.0, -2.0], count) + rng.normal(0, 0.02, count) - HEIGHT
    points = np.stack([run * np.cos(azimuth), run * np.sin(azimuth), z, 0 * z], 1).astype(np.float32)
    beams = rng.normal(0, [1, 1, 0.1], (200, 3))
    beams = (beams / np.linalg.norm(beams, axis=1, keepdims=True)).astype(np.float32)
    scan, spec = Scan(points, no_returns=beams), GridSpec.centered(40.0, 30.0, 0.25)
    expected = RayISM(spec, MOUNT)(scan).mass
    for threads in (2, 3):
        np.testing.assert_array_equal(RayISM(spec, MOUNT, threads=threads)(scan).mass, expected)


@each("threads", [0, 1.5])
def test_a_number_of_threads_is_whole_and_positive(threads: float) -> None:
    with pytest.raises(ValueError, match="threads must be a whole number of at least 1"):
        RayISM(SPEC, MOUNT, threads=threads)


def test_one_point_matters_only_near_it_and_in_its_direction() -> None:
    """Without it, no cell changes that is more than 3 m from it and 3 sectors from its own."""
    spec, sectors = GridSpec.centered(81.92, 56.32, 0.16), 1024
    points, ism = shipped_scan(), RayISM(spec, Mount(1.98))
    per_turn, (cx, cy) = sectors / (2 * math.pi), spec.cell_centers
    azimuth, run = np.arctan2(cy, cx) * per_turn, np.hypot(cx, cy)
    expected, inside = ism(points).mass, np.flatnonzero(spec.contains(points[:, 0], points[:, 1]))
    for n in np.random.default_rng(0).choice(inside, 15, replace=False):
        x, y = points[n, :2].astype(float)
        own = int(math.atan2(y, x) % (2 * math.pi) * per_turn) + 0.5
        apart = np.abs((azimuth - own + sectors / 2) % sectors - sectors / 2)
        is_far = (apart > 3.5 + 0.16 / run / 2 * per_turn + 0.5) & (np.hypot(cx - x, cy - y) > 3)
        change = np.abs(ism(np.delete(points, n, axis=0)).mass - expected).max(axis=-1)
        assert change[is_far].max() < 1e-3


@each("quarter", [1, 2, 3])
@each("model", [HeightBandISM, RayISM])
def test_rotating_points_rotates_the_grid(model: type, quarter: int) -> None:
    rng = np.random.default_rng(5)
    spec = GridSpec.centered(20.5, 20.5, 0.5)  # odd: the sensor in the middle of a cell
    points = at(*rng.uniform((-9, -9, -0.05), (9, 9, 2.5), (400, 3)))
    ism = model(spec, Mount(HEIGHT, ego_footprint=NO_FOOTPRINT))
    turned = points.copy()
    for _ in range(quarter):
        turned[:, 0], turned[:, 1] = -turned[:, 1], turned[:, 0].copy()
    expected, got = np.rot90(ism(points).mass, quarter), ism(turned).mass
    assert np.abs(got - expected).mean() < 0.02  # ties on lines and cell edges fall another way
    assert (np.abs(got - expected) > 0.3).any(-1).mean() < 0.03


def test_points_in_the_vehicles_frame_give_the_same_grid() -> None:
    rng = np.random.default_rng(6)
    spec = GridSpec.centered(30.0, 30.0, 0.5)
    T = pose(1.3, 0.2, 1.6, pitch=0.03, yaw=0.4)
    sensor = at(*rng.uniform((-12, -12, 0), (12, 12, 3), (500, 3)))
    vehicle = sensor.copy()
    vehicle[:, :3] = sensor[:, :3] @ T[:3, :3].T + T[:3, 3]
    for model in (HeightBandISM, RayISM):
        one = model(spec, Mount(HEIGHT, T))(sensor)
        other = model(spec, Mount(HEIGHT, T, points_in="vehicle"))(vehicle)
        assert (np.abs(one.mass - other.mass) > 1e-3).any(-1).mean() < 0.01


def test_rays_start_at_the_sensor_and_not_at_the_vehicles_origin() -> None:
    spec = GridSpec.centered(20.0, 20.0, 0.5)
    ism = HeightBandISM(spec, Mount(1.5, pose(4.0, 0.0, 1.5), points_in="vehicle"))
    grid = ism(np.array([[4.2, 6.2, 1.0, 0]], np.float32))
    assert grid.at(4.2, 3.0).free > 0
    assert grid.at(2.0, 3.0).free == 0


def test_a_pitched_mount_is_levelled() -> None:
    spec = GridSpec.centered(30.0, 30.0, 0.5)
    ring = np.array([(8 * math.cos(a), 8 * math.sin(a), -1.5, 0) for a in np.arange(0, 6.28, 0.01)])
    T = pose(0, 0, 0, pitch=0.2)
    tilted = ring.copy()
    tilted[:, :3] = ring[:, :3] @ T[:3, :3]
    grid = RayISM(spec, Mount(1.5, T), ground=flat_ground)(tilted.astype(np.float32))
    assert grid.occupied.max() == 0
    assert RayISM(spec, Mount(1.5), ground=flat_ground)(tilted.astype(np.float32)).occupied.max() > 0.5


def test_passing_rays_lower_the_belief_in_a_lone_return_only_as_far_as_they_are_reliable() -> None:
    spec = GridSpec.centered(20.0, 20.0, 0.5)
    scene = at(*[(8.0, 0.001 * k, 0.0) for k in range(800)], (6.2, 0.2, 0.5))

    def lone(reliability: float):
        return RayISM(spec, MOUNT, ground=flat_ground, free_reliability_at_hits=reliability)(scene).at(6.2, 0.2)

    assert lone(0.0).occupied == pytest.approx(0.95)
    assert lone(1.0).occupied < 0.45
    assert lone(1.0).unknown > 0.3  # the conflict goes to unknown (Yager)
    assert lone(1.0).occupied < lone(0.2).occupied < lone(0.0).occupied


@each("height", [1.9, 3.0, 5.0])
def test_rays_above_clearance_take_nothing_from_what_others_clear(height: float) -> None:
    """A facade behind free ground, hit well above clearance, changes no cell before it."""
    spec = GridSpec.centered(80.0, 4.0, 0.5)
    ism = RayISM(spec, Mount(height), ground=flat_ground)
    ground = [(x, y, -height, 0) for x in np.arange(6, 30, 0.5) for y in np.arange(-1, 1, 0.02)]
    facade = [(38.0, y, z - height, 0) for z in (2.2, 3.0, 6.0) for y in np.arange(-2, 2, 0.02)]
    alone = ism(np.array(ground, np.float32))
    both = ism(np.array(ground + facade, np.float32))
    near = slice(0, spec.index(30.0, 0)[0])
    assert (both.free[near] >= alone.free[near] - 1e-6).all()
    assert alone.at(15.0, 0.1).free > 0.8


def test_on_a_falling_road_high_rays_take_nothing_either() -> None:
    spec = GridSpec.centered(80.0, 4.0, 0.5)
    ism = RayISM(spec, Mount(1.9))
    x, y = np.meshgrid(np.arange(4, 36, 0.25), np.arange(-1.5, 1.5, 0.05))
    road = np.stack([x, y, -1.9 - 0.1 * x, 0 * x], -1).reshape(-1, 4)
    facade = np.array([(38.0, b, -1.9 - 3.8 + c, 0) for b in np.arange(-1.5, 1.5, 0.02) for c in (2.5, 3.0, 4.0)])
    alone = ism(road.astype(np.float32))
    both = ism(np.concatenate([road, facade]).astype(np.float32))
    near = slice(0, spec.index(34.0, 0)[0])
    assert (both.free[near] >= alone.free[near] - 0.05).all()
    assert alone.at(26.0, 0.1).free > 0.4


def test_directions_of_beams_without_echo_turn_with_the_mount() -> None:
    spec = GridSpec.centered(40.0, 40.0, 0.5)
    ism = RayISM(spec, Mount(HEIGHT, pose(yaw=math.pi / 2)), no_return_weight=1.0)
    ahead = np.array([(math.cos(a), math.sin(a), -0.05) for a in np.linspace(-0.1, 0.1, 400)], np.float32)
    grid = ism(Scan(NO_POINTS, no_returns=ahead))
    assert grid.at(0.1, 10.0).free > 0.3
    assert grid.at(10.0, 0.1).free == 0


def test_no_mass_exceeds_its_bound() -> None:
    spec = GridSpec.centered(20.0, 20.0, 0.5)
    scene = at(*[(6.2, 0.2, z) for z in np.linspace(0.2, 1.9, 400)], *[(8.0, 0.001 * k, 0.0) for k in range(4000)])
    grid = RayISM(spec, MOUNT, max_mass=0.6)(scene)
    assert grid.occupied.max() == pytest.approx(0.6)
    assert grid.free.max() == pytest.approx(0.6)


def test_the_released_codes_numbers() -> None:
    """Band -1.11 to 0.39 m around the sensor, nothing nearer than 3 m (EviLOG, naive_geometric_ISM)."""
    spec = GridSpec.centered(8.0, 8.0, 0.5)
    ism = HeightBandISM.as_released(spec)
    for z, marks in ((-1.12, False), (-1.10, True), (0.38, True), (0.40, False)):
        assert (ism(np.array([[3.6, 0.1, z, 0]], np.float32)).occupied.max() > 0) == marks
    for x, marks in ((2.98, False), (3.02, True)):
        assert (ism(np.array([[x, 0.0, 0.0, 0]], np.float32)).occupied.max() > 0) == marks


@each("edge", [9.99999999, 0.0, 1e-9, 9.9999])
def test_a_sensor_on_the_grids_edge(edge: float) -> None:
    """Its cell is found in float64: rounding must not carry it off the grid."""
    spec = GridSpec(0.5, (20, 20), (0.0, 0.0))
    points = np.array([(x, y, -0.9, 0) for x in (-4, -0.3, 0.3, 4) for y in (-4, -0.3, 0.3, 4)], np.float32)
    for T in (pose(edge, 5.2), pose(5.2, edge)):
        assert HeightBandISM(spec, Mount(HEIGHT, T))(points).occupied.any()
        assert RayISM(spec, Mount(HEIGHT, T), ground=flat_ground)(points).occupied.any()
        assert RayISM(spec, Mount(HEIGHT, T))(points).free.any()
