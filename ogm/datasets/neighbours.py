"""Truth of a frame from neighbouring scans of the same drive, and the ground that their heights count from.

The ground is not estimated by a sensor model's estimator, which this truth shall evaluate: `find_ground` shares
nothing with `ogm.geometric`.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.frames import EGO
from ogm.extras import import_extra
from ogm.grid import GridSpec
from ogm.scan import Boxes
from ogm.state import Truth
from ogm.truth import TRUTH_SPEC, cells_in_boxes, truth_from_scans
from ogm.truth.points import height_above_ground
from ogm.truth.scans import MARGIN, contradicted, ignore_cells

_REACH = 50.0  # [m] scans that were taken farther away hardly see the same cells
_SPAN = 30.0  # [s] before and after: later, parked cars have left and poses have drifted
_MOST = 40  # scans, spread evenly over those in reach
_AROUND = 1.0  # [m] beyond the grid, to interpolate the ground at its edge

_SQUARE = 1.0  # [m] side of the squares that the ground is estimated on
_LOW = 0.05  # quantile of the heights in a square that is its ground: ghost returns lie below, objects above
_MEDIAN = 5  # squares; what lies `_PIT` below the median around it is a ghost
_PIT = 0.5  # [m]
_SLOPE = 0.15  # most that ground rises from one square to another ...
_RADIUS = 5  # ... so many squares away,
_STEP = 0.1  # [m] and a kerb more
_BAND = 0.2  # [m] above and below the ground of its square, a point is a ground point
_DRAWN = 500_000  # points that the ground is estimated from, drawn at random of more


def choose_neighbours(n: int, stamps: NDArray[np.float64], places: NDArray[np.float64], *, later: bool) -> list[int]:
    """Choose the scans that show the surroundings of scan n: those near it in space and time, never itself.

    Parameters
    ----------
    n : int
    stamps : (K,) float
        Times of the drive's scans [s].
    places : (K, 3) float
        Positions of its sensor [m].
    later : bool
        Only those after scan n.
    """
    near = np.linalg.norm(places - places[n], axis=1) <= _REACH
    near &= np.abs(stamps - stamps[n]) <= _SPAN
    near[n] = False
    if later:
        near[: n + 1] = False
    found = np.flatnonzero(near)
    if len(found) > _MOST:
        found = found[np.round(np.linspace(0, len(found) - 1, _MOST)).astype(int)]
    return [int(one) for one in found]


def ego_path_cells(poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the cells of `TRUTH_SPEC` that the ego vehicle covered in any of some scans.

    Parameters
    ----------
    poses : (K, 4, 4) float
        Of its sensor in those scans, in the frame of the grid.
    """
    car = Boxes(np.zeros(3), np.array([EGO[1] - EGO[0], EGO[3] - EGO[2], 1.0]), np.zeros(1))
    result = np.zeros(TRUTH_SPEC.shape, bool)
    for T in poses[np.linalg.norm(poses[:, :3, 3], axis=1) <= TRUTH_SPEC.length]:
        result |= cells_in_boxes(car.moved(T), TRUTH_SPEC)
    return result


