"""Scores by the distance of the cells from the sensor."""

import numpy as np
from numpy.typing import NDArray

from ogm.grid import GridSpec
from ogm.metrics.areas import free_recall, overlaps, parts
from ogm.metrics.counts import ConfusionSums
from ogm.state import CellState


def distances(spec: GridSpec) -> NDArray[np.float32]:
    """Return how far the middles of the cells are from the origin of the grid's frame, which is the sensor.

    Parameters
    ----------
    spec : GridSpec

    Returns
    -------
    (nx, ny) float32
        Horizontal distance [m].
    """
    x, y = spec.cell_centers
    return np.asarray(np.hypot(x, y).astype(np.float32))


def by_range(counts: ConfusionSums) -> dict[str, NDArray[np.float64]]:
    """Return scores by distance, one number per bin of `RANGES`.

    Parameters
    ----------
    counts : ConfusionSums
        Counted with distances.

    Returns
    -------
    dict of str to (ranges,) float64
        ``cells``, ``free_cells`` and ``occupied_cells`` (not ignored, truly free, truly occupied), and, as in
        `METRICS`, ``false_free``, ``missed_occupied``, ``false_occupied``, ``iou_free``, ``iou_occupied``,
        ``iou_unknown``, ``free_recall_1`` and ``free_recall_01`` (each bin at its own threshold, of 1025
        levels); NaN where a bin has no such cell.
    """
    confusion, detections = counts.range_confusion, counts.range_detections
    cells = confusion.sum(axis=-1)
    overlap = np.array([overlaps(one) for one in confusion])
    return {
        "cells": cells.sum(axis=-1),
        "free_cells": cells[:, CellState.FREE],
        "occupied_cells": cells[:, CellState.OCCUPIED],
        "false_free": parts(detections[:, CellState.OCCUPIED, 0], cells[:, CellState.OCCUPIED]),
        "missed_occupied": 1 - parts(detections[:, CellState.OCCUPIED, 1], cells[:, CellState.OCCUPIED]),
        "false_occupied": parts(detections[:, CellState.FREE, 1], cells[:, CellState.FREE]),
        "iou_free": overlap[:, CellState.FREE],
        "iou_occupied": overlap[:, CellState.OCCUPIED],
        "iou_unknown": overlap[:, CellState.UNKNOWN],
        "free_recall_1": np.array([free_recall(one, 0.01) for one in counts.range_bel_free_hist]),
        "free_recall_01": np.array([free_recall(one, 0.001) for one in counts.range_bel_free_hist]),
    }
