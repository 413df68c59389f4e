"""Truth of boxes around objects and of a map's road.

Boxes: the cells they cover, the points they hold, and which of them move. A road is free where it is drivable, in sight
of the sensor, and no obstacle was hit.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.grid import GridSpec
from ogm.scan import Boxes
from ogm.state import CellState, Truth
from ogm.truth.scans import MARGIN, STANDING

MIN_RETURNS = 50  # points in the input scan that make all cells of an object occupied (Sec. IV-B)
MOVING_SPEED = 1.0  # [m/s] from the first box of a track to the last, above which an object moves
MOVING_DISTANCE = 3.0  # [m] or so far from its first box at any time: it may have driven a little, then waited


def _covers(boxes: Boxes, k: int, x: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return which places lie on the footprint of box k; in float64, whatever the places are in."""
    c, s = np.cos(boxes.yaw[k]), np.sin(boxes.yaw[k])
    px, py = x - boxes.center[k, 0], y - boxes.center[k, 1]
    length, width = boxes.size[k, :2]
    return np.asarray((np.abs(c * px + s * py) <= length / 2) & (np.abs(c * py - s * px) <= width / 2))


def cells_around(boxes: Boxes, k: int, spec: GridSpec) -> tuple[slice, slice]:
    """Return rows and columns of the cells around box k: all that it covers are among them."""
    (x, y), reach = boxes.center[k, :2], 0.5 * np.hypot(*boxes.size[k, :2]) + spec.resolution
    window = spec.index(*np.array([[x - reach, x + reach], [y - reach, y + reach]]), unbounded=True)
    rows, columns = (slice(max(first, 0), max(last + 1, 0)) for first, last in window)
    return rows, columns


def cells_in_boxes(boxes: Boxes, spec: GridSpec) -> NDArray[np.bool_]:
    """Return which cells any of some boxes covers.

    A box covers the cells whose centers lie in it, and the cell that holds its own center. Counting centers keeps
    the area right on average.

    Parameters
    ----------
    boxes : Boxes
        In the grid's frame; heights are not used.
    spec : GridSpec

    Returns
    -------
    (nx, ny) bool
    """
    result = np.zeros(spec.shape, bool)
    x, y = spec.cell_centers
    for k, (bx, by) in enumerate(boxes.center[:, :2]):
        rows, columns = cells_around(boxes, k, spec)
        result[rows, columns] |= _covers(boxes, k, x[rows], y[:, columns])
        if spec.contains(bx, by):
            result[spec.index(bx, by)] = True
    return result


def cells_in_footprint(footprint: Sequence[float], spec: GridSpec) -> NDArray[np.bool_]:
    """Return which cells have their centers on the ego vehicle.

    Parameters
    ----------
    footprint : (x_min, x_max, y_min, y_max)
        In the grid's frame [m], as `Mount.ego_footprint`.
    spec : GridSpec

    Returns
    -------
    (nx, ny) bool
    """
    x_min, x_max, y_min, y_max = footprint
    x, y = spec.cell_centers
    return (x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max)


def cells_in_hit_boxes(boxes: Boxes, returns: ArrayLike | None, spec: GridSpec) -> NDArray[np.bool_]:
    """Return which cells are covered by boxes with `MIN_RETURNS` points or more in the scan (`count_returns`)."""
    counts = np.asarray(returns)
    if counts.shape != (len(boxes),):
        raise ValueError(f"returns must have shape ({len(boxes)},), one per box, got {counts.shape}")
    return cells_in_boxes(boxes.select(counts >= MIN_RETURNS), spec)


def boxes_over_points(points: NDArray[np.floating], boxes: Boxes) -> NDArray[np.bool_]:
    """Return which points lie over, in or under any of the boxes, (N,): at any height."""
    result = np.zeros(len(points), bool)
    for k in range(len(boxes)):
        result |= _covers(boxes, k, points[:, 0], points[:, 1])
    return result


