"""What a folder of any data set is turned into before truth is made of it."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.io import Axes, LabelledPoints, read_poses
from ogm.io.axes import rotation_to_flu
from ogm.scan import Boxes
from ogm.truth import Kind

__all__ = [
    "CAR",
    "KITTI_CAR",
    "Layout",
    "Plan",
    "Seen",
    "Shot",
    "drive",
    "kinds_of",
    "pose_files",
    "poses_of",
    "scans_in",
    "stem",
]

CAR = (2.5, 1.1)  # [m] |x|, |y| from the sensor: what is nearer is the own vehicle
KITTI_CAR = (2.6, 1.7)  # [m] with what sticks out beside its doors
_PACKED = (".xz", ".gz")
_SCANS = (".bin", ".pcd", ".ply", ".las", ".laz")

# Classes by what they mean to a car, under the names of all data sets. What is not here is an obstacle.
_GROUND = ("road", "parking", "sidewalk", "other-ground", "terrain", "lane-marking")
_PLANTS = ("vegetation",)
_NOTHING = ("unlabeled", "outlier", "none")


_UNITS = ((1e17, 1e-9), (1e14, 1e-6), (1e11, 1e-3))  # [s] of one, by how large numbers are since 1970


class Shot(NamedTuple):
    """One scan that was not read yet."""

    name: str
    sequence: str
    stamp: float  # [s]; NaN where the recording does not say
    T_map_sensor: NDArray[np.float64] | None  # (4, 4)


class Seen(NamedTuple):
    """One scan, in its sensor's frame, with the returns from the own vehicle."""

    points: NDArray[np.float32]  # (N, 4)
    kinds: NDArray[np.uint8] | None = None  # (N,) `Kind` of each point, from its class
    moving: NDArray[np.bool_] | None = None  # (N,) points whose class says that they move
    around: NDArray[np.float32] | None = (
        None  # (M, 4) points of all lidars of the vehicle, seen from this one
    )


class Plan(NamedTuple):
    """A map around one scan, in its sensor's frame."""

    outlines: list[NDArray[np.float64]]  # (N, 2) each: drivable areas
    ground: Callable[
        [NDArray[np.float64]], NDArray[np.float64]
    ]  # places (N, 3) -> z of the ground, NaN: not known


@dataclass(frozen=True)
class Layout:
    """What was found at a path; nothing of it is read until it is asked for.

    Parameters
    ----------
    format : str
        In words.
    shots : tuple of Shot
    read : function of the number of a shot
    looked_for : str
        Which labels this layout may have: for the error where there are none.
    objects, plan : functions of the number of a shot, or None where there are no boxes, no map
    classes : bool
        Whether `read` gives kinds.
    own : (float, float)
        |x|, |y| of the own vehicle as seen from the sensor [m].
    view : str
        Whose eyes the recording is seen with, or how far they looked, where that needs to be said.
    heights : function of the number of a shot, or None
        Height of the sensor above ground [m], where the data set tells more of it than the scan's points do.
    """

    format: str
    shots: tuple[Shot, ...]
    read: Callable[[int], Seen]
    looked_for: str
    objects: Callable[[int], Boxes] | None = None
    plan: Callable[[int], Plan] | None = None
    classes: bool = False
    own: tuple[float, float] = CAR
    view: str = ""
    heights: Callable[[int], float] | None = None


def stem(path: Path) -> str:
    """Return a file's name without all its endings."""
    return path.name.split(".")[0]


def scans_in(folder: Path) -> list[Path]:
    """Return the scans that lie in a folder, by name; by number where all are named by numbers."""
    found = []
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        inner = path.with_suffix("") if path.suffix in _PACKED else path
        if inner.suffix in _SCANS and not inner.name.endswith(".pcd.bin") and path.is_file():
            found.append(path)
    numbered = all(_is_number(stem(path)) for path in found)
    return sorted(found, key=lambda path: int(stem(path))) if numbered else found


def poses_of(
    files: Iterable[Path],
    names: Sequence[str],
    *,
    axes: Axes = "flu",
    T_camera_sensor: NDArray[np.float64] | None = None,
) -> list[NDArray[np.float64] | None]:
    """Read the poses of scans from the first of some files that is there; None for all where none is.

    Parameters
    ----------
    files : iterable of Path
        See `pose_files`.
    names : sequence of str
        Of the scans. Where the file of poses has frame numbers, each scan gets the one in its name.
    axes : Axes
        Which way the poses' axes point, as for `read_points`: the scans' own.
    T_camera_sensor : (4, 4) array, optional
        Where poses are a camera's, as those of KITTI odometry are. Those in ``derived/`` are the lidar's.
    """
    path = next((one for one in files if one.is_file()), None)
    if path is None:
        return [None] * len(names)
    camera = None if path.parent.name == "derived" or path.suffix == ".csv" else T_camera_sensor
    found = read_poses(path, T_camera_sensor=camera)
    turn = np.eye(4)
    turn[:3, :3] = rotation_to_flu(axes)
    poses = turn @ found.poses @ turn.T
    if found.numbers is None:
        if len(poses) != len(names):
            raise ValueError(
                f"{path} has {len(poses)} poses, but there are {len(names)} scans: wanted as many, or the number of "
                "the scan at the beginning of each line"
            )
        return list(poses)
    of = {int(number): T for number, T in zip(found.numbers, poses, strict=True)}
    return [of.get(int(name)) if _is_number(name) else None for name in names]


def pose_files(folder: Path) -> list[Path]:
    """Return where the poses of a drive are looked for: ``derived/poses*``, ``poses.txt``, ``poses.csv``."""
    return [*sorted(folder.glob("derived/poses*")), folder / "poses.txt", folder / "poses.csv"]


def drive(
    name: str,
    scans: Sequence[Path],
    poses: Sequence[NDArray[np.float64] | None],
    stamps: Sequence[float] | NDArray[np.float64] | None = None,
) -> tuple[Shot, ...]:
    """Line up the scans of one drive.

    Without stamps, their names tell the time: tenths of a second, or milli-, micro- or nanoseconds since 1970 where
    the numbers are that large.
    """
    names = [stem(one) for one in scans]
    if stamps is None:
        numbered = all(_is_number(one) for one in names)
        counted = [int(one) for one in names] if numbered else list(range(len(names)))
        unit = next((unit for least, unit in _UNITS if max(counted, default=0) >= least), 0.1)
        stamps = [unit * number for number in counted]
    return tuple(Shot(*row) for row in zip(names, [name] * len(names), stamps, poses, strict=True))


def _is_number(name: str) -> bool:
    return name.isascii() and name.isdigit() and len(name) < 20


def kinds_of(labelled: LabelledPoints) -> NDArray[np.uint8]:
    """Return what each point is to a car, (N,), by the name of its class."""
    names = sorted(set(labelled.names.values()))
    kind = {one: Kind.OBSTACLE for one in names}
    for group, value in ((_GROUND, Kind.GROUND), (_PLANTS, Kind.PLANT), (_NOTHING, Kind.OTHER)):
        kind |= {one: value for one in group}
    table = np.full(max(labelled.names) + 1, Kind.OTHER, np.uint8)
    for number, name in labelled.names.items():
        table[number] = kind[name]
    return table[labelled.classes]
