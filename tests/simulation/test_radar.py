"""Simulated radars: power, places, Doppler, mirrors, noise."""

import math

import numpy as np
import pytest
from cases import each, refused

from ogm.pose import pose
from ogm.simulation.materials import Material
from ogm.simulation.mesh import Mesh, merge, quads
from ogm.simulation.radar import Origin, RadarSweep, sweep
from ogm.simulation.radars import RADARS, RadarMode, RadarSpec
from ogm.simulation.scene import Scene

PLAIN = RadarSpec(
    "plain",
    (RadarMode(math.radians(60), 150.0, 0.4, 0.2, math.radians(1.5), 150.0),),
    half_height=math.radians(10),
    elevation_resolution=math.radians(2),
    velocity=(-30.0, 30.0),
    false_alarms=0.0,
)
SENSOR = pose(0.0, 0.0, 1.0)


def wall(x: float, y: float, width: float, height: float = 2.0, material: Material = Material.PAINT_LIGHT) -> Mesh:
    """Make a plate across the x axis."""
    y0, y1 = y - width / 2, y + width / 2
    return quads([[[x, y0, 0.0], [x, y1, 0.0], [x, y1, height], [x, y0, height]]], material)


def many(scene: Scene, spec: RadarSpec, count: int, T: np.ndarray = SENSOR, **options: object) -> list[RadarSweep]:
    return [sweep(scene, spec, T, np.random.default_rng(seed), **options) for seed in range(count)]


def test_a_plate_is_detected_where_it_is() -> None:
    sweeps = many(Scene(wall(40.0, 3.0, 1.8)), PLAIN, 30)
    xyz = np.concatenate([one.xyz for one in sweeps])
    assert len(xyz) > 25
    assert np.median(xyz[:, 0]) == pytest.approx(40.0, abs=0.15)
    assert np.median(xyz[:, 1]) == pytest.approx(3.0, abs=0.5)
    assert np.abs(xyz[:, 0] - 40).max() < 1.0
    assert {int(k) for one in sweeps for k in one.origin} == {Origin.OBJECT}


def test_the_cross_section_does_not_depend_on_the_range() -> None:
    """A car's rear of about 3 square metres and 5 dB: 10 dBsm; Swerling 1 spreads it."""
    found = []
    for x in (20.0, 40.0, 80.0):
        turned = Scene(wall(0.0, 0.0, 1.9, 1.6).moved(pose(x, 0, 0, yaw=0.3)))  # no flash
        rcs = np.concatenate([10 ** (one.rcs / 10) for one in many(turned, PLAIN, 60)])
        found.append(10 * np.log10(rcs.sum() / 60))
    assert np.ptp(found) < 4.0
    assert 5 < np.mean(found) < 15


def test_detection_follows_the_law_of_swerling_1() -> None:
    """P_D = P_FA ** (1 / (1 + SNR)), here for the mean SNR that the detections themselves report."""
    scene = Scene(wall(0.0, 0.0, 0.5, 0.5, Material.CLOTH_DARK).moved(pose(60, 0, 0.8, yaw=0.3)))
    spec = RadarSpec("one", (RadarMode(0.2, 150, 2.0, 1.0, 0.1, 105.0),), 0.5, 0.1, (-30.0, 30.0), false_alarms=0.0)
    sweeps = many(scene, spec, 500)
    rate = np.mean([len(one.xyz) > 0 for one in sweeps])
    threshold = -math.log(1e-4)
    snr = 10 ** (np.concatenate([one.snr for one in sweeps]) / 10)  # above the threshold: shifted exponential
    mean = snr.mean() + 1 - threshold
    assert 0.15 < rate < 0.85
    assert rate == pytest.approx(math.exp(-threshold / mean), abs=0.08)


