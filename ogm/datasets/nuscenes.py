"""nuScenes: key frames from the official tables, or from an mmdetection3d info file (JSON)."""

from functools import cached_property
from pathlib import Path

from ogm.datasets.frames import FrameRef, RawFrame
from ogm.datasets.recording import Recording
from ogm.datasets.scans import scan_name
from ogm.io import read_scan
from ogm.io.nuscenes import NuScenes, read_mmdet3d, read_nuscenes
from ogm.scan import Boxes
from ogm.storage.files import OgmError


class NuScenesRecording(Recording):
    """Folder with nuScenes tables (``v1.0-*/``), or with an mmdetection3d info file next to ``.pcd.bin`` files."""

    wanted_labels = "boxes of nuScenes (sample_annotation.json, instance.json, category.json)"
    known_height = True
    stamped = True

    def __init__(self, path: Path, info: Path | None = None) -> None:
        self.path, self._info = path, info
        frames = self.content.frames
        refs = [FrameRef(scan_name(key.path), key.scene, key.stamp, key.T_map_sensor) for key in frames]
        super().__init__(path, refs)
        self.format = "nuScenes" if info is None else "nuScenes (mmdetection3d's info)"
        self.labelled = ("boxes",) if self.content.annotated else ()

    @classmethod
    def find(cls, path: Path) -> "NuScenesRecording | None":
        """Return the key frames of the tables, or of the info file."""
        here = path.name.startswith("v1.") and (path / "sample_data.json").is_file()
        if here or sorted(path.glob("v1.*-*/sample_data.json")):
            return cls(path)
        files = [path] if path.suffix == ".json" else sorted(path.glob("*.json"))
        if not files or not (path.suffix == ".json" or sorted(path.glob("*.pcd.bin"))):
            return None
        if len(files) > 1:
            raise OgmError(f"{path} has {len(files)} .json files, wanted one info file: give the info file itself")
        return cls(path, files[0])

    @cached_property
    def content(self) -> NuScenes:
        """Key frames and boxes. Reading large tables takes seconds."""
        return read_nuscenes(self.path) if self._info is None else read_mmdet3d(self._info)

    def read(self, n: int) -> RawFrame:
        """Read a scan."""
        return RawFrame(read_scan(self.content.frames[n].path, axes="nuscenes"))

    def read_boxes(self, n: int) -> Boxes:
        """Return the boxes of a key frame."""
        return self.content.boxes(n)

    def estimate_height(self, n: int) -> float:
        """Return the sensor height above the ground in a scan, or above the vehicle's origin without ground."""
        estimate = super().estimate_height(n)
        return self.content.frames[n].height if estimate is None else estimate
