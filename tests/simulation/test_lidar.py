"""Laws of the simulated lidars: published beams, ranges as told, losses that grow the right way."""

import math
from dataclasses import replace

import numpy as np
import pytest
from cases import each, refused

from ogm import read_scan
from ogm.pose import pose
from ogm.simulation.lidar import CLEAR_WEATHER, Weather, scan, to_points
from ogm.simulation.materials import Material
from ogm.simulation.mesh import Mesh, box, empty, merge, wall
from ogm.simulation.scene import EGO, Scene
from ogm.simulation.sensors import LIDARS, LidarSpec, hd_directions

VLP = LIDARS["vlp-32c"]
EXACT = replace(VLP, range_noise=0.0, range_bias=0.0, gain_spread=0.0, divergence=0.0)
FLAT = box([-300, -300, -1], [300, 300, 0], Material.ASPHALT)
T = pose(0, 0, 1.9)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def street_mesh(material: Material = Material.PLASTER_LIGHT) -> Mesh:
    """Two walls along a road."""
    sides = ([[-60, 9, 0], [60, 9, 0]], [[60, -9, 0], [-60, -9, 0]])
    return merge([FLAT, *(wall(side, 8, material) for side in sides)])


def street(material: Material = Material.PLASTER_LIGHT) -> Scene:
    """Two walls along a road, some boxes, the roof of the ego vehicle."""
    scene = Scene(street_mesh(material), threads=1)
    cars = [box([x, 4, 0.2], [x + 4, 5.8, 1.5], Material.PAINT_DARK) for x in (-20, 6, 17)]
    scene.place(cars, box([-2, -0.9, 0.3], [2, 0.9, 1.4], Material.EGO_VEHICLE))
    return scene


def room(material: Material, half: float) -> Scene:
    """A cube around the sensor's frame at (0, 0, 0)."""
    return Scene(box([-half] * 3, [half] * 3, material), threads=1)


def to_the_front(distance: float, material: Material) -> tuple[Scene, tuple[slice, slice]]:
    """A wall straight ahead, and the part of a VLP-32C's image that is surely on it and nearly head-on."""
    scene = Scene(wall([[distance, -40, -40], [distance, 40, -40]], 80, material), threads=1)
    return scene, (slice(10, 26), slice(870, 930))


# --- the sensors ---


def test_the_layers_of_the_vlp_32c_are_the_published_ones() -> None:
    degrees = np.degrees(VLP.elevations)
    assert VLP.layers == 32
    assert VLP.azimuths == 1800
    assert (degrees[0], degrees[-1]) == pytest.approx((-25, 15))
    np.testing.assert_allclose(
        degrees[9:26], np.arange(-11, 6) / 3, atol=6e-4
    )  # a third of a degree apart around the horizon
    assert set(np.round(np.degrees(VLP.azimuth_offsets), 1).tolist()) == {-4.2, -1.4, 1.4, 4.2}


def test_elevations_agree_with_a_real_vlp_32c(real) -> None:
    cloud = read_scan(real("nebula_apache2/vlp32/*.pcd")).points.astype(np.float64)
    elevation = np.degrees(np.arctan2(cloud[:, 2], np.hypot(cloud[:, 0], cloud[:, 1])))
    off = np.abs(elevation[:, None] - np.degrees(VLP.elevations)).min(axis=1)
    assert off.max() < 1e-3
    assert len(np.unique(np.round(elevation, 2))) == 32


def test_elevations_and_azimuth_offsets_agree_with_a_real_car(real) -> None:
    scan = read_scan(real("argoverse2_adcf/sensors/lidar/*.feather"))
    upper = scan.ring < 32
    x, y, z = (scan.points[upper, :3].astype(np.float64) - [1.3502, 0, 1.6404]).T  # where that sensor sits
    ring, time, reach = scan.ring[upper], scan.time[upper], np.hypot(x, y)
    found = {}
    for laser in range(32):
        chosen = (ring == laser) & (reach > (8 if laser != 31 else 0))
        if np.count_nonzero(chosen) < 20:
            continue
        elevation = np.median(np.degrees(np.arctan2(z[chosen], reach[chosen])))
        turned = np.arctan2(y[chosen], x[chosen]) + 2 * np.pi * 10.0025 * time[chosen]
        found[int(np.argmin(np.abs(np.degrees(VLP.elevations) - elevation)))] = (
            elevation,
            np.degrees(np.angle(np.exp(1j * turned).mean())),
        )
    assert len(found) >= 31
    layers = sorted(found)
    elevations, azimuths = np.array([found[k] for k in layers]).T
    np.testing.assert_allclose(elevations, np.degrees(VLP.elevations)[layers], atol=0.02)
    offsets = np.degrees(VLP.azimuth_offsets)[layers]
    apart = azimuths - offsets
    apart = (apart - apart[0] + 180) % 360 - 180
    np.testing.assert_allclose(apart, np.median(apart), atol=0.1)


