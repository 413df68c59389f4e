"""What ``ogm fuse`` fuses: the scans of a drive, in order."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ogm.cli.console import one_line
from ogm.cli.maps import ENDINGS, stem
from ogm.io import Poses, estimate_sensor_height, read_scan
from ogm.io.axes import rotation_to_flu
from ogm.scan import Scan

if TYPE_CHECKING:
    from ogm.io import Axes

__all__ = ["UNREADABLE", "Drive", "drive_of", "estimated_height"]

LARGEST = 10**9  # a number in a file's name that is larger is a clock's, not a frame's
HEIGHTS = 5  # scans whose median tells the sensor's height
UNREADABLE = (ValueError, TypeError, OSError)


@dataclass(frozen=True, eq=False)
class Drive:
    """The scans of a drive, in order.

    Parameters
    ----------
    names : tuple of str
        What a person calls them.
    read : function of int
        Reads a scan; raises ValueError, TypeError or OSError where it is damaged.
    numbers : (K,) int64 or None
        Their frame numbers, increasing; None where the names have none.
    poses : Poses or None
        Of each scan, where the recording knows them.
    mount : (4, 4) float64 or None
        ``T_vehicle_sensor``: height above ground and tilt, where the recording knows it.
    bent : bool
        Whether the points may be bent by the own motion, so that de-skewing makes sense.
    """

    names: tuple[str, ...]
    read: Callable[[int], Scan]
    numbers: NDArray[np.int64] | None = None
    poses: Poses | None = None
    mount: NDArray[np.float64] | None = None
    bent: bool = True

    def __len__(self) -> int:
        return len(self.names)

    def first(self, count: int | None) -> "Drive":
        """Return the drive's first so many scans; all for None."""
        if count is None:
            return self
        if count < 1:
            raise ValueError(f"--first must be at least 1, got {count}")
        numbers, poses = self.numbers, self.poses
        if poses is not None:
            stamps = None if poses.stamps is None else poses.stamps[:count]
            of = None if poses.numbers is None else poses.numbers[:count]
            poses = replace(poses, poses=poses.poses[:count], stamps=stamps, numbers=of)
        return replace(
            self, names=self.names[:count], numbers=None if numbers is None else numbers[:count], poses=poses
        )


def drive_of(
    scans: Sequence[Path],
    sequence: int | None = None,
    axes: "Axes" = "flu",
    intensity_max: float | None = None,
    time_unit: float | None = None,
) -> Drive:
    """Find the scans of a drive.

    Parameters
    ----------
    scans : sequence of Path
        Files; or one folder of them; or one data set that ``ogm simulate`` made.
    sequence : int, optional
        Which sequence of a data set, 0 by default.
    axes, intensity_max, time_unit
        As for `ogm.io.read_scan`.

    Raises
    ------
    FileNotFoundError
        If there is no such folder.
    ValueError
        If a folder holds no scans, or several formats; or if a data set has no such sequence.
    """
    folders = [path for path in scans if path.is_dir()]
    if folders and len(scans) > 1:
        raise ValueError(f"{folders[0]} is a folder; give one folder alone, or files")
    if folders and (folders[0] / "zarr.json").exists():
        if axes != "flu":
            raise ValueError("a data set that `ogm simulate` made needs no --axes")
        return _from_store(folders[0], sequence or 0)
    if sequence is not None:
        raise ValueError(
            "--sequence picks one of a data set that `ogm simulate` made; leave it out for files"
        )
    rotation_to_flu(axes)  # refuses what are none, before any scan is read
    files = _scans_in(folders[0]) if folders else list(scans)
    if not any(path.exists() for path in files):
        raise FileNotFoundError(f"there is no file or folder {files[0]}")
    names = [stem(path) for path in files]
    if len(set(names)) == len(names):
        order = sorted(range(len(files)), key=lambda k: _natural(names[k]))
        files, names = [files[k] for k in order], [names[k] for k in order]
    elif folders:
        double = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"{folders[0]} holds {double} twice; give the files one by one")
    read = partial(read_scan, axes=axes, intensity_max=intensity_max, time_unit=time_unit)
    return Drive(tuple(path.name for path in files), lambda k: read(files[k]), _frame_numbers(names))


