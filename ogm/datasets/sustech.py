"""SUSTechPOINTS: scans with boxes, with the axes of its example."""

from pathlib import Path

from ogm.datasets.layout import Layout, RawFrame
from ogm.datasets.paths import pose_files, poses_of, scan_name, scan_paths, sequence_of
from ogm.io import read_scan
from ogm.io.sustech import read_sustech

__all__ = ["sustech"]


def sustech(path: Path) -> Layout | None:
    """Find ``lidar/`` and ``label/*.json``."""
    scans = scan_paths(path / "lidar")
    labels = [path / "label" / f"{scan_name(one)}.json" for one in scans]
    scans = [one for one, label in zip(scans, labels, strict=True) if label.is_file()]
    labels = [label for label in labels if label.is_file()]
    if not scans:
        return None
    names = [scan_name(one) for one in scans]
    return Layout(
        "SUSTechPOINTS",
        sequence_of(path.name, names, poses_of(pose_files(path), names, axes="sustech")),
        lambda n: RawFrame(read_scan(scans[n], axes="sustech")),
        "boxes (label/*.json)",
        lambda n: read_sustech(labels[n]),
        axes="sustech",
    )