def test_doppler_is_the_change_of_the_range() -> None:
    scene = Scene(merge([]))
    scene.place([wall(30.0, 0.0, 1.8), wall(50.0, 20.0, 1.8)])
    sweeps = many(scene, PLAIN, 20, velocity=(10.0, 0.0, 0.0), velocities=[[-5.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    for number, speed in ((0, -5.0), (1, 0.0)):
        mine = np.concatenate([one.object for one in sweeps]) == number
        assert mine.sum() > 10
        unit = np.concatenate([one.xyz for one in sweeps])[mine]
        cosine = unit[:, 0] / np.linalg.norm(unit, axis=1)
        doppler = np.concatenate([one.doppler for one in sweeps])[mine]
        assert np.median(doppler - (speed - 10) * cosine) == pytest.approx(0, abs=0.1)
        compensated = np.concatenate([one.compensated for one in sweeps])[mine]
        assert np.median(compensated) == pytest.approx(speed * np.median(cosine), abs=0.15)


def test_doppler_is_folded_into_what_the_radar_tells_apart() -> None:
    scene = Scene(merge([]))
    scene.place([wall(30.0, 0.0, 1.8)])
    (one,) = many(scene, PLAIN, 1, velocity=(40.0, 0.0, 0.0))
    assert len(one.doppler)
    np.testing.assert_allclose(one.doppler, 20.0, atol=0.5)
    np.testing.assert_allclose(one.compensated, 0.0, atol=0.5)


def test_a_mirror_makes_a_ghost_with_the_doppler_of_the_real_thing() -> None:
    guard = quads([[[0.0, -4.0, 0.0], [80.0, -4.0, 0.0], [80.0, -4.0, 2.0], [0.0, -4.0, 2.0]]], Material.METAL_SHEET)
    scene = Scene(guard)
    scene.place([wall(40.0, 0.0, 1.8)])
    sweeps = many(scene, PLAIN, 30, velocities=[[-10.0, 0.0, 0.0]])
    origin, xyz = (np.concatenate([getattr(one, name) for one in sweeps]) for name in ("origin", "xyz"))
    speed = np.concatenate([one.compensated for one in sweeps])
    mirrored = (origin == Origin.GHOST) & (xyz[:, 1] < -4)
    assert mirrored.sum() > 10
    np.testing.assert_allclose(xyz[mirrored, 1], -8.0, atol=2.5)
    np.testing.assert_allclose(speed[mirrored], -10.0, atol=1.0)


def test_a_car_is_seen_below_the_car_before_it() -> None:
    road = quads([[[-10.0, -20.0, 0.0], [90.0, -20.0, 0.0], [90.0, 20.0, 0.0], [-10.0, 20.0, 0.0]]], Material.ASPHALT)

    def car(x: float) -> Mesh:  # a plate with room for the hand below
        return wall(x, 0.0, 1.8, 1.4).moved(pose(0, 0, 0.3))

    scene = Scene(road)
    scene.place([car(20.0), car(32.0)])
    behind = np.concatenate([one.object for one in many(scene, PLAIN, 30)]) == 1
    assert behind.sum() > 5


def test_the_number_of_false_alarms_is_poisson() -> None:
    spec = RadarSpec("noisy", PLAIN.modes, PLAIN.half_height, false_alarms=6.0, min_rcs=-200.0)
    sweeps = many(Scene(wall(500.0, 0.0, 1.0)), spec, 300)
    counts = np.array([len(one.xyz) for one in sweeps])
    assert counts.mean() == pytest.approx(6, abs=0.5)
    assert counts.var() == pytest.approx(6, abs=1.6)
    assert all((one.origin == Origin.CLUTTER).all() for one in sweeps)
    assert all((one.xyz[:, 2] == 0).all() for one in sweeps)  # no elevation


def test_the_same_seed_gives_the_same_sweep() -> None:
    scene = Scene(wall(40.0, 3.0, 1.8))
    a, b = (sweep(scene, RADARS["ars548"], SENSOR, np.random.default_rng(4)) for _ in range(2))
    for name, one, other in zip(a._fields, a, b, strict=True):
        np.testing.assert_array_equal(one, other, err_msg=name)


@each("name", RADARS)
def test_a_scan_has_what_a_real_radar_gives(name: str) -> None:
    scan = many(Scene(wall(40.0, 0.0, 6.0)), RADARS[name], 1)[0].scan(stamp=2.0, sensor=name)
    assert len(scan)
    assert scan.doppler is not None
    assert scan.rcs is not None
    assert scan.sensor == name
    assert len(scan) <= RADARS[name].max_detections


def test_an_empty_world_gives_noise_alone() -> None:
    assert len(many(Scene(merge([])), PLAIN, 1)[0].xyz) == 0


def test_wrong_numbers_are_refused() -> None:
    scene = Scene(wall(40.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="velocities 3 for each of the 0 objects"):
        sweep(scene, PLAIN, SENSOR, np.random.default_rng(0), velocities=[[1.0, 0.0, 0.0]])
    refused("finite", sweep, scene, PLAIN, SENSOR, np.random.default_rng(0), velocity=(math.nan, 0.0, 0.0))
    refused("reach", RadarMode, 1.0, 100.0, 0.4, 0.2, 0.02, -1.0)
    refused("velocity must be an interval around 0", RadarSpec, "x", PLAIN.modes, 0.1, velocity=(1.0, 2.0))