def _scans_in(folder: Path) -> list[Path]:
    files = [path for path in folder.iterdir() if path.is_file() and not path.name.startswith(".")]
    formats: dict[str, list[Path]] = {}
    for path in files:
        name = path.name.lower().removesuffix(".xz").removesuffix(".gz")
        ending = next((one for one in (".pcd.bin", *ENDINGS) if name.endswith(one)), None)
        if ending is not None:
            formats.setdefault(ending, []).append(path)
    if not formats:
        raise ValueError(
            f"{folder} holds no scans ({' '.join(ENDINGS)}, .xz, .gz); give the folder that does"
        )
    if len(formats) > 1:
        raise ValueError(
            f"{folder} holds scans of several formats ({', '.join(formats)}); give the files of one"
        )
    return next(iter(formats.values()))


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts 2 before 10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]


def _frame_numbers(names: Sequence[str]) -> NDArray[np.int64] | None:
    """Return the last number of each name, where all have one, it increases and all before it is the same."""
    found = [re.fullmatch(r"(.*?)(\d+)\D*", name) for name in names]
    if not all(found) or len({one[1] for one in found if one}) > 1:
        return None
    numbers = [int(one[2]) for one in found if one]
    if max(numbers) >= LARGEST or any(b <= a for a, b in zip(numbers, numbers[1:], strict=False)):
        return None
    return np.array(numbers, np.int64)


def _from_store(path: Path, sequence: int) -> Drive:
    from ogm.simulation.plan import SEQUENCE
    from ogm.simulation.store import FACTS, Store

    store = Store.open(path)
    planned = store.counts.get("sequences", 0)
    rows = store["sequences"].facts if planned else np.zeros((0, len(FACTS)))
    if not rows[:, 0].any():
        way = "--resume" if planned else "--resume --sequences 1"
        raise ValueError(
            f"{path} has no finished sequence; `ogm simulate {path} {way}` makes one (100 scans at 10 Hz)"
        )
    count = -(-len(rows) // SEQUENCE)
    numbers = sequence * SEQUENCE + np.arange(SEQUENCE)
    numbers = numbers[(numbers >= 0) & (numbers < len(rows))]
    numbers = numbers[rows[numbers, 0] != 0]
    if not len(numbers):
        raise ValueError(
            f"--sequence must be one that is finished, of 0 ... {count - 1} that {path} plans, got {sequence}"
        )
    part, rows = store["sequences"], rows[numbers]
    poses, mounts = (np.tile(np.eye(4), (len(rows), 1, 1)) for _ in range(2))
    for matrices, name in ((poses, "T_world_sensor_00"), (mounts, "T_vehicle_sensor_00")):
        matrices[:, :3] = rows[:, FACTS.index(name) :][:, :12].reshape(-1, 3, 4)
    mount = mounts[0]
    mount[:2, 3] = 0.0  # the grids lie around the sensor
    if (mounts[:, 2:, :] != mounts[0, 2:, :]).any():
        raise ValueError(f"sequence {sequence} of {path} changes how its sensor is mounted; it is no drive")

    def read(k: int) -> Scan:
        sample = part[int(numbers[k])]
        return Scan(sample.points, time=sample.time.astype(np.float64), stamp=sample.stamp)

    frames = numbers - sequence * SEQUENCE
    return Drive(
        tuple(f"frame {frame}" for frame in frames),
        read,
        frames,
        Poses(poses, rows[:, FACTS.index("stamp")], frames, "data set"),
        mount,
        bent=store.plan.get("in_motion", 0.0) == 1.0,
    )


def estimated_height(drive: Drive) -> tuple[float, int]:
    """Return the sensor's height above ground [m], a median over the first scans, and over how many.

    Raises
    ------
    ValueError
        If none of them shows enough ground.
    """
    heights: list[float] = []
    failed = ""
    for k in range(min(len(drive), 2 * HEIGHTS)):
        try:
            one = estimate_sensor_height(drive.read(k).points)
        except UNREADABLE as error:
            failed = f" ({one_line(error)})"
            continue  # the mapping will complain of it
        if one is not None:
            heights.append(one)
        if len(heights) == HEIGHTS:
            break
    if not heights:
        raise ValueError(
            f"the first scans show too little ground to tell the sensor's height, or cannot be read{failed}; "
            "give --sensor-height [m]"
        )
    return float(np.median(heights)), len(heights)
