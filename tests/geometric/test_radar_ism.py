"""RadarISM: what a radar's detections say, and what they must not say."""

import logging
import math
import time

import numpy as np
import pytest
from cases import refused
from hypothesis import given, settings
from hypothesis import strategies as st

from ogm import GridSpec, Mount, Scan
from ogm.evidence import check_mass
from ogm.geometric import RadarISM, moving_detections, sensor_velocity
from ogm.pose import pose

SPEC = GridSpec.centered()
FRONT = Mount(0.6, pose(3.7, 0.0, 0.6), ego_footprint=(-1.0, 3.9, -1.0, 1.0))


def detections(xy: list[tuple[float, float]], doppler: list[float] | None = None) -> Scan:
    points = np.zeros((len(xy), 4), np.float32)
    points[:, :2] = xy
    return Scan(points, doppler=None if doppler is None else np.array(doppler, np.float32))


def cell(x: float, y: float) -> tuple[int, int]:
    return tuple(int((v - o) / SPEC.resolution) for v, o in zip((x, y), SPEC.origin, strict=True))


def by_definition(ism: RadarISM, xy: np.ndarray) -> np.ndarray:
    """Masses of standing detections without Doppler, cell by cell in plain numpy."""
    x, y = np.broadcast_arrays(*SPEC.cell_centers)
    ox, oy, oz = ism.mount.origin
    heading = math.atan2(ism.mount.T_vehicle_sensor[1, 0], ism.mount.T_vehicle_sensor[0, 0])
    bearing, distance = np.arctan2(y - oy, x - ox), np.hypot(x - ox, y - oy)
    seen = np.abs(np.angle(np.exp(1j * (bearing - heading)))) <= ism.half_width
    x0, x1, y0, y1 = ism.mount.ego_footprint
    ego = (x > x0) & (x < x1) & (y > y0) & (y < y1)
    T = ism.mount.T_vehicle_points
    px, py, _ = T[:3, :3] @ np.c_[xy, np.zeros(len(xy))].T + T[:3, 3:]
    use = ~((px > x0) & (px < x1) & (py > y0) & (py < y1))
    pb, pr = np.arctan2(py - oy, px - ox), np.hypot(px - ox, py - oy)
    none = np.ones(SPEC.shape)
    for k in np.flatnonzero(use):
        same = use & (np.abs(np.angle(np.exp(1j * (pb - pb[k])))) < ism.beam)
        hidden = pr[k] > pr[same].min() + 2 * ism.range_noise + ism.margin
        s_t = pr[k] * ism.azimuth_noise
        along = (np.cos(pb[k]) * (x - px[k]) + np.sin(pb[k]) * (y - py[k])) / ism.range_noise
        beside = (np.cos(pb[k]) * (y - py[k]) - np.sin(pb[k]) * (x - px[k])) / s_t
        d2 = along**2 + beside**2
        peak = ism.hit_mass * min(1, ism.extent / (2 * math.pi * ism.range_noise * s_t)) * (ism.behind if hidden else 1)
        none *= 1 - np.where(d2 < 9, peak * np.exp(-d2 / 2), 0)
    snr = 10**1.3 * (ism.reach / np.maximum(np.floor(distance), 1)) ** 4
    belief = ism.free_mass * 1e-4 ** (1 / (1 + snr))
    nearest, farthest = np.full(SPEC.shape, np.inf), np.full(SPEC.shape, np.inf)
    for k in np.flatnonzero(use):  # directions that surely, or perhaps, belong to the detection's sectors
        off = np.abs(np.angle(np.exp(1j * (bearing - pb[k]))))
        nearest = np.where(off < 0.9 * ism.beam, np.minimum(nearest, pr[k]), nearest)
        farthest = np.where(off < 1.8 * ism.beam, np.minimum(farthest, pr[k]), farthest)
    stop = ism.margin + 2 * ism.range_noise
    sure = seen & ~ego & np.isfinite(nearest) & (nearest == farthest) & (distance < nearest - stop)
    never = ~seen | ego | ~np.isfinite(farthest) | (distance >= nearest - stop)
    free = np.where(sure, belief, np.where(never, 0, np.nan))
    occupied = np.where(ego, 0, 1 - none)
    return np.stack([free * (1 - occupied), occupied], axis=-1)


@pytest.mark.parametrize("mount", [FRONT, Mount(0.6, pose(-1.0, 0.9, 0.6, yaw=2.2), ego_footprint=(-1.0, 3.9, -1, 1))])
def test_masses_are_those_of_the_definition(mount: Mount) -> None:
    rng = np.random.default_rng(3)
    r, bearing = rng.uniform(4, 45, 40), np.tile(np.linspace(-1.0, 1.0, 20), 2)  # two in each of 20 directions
    xy = np.stack([r * np.cos(bearing), r * np.sin(bearing)], axis=-1)
    ism = RadarISM(SPEC, mount)
    wanted, got = by_definition(ism, xy), ism(detections(xy)).mass
    clear = np.isfinite(wanted[..., 0])
    assert clear.mean() > 0.8
    assert (wanted[..., 0][clear] > 0.1).sum() > 500
    np.testing.assert_allclose(got[clear], wanted[clear], atol=2e-5)


def test_a_detection_marks_and_clears_before_it() -> None:
    grid = RadarISM(SPEC, FRONT)(detections([(20.0, 0.0)]))
    assert grid.occupied[cell(23.7, 0.0)] > 0.5
    assert grid.free[cell(15.0, 0.0)] > 0.6
    assert grid.free[cell(24.5, 0.0)] == 0
    assert grid.free[cell(15.0, 5.0)] == 0  # no detection there
    assert grid.free[cell(9.0, 0.0)] > 0.6
    assert grid.mass[cell(0.0, 0.0)].sum() == 0  # the ego vehicle


