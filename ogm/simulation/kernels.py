"""Per-ray work around Open3D's ray casting: aiming, keeping the nearest hit, going through glass."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.jit import inline, kernel
from ogm.simulation.mesh import Array, Bytes, Floats32, Ints32


class Hits(NamedTuple):
    """What each ray hits first.

    Attributes
    ----------
    distance : (N,) float32
        [m]; inf for nothing.
    material : (N,) uint8
        `Material`; 255 for nothing.
    object : (N,) int32
        Number of the moving thing in the list given to `Scene.place`; -1 for static things or nothing, -2
        for the ego vehicle.
    cosine : (N,) float32
        Of the angle between ray and surface normal, [0, 1]; 0 for nothing.
    """

    distance: Floats32
    material: Bytes
    object: Ints32
    cosine: Floats32

    @classmethod
    def allocate(cls, count: int) -> "Hits":
        """Return arrays with arbitrary content."""
        columns: Any = (np.empty(count, dtype) for dtype in ("f4", "u1", "i4", "f4"))
        return cls(*columns)

    def part(self, start: int, stop: int) -> "Hits":
        """Return views of the hits of some rays."""
        columns: Any = (column[start:stop] for column in self)
        return Hits(*columns)

    def spread(self, index: NDArray[np.intp], count: int) -> "Hits":
        """Return the hits of `count` rays, of which these are those of `index`; the others hit nothing."""
        whole = Hits.allocate(count)
        whole.distance[:], whole.material[:], whole.object[:], whole.cosine[:] = np.inf, 255, -1, 0
        for k in range(len(self)):
            whole[k][index] = self[k]
        return whole


class Answer(NamedTuple):
    """What Open3D returns for n rays, and what its triangles are.

    Attributes
    ----------
    t : (n,) float32
        Distance [m]; inf for nothing.
    primitive : (n,) uint32
        Triangle.
    normals : (n, 3) float32
        Unit normal of the triangle; 0 for nothing.
    materials : (T,) uint8; things : (T,) int32
        `Hits.material` and `Hits.object` of each triangle.
    """

    t: Floats32
    primitive: NDArray[np.uint32]
    normals: Floats32
    materials: Bytes
    things: Ints32


@inline
def uniform(a: int, b: int) -> float:
    """Return a number in [0, 1) that depends on two integers only (the finaliser of SplitMix64)."""
    z = (np.uint64(a) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
    z = z + np.uint64(b) * np.uint64(0xD1B54A32D192ED03)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return np.float64(z >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@kernel
def aim(origins: Array, directions: Array, rotation: Array) -> Floats32:
    """Return rays (n, 6): origins (1 or n, 3), and directions turned by `rotation` (3, 3)."""
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
    """Where an answer is nearer than the hit so far, take it, and its normal where `normals` (N, 3) are wanted.

    Answer i belongs to ray `index[i]` of `hits` and to `rays[i]`, which starts `base[i]` [m] from the sensor.
    """
    for i in range(len(index)):
        k = index[i]
        reach = answer.t[i] + base[i]
        if reach < hits.distance[k]:
            normal = answer.normals[i]
            hits.distance[k] = reach
            hits.material[k] = answer.materials[answer.primitive[i]]
            hits.object[k] = answer.things[answer.primitive[i]]
            hits.cosine[k] = abs(rays[i, 3] * normal[0] + rays[i, 4] * normal[1] + rays[i, 5] * normal[2])
            if len(normals):
                for c in range(3):
                    normals[k, c] = normal[c]


@kernel
def transmitted(material: Bytes, transmission: Array, first: int, salt: int, index: Ints32) -> Ints32:
    """Return those of the rays `index` that pass through what they hit, by a hash of their number and `salt`.

    `material` (n,) is what each ray of a batch hit; `first` is the number of its first ray.
    """
    passed = np.zeros(len(index), np.bool_)
    for n in range(len(index)):
        m = material[index[n]]
        if m < len(transmission) and transmission[m] > 0:
            passed[n] = uniform(first + index[n], salt) < transmission[m]
    return index[passed]


@kernel
def restart(hits: Hits, index: Ints32, rays: Floats32, skin: np.float32) -> tuple[Floats32, Floats32]:
    """Return rays (n, 6) that start behind what the rays `index` hit, and how far they had come; forget the hits."""
    onward, base = np.empty((len(index), 6), np.float32), np.empty(len(index), np.float32)
    for n in range(len(index)):
        k = index[n]
        base[n] = hits.distance[k] + skin
        for c in range(3):
            onward[n, c] = rays[k, c] + base[n] * rays[k, 3 + c]
            onward[n, 3 + c] = rays[k, 3 + c]
        hits.distance[k], hits.material[k], hits.object[k], hits.cosine[k] = math.inf, 255, -1, 0
    return onward, base
