"""nuScenes: key frames of its own tables, or of mmdetection3d's info as JSON."""

from pathlib import Path

from ogm.datasets.layout import FrameRef, Layout, RawFrame
from ogm.datasets.paths import scan_name
from ogm.io import estimate_sensor_height, read_scan
from ogm.io.nuscenes import NuScenes, read_mmdet3d, read_nuscenes
from ogm.storage.files import OgmError

__all__ = ["mmdet3d", "nuscenes"]


def nuscenes(path: Path) -> Layout | None:
    """Find the tables of nuScenes, ``v1.0-*/``."""
    here = path.name.startswith("v1.") and (path / "sample_data.json").is_file()
    if not here and not sorted(path.glob("v1.*-*/sample_data.json")):
        return None
    return _layout(read_nuscenes(path), "nuScenes")


def mmdet3d(path: Path) -> Layout | None:
    """Find mmdetection3d's info of nuScenes: a ``.json``, or a folder with one beside its ``.pcd.bin``."""
    files = [path] if path.suffix == ".json" else sorted(path.glob("*.json"))
    if not files or not (path.suffix == ".json" or sorted(path.glob("*.pcd.bin"))):
        return None
    if len(files) > 1:
        raise OgmError(f"{path} has {len(files)} files that end in .json, wanted one info file: give it")
    return _layout(read_mmdet3d(files[0]), "nuScenes (mmdetection3d's info)")


def _layout(content: NuScenes, name: str) -> Layout:
    frames = content.frames

    def read(n: int) -> RawFrame:
        return RawFrame(read_scan(frames[n].path, axes="nuscenes"))

    def height(n: int) -> float:
        estimate = estimate_sensor_height(read(n).scan.points)
        return frames[n].height if estimate is None else estimate

    return Layout(
        name,
        tuple(FrameRef(scan_name(one.path), one.scene, one.stamp, one.T_map_sensor) for one in frames),
        read,
        "boxes of nuScenes (sample_annotation.json, instance.json, category.json)",
        content.boxes if content.annotated else None,
        sensor_height=height,
        stamped=True,
    )
