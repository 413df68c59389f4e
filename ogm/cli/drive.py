"""A drive of a data set with its poses, by the options that `ogm fuse` and `ogm serve` share."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from rich.progress import track

from ogm.cli.console import out, stderr
from ogm.cli.options import check_first

if TYPE_CHECKING:
    from ogm.datasets import Dataset


def check_pose_options(
    poses: Path | None, calib: Path | None, odometry: str | None, save_poses: Path | None, first: int | None
) -> None:
    """Refuse options of poses that exclude each other."""
    if poses is not None and odometry is not None:
        raise ValueError("--poses and --odometry exclude each other; give one")
    if calib is not None and poses is None:
        raise ValueError("--calib belongs to --poses, which is missing")
    check_first(first)
    for path in filter(None, (poses, calib)):
        if save_poses is not None and save_poses.resolve() == path.resolve():
            raise ValueError(f"--save-poses would overwrite {path}; give another name")


def pick_drive(dataset: "Dataset", sequence: str | None, sensor_height: float | None) -> "Dataset":
    """Return one drive of a data set, and print the height of its sensor."""
    drives = dataset.sequences
    if drives:
        names = list(drives)
        wanted = names[0] if sequence is None else sequence
        number = int(wanted) if wanted.isdecimal() else len(names)
        found = [one for one in (wanted, f"sequence {wanted}", *names[number : number + 1]) if one in drives]
        if not found:
            raise ValueError(f"--sequence must be one of {', '.join(drives)}, got {sequence}")
        if sequence is None and len(drives) > 1:
            out.print(f"drive: {names[0]}, the first of {len(drives)}; --sequence picks another", markup=False)
        dataset = dataset.select(drives[found[0]])
    elif sequence is not None:
        raise ValueError(f"--sequence picks one of several drives, of which {dataset.name} has none")
    height, recording = dataset[0].mount.sensor_height, dataset.recording
    if sensor_height is None and not recording.known_mount:
        how = "stated by the data set" if recording.known_height else "estimated from up to five scans"
        out.print(f"sensor height {height:.2f} m, {how}; --sensor-height sets it", soft_wrap=True)
    return dataset


def with_known_poses(
    dataset: "Dataset", poses: Path | None, calib: Path | None, odometry: str | None, rate: float, first: int | None
) -> "Dataset":
    """Return the first scans of a drive with their poses, as `posed`, and print whose they are."""
    from ogm.datasets import with_poses
    from ogm.workflows import posed

    def ticked(numbers: Iterable[int]) -> Iterable[int]:
        return track(list(numbers), odometry or "reading stamps", console=stderr, transient=True)

    if poses is not None:
        dataset = with_poses(dataset, poses, calib, rate, ticked)
    dataset, how = posed(dataset, odometry, rate, first, ticked)
    out.print(f"poses: {how}", markup=False, soft_wrap=True)
    return dataset