def test_free_fades_with_the_detection_probability() -> None:
    grid = RadarISM(SPEC, FRONT, reach=15.0, margin=0.5)(detections([(36.0, 0.0)]))
    near, far = grid.free[cell(10.0, 0.0)], grid.free[cell(37.0, 0.0)]
    assert near > 0.6
    assert 0 < far < 0.1 * near


def test_what_is_behind_another_detection_counts_less() -> None:
    ism = RadarISM(SPEC, FRONT, behind=0.25)
    both = ism(detections([(12.0, 0.0), (20.0, 0.0)])).occupied[cell(23.7, 0.0)]
    alone = ism(detections([(20.0, 0.0)])).occupied[cell(23.7, 0.0)]
    assert both == pytest.approx(0.25 * alone, rel=0.05)


def test_what_moves_does_not_mark_but_ends_what_is_cleared() -> None:
    rng = np.random.default_rng(0)
    bearing, r, v = rng.uniform(-0.9, 0.9, 60), rng.uniform(5, 40, 60), np.array([8.0, 0.3])
    unit = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    xy, doppler = r[:, None] * unit, -unit @ v + rng.normal(0, 0.05, 60)
    xy[0], doppler[0] = (18.0, 0.0), 4.0 - 8.0  # drives ahead of us at 4 m/s
    scan = detections([*map(tuple, xy)], [*doppler])
    np.testing.assert_allclose(sensor_velocity(scan), v, atol=0.1)
    moving = moving_detections(scan)
    assert moving[0]
    assert moving.sum() <= 2
    only = scan.select(np.r_[0, np.flatnonzero(np.abs(bearing) > 0.2)])
    grid = RadarISM(SPEC, FRONT)(only)
    assert grid.occupied[cell(21.7, 0.0)] == 0
    assert grid.free[cell(12.0, 0.0)] > 0.5
    assert grid.free[cell(25.0, 0.0)] == 0
    assert RadarISM(SPEC, FRONT, keep_moving=True)(only).occupied[cell(21.7, 0.0)] > 0.5


def test_without_agreement_nothing_is_said_to_move() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform(2, 30, (40, 2))
    scan = detections([*map(tuple, xy)], [*rng.uniform(-20, 20, 40)])
    assert sensor_velocity(scan) is None
    assert not moving_detections(scan).any()
    assert sensor_velocity(detections([(1.0, 0.0)], [3.0])) is None
    assert sensor_velocity(detections([(1.0, 0.0)])) is None


def test_compensated_doppler_gives_the_same() -> None:
    rng = np.random.default_rng(1)
    bearing = rng.uniform(-0.9, 0.9, 50)
    unit = np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    xy, own = rng.uniform(5, 40, 50)[:, None] * unit, np.where(np.arange(50) < 5, 6.0, 0.0)
    raw = detections([*map(tuple, xy)], [*(own - unit @ [9.0, 0.0])])
    over_ground = detections([*map(tuple, xy)], [*own])
    assert moving_detections(raw).tolist() == moving_detections(over_ground).tolist() == (np.arange(50) < 5).tolist()


def test_heights_above_the_clearance_do_not_mark() -> None:
    points = np.array([[20.0, 0.0, 4.5, 0.0]], np.float32)
    grid = RadarISM(SPEC, FRONT)(Scan(points))
    assert grid.occupied.max() == 0


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 300))
def test_masses_are_masses(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform(-60, 60, (count, 4)).astype(np.float32)
    points[rng.random(count) < 0.05] = np.nan
    scan = Scan(points, doppler=rng.uniform(-30, 30, count).astype(np.float32))
    check_mass(RadarISM(SPEC, FRONT)(scan).mass)
    assert not RadarISM(SPEC, FRONT)(np.zeros((0, 4), np.float32)).mass.any()


def test_impossible_numbers_and_a_sensor_outside_the_grid_are_refused() -> None:
    for name, value in (
        *(("half_width", 0.0), ("range_noise", math.nan), ("free_mass", 1.0), ("behind", 1.1), ("reach", 0.0)),
        ("beam", 1.0),
    ):
        refused(name, RadarISM, SPEC, FRONT, **{name: value})
    refused("outside the grid", RadarISM, SPEC, Mount(0.6, pose(100.0, 0.0, 0.6)))


def test_three_hundred_detections_take_milliseconds() -> None:
    rng = np.random.default_rng(0)
    r, bearing = rng.uniform(3, 60, 300), rng.uniform(-1, 1, 300)
    scan = detections([*map(tuple, np.stack([r * np.cos(bearing), r * np.sin(bearing)], axis=-1))], [0.0] * 300)
    ism = RadarISM(SPEC, FRONT)
    ism(scan)
    took = []
    for _ in range(20):
        start = time.thread_time()
        ism(scan)
        took.append(time.thread_time() - start)
    assert min(took) < 0.02


def test_detections_that_are_not_finite_are_dropped_and_counted(caplog: pytest.LogCaptureFixture) -> None:
    good = np.array([[20, 1, 0, 0], [12, 5, 0, 0]], np.float32)
    bad = np.array([[np.nan, 1, 0, 0], [5, np.inf, 0, 0], [1e30, 0, 0, 0]], np.float32)
    ism = RadarISM(SPEC, FRONT)
    with caplog.at_level(logging.WARNING):
        grid = ism(np.concatenate([bad, good]))
    np.testing.assert_array_equal(grid.mass, ism(good).mass)
    assert "dropped 3 of 5 points" in caplog.text
