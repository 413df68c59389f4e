"""Labelled range images: arrays (layers, azimuths, 6) of x, y, z, intensity, range, class."""

from pathlib import Path

from ogm.datasets.layout import EGO, KITTI_EGO, FrameRef, Layout, RawFrame, kinds_of
from ogm.datasets.paths import ending_of, scan_name
from ogm.io.range_images import NUSCENES_ELEVEN, read_range_image
from ogm.io.reading import parse_array, read_bytes
from ogm.io.semantic_kitti import SEMANTIC_KITTI_TRAINING
from ogm.scan import Scan
from ogm.storage.files import OgmError

__all__ = ["range_images"]

_KNOWN = {  # names of the classes, axes, intensity that means 1, ego vehicle
    "semantic_kitti": (SEMANTIC_KITTI_TRAINING, "kitti", 1.0, KITTI_EGO),
    "nuscenes": (NUSCENES_ELEVEN, "nuscenes", 255.0, EGO),
}


def range_images(path: Path) -> Layout | None:
    """Find range images with classes, ``.npy``, in a folder named after their data set, or one of them."""
    files = [path] if path.is_file() else sorted(path.iterdir())
    files = [one for one in files if ending_of(one) == ".npy" and one.is_file()]
    if not files or not _is_range_image(files[0]):
        return None
    folder = path.resolve() if path.is_dir() else path.resolve().parent
    if folder.name not in _KNOWN:
        raise OgmError(
            f"{path} may hold labelled range images, but nothing in them tells what their classes mean and which way "
            f"their axes point: wanted a folder named {' or '.join(_KNOWN)}, after their data set, got {folder.name}"
        )
    names, axes, intensity_max, ego = _KNOWN[folder.name]

    def read(n: int) -> RawFrame:
        found = read_range_image(files[n], names, axes, intensity_max=intensity_max)
        return RawFrame(Scan(found.points), kinds_of(found))

    return Layout(
        f"labelled range images ({folder.name})",
        tuple(FrameRef(scan_name(one), folder.name) for one in files),
        read,
        "classes",
        classes=True,
        ego_footprint=ego,
        axes=axes,
    )


def _is_range_image(path: Path) -> bool:
    """Tell whether an array has the shape of a range image with classes."""
    try:
        parse_array(read_bytes(path)[0], path, lambda shape: len(shape) == 3 and shape[2] == 6, "a range image")
    except ValueError:  # another array, or a damaged one, which its reader reports
        return False
    return True
