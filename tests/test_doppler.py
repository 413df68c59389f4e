"""Radial velocities from Doppler: whose they are, where, and how fast over ground."""

import lzma
from dataclasses import replace

import numpy as np
import pytest
from cases import each

from ogm import Mount, Scan
from ogm.geometric.doppler import RadialVelocities, moving_detections, radial_velocities, sensor_velocity
from ogm.pose import inverse, pose, transform_points

CAR, WALLS = 6, 60


def street(mount: Mount, own: tuple[float, float], car: tuple[float, float], rng: np.random.Generator) -> Scan:
    """Return a sweep of walls beside a vehicle that moves, and of a car at (25, 3) m in its frame (the last rows)."""
    xy = np.column_stack([rng.uniform(8, 45, WALLS), rng.choice([-9.0, 9.0], WALLS)])
    xy = np.vstack([xy, (25.0, 3.0) + rng.uniform(-0.8, 0.8, (CAR, 2))])
    rays = xy - mount.origin[:2]
    unit = rays / np.hypot(*rays.T)[:, None]
    velocity = np.zeros_like(xy)
    velocity[WALLS:] = car
    doppler = (unit * (velocity - own)).sum(axis=1) + rng.normal(0, 0.02, len(xy))
    points = np.column_stack([xy, np.full(len(xy), mount.origin[2]), np.zeros(len(xy))])
    if mount.points_in == "sensor":
        points = transform_points(inverse(mount.T_vehicle_sensor), points)
    return Scan(points.astype(np.float32), doppler=doppler.astype(np.float32))


@each("mount", [
        Mount(0.6, pose(3.7, 0.0, 0.6), ego_footprint=(-1.0, 3.9, -1.0, 1.0)),
        Mount(0.6, pose(3.0, 0.8, 0.6, yaw=0.9, pitch=0.05), ego_footprint=(-1.0, 3.9, -1.0, 1.0)),
        Mount(0.6, pose(3.7, 0.0, 0.6, yaw=-0.5), points_in="vehicle"),
    ])  # fmt: skip
def test_speeds_are_over_ground_and_places_in_the_vehicle_frame(mount):
    car = np.array([-7.0, 1.5])
    scan = street(mount, (12.0, 0.4), car, np.random.default_rng(0))
    found = radial_velocities(scan, mount)
    assert len(found.speed) == CAR
    np.testing.assert_allclose(found.xy, [(25, 3)] * CAR, atol=0.9)
    rays = found.xy - mount.origin[:2]
    np.testing.assert_allclose(found.direction, rays / np.hypot(*rays.T)[:, None], atol=1e-5)
    np.testing.assert_allclose(found.speed, found.direction @ car, atol=0.15)
    np.testing.assert_allclose(found.extent[:, 1], 0.01 * np.hypot(*rays.T), rtol=1e-5)
    assert (found.deviation >= 0.1).all()
    if mount.points_in == "sensor":
        assert moving_detections(scan)[WALLS:].all()
        assert moving_detections(scan).sum() == CAR


def test_a_standing_world_and_one_without_agreement_have_no_rows():
    mount, rng = Mount(0.6), np.random.default_rng(1)
    scan = street(mount, (12.0, 0.0), (0.0, 0.0), rng)
    assert len(radial_velocities(scan, mount).speed) == 0
    wild = Scan(scan.points, doppler=rng.uniform(-20, 20, len(scan)))
    assert len(radial_velocities(wild, mount).speed) == 0
    assert len(radial_velocities(scan.select(slice(0)), mount).speed) == 0
    assert radial_velocities(Scan(scan.points), mount) is None
    radar = radial_velocities(
        Scan(scan.points, rcs=np.zeros(len(scan))), mount
    )  # of a radar, so that it is not matched
    assert [np.shape(column) for column in radar.checked()[:5]] == [(0, 2), (0, 2), (0,), (0,), (0, 2)]


def test_what_is_behind_another_detection_in_the_ego_footprint_or_not_finite_is_left_out():
    mount = Mount(0.6, ego_footprint=(-1.0, 2.0, -1.0, 1.0))
    scan = street(mount, (10.0, 0.0), (-7.0, 0.0), np.random.default_rng(2))
    points = np.vstack([scan.points, [(50.0, 6.0, 0, 0), (1.5, 0.2, 0, 0), (20.0, -3.0, 0, 0), (np.nan, 1, 0, 0)]])
    doppler = np.r_[scan.doppler, 20.0, 20.0, 20.0, 20.0]
    found = radial_velocities(Scan(points.astype(np.float32), doppler=doppler), mount)
    assert len(found.speed) == CAR + 1  # behind the car, in the vehicle, free, nowhere
    np.testing.assert_allclose(found.xy[-1], (20, -3), atol=1e-5)


