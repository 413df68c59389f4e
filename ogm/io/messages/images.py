"""Depth images: ``Image`` with ``CameraInfo`` to a scan."""

import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.io.depth import Intrinsics, depth_scan
from ogm.io.messages.plain import as_bytes, describe_message, reads_message, stamp_seconds
from ogm.io.notices import notice
from ogm.scan import Scan
from ogm.storage.files import OgmError, error_context

log: logging.Logger = logging.getLogger(__name__)

DEPTH_ENCODINGS = {"16UC1": ("u2", 1000.0), "32FC1": ("f4", 1.0)}  # REP 118: type of a pixel, its value at 1 m
_ALSO = {"mono16": "u2", "16SC1": "i2", "64FC1": "f8"}  # may be depths, of no common scale
_DISTORTED = 1e-3  # largest coefficient of a lens whose distortion is less than a pixel


@reads_message
def scan_from_depth_image(message: Any, intrinsics: Intrinsics, *, scale: float | None = None) -> Scan:
    """Return the scan of a ``sensor_msgs/Image`` with depths.

    Parameters
    ----------
    message : object
        With the fields of the message. Rows may be padded, and bytes in either order.
    intrinsics : Intrinsics
        See `intrinsics_from_camera_info`.
    scale : float, optional
        Pixel value at 1 m; by default 1000 for 16UC1 and 1 for 32FC1, as REP 118 has them. Other encodings with one
        number per pixel need it.

    Returns
    -------
    Scan
        Of kind "depth" in the axes of the camera's body, x forward, y left, z up, whatever the frame of the header:
        see `ogm.io.depth_scan`.

    Raises
    ------
    OgmError
        If the encoding has no depths, or the bytes do not fit the size.
    """
    where = describe_message(message, "Image")
    encoding = str(message.encoding)
    kind, usual = DEPTH_ENCODINGS.get(encoding, (_ALSO.get(encoding, ""), None))
    wanted = f"wanted depths ({', '.join(DEPTH_ENCODINGS)})"
    if not kind:
        raise OgmError(f"{where} has the encoding {encoding}, {wanted}: choose the topic of a depth camera")
    if (scale := scale or usual) is None:
        raise OgmError(
            f"{where} has the encoding {encoding}, {wanted}: if it has depths, give --depth-scale, 1000 for mm"
        )
    image = _pixels(message, kind, where)
    with error_context(where, ValueError):
        return depth_scan(image, intrinsics, scale, stamp=stamp_seconds(message.header.stamp))


def _pixels(message: Any, kind: str, where: str) -> NDArray[Any]:
    """View the pixels of an image, (height, width)."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    order = ">" if message.is_bigendian else "<"
    pixel = np.dtype(order + kind)
    data, size = as_bytes(message.data, where), width * pixel.itemsize
    if height and not step:  # some drivers do not set it
        step = size
    if min(height, width) < 1 or step < size or len(data) < (height - 1) * step + size:
        raise OgmError(
            f"{where} has {len(data)} bytes, wanted {height} rows of {width} pixels of {pixel.itemsize} bytes, or of "
            f"step {step} bytes: it is cut short or damaged"
        )
    return np.ndarray((height, width), pixel, data, 0, (step, pixel.itemsize))


@reads_message
def intrinsics_from_camera_info(message: Any) -> Intrinsics:
    """Return the camera of a ``sensor_msgs/CameraInfo``, by its matrix K, binning and region of interest.

    The distortion of a lens is neglected, with a notice: drivers give depths of rectified images.

    Raises
    ------
    OgmError
        If it is no calibrated camera.
    """
    where = describe_message(message, "CameraInfo")
    with error_context(f"{where} has a matrix of no numbers", TypeError, ValueError, OverflowError):
        matrix = np.array(message.K if hasattr(message, "K") else message.k, np.float64).reshape(3, 3)
        lens = np.array(message.D if hasattr(message, "D") else message.d, np.float64)
    if np.abs(lens[np.isfinite(lens)]).max(initial=0) > _DISTORTED:
        notice(log, "lens distortion", "%s states a distortion of its lens, which is neglected", where)
    region, across, down = message.roi, max(int(message.binning_x), 1), max(int(message.binning_y), 1)
    width, height = int(region.width) or int(message.width), int(region.height) or int(message.height)
    return Intrinsics(
        width // across,
        height // down,
        float(matrix[0, 0]) / across,
        float(matrix[1, 1]) / down,
        (float(matrix[0, 2]) - int(region.x_offset)) / across,
        (float(matrix[1, 2]) - int(region.y_offset)) / down,
    ).check(where)
