"""Simulation of one radar sweep in a scene: ray paths with their power, bins, detections.

Every ray of a fan carries power to its hit, and from mirrors (ground at a grazing angle, walls, metal) onward to the
surface behind them. The power returns by the radar equation and is summed in bins of range, Doppler and azimuth. Bins
above the noise and their neighbours are detections. Not modelled: rotating wheels and moving limbs, interference
between radars, weather, paths with more than one mirror, range side lobes.

>>> import numpy as np
>>> from ogm.pose import pose
>>> from ogm.simulation.materials import Material
>>> from ogm.simulation.mesh import box, merge
>>> from ogm.simulation.radar import sweep
>>> from ogm.simulation.radars import RADARS
>>> from ogm.simulation.scene import Scene
>>> road = box([-100, -100, -1], [100, 100, 0], Material.ASPHALT)
>>> scene = Scene(merge([road, box([20, -1, 0], [24, 1, 1.5], Material.PAINT_DARK)]))
>>> found = sweep(scene, RADARS["ars548"], pose(z=0.5), np.random.default_rng(1))
>>> bool((np.abs(found.xyz[:, 0] - 20) < 1).any())                          # the car ahead
True
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike

from ogm.geometric.radar import FALSE_ALARM, REFERENCE_SNR
from ogm.pose import check_pose, rotate
from ogm.simulation.materials import GROUND, Material
from ogm.simulation.mesh import Bytes, Floats, Floats32, Ints, Ints32
from ogm.simulation.radars import RadarMode, RadarSpec
from ogm.simulation.sample import Origin, RadarSweep
from ogm.simulation.scene import EGO, Scene

__all__ = ["Origin", "RadarSweep", "sweep"]

FLASH = math.radians(4.0)  # width of specular reflection: facades and panels are not flat
GRAZING = math.radians(6.0)  # width of grazing angles at which the ground is a mirror

# Diffuse echo per area across the beam [dB], extra echo of a mirror that faces the sensor [dB], and share of the power
# that a mirror passes on. Effective values, estimated to match published cross sections of whole objects (cars 10,
# lorries 20, people -8 dBsm) and weak ground. The values of paint include corners and wheels of metal.
_WALL, _METAL, _BODY, _SOFT = (-14, 14, 0.2), (0, 18, 0.6), (5, 15, 0.5), (-12, 0, 0.0)
_GROUNDS = {Material.GRASS: -24, Material.SOIL: -25, Material.GRAVEL: -23, Material.COBBLES: -24, Material.PAVING: -30}
_ECHO: dict[Material, tuple[float, float, float]] = {
    **{ground: (-30, 0, 0.5) for ground in GROUND},
    **{ground: (level, 0, 0.2) for ground, level in _GROUNDS.items()},
    **dict.fromkeys((Material.PLASTER_LIGHT, Material.PLASTER_DARK, Material.BRICK, Material.CONCRETE), _WALL),
    **dict.fromkeys((Material.STONE, Material.ROOF, Material.KERB), _WALL),
    Material.WINDOW: (-20, 14, 0.3),
    Material.CAR_GLASS: (-10, 10, 0.2),
    **dict.fromkeys((Material.METAL_SHEET, Material.METAL_POLE, Material.SIGN), _METAL),
    **dict.fromkeys((Material.PAINT_LIGHT, Material.PAINT_MEDIUM, Material.PAINT_DARK, Material.PAINT_BLACK), _BODY),
    **dict.fromkeys((Material.PLATE, Material.LAMP, Material.TYRE, Material.EGO_VEHICLE), _BODY),
    Material.TARPAULIN: (3, 10, 0.2),
    Material.PLASTIC_DARK: (-8, 0, 0.0),
    Material.WOOD: (-14, 4, 0.05),
    Material.BARK: (-10, 0, 0.0),
    Material.FOLIAGE: (-15, 0, 0.0),
    **dict.fromkeys((Material.CLOTH_LIGHT, Material.CLOTH_DARK, Material.SKIN, Material.HIGH_VIS), (-6, 0, 0.0)),
}
_TABLE = np.zeros((256, 3))
for _material in Material:
    _diffuse, _flash, _share = _ECHO.get(_material, _SOFT)
    _TABLE[_material] = 10 ** (_diffuse / 10), 10 ** (_flash / 10) if _flash else 0.0, _share
IS_GROUND = np.zeros(256, np.bool_)
IS_GROUND[list(GROUND)] = True


def cross_section(material: Bytes, cosine: Floats32) -> Floats:
    """Return the radar cross section per area across the beam, (N,)."""
    angle = np.arccos(np.clip(cosine, 0.0, 1.0)).astype(np.float64)
    return np.asarray(_TABLE[material, 0] + _TABLE[material, 1] * np.exp(-((angle / FLASH) ** 2)))


def mirror_share(material: Bytes, cosine: Floats32) -> Floats:
    """Return the share of power reflected as by a mirror, (N,); by the ground only at grazing angles."""
    grazing = np.arcsin(np.clip(cosine, 0.0, 1.0)).astype(np.float64)
    return np.asarray(_TABLE[material, 2] * np.where(IS_GROUND[material], np.exp(-((grazing / GRAZING) ** 2)), 1.0))


AZIMUTH_STEP, ELEVATION_STEP = math.radians(0.5), math.radians(1.0)  # between rays
STRAY = 1.0  # [m] detections reported further from their cause are ghosts
BEAM_BINS = 2  # azimuth bins per resolution


class _Paths(NamedTuple):
    """Paths from the sensor to a surface and back, one row each."""

    distance: Floats  # [m] half the length of the path
    rate: Floats  # [m/s] its rate of change
    azimuth: Floats
    elevation: Floats
    power: Floats  # contribution to the signal-to-noise ratio
    origin: Bytes
    object: Ints32


def sweep(
    scene: Scene,
    spec: RadarSpec,
    T_world_sensor: ArrayLike,
    rng: Generator,
    *,
    velocity: ArrayLike = (0.0, 0.0, 0.0),
    velocities: ArrayLike | None = None,
) -> RadarSweep:
    """Simulate one radar sweep.

    Parameters
    ----------
    scene : Scene
    spec : RadarSpec
    T_world_sensor : (4, 4) array
        Pose of the sensor, x ahead and y to the left.
    rng : numpy.random.Generator
    velocity : (3,) array
        Velocity of the sensor itself in the world frame [m/s]; it varies over a turning vehicle.
    velocities : (K, 3) array, optional
        Velocities of the scene's moving objects, in their order, in the world frame [m/s]; 0 by default.

    Raises
    ------
    ValueError
        If the pose is invalid, or velocities have a wrong shape or are not finite.
    """
    T = check_pose(T_world_sensor, "T_world_sensor")
    own = np.asarray(velocity, np.float64)
    shape = (scene.object_count, 3)
    moving = np.zeros(shape) if velocities is None else np.asarray(velocities, np.float64)
    if own.shape != (3,) or moving.shape != shape or not np.isfinite(np.r_[own, moving.ravel()]).all():
        raise ValueError(
            f"velocity must be 3 finite numbers, and velocities 3 for each of the {shape[0]} objects in the scene, "
            f"got shapes {own.shape} and {moving.shape}"
        )
    salt = int(rng.integers(2**31))
    found = []
    for mode in spec.modes:
        paths = _paths(scene, spec, mode, T, own, np.vstack([moving, np.zeros(3)]), salt)
        found.append(_detections(paths, spec, mode, rng))
    columns = [np.concatenate(column) for column in zip(*found, strict=True)]
    strongest = np.sort(np.argsort(-columns[4], kind="stable")[: spec.max_detections])
    distance, rate, azimuth, elevation, snr, rcs, origin, number = (column[strongest] for column in columns)
    unit = _unit(azimuth, elevation)
    low, high = spec.velocity
    doppler = (rate - low) % (high - low) + low
    compensated = doppler + unit @ (T[:3, :3].T @ own)
    compensated -= (high - low) * np.round(compensated / (high - low))  # the fold nearest to 0
    xyz = distance[:, None] * unit
    if not spec.elevation_resolution:
        xyz[:, 2] = 0
    result: Any = [column.astype(np.float32) for column in (xyz, doppler, compensated, rcs, 10 * np.log10(snr))]
    result += [origin.astype(np.uint8), number.astype(np.int32)]
    return RadarSweep(*result)


def _unit(azimuth: Floats, elevation: Floats) -> Floats:
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)


def _paths(
    scene: Scene, spec: RadarSpec, mode: RadarMode, T: Floats, own: Floats, velocities: Floats, salt: int
) -> _Paths:
    """Return the paths of a mode's rays, direct and through one mirror."""
    edge = mode.half_width + 2 * mode.azimuth_resolution
    across = np.arange(-edge, edge, AZIMUTH_STEP) + AZIMUTH_STEP / 2
    upward = np.arange(-2 * spec.half_height, 2 * spec.half_height, ELEVATION_STEP) + ELEVATION_STEP / 2
    azimuth, elevation = (grid.ravel() for grid in np.meshgrid(across, upward))
    world = rotate(T[:3, :3], _unit(azimuth, elevation).T).T
    normals = np.zeros((len(world), 3), np.float32)
    hits = scene.cast(T[:3, 3], world.astype(np.float32), salt=salt, normals=normals)
    index = np.flatnonzero(np.isfinite(hits.distance) & (hits.object != EGO))
    gain = _gain(spec, mode, azimuth, elevation)
    constant = REFERENCE_SNR * mode.reach**4 * (AZIMUTH_STEP * ELEVATION_STEP)

    u = world[index]
    distance, cosine, material = hits.distance[index].astype(np.float64), hits.cosine[index], hits.material[index]
    echo = cross_section(material, cosine)
    rate = np.einsum("nk,nk->n", u, velocities[hits.object[index]] - own)
    origin = np.where(IS_GROUND[material], np.uint8(Origin.GROUND), np.uint8(Origin.OBJECT))
    power = constant * gain[index] * echo / np.maximum(distance, 1.0) ** 2
    direct = _Paths(distance, rate, azimuth[index], elevation[index], power, origin, hits.object[index])

    # reflections by mirrors
    share = mirror_share(material, cosine) ** 2
    on = np.flatnonzero(share > 1e-3)
    n = normals[index[on]].astype(np.float64)
    before = u[on]
    after = before - 2 * np.einsum("nk,nk->n", before, n)[:, None] * n
    start = T[:3, 3] + distance[on, None] * before + 1e-3 * after
    beyond = scene.cast(start, after.astype(np.float32), salt=salt + 1)
    real = np.flatnonzero(np.isfinite(beyond.distance) & (beyond.object != EGO) & ~IS_GROUND[beyond.material])
    on, second = on[real], beyond.distance[real].astype(np.float64)
    mirror, target = velocities[hits.object[index[on]]], velocities[beyond.object[real]]
    u1, u2 = u[on], after[real]
    rate = np.einsum("nk,nk->n", u1, mirror - own) + np.einsum("nk,nk->n", u2, target - mirror)
    length = distance[on] + second
    reported, place = T[:3, 3] + length[:, None] * u1, start[real] + second[:, None] * u2
    flat = np.linalg.norm((reported - place)[:, : 2 if not spec.elevation_resolution else 3], axis=1)
    origin = np.where(flat > STRAY, np.uint8(Origin.GHOST), np.uint8(Origin.OBJECT))
    echo = cross_section(beyond.material[real], beyond.cosine[real])
    power = constant * gain[index[on]] * share[on] * echo / np.maximum(length, 1.0) ** 2
    bounced = _Paths(length, rate, azimuth[index[on]], elevation[index[on]], power, origin, beyond.object[real])

    both: Any = zip(direct, bounced, strict=True)
    paths = _Paths._make(map(np.concatenate, both))
    keep = (paths.distance > mode.range_min) & (paths.distance < mode.range_max)
    return _Paths._make(column[keep] for column in paths)


