"""A guarantee of false free for drives that resemble the calibrated drives.

>>> from ogm.calibration import guarantee
>>> from ogm.datasets import open_dataset
>>> bounded = guarantee(open_dataset("drives/"), "combined", limit=0.01)                           # doctest: +SKIP
>>> bounded.save("combined.json")                                                                  # doctest: +SKIP
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from math import floor

import numpy as np
from numpy.typing import NDArray

from ogm.calibration.fit import facts_of
from ogm.grid import GridSpec
from ogm.models.fitted import Calibration, Guarantee
from ogm.models.named import describe_model, load_model, with_radar
from ogm.scan import Frame, SensorModels, run_model
from ogm.state import CellState

LEVELS = 4096  # of the mass of free; a multiple of 2, so that 1/2 is a level
_HALF = LEVELS // 2
_BELOW = 1 - 1e-6  # so that the product of a factor and its level is at most 1/2 in float32


def guarantee(
    dataset: Sequence[Frame],
    model: str = "combined",
    limit: float = 0.01,
    confidence: float = 0.9,
    spec: GridSpec | None = None,
    *,
    reading: Callable[[Iterable[int]], Iterable[int]] = iter,
) -> Calibration:
    """Choose the factor of the mass of free with which a further drive has a bounded false free.

    The loss of a drive is the mean over its frames of the metric ``false_free``: the share of truly occupied cells with
    a mass of free above 1/2. Each drive has a largest factor within `limit`. Of the factors of n drives, the k-th
    smallest is chosen, with k = floor((n + 1) (1 - confidence)). If a further drive is exchangeable with the n drives,
    its own factor is smaller with a probability of at most k / (n + 1) (split conformal prediction, Vovk et al. 2005,
    ch. 2; the loss rises with the factor, as in conformal risk control, Angelopoulos et al. 2024).

    The metrics before and after are means over drives: ``false_free``, and ``found_free``, the share of truly free
    cells with a mass of free above 1/2.

    Parameters
    ----------
    dataset : sequence of Frame
        Frames with truth, of drives to which the model was not fitted. A frame without a sequence is a drive.
    model : str
        Name of a model, see `ogm.models.load_model`; of a calibration without guarantee, the parameters are kept.
    limit : float
        Largest loss, in (0, 1).
    confidence : float
        Least probability that a further drive is within the limit, in (0, 1); at most n / (n + 1).
    spec : GridSpec, optional
        Cells; by default the 81.92 m x 56.32 m of the paper.
    reading : function
        Iterates over the numbers of the frames, and may draw a progress bar.

    Raises
    ------
    ValueError
        If a number is out of range, a frame has no truth, the model has a guarantee already, or there are too few
        drives for the confidence.

    Notes
    -----
    The probability is over calibrated and further drives together. Drives of another sensor, mount or place are not
    exchangeable, and may exceed the limit. Drives of a street on a day are no separate drives: give them
    the same sequence.
    """
    spec = GridSpec.centered() if spec is None else spec
    Guarantee(limit, confidence, 1.0, 0)  # checks the numbers before the scans are mapped
    start = Calibration.load(model) if model.endswith(".json") else None
    if start is not None and start.guarantee is not None:
        raise ValueError(f"{model} has a guarantee already; give the model or the fitted parameters without it")
    ism = load_model(with_radar(model), spec, drop_ego_returns=True)
    curves, count = curves_by_drive(dataset, ism, spec, reading)
    by_drive = np.array([*curves.values()]).reshape(-1, 2, LEVELS + 1)
    factor = chosen_factor([largest_factor(loss, limit) for loss, _ in by_drive], confidence)
    _, weights = describe_model(model if start is None else start.model)
    bound = Guarantee(limit, confidence, factor, len(by_drive), (weights or {}).get("sha256", ""))
    before, after = (
        dict(zip(("false_free", "found_free"), by_drive[..., level].mean(axis=0).tolist(), strict=True))
        for level in (_HALF, floor(_HALF / factor))
    )
    data = facts_of(dataset) | {"frames": count, "drives": len(by_drive)}
    given = Calibration(model, {}, guarantee=bound) if start is None else start
    fitted_to = {"fitted_to": given.data["name"]} if "name" in given.data else {}
    return replace(given, before=before, after=after, data=data | fitted_to, guarantee=bound)


def curves_by_drive(
    dataset: Sequence[Frame],
    ism: SensorModels,
    spec: GridSpec,
    reading: Callable[[Iterable[int]], Iterable[int]] = iter,
) -> tuple[dict[str, NDArray[np.float64]], int]:
    """Return shares of occupied and of free cells above each level of the mass of free, by drive.

    Parameters
    ----------
    dataset : sequence of Frame
        Frames with truth; without occupied or free cells they are left out.
    ism : sensor model
    spec : GridSpec
        Cells of the model.
    reading : function
        Iterates over the numbers of the frames.

    Returns
    -------
    curves : dict of str to (2, `LEVELS` + 1) float64
        Means over the frames of a drive, see `exceeded`.
    count : int
        Number of frames used.
    """
    curves: dict[str, list[NDArray[np.float64]]] = {}
    for k in reading(range(len(dataset))):
        frame = dataset[k]
        if frame.truth is None:
            raise ValueError(f"frame {frame.name} has no truth; give labelled frames")
        state, free = frame.truth.crop(spec).state, run_model(ism, frame).free
        masses = free[state == CellState.OCCUPIED], free[state == CellState.FREE]
        if all(map(len, masses)):
            curves.setdefault(frame.sequence or frame.name, []).append(np.array([*map(exceeded, masses)]))
    return {drive: np.mean(found, axis=0) for drive, found in curves.items()}, sum(map(len, curves.values()))


def exceeded(free: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the shares of cells with a mass of free above each of the levels 0, 1 / `LEVELS`, ..., 1."""
    level = np.ceil(np.asarray(free, np.float64) * LEVELS).astype(np.intp)
    return (len(level) - np.cumsum(np.bincount(level, minlength=LEVELS + 1))) / len(level)


def largest_factor(loss: NDArray[np.float64], limit: float) -> float:
    """Return the largest factor in [0, 1] with a loss within the limit, from the loss by the level of free."""
    level = max(int(np.argmax(loss <= limit + 1e-12)), _HALF)
    return 1.0 if level == _HALF else _BELOW * _HALF / level


def chosen_factor(factors: Sequence[float], confidence: float) -> float:
    """Return the k-th smallest of n factors, k = floor((n + 1) (1 - confidence)).

    Raises
    ------
    ValueError
        If there are too few factors.
    """
    n = len(factors)
    k = floor((n + 1) * (1 - confidence) + 1e-9)
    if k < 1:
        wanted = floor(confidence / (1 - confidence) + 1 - 1e-9)
        most = f"at most {n / (n + 1):.2g}" if n else "none"
        raise ValueError(
            f"{n} drives with occupied cells allow a confidence of {most}, wanted {confidence:g}: give {wanted} drives "
            "or more, or a lower confidence"
        )
    return float(np.sort(factors)[k - 1])
