"""Scans from depth images, without the pixels between two surfaces.

>>> import numpy as np
>>> from ogm.io import Intrinsics, depth_scan
>>> wall = np.full((48, 64), 2000, np.uint16)                       # [mm] along the optical axis
>>> scan = depth_scan(wall, Intrinsics(64, 48, 50.0, 50.0, 31.5, 23.5), scale=1000.0, stride=1)
>>> scan.kind, len(scan), scan.points[0].tolist()                   # x, y, z, intensity of the upper left pixel
('depth', 3072, [2.0, 1.25..., 0.93..., 0.0])
"""

import math
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.io.reading import need, need_numbers, read_json
from ogm.scan import Scan
from ogm.storage.files import FilePath, OgmError

EDGE = math.radians(3)  # angle between a surface and the ray, below which two pixels belong to two surfaces
APART = math.radians(0.5)  # [rad] default largest angle between points
MAX_STRIDE = 3  # [pixel] default largest side of the squares that give one point each
MIN_MEDIAN, MAX_MEDIAN = 0.05, 100.0  # [m] plausible median depth of any camera
# Takes x forward, y left, z up to a camera's optical axes: x right, y down, z forward
T_OPTICAL_BODY = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])


class Intrinsics(NamedTuple):
    """Intrinsic parameters of a pinhole camera.

    Attributes
    ----------
    width, height : int
        Size of the images [pixel].
    fx, fy : float
        Focal lengths [pixel].
    cx, cy : float
        Principal point [pixel]; (0, 0) is the centre of the upper left pixel.
    distortion : tuple of float
        Lens coefficients in the order of OpenCV: k1, k2, p1, p2, k3, and for the rational model k4, k5, k6. Empty for
        a rectified image.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def check(self, where: object) -> "Intrinsics":
        """Return the intrinsics if they are plausible; raise an OgmError with their origin `where` if not."""
        finite = np.isfinite([*self[:6], *self.distortion]).all()
        if not finite or min(self[:6]) <= 0 or not (self.cx < self.width and self.cy < self.height):
            raise OgmError(
                f"{where} must have a width and a height, focal lengths above 0 and a principal point in the image, "
                f"got {self.width} x {self.height}, fx {self.fx:g}, fy {self.fy:g}, cx {self.cx:g}, cy {self.cy:g}"
                f"{f', distortion {self.distortion}' if self.distortion else ''}: calibrate the camera"
            )
        return self


def read_intrinsics(path: FilePath) -> Intrinsics:
    """Read camera intrinsics as JSON of Open3D: ``width``, ``height``, ``intrinsic_matrix`` (9 numbers, by columns).

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If the content is invalid.
    """
    path = Path(path)
    content = read_json(path, dict, "intrinsics of a camera: width, height, intrinsic_matrix")
    sizes = [need_numbers(content, name, (), path) for name in ("width", "height")]
    fx, below, _, above, fy, _, cx, cy, last = need_numbers(content, "intrinsic_matrix", 9, path).tolist()
    if below or above or last != 1:
        raise OgmError(f"intrinsic_matrix of {path} must be fx 0 0 0 fy 0 cx cy 1 (by columns), got another matrix")
    width, height = (int(np.clip(size, 0, 2**31)) for size in sizes)
    return Intrinsics(width, height, fx, fy, cx, cy).check(path)


def is_intrinsics(path: Path) -> bool:
    """Return whether a file has the keys of camera intrinsics as JSON."""
    try:
        content = read_json(path, dict, "intrinsics of a camera")
        need(content, "intrinsic_matrix", path)
    except (OgmError, OSError):
        return False
    return True


def depth_scan(
    image: NDArray[Any],
    intrinsics: Intrinsics,
    scale: float,
    *,
    min_range: float = 0.2,
    max_range: float = 10.0,
    stride: int | None = None,
    stamp: float | None = None,
) -> Scan:
    """Return the scan of a depth image.

    A pixel without depth (0, NaN, infinite, below 0) or out of range is **unknown**: neither a point nor a beam without
    echo, because black, near, far or sunlit surfaces have no depth. Two kinds of pixels are left out. Pixels between
    two surfaces have a mixed depth: along their row or column they lie behind one neighbour by a jump, and before the
    other by a jump or next to missing depth. Isolated pixels continue none of their four neighbours. A jump is a depth
    difference that a surface has only if it is seen at less than 3 degrees; level ground therefore ends at 19 times the
    height of the camera. An image with lens distortion is rectified first, by nearest pixels.

    Parameters
    ----------
    image : (height, width) uint16, int, float32 or float64
        Depths along the optical axis, not distances.
    intrinsics : Intrinsics
    scale : float
        Pixel value at 1 m: 1000 for millimetres, 1 for metres, 5000 for TUM RGB-D.
    min_range, max_range : float
        Range of valid depths [m].
    stride : int, optional
        Side of squares of pixels, each of which gives its nearest point, so that thin objects stay. 1 keeps all pixels.
        Default: at most 3, and at most 0.5 degrees between points.
    stamp : float, optional
        [s]

    Returns
    -------
    Scan
        Scan of kind "depth", x forward, y left, z up around the camera. `Scan.max_range` is `max_range`, and
        `Scan.beam_width` the angle between points in the middle of the image.

    Raises
    ------
    ValueError
        If the image is no depth image or has another size than `intrinsics`, the median depth is implausible, or an
        option is out of range.
    """
    if stride is None:
        stride = int(np.clip(APART * min(intrinsics.fx, intrinsics.fy), 1, MAX_STRIDE))
    if not 0 < scale < math.inf or not 0 <= min_range < max_range < math.inf or not 1 <= stride <= 64:
        raise ValueError(
            "scale must be above 0, 0 <= min_range < max_range [m] and stride from 1 to 64, got "
            f"{scale:g}, {min_range:g}, {max_range:g}, {stride}"
        )
    image = np.asarray(image)
    if image.ndim != 2 or image.dtype.kind not in "uif" or image.dtype.itemsize < 2:
        raise ValueError(
            f"a depth image must be (height, width) of 16-bit or float numbers, got {image.shape} {image.dtype}: give "
            "the depth image, not the colour or grey image"
        )
    if image.shape != (intrinsics.height, intrinsics.width):
        raise ValueError(
            f"the image has {image.shape[1]} x {image.shape[0]} pixels, its intrinsics have {intrinsics.width} x "
            f"{intrinsics.height}: give the intrinsics of this image"
        )
    if intrinsics.distortion:
        image = np.append(image, image.dtype.type(0))[source_pixels(intrinsics)]
    with np.errstate(invalid="ignore", over="ignore"):
        metres = np.multiply(image, np.float32(1 / scale), dtype=np.float32)
    _check_depths(metres, scale)
    fx, fy, cx, cy = map(np.float32, intrinsics[2:6])
    from ogm.io.depth_points import surface_points  # imports numba, which other readers do not need

    slope, limits = np.float32(1 / math.tan(EDGE)), (np.float32(min_range), np.float32(max_range))
    points = surface_points(metres, (fx, fy, cx, cy), slope, limits, stride)
    width = min(stride / min(intrinsics.fx, intrinsics.fy), math.pi)
    return Scan(points, stamp=stamp, kind="depth", max_range=float(max_range), beam_width=width)


@lru_cache(maxsize=8)
def source_pixels(intrinsics: Intrinsics) -> NDArray[np.int64]:
    """Return the distorted pixel nearest to each rectified pixel, (height, width).

    Pixels are numbered row by row. ``height * width`` means no pixel: beyond the image, or beyond the angle at which
    the lens polynomial stops growing.

    Parameters
    ----------
    intrinsics : Intrinsics
        Intrinsics with distortion (Brown 1966 as in OpenCV: plumb bob, or rational with eight coefficients).
    """
    width, height, fx, fy, cx, cy, given = intrinsics
    k1, k2, p1, p2, k3, k4, k5, k6 = (*given, *(0.0,) * (8 - len(given)))
    x, y = (np.arange(width) - cx) / fx, ((np.arange(height) - cy) / fy)[:, np.newaxis]

    def radial(square: NDArray[np.float64]) -> NDArray[np.float64]:
        above, below = (1 + square * (a + square * (b + square * c)) for a, b, c in ((k1, k2, k3), (k4, k5, k6)))
        return np.asarray(above / below)

    with np.errstate(all="ignore"):
        square = x * x + y * y
        radius = np.linspace(0, math.sqrt(float(square.max())), 1024)
        grows = np.diff(radius * radial(radius**2)) > 0
        last = math.inf if grows.all() else float(radius[np.argmin(grows)])
        factor = radial(square)
        column = cx + fx * (x * factor + 2 * p1 * x * y + p2 * (square + 2 * x * x))
        row = cy + fy * (y * factor + p1 * (square + 2 * y * y) + 2 * p2 * x * y)
        inside = (
            (square <= last**2)
            & (abs(column - (width - 1) / 2) < width / 2)
            & (abs(row - (height - 1) / 2) < height / 2)
        )
        pixels = np.where(inside, np.rint(row) * width + np.rint(column), width * height)
    return pixels.astype(np.int64)


def _check_depths(metres: NDArray[np.float32], scale: float) -> None:
    """Raise if the median depth is implausible, which indicates a wrong scale."""
    sample = metres[::8, ::8]
    sample = sample[(sample > 0) & (sample < np.inf)]
    median = float(np.median(sample)) if sample.size else 1.0
    if not MIN_MEDIAN <= median <= MAX_MEDIAN:
        raise OgmError(
            f"the depths have a median of {median:.3g} m at scale {scale:g}, wanted {MIN_MEDIAN:g} to {MAX_MEDIAN:g} "
            "m: give the pixel value at 1 m, --depth-scale 1000 for millimetres, 1 for metres, 5000 for TUM"
        )
