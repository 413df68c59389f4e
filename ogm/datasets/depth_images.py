"""Folders of depth images: PNGs with camera intrinsics and optional poses (Open3D, Redwood, TUM)."""

import logging
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.frames import FrameRef, RawFrame, SensorPlace
from ogm.datasets.recording import OpenOptions, Recording
from ogm.datasets.scans import clock_stamps, in_order
from ogm.datasets.sensor_setup import setup_of
from ogm.io import read_poses
from ogm.io.depth import T_OPTICAL_BODY, Intrinsics, depth_scan, is_intrinsics, read_intrinsics
from ogm.io.images import deep_pixels
from ogm.io.poses import frame_numbers
from ogm.io.scan_table import rotation_to_flu
from ogm.storage.files import OgmError, error_context

_log = logging.getLogger(__name__)

RATE = 30.0  # [1/s] rate of images without times in their names
_POSES = ("odometry.log", "trajectory.log")
_SAMPLED = 3  # images that are read to find the scale
_MULTIPLES_SHARE = 0.9  # share of values that are multiples of a number, from which all count as multiples
_MAX_MEDIAN = 10.0  # [m] largest plausible median depth of an image
_MIN_FINE_MEDIAN = 5000  # raw median from which values are not millimetres in steps of 5 or 8
_HEADER = b"\x89PNG\r\n\x1a\n"
_WAY_OUT = "give --depth-scale, the pixel value at 1 m: 1000 for millimetres, 5000 (TUM, ICL-NUIM), 8000 (SUN RGB-D)"


class DepthImagesRecording(Recording):
    """Depth images of one camera: 16-bit PNGs in a folder or its sub-folder ``depth``, or one image."""

    format = "depth images"
    wanted_labels = f"poses of the camera ({', '.join(_POSES)})"
    ego_footprint = None
    known_axes = False

    def __init__(self, path: Path, images: Sequence[tuple[FrameRef, Path]], camera: Intrinsics, scale: float) -> None:
        super().__init__(path, [ref for ref, _ in images], path.resolve().name)
        self.images, self.camera, self.scale = [image for _, image in images], camera, scale

    @classmethod
    def open(cls, paths: Sequence[Path], options: OpenOptions) -> "DepthImagesRecording | None":
        """Return the depth images of a folder, or one image; None if there is no depth image.

        Raises
        ------
        OgmError
            If the camera is not known, or the depth scale is ambiguous.
        ValueError
            If the options state axes or units.
        """
        path = paths[0]
        if len(paths) > 1 or not (images := _images(path)):
            return None
        if not np.array_equal(rotation_to_flu(options.axes), np.eye(3)) or options.units:
            raise ValueError(f"{path} has depth images, whose axes and units are known: leave out `axes` and the units")
        folder = images[0].parent
        files = [file for place in (folder, folder.parent) for file in sorted(place.glob("*.json"))]
        cameras = list(filter(is_intrinsics, files))
        if not cameras or len({*map(read_intrinsics, cameras)}) > 1:
            raise OgmError(
                f"{path} has images of 16 bit, which may be depths, and {len(cameras)} files with camera intrinsics, "
                "wanted one next to the images: a JSON with width, height, intrinsic_matrix, in Open3D's format"
            )
        given, warnings = setup_of(options.setups, "").depth_scale, list[str]()
        if path.is_dir():
            images = _alike(images, warnings)
        scale, how = (given, "given") if given else _scale(images)
        recording = cls(path, _placed(folder, images), read_intrinsics(cameras[0]), scale)
        recording.warnings = warnings
        recording.facts = {"format": cls.format, "frames": len(images), "camera": cameras[0].name}
        recording.facts["depth_scale"] = f"{scale:g} at 1 m, {how}"
        for warning in warnings:
            _log.warning("%s", warning)
        return recording

    def read(self, n: int) -> RawFrame:
        """Read an image as points around the camera, x forward, y left, z up."""
        path = self.images[n]
        with error_context(path, ValueError):
            pixels, metre = read_depths(path, self.scale == SUN), 1000.0 if self.scale == SUN else self.scale
            return RawFrame(depth_scan(pixels, self.camera, metre, stamp=self.frames[n].stamp))

    def place(self, n: int) -> SensorPlace:
        """Return the place of the camera, with an empty ego footprint."""
        return SensorPlace(ego_footprint=(0.0, 0.0, 0.0, 0.0))


SUN = 8000.0
"""Pixel value at 1 m of images with bits rotated by 3 (SUN RGB-D): millimetres times 8, below 8.192 m."""


def read_depths(path: Path, rotated: bool = False) -> NDArray[np.uint16]:
    """Return the pixels of a 16-bit PNG, (height, width).

    Parameters
    ----------
    path : Path
    rotated : bool
        Whether the bits are rotated by 3, as in SUN RGB-D data.
    """
    pixels = deep_pixels(path)
    return (pixels >> 3 | pixels << 13).astype(np.uint16) if rotated else pixels


