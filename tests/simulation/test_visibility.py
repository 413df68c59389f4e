"""What a scan can see: laws of sectors, fog, dust and reach, against plain formulas."""

import math
from dataclasses import replace

import numpy as np
import pytest
from cases import each, refused

from ogm import GridSpec
from ogm.pose import pose
from ogm.simulation.cells import measure_ground, steep_cells
from ogm.simulation.kernels import View, beams_in_dust, in_view, lose_sight, make_view
from ogm.simulation.lidar import scan, to_points
from ogm.simulation.materials import Material
from ogm.simulation.mesh import Mesh, box, merge, quads
from ogm.simulation.scene import Scene
from ogm.simulation.sensors import LIDARS
from ogm.simulation.survey import Limits, aimed_truth, hd_truth
from ogm.state import CellState

SPEC = GridSpec.centered(20.48, 20.48, 0.16)
SENSOR = pose(0, 0, 1.9)
FIELD = (np.deg2rad(-25.0), np.deg2rad(15.0))
NO_DUST = np.zeros((0, 5))
VLP = LIDARS["vlp-32c"]
EXACT = replace(VLP, range_noise=0.0, range_bias=0.0, gain_spread=0.0, divergence=0.0)
FLAT = box([-300, -300, -1], [300, 300, 0], Material.ASPHALT)


def view(active: np.ndarray | None = None, air: float = 0.0, dust: np.ndarray = NO_DUST, reach: float = 185.0) -> View:
    beams = np.ones(VLP.shape, bool) if active is None else active
    return make_view(VLP.directions(), beams, (0.7, 200.0, reach), air, dust)


def ground(z, half: float = 40.0, step: float = 0.5) -> Mesh:
    """Ground of grass whose height is a function of x and y."""
    ticks = np.arange(-half, half + step, step)
    x, y = np.meshgrid(ticks, ticks, indexing="ij")
    p = np.stack([x, y, z(x, y)], axis=-1)
    corners = np.stack([p[:-1, :-1], p[1:, :-1], p[1:, 1:], p[:-1, 1:]], axis=2)
    return quads(corners.reshape(-1, 4, 3), Material.GRASS)


def directions(count: int = 5000) -> np.ndarray:
    azimuth, elevation = np.random.default_rng(0).uniform((-math.pi, -0.6), (math.pi, 0.4), (count, 2)).T
    parts = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)
    return np.stack(parts, axis=1).astype(np.float32)


# --- views ---


def test_a_whole_turn_sees_its_field_of_view() -> None:
    rays = directions()
    elevation = np.arcsin(rays[:, 2])
    inside = (elevation > FIELD[0] + 1e-6) & (elevation < FIELD[1] - 1e-6)
    np.testing.assert_array_equal(in_view(rays, view()), inside)


def test_a_part_sees_where_its_beams_are() -> None:
    beams = VLP.directions()
    azimuth = np.arctan2(beams[..., 1], beams[..., 0])
    active = (np.abs(azimuth - 1.0) < 0.6) & ((azimuth > 1.0) | (np.arange(32) > 8)[:, None])
    rays = directions(20_000)
    turn, elevation = np.arctan2(rays[:, 1], rays[:, 0]), np.arcsin(rays[:, 2])
    found = in_view(rays, view(active))
    low = np.where(turn > 1.0, FIELD[0], VLP.elevations[9])
    wanted = (np.abs(turn - 1.0) < 0.6) & (elevation >= low) & (elevation <= FIELD[1])
    edge = (np.abs(np.abs(turn - 1.0) - 0.6) < 0.01) | (np.abs(turn - 1.0) < 0.01)  # a column and a bin
    near = np.abs(elevation - low) < 1e-5
    np.testing.assert_array_equal(found[~edge & ~near], wanted[~edge & ~near])


