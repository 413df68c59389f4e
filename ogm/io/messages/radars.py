"""Radars: ``radar_msgs/RadarScan`` and Continental's detections. ``PointCloud2`` has a converter of its own."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from ogm.io.formats.table import Table
from ogm.io.messages.plain import describe_message, reads_message, stamp_seconds
from ogm.io.scan_table import scan_from_table
from ogm.scan import Scan
from ogm.storage.files import OgmError, error_context

_FIELDS = ("range", "azimuth", "elevation", "doppler_velocity")


@reads_message
def scan_from_radar_scan(message: Any) -> Scan:
    """Return the scan of a ``radar_msgs/RadarScan``.

    Parameters
    ----------
    message : object
        With the fields of the message: azimuth counts to the left of the sensor's x axis, elevation upwards [rad].

    Returns
    -------
    Scan
        `Scan.doppler` is ``doppler_velocity`` as it stands: the message does not define its sign, ours is positive away
        from the sensor. Intensities are 0: the message's amplitude has no common unit. `Scan.rcs`, which marks scans
        of radars, is NaN: the message has no cross sections.

    Raises
    ------
    OgmError
        If it is no such message, or numbers are of no scan.
    """
    rows = [[getattr(one, name) for name in _FIELDS] for one in message.returns]
    scan = _scan(message, "RadarScan", rows, ("doppler",))
    return replace(scan, rcs=np.full(len(scan), np.float32(np.nan)))


@reads_message
def scan_from_continental(message: Any) -> Scan:
    """Return the scan of a detection list of a Continental ARS548 or SRR520, as TIER IV's nebula driver sends it.

    Parameters
    ----------
    message : object or mapping
        A ``continental_msgs/ContinentalArs548DetectionList`` or ``ContinentalSrr520DetectionList``, or its fields, as
        ``ros2 topic echo`` prints them. Of an SRR520, azimuth counts to the left, too, and there is no elevation.

    Returns
    -------
    Scan
        Detections that the sensor flags as invalid are left out. `Scan.doppler` is the range rate.

    Raises
    ------
    OgmError
        If it is no such message, or numbers are of no scan.
    """
    message = _namespace(message)
    where = describe_message(message, "ContinentalDetectionList")
    flags = ("invalid_distance", "invalid_azimuth", "invalid_elevation", "invalid_range_rate")
    if not isinstance(message.detections, Iterable):
        raise OgmError(f"{where} must have a list of detections, got {type(message.detections).__name__}")
    valid = [one for one in message.detections if not any(getattr(one, flag, False) for flag in flags)]
    rows = [
        (one.range, one.azimuth_angle, getattr(one, "elevation_angle", 0.0), one.range_rate, one.rcs) for one in valid
    ]
    return _scan(message, "ContinentalDetectionList", rows, ("doppler", "rcs"))


def _scan(message: Any, kind: str, rows: Sequence[Sequence[Any]], others: Sequence[str]) -> Scan:
    """Return the scan of detections: range, azimuth and elevation of each, and other columns by their names."""
    where = describe_message(message, kind)
    with error_context(f"{where} has detections that are no numbers", TypeError, ValueError, OverflowError):
        columns = np.array(rows, np.float64).reshape(-1, 3 + len(others)).T
    distance, azimuth, elevation = columns[:3]
    flat = distance * np.cos(elevation)
    xyz = flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)
    table = Table(kind, dict(zip(("x", "y", "z", *others), (*xyz, *columns[3:]), strict=True)))
    return scan_from_table(table, where, stamp=stamp_seconds(message.header.stamp))[0]


def _namespace(value: Any, levels: int = 4) -> Any:
    """Return nested mappings as objects, as deep as the messages are."""
    if levels and isinstance(value, Mapping):
        return SimpleNamespace(**{str(key): _namespace(one, levels - 1) for key, one in value.items()})
    return [_namespace(one, levels - 1) for one in value] if levels and isinstance(value, list) else value
