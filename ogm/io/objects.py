"""What people noted down about a scan: boxes around objects, a class for every point."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["REACH", "LabelledPoints", "Objects", "upright_boxes"]

REACH = 1e5  # [m] beyond which nothing was seen: as for the points of scans


@dataclass(frozen=True, eq=False)
class Objects:
    """Boxes around objects, upright, in the frame of a sensor: x forward, y left, z up.

    Parameters
    ----------
    boxes : (B, 7) float64
        x, y of the middle [m], yaw [rad], length, width [m], bottom, top: lowest and highest z [m].
    labels : tuple of B str
        What each object is, in the words of its data set.
    tracks : tuple of B str
        Who each object is: the same name in another scan of the recording is the same object. Empty where the
        data set does not say.

    Raises
    ------
    ValueError
        If the counts disagree, a number is not finite or beyond `REACH`, a length or width is not above 0, or a
        top is not above its bottom.
    """

    boxes: NDArray[np.float64]
    labels: tuple[str, ...]
    tracks: tuple[str, ...]

    def __post_init__(self) -> None:
        boxes = np.asarray(self.boxes, np.float64)
        boxes = boxes.reshape(0, 7) if boxes.size == 0 else boxes
        if boxes.ndim != 2 or boxes.shape[1] != 7:
            raise ValueError(
                f"boxes must be (B, 7): x, y, yaw, length, width, bottom, top, got {boxes.shape}"
            )
        labels, tracks = tuple(self.labels), tuple(self.tracks)
        if not len(boxes) == len(labels) == len(tracks):
            raise ValueError(
                f"there must be one label and one track per box, got {len(boxes)} boxes, {len(labels)} labels and "
                f"{len(tracks)} tracks; an unknown track is ''"
            )
        flat = (boxes[:, 3:5] > 0).all(axis=1) & (boxes[:, 6] > boxes[:, 5])
        bad = ~((np.abs(boxes) <= REACH).all(axis=1) & flat)  # NaN is not
        if bad.any():
            k = int(np.argmax(bad))
            raise ValueError(
                f"box {k} ({labels[k]}) must be finite, within {REACH:g} m, with length, width and height above 0 m, "
                f"got x, y, yaw, length, width, bottom, top = {boxes[k].tolist()}; drop it, or mend the label"
            )
        for name, value in (("boxes", boxes), ("labels", labels), ("tracks", tracks)):
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.boxes)

    def chosen(self, keep: ArrayLike) -> "Objects":
        """Return some of the objects: those where `keep`, (B,) bool, is True."""
        at = np.flatnonzero(np.asarray(keep, bool))
        return Objects(self.boxes[at], tuple(self.labels[n] for n in at), tuple(self.tracks[n] for n in at))


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
        What the numbers mean.
    instances : (N,) int64 or None
        Number of the object that each point belongs to, within its class; 0 for none. None where the file does
        not say.

    Raises
    ------
    ValueError
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
                raise ValueError(
                    f"there must be one of {name} per point, shape {wanted}, got {column.shape}: do the labels belong "
                    "to this scan?"
                )
        strangers = sorted(set(np.unique(self.classes).tolist()) - set(self.names))
        if strangers:
            raise ValueError(
                f"class {', '.join(map(str, strangers[:8]))} is not one of {_range(self.names)}: are these labels of "
                "another data set, or in another order of bytes?"
            )

    def named(self) -> NDArray[np.str_]:
        """Return the name of each point's class, (N,)."""
        numbers, where = np.unique(self.classes, return_inverse=True)
        return np.array([self.names[int(number)] for number in numbers], dtype=np.str_)[where]


def upright_boxes(
    middles: ArrayLike, yaw: ArrayLike, sizes: ArrayLike, *, from_bottom: float = 0.5
) -> NDArray[np.float64]:
    """Write boxes as rows: x, y, yaw, length, width, bottom, top.

    Parameters
    ----------
    middles : (B, 3) float
        A point on each box's upright axis [m].
    yaw : (B,) float
        Which way their length points [rad].
    sizes : (B, 3) float
        Length, width, height [m].
    from_bottom : float
        How high in the box that point lies: 0 in the bottom, 0.5 in the middle.

    Returns
    -------
    (B, 7) float64
    """
    middles, sizes = np.reshape(np.asarray(middles, np.float64), (-1, 3)), np.reshape(sizes, (-1, 3))
    bottom = middles[:, 2] - from_bottom * sizes[:, 2]
    top = middles[:, 2] + (1 - from_bottom) * sizes[:, 2]
    turn = np.reshape(np.asarray(yaw, np.float64), (-1,))
    return np.column_stack([middles[:, :2], turn, sizes[:, :2], bottom, top])


def _range(names: Mapping[int, str]) -> str:
    numbers = sorted(names)
    shown = ", ".join(f"{number} {names[number]}" for number in numbers[:3])
    return f"the {len(numbers)} that are known ({shown}, ... {numbers[-1]} {names[numbers[-1]]})"
