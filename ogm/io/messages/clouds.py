"""Point clouds and radar detections: ``PointCloud2`` to a scan and back, ``RadarScan`` and Continental's lists."""

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.io.columns import IntensityScale
from ogm.io.formats.table import POSITION, Table, plain, refuse_doubles
from ogm.io.messages.plain import as_bytes, describe_message, header, reads_message, stamp_seconds
from ogm.io.notices import notice
from ogm.io.scan_table import Axes, scan_from_table
from ogm.scan import Scan
from ogm.storage.files import OgmError, error_context

log: logging.Logger = logging.getLogger(__name__)

# sensor_msgs/PointField.datatype; 9 and above only in releases of ROS 2 since 2025
_TYPES = dict(enumerate(("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8", "i8", "u8", "u1"), start=1))
_CODES = {np.dtype(np.float32): 7, np.dtype(np.uint16): 4}
_PADDING = ("", "_")


@reads_message
def scan_from_point_cloud2(
    message: Any,
    *,
    axes: Axes = "flu",
    intensity_max: IntensityScale | None = None,
    time_unit: float | None = None,
    no_returns: bool = True,
) -> Scan:
    """Return the scan of a point cloud message.

    Fields are recognised by name, in any order and type, as in files: see `ogm.io.read_scan` for intensities, rings and
    rows without a point. ``is_dense`` is ignored. Fields outside of their point, or of unknown type, are left out with
    a warning in the log.

    Parameters
    ----------
    message : object
        Object with the fields of ``sensor_msgs/PointCloud2``, from rosbags, rclpy, rospy, or a decoded MCAP.
    axes, intensity_max, time_unit
        See `ogm.io.read_scan`.
    no_returns : bool
        Whether to compute the beams without echo of an organised cloud (``height`` above 1) with the raster of a
        spinning lidar, which takes longer than all other steps.

    Returns
    -------
    Scan
        `Scan.stamp` is the header's stamp, and `Scan.time` counts from it. Times of the same clock (nearer to the stamp
        than to 0, in s, ms, us or ns) may precede a stamp at the end of the sweep. Times relative to the stamp are used
        directly. Times of another clock count from the earliest. If the header has no stamp (0), the earliest time of a
        clock becomes the stamp. `Scan.doppler` is a field ``doppler``, ``doppler_velocity``, ``radial_velocity``,
        ``range_rate`` or ``velocity`` [m/s], which must be positive away from the sensor; `Scan.rcs` is ``rcs`` [dBsm].

    Raises
    ------
    OgmError
        If sizes are inconsistent, x, y or z is missing or lies outside of its point, or most coordinates are
        implausible.
    ValueError
        If an option is invalid.
    """
    table, where = cloud_table(message)
    if not no_returns:
        table = table._replace(shape=None)
    stamp = stamp_seconds(message.header.stamp)
    return scan_from_table(table, where, axes, intensity_max=intensity_max, time_unit=time_unit, stamp=stamp)[0]


@reads_message
def cloud_table(message: Any) -> tuple[Table, str]:
    """Return the fields of a point cloud message as columns, and the name of the message for errors.

    Raises
    ------
    OgmError
        If sizes are inconsistent, or x, y or z lies outside of its point.
    """
    where = describe_message(message, "PointCloud2")
    return Table("PointCloud2", *_columns(message, where)), where


def _columns(message: Any, where: str) -> tuple[dict[str, NDArray[Any]], tuple[int, int] | None]:
    """Return views of all fields, of several values the first, and the raster of an organised cloud."""
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    row_step, data = int(message.row_step), as_bytes(message.data, where)
    if min(height, width, step) < 0 or (height * width and step < 1):
        raise OgmError(f"{where} has height {height}, width {width} and point_step {step}: it is damaged")
    if len(data) == height * width * step or not row_step:  # some drivers do not set row_step
        row_step = width * step
    if row_step < width * step or len(data) < height * row_step:
        raise OgmError(
            f"{where} has {len(data)} bytes, wanted {height} rows of {width} points of {step} bytes, or of row_step "
            f"{row_step} bytes: it is cut short or damaged"
        )
    if surplus := len(data) - height * row_step:
        text = "%s has %d bytes after its %d points, which are ignored: check its width"
        notice(log, "surplus bytes", text, where, surplus, height * width)
    fields = [field for field in message.fields if field.name not in _PADDING]
    refuse_doubles((field.name for field in fields), where)
    order = ">" if message.is_bigendian else "<"
    columns: dict[str, NDArray[Any]] = {}
    for field in fields:
        if not height * width and int(field.datatype) in _TYPES:
            columns.setdefault(field.name, np.empty(0, order + _TYPES[int(field.datatype)]))
        elif not (damage := _damage(field, step)):
            place, kind = int(field.offset), order + _TYPES[int(field.datatype)]
            column = np.ndarray((height, width), kind, data, place, (row_step, step)).reshape(-1)
            columns.setdefault(field.name, column)
        elif plain(field.name) in POSITION:
            raise OgmError(f"{where} has {damage}: it is damaged")
        else:
            notice(log, f"field {field.name}", "%s has %s: the field is left out", where, damage)
    if not columns and not height * width:
        columns = {name: np.empty(0, np.float32) for name in "xyz"}
    return columns, (height, width) if height > 1 and width > 1 else None


def _damage(field: Any, step: int) -> str:
    """Return the reason why a field cannot be read from points of `step` bytes; "" if it can."""
    if int(field.datatype) not in _TYPES:
        return f"datatype {field.datatype} for {field.name}, wanted 1 to {len(_TYPES)}"
    size = np.dtype(_TYPES[int(field.datatype)]).itemsize
    offset, count = int(field.offset), max(int(field.count), 1)  # old drivers write a count of 0 for 1
    if 0 <= offset <= step - count * size:
        return ""
    return f"{field.name} at byte {offset}, {count} times {size} bytes, wanted it inside of point_step {step}"


