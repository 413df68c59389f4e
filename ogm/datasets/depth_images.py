"""Folders of depth images: PNGs with the intrinsics of their camera, and perhaps its poses (Open3D, Redwood, TUM)."""

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

RATE = 30.0  # [1/s] of images whose names state no time
_POSES = ("odometry.log", "trajectory.log")
_SEEN = 3  # images whose values tell the scale
_SHARE = 0.9  # of the values that are multiples of a number
_FAR = 10.0  # [m] beyond which the median of a depth camera's image does not lie
_CLEAR = 5000  # raw median from which values cannot be millimetres in steps of some
_HEADER = b"\x89PNG\r\n\x1a\n"
_WAY = "give --depth-scale, the pixel value at 1 m: 1000 for millimetres, 5000 (TUM, ICL-NUIM), 8000 (SUN RGB-D)"


class DepthImagesRecording(Recording):
    """Depth images of one camera: PNGs of 16 bit in a folder, or in its folder ``depth``, or one of them."""

    format = "depth images"
    wanted_labels = f"poses of the camera ({', '.join(_POSES)})"
    ego_footprint = None
    known_axes = False

    def __init__(self, path: Path, images: Sequence[tuple[FrameRef, Path]], camera: Intrinsics, scale: float) -> None:
        super().__init__(path, [ref for ref, _ in images], path.resolve().name)
        self.images, self.camera, self.scale = [image for _, image in images], camera, scale

    @classmethod
    def open(cls, paths: Sequence[Path], options: OpenOptions) -> "DepthImagesRecording | None":
        """Return the depth images of a folder, or one image; None if there is no such image.

        Raises
        ------
        OgmError
            If the camera is not known, or the values of the pixels do not tell their scale.
        ValueError
            If the options state axes or units.
        """
        path = paths[0]
        if len(paths) > 1 or not (images := _images(path)):
            return None
        if not np.array_equal(rotation_to_flu(options.axes), np.eye(3)) or options.units:
            raise ValueError(f"{path} has depth images, whose axes are known; leave out `axes` and units of points")
        folder = images[0].parent
        cameras = [
            file for place in (folder, folder.parent) for file in sorted(place.glob("*.json")) if is_intrinsics(file)
        ]
        if not cameras or len({*map(read_intrinsics, cameras)}) > 1:
            raise OgmError(
                f"{path} has images of 16 bit, which may be depths, and {len(cameras)} files with intrinsics of a "
                "camera, wanted one beside them: a JSON with width, height, intrinsic_matrix, as Open3D writes it"
            )
        given, warnings = setup_of(options.setups, "").depth_scale, list[str]()
        if path.is_dir():
            images = _alike(images, warnings)
        scale, how = (given, "given") if given else _scale(images)
        recording = cls(path, _placed(folder, images), read_intrinsics(cameras[0]), scale)
        recording.warnings = warnings
        recording.facts = {
            "format": cls.format,
            "frames": len(images),
            "camera": cameras[0].name,
            "depth_scale": f"{scale:g} at 1 m, {how}",
        }
        for warning in warnings:
            _log.warning("%s", warning)
        return recording

    def read(self, n: int) -> RawFrame:
        """Read an image as points around the camera, x forward, y left, z up."""
        path = self.images[n]
        with error_context(path, ValueError):
            return RawFrame(
                depth_scan(read_depths(path, self.scale == SUN), self.camera, self._metre, stamp=self.frames[n].stamp)
            )

    @property
    def _metre(self) -> float:
        return 1000.0 if self.scale == SUN else self.scale

    def place(self, n: int) -> SensorPlace:
        """Return the place of the camera, which sees nothing of its vehicle."""
        return SensorPlace(ego_footprint=(0.0, 0.0, 0.0, 0.0))


SUN = 8000.0
"""Pixel value at 1 m of images whose bits are rotated by 3: eight times the millimetres, below 8.192 m."""


def read_depths(path: Path, rotated: bool = False) -> NDArray[np.uint16]:
    """Return the pixels of a PNG of 16 bit, (height, width).

    Parameters
    ----------
    path : Path
    rotated : bool
        Whether the bits are rotated by 3, as those of the SUN RGB-D data are.
    """
    pixels = deep_pixels(path)
    return (pixels >> 3 | pixels << 13).astype(np.uint16) if rotated else pixels