def count_returns(points: ArrayLike, boxes: Boxes, *, above_bottom: float = 0.0) -> NDArray[np.int64]:
    """Count the points of a scan in each box.

    Parameters
    ----------
    points : (N, 3 or more) float
        x, y, z [m] in the boxes' frame.
    boxes : Boxes
    above_bottom : float
        Points lower than this over a box's bottom [m] are left out, as ground. 0 if ground was removed before.

    Returns
    -------
    (B,) int64
    """
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(f"points must have shape (N, 3 or more), got {points.shape}")
    result = np.zeros(len(boxes), np.int64)
    bottom, top = boxes.bottom + above_bottom, boxes.top
    for k in range(len(boxes)):
        reach = 0.5 * np.hypot(*boxes.size[k, :2])
        near = points[np.abs(points[:, 0] - boxes.center[k, 0]) <= reach]
        inside = _covers(boxes, k, near[:, 0], near[:, 1])
        inside &= (near[:, 2] >= bottom[k]) & (near[:, 2] <= top[k])
        result[k] = np.count_nonzero(inside)
    return result


def boxes_seen_from(T: ArrayLike, poses: ArrayLike, sizes: ArrayLike) -> Boxes:
    """Return upright boxes around objects, in the grid's frame.

    Parameters
    ----------
    T : (4, 4) float
        ``T_grid_world``, from the frame of the poses to that of the grid.
    poses : (B, 4, 4) float
        ``T_world_object``; origin in the middle of the footprint, x forward, z up.
    sizes : (B, 3) float
        Length, width, height [m].

    Returns
    -------
    Boxes
        Where the frames tilt against each other, the center is that of the body at half its height, and the
        box's height holds the whole body.
    """
    poses = np.asarray(poses, np.float64).reshape(-1, 4, 4)
    sizes = np.asarray(sizes, np.float64).reshape(-1, 3)
    if len(poses) != len(sizes):
        raise ValueError(f"there must be one size per pose, got {len(poses)} poses and {len(sizes)} sizes")
    seen = np.asarray(T, np.float64) @ poses
    center = seen[:, :3, 3] + 0.5 * sizes[:, 2, None] * seen[:, :3, 2]
    height = np.abs(seen[:, 2, :3] * sizes).sum(axis=1)
    yaw = np.arctan2(seen[:, 1, 0], seen[:, 0, 0])
    return Boxes(center, np.column_stack([sizes[:, :2], height]), yaw)


def moving_tracks(stamps: Sequence[float], boxes: Sequence[Boxes]) -> frozenset[str]:
    """Return the tracks of the objects that move while they are recorded.

    Parameters
    ----------
    stamps : sequence of K float
        Times of some frames [s], in any order.
    boxes : sequence of K Boxes
        The boxes of each, in the map's frame. Those without a track are left out.

    Returns
    -------
    frozenset of str
        Tracks above `MOVING_SPEED` or `MOVING_DISTANCE`. An object that was seen once is none of them.
    """
    if len(stamps) != len(boxes):
        raise ValueError(f"there must be one stamp per frame, got {len(stamps)} stamps and {len(boxes)} frames")
    track: dict[str, list[tuple[float, float, float]]] = {}
    for k in np.argsort(np.asarray(stamps, np.float64), kind="stable"):
        for name, (x, y) in zip(boxes[k].track, boxes[k].center[:, :2], strict=True):
            track.setdefault(name, []).append((stamps[k], x, y))
    track.pop("", None)
    moving = set()
    for name, rows in track.items():
        t, *place = np.array(rows).T
        away, time = np.hypot(*(np.array(place) - np.array(place)[:, :1])), t[-1] - t[0]
        if away.max() > MOVING_DISTANCE or (time > 0 and away[-1] > MOVING_SPEED * time):
            moving.add(name)
    return frozenset(moving)


def truth_from_boxes(boxes: Boxes, returns: ArrayLike, spec: GridSpec) -> Truth:
    """Return the truth of boxes alone: objects with enough returns are occupied (van Kempen et al. 2021, Sec. IV-B).

    Parameters
    ----------
    boxes : Boxes
        In the grid's frame.
    returns : (B,) integer
        Points that each has in the scan: `count_returns`. `MIN_RETURNS` make the cells of a box occupied.
    spec : GridSpec

    Returns
    -------
    Truth
        Never free or unknown: boxes with fewer returns, and all outside of boxes, are to be ignored.
    """
    hit = cells_in_hit_boxes(boxes, returns, spec)
    return Truth(spec, np.where(hit, np.uint8(CellState.OCCUPIED), np.uint8(CellState.IGNORE)))


SECTOR = np.radians(0.4)  # [rad] of azimuth in which a return hides the road; a VLP-32C fires every 0.2 deg