def point_cloud2(scan: Scan, *, frame_id: str, stamp: float | None = None) -> SimpleNamespace:
    """Return a scan as a ``sensor_msgs/PointCloud2``.

    It has x, y, z and intensity [0, 1] as float32, and if present ring (uint16), time since the stamp (float32 [s]),
    doppler [m/s] and rcs [dBsm] (float32). The message cannot hold beams without echo.

    Parameters
    ----------
    scan : Scan
    frame_id : str
        Frame of the sensor.
    stamp : float, optional
        [s]; by default the scan's stamp, or 0 without one.

    Returns
    -------
    SimpleNamespace
        Object with the fields of the message, ``data`` as (bytes,) uint8. rosbags serialises it, `fill_message` copies
        it into a message of rclpy or rospy.
    """
    columns: dict[str, NDArray[Any]] = dict(zip(("x", "y", "z", "intensity"), scan.points.T, strict=True))
    if scan.ring is not None:
        columns["ring"] = scan.ring
    for name in ("time", "doppler", "rcs"):
        if getattr(scan, name) is not None:
            columns[name] = getattr(scan, name).astype(np.float32)
    kind = np.dtype([(name, column.dtype.newbyteorder("<")) for name, column in columns.items()])
    records = np.empty(len(scan), kind)
    for name, column in columns.items():
        records[name] = column
    offsets: Any = records.dtype.fields
    fields = [
        SimpleNamespace(name=name, offset=offsets[name][1], datatype=_CODES[column.dtype], count=1)
        for name, column in columns.items()
    ]
    return SimpleNamespace(
        header=header(scan.stamp if stamp is None else stamp, frame_id),
        height=1,
        width=len(scan),
        fields=fields,
        is_bigendian=False,
        point_step=records.dtype.itemsize,
        row_step=records.nbytes,
        data=records.view(np.uint8).reshape(-1),
        is_dense=True,
    )


_FIELDS = ("range", "azimuth", "elevation", "doppler_velocity")


@reads_message
def scan_from_radar_scan(message: Any) -> Scan:
    """Return the scan of a ``radar_msgs/RadarScan``.

    Parameters
    ----------
    message : object
        Object with the fields of the message: azimuth counts to the left of the sensor's x axis, elevation upwards
        [rad].

    Returns
    -------
    Scan
        `Scan.doppler` is ``doppler_velocity`` unchanged: the message does not define its sign, which is positive away
        from the sensor in `ogm`. Intensities are 0, as the message's amplitude has no common unit. `Scan.rcs`, which
        marks radar scans, is NaN, as the message has no cross sections.

    Raises
    ------
    OgmError
        If it is no such message, or has invalid numbers.
    """
    rows = [[getattr(detection, name) for name in _FIELDS] for detection in message.returns]
    scan = _scan(message, "RadarScan", rows, ("doppler",))
    return replace(scan, rcs=np.full(len(scan), np.float32(np.nan)))


@reads_message
def scan_from_continental(message: Any) -> Scan:
    """Return the scan of a detection list of a Continental ARS548 or SRR520, as sent by TIER IV's nebula driver.

    Parameters
    ----------
    message : object or mapping
        A ``continental_msgs/ContinentalArs548DetectionList`` or ``ContinentalSrr520DetectionList``, or its fields as
        printed by ``ros2 topic echo``. The azimuth counts to the left for both; an SRR520 has no elevation.

    Returns
    -------
    Scan
        Detections flagged as invalid by the sensor are left out. `Scan.doppler` is the range rate.

    Raises
    ------
    OgmError
        If it is no such message, or has invalid numbers.
    """
    message = _namespace(message)
    where = describe_message(message, "ContinentalDetectionList")
    flags = ("invalid_distance", "invalid_azimuth", "invalid_elevation", "invalid_range_rate")
    if not isinstance(message.detections, Iterable):
        raise OgmError(f"{where} must have a list of detections, got {type(message.detections).__name__}")
    valid = [row for row in message.detections if not any(getattr(row, flag, False) for flag in flags)]
    rows = [
        (row.range, row.azimuth_angle, getattr(row, "elevation_angle", 0.0), row.range_rate, row.rcs) for row in valid
    ]
    return _scan(message, "ContinentalDetectionList", rows, ("doppler", "rcs"))


def _scan(message: Any, kind: str, rows: Sequence[Sequence[Any]], others: Sequence[str]) -> Scan:
    """Return the scan of detections with range, azimuth, elevation, and the columns named `others`."""
    where = describe_message(message, kind)
    with error_context(f"{where} has detections that are no numbers", TypeError, ValueError, OverflowError):
        columns = np.array(rows, np.float64).reshape(-1, 3 + len(others)).T
    distance, azimuth, elevation = columns[:3]
    flat = distance * np.cos(elevation)
    xyz = flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)
    table = Table(kind, dict(zip(("x", "y", "z", *others), (*xyz, *columns[3:]), strict=True)))
    return scan_from_table(table, where, stamp=stamp_seconds(message.header.stamp))[0]


def _namespace(value: Any, levels: int = 4) -> Any:
    """Return nested mappings as objects, up to the depth of the messages."""
    if levels and isinstance(value, Mapping):
        return SimpleNamespace(**{str(key): _namespace(inner, levels - 1) for key, inner in value.items()})
    return [_namespace(inner, levels - 1) for inner in value] if levels and isinstance(value, list) else value
