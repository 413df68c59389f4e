"""How the simulator observes the truth: laws of sight on small scenes, and both ways of observing compared."""

import numpy as np
from cases import each, refused

from ogm import GridSpec
from ogm.pose import pose
from ogm.simulation import cells
from ogm.simulation.cells import Aim, aimed_directions, measure_ground
from ogm.simulation.materials import Material
from ogm.simulation.mesh import Mesh, box, cylinder, empty, merge, quads
from ogm.simulation.scene import Scene
from ogm.simulation.survey import Known, aimed_truth, hd_truth
from ogm.state import CellState, Truth
from ogm.truth.boxes import boxes_seen_from, cells_in_footprint

SPEC = GridSpec.centered(20.48, 20.48, 0.16)  # 128 x 128 cells: 10 m around the sensor
VIEW = (np.deg2rad(-25.0), np.deg2rad(15.0))
SENSOR = pose(0, 0, 1.9)
BLIND = 1.9 / np.tan(-VIEW[0])  # [m] radius around the sensor that it cannot see the ground in


def rectangle(x0, x1, y0, y1, z, material) -> Mesh:
    return quads([[(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)]], material)


PLANE = rectangle(-40, 40, -40, 40, 0.0, Material.ASPHALT)


def rays(layers: int = 1000, azimuths: int = 1400) -> np.ndarray:
    """Return the directions of an HD lidar."""
    up, around = np.linspace(*VIEW, layers)[:, None], np.linspace(0, 2 * np.pi, azimuths, endpoint=False)
    parts = np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up) + 0 * around
    return np.stack(parts, axis=-1).astype(np.float32)


RAYS = rays()


class View:
    """Both ways to observe one scene from one pose."""

    def __init__(self, *things: Mesh, ground: Mesh = PLANE, T: np.ndarray = SENSOR, **known) -> None:
        self.scene, self.known = Scene(merge([ground, *things]), threads=1), known
        self.below = measure_ground(Scene(ground, threads=1), T, SPEC)

    def hd(self, **known) -> Truth:
        return hd_truth(self.scene, self.below, RAYS, Known(**self.known, **known))

    def aimed(self, **known) -> Truth:
        return aimed_truth(self.scene, self.below, VIEW, Known(**self.known, **known))

    def both(self) -> list[Truth]:
        return [self.hd(), self.aimed()]


x, y = np.broadcast_arrays(*SPEC.cell_centers)
RADIUS = np.hypot(x, y)
SEEN = RADIUS > BLIND + 0.12


# --- Sight ------------------------------------------------------------------------------------------


def test_an_open_plane_is_free_but_for_the_blind_ring() -> None:
    for truth in View().both():
        assert (truth.state[SEEN] == CellState.FREE).all()
        assert (truth.state[BLIND - 0.12 > RADIUS] == CellState.UNKNOWN).all()


def test_a_wall_shadows_what_is_behind_it() -> None:
    wall = box((5.0, -3.0, 0.0), (5.2, 3.0, 5.0), Material.BRICK)
    shadow = (x > 5.5) & (np.abs(y) < 3.0 / 5.0 * x - 0.3)
    front = (np.abs(y) < 2.8) & (np.abs(x - 5.0) < 0.08)
    clear = SEEN & (x < 4.8)
    for truth in View(wall).both():
        assert (truth.state[shadow] == CellState.UNKNOWN).all()
        assert (truth.state[front] == CellState.OCCUPIED).all()
        assert (truth.state[clear] == CellState.FREE).all()


def test_a_bridge_does_not_block() -> None:
    deck = box((4.0, -40.0, 4.5), (8.0, 40.0, 5.0), Material.CONCRETE)
    for truth, open_sky in zip(View(deck).both(), View().both(), strict=True):
        np.testing.assert_array_equal(truth.state, open_sky.state)


def test_clearance_decides_whether_an_overhang_blocks() -> None:
    decks = [View(box((5.0, -3.0, bottom), (8.0, 3.0, 2.4), Material.CONCRETE)) for bottom in (1.75, 2.05)]
    for low, high in zip(*(deck.both() for deck in decks), strict=True):
        assert np.count_nonzero(low.state == CellState.OCCUPIED) > 30
        assert np.count_nonzero(high.state == CellState.OCCUPIED) == 0


