"""Depth images as scans: pixels to points, without the pixels that lie between two surfaces.

>>> import numpy as np
>>> from ogm.io import Intrinsics, depth_scan
>>> wall = np.full((48, 64), 2000, np.uint16)                       # [mm] along the optical axis
>>> scan = depth_scan(wall, Intrinsics(64, 48, 50.0, 50.0, 31.5, 23.5), scale=1000.0, stride=1)
>>> scan.kind, len(scan), scan.points[0].round(2).tolist()          # of the upper left pixel: x, y, z, intensity
('depth', 3072, [2.0, 1.26, 0.94, 0.0])
"""

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.io.reading import need, need_numbers, read_json
from ogm.jit import kernel
from ogm.scan import Scan
from ogm.storage.files import FilePath, OgmError

EDGE = math.radians(3)  # angle between a surface and the ray to it, below which two pixels are on two surfaces
APART = math.radians(0.5)  # [rad] between points that are left by default
MOST_PIXELS = 3  # along a side of the squares that one point each is left of, by default
LEAST, GREATEST = 0.05, 100.0  # [m] within which the median depth of any camera lies
T_OPTICAL_BODY = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
"""Takes x forward, y left, z up to a camera's optical axes: x right, y down, z forward."""


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
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def check(self, where: object) -> "Intrinsics":
        """Return them, or raise an OgmError that names their origin where they are no camera's."""
        finite = np.isfinite(self).all()
        if not finite or min(self) <= 0 or not (self.cx < self.width and self.cy < self.height):
            raise OgmError(
                f"{where} must have a width and a height, focal lengths above 0 and a principal point in the image, "
                f"got {self.width} x {self.height}, fx {self.fx:g}, fy {self.fy:g}, cx {self.cx:g}, cy {self.cy:g}: "
                "is the camera calibrated?"
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
    with np.errstate(invalid="ignore", over="ignore"):
        metres = np.multiply(image, np.float32(1 / scale), dtype=np.float32)
    _check_depths(metres, scale)
    camera = (
        np.float32(intrinsics.fx),
        np.float32(intrinsics.fy),
        np.float32(intrinsics.cx),
        np.float32(intrinsics.cy),
    )
    points = _points(
        metres, camera, np.float32(1 / math.tan(EDGE)), (np.float32(min_range), np.float32(max_range)), stride
    )
    width = min(stride / min(intrinsics.fx, intrinsics.fy), math.pi)
    return Scan(points, stamp=stamp, kind="depth", max_range=float(max_range), beam_width=width)


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


@kernel
def _step(a: np.float32, b: np.float32, slope: np.float32) -> int:
    """Return whether b lies behind a (1) or before it (-1) by a jump, or continues it (0); 2 where it has no depth."""
    if not b > 0:
        return 2
    jump = min(a, b) * slope
    if b - a > jump:
        return 1
    return -1 if a - b > jump else 0


@kernel
def _is_mixture(depth: NDArray[np.float32], v: int, u: int, across: np.float32, down: np.float32) -> bool:
    """Return whether a pixel lies between two surfaces, or is continued by no neighbour."""
    z, none = depth[v, u], np.float32(0)
    left = _step(z, depth[v, u - 1] if u > 0 else none, across)
    right = _step(z, depth[v, u + 1] if u + 1 < depth.shape[1] else none, across)
    up = _step(z, depth[v - 1, u] if v > 0 else none, down)
    low = _step(z, depth[v + 1, u] if v + 1 < depth.shape[0] else none, down)
    if (left == -1 and right >= 1) or (right == -1 and left >= 1) or (up == -1 and low >= 1) or (low == -1 and up >= 1):
        return True
    return left != 0 and right != 0 and up != 0 and low != 0


@kernel
def _nearest(
    depth: NDArray[np.float32], rows: tuple[int, int], columns: tuple[int, int], limits: tuple[np.float32, np.float32]
) -> tuple[int, int]:
    """Return row and column of the nearest pixel of a rectangle within limits, (-1, -1) without any."""
    nearest, row, column = limits[1], -1, -1
    for v in range(rows[0], rows[1]):
        for u in range(columns[0], columns[1]):
            z = depth[v, u]
            if z >= limits[0] and z <= nearest and z > 0:
                nearest, row, column = z, v, u
    return row, column


@kernel
def _nearest_surface(
    depth: NDArray[np.float32],
    rows: tuple[int, int],
    columns: tuple[int, int],
    limits: tuple[np.float32, np.float32],
    slopes: tuple[np.float32, np.float32],
) -> tuple[int, int]:
    """Return what `_nearest` does, of the pixels that are no mixture."""
    nearest, row, column = limits[1], -1, -1
    for v in range(rows[0], rows[1]):
        for u in range(columns[0], columns[1]):
            z = depth[v, u]
            near = z >= limits[0] and z <= nearest and z > 0
            if near and not _is_mixture(depth, v, u, slopes[0], slopes[1]):
                nearest, row, column = z, v, u
    return row, column


@kernel
def _points(
    depth: NDArray[np.float32],
    camera: tuple[np.float32, np.float32, np.float32, np.float32],
    per_tangent: np.float32,
    limits: tuple[np.float32, np.float32],
    stride: int,
) -> NDArray[np.float32]:
    """Return the nearest point of every `stride` x `stride` pixels that is no mixture, (N, 4).

    Parameters
    ----------
    depth : (rows, columns) float32
        [m]; no depth where not above 0.
    camera : (fx, fy, cx, cy)
    per_tangent : float
        Difference of depth over distance across of the flattest surface.
    limits : (least, greatest)
        [m]
    stride : int
    """
    fx, fy, cx, cy = camera
    rows, columns = depth.shape
    across, down = per_tangent / fx, per_tangent / fy
    points = np.empty((((rows + stride - 1) // stride) * ((columns + stride - 1) // stride), 4), np.float32)
    count = 0
    for top in range(0, rows, stride):
        for first in range(0, columns, stride):
            bottom, last = min(top + stride, rows), min(first + stride, columns)
            row, column = _nearest(depth, (top, bottom), (first, last), limits)
            if row >= 0 and _is_mixture(depth, row, column, across, down):
                row, column = _nearest_surface(depth, (top, bottom), (first, last), limits, (across, down))
            if row >= 0:
                nearest = depth[row, column]
                points[count, 0] = nearest
                points[count, 1] = (cx - column) * nearest / fx
                points[count, 2] = (cy - row) * nearest / fy
                points[count, 3] = 0
                count += 1
    return points[:count].copy()
