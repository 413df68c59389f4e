"""Simulation of one turn of a lidar in a scene: ranges and intensities as reported by real lidars.

>>> import numpy as np
>>> from ogm.pose import pose
>>> from ogm.simulation.lidar import scan, to_points
>>> from ogm.simulation.materials import Material
>>> from ogm.simulation.mesh import box
>>> from ogm.simulation.scene import Scene
>>> from ogm.simulation.sensors import LIDARS
>>> road = Scene(box([-100, -100, -1], [100, 100, 0], Material.ASPHALT))
>>> image = scan(road, LIDARS["vlp-16"], pose(z=1.9), np.random.default_rng(1))
>>> points, *_ = to_points(image, LIDARS["vlp-16"])
>>> round(float(np.median(points[:, 2])), 2)                                # the road, below the sensor [m]
-1.9
"""

import math
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from ogm.pose import check_pose
from ogm.simulation.echo import Air, Device, RangeImage, receive, reflect
from ogm.simulation.kernels import beams_in_dust
from ogm.simulation.materials import GROUND, Material, table
from ogm.simulation.mesh import Floats, Floats32, Ints, Mask
from ogm.simulation.sample import Weather
from ogm.simulation.scene import NO_MATERIAL, STATIC, Scene
from ogm.simulation.sensors import LidarSpec

__all__ = ["CLEAR_WEATHER", "RangeImage", "Weather", "air_optics", "scan", "to_points"]


CLEAR_WEATHER = Weather()
_STEADY = np.zeros(256, np.bool_)  # materials without random losses
_STEADY[[*GROUND, NO_MATERIAL]] = True


def scan(
    scene: Scene,
    spec: LidarSpec,
    T_world_sensor: ArrayLike,
    rng: Generator,
    *,
    velocity: ArrayLike = (0.0, 0.0, 0.0),
    yaw_rate: float = 0.0,
    weather: Weather = CLEAR_WEATHER,
    paints: ArrayLike | None = None,
    active: Mask | None = None,
    dust: Floats | None = None,
) -> RangeImage:
    """Simulate one turn of a lidar.

    Parameters
    ----------
    scene : Scene
    spec : LidarSpec
    T_world_sensor : (4, 4) array
        Pose in the middle of the turn.
    rng : numpy.random.Generator
    velocity : (3,) array
        Velocity of the sensor in the world frame [m/s]. The range image is not corrected for motion: each column is
        measured from the sensor's position at that time (`spec.times`).
    yaw_rate : float
        Yaw rate about the sensor's z axis, positive to the left [rad/s].
    weather : Weather
    paints : (K,) integers, optional
        Number of each moving object's paint: equal numbers have equal paint in all scans. By default the index of the
        object.
    active : (layers, columns) bool, optional
        Beams that are not blocked or missing; by default all.
    dust : (P, 5) float64, optional
        Balls of dust, see `ogm.simulation.conditions.Conditions`.

    Returns
    -------
    RangeImage

    Raises
    ------
    ValueError
        If the pose is invalid, or a number is not finite or out of range.
    """
    T = check_pose(T_world_sensor, "T_world_sensor")
    motion = np.asarray(velocity, np.float64)
    if motion.shape != (3,) or not np.isfinite(motion).all() or not np.isfinite(yaw_rate):
        raise ValueError(f"velocity must be 3 finite numbers, and yaw_rate one, got {velocity!r} and {yaw_rate}")
    seed = int(rng.integers(2**62))
    rays = spec.aims().reshape(-1, 3)
    moving = spec.origins or motion.any() or yaw_rate
    origins, directions = _moving_rays(spec, T, motion, yaw_rate) if moving else (T, rays)
    if active is None:
        hits = scene.cast(origins, directions, salt=seed % 2**31)
    else:
        index = np.flatnonzero(active)
        starts = origins[index] if moving else origins
        hits = scene.cast(starts, directions[index], salt=seed % 2**31).spread(index, len(rays))
    paint = np.arange(scene.object_count) if paints is None else np.asarray(paints)
    if paint.shape != (scene.object_count,) or (paint.size and paint.dtype.kind not in "iu"):
        raise ValueError(f"paints must be one integer per object in the scene, {scene.object_count}, got {paints!r}")
    strength = np.empty(len(rays), np.float32)
    reflect(rays, T, hits, _optics(weather.wet), paint.astype(np.int64), strength)
    if dust is not None and len(dust):
        scattered = np.zeros(len(rays), np.bool_)
        beams_in_dust(hits.distance, strength, rays, dust, rng.random((len(rays), 3), np.float32), scattered)
        hits.material[scattered], hits.object[scattered], hits.cosine[scattered] = NO_MATERIAL, STATIC, 1
    image = RangeImage._make(np.empty(len(rays), dtype) for dtype in ("f4", "f4", "i4", "u1"))
    receive(hits, strength, _device(spec), air_optics(weather), _STEADY, seed, image)
    if spec.noise_growth:
        _blur_depths(image, rays, spec, rng)
    if active is not None:  # remove drops in front of the sensor, and returns from neighbouring beams
        blind = ~active.ravel()
        image.range[blind], image.intensity[blind] = 0, 0
        image.object[blind], image.material[blind] = STATIC, NO_MATERIAL
    return RangeImage._make(column.reshape(spec.shape) for column in image)