@each("name", LIDARS)
def test_every_lidar_is_sane(name: str) -> None:
    spec = LIDARS[name]
    assert spec.name == name
    rays = spec.directions()
    assert rays.shape == (spec.layers, spec.azimuths, 3)
    assert rays.dtype == np.float32
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-6)
    np.testing.assert_allclose(rays[:, 0, 2], np.sin(spec.elevations), atol=1e-6)
    azimuth = np.unwrap(np.arctan2(rays[..., 1], rays[..., 0]).astype(np.float64), axis=1)
    np.testing.assert_allclose(np.diff(azimuth, axis=1), -spec.azimuth_step, atol=2e-6)  # clockwise
    ahead = azimuth[:, spec.azimuths // 2] - np.array(spec.azimuth_offsets)
    np.testing.assert_allclose((ahead + np.pi) % (2 * np.pi) - np.pi, 0, atol=spec.azimuth_step)
    assert len(np.unique(np.round(rays[:, 0].astype(np.float64), 5), axis=0)) >= spec.layers - 40  # few coincide
    np.testing.assert_allclose(np.diff(spec.times), 1 / spec.rate / spec.azimuths)
    assert spec.times.mean() == pytest.approx(0, abs=1e-9)
    image = scan(Scene(street_mesh(), threads=1), spec, pose(0, 0, spec.height), rng())
    share = (image.range > 0).mean(axis=1)
    assert share[0] > 0.95  # the ground before the car
    assert 0.3 < share.mean() <= 1


def test_the_hd_lidar_has_the_same_field_of_view() -> None:
    rays = hd_directions(VLP, 300)
    assert rays.shape == (300, 1800, 3)
    for k in (0, -1):
        np.testing.assert_allclose(rays[k, :, 2], math.sin(VLP.elevations[k]), atol=1e-6)
    straight = replace(VLP, azimuth_offsets=(0.0,) * 32).directions()
    np.testing.assert_allclose(
        np.arctan2(rays[7, :, 1], rays[7, :, 0]), np.arctan2(straight[7, :, 1], straight[7, :, 0]), atol=1e-5
    )
    refused("layers", hd_directions, VLP, 1)


@each("change, reason", [
        ({"elevations": VLP.elevations[::-1]}, "ascend"), ({"elevations": (), "azimuth_offsets": ()}, "empty"),
        ({"elevations": (math.nan, *VLP.elevations[1:])}, "NaN"),
        ({"elevations": tuple(np.degrees(VLP.elevations))}, "degrees"),
        ({"azimuth_offsets": (0.0,)}, "azimuth_offsets"), ({"azimuth_offsets": (math.inf,) * 32}, "inf"),
        ({"azimuth_step": -0.01}, "azimuth_step"), ({"azimuth_step": math.nan}, "azimuth_step"),
        ({"azimuth_step": 0.0031}, "full turn"), ({"rate": 0.0}, "rate"), ({"range_min": -1.0}, "range_min"),
        ({"range_max": 0.1}, "range_max"), ({"range_noise": -0.01}, "range_noise"),
        ({"range_step": 0.0}, "range_step"), ({"divergence": math.nan}, "divergence"), ({"reach": 0.0}, "reach"),
        ({"height": -2.0}, "height"), ({"origins": ((0.0, 0.0, 0.0),)}, "origins"),
        ({"origins": ((0.0, 0.0, math.nan),) * 32}, "NaN"), ({"unit": -1}, "unit"), ({"unit": 1.5}, "unit"),
    ])  # fmt: skip
def test_impossible_lidars_are_refused(change: dict, reason: str) -> None:
    refused(reason, replace, VLP, **change)


# --- ranges ---


def test_ranges_without_noise_are_those_of_geometry() -> None:
    image = scan(Scene(FLAT, threads=1), EXACT, T, rng())
    for layer in range(8):
        seen = image.range[layer][image.range[layer] > 0]
        np.testing.assert_allclose(seen, -1.9 / math.sin(EXACT.elevations[layer]), atol=0.01 + 0.02 * (layer > 4))
    assert (image.range[20:] == 0).all()  # the horizon, and the sky
    assert (image.object[20:] == -1).all()
    assert (image.material[20:] == 255).all()
    assert (image.intensity[20:] == 0).all()


def test_the_noise_is_as_strong_as_specified() -> None:
    scene, part = to_the_front(20.0, Material.PLASTER_LIGHT)
    for sigma in (0.01, 0.05):
        spec = replace(VLP, range_noise=sigma, range_bias=0.0)
        errors = []
        for seed in range(5):
            image = scan(scene, spec, np.eye(4), rng(seed))
            error = image.range[part] - 20 / spec.directions()[part][..., 0]
            errors.extend(error[image.range[part] > 0])
        assert np.std(errors) == pytest.approx(sigma, rel=0.15)
        assert abs(np.mean(errors)) < sigma / 10 + 1e-3


def test_layers_and_units_have_errors_and_gains_of_their_own() -> None:
    bias, gain = VLP.errors
    assert bias.shape == gain.shape == (VLP.layers,)
    assert 0.5 * VLP.range_bias < bias.std() < 1.5 * VLP.range_bias
    assert np.log(gain).std() == pytest.approx(VLP.gain_spread, rel=0.5)
    np.testing.assert_array_equal(replace(VLP, unit=0).errors[0], bias)
    assert not np.array_equal(replace(VLP, unit=1).errors[0], bias)
    scene, part = to_the_front(20.0, Material.PLASTER_LIGHT)
    shots = np.array([scan(scene, VLP, np.eye(4), rng(seed)).range[part] for seed in range(4)])
    errors = np.where(shots > 0, shots - 20 / VLP.directions()[part][..., 0], np.nan)
    np.testing.assert_allclose(np.nanmean(errors, axis=(0, 2)), bias[part[0]], atol=0.002)


def test_ranges_and_intensities_are_whole_steps() -> None:
    image = scan(street(), VLP, T, rng())
    steps = image.range.astype(np.float64) / VLP.range_step
    np.testing.assert_allclose(steps, np.round(steps), atol=0.01)
    np.testing.assert_allclose(image.intensity * 255, np.round(image.intensity * 255), atol=1e-4)
    assert image.intensity.min() >= 0
    assert image.intensity.max() <= 1


def test_nothing_is_reported_nearer_or_farther_than_the_sensor_can() -> None:
    spec = replace(VLP, range_min=3.0, range_max=12.0)
    image = scan(street(), spec, T, rng())
    seen = image.range[image.range > 0]
    assert seen.min() >= 3
    assert seen.max() <= 12
    assert not (image.object == EGO).any()


def test_points_are_the_inverse_of_the_range_image() -> None:
    for spec in (VLP, LIDARS["dual-vlp-32c"]):
        image = scan(street(), spec, T, rng())
        cloud, layer, column = to_points(image, spec)
        assert cloud.dtype == np.float32
        np.testing.assert_array_equal(np.stack([layer, column]), np.nonzero(image.range))
        again = np.zeros(spec.shape, np.float32)
        way = cloud[:, :3] - np.array(spec.origins or [(0, 0, 0)] * spec.layers, np.float32)[layer]
        length = np.linalg.norm(way, axis=1)
        again[layer, column] = length
        np.testing.assert_allclose(again, image.range, atol=2e-5)
        np.testing.assert_allclose(way / length[:, None], spec.directions()[layer, column], atol=2e-6)
        np.testing.assert_array_equal(cloud[:, 3], image.intensity[layer, column])
    refused("shape", to_points, scan(street(), VLP, T, rng()), LIDARS["vls-128"])


def test_edges_are_mixed_only_by_beams_that_are_wide() -> None:
    scene = Scene(
        merge(
            [
                wall([[x, y, -5], [x, y + 1, -5]], 10, Material.PLASTER_LIGHT)
                for x, ys in ((10.0, range(-30, 30, 2)), (10.4, range(-31, 30, 2)))
                for y in map(float, ys)
            ]
        ),
        threads=1,
    )

    def between(spec: LidarSpec) -> float:
        image = scan(scene, spec, np.eye(4), rng())
        ahead = (image.range > 0) & (np.abs(spec.directions()[..., 1]) < 0.7) & (spec.directions()[..., 0] > 0)
        depth = image.range[ahead] * spec.directions()[ahead][:, 0]
        return ((depth > 10.06) & (depth < 10.34)).mean()

    assert between(replace(VLP, divergence=0.0)) == 0
    assert 0.005 < between(VLP) < 0.2
    assert between(replace(VLP, divergence=0.0015)) < between(VLP)


@each("name", ["vlp-32c", "os1-64"])
def test_a_plane_has_no_edges_however_much_it_slants(name: str) -> None:
    """Layers meet far ground metres apart, yet no return of it lies above it."""
    spec = replace(LIDARS[name], range_noise=0.0, range_bias=0.0)
    ground = box([-3000, -3000, -1], [3000, 3000, 0], Material.MARKING)
    points, *_ = to_points(scan(Scene(ground, threads=1), spec, T, rng()), spec)
    assert len(points) > 10_000
    assert np.abs(points[:, 2] + 1.9).max() < 0.02


# --- losses and strengths ---


def seen(material: Material, distance: float, weather: Weather = CLEAR_WEATHER) -> float:
    scene, part = to_the_front(distance, material)
    return float((scan(scene, VLP, np.eye(4), rng(), weather=weather).range[part] > 0.9 * distance).mean())


def test_returns_get_lost_with_distance_and_darkness() -> None:
    for material in (Material.PAINT_BLACK, Material.ASPHALT, Material.PLASTER_LIGHT):
        shares = [seen(material, distance) for distance in (5, 20, 40, 60, 90, 120, 190)]
        assert shares[0] > 0.95  # a few are lost at random
        assert all(a >= b - 0.05 for a, b in zip(shares, shares[1:], strict=False))
        assert shares[-1] < 0.1
    assert seen(Material.SIGN, 190) > 0.95


def test_a_black_car_partly_vanishes_where_it_does_not_face_the_sensor() -> None:
    def share(material: Material, distance: float) -> float:
        oblique = wall([[distance - 20, -20, -40], [distance + 20, 20, -40]], 80, material)
        image = scan(Scene(oblique, threads=1), VLP, np.eye(4), rng())
        return float((image.range[10:26, 885:915] > 0).mean())

    assert share(Material.PAINT_BLACK, 8) > 0.9
    assert share(Material.PAINT_BLACK, 40) < 0.1 < 0.95 < share(Material.PAINT_LIGHT, 40)


def ground_reach(material: Material, weather: Weather = CLEAR_WEATHER) -> float:
    """How far away the ground is still seen by half of the rays [m]."""
    scene = Scene(FLAT.painted(material), threads=1)
    image = scan(scene, VLP, T, rng(), weather=weather)
    share = (image.range > 0).mean(axis=1)
    return float(-1.9 / np.tan(VLP.elevations[int(np.nonzero(share > 0.5)[0].max())]))


def test_dry_asphalt_is_seen_for_some_thirty_metres_and_wet_asphalt_is_not() -> None:
    assert 20 < ground_reach(Material.ASPHALT) < 45
    assert ground_reach(Material.ASPHALT) <= ground_reach(Material.WORN_ASPHALT) < 60
    assert ground_reach(Material.ASPHALT, Weather(wet=1.0)) < 0.8 * ground_reach(Material.ASPHALT)
    assert ground_reach(Material.WET_ASPHALT) == ground_reach(Material.ASPHALT, Weather(wet=1.0))


def test_fog_and_rain_hide_what_is_far_and_return_light_from_close_by() -> None:
    clear = scan(street(), VLP, T, rng())
    assert not ((clear.range > 0) & (clear.material == 255)).any()
    drops = {}
    for weather in (Weather(rain=5), Weather(rain=25), Weather(fog=100.0), Weather(fog=30.0)):
        image = scan(street(), VLP, T, rng(), weather=weather)
        air = (image.range > 0) & (image.material == 255)
        assert (image.object[air] == -1).all()
        drops[weather] = air.mean()
        assert np.median(image.range[air]) < 10
        assert (image.range > 20).mean() <= (clear.range > 20).mean()
    rain, downpour, haze, fog = drops.values()
    assert 0 < rain < downpour < 0.1 < fog
    assert haze < fog
    assert seen(Material.PLASTER_LIGHT, 60) > 0.9 > 0.1 > seen(Material.PLASTER_LIGHT, 60, Weather(fog=60.0))


def test_impossible_weather_is_refused() -> None:
    for weather in (Weather(rain=-1), Weather(rain=math.nan), Weather(fog=0), Weather(wet=1.5)):
        refused("rain|fog|wet", scan, street(), VLP, T, rng(), weather=weather)


def test_strengths_are_in_the_ranges_of_real_scans() -> None:
    def middle(material: Material) -> float:
        image = scan(room(material, 8.0), VLP, np.eye(4), rng())
        return float(np.median(image.intensity[image.range > 0]) * 255)

    assert 3 < middle(Material.ASPHALT) < 15
    assert 5 < middle(Material.BRICK) < 25
    assert 25 < middle(Material.PLASTER_LIGHT) < 60
    assert middle(Material.PAINT_BLACK) < 8
    for material in (Material.SIGN, Material.PLATE, Material.HIGH_VIS):
        assert middle(material) > 100
    image = scan(Scene(FLAT, threads=1), VLP, T, rng())
    road = np.median(image.intensity[1:5][image.range[1:5] > 0]) * 255
    assert 3 <= road <= 20


# --- motion ---


def test_driving_shifts_each_column_by_the_way_driven_so_far() -> None:
    scene = room(Material.PLASTER_LIGHT, 15.0)
    velocity = np.array([12.0, -3.0, 0.0])
    image = scan(scene, EXACT, np.eye(4), rng(), velocity=velocity)
    cloud, _, column = to_points(image, EXACT)
    world = cloud[:, :3] + velocity * EXACT.times[column, None]  # deskewed
    np.testing.assert_allclose(np.abs(world).max(axis=1), 15, atol=0.03)
    raw = np.abs(cloud[:, :3]).max(axis=1)
    assert np.abs(raw - 15).max() > 0.3  # and without that they do not fit


def test_turning_turns_each_column() -> None:
    scene = room(Material.PLASTER_LIGHT, 15.0)
    cloud, _, column = to_points(scan(scene, EXACT, np.eye(4), rng(), yaw_rate=1.0), EXACT)
    cosine, sine = np.cos(EXACT.times[column]), np.sin(EXACT.times[column])
    x, y, z = cloud[:, :3].T
    world = np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=1)
    np.testing.assert_allclose(np.abs(world).max(axis=1), 15, atol=0.03)


