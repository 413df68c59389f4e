"""Drives of a world map: sub-maps of consecutive frames, each with the pose of an anchor frame."""

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
from ogm.pose import Trajectory, check_pose, inverse
from ogm.scan import Frame
from ogm.storage.archive import attributes_checksum
from ogm.storage.files import OgmError
from ogm.world.layout import LAYERS, TILES, TileIndex, checked_array, codecs
from ogm.world.stores import children, keys, read_object, reading, writing
from ogm.world.tiles import TileStore

_GROUP, _FORMAT = "drives", "ogm.drive/1"
_REPAIR = "remove its folder, or prefix, and build it again"


@dataclass(frozen=True, eq=False)
class SubMap:
    """Consecutive frames of a drive as one map, in tiles of the world's lattice.

    Parameters
    ----------
    frames : (int, int)
        Index of the first frame in the drive, and of the last frame + 1.
    anchor : int
        Index in the drive of the frame with which the sub-map moves.
    stamp : float or None
        Time of the anchor [s].
    made, pose : (4, 4) float64
        ``T_map_sensor`` of the anchor when the sub-map was made, and its present value.
    tiles : tuple of (int, int), optional
        Tiles that contain cells of the sub-map; None until it is made.
    mapped : int
        Number of fused frames; the others were damaged.
    number : int
        Frame number of the anchor: the last number in its name (`ogm.io.poses.frame_numbers`), or `anchor` if names
        have no number.
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
        """Transform of its cells to their present place, (4, 4); None if they have not moved."""
        if np.array_equal(self.made, self.pose):
            return None
        return self.pose @ inverse(self.made)


@dataclass
class Drive:
    """A drive and its sub-maps.

    Parameters
    ----------
    name : str
    source : str
        SHA-256 of the sensor model and of the names, stamps and poses of the frames.
    submaps : list of SubMap
    """

    name: str
    source: str
    submaps: list[SubMap] = field(default_factory=list)

    def moved(self, place: Callable[[SubMap], NDArray[np.float64]]) -> "Drive":
        """Return the drive with new poses of the anchors."""
        moved = [replace(submap, pose=check_pose(place(submap)).copy()) for submap in self.submaps]
        return Drive(self.name, self.source, moved)

    def along(self, trajectory: Trajectory) -> "Drive":
        """Return the drive with the anchors on a trajectory of the sensor, by their stamps.

        Raises
        ------
        ValueError
            If an anchor has no stamp, or one outside the trajectory.
        """

        def place(submap: SubMap) -> NDArray[np.float64]:
            if submap.stamp is None:
                raise ValueError(f"drive {self.name} has no stamps: give poses by frame number")
            try:
                return trajectory.at(submap.stamp)
            except ValueError as error:
                raise ValueError(f"drive {self.name}, frame {submap.anchor}: {error}") from error

        return self.moved(place)

    def by_number(self, poses: Mapping[int, NDArray[np.float64]] | Sequence[NDArray[np.float64]]) -> "Drive":
        """Return the drive with the anchors at poses of the sensor, by frame number (mapping) or by index (sequence).

        Raises
        ------
        ValueError
            If an anchor's frame has no pose.
        """
        by_index = not isinstance(poses, Mapping)
        found: Mapping[int, Any] = poses if isinstance(poses, Mapping) else dict(enumerate(poses))

        def place(submap: SubMap) -> NDArray[np.float64]:
            number = submap.anchor if by_index else submap.number
            if number not in found:
                raise ValueError(f"frame {number} of drive {self.name}, an anchor, has no pose: give its pose too")
            return np.asarray(found[number], np.float64)

        return self.moved(place)


def split_drive(name: str, frames: Sequence[Frame], model: str, length: float) -> Drive:
    """Return a drive with its sub-maps planned, but not yet made.

    Parameters
    ----------
    name : str
        Letters, digits, ``-``, ``_`` and ``.``.
    frames : sequence of Frame
        Frames in order. Frames without a pose are left out when sub-maps are made. No scan is read.
    model : str
        Description of the sensor model, for `Drive.source`.
    length : float
        Distance travelled within a sub-map [m].

    Raises
    ------
    ValueError
        If the name has other characters, or no frame has a pose.
    """
    if not name or not all(letter.isalnum() or letter in "-_." for letter in name) or name.startswith("."):
        raise ValueError(f"the name of a drive must be of letters, digits, - and _, got {name!r}")
    if not length > 0:
        raise ValueError(f"the length of sub-maps must be greater than 0 m, got {length}")
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
        raise ValueError(f"none of the {len(frames)} frames of drive {name} has a pose: see ogm.datasets.with_poses")
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
    """Return the names of the drives of a map, sorted, including drives without a description."""
    with reading(store.url):
        return [name for name in children(store.store, f"{store.prefix}{_GROUP}") if name != "zarr.json"]


def has_drive(store: TileStore, name: str) -> bool:
    """Return whether a drive exists, with its description."""
    with reading(store.url):
        return read_object(store.store, f"{store.prefix}{_GROUP}/{name}/zarr.json") is not None


def begin_drive(store: TileStore, drive: Drive) -> None:
    """Make the array of a drive: (sub-maps, layers, cells, cells), with one shard per sub-map and tile."""
    with writing(store.url, f"drive {drive.name} of {store.url}"):
        store.check_writer()
        store.root.require_group(_GROUP).create_array(
            drive.name,
            **_array(store, len(drive.submaps)),
            **codecs(),
            attributes=_attributes(drive),
            overwrite=True,  # sub-maps of a drive without a description
        )


def save_drive(store: TileStore, drive: Drive) -> None:
    """Write the description of a drive, anchors and finished sub-maps, in one step."""
    with writing(store.url, f"drive {drive.name} of {store.url}"):
        store.check_writer()
        drive_array(store, drive.name).attrs.put(_attributes(drive))


def load_drive(store: TileStore, name: str) -> Drive:
    """Return a drive of a map.

    Raises
    ------
    OgmError
        If the drive does not exist or is damaged.
    """
    array = drive_array(store, name)
    with reading(f"drive {name} of {store.url}", _REPAIR):  # attributes may be a list
        attributes = dict(array.attrs)
    if attributes.get("sha256") != attributes_checksum(attributes):
        raise OgmError(f"the attributes of drive {name} of {store.url} are damaged: {_REPAIR}")
    try:
        if attributes["format"] != _FORMAT:
            raise ValueError(f"its format is {attributes['format']}, wanted {_FORMAT}")
        drive = Drive(name, str(attributes["source"]), [_submap(entry, store) for entry in attributes["submaps"]])
        checked_array(array, **_array(store, len(drive.submaps)))
        return drive
    except (ValueError, TypeError, KeyError, OverflowError) as error:
        raise OgmError(f"the description of drive {name} of {store.url} is invalid ({error}): {_REPAIR}") from error


def drive_array(store: TileStore, name: str) -> Any:
    """Return the Zarr array of a drive."""
    with reading(f"drive {name} of {store.url}", _REPAIR):
        with suppress(KeyError):
            return store.root[f"{_GROUP}/{name}"]
        names = drive_names(store)
        if name in names:
            raise OgmError(f"drive {name} of {store.url} has lost its zarr.json: {_REPAIR}")
        raise OgmError(f"{store.url} has no drive {name!r}; it has: {', '.join(names) or 'none'}")


def submap_key(store: TileStore, name: str, number: int, index: TileIndex) -> str:
    """Return the key of the object of a tile of a sub-map."""
    i, j = (k + TILES // 2 for k in index)
    return f"{store.prefix}{_GROUP}/{name}/c/{number}/0/{i}/{j}"


def lost_tiles(store: TileStore, drive: Drive) -> dict[int, list[TileIndex]]:
    """Return the missing tiles of finished sub-maps by number of the sub-map; the store is listed."""
    with reading(store.url):
        existing = set(keys(store.store, f"{store.prefix}{_GROUP}/{drive.name}/c/"))
    lost: dict[int, list[TileIndex]] = {}
    for number, submap in enumerate(drive.submaps):
        for index in submap.tiles or ():
            if submap_key(store, drive.name, number, index) not in existing:
                lost.setdefault(number, []).append(index)
    return lost


def _array(store: TileStore, count: int) -> dict[str, Any]:
    """Return shape, shards, chunks and type of the array of a drive with `count` sub-maps."""
    of_level = store.layout.array(0)
    first = {"shape": count, "shards": 1, "chunks": 1}
    return {name: (first[name], *value) if name in first else value for name, value in of_level.items()}


def _attributes(drive: Drive) -> dict[str, Any]:
    submaps = [
        vars(submap) | {"made": submap.made.ravel().tolist(), "pose": submap.pose.ravel().tolist()}
        for submap in drive.submaps
    ]
    attributes = {"format": _FORMAT, "source": drive.source, "layers": list(LAYERS), "submaps": submaps}
    return attributes | {"sha256": attributes_checksum(attributes)}


def _submap(found: Mapping[str, Any], store: TileStore) -> SubMap:
    made, now = (check_pose(np.reshape(found[name], (4, 4)), name) for name in ("made", "pose"))
    tiles = None if found["tiles"] is None else tuple((operator.index(i), operator.index(j)) for i, j in found["tiles"])
    for index in tiles or ():
        store.layout.check_box(store.layout.box_of(index))
    first, last = found["frames"]
    number = operator.index(found.get("number", found["anchor"]))  # older maps have no numbers
    return SubMap((first, last), found["anchor"], found["stamp"], made, now, tiles, found["mapped"], number)
