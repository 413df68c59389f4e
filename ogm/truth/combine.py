"""One truth of several, and a truth without some cells."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ogm.state import CellState, LazyTruth, Truth


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
