"""Truth of a frame from neighbouring scans of the same drive, with heights above an estimated ground.

This truth evaluates sensor models, so `find_ground` shares no code with the ground estimators of `ogm.geometric`.
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

_REACH = 50.0  # [m] scans from farther away show few of the same cells
_SPAN = 30.0  # [s] before and after: later, parked cars have left and poses have drifted
_MAX_SCANS = 40  # chosen evenly from the scans in reach
_MARGIN_GROUND = 1.0  # [m] margin around the grid, to interpolate the ground at its edge

_SQUARE_SIDE = 1.0  # [m] side of the squares in which the ground is estimated
_LOW_QUANTILE = 0.05  # quantile of heights that is the ground of a square: ghost returns lie below, objects above
_MEDIAN_SIZE = 5  # squares, size of the median filter
_MAX_PIT = 0.5  # [m] squares deeper than this below the median hold ghost returns
_MAX_SLOPE = 0.15  # largest rise of the ground between two squares, per distance
_SLOPE_RADIUS = 5  # squares, largest distance at which the slope is checked
_KERB = 0.1  # [m] height that the ground may rise in addition to the slope
_GROUND_BAND = 0.2  # [m] largest distance of a ground point from the ground of its square
_MAX_POINTS = 500_000  # points that are drawn at random to estimate the ground


def choose_neighbours(n: int, stamps: NDArray[np.float64], places: NDArray[np.float64], *, later: bool) -> list[int]:
    """Choose up to 40 scans near scan n in space and time, without scan n itself.

    Parameters
    ----------
    n : int
        Number of the scan in the drive.
    stamps : (K,) float
        Times of the drive's scans [s].
    places : (K, 3) float
        Sensor positions [m].
    later : bool
        Choose only scans after scan n.

    Returns
    -------
    list of int
        Numbers of the chosen scans, ascending.
    """
    near = np.linalg.norm(places - places[n], axis=1) <= _REACH
    near &= np.abs(stamps - stamps[n]) <= _SPAN
    near[n] = False
    if later:
        near[: n + 1] = False
    found = np.flatnonzero(near)
    if len(found) > _MAX_SCANS:
        found = found[np.round(np.linspace(0, len(found) - 1, _MAX_SCANS)).astype(int)]
    return [int(number) for number in found]


def ego_path_cells(poses: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return the cells of `TRUTH_SPEC` that the ego vehicle covered in any scan, (nx, ny) bool.

    Parameters
    ----------
    poses : (K, 4, 4) float
        Sensor poses of the scans, in the frame of the grid.
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
    """Return the truth on which neighbouring scans agree, in the frame of one scan.

    Heights are above the map's ground if `map_ground` is given, else above labelled ground points, else above the
    ground points that `find_ground` finds in all clouds together.

    Parameters
    ----------
    clouds : sequence of (N, 4) float32
        Points of each neighbouring scan [m], without moving objects.
    spec : GridSpec
    moving : Boxes
        Moving objects in the scan. Cells under them and within `MARGIN` of them are ignored.
    own : (N, 4) float32, optional
        Points of the scan itself. They do not make cells known, but cells in which they contradict the neighbours are
        ignored, see `contradicted`.
    is_ground : sequence of (N,) bool, optional
        Masks of the points of each cloud that are labelled as ground.
    map_ground : function, optional
        Maps positions (N, 3) to the height of the map's ground (N,) [m], NaN if unknown.
    min_scans : int
        See `truth_from_scans`.
    """
    x0, x1, y0, y1 = spec.extent
    edges = x0 - _MARGIN_GROUND, x1 + _MARGIN_GROUND, y0 - _MARGIN_GROUND, y1 + _MARGIN_GROUND
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
            labelled = [mask[keep] for mask, keep in zip(is_ground, kept, strict=True)]
            flags[: len(xyz) - len(own)] = np.concatenate(labelled)
        high = height_above_ground(xyz, flags)
    *above, own_above = np.split(high, np.cumsum([len(cloud) for cloud in near]))
    moving_cells = cells_in_boxes(moving.widened(MARGIN), spec)
    truth = truth_from_scans(near, above, spec, min_scans=min_scans, moving=moving_cells)
    return ignore_cells(truth, contradicted(truth, own, own_above)) if len(own) else truth


def find_ground(xyz: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask of the ground points in aggregated scans, (N,).

    The ground height of a square of 1 m is the 5 % quantile of its heights, and points within 0.2 m of it are ground
    points. Squares more than 0.5 m below the local median hold ghost returns. Squares that rise more than 15 % plus a
    kerb of 0.1 m above a lower square within 5 m hold objects. Neither kind has ground points. Of more than 500,000
    points, only a random sample of this size can be ground points.

    Parameters
    ----------
    xyz : (N, 3) float64
        Points [m].
    """
    result = np.zeros(len(xyz), bool)
    if not len(xyz):
        return result
    drawn = np.random.default_rng(0).choice(len(xyz), min(len(xyz), _MAX_POINTS), replace=False)
    square = np.floor(xyz[drawn, :2] / _SQUARE_SIDE).astype(np.int64)
    square -= square.min(axis=0)
    shape = tuple(square.max(axis=0) + 1)
    flat, z = np.ravel_multi_index(tuple(square.T), shape), xyz[drawn, 2]
    order = np.lexsort((z, flat))
    squares, first, count = np.unique(flat[order], return_index=True, return_counts=True)
    low = np.full(shape, np.nan)
    low.flat[squares] = z[order][first + (_LOW_QUANTILE * count).astype(int)]

    ndimage = import_extra("scipy.ndimage", "evaluate")
    ground = low[tuple(ndimage.distance_transform_edt(np.isnan(low), return_distances=False, return_indices=True))]
    usual = ndimage.median_filter(ground, _MEDIAN_SIZE)
    ground = np.where(ground < usual - _MAX_PIT, usual, ground)
    steps = np.arange(-_SLOPE_RADIUS, _SLOPE_RADIUS + 1)
    cone = -_MAX_SLOPE * _SQUARE_SIDE * np.hypot(*np.meshgrid(steps, steps))
    ceiling = ndimage.grey_erosion(ground, structure=cone) + _KERB  # highest ground allowed by the squares around
    known = (low >= usual - _MAX_PIT) & (low <= ceiling)
    result[drawn] = known.flat[flat] & (np.abs(z - low.flat[flat]) <= _GROUND_BAND)
    return result


def _within(cloud: NDArray[np.float32], edges: tuple[float, float, float, float]) -> NDArray[np.bool_]:
    x, y = cloud[:, 0], cloud[:, 1]
    return (x >= edges[0]) & (x < edges[1]) & (y >= edges[2]) & (y < edges[3])