@each("extinction", [0.0, 0.02, 0.1])
def test_sight_ends_where_a_bright_wall_or_bright_ground_is_lost(extinction: float) -> None:
    distance = np.linspace(0.3, 250, 5000).astype(np.float32)
    rays = np.tile(np.float32([1, 0, 0]), (5000, 1))
    for ground, sent_back in ((False, 0.3), (True, 0.1)):
        found, returned = distance.copy(), sent_back * np.exp(-2 * extinction * distance)
        wanted = (distance >= 0.7) & (distance <= 200) & (returned >= (distance / 185) ** 2)
        lose_sight(found, rays, np.full(5000, ground), view(air=extinction))
        np.testing.assert_array_equal(np.isfinite(found), wanted)


def test_dust_hides_as_its_optical_depth_has_it() -> None:
    ball = np.array([[10.0, 0.3, 0.0, 2.0, 0.5]])
    rays, far = directions(3000), 30.0
    rays[:, 1] *= 0.2
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    along = np.linspace(0, far, 3001)
    points = rays[:, None] * along[:, None]
    away = np.linalg.norm(points - ball[0, :3], axis=2)
    depth = np.trapezoid(0.5 * np.clip(1 - (away / 2.0) ** 2, 0, None), along, axis=1)
    distance = np.full(3000, far, np.float32)
    lose_sight(distance, rays, np.zeros(3000, bool), view(dust=ball, reach=60.0))
    wanted = 0.3 * np.exp(-2 * depth) >= (far / 60.0) ** 2
    clear = np.abs(0.3 * np.exp(-2 * depth) - (far / 60.0) ** 2) > 0.001
    np.testing.assert_array_equal(np.isfinite(distance)[clear], wanted[clear])
    assert 0 < wanted.mean() < 1
    # Beams: returns come from within the ball, the others are dimmed by the depth.
    distance, strength = np.full(3000, far, np.float32), np.ones(3000, np.float32)
    scattered, draws = np.zeros(3000, bool), np.random.default_rng(1).random((3000, 3), np.float32)
    beams_in_dust(distance, strength, rays, ball, draws, scattered)
    at = rays[scattered] * distance[scattered, None]
    assert scattered.sum() > 20
    assert (np.linalg.norm(at - ball[0, :3], axis=1) < 2.001).all()
    np.testing.assert_allclose(strength[~scattered], np.exp(-2 * depth[~scattered]), atol=2e-3)
    thick = depth > 0.2
    assert np.mean(scattered[thick]) == pytest.approx(0.7 * np.mean(1 - np.exp(-depth[thick])), abs=0.06)


def test_truth_stays_unknown_where_no_ray_could_tell() -> None:
    scene, surface = Scene(FLAT, threads=1), Scene(FLAT, threads=1)
    below = measure_ground(surface, SENSOR, SPEC)
    beams = VLP.directions()
    ahead = np.abs(np.arctan2(beams[..., 1], beams[..., 0])) < 0.5
    cloud = np.array([[6.0, 0.0, -1.0, 1.5, 50.0]])
    x, y = np.broadcast_arrays(*SPEC.cell_centers)
    radius, turn = np.hypot(x, y), np.arctan2(y, x)
    rays = np.concatenate([VLP.directions()] * 12)  # coarse, but many
    rays[..., 2] += np.linspace(0, 0.03, 12).repeat(32)[:, None]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    for limits, dark in (
        (Limits(view(ahead)), np.abs(turn) > 0.53),
        (Limits(view(air=0.3)), radius > 7.0),
        (Limits(view(dust=cloud)), (radius > 9.0) & (np.abs(turn) < 0.1)),
    ):
        aimed = aimed_truth(scene, below, FIELD, limits=limits).state
        assert (aimed[dark] == CellState.UNKNOWN).all()
        light = (radius > 4.3) & (radius < 4.6) & (np.abs(turn) < 0.4)
        assert (aimed[light] == CellState.FREE).all()
        hd = hd_truth(scene, below, rays, limits=limits).state
        assert (hd[dark] == CellState.UNKNOWN).all()
        assert (hd == CellState.FREE).any()


# --- steep ground ---


