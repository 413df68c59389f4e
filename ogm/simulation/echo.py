"""Strength and measured range of a lidar's returns.

The strength of a return is given in percent of the return of a matt white target at the same place, hit head-on. This
equals Velodyne's calibrated intensities up to 100.
"""

import math
from typing import NamedTuple

from ogm.jit import kernel
from ogm.simulation.kernels import Hits, uniform
from ogm.simulation.materials import Material
from ogm.simulation.mesh import Array, Bytes, Floats, Floats32, Ints, Ints32

ROUGH = 0.3  # share that rough ground reflects back at grazing incidence (Oren-Nayar)
LOBE = 0.01  # width of a specular reflection: squared tangent of the incidence angle
GLANCE = 2.0  # strength of a specular reflection hit head-on, relative to a white target
FINE, COARSE = 0.8, 20.0  # [m] sizes of surface patches that differ in reflectivity
VARIETY = 0.1  # additional spread of static surfaces, not in the table of materials
EDGE = 0.15  # [m] smaller range steps between neighbouring rays are no edges
BEND = 1.5  # limit for surfaces that meet, relative to the range step on a plane: ground bends
PULSE = 0.6  # [m] returns closer together are always merged
SMEAR = 2.5  # [m] returns closer together may be merged
SMEARED = 0.15  # share of such returns that are merged
SPECKLE = 0.18  # standard deviation of the logarithm of a return's strength
LOST = 0.015  # share of returns, except those from ground, that are lost at random
WAVER = 0.3  # standard deviation of the detection threshold, relative to it
FOLIAGE, NO_MATERIAL = int(Material.FOLIAGE), 255


class Device(NamedTuple):
    """Parameters of a lidar for kernels.

    Attributes
    ----------
    layers, columns : int
        Size of a range image.
    sideways : float
        Half the beam width [columns].
    upwards : (layers,) float64
        Half the beam width in units of the spacing to the layer above; 0 if that is no neighbour.
    shift : (layers,) int64
        Column offset of the beam with the same direction in the layer above.
    near, far, reach : float
        `LidarSpec.range_min`, `range_max` and `reach` [m].
    noise, step, divergence : float
        `LidarSpec.range_noise` [m], `range_step` [m] and `divergence` [rad].
    bias, gain : (layers,) float64
        Fixed range error [m] and gain factor of each layer, see `LidarSpec.errors`.
    turns : bool
        Whether the last and first columns are neighbours.
    """

    layers: int
    columns: int
    sideways: float
    upwards: Floats
    shift: Ints
    near: float
    far: float
    reach: float
    noise: float
    step: float
    divergence: float
    bias: Floats
    gain: Floats
    turns: bool


class Air(NamedTuple):
    """Extinction coefficient [1/m], expected returns from drops on a free ray, and their mean distance [m]."""

    extinction: float
    drops: float
    depth: float


class RangeImage(NamedTuple):
    """Range image of one turn of a lidar, (layers, columns) per attribute, the lowest layer first.

    Attributes
    ----------
    range : float32
        Range [m]; 0 without return.
    intensity : float32
        Intensity [0, 1] in steps of 1/255: up to 100/255 in percent of a matt white target, above for retroreflectors.
    object : int32
        See `Hits`; -1 also without return.
    material : uint8
        `Material`; 255 without return and for drops in the air.
    """

    range: Floats32
    intensity: Floats32
    object: Ints32
    material: Bytes


@kernel
def _normal(a: int, b: int) -> float:
    """Return a standard normal number that is a hash of two integers (Box-Muller)."""
    radius = math.sqrt(-2 * math.log(1 - uniform(2 * a, b)))
    return radius * math.cos(2 * math.pi * uniform(2 * a + 1, b))


@kernel
def _patch(x: float, y: float, z: float, size: float) -> int:
    """Return a hash of the cube that contains a point."""
    i, j, k = math.floor(x / size), math.floor(y / size), math.floor(z / size)
    return int((i * 73856093) ^ (j * 19349663) ^ (k * 83492791))


