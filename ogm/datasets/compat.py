"""Boxes to and from rows (B, 7)."""

import numpy as np
from numpy.typing import NDArray

from ogm.io import Objects
from ogm.scan import Boxes


def as_boxes(objects: Objects) -> Boxes:
    rows = objects.boxes
    center = np.column_stack([rows[:, :2], (rows[:, 5] + rows[:, 6]) / 2])
    size = np.column_stack([rows[:, 3:5], rows[:, 6] - rows[:, 5]])
    return Boxes(center, size, rows[:, 2], None, objects.labels, objects.tracks)


def rows(boxes: Boxes) -> NDArray[np.float64]:
    return np.column_stack([boxes.center[:, :2], boxes.yaw, boxes.size[:, :2], boxes.bottom, boxes.top])