def test_folded_doppler_is_unfolded_by_the_interval():
    mount, width = Mount(0.6), 46.0
    scan = street(mount, (13.0, 0.0), (-13.0, 0.0), np.random.default_rng(3))
    folded = Scan(scan.points, doppler=(scan.doppler + width / 2) % width - width / 2)
    assert (radial_velocities(folded, mount).speed > 25).all()  # wrong, as documented
    unfolded = radial_velocities(replace(folded, doppler_interval=width), mount)
    plain = radial_velocities(scan, mount)
    np.testing.assert_allclose(unfolded.speed, plain.speed, atol=1e-4)


@each("interval", [8.0, 10.4, 45.8])
def test_the_velocity_of_the_sensor_is_found_from_folded_doppler(interval):
    rng, right = np.random.default_rng(4), 0
    for _ in range(20):
        count = rng.integers(60, 400)
        azimuth, speed, heading = rng.uniform(-1, 1, count), rng.uniform(0, 50), rng.uniform(-np.pi, np.pi)
        unit, velocity = (
            np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1),
            speed * np.array([np.cos(heading), np.sin(heading)]),
        )
        doppler = rng.normal(0, 0.1, count) - unit @ velocity + rng.uniform(-20, 20, count) * (rng.random(count) < 0.3)
        points = np.column_stack([20 * unit, np.zeros((count, 2))]).astype(np.float32)
        folded = Scan(points, doppler=(doppler + interval / 2) % interval - interval / 2, doppler_interval=interval)
        found = sensor_velocity(folded)
        right += found is not None and np.hypot(*(found - velocity)) < 0.3
    assert right >= 19


def test_where_folds_agree_alike_no_velocity_is_found():
    azimuth = np.linspace(-0.1, 0.1, 100)
    unit = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
    points = np.column_stack([20 * unit, np.zeros((100, 2))]).astype(np.float32)
    doppler = (5 - 23 * unit[:, 0]) % 10 - 5
    assert sensor_velocity(Scan(points, doppler=doppler, doppler_interval=10.0)) is None


def test_real_folded_doppler_gives_the_speed_ahead(real):
    speeds = []
    for path in sorted(real("astyx_radar").glob("radar_6455_*.txt.xz")):
        with lzma.open(path, "rt") as file:
            table = np.loadtxt(file, skiprows=2)
        points = np.column_stack([table[:, :3], np.zeros(len(table))]).astype(np.float32)
        found = sensor_velocity(Scan(points, doppler=-table[:, 3], doppler_interval=10.4))
        speeds.append((np.nan, np.nan) if found is None else found)
    forward, left = np.transpose(speeds)
    known = np.isfinite(forward)
    assert known.mean() >= 0.85
    assert (np.abs(left[known]) < 1).all()
    assert ((forward[known] > -0.1) & (forward[known] < 20)).all()


def test_in_another_frame_places_and_directions_turn_and_speeds_stay():
    place, direction = np.array([[3.0, 1.0]]), np.array([[0.6, 0.8]])
    one = RadialVelocities(place, direction, np.array([2.0]), np.ones(1), np.ones((1, 2)))
    moved = one.moved(pose(1.0, 2.0, yaw=np.pi / 2, pitch=0.1))
    np.testing.assert_allclose(moved.direction, [(-0.8, 0.6)], atol=0.01)
    np.testing.assert_allclose(np.hypot(*moved.direction.T), 1)
    np.testing.assert_allclose(moved.xy, [(0.0, 5.0)], atol=0.05)
    assert moved.speed == one.speed


@each("wrong, message", [
        ({"xy": np.zeros((2, 2))}, "xy of radial velocities must have shape"),
        ({"speed": np.zeros((1, 1))}, "speed of radial velocities must have shape"),
        ({"speed": np.array([np.nan])}, "speed of radial velocities must be finite"),
        ({"deviation": np.zeros(1)}, "deviation of radial velocities must be above 0"),
        ({"extent": np.array([[1.0, -1.0]])}, "extent of radial velocities must be above 0"),
        ({"direction": np.array([[3.0, 4.0]])}, "unit vectors"),
    ])  # fmt: skip
def test_columns_that_do_not_fit_are_refused(wrong, message):
    good = RadialVelocities(np.zeros((1, 2)), np.array([[0.6, 0.8]]), np.zeros(1), np.ones(1), np.ones((1, 2)))
    assert good.checked().dense is False
    with pytest.raises(ValueError, match=message):
        good._replace(**wrong).checked()
