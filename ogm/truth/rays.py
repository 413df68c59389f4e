"""Observation of ground and obstacles in cells, from millions of rays: compiled, for the simulator."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.grid import GridSpec
from ogm.jit import kernel
from ogm.truth.observe import HEIGHT_LIMITS, HeightLimits


class _Rules(NamedTuple):
    resolution: float  # [m]
    x0: float  # origin of the grid [m]
    y0: float
    heights: HeightLimits


def observe_rays(
    seen: NDArray[np.uint8],
    highest: NDArray[np.float32],
    distance: NDArray[np.float32],
    directions: NDArray[np.float32],
    kind: NDArray[np.uint8],
    ground: NDArray[np.float32],
    rise: NDArray[np.float32],
    spec: GridSpec,
    heights: HeightLimits = HEIGHT_LIMITS,
) -> None:
    """Add hits of rays from the grid's (0, 0) to an observation, in one pass; `observe_points` is the reference.

    The arguments are not checked.

    Parameters
    ----------
    seen : (nx, ny) uint8, C-contiguous
        Changed in place; begin with zeros.
    highest : (nx, ny) float32, C-contiguous
        Height above ground of the highest obstacle hit in each cell [m]; changed in place, begin with zeros.
    distance : (N,) float32
        Range of each hit [m]; not finite for rays without hit.
    directions : (N, 3) float32
        Unit vectors in the grid's frame.
    kind : (N,) uint8
        `Kind` of each hit.
    ground : (nx, ny) float32
        z of the ground in each cell [m], at a step the lowest around; NaN in cells without ground.
    rise : (nx, ny) float32
        Abrupt rise or drop of the ground in each cell [m], for hits of `Kind.STEP`.
    spec : GridSpec
    heights : HeightLimits
    """
    rules = _Rules(spec.resolution, *spec.origin, heights)
    _observe_rays(seen, highest, distance, directions, kind, ground, rise, rules)


@kernel
def _observe_rays(
    seen: Any, highest: Any, distance: Any, directions: Any, kinds: Any, ground: Any, rise: Any, rules: _Rules
) -> None:
    nx, ny = seen.shape
    for n in range(len(distance)):
        kind = kinds[n]
        if kind == 4:  # Kind.OTHER
            continue
        t = np.float64(distance[n])
        if not t < 1e6:  # no hit; NaN
            continue
        u = (t * directions[n, 0] - rules.x0) / rules.resolution
        v = (t * directions[n, 1] - rules.y0) / rules.resolution
        if not (u >= 0 and v >= 0 and u < nx and v < ny):
            continue
        ix, iy = int(u), int(v)
        height = t * directions[n, 2] - ground[ix, iy]
        if not height < rules.heights.clearance:
            continue
        if kind == 3:  # Kind.STEP
            height = rise[ix, iy]
        if kind == 0 or (kind == 2 and height < rules.heights.plant):
            seen[ix, iy] |= 1
        elif height >= (rules.heights.plant if kind == 2 else rules.heights.obstacle):
            seen[ix, iy] |= 2
            highest[ix, iy] = max(highest[ix, iy], height)
