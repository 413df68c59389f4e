"""Depth images: ``Image`` or ``CompressedImage`` with ``CameraInfo`` to a scan."""

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.io.depth import Intrinsics, depth_scan
from ogm.io.images import deep_pixels
from ogm.io.messages.plain import as_bytes, describe_message, reads_message, stamp_seconds
from ogm.scan import Scan
from ogm.storage.files import OgmError, error_context

DEPTH_ENCODINGS = {"16UC1": ("u2", 1000.0), "32FC1": ("f4", 1.0)}  # REP 118: type of a pixel, its value at 1 m
_ALSO = {"mono16": "u2", "16SC1": "i2", "64FC1": "f8"}  # possible depths, of no common scale
_DISTORTED = 1e-3  # largest coefficient of a lens with less than a pixel of distortion
_LENSES = {"plumb_bob": 5, "rational_polynomial": 8}  # largest number of coefficients
_HEADER = struct.Struct("<iff")  # of compressed_depth_image_transport: format, quantisation A and B
_PNG = b"\x89PNG"


@reads_message
def scan_from_depth_image(message: Any, intrinsics: Intrinsics, *, scale: float | None = None) -> Scan:
    """Return the scan of a ``sensor_msgs/Image`` or ``sensor_msgs/CompressedImage`` with depths.

    Parameters
    ----------
    message : object
        Object with the fields of the message. Rows may be padded, with either byte order. Compressed depths are PNG,
        either by compressed_depth_image_transport, with quantised float depths, or by compressed_image_transport.
    intrinsics : Intrinsics
        See `intrinsics_from_camera_info`.
    scale : float, optional
        Pixel value at 1 m; by default 1000 for 16UC1 and 1 for 32FC1 (REP 118). Required for other encodings with one
        number per pixel.

    Returns
    -------
    Scan
        Scan of kind "depth" in the axes of the camera's body, x forward, y left, z up, regardless of the header's
        frame: see `ogm.io.depth_scan`.

    Raises
    ------
    OgmError
        If the encoding has no depths, or the bytes do not fit the size.
    """
    packed = hasattr(message, "format")
    where = describe_message(message, "CompressedImage" if packed else "Image")
    encoding = str(message.format).partition(";")[0].strip() if packed else str(message.encoding)
    kind, usual = DEPTH_ENCODINGS.get(encoding, (_ALSO.get(encoding, ""), None))
    wanted = f"wanted depths ({', '.join(DEPTH_ENCODINGS)})"
    if not kind:
        raise OgmError(f"{where} has the encoding {encoding}, {wanted}: choose the topic of a depth camera")
    if (scale := scale or usual) is None:
        raise OgmError(f"{where} has the encoding {encoding}, {wanted}: for depths give --depth-scale, 1000 for mm")
    image = _unpacked(message, kind, where) if packed else _pixels(message, kind, where)
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


def _unpacked(message: Any, kind: str, where: str) -> NDArray[Any]:
    """Return the pixels of a compressed image, (height, width); float depths [m] are restored from their inverse."""
    data = as_bytes(message.data, where).tobytes()
    a, b = 0.0, 0.0
    if not data.startswith(_PNG):
        if not data[_HEADER.size :].startswith(_PNG):
            way_out = "the Image itself" if kind == "f4" else "compressed, which is also PNG"
            way_out = f"record PNG (the parameter format of compressedDepth), or {way_out}"
            raise OgmError(f"{where} has the format {str(message.format)!r}, wanted depths as PNG: {way_out}")
        _, a, b = _HEADER.unpack_from(data)
        data = data[_HEADER.size :]
    pixels = deep_pixels(where, data)
    if np.dtype(kind).kind != "f":
        return pixels
    if not (np.isfinite((a, b)).all() and a > 0):
        raise OgmError(f"{where} has depths quantised by {a:g} and {b:g}, wanted finite numbers, the first above 0")
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(pixels > 0, np.float32(a) / (pixels - np.float32(b)), np.float32(np.nan))


@reads_message
def intrinsics_from_camera_info(message: Any, *, rectified: bool = False) -> Intrinsics:
    """Return the camera of a ``sensor_msgs/CameraInfo``, with binning and region of interest.

    Parameters
    ----------
        Object with the fields of the message.
    rectified : bool
        Whether the images are rectified: then the matrix P is used if present, else K and the lens distortion. By ROS
        convention, topics of rectified images contain ``rect``.

    Raises
    ------
    OgmError
        If the camera is not calibrated, or has a lens model other than plumb bob and rational polynomial.
    """
    where = describe_message(message, "CameraInfo")
    with error_context(f"{where} has a matrix that is not numeric", TypeError, ValueError, OverflowError):
        names = (name if hasattr(message, name) else name.lower() for name in "KDP")
        matrix, lens, projection = (np.array(getattr(message, name), np.float64) for name in names)
        matrix = matrix.reshape(3, 3)
        if rectified and projection.size == 12 and projection[0] > 0:
            matrix = projection.reshape(3, 4)
    distortion: tuple[float, ...] = ()
    if not rectified and not np.abs(lens).max(initial=0) <= _DISTORTED:
        count = _LENSES.get(str(message.distortion_model), 0)
        if len(lens) > count and not np.abs(lens[count:]).max() <= 0:
            wanted = " or ".join(f"{name} with {number}" for name, number in _LENSES.items())
            got = f"{str(message.distortion_model)!r} with {len(lens)} coefficients"
            raise OgmError(f"{where} has the lens model {got}, wanted {wanted}: record rectified images")
        distortion = tuple(lens[:count].tolist())
    region, across, down = message.roi, max(int(message.binning_x), 1), max(int(message.binning_y), 1)
    width, height = int(region.width) or int(message.width), int(region.height) or int(message.height)
    return Intrinsics(
        width // across,
        height // down,
        float(matrix[0, 0]) / across,
        float(matrix[1, 1]) / down,
        (float(matrix[0, 2]) - int(region.x_offset)) / across,
        (float(matrix[1, 2]) - int(region.y_offset)) / down,
        distortion,
    ).check(where)
