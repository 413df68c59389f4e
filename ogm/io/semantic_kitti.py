"""SemanticKITTI: a class for every point of KITTI's odometry scans (Behley et al. 2019).

>>> from ogm.io.semantic_kitti import SEMANTIC_KITTI, read_semantic_kitti
>>> SEMANTIC_KITTI[40]
'road'
>>> points = read_semantic_kitti("velodyne/000000.bin", "labels/000000.label")  # doctest: +SKIP
"""

import numpy as np

from ogm.io.formats import parse_kitti
from ogm.io.labels import LabelledPoints
from ogm.io.reading import read_bytes
from ogm.storage.files import FilePath, OgmError, error_context

__all__ = ["SEMANTIC_KITTI", "SEMANTIC_KITTI_MOVING", "SEMANTIC_KITTI_TRAINING", "read_semantic_kitti"]

# Classes by number, as in ``labels/*.label`` of SemanticKITTI
SEMANTIC_KITTI = {
    **{0: "unlabeled", 1: "outlier", 10: "car", 11: "bicycle", 13: "bus", 15: "motorcycle", 16: "on-rails"},
    **{18: "truck", 20: "other-vehicle", 30: "person", 31: "bicyclist", 32: "motorcyclist", 40: "road"},
    **{44: "parking", 48: "sidewalk", 49: "other-ground", 50: "building", 51: "fence", 52: "other-structure"},
    **{60: "lane-marking", 70: "vegetation", 71: "trunk", 72: "terrain", 80: "pole", 81: "traffic-sign"},
    **{99: "other-object", 252: "moving-car", 253: "moving-bicyclist", 254: "moving-person"},
    **{255: "moving-motorcyclist", 256: "moving-on-rails", 257: "moving-bus", 258: "moving-truck"},
    **{259: "moving-other-vehicle"},
}

# Classes that move while the drive is recorded
SEMANTIC_KITTI_MOVING = frozenset(range(252, 260))

_TRAINING = (
    "unlabeled, car, bicycle, motorcycle, truck, other-vehicle, person, bicyclist, motorcyclist, road, parking, "
    "sidewalk, other-ground, building, fence, vegetation, trunk, terrain, pole, traffic-sign"
)
# The 20 training classes, by number
SEMANTIC_KITTI_TRAINING = dict(enumerate(_TRAINING.split(", ")))

_LABEL = np.dtype("<u4")


def read_semantic_kitti(scan: FilePath, labels: FilePath) -> LabelledPoints:
    """Read a scan with the class of every point.

    Parameters
    ----------
    scan : path
        ``velodyne/000000.bin`` of KITTI.
    labels : path
        ``labels/000000.label``: one 32-bit number per point, its lower 16 bits are the class.

    Returns
    -------
    LabelledPoints
        Points with `SEMANTIC_KITTI` as names. Points at the sensor itself are left out with their labels.

    Raises
    ------
    FileNotFoundError
        If a file is missing.
    OgmError
        If the numbers of labels and points differ, a class is unknown, or a point is absurdly far.
    """
    (data, inner), (numbers, named) = read_bytes(scan), read_bytes(labels)
    rows = np.column_stack(list(parse_kitti(data, inner).columns.values()))
    if len(numbers) != _LABEL.itemsize * len(rows):
        raise OgmError(
            f"{labels} has {len(numbers) / _LABEL.itemsize:g} labels, {scan} has {len(rows)} points, wanted equal "
            "numbers, 4 bytes per label: give complete files of the same scan"
        )
    both = np.frombuffer(numbers, _LABEL).astype(np.int64)
    kept = np.isfinite(rows).all(axis=1) & np.any(rows[:, :3] != 0, axis=1)
    rows[:, 3] = rows[:, 3].clip(0, 1)
    with error_context(f"{scan} with {named}"):
        return LabelledPoints(rows[kept], both[kept] & 0xFFFF, SEMANTIC_KITTI)
