"""Per-ray work around Open3D's ray casting: aiming, picking, looking up, going through glass.

All kernels work on rays ``first <= i < last`` and write to these places only, so callers may share the rays
among threads in any way and get the same bits.
"""

import math

import numpy as np
from numba import njit

__all__ = [
    "aim",
    "collect",
    "improve",
    "look_around",
    "look_up",
    "restart",
    "through_glass",
    "uniform",
    "upright_box",
]

HALVINGS = 14  # of a triangle that fills much of the view

kernel = njit(cache=True, nogil=True, error_model="numpy")
inline = njit(cache=True, nogil=True, error_model="numpy", inline="always")


@inline
def uniform(a, b):
    """Return a number in [0, 1) that depends on two integers only (the finaliser of SplitMix64)."""
    z = (np.uint64(a) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(b) * np.uint64(
        0xD1B54A32D192ED03
    )
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return np.float64(z >> np.uint64(11)) * (1.0 / 9007199254740992.0)


@inline
def _diamond(x, y):
    """Return an angle without trigonometry: grows to the left, 0 along x, 1 along y, 4 a full turn."""
    total = abs(x) + abs(y)
    if total == 0:
        return 0.0
    share = x / total
    return 1 - share if y >= 0 else 3 + share


@inline
def _turned(angle):
    """Return the pseudo-angle's equal between -2 and 2."""
    return angle - 4 * math.floor(angle / 4 + 0.5)


@kernel
def aim(origin, directions, rotation, start, rays, first, last):
    """Write rays (n, 6): origins, and directions turned by `rotation` (3, 3).

    `origin` is (1, 3), shared, or one per direction; `start` is the number of the batch's first ray in both.
    """
    toward, out = directions[start + first : start + last], rays[first:last]
    a, b, c = rotation
    if len(origin) == 1:
        for i in range(len(out)):
            out[i, 0], out[i, 1], out[i, 2] = origin[0, 0], origin[0, 1], origin[0, 2]
    else:
        places = origin[start + first : start + last]
        for i in range(len(out)):
            out[i, 0], out[i, 1], out[i, 2] = places[i, 0], places[i, 1], places[i, 2]
    for i in range(len(out)):
        x, y, z = toward[i, 0], toward[i, 1], toward[i, 2]
        out[i, 3] = a[0] * x + a[1] * y + a[2] * z
        out[i, 4] = b[0] * x + b[1] * y + b[2] * z
        out[i, 5] = c[0] * x + c[1] * y + c[2] * z


@kernel
def look_up(rays, t, primitive, normals, materials, start, distance, material, thing, cosine, first, last):
    """Turn Open3D's answer about the static world into hits, from place `start` of the four results on."""
    rays, t, primitive, normals = rays[first:last], t[first:last], primitive[first:last], normals[first:last]
    distance, material = distance[start + first : start + last], material[start + first : start + last]
    thing, cosine = thing[start + first : start + last], cosine[start + first : start + last]
    thing[:] = -1
    distance[:] = t
    for i in range(len(t)):
        if t[i] < math.inf:
            material[i] = materials[primitive[i]]
        else:
            material[i] = 255
    for i in range(len(t)):  # the normal of no hit is (0, 0, 0)
        cosine[i] = abs(rays[i, 3] * normals[i, 0] + rays[i, 4] * normals[i, 1] + rays[i, 5] * normals[i, 2])


@kernel
def collect(rays, nearest, start, distance, index, picked, first, last):
    """Gather the rays that may hit a moving thing before they hit anything static.

    Parameters
    ----------
    nearest : (rows, sectors) float32
        From `look_around`.
    index : (n,) int32; picked : (n, 6) float32
        Filled from place `first` on: numbers of the rays in their batch, and the rays.

    Returns
    -------
    int
        How many there are.
    """
    rows, sectors = nearest.shape
    one, three = np.float32(1), np.float32(3)
    turn, rise = np.float32(sectors / 4), np.float32(rows / 2)
    place = first
    for i in range(first, last):
        x, y, z = rays[i, 3], rays[i, 4], rays[i, 5]
        across = abs(x) + abs(y)  # at least the run of the ray per metre
        share = x / max(across, np.float32(1e-30))
        angle = one - share if y >= 0 else three + share
        column = min(int(angle * turn), sectors - 1)
        row = max(0, min(int((z + one) * rise), rows - 1))
        near = nearest[row, column]
        if near < math.inf and not distance[start + i] * across < near:  # inf * 0 upright into the sky
            index[place] = i
            for k in range(6):
                picked[place, k] = rays[i, k]
            place += 1
    return place - first


@kernel
def improve(
    index,
    rays,
    t,
    primitive,
    normals,
    materials,
    things,
    base,
    start,
    distance,
    material,
    thing,
    cosine,
    first,
    last,
):
    """Where a second answer is nearer than the hit so far, take it.

    Answer i is about ray ``start + index[i]``; `base` (n,) or (1,) is how far it had come already.
    """
    for i in range(first, last):
        k = start + index[i]
        reach = t[i] + base[i if len(base) > 1 else 0]
        if reach < distance[k]:
            distance[k] = reach
            material[k] = materials[primitive[i]]
            thing[k] = things[primitive[i]]
            cosine[k] = abs(
                rays[i, 3] * normals[i, 0] + rays[i, 4] * normals[i, 1] + rays[i, 5] * normals[i, 2]
            )


@kernel
def through_glass(material, transmission, start, number, salt, candidates, index):
    """Choose the rays that pass through what they hit, by a hash of their number and `salt`.

    Parameters
    ----------
    material : (N,) uint8
        What each ray hit; those of the batch from place `start` on.
    number : int
        Of the batch's first ray.
    candidates : (n,) int32
        Rays of the batch to choose from.
    index : (>= n,) int32
        Filled with the chosen ones; may be the same array.

    Returns
    -------
    int
        How many.
    """
    chosen = 0
    for i in candidates:
        m = material[start + i]
        if m < len(transmission) and transmission[m] > 0 and uniform(number + i, salt) < transmission[m]:
            index[chosen] = i
            chosen += 1
    return chosen


@kernel
def restart(index, rays, skin, start, distance, material, thing, cosine, base, onward, first, last):
    """Let rays start anew behind what they hit: fill `base` (n,) and `onward` (n, 6), forget the hits."""
    for n in range(first, last):
        k = start + index[n]
        base[n] = distance[k] + skin
        for c in range(3):
            onward[n, c] = rays[index[n], c] + base[n] * rays[index[n], 3 + c]
            onward[n, 3 + c] = rays[index[n], 3 + c]
        distance[k] = math.inf
        material[k] = 255
        thing[k] = -1
        cosine[k] = 0


@kernel
def upright_box(vertices):
    """Find the box of least footprint around vertices (V, 3), of those turned by multiples of 15 degrees.

    Returns
    -------
    cosine, sine, x0, y0, z0, x1, y1, z1
        The turn, and two corners in the turned axes, 1 mm outside.
    """
    best = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    least = math.inf
    low, high = vertices[:, 2].min() - 1e-3, vertices[:, 2].max() + 1e-3
    for n in range(6):
        cosine, sine = math.cos(n * math.pi / 12), math.sin(n * math.pi / 12)
        x0, x1, y0, y1 = math.inf, -math.inf, math.inf, -math.inf
        for k in range(len(vertices)):
            x = cosine * vertices[k, 0] + sine * vertices[k, 1]
            y = cosine * vertices[k, 1] - sine * vertices[k, 0]
            x0, x1, y0, y1 = min(x0, x), max(x1, x), min(y0, y), max(y1, y)
        if (x1 - x0) * (y1 - y0) < least:
            least = (x1 - x0) * (y1 - y0)
            best = (cosine, sine, x0 - 1e-3, y0 - 1e-3, low, x1 + 1e-3, y1 + 1e-3, high)
    return best


@kernel
def _reach(corners, rows, sectors):
    """Return the nearest horizontal distance of a triangle around the origin, and the cells it may fill.

    `corners` is (3, 3). The cells are first row, last row, first column, number of columns.
    """
    near, far = math.inf, 0.0
    low, high = math.inf, -math.inf
    base, left, right = 0.0, 0.0, 0.0
    turn = 0.0  # its corners go once round the origin's vertical if that pierces the triangle
    for c in range(3):
        ax, ay, az = corners[c]
        bx, by = corners[(c + 1) % 3, 0], corners[(c + 1) % 3, 1]
        low, high = min(low, az), max(high, az)
        far = max(far, ax * ax + ay * ay)
        # nearest point of this edge
        ex, ey = bx - ax, by - ay
        length = ex * ex + ey * ey
        share = 0.0 if length == 0 else min(1.0, max(0.0, -(ax * ex + ay * ey) / length))
        px, py = ax + share * ex, ay + share * ey
        near = min(near, px * px + py * py)
        angle = _diamond(ax, ay)
        turn += _turned(_diamond(bx, by) - angle)
        if c == 0:
            base = angle
        else:
            off = _turned(angle - base)
            left, right = max(left, off), min(right, off)
    near, far = max(math.sqrt(near) - 1e-3, 0.0), math.sqrt(far)
    around = near < 1e-2 or abs(turn) > 2
    if around:
        near = 0.0
    # steepest directions down and up to anything between near and far, low and high
    down = low / math.hypot(low, near if low < 0 else far) if low != 0 else 0.0
    up = high / math.hypot(high, near if high > 0 else far) if high != 0 else 0.0
    lowest = max(0, int(math.floor((down + 1) * rows / 2 - 0.01)))
    highest = min(rows - 1, int(math.floor((up + 1) * rows / 2 + 0.01)))
    first = int(math.floor((base + right) * sectors / 4 - 0.01))
    count = min(int(math.floor((base + left) * sectors / 4 + 0.01)) - first + 1, sectors)
    if around:
        first, count = 0, sectors
    return near, lowest, highest, first, count


@kernel
def look_around(vertices, triangles, origin, nearest):
    """Find where around `origin` there are triangles.

    Parameters
    ----------
    vertices, triangles : (V, 3) float32, (T, 3) uint32
    origin : (3,) float64
    nearest : (rows, sectors) float32
        Filled: over the z of a unit direction from -1 to 1 and its pseudo-azimuth, the least horizontal
        distance of a triangle that it may hit [m]; inf where there is none. Errs on the near side only.
    """
    rows, sectors = nearest.shape
    nearest[:] = math.inf
    pieces = np.empty((HALVINGS + 2, 3, 3))
    halvings = np.empty(HALVINGS + 2, np.int64)
    for n in range(len(triangles)):
        for c in range(3):
            for k in range(3):
                pieces[0, c, k] = vertices[triangles[n, c], k] - origin[k]
        halvings[0] = 0
        waiting = 1
        while waiting:
            waiting -= 1
            near, lowest, highest, first, count = _reach(pieces[waiting], rows, sectors)
            if (highest - lowest + 1) * count > 64 and halvings[waiting] < HALVINGS:
                # a triangle seen from close by covers far less than the span of its corners: halve it
                longest, c = -1.0, 0
                for k in range(3):
                    length = 0.0
                    for axis in range(3):
                        length += (pieces[waiting, k, axis] - pieces[waiting, (k + 1) % 3, axis]) ** 2
                    if length > longest:
                        longest, c = length, k
                halvings[waiting] += 1
                halvings[waiting + 1] = halvings[waiting]
                for axis in range(3):
                    middle = (pieces[waiting, c, axis] + pieces[waiting, (c + 1) % 3, axis]) / 2
                    pieces[waiting + 1, :, axis] = pieces[waiting, :, axis]
                    pieces[waiting + 1, c, axis] = middle
                    pieces[waiting, (c + 1) % 3, axis] = middle
                waiting += 2
                continue
            for row in range(lowest, highest + 1):
                for k in range(first, first + count):
                    column = k % sectors
                    nearest[row, column] = min(nearest[row, column], np.float32(near))
