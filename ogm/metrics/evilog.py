"""The metrics of the paper's published code, EviLOG: for comparison with its figures only, not for ranking.

Its "KL divergence" is Keras' categorical one of clipped evidence, it averages the baseline's with the other method's,
and its "accuracy" is the share of cells that are predicted unknown (github.com/ika-rwth-aachen/EviLOG,
model/evaluate.py and model/metrics.py). None of the three measures the quality of a map; the functions give details.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.metrics.divergence import MIN_EVIDENCE
from ogm.state import CellState


class Published(NamedTuple):
    """Values that the EviLOG code's stateful metric reports of two methods, see `evilog_published`.

    Attributes
    ----------
    first, second : (frames,) float64
        If the metric is reset at every frame, as for the paper's figure: the first method's own value, and the
        mean of both.
    running_first, running_second : (frames,) float64
        If it is never reset: the mean of all updates so far, read after the first and after the second method.
    """

    first: NDArray[np.float64]
    second: NDArray[np.float64]
    running_first: NDArray[np.float64]
    running_second: NDArray[np.float64]


def evilog_kl(evidence: NDArray[np.floating], state: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the "KL divergence" of the EviLOG code for every cell, without its running average.

    It is Keras' categorical divergence between the truth as *evidence*, 1 for the state of a known cell and 0
    elsewhere, and the raw evidence of the grid, both clipped to [1e-7, 1]: -ln(clip(e of the true state)) to six
    digits. A missing detection costs 16.1, excess and false evidence nothing: evidence of 1 for both states everywhere
    is perfect.

    Parameters
    ----------
    evidence : (..., 2) float array
        Raw evidence of free and occupied.
    state : (...) uint8
        True states: 0 unknown, 1 free, 2 occupied, 3 ignored.

    Returns
    -------
    (...) float64; NaN where the truth is ignored

    Notes
    -----
    The code updates one metric object with the network and then, without a reset, with the baseline, so that the
    published value of the baseline is the mean of both; this function keeps no state. See `evilog_published`.
    """
    label = np.stack([state == CellState.FREE, state == CellState.OCCUPIED], axis=-1).astype(np.float64)
    label, clipped = (np.clip(x, MIN_EVIDENCE, 1.0) for x in (label, evidence.astype(np.float64)))
    values = (label * np.log(label / clipped)).sum(axis=-1)
    return np.where(state == CellState.IGNORE, np.nan, values)


def evilog_published(first: ArrayLike, second: ArrayLike) -> Published:
    """Return the values that the EviLOG code reports for two methods, given the mean `evilog_kl` of each frame.

    One metric object averages all updates until it is reset. It is updated with the first method (the network), read,
    updated with the second one (the baseline), and read again: the second reading is the mean of both.

    Parameters
    ----------
    first, second : (frames,) float array
        Mean of `evilog_kl` over the cells of every frame (the score ``legacy_kl``), finite.

    Returns
    -------
    Published
    """
    a, b = _alike(first, second)
    updates = np.stack([a, b], axis=-1).ravel()
    running = np.cumsum(updates) / np.arange(1, len(updates) + 1)
    return Published(a, (a + b) / 2, running[::2], running[1::2])


def evilog_unmixed(first: ArrayLike, published: ArrayLike) -> NDArray[np.float64]:
    """Return the second method's own values from the two published curves: 2 published - first.

    Parameters
    ----------
    first, published : (frames,) float array
        As `Published.first` and `Published.second`.
    """
    a, b = _alike(first, published)
    return 2 * b - a


def _alike(first: ArrayLike, second: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
    if a.ndim != 1 or a.shape != b.shape or not np.isfinite(a).all() or not np.isfinite(b).all():
        raise ValueError(
            f"both methods need one finite value per frame, got shapes {a.shape} and {b.shape}; leave out frames "
            "without a value"
        )
    return a, b
