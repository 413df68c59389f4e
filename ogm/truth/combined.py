"""Several truths of one scan made one."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ogm.truth.state import FREE, IGNORE, OCCUPIED, Truth

__all__ = ["combine_truths"]


def combine_truths(
    sources: Sequence[Truth],
    *,
    boxes: Truth | None = None,
    uncertain: NDArray[np.bool_] | None = None,
    unobserved: NDArray[np.bool_] | None = None,
) -> Truth:
    """Combine what several sources say about the same cells.

    1. A cell has the state that the sources give it, where one or more say free or occupied and none
       contradicts; where they contradict each other, and where none says anything, it is to be ignored. Unknown
       counts as saying nothing: a recording that did not look is no evidence.
    2. Occupied cells of `boxes` win over all of that: people drew them, and they hold the side that no beam met.
    3. Cells that are `uncertain` are not free: something stands there that was hardly seen. They are ignored
       where a source calls them free.
    4. `unobserved` looked at some cells, such as those under the own vehicle: to be ignored.

    Parameters
    ----------
    sources : sequence of Truth
        On one grid.
    boxes : Truth, optional
        From `truth_from_boxes`.
    doubtful, nobody : (nx, ny) bool, optional

    Returns
    -------
    Truth
        Free, occupied or to be ignored.

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
        free |= one.state == FREE
        occupied |= one.state == OCCUPIED
    state = np.full(spec.shape, IGNORE, np.uint8)
    state[free & ~occupied] = FREE
    state[occupied & ~free] = OCCUPIED
    if uncertain is not None:
        state[uncertain & (state == FREE)] = IGNORE
    if boxes is not None:
        state[boxes.state == OCCUPIED] = OCCUPIED
    if unobserved is not None:
        state[unobserved] = IGNORE
    return Truth(spec, state)
