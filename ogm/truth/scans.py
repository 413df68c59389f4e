"""Truth from the agreement of many scans of an area, and combination of several truths."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ogm.extras import import_extra
from ogm.grid import GridSpec
from ogm.state import CellState, LazyTruth, Truth

GROUND = (-0.3, 0.15)  # [m] above the estimated ground: ground
STANDING = (0.3, 2.0)  # [m] above the ground: an obstacle. Returns between (kerbs, grass) make a cell ignored
MIN_KIND_RETURNS = 3  # returns of one kind for a known cell
MIN_SHARE = 0.5  # share of scans with returns in a cell that must show the obstacle; else it appeared or left
MARGIN = 0.3  # [m] around boxes, for errors of annotation and de-skewing


def truth_from_scans(
    clouds: Sequence[NDArray[np.floating]],
    above: Sequence[NDArray[np.floating]],
    spec: GridSpec,
    *,
    min_scans: int = 2,
    moving: NDArray[np.bool_] | None = None,
) -> Truth:
    """Return the truth from several scans of an area, without moving objects.

    A cell is

    * free with 3 returns or more from the ground (-0.3 to 0.15 m), in at least `min_scans` scans, and no return from
      0.15 to 2.0 m;
    * occupied with 3 returns or more from 0.3 to 2.0 m, in at least `min_scans` scans, and in at least half of the
      scans with a return in the cell, as otherwise an object appeared or left;
    * otherwise ignored: kerbs, grass, hidden or far cells.

    Parameters
    ----------
    clouds : sequence of (N, 3 or more) float
        Points of each scan in the grid's frame [m], without points on moving objects (and `MARGIN` around them) and on
        the ego vehicle.
    above : sequence of (N,) float
        Heights of the points above ground [m].
    spec : GridSpec
    min_scans : int
        Number of scans that must agree.
    moving : (nx, ny) bool, optional
        Cells to ignore regardless of the scans, as a moving object is there now.

    Returns
    -------
    Truth
        Free, occupied or ignored.

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
    enough = (returns >= MIN_KIND_RETURNS) & (scans >= min_scans)
    state = np.full(cells, np.uint8(CellState.IGNORE))
    state[enough[0] & (returns[1] == 0) & (returns[2] == 0)] = CellState.FREE
    state[enough[2] & (scans[2] >= MIN_SHARE * seen)] = CellState.OCCUPIED
    state = state.reshape(spec.shape)
    if moving is not None:
        state[moving] = CellState.IGNORE
    return Truth(spec, state)


def contradicted(
    truth: Truth, cloud: NDArray[np.floating], above: NDArray[np.floating], reach: float = MARGIN
) -> NDArray[np.bool_]:
    """Return the cells in which a scan contradicts the truth of other scans.

    The scan has an obstacle in a free cell; or it has ground in an occupied cell, without an obstacle in that cell and
    its eight neighbours: an unlabelled object has appeared or left. Since beams are sparse, cells of the same state
    within `reach` are contradicted, too.

    Parameters
    ----------
    truth : Truth
        Truth from other scans, see `truth_from_scans`.
    cloud : (N, 3 or more) float
        Points of the scan in the grid's frame [m].
    above : (N,) float
        Heights of the points above ground [m].
    reach : float
        Distance around contradicted cells [m].

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
    """Return the combined truth of several sources.

    1. A cell is free or occupied if at least one source states it and no source states the opposite; unknown is no
       statement. Other cells are ignored.
    2. Occupied cells of `boxes` override this, as annotated boxes include sides that no beam hit.
    3. `uncertain` cells are never free, as they contain a barely measured object; they become ignored.
    4. `unobserved` cells are ignored.

    Parameters
    ----------
    sources : sequence of Truth
        Truths on one grid.
    boxes : Truth, optional
        Truth of `truth_from_boxes`.
    uncertain, unobserved : (nx, ny) bool, optional
        Cells, such as under boxes with few returns, and under the ego vehicle.

    Returns
    -------
    Truth
        Free, occupied or ignored; without heights and motion.

    Raises
    ------
    ValueError
        If there is no source, or their grids differ.
    """
    every = [*sources, *([] if boxes is None else [boxes])]
    if not every:
        raise ValueError("sources must contain at least one truth, got none")
    spec = every[0].spec
    if any(truth.spec != spec for truth in every):
        raise ValueError(f"truths must be on one grid, got {', '.join(str(truth.spec) for truth in every)}")
    free, occupied = np.zeros(spec.shape, bool), np.zeros(spec.shape, bool)
    for truth in sources:
        free |= truth.state == CellState.FREE
        occupied |= truth.state == CellState.OCCUPIED
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
    """Return a truth with cells, (nx, ny) bool, set to ignored; their motion is kept."""
    state = np.where(cells, np.uint8(CellState.IGNORE), truth.state)
    return LazyTruth(truth.spec, state, truth.height_cm, lambda: truth.motion)