def kerb(rise: float, turn: float) -> tuple[Mesh, Mesh]:
    """Make a road with a kerb 6 m ahead of which the upright face shows, and the sidewalk behind it."""
    line = 5.03
    road = rectangle(-40, line, -40, 40, 0.0, Material.ASPHALT)
    walk = rectangle(line, 40, -40, 40, rise, Material.PAVING)
    face = quads([[(line, -40, 0), (line, 40, 0), (line, 40, rise), (line, -40, rise)]], Material.KERB)
    T = pose(yaw=turn)
    return merge([road, walk]).moved(T), face.moved(T)


@each("turn", [0.0, 0.3, np.pi / 4, 2.0])
def test_a_kerb_is_one_unbroken_line(turn: float) -> None:
    ground, face = kerb(0.12, turn)
    far = np.cos(turn) * x + np.sin(turn) * y - 5.03  # [m] beyond the kerb's line
    for truth in View(face, ground=ground).both():
        occupied = truth.state == CellState.OCCUPIED
        assert np.abs(far[occupied]).max() <= 0.115
        along = (np.cos(turn) * y - np.sin(turn) * x)[occupied]
        assert np.diff(np.sort(along)).max() < 0.33
        # those cells through the middle of which it runs are all there
        assert occupied[(np.abs(far) < 0.06) & (RADIUS < 9)].mean() > 0.97
        assert (truth.state[SEEN & (np.abs(far) > 0.12)] == CellState.FREE).all()


def test_heights_are_those_of_the_obstacles_and_of_a_kerb_its_rise() -> None:
    ground, face = kerb(0.12, 0.0)
    bench = box((-4.0, -1.0, 0.0), (-3.9, 1.0, 0.4), Material.STONE)
    wall = box((-1.0, 5.0, 0.0), (1.0, 5.1, 4.0), Material.BRICK)
    for truth in View(face, bench, wall, ground=ground).both():
        found = np.where(truth.state == CellState.OCCUPIED, truth.height_cm, 0)
        assert set(np.unique(found[(x > 4.5) & (np.abs(y) < 3)])) == {0, 12}
        assert 36 <= found[(np.abs(x + 3.95) < 0.3) & (np.abs(y) < 0.8)].max() <= 40
        assert (found[(np.abs(y - 5) < 0.3) & (np.abs(x) < 0.8)].reshape(-1, 4).max(axis=1) > 170).all()


def test_a_dropped_kerb_is_none() -> None:
    ground, face = kerb(0.02, 0.3)
    for truth in View(face, ground=ground).both():
        assert np.count_nonzero(truth.state == CellState.OCCUPIED) == 0
        assert (truth.state[SEEN] == CellState.FREE).mean() > 0.999


def test_poles_and_fences_are_seen_and_seen_through() -> None:
    poles = [
        cylinder((6 * np.cos(a), 6 * np.sin(a), 0), (6 * np.cos(a), 6 * np.sin(a), 4), 0.04, Material.METAL_POLE)
        for a in np.arange(12) * np.pi / 6 + 0.05
    ]
    for truth in View(*poles).both():
        for a in np.arange(12) * np.pi / 6 + 0.05:
            near = np.hypot(x - 6 * np.cos(a), y - 6 * np.sin(a)) < 0.16
            assert (truth.state[near] == CellState.OCCUPIED).any()
        assert (truth.state[SEEN & (RADIUS > 6.3)] == CellState.FREE).mean() > 0.95


def test_grass_may_be_driven_over_and_a_hedge_not() -> None:
    tufts = box((5.0, -2.0, 0.0), (6.0, 0.0, 0.12), Material.FOLIAGE)
    hedge = box((5.0, 0.5, 0.0), (6.0, 2.0, 1.0), Material.FOLIAGE)
    for truth in View(tufts, hedge).both():
        assert (truth.state[(np.abs(x - 5.5) < 0.4) & (np.abs(y + 1.0) < 0.8)] == CellState.FREE).all()
        assert (truth.state[(np.abs(x - 5.0) < 0.08) & (np.abs(y - 1.25) < 0.6)] == CellState.OCCUPIED).all()


