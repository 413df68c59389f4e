"""Reference of `height_layers` in numpy and scipy, in float64."""

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import grey_opening, maximum_filter

from geometric_reference.ground import lower_envelope, pull_push
from ogm.geometric.ground import ground_height
from ogm.geometric.ray import RayTrace
from ogm.grid import GridSpec

__all__ = ["terrain"]

Array = NDArray[Any]


def terrain(trace: RayTrace) -> dict[str, Array]:
    """Return the layers of `ogm.geometric.height_layers` by name."""
    spec, numbers, (x, y, z0) = trace.grid.spec, trace.numbers, trace.mount.ground_point
    cells = np.column_stack([a.ravel() for a in np.broadcast_arrays(*spec.cell_centers)])
    old = GridSpec(1 / float(trace.ground.per_metre), trace.ground.height.shape, spec.origin)

    # Returns of each cell
    xyz, above = np.column_stack(trace.points), trace.work.above[: len(trace.points.x)].astype(float)
    index = np.full(len(above), -1)
    inside = spec.contains(xyz[:, 0], xyz[:, 1])
    index[inside] = np.ravel_multi_index(spec.index(*xyz[inside, :2].T), spec.shape)
    low, high = np.float32(numbers.obstacle_height), np.float32(numbers.clearance)
    of_ground = inside & (above >= np.float32(-numbers.below_ground)) & (above <= low)
    count, total, squares = (_sums(index[of_ground], above[of_ground] ** power, spec.shape) for power in (0, 1, 2))
    top, hang = np.zeros(spec.shape), np.full(spec.shape, np.inf)
    standing, raised = inside & (above > low) & (above < high), inside & (above > low)
    np.maximum.at(top.ravel(), index[standing], above[standing])
    np.minimum.at(hang.ravel(), index[raised], above[raised])
    valid = (count > 0) & (maximum_filter(top, 3, mode="constant") == 0)

    # The ground without obstacles and without bulges
    def without(valid: Array) -> Array:
        weight = _sums(np.ravel_multi_index(old.index(*cells[valid.ravel()].T), old.shape), 1.0, old.shape)
        mended, under = trace.ground.height.astype(float), old.index(x, y)
        if weight[under] == 0:
            mended[under], weight[under] = z0, 1
        return pull_push(mended, np.minimum(weight, 8), z0)

    mended = without(valid)
    reach = max(int(5.0 / old.resolution + 0.5), 1)
    inner = (slice(reach, -reach),) * 2
    opening = grey_opening(np.pad(mended, reach, "reflect", reflect_type="odd"), (2 * reach + 1,) * 2, mode="nearest")
    bulges = mended - opening[inner] > 0.25
    valid &= ~bulges[old.index(*cells.T)].reshape(spec.shape)
    mended = without(valid)
    base = _at(mended, old, cells, spec)
    shift = _at(trace.ground.height, old, cells, spec) - base

    # Blocks
    size = max(int(0.64 / spec.resolution + 0.5), 1)
    blocks = GridSpec(spec.resolution * size, (-(-spec.shape[0] // size), -(-spec.shape[1] // size)), spec.origin)
    block = np.ravel_multi_index(blocks.index(*cells[valid.ravel()].T), blocks.shape)
    number, first, second = (
        _sums(block, values[valid], blocks.shape)
        for values in (count, total + count * shift, squares + 2 * shift * total + count * shift**2)
    )
    mean, has = first / np.maximum(number, 1), number > 0
    spread = np.maximum(second / np.maximum(number, 1) - mean**2, 0)
    gap = lower_envelope(np.where(has, 0.0, 1e3), blocks.resolution)
    deep = inside & (above < np.float32(-numbers.below_ground))
    gap[
        _sums(np.ravel_multi_index(blocks.index(*xyz[deep, :2].T), blocks.shape), 1.0, blocks.shape)
        > np.minimum(number, 8)
    ] = 1e3
    mean, spread = (pull_push(values, np.minimum(number, 8), 0.0) for values in (mean, spread))
    mean, spread, gap = (_at(values, blocks, cells, spec) for values in (mean, spread, gap))

    # Cells
    own, prior = total / np.maximum(count, 1) + shift, spread + 1e-4
    used = np.where(valid, count, 0)
    share = used * prior / (used * prior + np.maximum(spread, 1e-4))
    ground = base + mean + share * (own - mean)
    observed = trace.grid.mass[..., 0] > 0.1
    known = (gap <= 0.75 * blocks.resolution) | ((gap <= 3) & observed)
    known &= _at(bulges, old, cells, spec) < 0.5
    variance = (1 - share) * prior + np.where(valid, 0.3 * spread, 0) + 0.005**2 + (0.04 * gap) ** 2
    highest = np.where(top > 0, top + shift, 0)
    stands = (top > 0) & (hang < 0.5)
    surface = [np.where(count > 0, base + own, np.where(stands, base + highest, edge)) for edge in (-1e3, 1e3)]
    surface[0] = np.where(stands, base + highest, surface[0])
    return {
        "ground_height": np.where(known, ground, np.nan),
        "ground_variance": np.where(known, variance, np.nan),
        "slope": np.where(known, _slope(ground, spec.resolution), np.nan),
        "step": _step(surface[0], surface[1], mended, old, spec),
        "roughness": np.where(known, np.sqrt(spread), np.nan),
        "highest_obstacle": np.where(known | (top > 0), highest, np.nan),
        "clearance": np.where(np.isfinite(hang), hang + shift, np.nan),
    }


def _sums(index: Array, values: Any, shape: tuple[int, int]) -> Array:
    result = np.zeros(shape)
    np.add.at(result.ravel(), index, values)
    return result


def _at(values: Array, coarse: GridSpec, cells: Array, spec: GridSpec) -> Array:
    return ground_height(values.astype(np.float32), coarse, cells).astype(float).reshape(spec.shape)


def _slope(height: Array, resolution: float) -> Array:
    reach, index = max(int(0.5 / resolution + 0.5), 1), np.indices(height.shape)
    squares = np.zeros(height.shape)
    for axis in (0, 1):
        ends = [np.clip(index[axis] + s * reach, 0, height.shape[axis] - 1) for s in (-1, 1)]
        low, high = (np.take_along_axis(height, end, axis) for end in ends)
        squares += ((high - low) / ((ends[1] - ends[0]) * resolution)) ** 2
    return np.arctan(np.sqrt(squares))


def _step(high: Array, low: Array, ground: Array, coarse: GridSpec, spec: GridSpec) -> Array:
    reach = max(int(0.35 / spec.resolution + 0.5), 1)
    cells = np.column_stack([a.ravel() for a in np.broadcast_arrays(*spec.cell_centers)])
    rises = []
    for axis in (0, 1):
        rise, last = np.diff(ground, axis=axis), ground.shape[axis] - 2
        taken = [np.take(rise, np.clip(np.arange(last + 2) + t, 0, last), axis) for t in range(-3, 2)]
        rises.append(_at(np.median(taken, axis=0) * spec.resolution / coarse.resolution, coarse, cells, spec))
    window = []
    for values, reduce, empty in ((high, np.maximum, -1e3), (low, np.minimum, 1e3)):
        padded, edge = np.pad(values, reach, constant_values=empty), np.full(spec.shape, empty)
        along = np.pad(rises[1], reach, mode="edge")  # rise along y in the row of the shifted cell
        for i, j in itertools.product(range(-reach, reach + 1), repeat=2):
            here = tuple(slice(reach + s, reach + s + n) for s, n in zip((i, j), spec.shape, strict=True))
            row = (here[0], slice(reach, reach + spec.shape[1]))
            edge = reduce(edge, padded[here] - i * rises[0] - j * along[row])
        window.append(edge)
    step = window[0] - window[1]
    return np.where(step > -1e3, step, np.nan)
