"""Truth of a map's road: free where it is drivable, in sight of the sensor, and no obstacle was hit."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.grid import GridSpec
from ogm.scan import Boxes
from ogm.state import CellState, Truth
from ogm.truth.boxes import cells_in_boxes
from ogm.truth.scans import MARGIN, STANDING

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