def test_ground_beyond_a_crest_is_unknown() -> None:
    up = quads([[(3, -40, 0), (6, -40, 0.8), (6, 40, 0.8), (3, 40, 0)]], Material.ASPHALT)
    down = quads([[(6, -40, 0.8), (9, -40, -1), (9, 40, -1), (6, 40, 0.8)]], Material.ASPHALT)
    ground = merge([rectangle(-40, 3, -40, 40, 0, Material.ASPHALT), up, down])
    for truth in View(ground=ground).both():
        assert (truth.state[(x > 6.4) & (x < 8.8) & (np.abs(y) < 5)] == CellState.UNKNOWN).all()
        assert (truth.state[(x > 4.5) & (x < 5.8) & (np.abs(y) < 5)] == CellState.FREE).all()
        assert np.count_nonzero(truth.state == CellState.OCCUPIED) == 0


def test_turning_scene_and_sensor_together_leaves_the_truth_unchanged() -> None:
    ground, face = kerb(0.12, 0.4)
    things = [face, box((-6.03, -3.07, 0), (-4.1, 1.03, 2.6), Material.PAINT_LIGHT)]
    here = View(*things, ground=ground)
    T = pose(120.0, -80.0, 6.0, yaw=2.3, pitch=0.05)
    there = View(*(thing.moved(T) for thing in things), ground=ground.moved(T), T=T @ SENSOR)
    for one, other in zip(here.both(), there.both(), strict=True):
        assert (one.state == other.state).mean() > 0.999  # rounding moves hits on edges of cells


def test_cells_beyond_the_end_of_the_world_are_ignored() -> None:
    island = rectangle(-40, 5.0, -40, 40, 0.0, Material.GRASS)
    for truth in View(ground=island).both():
        assert (truth.state[x > 5.2] == CellState.IGNORE).all()
        assert (truth.state[SEEN & (x < 4.9)] == CellState.FREE).all()
        assert not truth.ignored[x < 4.9].any()


# --- Both ways --------------------------------------------------------------------------------------


def test_both_ways_agree_where_both_know() -> None:
    ground, face = kerb(0.12, 0.3)
    car = box((-2.2, -0.9, 0.3), (2.2, 0.9, 2.5), Material.PAINT_DARK).moved(pose(-6, 2, 0, yaw=0.5))
    hd, aimed = View(face, car, ground=ground).both()
    known = hd.known & aimed.known
    assert known.mean() > 0.6
    assert (hd.state == aimed.state)[known].mean() > 0.998
    assert (hd.known == aimed.known).mean() > 0.985


def test_participants_are_filled_by_their_returns_in_the_input() -> None:
    van = box((-2.2, -0.9, 0.0), (2.2, 0.9, 2.6), Material.PAINT_DARK)
    place = pose(6, 3, 0, yaw=0.5)
    view = View(ego=cells_in_footprint((-2.25, 2.25, -0.9, 0.9), SPEC))
    view.scene.place([van.moved(place)], box((-2.2, -0.9, 0.2), (2.2, 0.9, 1.45), Material.EGO_VEHICLE))
    boxes = boxes_seen_from(np.linalg.inv(SENSOR), [place], [[4.4, 1.8, 2.6]])
    inside = np.abs(np.cos(0.5) * (x - 6) + np.sin(0.5) * (y - 3)) < 2.0
    inside &= np.abs(np.cos(0.5) * (y - 3) - np.sin(0.5) * (x - 6)) < 0.7
    for observe in (view.hd, view.aimed):
        full, partial = (observe(boxes=boxes, returns=np.array([n])).state for n in (50, 49))
        assert (full[inside] == CellState.OCCUPIED).all()
        assert (partial[inside] == CellState.UNKNOWN).any()
        assert (partial == CellState.OCCUPIED).sum() > 15
        assert (full[(np.abs(x) < 2.2) & (np.abs(y) < 0.8)] == CellState.IGNORE).all()


