"""Real recordings by name, opened for single scans and for maps."""

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from ogm.datasets import Dataset, open_dataset

REAL = {
    "KITTI, single scans": "kitti_object",
    "KITTI, drive 0005": "kitti_raw_0005",
    "KITTI, odometry 00": "kitti_odometry_00",
    "Argoverse 2": "argoverse2_adcf",
    "nuScenes": "nuscenes_n015",
    "SUSTechPOINTS": "sustechpoints",
    "SemanticKITTI, labelled scans": "labelled_range_images/semantic_kitti",
    "nuScenes, labelled scans": "labelled_range_images/nuscenes",
}
MIN_SCANS = 3  # of a sequence that is fused


class QualityInput(NamedTuple):
    """A real recording, for single scans and for maps, or the reason why it is left out."""

    name: str
    alone: Dataset | None
    fused: Dataset | None
    reason: str = ""


def recordings(folder: Path) -> Iterator[tuple[str, Dataset]]:
    """Yield the recordings that can be opened, for single scans, by name; print why others are left out."""
    for recording in real(folder) if folder.is_dir() else ():
        if recording.alone is None:
            print(f"{recording.name} is left out: {recording.reason}", file=sys.stderr)
        else:
            yield recording.name, recording.alone


def real(folder: Path) -> Iterator[QualityInput]:
    """Yield the recordings of `REAL`, opened for single scans and, with poses, for maps."""
    for name, place in REAL.items():
        if not (folder / place).exists():
            yield QualityInput(name, None, None, f"there is no {place}")
            continue
        try:
            alone = open_dataset(folder / place)
        except ValueError as error:
            yield QualityInput(name, None, None, str(error).replace(str(folder), "OGM_DATA"))
            continue
        yield QualityInput(name, alone, open_dataset(folder / place, others="later") if _is_drive(alone) else None)


def _is_drive(dataset: Dataset) -> bool:
    """Tell whether all frames belong to sequences, with stamps and poses."""
    posed = all(frame.sequence and frame.stamp is not None for frame in dataset)
    return posed and len(dataset) >= MIN_SCANS * len(dataset.sequences) and dataset[0].T_map_sensor is not None
