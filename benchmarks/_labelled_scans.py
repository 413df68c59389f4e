"""Scans whose points are labelled as ground or obstacle, for `ground.py`."""

import _run as run  # first: it sets the number of threads

# isort: split
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm import GridSpec
from ogm.datasets import open_dataset
from ogm.io import estimate_sensor_height
from ogm.io.range_images import NUSCENES_ELEVEN, read_range_image
from ogm.io.semantic_kitti import SEMANTIC_KITTI_TRAINING
from ogm.scan import Boxes
from ogm.truth.boxes import boxes_over_points

SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
EGO = (2.5, 1.1)  # [m] |x|, |y| of the ego vehicle: returns in this box are dropped beforehand, as in RayISM
NEAREST = 2.7  # [m] Patchwork++ takes no nearer return for ground, so none is counted for any method
ABOVE_BOTTOM = 0.1  # [m] what is higher above the bottom of an object's box is an obstacle
LABELS = {  # folder, names of the classes, axes, intensity that means 1
    "SemanticKITTI": ("semantic_kitti", SEMANTIC_KITTI_TRAINING, "kitti", 1.0),
    "nuScenes": ("nuscenes", NUSCENES_ELEVEN, "nuscenes", 255.0),
}
GROUND = ("road", "parking", "sidewalk", "other-ground", "terrain")
UNLABELLED = ("unlabeled", "none")
BOXED = {
    "KITTI object, 3 scans": "kitti_object",
    "KITTI drive, 24 consecutive scans": "kitti_raw_0005",
    "nuScenes, 1 scan": "nuscenes_n015",
}


class LabelledScan(NamedTuple):
    """One scan, level and without the ego vehicle, and what is known about its points."""

    name: str
    points: NDArray[np.float32]  # (N, 4) x, y, z [m], intensity [0, 1]
    ground: NDArray[np.bool_]  # (N,) labelled as ground
    obstacle: NDArray[np.bool_]  # (N,) labelled as anything else; what is neither is not counted
    sensor_height: float  # [m] estimated from the points without their labels


def labelled_scan(name: str, points: NDArray, ground: NDArray, obstacle: NDArray) -> LabelledScan:
    """Drop the ego vehicle, and do not count what is too near or outside the grid."""
    x, y = points[:, 0], points[:, 1]
    kept = (np.abs(x) > EGO[0]) | (np.abs(y) > EGO[1])
    counted = SPEC.contains(x, y) & (np.hypot(x, y) > NEAREST)
    height = estimate_sensor_height(points)
    if height is None:
        raise ValueError(f"{name} shows no ground around the sensor, so its height is not known")
    points = np.ascontiguousarray(points[kept], np.float32)
    return LabelledScan(name, points, (ground & counted)[kept], (obstacle & counted)[kept], height)


def range_images(name: str) -> Iterator[LabelledScan]:
    """Read labelled range images, and sort their classes into ground and obstacles."""
    folder, names, axes, intensity_max = LABELS[name]
    for path in sorted((run.DATA / "labelled_range_images" / folder).glob("*.npy.xz")):
        image = read_range_image(path, names, axes, intensity_max=intensity_max)
        ground = np.isin(image.named(), GROUND)
        obstacle = ~ground & ~np.isin(image.named(), UNLABELLED)
        yield labelled_scan(path.name.split(".")[0], image.points, ground, obstacle)


def boxed_scan(name: str, points: NDArray[np.float32], boxes: Boxes) -> LabelledScan:
    """Return a scan of which only the points on objects are known: those in a box and clear of its bottom."""
    obstacle = np.zeros(len(points), bool)
    for k in range(len(boxes)):
        above = (points[:, 2] - boxes.bottom[k] > ABOVE_BOTTOM) & (points[:, 2] < boxes.top[k])
        obstacle |= boxes_over_points(points, boxes.select([k])) & above
    return labelled_scan(name, points, np.zeros_like(obstacle), obstacle)


def boxed_scans(name: str, count: int | None) -> list[LabelledScan]:
    """Read the first frames of a recording with boxes; none where it is not there."""
    folder = run.DATA / BOXED[name]
    if not folder.is_dir():
        return []
    return [boxed_scan(frame.name, frame.scan.points, frame.boxes) for frame in open_dataset(folder)[:count]]
