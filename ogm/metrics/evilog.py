"""Metrics of the paper's published code, EviLOG: for comparison with its figures only, not for ranking.

Its "KL divergence" is Keras' categorical divergence of clipped evidence, its value of the baseline is averaged with the
other method's, and its "accuracy" is the share of cells predicted unknown (github.com/ika-rwth-aachen/EviLOG,
model/evaluate.py and model/metrics.py). These values do not measure the quality of a map; see the functions.
"""

import numpy as np
from numpy.typing import NDArray

from ogm.metrics.divergence import MIN_EVIDENCE
from ogm.state import CellState


def evilog_kl(evidence: NDArray[np.floating], state: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the "KL divergence" of the EviLOG code for every cell, without its running average.

    It is Keras' categorical divergence between the truth as *evidence*, 1 for the state of a known cell and 0
    otherwise, and the raw evidence of the grid, both clipped to [1e-7, 1]: -ln(clip(e of the true state)) to six
    digits. A missed detection costs 16.1, excess and false evidence cost nothing: evidence of 1 for both states in all
    cells is perfect.

    Parameters
    ----------
    evidence : (..., 2) float array
        Raw evidence of free and occupied.
    state : (...) uint8
        True states: 0 unknown, 1 free, 2 occupied, 3 ignored.

    Returns
    -------
    (...) float64; NaN in ignored cells

    Notes
    -----
    The code updates one metric object with the network and then, without a reset, with the baseline, so that the
    published value of the baseline is the mean of both. This function has no state.
    """
    label = np.stack([state == CellState.FREE, state == CellState.OCCUPIED], axis=-1).astype(np.float64)
    label, clipped = (np.clip(x, MIN_EVIDENCE, 1.0) for x in (label, evidence.astype(np.float64)))
    values = (label * np.log(label / clipped)).sum(axis=-1)
    return np.where(state == CellState.IGNORE, np.nan, values)
