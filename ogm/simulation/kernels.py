"""Kernels around Open3D's ray casting: ray directions, nearest hit, glass, dust, and the visibility of a scan."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.jit import inline, kernel
from ogm.simulation.mesh import Array, Bytes, Floats, Floats32, Ints32, Mask


class Hits(NamedTuple):
    """First hit of each ray.

    Attributes
    ----------
    distance : (N,) float32
        Distance [m]; inf without a hit.
    material : (N,) uint8
        `Material` of the surface; 255 without a hit.
    object : (N,) int32
        Index of the moving object in the list given to `Scene.place`; -1 for static surfaces and without a hit, -2 for
        the ego vehicle.
    cosine : (N,) float32
        Cosine of the angle between ray and surface normal, [0, 1]; 0 without a hit.
    """

    distance: Floats32
    material: Bytes
    object: Ints32
    cosine: Floats32

    @classmethod
    def allocate(cls, count: int) -> "Hits":
        """Return the hits of rays that hit nothing."""
        return cls._make(
            np.full(count, value, dtype) for value, dtype in ((np.inf, "f4"), (255, "u1"), (-1, "i4"), (0, "f4"))
        )

    def part(self, start: int, stop: int) -> "Hits":
        """Return views of the hits of the rays from `start` to `stop`."""
        return Hits._make(column[start:stop] for column in self)

    def spread(self, index: NDArray[np.intp], count: int) -> "Hits":
        """Return hits of `count` rays with these at positions `index`; the other rays hit nothing."""
        whole = Hits.allocate(count)
        for k in range(len(self)):
            whole[k][index] = self[k]
        return whole


class Answer(NamedTuple):
    """Result of Open3D for n rays, with the attributes of its triangles.

    Attributes
    ----------
    t : (n,) float32
        Distance [m]; inf without a hit.
    primitive : (n,) uint32
        Index of the triangle.
    normals : (n, 3) float32
        Unit normal of the triangle; 0 without a hit.
    materials : (T,) uint8; objects : (T,) int32
        `Hits.material` and `Hits.object` of each triangle.
    """

    t: Floats32
    primitive: NDArray[np.uint32]
    normals: Floats32
    materials: Bytes
    objects: Ints32


@inline
def uniform(a: int, b: int) -> float:
    """Return a number in [0, 1) that is a hash of two integers (the finaliser of SplitMix64)."""
    z = (np.uint64(a) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    z = z + np.uint64(b) * np.uint64(0xD1B54A32D192ED03)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return np.float64(z >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@kernel
def aim(origins: Array, directions: Array, rotation: Array) -> Floats32:
    """Return rays (n, 6) from origins (1 or n, 3) and directions rotated by `rotation` (3, 3)."""
    rays = np.empty((len(directions), 6), np.float32)
    a, b, c = rotation
    for i in range(len(rays)):
        k = i if len(origins) > 1 else 0
        rays[i, 0], rays[i, 1], rays[i, 2] = origins[k, 0], origins[k, 1], origins[k, 2]
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        rays[i, 3] = a[0] * x + a[1] * y + a[2] * z
        rays[i, 4] = b[0] * x + b[1] * y + b[2] * z
        rays[i, 5] = c[0] * x + c[1] * y + c[2] * z
    return rays


@kernel
def keep_nearer(hits: Hits, index: Ints32, rays: Floats32, base: Floats32, answer: Answer, normals: Floats32) -> None:
    """Update hits by nearer answers in place, and their `normals` (N, 3) unless that array is empty.

    Answer i belongs to ray `index[i]` of `hits` and to `rays[i]`, which starts `base[i]` [m] from the sensor.
    """
    for i in range(len(index)):
        k = index[i]
        reach = answer.t[i] + base[i]
        if reach < hits.distance[k]:
            normal = answer.normals[i]
            hits.distance[k] = reach
            hits.material[k] = answer.materials[answer.primitive[i]]
            hits.object[k] = answer.objects[answer.primitive[i]]
            hits.cosine[k] = abs(rays[i, 3] * normal[0] + rays[i, 4] * normal[1] + rays[i, 5] * normal[2])
            if len(normals):
                for c in range(3):
                    normals[k, c] = normal[c]


@kernel
def transmitted(material: Bytes, transmission: Array, first: int, salt: int, index: Ints32) -> Ints32:
    """Return the rays of `index` that pass through the glass they hit, selected by a hash of ray number and `salt`.

    `material` (n,) is the material that each ray of a batch hit; `first` is the number of the first ray.
    """
    passed = np.zeros(len(index), np.bool_)
    for n in range(len(index)):
        m = material[index[n]]
        if m < len(transmission) and transmission[m] > 0:
            passed[n] = uniform(first + index[n], salt) < transmission[m]
    return index[passed]


@kernel
def restart(hits: Hits, index: Ints32, rays: Floats32, skin: np.float32) -> tuple[Floats32, Floats32]:
    """Return the rays (n, 6) that continue behind their hits, and their distances so far [m]; reset these hits."""
    onward, base = np.empty((len(index), 6), np.float32), np.empty(len(index), np.float32)
    for n in range(len(index)):
        k = index[n]
        base[n] = hits.distance[k] + skin
        for c in range(3):
            onward[n, c] = rays[k, c] + base[n] * rays[k, 3 + c]
            onward[n, 3 + c] = rays[k, 3 + c]
        hits.distance[k], hits.material[k], hits.object[k], hits.cosine[k] = math.inf, 255, -1, 0
    return onward, base


BINS = 3600  # azimuth bins of a view
# Returned shares relative to a white target: grass or gravel at grazing incidence; a bright wall or leaf head-on.
BRIGHT_GROUND, BRIGHT_WALL = 0.1, 0.3


class View(NamedTuple):
    """Visibility of a scan: elevations per azimuth bin, and limits of the range.

    Attributes
    ----------
    low, high : (BINS,) float32
        Sines of the lowest and highest visible elevation per azimuth bin, starting at -pi; `low` exceeds `high` in bins
        without visible elevations.
    near, far, reach : float
        `LidarSpec.range_min`, `range_max` and `reach` [m].
    extinction : float
        Extinction coefficient of the air [1/m].
    dust : (P, 5) float64
        Balls of dust, see `ogm.simulation.conditions.Conditions`.
    """

    low: Floats32
    high: Floats32
    near: float
    far: float
    reach: float
    extinction: float
    dust: Floats


def make_view(directions: Floats32, active: Mask, limits: tuple[float, float, float], air: float, dust: Floats) -> View:
    """Return the visibility of a scan.

    Parameters
    ----------
    directions : (layers, columns, 3) float32
        Unit directions of all beams in the sensor's frame.
    active : (layers, columns) bool
        Beams that are not blocked or missing.
    limits : (near, far, reach)
        See `View` [m].
    air : float
        Extinction coefficient [1/m].
    dust : (P, 5) float64
    """  # fmt: skip
    low, high = np.full(BINS, 2, np.float32), np.full(BINS, -2, np.float32)
    half = max(1, math.ceil(BINS / directions.shape[1] / 2))  # bins covered by half a column
    _widen(low, high, directions, active, half)
    return View(low, high, *limits, air, dust)


@kernel
def _bin(x: float, y: float) -> int:
    return int((math.atan2(y, x) / (2 * math.pi) + 0.5) * BINS) % BINS


@kernel
def _widen(low: Floats32, high: Floats32, directions: Floats32, active: Mask, half: int) -> None:
    layers, columns = active.shape
    for i in range(layers):
        for j in range(columns):
            if not active[i, j]:
                continue
            z, middle = directions[i, j, 2], _bin(directions[i, j, 0], directions[i, j, 1])
            for k in range(middle - half, middle + half + 1):
                b = k % BINS
                low[b], high[b] = min(low[b], z), max(high[b], z)


@kernel
def in_view(directions: Array, view: View) -> Array:
    """Return a mask (N,) of the rays (N, 3) within the view; rays are unit vectors in the sensor's frame."""
    result = np.zeros(len(directions), np.bool_)
    for i in range(len(directions)):
        b = _bin(directions[i, 0], directions[i, 1])
        result[i] = view.low[b] <= directions[i, 2] <= view.high[b]
    return result


