"""What the paper's released code reports: for comparison with its figures only, never to rank by.

Its "KL divergence" is Keras' categorical one of clipped evidence, it averages the baseline's with its rival's, and
its "accuracy" is the share of cells that are called unknown (github.com/ika-rwth-aachen/EviLOG, model/evaluate.py
and model/metrics.py). None of the three says how good a map is, as the functions here say in detail.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.metrics.kernels import CLIP
from ogm.state import predict_state

__all__ = ["Published", "legacy_accuracy", "legacy_kl", "legacy_published", "legacy_unmixed"]

_UNKNOWN, _FREE, _OCCUPIED, _IGNORE = 0, 1, 2, 3  # states of a cell, as in ogm.truth


class Published(NamedTuple):
    """What the released code's stateful metric reports of two methods, see `legacy_published`.

    Attributes
    ----------
    first, second : (frames,) float64
        If the metric is reset at every frame, as for the paper's figure: the first method's own value, and the
        mean of both.
    running_first, running_second : (frames,) float64
        If it is never reset: the mean of all calls so far, read after the first and after the second method.
    """

    first: NDArray[np.float64]
    second: NDArray[np.float64]
    running_first: NDArray[np.float64]
    running_second: NDArray[np.float64]


def legacy_kl(evidence: NDArray[np.floating], state: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return what the paper's released code calls KL divergence, for every cell, without its running average.

    It is Keras' categorical divergence between the truth as *evidence*, 1 for the state of a known cell and 0
    elsewhere, and the raw evidence of the grid, both clipped to [1e-7, 1]: -ln(clip(e of the true state)) to six
    digits. It charges 16.1 for a missing claim, nothing for an excess and nothing for a wrong one: evidence of 1
    for both states everywhere is perfect. For comparison with the paper's figures only.

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
    Their code calls one metric object for the network and then, without a reset, for the baseline, so that the
    published value of the baseline is the mean of both; this function keeps no state. See `legacy_published`.
    """
    logs = np.log(np.clip(evidence.astype(np.float64), CLIP, 1.0))
    free, occupied = logs[..., 0], logs[..., 1]
    faint = CLIP * np.log(CLIP)
    values = np.full(state.shape, np.nan)
    values = np.where(state == _UNKNOWN, 2 * faint - CLIP * (free + occupied), values)
    values = np.where(state == _FREE, faint - free - CLIP * occupied, values)
    return np.where(state == _OCCUPIED, faint - occupied - CLIP * free, values)


def legacy_published(first: ArrayLike, second: ArrayLike) -> Published:
    """Return what the released code reports for two methods, given the mean `legacy_kl` of each frame.

    One metric object averages all that it is called with until it is reset. It is called with the first method
    (the network), read, called with the second one (the baseline), and read again: the second reading is the mean
    of both.

    Parameters
    ----------
    first, second : (frames,) float array
        Mean of `legacy_kl` over the cells of every frame (the score ``legacy_kl``), finite.

    Returns
    -------
    Published
    """
    a, b = _alike(first, second)
    calls = np.stack([a, b], axis=-1).ravel()
    running = np.cumsum(calls) / np.arange(1, len(calls) + 1)
    return Published(a, (a + b) / 2, running[::2], running[1::2])


def legacy_unmixed(first: ArrayLike, published: ArrayLike) -> NDArray[np.float64]:
    """Return the second method's own values from the two published curves: 2 published - first.

    Parameters
    ----------
    first, published : (frames,) float array
        As `Published.first` and `Published.second`.
    """
    a, b = _alike(first, published)
    return 2 * b - a


def legacy_accuracy(mass: NDArray[np.floating], state: NDArray[np.uint8]) -> float:
    """Return what the released code calls accuracy: agreement in the largest of (free, occupied, unknown).

    Its truth has evidence 1, hence masses of 1/3 for the true state and 2/3 for unknown: by largest mass, every
    cell of the truth is unknown, and the accuracy is the share of cells that the grid calls unknown. A grid that
    says nothing is perfect.

    Parameters
    ----------
    mass : (..., 2) float array
        Masses of free and occupied.
    state : (...) uint8
        True states: 0 unknown, 1 free, 2 occupied, 3 ignored.

    Returns
    -------
    float
        In [0, 1]; NaN if every cell is ignored.
    """
    kept = state != _IGNORE
    if not kept.any():
        return float("nan")
    truth = np.stack([state == _FREE, state == _OCCUPIED], axis=-1) / 3
    return float((predict_state(mass[kept]) == predict_state(truth[kept])).mean())


def _alike(first: ArrayLike, second: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
    if a.ndim != 1 or a.shape != b.shape or not np.isfinite(a).all() or not np.isfinite(b).all():
        raise ValueError(
            f"both methods need one finite value per frame, got shapes {a.shape} and {b.shape}; leave out frames "
            "without a value"
        )
    return a, b