def truth_from_neighbours(
    clouds: Sequence[NDArray[np.float32]],
    spec: GridSpec,
    moving: Boxes,
    *,
    own: NDArray[np.float32] | None = None,
    is_ground: Sequence[NDArray[np.bool_]] | None = None,
    map_ground: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
    min_scans: int = 2,
) -> Truth:
    """Return the truth that neighbouring scans agree on, in the frame of one scan.

    Parameters
    ----------
    clouds : sequence of (N, 4) float32
        Points of each [m], without what moves.
    spec : GridSpec
    moving : Boxes
        Moving objects in the scan: the cells under them and `MARGIN` around are ignored.
    own : (N, 4) float32, optional
        Points of the scan itself. They do not make cells known, but cells in which they show the opposite of the
        neighbours are ignored: `contradicted`.
    is_ground : sequence of (N,) bool, optional
        Points of each cloud that are labelled as ground. Heights are then above these.
    map_ground : function, optional
        (N, 3) places -> (N,) z of a map's ground there [m], NaN where it is not known. Heights are then above this;
        without map and labels, above the ground points that `find_ground` finds in all clouds together.
    min_scans : int
        As in `truth_from_scans`.
    """
    x0, x1, y0, y1 = spec.extent
    edges = x0 - _AROUND, x1 + _AROUND, y0 - _AROUND, y1 + _AROUND
    kept = [_within(cloud, edges) for cloud in clouds]
    near = [cloud[keep] for cloud, keep in zip(clouds, kept, strict=True)]
    own = np.empty((0, 4), np.float32) if own is None else own[_within(own, edges)]
    xyz = np.concatenate([*near, own])[:, :3].astype(np.float64)
    if map_ground is not None:
        high = xyz[:, 2] - map_ground(xyz)
    else:
        flags = np.zeros(len(xyz), bool)
        if is_ground is None:
            flags[: len(xyz) - len(own)] = find_ground(xyz[: len(xyz) - len(own)])
        else:
            labelled = [one[keep] for one, keep in zip(is_ground, kept, strict=True)]
            flags[: len(xyz) - len(own)] = np.concatenate(labelled)
        high = height_above_ground(xyz, flags)
    *above, own_above = np.split(high, np.cumsum([len(cloud) for cloud in near]))
    truth = truth_from_scans(
        near, above, spec, min_scans=min_scans, moving=cells_in_boxes(moving.widened(MARGIN), spec)
    )
    return ignore_cells(truth, contradicted(truth, own, own_above)) if len(own) else truth


def find_ground(xyz: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which points of aggregated scans are ground points, (N,); of many, only of those that are drawn.

    The ground of a square of 1 m is the 5 % quantile of its points' heights. Squares far below the median around
    them hold ghost returns, and squares that rise more than 15 % and a kerb above a lower one within 5 m hold
    objects; neither has ground points. In the others, points within 0.2 m of that height are ground points.

    Parameters
    ----------
    xyz : (N, 3) float64
        Points [m].
    """
    result = np.zeros(len(xyz), bool)
    if not len(xyz):
        return result
    drawn = np.random.default_rng(0).choice(len(xyz), min(len(xyz), _DRAWN), replace=False)
    square = np.floor(xyz[drawn, :2] / _SQUARE).astype(np.int64)
    square -= square.min(axis=0)
    shape = tuple(square.max(axis=0) + 1)
    flat, z = np.ravel_multi_index(tuple(square.T), shape), xyz[drawn, 2]
    order = np.lexsort((z, flat))
    squares, first, count = np.unique(flat[order], return_index=True, return_counts=True)
    low = np.full(shape, np.nan)
    low.flat[squares] = z[order][first + (_LOW * count).astype(int)]

    ndimage = import_extra("scipy.ndimage", "evaluate")
    ground = low[tuple(ndimage.distance_transform_edt(np.isnan(low), return_distances=False, return_indices=True))]
    usual = ndimage.median_filter(ground, _MEDIAN)
    ground = np.where(ground < usual - _PIT, usual, ground)
    steps = np.arange(-_RADIUS, _RADIUS + 1)
    cone = -_SLOPE * _SQUARE * np.hypot(*np.meshgrid(steps, steps))
    ceiling = ndimage.grey_erosion(ground, structure=cone) + _STEP  # how high ground may lie by the squares around
    known = (low >= usual - _PIT) & (low <= ceiling)
    result[drawn] = known.flat[flat] & (np.abs(z - low.flat[flat]) <= _BAND)
    return result


def _within(cloud: NDArray[np.float32], edges: tuple[float, float, float, float]) -> NDArray[np.bool_]:
    x, y = cloud[:, 0], cloud[:, 1]
    return (x >= edges[0]) & (x < edges[1]) & (y >= edges[2]) & (y < edges[3])
