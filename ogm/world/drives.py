"""Drives of a world map: sub-maps of consecutive frames, kept with the pose of an anchor frame each."""

import hashlib
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.io.poses import frame_numbers
from ogm.pose import Trajectory, check_pose
from ogm.scan import Frame
from ogm.storage.archive import attributes_checksum
from ogm.storage.files import OgmError
from ogm.world.layout import LAYERS, TILES, TileIndex, checked_array, codecs
from ogm.world.stores import children, keys, read_object, reading, writing
from ogm.world.tiles import TileStore

_GROUP, _FORMAT = "drives", "ogm.drive/1"
_MEND = "remove its folder, or prefix, and build it again"


@dataclass(frozen=True, eq=False)
class SubMap:
    """Consecutive frames of a drive, as one map in tiles of the world's lattice.

    Parameters
    ----------
    frames : (int, int)
        Numbers of the first one in the drive, and of the last one + 1.
    anchor : int
        Place in the drive of the frame that the sub-map moves with.
    stamp : float or None
        Its time [s].
    made, pose : (4, 4) float64
        ``T_map_sensor`` of the anchor when the sub-map was made, and as it is known now.
    tiles : tuple of (int, int), optional
        What it has cells in; None until it is made.
    mapped : int
        Frames that are in it; the others were damaged.
    number : int
        Frame number of the anchor, the last number in its name (`ogm.io.poses.frame_numbers`); `anchor` where names
        have none.
    """

    frames: tuple[int, int]
    anchor: int
    stamp: float | None
    made: NDArray[np.float64]
    pose: NDArray[np.float64]
    tiles: tuple[TileIndex, ...] | None = None
    mapped: int = 0
    number: int = -1

    @property
    def correction(self) -> NDArray[np.float64] | None:
        """What takes its cells to where they belong now, (4, 4); None if they stand there."""
        if np.array_equal(self.made, self.pose):
            return None
        inverse = np.eye(4)
        inverse[:3, :3] = self.made[:3, :3].T
        inverse[:3, 3] = -self.made[:3, :3].T @ self.made[:3, 3]
        return self.pose @ inverse


@dataclass
class Drive:
    """A drive and its sub-maps.

    Parameters
    ----------
    name : str
    source : str
        SHA-256 of the names, stamps and poses of its frames and of the sensor model.
    submaps : list of SubMap
    """

    name: str
    source: str
    submaps: list[SubMap] = field(default_factory=list)

    @property
    def finished(self) -> bool:
        """Whether all sub-maps are made."""
        return all(one.tiles is not None for one in self.submaps)

    def moved(self, place: Callable[[SubMap], NDArray[np.float64]]) -> "Drive":
        """Return the drive with other poses of the anchors."""
        moved = [replace(one, pose=check_pose(place(one)).copy()) for one in self.submaps]
        return Drive(self.name, self.source, moved)

    def along(self, trajectory: Trajectory) -> "Drive":
        """Return the drive with the anchors on a trajectory of the sensor, by their stamps.

        Raises
        ------
        ValueError
            If an anchor has no stamp, or one outside the trajectory.
        """

        def place(one: SubMap) -> NDArray[np.float64]:
            if one.stamp is None:
                raise ValueError(f"drive {self.name} has no stamps: give poses by frame number")
            try:
                return trajectory.at(one.stamp)
            except ValueError as error:
                raise ValueError(f"drive {self.name}, frame {one.anchor}: {error}") from error

        return self.moved(place)

    def by_number(self, poses: Mapping[int, NDArray[np.float64]] | Sequence[NDArray[np.float64]]) -> "Drive":
        """Return the drive with the anchors at poses of the sensor, by frame number, as of pose graphs, or by row.

        Raises
        ------
        ValueError
            If an anchor's frame has no pose.
        """
        by_row = not isinstance(poses, Mapping)
        found: Mapping[int, Any] = poses if isinstance(poses, Mapping) else dict(enumerate(poses))

        def place(one: SubMap) -> NDArray[np.float64]:
            number = one.anchor if by_row else one.number
            if number not in found:
                raise ValueError(f"frame {number} of drive {self.name} has no pose, and is an anchor")
            return np.asarray(found[number], np.float64)

        return self.moved(place)


