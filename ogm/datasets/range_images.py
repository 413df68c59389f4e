"""Labelled range images: arrays (layers, azimuths, 6) of x, y, z, intensity, range, class."""

from pathlib import Path

from ogm.datasets.frames import EGO, KITTI_EGO, FrameRef, RawFrame, kinds_of
from ogm.datasets.recording import ScanFiles
from ogm.datasets.scans import ending_of, scan_name
from ogm.io.range_images import NUSCENES_ELEVEN, read_range_image
from ogm.io.reading import parse_array, read_bytes
from ogm.io.semantic_kitti import SEMANTIC_KITTI_TRAINING
from ogm.scan import Scan
from ogm.storage.files import OgmError

_KNOWN = {  # names of the classes, axes, intensity that means 1, ego vehicle
    "semantic_kitti": (SEMANTIC_KITTI_TRAINING, "kitti", 1.0, KITTI_EGO),
    "nuscenes": (NUSCENES_ELEVEN, "nuscenes", 255.0, EGO),
}


class RangeImagesRecording(ScanFiles):
    """Folder of range images with classes (``.npy``), named after the dataset, or one such file."""

    wanted_labels = "classes"
    labelled = ("classes",)

    def __init__(self, path: Path, files: list[Path], dataset: str) -> None:
        super().__init__(path, [(FrameRef(scan_name(file), dataset), file) for file in files])
        self.format = f"labelled range images ({dataset})"
        self._classes, self.axes, self._intensity_max, self.ego_footprint = _KNOWN[dataset]

    @classmethod
    def find(cls, path: Path) -> "RangeImagesRecording | None":
        """Return the range images of a folder, or None if there is no range image."""
        files = [path] if path.is_file() else sorted(path.iterdir())
        files = [file for file in files if ending_of(file) == ".npy" and file.is_file()]
        if not files or not _is_range_image(files[0]):
            return None
        folder = path.resolve() if path.is_dir() else path.resolve().parent
        if folder.name not in _KNOWN:
            raise OgmError(
                f"{path} may hold labelled range images, which do not state their classes and axes: wanted a folder "
                f"named {' or '.join(_KNOWN)} after the dataset, got {folder.name}"
            )
        return cls(path, files, folder.name)

    def read(self, n: int) -> RawFrame:
        """Read a range image as points with classes."""
        found = read_range_image(self.scans[n], self._classes, self.axes, intensity_max=self._intensity_max)
        return RawFrame(Scan(found.points), kinds_of(found))


def _is_range_image(path: Path) -> bool:
    """Return whether an array has the shape of a range image with classes."""
    try:
        parse_array(read_bytes(path)[0], path, lambda shape: len(shape) == 3 and shape[2] == 6, "a range image")
    except ValueError:  # an array of another shape, or a damaged file, which its reader reports
        return False
    return True
