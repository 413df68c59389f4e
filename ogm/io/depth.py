"""Depth images as scans: pixels to points, without the pixels that lie between two surfaces.

>>> import numpy as np
>>> from ogm.io import Intrinsics, depth_scan
>>> wall = np.full((48, 64), 2000, np.uint16)                       # [mm] along the optical axis
>>> scan = depth_scan(wall, Intrinsics(64, 48, 50.0, 50.0, 31.5, 23.5), scale=1000.0, stride=1)
>>> scan.kind, len(scan), scan.points[0].tolist()                   # of the upper left pixel: x, y, z, intensity
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

EDGE = math.radians(3)  # angle between a surface and the ray to it, below which two pixels are on two surfaces
APART = math.radians(0.5)  # [rad] between points that are left by default
MOST_PIXELS = 3  # along a side of the squares that one point each is left of, by default
LEAST, GREATEST = 0.05, 100.0  # [m] within which the median depth of any camera lies
# Takes x forward, y left, z up to a camera's optical axes: x right, y down, z forward
T_OPTICAL_BODY = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])


class Intrinsics(NamedTuple):
    """A pinhole camera.

    Attributes
    ----------
    width, height : int
        Size of its images [pixel].
    fx, fy : float
        Focal lengths [pixel].
    cx, cy : float
        Principal point [pixel]; (0, 0) is the middle of the upper left pixel.
    distortion : tuple of float
        Coefficients of the lens as OpenCV orders them, k1, k2, p1, p2, k3, and of the rational model k4, k5, k6; empty
        for a rectified image.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def check(self, where: object) -> "Intrinsics":
        """Return them, or raise an OgmError that names their origin where they are no camera's."""
        finite = np.isfinite([*self[:6], *self.distortion]).all()
        if not finite or min(self[:6]) <= 0 or not (self.cx < self.width and self.cy < self.height):
            raise OgmError(
                f"{where} must have a width and a height, focal lengths above 0 and a principal point in the image, "
                f"got {self.width} x {self.height}, fx {self.fx:g}, fy {self.fy:g}, cx {self.cx:g}, cy {self.cy:g}"
                f"{f', distortion {self.distortion}' if self.distortion else ''}: is the camera calibrated?"
            )
        return self


def read_intrinsics(path: FilePath) -> Intrinsics:
    """Read a camera's JSON as Open3D writes it: ``width``, ``height``, ``intrinsic_matrix`` (9 numbers, by columns).

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If it is no such file.
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
    """Return whether a file is a camera's JSON, as far as its keys show."""
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
    """Return a depth image as a scan.

    A pixel without depth (0, NaN, infinite, below 0) or out of range is **unknown**: neither a point nor a beam without
    echo, as what is black, near, far or in the sun has no depth. Left out are pixels between two surfaces, whose depth
    is a mixture: along their row or column they lie behind one neighbour by a jump, and before the other one by a jump
    or beside one without depth. Left out, too, are pixels that none of the four neighbours continues. A jump is a
    difference that a surface has only where it is seen at less than 3 degrees; so a level ground ends at 19 times
    the height of the camera.

    Parameters
    ----------
    image : (height, width) uint16, int, float32 or float64
        Depths along the optical axis, not distances.
    intrinsics : Intrinsics
    scale : float
        Pixel value at 1 m: 1000 for millimetres, 1 for metres, 5000 in the TUM RGB-D data.
    min_range, max_range : float
        Depths that are used [m].
    stride : int, optional
        Of every square of this many pixels, the nearest point is kept: thin things stay. 1 keeps all pixels; by default
        at most 3, and so few that points are at most 0.5 degrees apart.
    stamp : float, optional
        [s]

    The image of a lens with distortion is rectified before, by nearest pixels.

    Returns
    -------
    Scan
        Of `Scan.kind` "depth", x forward, y left, z up around the camera. `Scan.max_range` is `max_range`, and
        `Scan.beam_width` the angle between points in the middle of the image.

    Raises
    ------
    ValueError
        If the image is no depth image, or of another size than the camera's, if most of its depths are of no camera, or
        an option makes no sense.
    """
    if stride is None:
        stride = int(np.clip(APART * min(intrinsics.fx, intrinsics.fy), 1, MOST_PIXELS))
    if not 0 < scale < math.inf or not 0 <= min_range < max_range < math.inf or not 1 <= stride <= 64:
        raise ValueError(
            "scale must be above 0, 0 <= min_range < max_range [m] and stride from 1 to 64, got "
            f"{scale:g}, {min_range:g}, {max_range:g}, {stride}"
        )
    image = np.asarray(image)
    if image.ndim != 2 or image.dtype.kind not in "uif" or image.dtype.itemsize < 2:
        raise ValueError(
            f"a depth image must be (height, width) of 16-bit or float numbers, got {image.shape} {image.dtype}: a "
            "picture of colours or grey values has no depths"
        )
    if image.shape != (intrinsics.height, intrinsics.width):
        raise ValueError(
            f"the image has {image.shape[1]} x {image.shape[0]} pixels, its intrinsics are of {intrinsics.width} x "
            f"{intrinsics.height}: give those of this image"
        )
    if intrinsics.distortion:
        image = np.append(image, image.dtype.type(0))[source_pixels(intrinsics)]
    with np.errstate(invalid="ignore", over="ignore"):
        metres = np.multiply(image, np.float32(1 / scale), dtype=np.float32)
    _check_depths(metres, scale)
    camera = (
        np.float32(intrinsics.fx),
        np.float32(intrinsics.fy),
        np.float32(intrinsics.cx),
        np.float32(intrinsics.cy),
    )
    from ogm.io.depth_points import surface_points  # numba, which reading other files does not need

    points = surface_points(
        metres, camera, np.float32(1 / math.tan(EDGE)), (np.float32(min_range), np.float32(max_range)), stride
    )
    width = min(stride / min(intrinsics.fx, intrinsics.fy), math.pi)
    return Scan(points, stamp=stamp, kind="depth", max_range=float(max_range), beam_width=width)


@lru_cache(maxsize=8)
def source_pixels(intrinsics: Intrinsics) -> NDArray[np.int64]:
    """Return the pixel of a distorted image that lies nearest to each pixel of the rectified one, (height, width).

    Pixels are numbered row by row; ``height * width`` stands for none: beyond the image, or beyond the angle from which
    on the polynomial of the lens no longer grows.

    Parameters
    ----------
    intrinsics : Intrinsics
        With distortion (Brown 1966, as OpenCV has it: plumb bob, or rational with eight coefficients).
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
    """Raise where depths are of no camera: then the scale is wrong."""
    some = metres[::8, ::8]
    some = some[(some > 0) & (some < np.inf)]
    middle = float(np.median(some)) if some.size else 1.0
    if not LEAST <= middle <= GREATEST:
        raise OgmError(
            f"the depths have a median of {middle:.3g} m with {scale:g} for a metre, wanted {LEAST:g} to {GREATEST:g} "
            "m: give the value of a metre, --depth-scale 1000 for millimetres, 1 for metres, 5000 for TUM"
        )