# --- determinism and bad input ---


def test_the_same_seed_gives_the_same_bits_with_any_number_of_threads() -> None:
    scenes = []
    for threads in (1, 2):
        scene = Scene(street_mesh(), threads=threads)
        scene.place([box([4, 4, 0], [8, 6, 2], Material.CAR_GLASS)])
        scenes.append(scene)
    for kind in ({}, {"velocity": (5, 1, 0), "weather": Weather(rain=10, wet=1)}):
        images = [scan(scene, VLP, T, rng(9), **kind) for scene in (*scenes, scenes[0])]
        for other in images[1:]:
            for a, b in zip(images[0], other, strict=True):
                np.testing.assert_array_equal(a, b)
    assert (scan(scenes[0], VLP, T, rng(1)).range != scan(scenes[0], VLP, T, rng(2)).range).any()


def test_bad_input_is_refused_with_a_reason() -> None:
    scene = Scene(empty(), threads=1)
    refused("T_world_sensor", scan, scene, VLP, np.eye(3), rng())
    refused("velocity", scan, scene, VLP, T, rng(), velocity=(1, 2))
    refused("velocity", scan, scene, VLP, T, rng(), velocity=(1, 2, math.nan))
    refused("yaw_rate", scan, scene, VLP, T, rng(), yaw_rate=math.inf)


def test_a_thing_keeps_its_paint_whatever_its_place_in_the_list() -> None:
    parts = [wall([[6, y, 0], [6, y + 2, 0]], 3, Material.PAINT_MEDIUM) for y in (-4.0, 0.0, 4.0)]
    scene = Scene(FLAT, threads=1)

    def brightness(order: list[int], paints: list[int] | None) -> list[float]:
        scene.place([parts[k] for k in order])
        image = scan(scene, VLP, T, rng(), paints=paints)
        return [float(np.median(image.intensity[image.object == order.index(k)])) for k in range(3)]

    paints = [11, 500_000, 7]
    first = brightness([0, 1, 2], paints)
    np.testing.assert_allclose(brightness([2, 0, 1], [paints[k] for k in (2, 0, 1)]), first, atol=0.02)
    assert len(set(first)) > 1
    refused("paints", brightness, [0, 1, 2], [1, 2])
    with pytest.raises(ValueError, match="paints"):
        brightness([0, 1, 2], [1.5, 2.5, 3.5])  # type: ignore[list-item]