@kernel
def reflect(directions: Array, T: Array, hits: Hits, optics: Array, paints: Array, strength: Array) -> None:
    """Fill in the undisturbed strength of each ray's return.

    Parameters
    ----------
    directions : (N, 3) float32
        Unit directions in the sensor frame.
    T : (4, 4) float64
        ``T_world_sensor``; patches of static surfaces are fixed in the world.
    hits : Hits
    optics : (materials, 5) float32
        See `ogm.simulation.materials.table`.
    paints : (K,) int64
        Seed of each moving object, which determines the brightness of its materials.
    strength : (N,) float32
        Output [percent]; 0 without a hit.
    """
    for i in range(len(strength)):
        m, thing = hits.material[i], hits.object[i]
        d = hits.distance[i]
        if m >= len(optics) or not d < math.inf:
            strength[i] = 0
            continue
        reflectivity, spread = optics[m, 0], optics[m, 1]
        retro, specular = optics[m, 2], optics[m, 3]
        if thing == -1:
            x, y, z = d * directions[i, 0], d * directions[i, 1], d * directions[i, 2]
            wx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            wy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            wz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            patch = 0.7 * _normal(_patch(wx, wy, wz, FINE), 64 + m)
            patch += 0.7 * _normal(_patch(wx, wy, wz, COARSE), 128 + m)
            spread += VARIETY
        else:  # one coat of paint per object
            patch = _normal(paints[thing] if thing >= 0 else 0, m)
        share = min(1.0, reflectivity * math.exp(spread * patch))
        c = min(max(hits.cosine[i], 1e-3), 1.0)
        matt = share * (c + ROUGH * (1 - specular) * (1 - c * c))
        mirror = GLANCE * specular * math.exp(-(1 / (c * c) - 1) / LOBE)
        strength[i] = 100 * (matt + mirror + retro * c)


@kernel
def _neighbour(i: int, side: int, device: Device) -> tuple[int, int, float]:
    """Return the index of a neighbouring ray, a number of the pair, and half the beam width in its direction.

    `side` is 0 for left, 1 for right, 2 for above, 3 for below. The width is 0 without a neighbour.
    """
    columns = device.columns
    layer, column = i // columns, i % columns
    if side < 2:  # left and right
        other = layer * columns + (column + 2 * side - 1) % columns
        pair = 2 * min(i, other)
        if abs(i - other) > 1:
            if not device.turns:
                return i, 0, 0.0
            pair = 2 * max(i, other)
        return other, pair, device.sideways
    above = layer if side == 2 else layer - 1
    if above < 0 or above + 1 >= device.layers:
        return i, 0, 0.0
    if side == 2:
        other = (layer + 1) * columns + (column + device.shift[above]) % columns
        return other, 2 * i + 1, device.upwards[above]
    other = (layer - 1) * columns + (column - device.shift[above]) % columns
    return other, 2 * other + 1, device.upwards[above]


@kernel
def _is_edge(first: int, second: int, apart: float, hits: Hits) -> bool:
    """Return whether two rays, `apart` [rad], hit surfaces behind one another.

    This is neither a slanted surface nor two surfaces that meet. Surfaces meet if one of them, extended as a plane,
    reaches the distance of the other between the rays. A plane hit at distance d and incidence a has distance D on the
    next ray, with ``|D - d| <= apart * D * tan(a)``.
    """
    near, far = (first, second) if hits.distance[first] < hits.distance[second] else (second, first)
    gap: float = 1.0 * hits.distance[far] - hits.distance[near]
    if not gap > EDGE:  # also if both hit nothing
        return False
    c = max(1.0 * hits.cosine[near], 1e-3)
    slant: float = BEND * apart * math.sqrt(max(1 - c * c, 0.0)) / c
    if gap == math.inf:
        return slant < 1
    c = max(1.0 * hits.cosine[far], 1e-3)
    back = BEND * apart * math.sqrt(max(1 - c * c, 0.0)) / c
    reach: float = max(slant * hits.distance[far], back * hits.distance[near])
    return gap > EDGE + reach


