"""Truth from boxes around objects and from the road of a map.

For boxes: covered cells, points within, and moving tracks. A road cell is free if it is drivable, visible from the
sensor, and without obstacle hits.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.grid import GridSpec
from ogm.scan import Boxes
from ogm.state import CellState, Truth
from ogm.truth.scans import MARGIN, STANDING

MIN_RETURNS = 50  # points in the input scan for all cells of an object to be occupied (Sec. IV-B)
MOVING_SPEED = 1.0  # [m/s] mean speed between first and last box of a track above which an object moves
MOVING_DISTANCE = 3.0  # [m] from the first box above which it moves, too: it may have driven a little, then waited


def _covers(boxes: Boxes, k: int, x: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return whether each position lies on the footprint of box k; computed in float64."""
    c, s = np.cos(boxes.yaw[k]), np.sin(boxes.yaw[k])
    px, py = x - boxes.center[k, 0], y - boxes.center[k, 1]
    length, width = boxes.size[k, :2]
    return np.asarray((np.abs(c * px + s * py) <= length / 2) & (np.abs(c * py - s * px) <= width / 2))


def cells_around(boxes: Boxes, k: int, spec: GridSpec) -> tuple[slice, slice]:
    """Return slices of rows and columns that include all cells of box k."""
    (x, y), reach = boxes.center[k, :2], 0.5 * np.hypot(*boxes.size[k, :2]) + spec.resolution
    window = spec.index(*np.array([[x - reach, x + reach], [y - reach, y + reach]]), unbounded=True)
    rows, columns = (slice(max(first, 0), max(last + 1, 0)) for first, last in window)
    return rows, columns


def cells_in_boxes(boxes: Boxes, spec: GridSpec) -> NDArray[np.bool_]:
    """Return the cells covered by boxes.

    A box covers the cells with centers in it, and the cell of its own center. Centers preserve the area on average.

    Parameters
    ----------
    boxes : Boxes
        Boxes in the grid's frame; heights are not used.
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
    """Return the cells with centers on the ego vehicle.

    Parameters
    ----------
    footprint : (x_min, x_max, y_min, y_max)
        Ego vehicle in the grid's frame [m], see `Mount.ego_footprint`.
    spec : GridSpec

    Returns
    -------
    (nx, ny) bool
    """
    x_min, x_max, y_min, y_max = footprint
    x, y = spec.cell_centers
    return (x >= x_min) & (x <= x_max) & (y >= y_min) & (y <= y_max)


def cells_in_hit_boxes(boxes: Boxes, returns: ArrayLike | None, spec: GridSpec) -> NDArray[np.bool_]:
    """Return the cells covered by boxes with at least `MIN_RETURNS` points in the scan (`count_returns`)."""
    counts = np.asarray(returns)
    if counts.shape != (len(boxes),):
        raise ValueError(f"returns must have shape ({len(boxes)},), one per box, got {counts.shape}")
    return cells_in_boxes(boxes.select(counts >= MIN_RETURNS), spec)


def boxes_over_points(points: NDArray[np.floating], boxes: Boxes) -> NDArray[np.bool_]:
    """Return whether each point lies on the footprint of a box, at any height, (N,)."""
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
        Height above a box's bottom [m] below which points are left out as ground. 0 if ground was removed before.

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
        ``T_grid_world``, from the frame of the poses to the frame of the grid.
    poses : (B, 4, 4) float
        ``T_world_object``; origin in the middle of the footprint, x forward, z up.
    sizes : (B, 3) float
        Length, width, height [m].

    Returns
    -------
    Boxes
        If the frames are tilted relative to each other, the center is the center of the body, and the height of the box
        covers the whole body.
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
    """Return the tracks of objects that move during the recording.

    Parameters
    ----------
    stamps : sequence of K float
        Times of frames [s], in any order.
    boxes : sequence of K Boxes
        Boxes of each frame, in the map's frame. Boxes without a track are left out.

    Returns
    -------
    frozenset of str
        Tracks above `MOVING_SPEED` or `MOVING_DISTANCE`. Objects in a single frame are not included.
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
        t, *xy = np.array(rows).T
        away, time = np.hypot(*(np.array(xy) - np.array(xy)[:, :1])), t[-1] - t[0]
        if away.max() > MOVING_DISTANCE or (time > 0 and away[-1] > MOVING_SPEED * time):
            moving.add(name)
    return frozenset(moving)


def truth_from_boxes(boxes: Boxes, returns: ArrayLike, spec: GridSpec) -> Truth:
    """Return the truth from boxes: objects with enough returns are occupied (van Kempen et al. 2021, Sec. IV-B).

    Parameters
    ----------
    boxes : Boxes
        Boxes in the grid's frame.
    returns : (B,) integer
        Points of each box in the scan, see `count_returns`. Boxes with at least `MIN_RETURNS` are occupied.
    spec : GridSpec

    Returns
    -------
    Truth
        Occupied or ignored: boxes with fewer returns and cells outside boxes are ignored.
    """
    hit = cells_in_hit_boxes(boxes, returns, spec)
    return Truth(spec, np.where(hit, np.uint8(CellState.OCCUPIED), np.uint8(CellState.IGNORE)))


SECTOR = np.radians(0.4)  # [rad] azimuth sector in which a return hides the road; a VLP-32C fires every 0.2 deg


def cells_in_areas(outlines: Sequence[ArrayLike], spec: GridSpec) -> NDArray[np.bool_]:
    """Return the cells with centres in areas.

    Parameters
    ----------
    outlines : sequence of (N, 2) float
        Corners of the areas, in order [m]; the last is joined to the first. Outlines that cross themselves follow the
        even-odd rule.
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
            rows = np.flatnonzero((xs < x0) != (xs < x1))  # the edge crosses the line of centres at this x
            y = y0 + (y1 - y0) * (xs[rows] - x0) / (x1 - x0)
            # Centres below the crossing change sides; a centre on it lies inside the area to its left
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
    """Return the truth from a map's road: free if visible from a sensor at (0, 0, 0), else ignored.

    Cells of all boxes, with `MARGIN` around them, and cells with an obstacle return are ignored. A cell is visible if
    no obstacle return lies nearer in its direction, on or above the line from the sensor to the cell's ground.

    Parameters
    ----------
    drivable : (nx, ny) bool
        Drivable cells, see `cells_in_areas`.
    ground : (nx, ny) float
        z of the ground at the centres of cells [m].
    points : (N, 3 or more) float
        Returns of all lidars, in the frame of the evaluated lidar [m].
    above : (N,) float
        Height of each return above ground [m].
    spec : GridSpec
    boxes : Boxes, optional
        Objects; their heights are not used.
    min_range : float
        Range below which cells are ignored, for the ego vehicle [m].

    Returns
    -------
    Truth
        Free or ignored.
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
