"""Labels of a scan: boxes around objects, and a class for every point."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.scan import Boxes
from ogm.storage.files import OgmError, error_context

REACH = 1e5  # [m] beyond which float32 is coarser than a centimetre, and no lidar measures


class BoxRow(NamedTuple):
    """One box of a file: center (3,) [m], length, width, height [m], yaw [rad], class, track."""

    center: Sequence[float] | NDArray[np.float64]
    size: Sequence[float] | NDArray[np.float64]
    yaw: float
    label: str
    track: str = ""


def boxes_of(rows: Sequence[BoxRow], where: object) -> Boxes:
    """Return the boxes of a file as columns.

    Parameters
    ----------
    rows : sequence of BoxRow
    where : path or str
        Name of the file, for the error.

    Raises
    ------
    OgmError
        If a number is not finite or beyond `REACH`, or a size is not above 0.
    """
    if not rows:
        return Boxes.empty()
    center, size, yaw, label, track = zip(*rows, strict=True)
    with error_context(where):
        boxes = Boxes(np.array(center), np.array(size), np.array(yaw), label=label, track=track)
    far = np.abs(np.column_stack([boxes.center, boxes.size])).max(axis=1) > REACH
    if far.any():
        k = int(np.argmax(far))
        got = f"center {boxes.center[k].tolist()}, size {boxes.size[k].tolist()}"
        raise OgmError(f"{where}: box {k} ({label[k]}) must lie within {REACH:g} m, got {got}: drop or correct it")
    return boxes


@dataclass(frozen=True, eq=False)
class LabelledPoints:
    """Points of a scan, each with a class.

    Parameters
    ----------
    points : (N, 4) float32
        x forward, y left, z up [m], intensity [0, 1].
    classes : (N,) int64
        Number of each point's class.
    names : mapping of int to str
        Name of each class.

    Raises
    ------
    OgmError
        If the counts disagree, a class has no name, or a point lies beyond `REACH`.
    """

    points: NDArray[np.float32]
    classes: NDArray[np.int64]
    names: Mapping[int, str]

    def __post_init__(self) -> None:
        if self.classes.shape != (len(self.points),):
            raise OgmError(f"there must be one class per point, got {self.classes.shape} for {len(self.points)} points")
        if np.abs(self.points[:, :3]).max(initial=0) > REACH:
            raise OgmError(f"points have coordinates of more than {REACH:g} m, wanted metres: the scan is damaged")
        if unknown := sorted(set(np.unique(self.classes).tolist()) - set(self.names)):
            raise OgmError(
                f"class {', '.join(map(str, unknown[:8]))} is not one of the {len(self.names)} known classes (up to "
                f"{max(self.names)}): these labels belong to another dataset, or have another byte order"
            )

    def named(self) -> NDArray[np.str_]:
        """Return the name of each point's class, (N,)."""
        numbers, where = np.unique(self.classes, return_inverse=True)
        return np.array([self.names[int(number)] for number in numbers], dtype=np.str_)[where]