def _blur_depths(image: RangeImage, rays: Floats32, spec: LidarSpec, rng: Generator) -> None:
    """Add the noise of a depth camera, proportional to the squared depth, in place."""
    along = rays[:, 0].astype(np.float64)
    depth = image.range * along
    depth += spec.noise_growth * depth**2 * rng.standard_normal(len(depth))
    distance = np.round(depth / along / spec.range_step) * spec.range_step
    lost = (image.range == 0) | (distance < spec.range_min) | (distance > spec.range_max)
    image.range[:] = np.where(lost, 0, distance)
    image.intensity[lost], image.object[lost], image.material[lost] = 0, STATIC, NO_MATERIAL


def _moving_rays(spec: LidarSpec, T: Floats, velocity: Floats, yaw_rate: float) -> tuple[Floats32, Floats32]:
    """Return world origins and directions (layers * azimuths, 3) of the rays of a moving sensor."""
    turned = yaw_rate * spec.times
    cosine, sine = np.cos(turned), np.sin(turned)
    rotation = np.zeros((spec.azimuths, 3, 3))
    rotation[:, 0, 0] = rotation[:, 1, 1] = cosine
    rotation[:, 0, 1], rotation[:, 1, 0] = -sine, sine
    rotation[:, 2, 2] = 1
    rotation = T[:3, :3] @ rotation
    place = T[:3, 3] + velocity * spec.times[:, None]
    starts = np.array(spec.origins or np.zeros((spec.layers, 3)))
    origins = np.einsum("aij,lj->lai", rotation, starts) + place
    directions = np.einsum("aij,laj->lai", rotation.astype(np.float32), spec.aims())
    return origins.reshape(-1, 3).astype(np.float32), directions.reshape(-1, 3).astype(np.float32)


def _device(spec: LidarSpec) -> Device:
    """Return the parameters of a lidar for kernels."""
    spacing = np.diff(spec.elevations, append=math.inf)
    upwards = spec.divergence / 2 / np.maximum(spacing, 1e-9)
    if spec.origins:
        apart = np.any(np.diff(spec.origins, axis=0) != 0, axis=1)
        upwards[:-1][apart] = 0
    upwards[spacing < 1e-9] = 0
    shift = np.zeros(spec.layers, np.int64)
    shift[:-1] = np.round(np.diff(spec.azimuth_offsets) / spec.azimuth_step)
    sideways = spec.divergence / 2 / spec.azimuth_step
    limits = (spec.range_min, spec.range_max, spec.reach)
    numbers = map(float, (*limits, spec.range_noise, spec.range_step, spec.divergence))
    rest: Any = (*numbers, *spec.errors, not spec.columns)
    return Device(*spec.shape, sideways, upwards, shift, *rest)


def _optics(wet: float) -> Floats32:
    """Return the optics of materials with wet ground, which is darker and more specular."""
    if not 0 <= wet <= 1:
        raise ValueError(f"wet must be in 0 ... 1, got {wet}")
    optics = table()
    soaked = optics[Material.WET_ASPHALT].copy()
    for m in GROUND - {Material.WET_ASPHALT}:
        if m in (Material.ASPHALT, Material.WORN_ASPHALT):
            optics[m] += np.float32(wet) * (soaked - optics[m])
        else:
            optics[m, 0] *= 1 - 0.4 * wet
            optics[m, 2] *= 1 - 0.7 * wet
            optics[m, 3] += 0.3 * wet
    return optics


def air_optics(weather: Weather) -> Air:
    """Return the optical properties of the air in some weather.

    Extinction follows Koschmieder's law for fog, and a power law of the rate for rain (order of magnitude of published
    measurements at 905 nm). The returns are estimates: about one ray in fifty in strong rain, most rays in dense fog,
    at short range.
    """
    if not (weather.rain >= 0 and math.isfinite(weather.rain)):
        raise ValueError(f"rain must be 0 mm/h or more, got {weather.rain}")
    if not weather.fog > 0:
        raise ValueError(f"fog must be a visibility above 0 m, inf for clear air, got {weather.fog}")
    extinction = 2e-4 * weather.rain**0.7 + 3.912 / weather.fog
    drops = 1e-3 * weather.rain + 10 / weather.fog
    depth = 3.0 if not math.isfinite(weather.fog) else 2 + 0.05 * min(weather.fog, 200.0)
    return Air(extinction, drops, depth)


def to_points(image: RangeImage, spec: LidarSpec) -> tuple[Floats32, Ints, Ints]:
    """Convert a range image to points, layer by layer.

    Returns
    -------
    points : (N, 4) float32
        Positions in the sensor frame [m], intensity [0, 1].
    layer, column : (N,) int64
        Position of each point in the range image.
    """
    if image.range.shape != spec.shape:
        raise ValueError(f"the range image of {spec.name} must have shape {spec.shape}, got {image.range.shape}")
    layer, column = np.nonzero(image.range)
    points = np.empty((len(layer), 4), np.float32)
    points[:, :3] = image.range[layer, column, None] * spec.directions()[layer, column]
    if spec.origins:
        points[:, :3] += np.array(spec.origins, np.float32)[layer]
    points[:, 3] = image.intensity[layer, column]
    return points, layer, column
