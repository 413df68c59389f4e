"""What a lidar makes of the surfaces that its beams hit: how strong a return is, and where it seems to be.

The strength of a return is told in percent of what a matt white target seen head-on at the same place would
return, which is what Velodyne's calibrated intensities are up to 100.
"""

import math

from numba import njit
from numpy.typing import NDArray

from ogm.simulation.kernels import uniform
from ogm.simulation.materials import Material

__all__ = ["receive", "reflect"]

ROUGH = 0.3  # share that rough ground sends back the way it came at grazing incidence (Oren-Nayar)
LOBE = 0.01  # width of a specular reflection: square of the tangent of incidence
GLANCE = 2.0  # strength of a specular reflection seen head-on, of a white target's
FINE, COARSE = 0.8, 20.0  # [m] patches of a surface that differ in reflectivity
VARIETY = 0.1  # that no table of materials tells: what static surfaces differ more by
EDGE = 0.15  # [m] a smaller step of the range between neighbouring rays is no edge
PULSE = 0.6  # [m] returns closer together than this melt into one
SMEAR = 2.5  # [m] returns closer together than this may do so
SMEARED = 0.15  # share of those that do
SPECKLE = 0.18  # standard deviation of the logarithm of one return's strength
LOST = (
    0.015  # share of the returns of anything but the ground that are missing for no reason that can be seen
)
WAVER = 0.3  # standard deviation of the detection threshold, of itself
FOLIAGE, NOTHING = int(Material.FOLIAGE), 255


@njit(cache=True, nogil=True)
def _normal(a: int, b: int) -> float:
    """Return a standard normal number that depends on two integers only (Box-Muller)."""
    radius = math.sqrt(-2 * math.log(1 - uniform(2 * a, b)))
    return radius * math.cos(2 * math.pi * uniform(2 * a + 1, b))


@njit(cache=True, nogil=True)
def _patch(x: float, y: float, z: float, size: float) -> int:
    """Return a number for each cube of space."""
    i, j, k = math.floor(x / size), math.floor(y / size), math.floor(z / size)
    return int((i * 73856093) ^ (j * 19349663) ^ (k * 83492791))


@njit(cache=True, nogil=True)
def reflect(
    directions: NDArray,
    T: NDArray,
    distance: NDArray,
    material: NDArray,
    thing: NDArray,
    cosine: NDArray,
    optics: NDArray,
    coats: NDArray,
    strength: NDArray,
) -> None:
    """Fill in how strong the return of each ray would be if nothing disturbed it.

    Parameters
    ----------
    directions : (N, 3) float32
        In the sensor frame.
    T : (4, 4) float64
        ``T_world_sensor``: patches of static surfaces are fixed in the world.
    distance, material, thing, cosine : (N,)
        As `Hits`.
    optics : (materials, 5) float32
        As `ogm.simulation.materials.table`.
    coats : (K,) int64
        A number for each moving thing, which says how bright its own coat of each material is.
    strength : (N,) float32
        Filled; 0 where nothing is hit.
    """
    for i in range(len(strength)):
        m = material[i]
        if m >= len(optics) or not distance[i] < math.inf:
            strength[i] = 0
            continue
        reflectivity, spread = optics[m, 0], optics[m, 1]
        retro, specular = optics[m, 2], optics[m, 3]
        if thing[i] == -1:
            d = distance[i]
            x, y, z = d * directions[i, 0], d * directions[i, 1], d * directions[i, 2]
            wx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
            wy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
            wz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
            patch = 0.7 * _normal(_patch(wx, wy, wz, FINE), 64 + m)
            patch += 0.7 * _normal(_patch(wx, wy, wz, COARSE), 128 + m)
            spread += VARIETY
        else:  # one coat of paint per thing
            patch = _normal(coats[thing[i]] if thing[i] >= 0 else 0, m)
        share = min(1.0, reflectivity * math.exp(spread * patch))
        c = min(max(cosine[i], 1e-3), 1.0)
        matt = share * (c + ROUGH * (1 - specular) * (1 - c * c))
        mirror = GLANCE * specular * math.exp(-(1 / (c * c) - 1) / LOBE)
        strength[i] = 100 * (matt + mirror + retro * c)


