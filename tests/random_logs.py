"""Logs of a small drive with random oddities of clock, field, unit and damage, as recorders and drivers make them.

An oddity is a function that changes the messages of a drive; `odd_drive` has some of them.
"""

import copy
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from ogm.io.logs import LogWriter
from ogm.io.messages import StampedTransform, point_cloud2, tf_message
from ogm.io.messages.plain import ros_stamp
from ogm.pose import inverse, pose, transform_points
from ogm.scan import Scan

CLOUD, TF = "sensor_msgs/msg/PointCloud2", "tf2_msgs/msg/TFMessage"
START, STEP = 1_700_000_000.0, 0.125  # [s]
SCANS = 6
_CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}

Rng = np.random.Generator
Drive = list["Message"]


class Message(SimpleNamespace):
    """A message of a log: topic, type, message, log time [s]."""

    topic: str
    type: str
    message: Any
    time: float


def made_scans() -> list[tuple[Scan, np.ndarray]]:
    """Return scans of ground and a wall from places along a line, and these places."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-12, 10, 0.35), np.arange(-8, 8, 0.35)))
    wall = np.array([(10.05, b, z) for b in np.arange(-8, 8, 0.15) for z in np.arange(0.1, 2.2, 0.3)])
    world = np.r_[np.c_[x, y, 0 * x], wall]
    scans = []
    for k in range(SCANS):
        T = pose(0.4 * k, 0.05 * k, 1.8, yaw=0.02 * k)
        points = transform_points(inverse(T), world).astype("f4")
        turn = (np.arctan2(points[:, 1], points[:, 0]) / (2 * np.pi) + 0.5) * 0.1
        points = np.c_[points, 0.5 + 0.5 * np.sin(points[:, 0])].astype("f4")
        scans.append((Scan(points, time=turn, ring=np.arange(len(points)) % 16), T))
    return scans


def messages_of(scans: Sequence[tuple[Scan, np.ndarray]]) -> Drive:
    """Return a cloud and a transform of each scan, 8 Hz."""
    drive = []
    for k, (scan, T) in enumerate(scans):
        stamp = START + STEP * k
        cloud = point_cloud2(scan, frame_id="lidar", stamp=stamp)
        moved = tf_message([StampedTransform("map", "lidar", stamp, T)])
        drive += [Message(topic="/tf", type=TF, message=moved, time=stamp + 0.01)]
        drive += [Message(topic="/points", type=CLOUD, message=cloud, time=stamp + 0.06)]
    return drive


def write(path: Path, drive: Drive) -> Path:
    """Write messages in the order of their log times."""
    with LogWriter(path) as log:
        for one in sorted(drive, key=lambda one: one.time):
            log.write(one.topic, one.type, one.message, one.time)
    return path


def clouds(drive: Drive) -> list[Any]:
    """Return the point clouds of a drive that have points."""
    return [one.message for one in drive if one.type == CLOUD and one.message.width]


def column(cloud: Any, name: str, kind: str = "<f4") -> np.ndarray:
    """View a field of a cloud."""
    offset = next(field.offset for field in cloud.fields if field.name == name)
    return np.ndarray((cloud.width,), kind, cloud.data, offset, (cloud.point_step,))


def exchange(cloud: Any, name: str, values: np.ndarray | None, new: str = "") -> None:
    """Replace a field of a cloud by numbers of any type, or leave it out."""
    kinds = {code: f"<{kind}" for kind, code in _CODES.items()}
    names = [field.name.lower() for field in cloud.fields]
    if name not in names or len({*names}) < len(names) or any(field.datatype not in kinds for field in cloud.fields):
        raise StopIteration(name)
    known = [
        (field.name, column(cloud, field.name, kinds[field.datatype]))
        for field in cloud.fields
        if field.name != "extra"
    ]
    parts = [(new or n, values) if n == name else (n, v) for n, v in known]
    parts = [(n, np.asarray(v)) for n, v in parts if v is not None]
    records = np.zeros(cloud.width, [(n, v.dtype) for n, v in parts])
    for n, v in parts:
        records[n] = v
    offsets: Any = records.dtype.fields
    cloud.fields = [
        SimpleNamespace(name=n, offset=offsets[n][1], datatype=_CODES[v.dtype.str[1:]], count=1) for n, v in parts
    ]
    cloud.point_step, cloud.row_step = records.dtype.itemsize, records.nbytes
    cloud.data = records.view(np.uint8).reshape(-1).copy()


def restamp(one: Message, change: Callable[[float], float]) -> None:
    """Change the stamps of a message."""
    headers = [one.message.header] if hasattr(one.message, "header") else [t.header for t in one.message.transforms]
    for header in headers:
        header.stamp = ros_stamp(max(change(header.stamp.sec + header.stamp.nanosec * 1e-9), 0.0))


# --- Oddities that cost nothing: the map is that of the clean log -------------------------------------


def photons(drive: Drive, rng: Rng) -> None:
    factor = rng.choice([200.0, 4000.0, 90_000.0])
    for cloud in clouds(drive):
        column(cloud, "intensity")[:] *= factor * rng.uniform(0.02, 1)


def decibels(drive: Drive, rng: Rng) -> None:
    for cloud in clouds(drive):
        column(cloud, "intensity")[:] = rng.uniform(-150, 0, cloud.width)


def wrong_intensities(drive: Drive, rng: Rng) -> None:
    for cloud in clouds(drive):
        column(cloud, "intensity")[rng.integers(0, cloud.width, 5)] = rng.choice([np.nan, np.inf, -3.0, 1e30], 5)


def foreign_clock(drive: Drive, rng: Rng) -> None:
    unit, since = rng.choice([1.0, 1e-3, 1e-6, 1e-9]), rng.uniform(20, 1e5)
    for k, cloud in enumerate(clouds(drive)):
        seconds = column(cloud, "time").astype("f8") + since + STEP * k
        exchange(cloud, "time", np.round(seconds / unit, 4), "timestamp")


def wrapped_times(drive: Drive, rng: Rng) -> None:
    for k, cloud in enumerate(clouds(drive)):
        ticks = (column(cloud, "time").astype("f8") + STEP * k) * 1e9 + 2**32 - rng.uniform(0, 1e9)
        exchange(cloud, "time", (ticks % 2**32).astype("u4"), "t")


def wrong_times(drive: Drive, rng: Rng) -> None:
    for cloud in clouds(drive):
        column(cloud, "time")[rng.integers(0, cloud.width, 3)] = rng.choice([np.nan, 1e30, -1e9, 5e4], 3)


def times_of_no_sweep(drive: Drive, rng: Rng) -> None:
    for cloud in clouds(drive):
        column(cloud, "time")[:] = rng.uniform(-1e30, 1e30, cloud.width)


def wrong_rings(drive: Drive, rng: Rng) -> None:
    for cloud in clouds(drive):
        exchange(cloud, "ring", rng.choice([-1.0, 0.5, np.nan, 1e9], cloud.width).astype("f4"))


def lost_field(drive: Drive, rng: Rng) -> None:
    name = rng.choice(["intensity", "ring", "time"])
    for cloud in clouds(drive):
        exchange(cloud, name, None)


def damaged_field(drive: Drive, rng: Rng) -> None:
    damage = {"offset": int(rng.choice([2**31, 60_000])), "datatype": int(rng.choice([0, 77]))}
    name = str(rng.choice(list(damage)))
    for cloud in clouds(drive):
        field = SimpleNamespace(name="extra", offset=0, datatype=7, count=1)
        setattr(field, name, damage[name])
        cloud.fields = [*cloud.fields, field]


def doubled_field(drive: Drive, rng: Rng) -> None:
    for cloud in clouds(drive):
        cloud.fields = [*cloud.fields, replaced(cloud.fields[3], name=str(rng.choice(["intensity", "Intensity"])))]


def replaced(field: SimpleNamespace, **changes: Any) -> SimpleNamespace:
    return SimpleNamespace(**{**vars(field), **changes})


def bad_points(drive: Drive, rng: Rng) -> None:
    for cloud in clouds(drive):
        extra = 8
        cloud.data = np.concatenate([cloud.data, cloud.data[: extra * cloud.point_step]])
        cloud.width += extra
        cloud.row_step = len(cloud.data)
        column(cloud, str(rng.choice(["x", "y", "z"])))[-extra:] = rng.choice([np.nan, np.inf, 1e30, -3e7], extra)


def foreign_transform(drive: Drive, rng: Rng) -> None:
    for one in drive:
        if one.type == TF:
            wrong = tf_message([StampedTransform("base_link", "camera", START, np.eye(4))]).transforms[0]
            wrong.transform.rotation.w = float(rng.choice([0.0, np.nan, 2.0]))
            one.message.transforms = [wrong, *one.message.transforms]


def old_frame_names(drive: Drive, rng: Rng) -> None:
    for cloud in clouds(drive):
        cloud.header.frame_id = "/lidar"


def late_messages(drive: Drive, rng: Rng) -> None:
    for one in drive:
        if rng.random() < 0.3:
            one.time += rng.uniform(0, 0.4)


def offset_clock(drive: Drive, rng: Rng) -> None:
    seconds = rng.choice([-1.6e9, -3600.0, 1e8])
    for one in drive:
        restamp(one, lambda stamp: stamp + seconds)


def empty_cloud(drive: Drive, rng: Rng) -> None:
    hollow = SimpleNamespace(**vars(point_cloud2(Scan(np.empty((0, 4), "f4")), frame_id="lidar", stamp=START + 0.07)))
    if rng.random() < 0.5:
        hollow.fields, hollow.point_step = [], 0
    drive.append(Message(topic="/points", type=CLOUD, message=hollow, time=START + 0.13))


# --- Oddities that must be told: scans are lost, or the drive is cut ----------------------------------


def stray_stamp(drive: Drive, rng: Rng) -> None:
    one = [one for one in drive if one.type == CLOUD][rng.integers(2, SCANS - 1)]
    seconds = rng.choice([-3600.0, 4e5, -START])
    restamp(one, lambda stamp: stamp + seconds)


def unset_clock(drive: Drive, rng: Rng) -> None:
    for one in drive[: 2 * int(rng.integers(1, 3))]:
        restamp(one, lambda stamp: stamp - START)


def looped(drive: Drive, rng: Rng) -> None:
    """Append the drive once more, beside the first: the clock begins anew."""
    gap, again = float(rng.choice([0.2, 60.0])), copy.deepcopy(drive)
    end = max(one.time for one in drive)
    for one in again:
        one.time += end - START + gap
        if one.type == TF:
            one.message.transforms[-1].transform.translation.y += 3.2
    drive += again


def step_of_clock(drive: Drive, rng: Rng) -> None:
    seconds = float(rng.choice([-5.0, -600.0, 3e5]))
    for one in drive[SCANS:]:
        restamp(one, lambda stamp: stamp + seconds)


def coarse_stamps(drive: Drive, rng: Rng) -> None:
    step = float(rng.choice([1.0, 128.0]))
    for one in drive:
        restamp(one, lambda stamp: stamp // step * step)


def lost_transforms(drive: Drive, rng: Rng) -> None:
    first = 2 * int(rng.integers(2, 5))
    drive[:] = [one for n, one in enumerate(drive) if one.type != TF or n < first]


def damaged_cloud(drive: Drive, rng: Rng) -> None:
    cloud = clouds(drive)[rng.integers(0, SCANS)]
    cloud.data = cloud.data[: len(cloud.data) // 2]


def lost_axis(drive: Drive, rng: Rng) -> None:
    for cloud in clouds(drive):
        exchange(cloud, "z", None)


def map_coordinates(drive: Drive, rng: Rng) -> None:
    for cloud in clouds(drive):
        column(cloud, "y")[:] += 5.6e6


HARMLESS: tuple[Callable[[Drive, Rng], None], ...] = (
    photons, decibels, wrong_intensities, foreign_clock, wrapped_times, wrong_times, times_of_no_sweep, wrong_rings,
    lost_field, bad_points, foreign_transform, old_frame_names, late_messages, offset_clock, damaged_field,
    doubled_field, empty_cloud,
)  # fmt: skip
TOLD: tuple[Callable[[Drive, Rng], None], ...] = (
    stray_stamp, unset_clock, looped, step_of_clock, coarse_stamps, lost_transforms, damaged_cloud, lost_axis,
    map_coordinates,
)  # fmt: skip
"""Functions that change the messages of a drive: those that must not change the map, and those that must be told."""


def combination(number: int) -> list[Callable[[Drive, Rng], None]]:
    """Return one to four oddities by chance: every other combination has one that must be told."""
    rng = np.random.default_rng(number)
    chosen = [HARMLESS[k] for k in sorted(rng.choice(len(HARMLESS), rng.integers(1, 4), replace=False))]
    return chosen + ([TOLD[number // 2 % len(TOLD)]] if number % 2 else [])


def odd_drive(scans: Sequence[tuple[Scan, np.ndarray]], number: int) -> tuple[Drive, list[str]]:
    """Return the messages of a drive with a combination of oddities, and the names of those that it has."""
    drive, names, rng = messages_of(scans), [], np.random.default_rng(number)
    for oddity in combination(number):
        try:
            oddity(drive, rng)
        except (StopIteration, RuntimeError):  # the field was changed by another
            continue
        names.append(oddity.__name__)
    return drive, names
