"""Range images with a class for every beam, as used to train segmentation networks.

>>> from ogm.io.range_images import NUSCENES_ELEVEN, read_range_image
>>> NUSCENES_ELEVEN[0]
'road'
>>> points = read_range_image("nuscenes/frame.npy", NUSCENES_ELEVEN)        # doctest: +SKIP
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ogm.io.labels import LabelledPoints
from ogm.io.reading import parse_array, read_bytes
from ogm.io.scan_table import Axes, rotation_to_flu
from ogm.storage.files import FilePath, OgmError, error_context

__all__ = ["NUSCENES_ELEVEN", "read_range_image"]

# Classes of the nuScenes frames shipped with PCLSegmentation (ika, RWTH Aachen), by number
_ELEVEN = "road, sidewalk, building, pole, vegetation, person, two-wheeler, car, truck, bus, none"
NUSCENES_ELEVEN = dict(enumerate(_ELEVEN.split(", ")))

_WANTED = "numbers of shape (layers, azimuths, 6): x, y, z, intensity, range, class"


def read_range_image(
    path: FilePath, names: Mapping[int, str], axes: Axes = "flu", *, intensity_max: float = 1.0
) -> LabelledPoints:
    """Read an array (layers, azimuths, 6) of x, y, z [m], intensity, range [m], class.

    Parameters
    ----------
    path : path
        ``.npy``, or packed as ``.npy.xz`` or ``.npy.gz``.
    names : mapping of int to str
        Names of the classes: `NUSCENES_ELEVEN`, `SEMANTIC_KITTI_TRAINING`.
    axes : str, 3 str or (3, 3) array
        Axes of the file, see `read_scan`.
    intensity_max : float
        Intensity that becomes 1; larger values also become 1.

    Returns
    -------
    LabelledPoints
        The beams with a range above 0.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If it holds another array, a beam with a range but with NaN or infinite values, or a class without a name.
    """
    data, _ = read_bytes(path)
    array = parse_array(data, Path(path), lambda shape: len(shape) == 3 and shape[-1] == 6, _WANTED)
    with np.errstate(invalid="ignore"):  # signalling NaN, which are refused if there is a range
        image = array.reshape(-1, 6).astype(np.float64)
    image = image[image[:, 4] > 0]
    if not np.isfinite(image).all():
        bad = np.count_nonzero(~np.isfinite(image).all(axis=1))
        raise OgmError(f"{path} has {bad} beams with a range but with NaN or inf: set their range to 0")
    classes = np.clip(image[:, 5], -1, 2**31).astype(np.int64)
    if not np.array_equal(classes, image[:, 5]):
        raise OgmError(f"{path} must have integer classes in its last column, got other numbers")
    points = np.empty((len(image), 4), np.float32)
    with np.errstate(over="ignore"):  # refused by `LabelledPoints`
        points[:, :3] = image[:, :3] @ rotation_to_flu(axes).T
    points[:, 3] = np.clip(image[:, 3] / intensity_max, 0, 1)
    with error_context(path):
        return LabelledPoints(points, classes, names)