@kernel
def _meet(direction: Array, ball: Array, far: float) -> tuple[float, float, float]:
    """Return the distances at which a ray enters and leaves a dust ball, at most `far` [m], and the optical depth."""
    along = direction[0] * ball[0] + direction[1] * ball[1] + direction[2] * ball[2]
    apart = ball[0] ** 2 + ball[1] ** 2 + ball[2] ** 2 - along * along
    inside = ball[3] ** 2 - apart
    if inside <= 0:
        return 0.0, 0.0, 0.0
    half = math.sqrt(inside)
    start, stop = min(max(along - half, 0.0), far), min(max(along + half, 0.0), far)
    # Extinction falls as 1 - (r / radius)^2: its integral along the whole chord, times the share of it before `far`.
    return start, stop, ball[4] * 4 / 3 * half**3 / ball[3] ** 2 * (stop - start) / (2 * half)


@kernel
def lose_sight(distance: Array, directions: Array, ground: Array, view: View) -> None:
    """Set distances (N,) to inf for hits too far for the lidar to see even a bright surface there.

    Hits of `ground` (N,) bool count as bright ground at grazing incidence, all others as a bright wall hit head-on.
    """
    for i in range(len(distance)):
        d = 1.0 * distance[i]
        if not d < math.inf:
            continue
        depth = view.extinction * d
        sent_back = BRIGHT_GROUND if ground[i] else BRIGHT_WALL
        for k in range(len(view.dust)):
            depth += _meet(directions[i], view.dust[k], d)[2]
        if not view.near <= d <= view.far or sent_back * math.exp(-2 * depth) < (d / view.reach) ** 2:
            distance[i] = math.inf


@kernel
def beams_in_dust(
    distance: Array, strength: Array, directions: Array, dust: Array, draws: Array, scattered: Array
) -> None:
    """Apply dust to returns: attenuate them, or replace them by returns from the dust.

    Parameters
    ----------
    distance, strength : (N,) float32
        Ranges [m] and strengths [percent] of the returns; changed in place.
    directions : (N, 3) float32
        Unit directions in the sensor's frame.
    dust : (P, 5) float64
        Balls of dust, see `ogm.simulation.conditions.Conditions`.
    draws : (N, 3) float32
        Uniform random numbers in [0, 1).
    scattered : (N,) bool
        Set to True for returns from dust.
    """
    for i in range(len(distance)):
        wanted, depth, nearest = -math.log(1.0 - draws[i, 0]), 0.0, math.inf
        for k in range(len(dust)):
            start, stop, through = _meet(directions[i], dust[k], min(1.0 * distance[i], 1e3))
            if through <= 0:
                continue
            if depth + through > wanted:
                nearest = min(nearest, start + (stop - start) * draws[i, 2])
            depth += through
        if nearest < math.inf and draws[i, 1] < 0.7:
            distance[i], strength[i], scattered[i] = nearest, 2.0 + 18.0 * draws[i, 1], True
        else:
            strength[i] *= math.exp(-2 * depth)
