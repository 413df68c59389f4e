"""What `quality` judges on: the simulated test town, simulated test drives, real recordings."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from ogm import GridSpec
from ogm.cli.source import Source, source_of

__all__ = ["REAL", "Recording", "drives", "every", "first_drives", "real", "town"]

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
FEWEST = 3  # scans with poses that are worth fusing


class Recording(NamedTuple):
    """A real recording, or why there is none.

    Attributes
    ----------
    name : str
    alone, fused : Source or None
        For single scans; for maps, whose truth is made from later scans only.
    says : str
        Why it is left out.
    """

    name: str
    alone: Source | None
    fused: Source | None
    description: str = ""


def town(path: Path, spec: GridSpec, split: str) -> Source:
    """Return the single frames of a part of a simulated data set."""
    return source_of(path, spec, split)


def drives(path: Path, spec: GridSpec) -> Source:
    """Return simulated drives; what a frame itself cannot see is left out of its truth.

    A map may well know what the frame's truth calls unknown, from other frames: that is no error.
    """
    return source_of(path, spec, "sequences", judged="maps")


def real(folder: Path, spec: GridSpec) -> Iterator[Recording]:
    """Yield the recordings of `REAL` one by one, opened for single scans and, where there are poses, for maps."""
    for name, place in REAL.items():
        path = folder / place
        if not path.exists():
            yield Recording(name, None, None, f"there is no {place}")
            continue
        try:
            alone = source_of(path, spec)
        except ValueError as error:
            yield Recording(name, None, None, str(error).replace(str(folder), "OGM_DATA"))
            continue
        fused = None
        if _drive(alone):
            fused = source_of(path, spec, judged="maps")
        yield Recording(name, alone, fused)


def every(source: Source, step: int) -> list[int]:
    """Return every so manieth frame of each sequence, counted from its beginning, the first ones left out."""
    place: dict[str, int] = {}
    chosen = []
    for k, frame in enumerate(source.frames):
        n = place.get(frame.sequence, 0)
        place[frame.sequence] = n + 1
        if n % step == step - 1:
            chosen.append(k)
    return chosen


def _drive(source: Source) -> bool:
    """Say whether the frames follow each other and know where they were."""
    sequences = {frame.sequence for frame in source.frames}
    stamped = all(frame.stamp is not None and frame.sequence for frame in source.frames)
    long = len(source.frames) >= FEWEST * len(sequences)
    return stamped and long and source.read(0).T_map_sensor is not None


def first_drives(source: Source, numbers: Sequence[int], count: int) -> list[int]:
    """Return those of the numbers that lie in the first so many sequences."""
    kept = list(dict.fromkeys(frame.sequence for frame in source.frames))[:count]
    return [k for k in numbers if source.frames[k].sequence in kept]
