"""Labels of a scan: boxes around objects, a class for every point."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.files import OgmError
from ogm.scan import Boxes

__all__ = ["REACH", "BoxRow", "LabelledPoints", "boxes_of"]

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
        Where they are from, for the error.

    Raises
    ------
    OgmError
        If a number is not finite or beyond `REACH`, or a size is not above 0.
    """
    if not rows:
        return Boxes.empty()
    center, size, yaw, label, track = zip(*rows, strict=True)
    try:
        boxes = Boxes(np.array(center), np.array(size), np.array(yaw), label=label, track=track)
    except ValueError as error:
        raise OgmError(f"{where}: {error}") from error
    far = np.abs(np.column_stack([boxes.center, boxes.size])).max(axis=1) > REACH
    if far.any():
        k = int(np.argmax(far))
        raise OgmError(
            f"{where}: box {k} ({label[k]}) must lie within {REACH:g} m, got center {boxes.center[k].tolist()}, size "
            f"{boxes.size[k].tolist()}; drop it, or mend the label"
        )
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
    instances : (N,) int64 or None
        Number of the object that each point belongs to, within its class; 0 for none. None where the file has
        none.

    Raises
    ------
    OgmError
        If the counts disagree, or a class has no name.
    """

    points: NDArray[np.float32]
    classes: NDArray[np.int64]
    names: Mapping[int, str]
    instances: NDArray[np.int64] | None = None

    def __post_init__(self) -> None:
        wanted = (len(self.points),)
        for name, column in (("classes", self.classes), ("instances", self.instances)):
            if column is not None and column.shape != wanted:
                raise OgmError(
                    f"there must be one of {name} per point, shape {wanted}, got {column.shape}: do the labels belong "
                    "to this scan?"
                )
        unknown = sorted(set(np.unique(self.classes).tolist()) - set(self.names))
        if unknown:
            raise OgmError(
                f"class {', '.join(map(str, unknown[:8]))} is not one of {_range(self.names)}: are these labels of "
                "another data set, or in another order of bytes?"
            )

    def named(self) -> NDArray[np.str_]:
        """Return the name of each point's class, (N,)."""
        numbers, where = np.unique(self.classes, return_inverse=True)
        return np.array([self.names[int(number)] for number in numbers], dtype=np.str_)[where]


def _range(names: Mapping[int, str]) -> str:
    numbers = sorted(names)
    shown = ", ".join(f"{number} {names[number]}" for number in numbers[:3])
    return f"the {len(numbers)} that are known ({shown}, ... {numbers[-1]} {names[numbers[-1]]})"
