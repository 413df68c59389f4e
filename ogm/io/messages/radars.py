"""Radars: ``radar_msgs/RadarScan`` to a scan. Radars that send ``PointCloud2`` go through that converter."""

from typing import Any

import numpy as np

from ogm.io.formats.table import Table
from ogm.io.messages.plain import describe_message, reads_message, stamp_seconds
from ogm.io.scan_table import scan_from_table
from ogm.scan import Scan

__all__ = ["scan_from_radar_scan"]

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
        from the sensor. Intensities are 0: the message's amplitude has no common unit.

    Raises
    ------
    OgmError
        If it is no such message, or numbers are of no scan.
    """
    where = describe_message(message, "RadarScan")
    rows = [[getattr(one, name) for name in _FIELDS] for one in message.returns]
    distance, azimuth, elevation, doppler = np.array(rows, np.float64).reshape(-1, 4).T
    flat = distance * np.cos(elevation)
    x, y, z = flat * np.cos(azimuth), flat * np.sin(azimuth), distance * np.sin(elevation)
    table = Table("RadarScan", {"x": x, "y": y, "z": z, "doppler": doppler}, fields=_FIELDS)
    return scan_from_table(table, where, stamp=stamp_seconds(message.header.stamp))[0]
