"""Point clouds: ``sensor_msgs/PointCloud2`` to a scan and back."""

from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.io.axes import Axes
from ogm.io.formats.table import Table, refuse_doubles
from ogm.io.messages.plain import as_bytes, describe_message, header, reads_message, stamp_seconds
from ogm.io.scan_table import scan_from_table
from ogm.scan import Scan
from ogm.storage.files import OgmError

# sensor_msgs/PointField.datatype; from 9 on only in releases of ROS 2 since 2025
_TYPES = dict(enumerate(("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8", "i8", "u8", "u1"), start=1))
_CODES = {np.dtype(np.float32): 7, np.dtype(np.uint16): 4}
_PADDING = ("", "_")


@reads_message
def scan_from_point_cloud2(
    message: Any,
    *,
    axes: Axes = "flu",
    intensity_max: float | None = None,
    time_unit: float | None = None,
    no_returns: bool = True,
) -> Scan:
    """Return the scan of a point cloud message.

    Fields are known by their names, in any order and type, as in files: see `ogm.io.read_scan` for what becomes of
    intensities, rings and rows without a point. ``is_dense`` is not relied upon.

    Parameters
    ----------
    message : object
        With the fields of ``sensor_msgs/PointCloud2``: of rosbags, rclpy, rospy, or of a decoded MCAP.
    axes, intensity_max, time_unit
        As for `ogm.io.read_scan`.
    no_returns : bool
        Whether to find the beams without echo in an organised cloud (``height`` above 1) whose raster is a spinning
        lidar's; that costs more time than all the rest.

    Returns
    -------
    Scan
        `Scan.stamp` is that of the header. `Scan.time` counts from it, whether the message has times of the same clock
        (nearer to the stamp than to 0; they may count s, ms, us or ns), which are before the stamp if that is of the
        sweep's end; or times since the stamp, which are taken as they are; or times of another clock, which count
        from the earliest. Where the header has no stamp (0), the earliest time of a clock becomes the stamp.
        `Scan.doppler` is a field ``doppler``, ``doppler_velocity``, ``radial_velocity``, ``range_rate`` or
        ``velocity`` [m/s], positive away from the sensor as the message has to have it; `Scan.rcs` is ``rcs`` [dBsm].

    Raises
    ------
    OgmError
        If sizes contradict each other, a field lies outside of its point, x, y or z is missing, or numbers are
        of no scan.
    ValueError
        If an option makes no sense.
    """
    where = describe_message(message, "PointCloud2")
    table = Table("PointCloud2", *_columns(message, where))
    if not no_returns:
        table = table._replace(shape=None)
    stamp = stamp_seconds(message.header.stamp)
    return scan_from_table(table, where, axes, intensity_max=intensity_max, time_unit=time_unit, stamp=stamp)[0]


def _columns(message: Any, where: str) -> tuple[dict[str, NDArray[Any]], tuple[int, int] | None]:
    """View every field for all points, and the raster of an organised cloud; of several values, the first."""
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    row_step, data = int(message.row_step), as_bytes(message.data, where)
    if min(height, width, step) < 0 or (height * width and step < 1):
        raise OgmError(f"{where} has height {height}, width {width} and point_step {step}: it is damaged")
    if len(data) == height * width * step:  # some drivers do not set row_step
        row_step = width * step
    elif row_step < width * step or len(data) != height * row_step:
        raise OgmError(
            f"{where} has {len(data)} bytes, wanted {height} rows of {width} points of {step} bytes, or of row_step "
            f"{row_step} bytes: it is cut short or damaged"
        )
    fields = [field for field in message.fields if field.name not in _PADDING]
    refuse_doubles((field.name for field in fields), where)
    order = ">" if message.is_bigendian else "<"
    columns = {}
    for field in fields:
        if int(field.datatype) not in _TYPES:
            raise OgmError(
                f"{where} has datatype {field.datatype} for {field.name}, wanted 1 to {len(_TYPES)}: it is damaged"
            )
        kind = np.dtype(order + _TYPES[int(field.datatype)])
        offset, count = int(field.offset), max(int(field.count), 1)  # old drivers write a count of 0 for 1
        if not height * width:
            columns[field.name] = np.empty(0, kind)
            continue
        if offset < 0 or offset + count * kind.itemsize > step:
            raise OgmError(
                f"{where} has {field.name} at byte {offset}, {count} times {kind.itemsize} bytes, wanted it inside of "
                f"point_step {step}: it is damaged"
            )
        columns[field.name] = np.ndarray((height, width), kind, data, offset, (row_step, step)).reshape(-1)
    if not columns and not height * width:
        columns = {name: np.empty(0, np.float32) for name in "xyz"}
    return columns, (height, width) if height > 1 and width > 1 else None


def point_cloud2(scan: Scan, *, frame_id: str, stamp: float | None = None) -> SimpleNamespace:
    """Return a scan as a ``sensor_msgs/PointCloud2``.

    It has x, y, z and intensity [0, 1] as float32, and where the scan has them: ring (uint16), time since the stamp
    (float32 [s]), doppler [m/s] and rcs [dBsm] (float32). Beams without echo have no place in it.

    Parameters
    ----------
    scan : Scan
    frame_id : str
        Of the sensor.
    stamp : float, optional
        [s]; that of the scan by default, 0 if it has none.

    Returns
    -------
    SimpleNamespace
        With the fields of the message, ``data`` as (bytes,) uint8: rosbags serialises it, `fill_message` copies it
        into a message of rclpy or rospy.
    """
    columns: dict[str, NDArray[Any]] = dict(zip(("x", "y", "z", "intensity"), scan.points.T, strict=True))
    if scan.ring is not None:
        columns["ring"] = scan.ring
    for name in ("time", "doppler", "rcs"):
        if getattr(scan, name) is not None:
            columns[name] = getattr(scan, name).astype(np.float32)
    records = np.empty(
        len(scan), np.dtype([(name, column.dtype.newbyteorder("<")) for name, column in columns.items()])
    )
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