def _images(path: Path) -> list[Path]:
    """Return the PNGs of 16-bit grey values at a path, in the order of their names; refuse PGMs alone."""
    if path.is_file():
        files = [path]
    else:
        files = in_order(one for place in (path, path / "depth") if place.is_dir() for one in place.iterdir())
    images = [file for file in files if file.suffix.lower() == ".png" and _is_deep(file)]
    disparities = [file for file in files if file.name.lower().removesuffix(".xz").endswith(".pgm")]
    if disparities and not images and (path.is_dir() or any(map(is_intrinsics, path.parent.glob("*.json")))):
        raise OgmError(
            f"{disparities[0]} is a PGM: those with depths hold raw disparities of a Kinect (NYU), no lengths; convert "
            "them to millimetres in PNGs of 16 bit"
        )
    return [image for image in images if image.parent == images[0].parent]


def _is_deep(path: Path) -> bool:
    """Return whether the header of a PNG is that of 16-bit grey values."""
    with path.open("rb") as file:
        head = file.read(26)
    return head.startswith(_HEADER) and head[24:] == b"\x10\x00"


def _alike(images: list[Path], warnings: list[str]) -> list[Path]:
    """Return the images whose names differ in numbers alone, of several such groups the largest."""
    groups: dict[str, list[Path]] = {}
    for image in images:
        groups.setdefault(re.sub(r"\d+", "0", image.stem), []).append(image)
    largest = max(groups.values(), key=len)
    if others := [image.name for image in images if image not in largest]:
        text = f"{len(others)} images with other names than {largest[0].name} are left out: {', '.join(others[:4])}"
        warnings.append(f"{images[0].parent}: {text}")
    return largest


def _scale(images: Sequence[Path]) -> tuple[float, str]:
    """Return the pixel value at 1 m by the values of some images, and how it is known.

    Raises
    ------
    OgmError
        If they may be of several conventions.
    """
    some = [read_depths(images[k]) for k in np.unique(np.linspace(0, len(images) - 1, _SEEN).astype(int))]
    values = np.concatenate([image[image > 0] for image in some])
    if not values.size:
        return 1000.0, "millimetres assumed: no pixel has a depth"
    middle = float(np.median(values))
    eighths, fifths = np.mean(values % 8 <= 1), np.mean(values % 5 == 0)
    few = f"{images[0]} has depths with a median of {middle:g}, which may be millimetres"
    if np.mean(values % 8 == 0) >= _SHARE or (eighths >= _SHARE and middle >= _CLEAR):
        if middle < _CLEAR:
            raise OgmError(f"{few} in steps of 8, or values of SUN RGB-D (bits rotated by 3): {_WAY}")
        return SUN, "bits rotated by 3 (SUN RGB-D): all values are multiples of 8"
    if fifths >= _SHARE:
        if middle < _CLEAR:
            raise OgmError(f"{few} in steps of 5, or fifths of them (TUM): {_WAY}")
        return 5000.0, "fifths of millimetres (TUM): all values are multiples of 5"
    if middle > 1000 * _FAR:
        raise OgmError(f"{few} or not: half of them would lie beyond {_FAR:g} m: {_WAY}")
    return 1000.0, f"millimetres assumed, as the median is {middle / 1000:.2f} m then (--depth-scale)"


def _placed(folder: Path, images: Sequence[Path]) -> list[tuple[FrameRef, Path]]:
    """Return images as frames with the poses beside them, in the axes of the first camera's body."""
    names, sequence = [image.stem for image in images], folder.resolve().name
    numbers = frame_numbers(names)
    counted = np.arange(len(names)) if numbers is None else numbers
    stamps = clock_stamps(names) or (counted / RATE).tolist()
    poses: list[NDArray[np.float64] | None] = [None] * len(names)
    files = [place / name for place in (folder, folder.parent) for name in _POSES]
    if file := next((one for one in files if one.is_file()), None):
        found = read_poses(file, T_camera_sensor=T_OPTICAL_BODY)
        if len(found) == len(names):
            poses = list(found.poses)
        elif found.numbers is not None:
            of = dict(zip(found.numbers.tolist(), found.poses, strict=True))
            poses = [of.get(int(number)) for number in counted]
    rows = zip(names, stamps, poses, images, strict=True)
    return [(FrameRef(name, sequence, float(stamp), T), image) for name, stamp, T, image in rows]