def test_results_do_not_depend_on_threads_or_on_earlier_calls() -> None:
    ground, face = kerb(0.12, 0.3)
    glass = box((4, 2, 0.2), (6, 3, 1.5), Material.CAR_GLASS)
    view = View(face, glass, ground=ground)
    first = view.both()
    again = view.both()
    view.scene = Scene(merge([ground, face, glass]), threads=2)
    for one, two, three in zip(first, again, view.both(), strict=True):
        np.testing.assert_array_equal(one.state, two.state)
        np.testing.assert_array_equal(one.state, three.state)


# --- Pieces -----------------------------------------------------------------------------------------


def test_rays_down_find_ground_steps_and_holes() -> None:
    ground, _ = kerb(0.12, 0.0)
    found = measure_ground(Scene(ground), SENSOR, SPEC)
    np.testing.assert_allclose(found.z, np.where(x < 5.03, -1.9, -1.78), atol=1e-4)
    step = np.abs(x - 5.03) < 0.1
    np.testing.assert_allclose(found.rise[step], 0.12, atol=1e-4)
    np.testing.assert_allclose(found.ground[step], -1.9, atol=1e-4)
    assert (found.rise[np.abs(x - 5.03) > 0.3] < 1e-4).all()
    torn = Scene(
        merge([rectangle(-40, 3.0, -40, 40, 0.0, Material.SOIL), rectangle(3.15, 40, -40, 40, 0.0, Material.SOIL)])
    )
    torn_z = measure_ground(torn, SENSOR, SPEC).z
    np.testing.assert_allclose(torn_z, -1.9, atol=1e-4)
    nothing = measure_ground(Scene(empty()), SENSOR, SPEC)
    assert np.isnan(nothing.z).all()
    assert np.isnan(nothing.ground).all()
    assert (nothing.rise == 0).all()


def test_rays_aim_at_the_chosen_points_within_the_field_of_view() -> None:
    z = np.full(SPEC.shape, -1.9, np.float32)
    chosen = np.zeros(SPEC.shape, bool)
    chosen[100, 30] = chosen[64, 64] = chosen[10, 10] = True  # the second is under the sensor
    z[10, 10] = np.nan
    directions = aimed_directions(z, SPEC, Aim(0.4, 0.25, -0.25), VIEW, chosen)
    cx, cy = SPEC.cell_centers
    target = np.array([cx[100, 0] + 0.04, cy[0, 30] - 0.04, -1.5])
    np.testing.assert_allclose(directions, [target / np.linalg.norm(target)], atol=1e-6)


def test_kernels_do_the_same_uncompiled() -> None:
    spec = GridSpec.centered(3.2, 3.2, 0.16)
    z = np.random.default_rng(0).uniform(-2, -1.5, spec.shape).astype(np.float32)
    z[3, 4] = np.nan
    numbers = (z, z > -1.8, (spec.resolution, *spec.origin), Aim(0.3, 0.1, -0.2), -0.9, 0.5)
    rays = [np.zeros((z.size, 3), np.float32) for _ in range(2)]
    assert cells._aim(rays[0], *numbers) == cells._aim.py_func(rays[1], *numbers) > 50
    np.testing.assert_allclose(*rays, rtol=1e-6)


def test_no_ray_leaves_the_field_of_view() -> None:
    z = np.full(SPEC.shape, -1.9, np.float32)
    chosen = np.ones(SPEC.shape, bool)
    for aim in (Aim(0.0), Aim(1.2), Aim(3.0, 0.4, 0.4)):
        sine = aimed_directions(z, SPEC, aim, VIEW, chosen)[:, 2]
        assert sine.min() >= np.sin(VIEW[0]) - 1e-6
        assert sine.max() <= np.sin(VIEW[1]) + 1e-6


@each("T", [np.eye(3), 2 * np.eye(4), np.full((4, 4), np.nan)])
def test_a_pose_that_is_none_is_refused(T: np.ndarray) -> None:
    refused("T_world_sensor", measure_ground, View().scene, T, SPEC)


@each("view", [(0.3, -0.3), (-2.0, 0.2), (float("nan"), 0.2)])
def test_an_impossible_field_of_view_is_refused(view: tuple) -> None:
    scene = View()
    refused("elevations", aimed_truth, scene.scene, scene.below, view)