def cells_in_areas(outlines: Sequence[ArrayLike], spec: GridSpec) -> NDArray[np.bool_]:
    """Return which cells have their middle in any of some areas.

    Parameters
    ----------
    outlines : sequence of (N, 2) float
        Corners of the areas, in turn [m]; the last is joined to the first. Where an outline crosses itself,
        what it goes around twice is outside (even-odd rule).
    spec : GridSpec

    Returns
    -------
    (nx, ny) bool
    """
    result = np.zeros(spec.shape, bool)
    xs = spec.origin[0] + (np.arange(spec.shape[0]) + 0.5) * spec.resolution
    for outline in outlines:
        corners = np.asarray(outline, np.float64)
        if corners.ndim != 2 or corners.shape[1] != 2 or not np.isfinite(corners).all():
            raise ValueError(f"an outline must be finite, of shape (N, 2), got {corners.shape}")
        inside = np.zeros(spec.shape, bool)
        for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            rows = np.flatnonzero((xs < x0) != (xs < x1))  # the edge crosses the line of middles at this x
            y = y0 + (y1 - y0) * (xs[rows] - x0) / (x1 - x0)
            # Middles below the crossing change sides; a middle on it lies inside the area to its left
            count = np.ceil((y - spec.origin[1]) / spec.resolution - 0.5)
            inside[rows] ^= np.arange(spec.shape[1]) < count[:, None]
        result |= inside
    return result


def truth_from_road(
    drivable: NDArray[np.bool_],
    ground: NDArray[np.floating],
    points: NDArray[np.floating],
    above: NDArray[np.floating],
    spec: GridSpec,
    *,
    boxes: Boxes | None = None,
    min_range: float = 0.0,
) -> Truth:
    """Return the truth of a map's road: free where it is in sight of a sensor at (0, 0, 0), ignored elsewhere.

    Left out are cells of boxes (all of them, however few returns they have, and `MARGIN` around them) and cells with
    a return from an obstacle. A cell is in sight if no such return lies nearer in its direction, on or above the
    line from the sensor to the cell's ground.

    Parameters
    ----------
    drivable : (nx, ny) bool
        `cells_in_areas` of the map's outlines.
    ground : (nx, ny) float
        z of the ground at the cells' middles [m].
    points : (N, 3 or more) float
        Returns of all lidars, in the frame of the one whose scan is evaluated [m].
    above : (N,) float
        Their heights above ground [m].
    spec : GridSpec
    boxes : Boxes, optional
        Objects; their heights are not used.
    min_range : float
        Cells nearer than this [m] are left out: the ego vehicle is there.

    Returns
    -------
    Truth
        Never occupied or unknown.
    """
    xyz = np.asarray(points, np.float64)[:, :3]
    standing = xyz[(above > STANDING[0]) & (above < STANDING[1])]
    taken = cells_in_boxes((boxes or Boxes.empty()).widened(MARGIN), spec)
    here = standing[spec.contains(*standing[:, :2].T)]
    taken[spec.index(*here[:, :2].T)] = True

    x, y = spec.cell_centers
    distance = np.hypot(x, y)
    clear = drivable & ~taken & (distance >= min_range)
    sector = np.floor(np.arctan2(y, x) / SECTOR).astype(int).ravel()
    slope = (ground / np.maximum(distance, 1e-9)).ravel()  # tangent of the elevation of the ground
    hidden = np.zeros(spec.shape, bool).ravel()
    far = np.hypot(*standing[:, :2].T)
    of = np.floor(np.arctan2(standing[:, 1], standing[:, 0]) / SECTOR).astype(int)
    order = np.lexsort((far, of))
    far, of, tangent = far[order], of[order], (standing[:, 2] / np.maximum(far, 1e-9))[order]
    cells = np.argsort(sector, kind="stable")
    sector = sector[cells]
    for k in np.unique(of):
        first, last = np.searchsorted(of, [k, k + 1])
        seen = cells[slice(*np.searchsorted(sector, [k, k + 1]))]
        highest = np.maximum.accumulate(tangent[first:last])
        nearer = np.searchsorted(far[first:last], distance.ravel()[seen]) - 1
        hidden[seen] = (nearer >= 0) & (highest[np.maximum(nearer, 0)] >= slope[seen])
    free = clear & ~hidden.reshape(spec.shape)
    return Truth(spec, np.where(free, np.uint8(CellState.FREE), np.uint8(CellState.IGNORE)))