def split_drive(name: str, frames: Sequence[Frame], model: str, length: float) -> Drive:
    """Return a drive whose sub-maps are still to be made.

    Parameters
    ----------
    name : str
        Letters, digits, ``-``, ``_`` and ``.``.
    frames : sequence of Frame
        In order; those without a pose are left out when sub-maps are made. No scan is read.
    model : str
        Of the sensor, for `Drive.source`.
    length : float
        Of the way along which a sub-map's frames were taken [m].

    Raises
    ------
    ValueError
        If the name has other characters, or no frame has a pose.
    """
    if not name or not all(one.isalnum() or one in "-_." for one in name) or name.startswith("."):
        raise ValueError(f"a drive is named by letters, digits, - and _, got {name!r}")
    if not length > 0:
        raise ValueError(f"the length of sub-maps must be above 0 m, got {length}")
    sums = hashlib.sha256(f"{model} {length!r}".encode())
    posed: list[tuple[int, float | None, NDArray[np.float64]]] = []
    numbers = frame_numbers([frame.name for frame in frames])
    for k, frame in enumerate(frames):
        sums.update(f"{frame.name} {frame.stamp!r}".encode())
        if frame.T_map_sensor is not None:
            T = check_pose(frame.T_map_sensor, f"the pose of {frame.name}")
            sums.update(T.tobytes())
            posed.append((k, frame.stamp, T))
    if not posed:
        raise ValueError(f"none of the {len(frames)} frames of drive {name} has a pose (see ogm.datasets.with_poses)")
    groups: list[list[int]] = [[]]
    way = 0.0
    for n, (_, _, T) in enumerate(posed):
        step = math.dist(T[:3, 3].tolist(), posed[n - 1][2][:3, 3].tolist()) if n else 0.0
        way += step
        if way > length and groups[-1]:
            groups.append([])
            way = 0.0
        groups[-1].append(n)
    submaps = []
    for group in groups:
        anchor, stamp, T = posed[group[len(group) // 2]]
        number = anchor if numbers is None else int(numbers[anchor])
        span = posed[group[0]][0], posed[group[-1]][0] + 1
        submaps.append(SubMap(span, anchor, stamp, T.copy(), T.copy(), number=number))
    return Drive(name, sums.hexdigest(), submaps)


def drive_names(store: TileStore) -> list[str]:
    """Return the names of the drives of a map, sorted; also of those whose description is lost."""
    with reading(store.url):
        return [name for name in children(store.store, f"{store.prefix}{_GROUP}") if name != "zarr.json"]


def has_drive(store: TileStore, name: str) -> bool:
    """Return whether there is a drive of a name, with its description."""
    with reading(store.url):
        return read_object(store.store, f"{store.prefix}{_GROUP}/{name}/zarr.json") is not None


def begin_drive(store: TileStore, drive: Drive) -> None:
    """Make the array of a drive: (sub-maps, layers, cells, cells), a shard per sub-map and tile."""
    with writing(store.url, f"drive {drive.name} of {store.url}"):
        store.check_writer()
        store.root.require_group(_GROUP).create_array(
            drive.name,
            **_array(store, len(drive.submaps)),
            **codecs(),
            attributes=_attributes(drive),
            overwrite=True,  # a description that is lost left sub-maps
        )


def save_drive(store: TileStore, drive: Drive) -> None:
    """Write what is known of a drive: anchors, and the sub-maps that are made, in one step."""
    with writing(store.url, f"drive {drive.name} of {store.url}"):
        store.check_writer()
        drive_array(store, drive.name).attrs.put(_attributes(drive))


def load_drive(store: TileStore, name: str) -> Drive:
    """Return a drive of a map.

    Raises
    ------
    OgmError
        If there is none of that name, or it is damaged.
    """
    array = drive_array(store, name)
    with reading(f"drive {name} of {store.url}", _MEND):  # attributes may be a list
        attributes = dict(array.attrs)
    if attributes.get("sha256") != attributes_checksum(attributes):
        raise OgmError(f"the attributes of drive {name} of {store.url} are damaged: {_MEND}")
    try:
        if attributes["format"] != _FORMAT:
            raise ValueError(f"it has the format {attributes['format']}")
        drive = Drive(name, str(attributes["source"]), [_submap(one, store) for one in attributes["submaps"]])
        checked_array(array, **_array(store, len(drive.submaps)))
        return drive
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise OgmError(f"drive {name} of {store.url} makes no sense ({error}): {_MEND}") from error


def drive_array(store: TileStore, name: str) -> Any:
    """Return the Zarr array of a drive."""
    with reading(f"drive {name} of {store.url}", _MEND):
        with suppress(KeyError):
            return store.root[f"{_GROUP}/{name}"]
        names = drive_names(store)
        if name in names:
            raise OgmError(f"drive {name} of {store.url} has lost its zarr.json: {_MEND}")
        raise OgmError(f"{store.url} has no drive {name!r}; there are: {', '.join(names) or 'none'}")


def submap_key(store: TileStore, name: str, number: int, index: TileIndex) -> str:
    """Return the key of the object that holds a tile of a sub-map."""
    i, j = (one + TILES // 2 for one in index)
    return f"{store.prefix}{_GROUP}/{name}/c/{number}/0/{i}/{j}"


def lost_tiles(store: TileStore, drive: Drive) -> dict[int, list[TileIndex]]:
    """Return the tiles of finished sub-maps that are not there, by number of the sub-map; the store is listed."""
    with reading(store.url):
        there = set(keys(store.store, f"{store.prefix}{_GROUP}/{drive.name}/c/"))
    lost: dict[int, list[TileIndex]] = {}
    for number, one in enumerate(drive.submaps):
        for index in one.tiles or ():
            if submap_key(store, drive.name, number, index) not in there:
                lost.setdefault(number, []).append(index)
    return lost


def _array(store: TileStore, count: int) -> dict[str, Any]:
    """Return shape, shards, chunks and type of the array of a drive of so many sub-maps."""
    of_level = store.layout.array(0)
    first = {"shape": count, "shards": 1, "chunks": 1}
    return {name: (first[name], *value) if name in first else value for name, value in of_level.items()}


def _attributes(drive: Drive) -> dict[str, Any]:
    submaps = [
        {
            "frames": list(one.frames),
            "anchor": one.anchor,
            "stamp": one.stamp,
            "made": one.made.ravel().tolist(),
            "pose": one.pose.ravel().tolist(),
            "tiles": None if one.tiles is None else [list(index) for index in one.tiles],
            "mapped": one.mapped,
            "number": one.number,
        }
        for one in drive.submaps
    ]
    attributes = {"format": _FORMAT, "source": drive.source, "layers": list(LAYERS), "submaps": submaps}
    return attributes | {"sha256": attributes_checksum(attributes)}


def _submap(found: Mapping[str, Any], store: TileStore) -> SubMap:
    made, now = (check_pose(np.reshape(found[name], (4, 4)), name) for name in ("made", "pose"))
    tiles = None if found["tiles"] is None else tuple((operator.index(i), operator.index(j)) for i, j in found["tiles"])
    for index in tiles or ():
        store.layout.check_box(store.layout.box_of(index))
    first, last = found["frames"]
    number = operator.index(found.get("number", found["anchor"]))  # older maps have positions alone
    return SubMap((first, last), found["anchor"], found["stamp"], made, now, tiles, found["mapped"], number)
