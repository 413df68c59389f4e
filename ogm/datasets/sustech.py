"""SUSTechPOINTS: scans with boxes, in the axes of its example data."""

from pathlib import Path

from ogm.datasets.recording import ScanFiles
from ogm.datasets.scans import drive_of, pose_files, scan_name, scan_paths
from ogm.io.sustech import read_sustech
from ogm.scan import Boxes


class SustechRecording(ScanFiles):
    """Folder with ``lidar/`` and ``label/*.json``."""

    format = "SUSTechPOINTS"
    wanted_labels = "boxes (label/*.json)"
    labelled = ("boxes",)
    axes = "sustech"

    @classmethod
    def find(cls, path: Path) -> "SustechRecording | None":
        """Return the scans that have a label file, with poses if the folder has poses."""
        scans = [scan for scan in scan_paths(path / "lidar") if _label(path, scan).is_file()]
        return cls(path, drive_of(path.name, scans, pose_files(path), axes=cls.axes)) if scans else None

    def read_boxes(self, n: int) -> Boxes:
        """Read the boxes around a scan."""
        return read_sustech(_label(self.path, self.scans[n]))


def _label(folder: Path, scan: Path) -> Path:
    return folder / "label" / f"{scan_name(scan)}.json"