def _detections(paths: _Paths, spec: RadarSpec, mode: RadarMode, rng: Generator) -> tuple[Any, ...]:
    """Sum power in bins, and return the bins above noise and their neighbours.

    The columns are distance, rate, azimuth, elevation, signal-to-noise ratio, cross section [dBsm], origin and object.
    """
    low, high = spec.velocity
    rate = (paths.rate - low) % (high - low)
    sine = np.sin(paths.azimuth)  # the beam width in it is constant
    steps = mode.range_resolution, mode.doppler_resolution, mode.azimuth_resolution / BEAM_BINS
    rows = (paths.distance, rate, sine + 1)
    number = [np.floor(row / step).astype(np.int64) + 2 for row, step in zip(rows, steps, strict=True)]
    stride = int((high - low) / steps[1]) + 5, int(2 / steps[2]) + 7
    key, group = np.unique((number[0] * stride[0] + number[1]) * stride[1] + number[2], return_inverse=True)
    power = np.bincount(group, paths.power, len(key))
    columns = (paths.distance, rate + low, sine, paths.elevation)
    mean = [np.bincount(group, paths.power * column, len(key)) / power for column in columns]
    last = np.flatnonzero(np.diff(np.sort(group), append=-1))
    leader = np.lexsort((paths.power, group))[last]

    # Swerling 1: the echo of every bin fluctuates, the antenna smears it in azimuth, the receiver adds noise of power 1
    echo, total = power * rng.exponential(size=len(key)), rng.exponential(size=len(key))
    for shift in range(-BEAM_BINS, BEAM_BINS + 1):
        total += np.exp2(-2 * (2 * shift / BEAM_BINS) ** 2) * _at(key, key + shift, echo)
    peak = total > -math.log(FALSE_ALARM)
    for r in (-1, 0, 1):
        for d in (-1, 0, 1):
            for a in range(-BEAM_BINS, BEAM_BINS + 1):
                if r or d or a:
                    peak &= total > _at(key, key + (r * stride[0] + d) * stride[1] + a, total)

    # measurements with errors
    found = np.flatnonzero(peak)
    snr = np.maximum(total[found] - 1, 1.0)
    error = 0.05 + 0.5 / np.sqrt(2 * snr)
    resolutions = (mode.range_resolution, mode.doppler_resolution, mode.azimuth_resolution, spec.elevation_resolution)
    distance, rate, sine, elevation = (
        column[found] + resolution * error * rng.standard_normal(len(found))
        for column, resolution in zip(mean, resolutions, strict=True)
    )
    origin, thing = paths.origin[leader[found]].astype(np.int64), paths.object[leader[found]]

    # noise
    count = int(rng.poisson(spec.false_alarms / len(spec.modes)))
    edge = math.sin(mode.half_width)
    noise = [rng.uniform(mode.range_min, mode.range_max, count), rng.uniform(low, high, count)]
    noise += [rng.uniform(-edge, edge, count), rng.uniform(-spec.half_height, spec.half_height, count)]
    noise += [rng.exponential(size=count) - math.log(FALSE_ALARM) - 1]
    noise += [np.full(count, Origin.CLUTTER), np.full(count, -1)]
    several: Any = zip((distance, rate, sine, elevation, snr, origin, thing), noise, strict=True)
    distance, rate, sine, elevation, snr, origin, thing = (np.concatenate(pair) for pair in several)

    azimuth = np.arcsin(np.clip(sine, -1, 1))
    elevation = elevation if spec.elevation_resolution else np.zeros_like(elevation)
    gain = _gain(spec, mode, azimuth, elevation)
    rcs = 10 * np.log10(snr / (REFERENCE_SNR * gain) * (np.maximum(distance, 1.0) / mode.reach) ** 4)
    seen = (np.abs(sine) <= edge) & (distance > mode.range_min) & (rcs >= spec.min_rcs)
    return tuple(column[seen] for column in (distance, rate, azimuth, elevation, snr, rcs, origin, thing))


def _at(key: Ints, wanted: Ints, values: Floats) -> Floats:
    """Return the values of the `wanted` bins, 0 for empty bins; `key` is sorted."""
    place = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
    return np.where(key[place] == wanted, values[place], 0.0) if len(key) else values


def _gain(spec: RadarSpec, mode: RadarMode, azimuth: Floats, elevation: Floats) -> Floats:
    """Return the two-way antenna gain relative to straight ahead."""
    return np.exp2(-2 * ((azimuth / (1.2 * mode.half_width)) ** 2 + (elevation / spec.half_height) ** 2))