@each("slope", [0.0, 0.3, 0.5, 0.9])
@each("tilt", [0.0, 0.1])
def test_ground_too_steep_to_drive_on_is_occupied_as_high_as_it_rises(slope: float, tilt: float) -> None:
    bank = ground(lambda x, y: slope * np.clip(x - 4.0, 0, 3.0))
    T = pose(0, 0, 1.9, pitch=tilt)
    below = measure_ground(Scene(bank, threads=1), T, SPEC)
    truth = aimed_truth(Scene(bank, threads=1), below, FIELD, limits=Limits(steepest=0.4))
    assert truth.height_cm is not None
    x, y = np.broadcast_arrays(*SPEC.cell_centers)
    on = (x > 4.8) & (x < 6.2) & (np.abs(y) < 3)
    level = (x > 8.2) & (np.abs(y) < 3) | (x < -4.5) & (np.abs(y) < 3)
    if slope > 0.4:
        assert (truth.state[on] == CellState.OCCUPIED).mean() > 0.97
        heights = truth.height_cm[on & (truth.state == CellState.OCCUPIED)]
        np.testing.assert_allclose(heights, 100 * 0.48 * slope, atol=3)
    else:
        assert not (truth.state == CellState.OCCUPIED).any()
    assert not (truth.state[level] == CellState.OCCUPIED).any()
    plain = aimed_truth(Scene(bank, threads=1), below, FIELD)
    assert not (plain.state == CellState.OCCUPIED).any()


def test_a_kerb_is_not_steep_and_a_ditch_is() -> None:
    for height, width, wanted in ((0.15, 0.02, False), (-0.5, 0.5, True)):
        edge = ground(lambda x, y, h=height, w=width: h * np.clip((x - 4.0) / w, 0, 1), half=12.0, step=0.02 * 5)
        steep, _ = steep_cells(measure_ground(Scene(edge, threads=1), SENSOR, SPEC), 0.4)
        assert bool(steep.any()) == wanted


# --- beams ---


def test_beams_that_see_nothing_return_nothing() -> None:
    scene = Scene(merge([FLAT, box([8, -20, 0], [9, 20, 5], Material.PLASTER_LIGHT)]), threads=1)
    active = np.random.default_rng(2).random(VLP.shape) < 0.5
    rng = np.random.default_rng(3)
    image = scan(scene, VLP, SENSOR, rng, active=active, weather=scan.__kwdefaults__["weather"]._replace(fog=40.0))
    assert not (image.range > 0)[~active].any()
    assert (image.range > 0)[active].mean() > 0.4
    none = scan(scene, VLP, SENSOR, rng, active=np.zeros(VLP.shape, bool))
    assert not none.range.any()


def test_seeing_all_is_seeing_as_ever() -> None:
    scene = Scene(FLAT, threads=1)
    whole, all_of_it = (
        scan(scene, VLP, SENSOR, np.random.default_rng(4), active=active) for active in (None, np.ones(VLP.shape, bool))
    )
    np.testing.assert_array_equal(whole.range, all_of_it.range)
    np.testing.assert_array_equal(whole.intensity, all_of_it.intensity)


def test_points_are_reported_where_the_data_sheet_has_the_layer() -> None:
    scene = Scene(FLAT, threads=1)
    errors = tuple(np.radians(np.linspace(-0.2, 0.2, 32)).tolist())
    ranges = tuple(np.linspace(-0.05, 0.05, 32).tolist())
    for spec in (replace(EXACT, elevation_errors=errors), replace(EXACT, range_errors=ranges)):
        image = scan(scene, spec, SENSOR, np.random.default_rng(5))
        points, layer, _ = to_points(image, spec)
        near = layer < 8
        elevation = np.arcsin(points[near, 2] / np.linalg.norm(points[near, :3], axis=1))
        np.testing.assert_allclose(elevation, np.array(spec.elevations)[layer[near]], atol=1e-5)
        true = -1.9 / np.sin((np.array(spec.elevations) + np.array(spec.elevation_errors or (0.0,) * 32))[layer[near]])
        wanted = true + np.array(spec.range_errors or (0.0,) * 32)[layer[near]]
        np.testing.assert_allclose(np.linalg.norm(points[near, :3], axis=1), wanted, atol=5e-3)
    refused("elevation_errors must have one entry per layer, 32, got 2", replace, VLP, elevation_errors=(0.0, 0.0))
