"""Truth of many scans of one place, on which they agree; one truth of several, and a truth without some cells."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ogm.extras import import_extra
from ogm.grid import GridSpec
from ogm.state import CellState, LazyTruth, Truth

GROUND = (-0.3, 0.15)  # [m] above the estimated ground: ground
STANDING = (0.3, 2.0)  # [m] above it: an obstacle. What lies between (kerbs, grass) makes a cell ignored
AT_LEAST = 3  # returns of one kind that make a cell known
HALF = 0.5  # share of the scans with returns in a cell that must show the obstacle, or it came and went
MARGIN = 0.3  # [m] around boxes: what annotation and de-skewing leave outside


def truth_from_scans(
    clouds: Sequence[NDArray[np.floating]],
    above: Sequence[NDArray[np.floating]],
    spec: GridSpec,
    *,
    min_scans: int = 2,
    moving: NDArray[np.bool_] | None = None,
) -> Truth:
    """Return the truth of several scans of one place, without what moved.

    A cell is

    * free: 3 returns or more from the ground (-0.3 to 0.15 m above it), in `min_scans` scans or more, and none
      from 0.15 to 2.0 m;
    * occupied: 3 returns or more from 0.3 to 2.0 m, in as many scans, and in half or more of the scans that have
      a return in it: else something came or went;
    * to be ignored otherwise: kerbs, grass, what is hidden or far.

    Parameters
    ----------
    clouds : sequence of (N, 3 or more) float
        Points of each scan in the grid's frame [m], without those on moving objects (and `MARGIN` around
        them) and on the ego vehicle.
    above : sequence of (N,) float
        Their heights above ground [m].
    spec : GridSpec
    min_scans : int
        How many scans must agree.
    moving : (nx, ny) bool, optional
        Cells to be ignored whatever the scans hold: something that moves is there now.

    Returns
    -------
    Truth
        Without unknown cells.

    Raises
    ------
    ValueError
        If the counts do not agree, or `min_scans` is below 1.
    """
    if len(clouds) != len(above) or any(len(a) != len(b) for a, b in zip(clouds, above, strict=True)):
        raise ValueError("there must be one height for every point of every scan")
    if min_scans < 1:
        raise ValueError(f"min_scans must be 1 or more, got {min_scans}")
    cells = spec.shape[0] * spec.shape[1]
    returns, scans = np.zeros((3, cells), np.int64), np.zeros((3, cells), np.int64)  # ground, low, standing
    seen = np.zeros(cells, np.int64)
    edges = (*GROUND, *STANDING)
    for cloud, high in zip(clouds, above, strict=True):
        inside = spec.contains(cloud[:, 0], cloud[:, 1]) & (high >= edges[0]) & (high < edges[-1])
        flat = np.ravel_multi_index(spec.index(cloud[inside, 0], cloud[inside, 1]), spec.shape)
        any_here = np.zeros(cells, bool)
        for kind in range(3):
            band = (high[inside] >= edges[kind]) & (high[inside] < edges[kind + 1])
            count = np.bincount(flat[band], minlength=cells)
            returns[kind] += count
            scans[kind] += count > 0
            any_here |= count > 0
        seen += any_here
    enough = (returns >= AT_LEAST) & (scans >= min_scans)
    state = np.full(cells, np.uint8(CellState.IGNORE))
    state[enough[0] & (returns[1] == 0) & (returns[2] == 0)] = CellState.FREE
    state[enough[2] & (scans[2] >= HALF * seen)] = CellState.OCCUPIED
    state = state.reshape(spec.shape)
    if moving is not None:
        state[moving] = CellState.IGNORE
    return Truth(spec, state)


def contradicted(
    truth: Truth, cloud: NDArray[np.floating], above: NDArray[np.floating], reach: float = MARGIN
) -> NDArray[np.bool_]:
    """Return the cells in which a scan shows the opposite of what others agreed on.

    Something unlabelled has come or gone: the scan has an obstacle in a free cell; or it has ground in an occupied
    cell, and no obstacle in that cell and its eight neighbours. Cells of the same state up to `reach` around are
    contradicted too, for beams are sparse.

    Parameters
    ----------
    truth : Truth
        From `truth_from_scans` of other scans.
    cloud : (N, 3 or more) float
        Points of the scan in the grid's frame [m].
    above : (N,) float
        Their heights above ground [m].
    reach : float
        [m]

    Returns
    -------
    (nx, ny) bool
    """
    binary_dilation = import_extra("scipy.ndimage", "evaluate").binary_dilation

    spec = truth.spec
    ground, standing = np.zeros(spec.shape, bool), np.zeros(spec.shape, bool)
    inside = spec.contains(cloud[:, 0], cloud[:, 1])
    for cells, (low, high) in ((ground, GROUND), (standing, STANDING)):
        chosen = inside & (above >= low) & (above < high)
        cells[spec.index(cloud[chosen, 0], cloud[chosen, 1])] = True
    near_standing = binary_dilation(standing, np.ones((3, 3), bool))
    steps = max(1, int(np.ceil(reach / spec.resolution - 1e-9)))
    result = np.zeros(spec.shape, bool)
    for state, against in ((CellState.FREE, standing), (CellState.OCCUPIED, ground & ~near_standing)):
        mine = truth.state == state
        result |= mine & binary_dilation(mine & against, iterations=steps)
    return result


def combine_truths(
    sources: Sequence[Truth],
    *,
    boxes: Truth | None = None,
    uncertain: NDArray[np.bool_] | None = None,
    unobserved: NDArray[np.bool_] | None = None,
) -> Truth:
    """Return the truth that several sources make together.

    1. A cell is free or occupied where one or more sources are that, and none is the opposite. Other cells are to
       be ignored. Unknown counts as no statement: an area that was not recorded is no evidence.
    2. Occupied cells of `boxes` win over all of that: annotators drew them, and they hold the sides that no beam met.
    3. Cells that are `uncertain` are never free: there is something that was hardly measured. They are ignored
       where a source is free.
    4. `unobserved` cells are to be ignored.

    Parameters
    ----------
    sources : sequence of Truth
        On one grid.
    boxes : Truth, optional
        From `truth_from_boxes`.
    uncertain, unobserved : (nx, ny) bool, optional
        Cells, such as those of boxes with few returns, and those under the ego vehicle.

    Returns
    -------
    Truth
        Free, occupied or to be ignored; without heights and motion.

    Raises
    ------
    ValueError
        If there is no source, or their grids differ.
    """
    every = [*sources, *([] if boxes is None else [boxes])]
    if not every:
        raise ValueError("there must be a truth to combine, got none")
    spec = every[0].spec
    if any(one.spec != spec for one in every):
        raise ValueError(f"truths must be of one grid, got {', '.join(str(one.spec) for one in every)}")
    free, occupied = np.zeros(spec.shape, bool), np.zeros(spec.shape, bool)
    for one in sources:
        free |= one.state == CellState.FREE
        occupied |= one.state == CellState.OCCUPIED
    state = np.full(spec.shape, np.uint8(CellState.IGNORE))
    state[free & ~occupied] = CellState.FREE
    state[occupied & ~free] = CellState.OCCUPIED
    if uncertain is not None:
        state[uncertain & (state == CellState.FREE)] = CellState.IGNORE
    if boxes is not None:
        state[boxes.state == CellState.OCCUPIED] = CellState.OCCUPIED
    if unobserved is not None:
        state[unobserved] = CellState.IGNORE
    return Truth(spec, state)


def ignore_cells(truth: Truth, cells: NDArray[np.bool_]) -> Truth:
    """Return a truth with some cells, (nx, ny) bool, to be ignored. Their motion stays: it is no state."""
    state = np.where(cells, np.uint8(CellState.IGNORE), truth.state)
    return LazyTruth(truth.spec, state, truth.height_cm, lambda: truth.motion)