def _images(path: Path) -> list[Path]:
    """Return the 16-bit grey PNGs at a path, in the order of their names; PGMs without PNGs are refused."""
    if path.is_file():
        files = [path]
    else:
        files = in_order(file for folder in (path, path / "depth") if folder.is_dir() for file in folder.iterdir())
    images = [file for file in files if file.suffix.lower() == ".png" and _is_deep(file)]
    disparities = [file for file in files if file.name.lower().removesuffix(".xz").endswith(".pgm")]
    if disparities and not images and (path.is_dir() or any(map(is_intrinsics, path.parent.glob("*.json")))):
        raise OgmError(
            f"{disparities[0]} is a PGM, which holds raw disparities of a Kinect (NYU) instead of depths: convert the "
            "images to millimetres in PNGs of 16 bit"
        )
    return [image for image in images if image.parent == images[0].parent]


def _is_deep(path: Path) -> bool:
    """Return whether the header of a PNG states 16-bit grey values."""
    with path.open("rb") as file:
        head = file.read(26)
    return head.startswith(_HEADER) and head[24:] == b"\x10\x00"


def _alike(images: list[Path], warnings: list[str]) -> list[Path]:
    """Return the largest group of images with names that differ only in numbers."""
    groups: dict[str, list[Path]] = {}
    for image in images:
        groups.setdefault(re.sub(r"\d+", "0", image.stem), []).append(image)
    largest = max(groups.values(), key=len)
    if others := [image.name for image in images if image not in largest]:
        text = f"{len(others)} images with other names than {largest[0].name} are left out: {', '.join(others[:4])}"
        warnings.append(f"{images[0].parent}: {text}")
    return largest


def _scale(images: Sequence[Path]) -> tuple[float, str]:
    """Return the pixel value at 1 m, found from some images, and its reason in words.

    Raises
    ------
    OgmError
        If the values fit several conventions.
    """
    some = [read_depths(images[k]) for k in np.unique(np.linspace(0, len(images) - 1, _SAMPLED).astype(int))]
    values = np.concatenate([image[image > 0] for image in some])
    if not values.size:
        return 1000.0, "millimetres assumed: no pixel has a depth"
    middle = float(np.median(values))
    eighths, fifths = np.mean(values % 8 <= 1), np.mean(values % 5 == 0)
    ambiguous = f"{images[0]} has depths with a median of {middle:g}, which may be millimetres"
    if np.mean(values % 8 == 0) >= _MULTIPLES_SHARE or (eighths >= _MULTIPLES_SHARE and middle >= _MIN_FINE_MEDIAN):
        if middle < _MIN_FINE_MEDIAN:
            raise OgmError(f"{ambiguous} in steps of 8, or values of SUN RGB-D (bits rotated by 3): {_WAY_OUT}")
        return SUN, "bits rotated by 3 (SUN RGB-D): all values are multiples of 8"
    if fifths >= _MULTIPLES_SHARE:
        if middle < _MIN_FINE_MEDIAN:
            raise OgmError(f"{ambiguous} in steps of 5, or fifths of millimetres (TUM): {_WAY_OUT}")
        return 5000.0, "fifths of millimetres (TUM): all values are multiples of 5"
    if middle > 1000 * _MAX_MEDIAN:
        raise OgmError(f"{ambiguous}, but then half of them are beyond {_MAX_MEDIAN:g} m: {_WAY_OUT}")
    return 1000.0, f"millimetres assumed, which gives a median of {middle / 1000:.2f} m (--depth-scale)"


def _placed(folder: Path, images: Sequence[Path]) -> list[tuple[FrameRef, Path]]:
    """Return images as frames, with poses from a file next to them, in the axes of the first camera body."""
    names, sequence = [image.stem for image in images], folder.resolve().name
    numbers = frame_numbers(names)
    counted = np.arange(len(names)) if numbers is None else numbers
    stamps = clock_stamps(names) or (counted / RATE).tolist()
    poses: list[NDArray[np.float64] | None] = [None] * len(names)
    files = [place / name for place in (folder, folder.parent) for name in _POSES]
    if file := next((file for file in files if file.is_file()), None):
        found = read_poses(file, T_camera_sensor=T_OPTICAL_BODY)
        if len(found) == len(names):
            poses = list(found.poses)
        elif found.numbers is not None:
            of = dict(zip(found.numbers.tolist(), found.poses, strict=True))
            poses = [of.get(int(number)) for number in counted]
    rows = zip(names, stamps, poses, images, strict=True)
    return [(FrameRef(name, sequence, float(stamp), T), image) for name, stamp, T, image in rows]