@njit(cache=True, nogil=True)
def receive(
    shape: tuple[int, int],
    distance: NDArray,
    strength: NDArray,
    material: NDArray,
    thing: NDArray,
    cosine: NDArray,
    sideways: float,
    upwards: NDArray,
    shift: NDArray,
    limits: tuple[float, float, float],
    noise: tuple[float, float, float],
    bias: NDArray,
    gain: NDArray,
    air: tuple[float, float, float],
    steady: NDArray,
    seed: int,
    ranges: NDArray,
    intensities: NDArray,
    materials: NDArray,
    things: NDArray,
) -> None:
    """Turn what the rays hit into what the lidar reports.

    Parameters
    ----------
    shape : (layers, columns)
    distance, strength, material, thing, cosine : (layers * columns,)
        As `Hits`, and from `reflect`.
    sideways : float
        Half the beam's width, in columns.
    upwards : (layers,) float64
        The same in spacings to the layer above, 0 where that has nothing to do with this one.
    shift : (layers,) int64
        The column of the layer above that looks the same way is so many further.
    limits : (range_min, range_max, reach)
        [m]; see `LidarSpec`.
    noise : (range_noise, range_step, divergence)
        [m], [m], [rad].
    bias, gain : (layers,) float64
        Fixed error of the range [m] and factor of the strength, see `LidarSpec.errors`.
    air : (extinction, drops, depth)
        [1/m]; expected number of returns from the air on a free ray; their mean distance [m].
    steady : (256,) bool
        Materials whose returns are never lost for no reason: ground, and nothing. An argument and no constant,
        because compiled kernels are cached by the text of this file alone.
    seed : int
        Of everything random.
    ranges, intensities : (layers * columns,) float32; materials : uint8; things : int32
        Filled. No return: 0, 0, 255, -1.
    """
    layers, columns = shape
    near, far, reach = limits
    sigma, step, divergence = noise
    extinction, drops, depth = air
    for i in range(layers * columns):
        layer, column = i // columns, i % columns
        d, p, source = 1.0 * distance[i], 1.0 * strength[i], i
        # the beam's edge laps over to a neighbour: its light is shared
        for side in range(4):
            if side < 2:  # left and right
                other = layer * columns + (column + 2 * side - 1) % columns
                pair, half = 2 * min(i, other), sideways
                if abs(i - other) > 1:
                    pair = 2 * max(i, other)
            else:  # above and below
                above = layer if side == 2 else layer - 1
                if above < 0 or above + 1 >= layers:
                    continue
                half = upwards[above]
                if side == 2:
                    other = (layer + 1) * columns + (column + shift[above]) % columns
                    pair = 2 * i + 1
                else:
                    other = (layer - 1) * columns + (column - shift[above]) % columns
                    pair = 2 * other + 1
            if half <= 0:
                continue
            gap = abs(distance[other] - distance[i])
            if not gap > EDGE:  # also if both hit nothing
                continue
            edge = uniform(pair, seed)  # where it lies between the two rays' middles
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
        m, owner = material[source], thing[source]
        if m == FOLIAGE:  # leaves fill part of the beam
            p *= 0.1 + 0.9 * uniform(8 * i, seed + 2)
        p *= gain[layer]
        # air: it dims, and sometimes returns light itself
        if extinction > 0:
            p *= math.exp(-2 * extinction * min(d, 1e4))
        if drops > 0 and uniform(8 * i + 1, seed + 2) < 1 - math.exp(-drops):
            first = near - depth * math.log(1 - uniform(8 * i + 2, seed + 2))
            if first < d:
                d, p, m, owner = first, 4.0 * uniform(8 * i + 3, seed + 2), NOTHING, -1
        p *= math.exp(SPECKLE * _normal(4 * i + 2, seed + 2))
        # is it seen?
        threshold = 100 * (d / reach) ** 2
        lost = not near <= d <= far or p < threshold * (1 + WAVER * _normal(4 * i + 3, seed + 2))
        if not steady[m] and uniform(i, seed + 5) < LOST:
            lost = True
        if m == NOTHING and d < far:  # drops that are seen at all are so by definition
            lost = False
        if lost or p <= 0:
            ranges[i], intensities[i], materials[i], things[i] = 0, 0, NOTHING, -1
            continue
        # how exactly: weak returns, and those of a long footprint on slanting ground, are less so
        c = max(1.0 * cosine[source], 0.05)
        footprint = 0.03 * d * divergence * math.sqrt(1 - c * c) / c
        error = math.sqrt(sigma * sigma * (1 + threshold / p) + footprint * footprint)
        measured = round((d + bias[layer] + error * _normal(i, seed + 3)) / step) * step
        if not near <= measured <= far:
            ranges[i], intensities[i], materials[i], things[i] = 0, 0, NOTHING, -1
            continue
        ranges[i] = measured
        value = p if p <= 100 else 100 + 45 * math.log(p / 100)
        intensities[i] = round(min(value, 255.0)) / 255
        materials[i], things[i] = m, owner