@kernel
def _share_light(i: int, hits: Hits, strength: Array, device: Device, seed: int) -> tuple[float, float, int]:
    """Return distance, strength and source ray of ray i's return; its beam may overlap neighbours at edges."""
    distance = hits.distance
    d, p, source = 1.0 * distance[i], 1.0 * strength[i], i
    for side in range(4):
        other, pair, half = _neighbour(i, side, device)
        if half <= 0:
            continue
        if not _is_edge(i, other, device.divergence / (2 * half), hits):
            continue
        gap = abs(distance[other] - distance[i])
        edge = uniform(pair, seed)  # position between the middles of the two rays
        if i > other:
            edge = 1 - edge
        if edge >= half:
            continue
        lap = 0.5 * (half - edge) / half
        theirs = lap * strength[other]
        p *= 1 - lap
        if theirs <= 0:
            continue
        if source == i and (gap < PULSE or (gap < SMEAR and uniform(pair, seed + 1) < SMEARED)):
            if p + theirs > 0:
                d += (distance[other] - d) * theirs / (p + theirs)
                p += theirs
        elif d == math.inf or theirs * d * d > p * (1.0 * distance[other]) ** 2:
            d, p, source = (1.0 * distance[other]), theirs, other
    return d, p, source


@kernel
def receive(hits: Hits, strength: Array, device: Device, air: Air, steady: Array, seed: int, image: RangeImage) -> None:
    """Convert hits to the reported range image.

    Parameters
    ----------
    hits, strength : (layers * columns,)
        Results of `Scene.cast` and `reflect`.
    device : Device
    air : Air
    steady : (256,) bool
        Materials without random losses: ground, and no hit. An argument instead of a constant, because compiled
        kernels are cached by the source of this file only.
    seed : int
        Seed of all random numbers.
    image : RangeImage
        Output, (layers * columns,) per attribute. Without return: 0, 0, -1, 255.
    """
    near, far = device.near, device.far
    for i in range(device.layers * device.columns):
        image.range[i], image.intensity[i], image.object[i], image.material[i] = 0, 0, -1, NO_MATERIAL
        layer = i // device.columns
        d, p, source = _share_light(i, hits, strength, device, seed)
        m, owner = hits.material[source], hits.object[source]
        if m == FOLIAGE:  # leaves fill part of the beam
            p *= 0.1 + 0.9 * uniform(8 * i, seed + 2)
        p *= device.gain[layer]
        # Air attenuates the return, and drops in it may return light.
        if air.extinction > 0:
            p *= math.exp(-2 * air.extinction * min(d, 1e4))
        if air.drops > 0 and uniform(8 * i + 1, seed + 2) < 1 - math.exp(-air.drops):
            first = near - air.depth * math.log(1 - uniform(8 * i + 2, seed + 2))
            if first < d:
                d, p, m, owner = first, 4.0 * uniform(8 * i + 3, seed + 2), NO_MATERIAL, -1
        p *= math.exp(SPECKLE * _normal(4 * i + 2, seed + 2))
        # Detection.
        threshold = 100 * (d / device.reach) ** 2
        lost = not near <= d <= far or p < threshold * (1 + WAVER * _normal(4 * i + 3, seed + 2))
        if not steady[m] and uniform(i, seed + 5) < LOST:
            lost = True
        if m == NO_MATERIAL and d < far:  # `drops` counts detected returns only
            lost = False
        if lost or p <= 0:
            continue
        # Accuracy: weak returns, and long footprints on slanted ground, have larger errors.
        c = max(1.0 * hits.cosine[source], 0.05)
        footprint = 0.03 * d * device.divergence * math.sqrt(1 - c * c) / c
        error = math.sqrt(device.noise * device.noise * (1 + threshold / p) + footprint * footprint)
        measured = round((d + device.bias[layer] + error * _normal(i, seed + 3)) / device.step) * device.step
        if not near <= measured <= far:
            continue
        image.range[i] = measured
        value = p if p <= 100 else 100 + 45 * math.log(p / 100)
        image.intensity[i] = round(min(value, 255.0)) / 255
        image.object[i], image.material[i] = owner, m
