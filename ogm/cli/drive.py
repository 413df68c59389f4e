"""Selection of a drive and its poses by the common options of `ogm fuse` and `ogm serve`."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from ogm.cli.console import out, ticked
from ogm.cli.options import check_first

if TYPE_CHECKING:
    from ogm.datasets import Dataset


def check_pose_options(
    poses: Path | None, calib: Path | None, odometry: str | None, save_poses: Path | None, first: int | None
) -> None:
    """Raise a ValueError if pose options exclude each other."""
    if poses is not None and odometry is not None:
        raise ValueError("--poses and --odometry exclude each other; give one of them")
    if calib is not None and poses is None:
        raise ValueError("--calib needs --poses: give both, or leave out --calib")
    check_first(first)
    for path in filter(None, (poses, calib)):
        if save_poses is not None and save_poses.resolve() == path.resolve():
            raise ValueError(f"--save-poses would overwrite {path}; give another name")


def pick_drive(dataset: "Dataset", sequence: str | None) -> "Dataset":
    """Return the drive of a dataset selected by --sequence, by default the main or the first drive."""
    drives = dataset.sequences
    if drives:
        names = list(drives)
        wanted = (dataset.recording.main_sequence or names[0]) if sequence is None else sequence
        number = int(wanted) if wanted.isdecimal() else len(names)
        known = (wanted, f"sequence {wanted}", f"{dataset.name} part {wanted}", *names[number : number + 1])
        found = [name for name in known if name in drives]
        if not found:
            raise ValueError(f"--sequence must be one of {', '.join(drives)}, got {sequence}")
        if sequence is None and len(drives) > 1:
            which = "the longest" if dataset.recording.main_sequence else "the first"
            out.print(f"drive: {found[0]}, {which} of {len(drives)}; --sequence picks another", markup=False)
        dataset = dataset.select(drives[found[0]])
    elif sequence is not None:
        raise ValueError(f"--sequence selects a drive by name, but {dataset.name} has no named drives: leave it out")
    return dataset


def print_sensor(dataset: "Dataset") -> None:
    """Print the height of the sensor of a drive."""
    height, recording = dataset[0].mount.sensor_height, dataset.recording
    given = recording.sensor_height is not None or recording.setup(0).sensor_height is not None
    if not given and not recording.known_mount:
        how = "stated by the dataset" if recording.known_height else "estimated from up to five scans"
        how = "assumed, as it cannot be estimated" if recording.assumed_height else how
        out.print(f"sensor height {height:.2f} m, {how}; --sensor-height sets it", soft_wrap=True)


def with_known_poses(
    dataset: "Dataset",
    poses: Path | None,
    calib: Path | None,
    odometry: str | None,
    rate: float,
    first: int | None,
    match: bool = False,
) -> "Dataset":
    """Return the first scans of a drive with their poses, see `posed`, and print the origin of the poses."""
    from ogm.datasets import with_poses
    from ogm.workflows import posed

    def progress(numbers: Iterable[int]) -> Iterable[int]:
        return ticked(list(numbers), odometry or ("matching scans" if match else "reading stamps"))

    if poses is not None:
        dataset = with_poses(dataset, poses, calib, rate, progress)
    dataset, how = posed(dataset, odometry, rate, first, progress, match)
    out.print(f"poses: {how}", markup=False, soft_wrap=True)
    return dataset
