"""Reading scans: any supported file to points in metres, x forward, y left, z up."""

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np

from ogm.io.columns import IntensityScale
from ogm.io.formats import parse
from ogm.io.formats.table import Table
from ogm.io.ground_plane import estimate_sensor_height
from ogm.io.reading import read_bytes
from ogm.io.scan_table import Axes, FileFacts, check_scales, rotation_to_flu, scan_from_table
from ogm.scan import Scan
from ogm.storage.files import FilePath

log: logging.Logger = logging.getLogger(__name__)


def read_points(path: FilePath, axes: Axes = "flu", **options: Any) -> np.ndarray:
    """Read the points of one scan.

    Parameters
    ----------
    path, axes
        As for `read_scan`, which lists the formats, the defaults and the errors.
    **options
        ``intensity_max``, ``origin`` and ``time_unit`` of `read_scan`.

    Returns
    -------
    points : (N, 4) float32
        x forward, y left, z up [m], intensity [0, 1].
    """
    return read_scan(path, axes, **options).points


def read_scan(
    path: FilePath,
    axes: Axes = "flu",
    *,
    intensity_max: IntensityScale | None = None,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    time_unit: float | None = None,
) -> Scan:
    """Read one scan, with everything that the file holds about it.

    The file's name gives its format: ``.bin`` (KITTI), ``.pcd.bin`` (nuScenes), ``.pcd``, ``.ply``,
    ``.feather`` (Argoverse 2), ``.las``, ``.laz`` and ``.npy``, each also packed as ``.xz`` or ``.gz``.

    Rows without a point (x, y or z NaN or infinite, or all three 0 for "no return") are dropped, counted and
    logged. All others are kept as they are, those of the ego vehicle and those far below the ground too: the
    inverse sensor model decides about them. A file of no points gives (0, 4).

    Points beyond 100 km are dropped, too, unless they are most: then the file is in map coordinates.

    What else a row lacks drops no point, for a wall that is dropped is taken for free: an intensity that is
    NaN or infinite becomes 0, counted and logged; a time that is, or that is far from the others, becomes one between
    those of the rows around it; rings of which one is no whole number from 0 to 65535, and times of no sweep, are left
    out altogether (None). All of this is logged, of the scans of a drive once.

    Fields are known by their names, whether in capitals or not, and with or without the ``scalar_`` of
    CloudCompare.

    Parameters
    ----------
    path : path
        The file.
    axes : str, 3 str or (3, 3) array
        Which way the file's axes point. Either a name from `AXES`; or the file's axes
        that point forward, left and up, such as ``("+y", "-x", "+z")``; or the rotation from the file's axes
        to those. The default, ``"flu"``, changes nothing but files of nuScenes, whose axes are known: ``"nuscenes"``.
    intensity_max : float or (float, float), optional
        The file's intensity that means 1, or those that mean 0 and 1; others count as 0 or 1. By default 1 is that of
        the format: 1 in KITTI, 255 in nuScenes, 255 or 65535 where intensities are whole numbers of 8 or 16 bits
        without sign (Argoverse, PLY, LAS). Else, and where more than 1 % are larger, it is the first of 1, 255 and
        65535 that 99 % do not exceed, or what 99 % do not exceed. Where most intensities are negative they are
        decibels, and the range of 98 % of them counts. What is guessed is logged; the scans of a drive have one range,
        see `ogm.datasets.recording.Recording.intensities`. `read_scan_file` returns what was taken.
    origin : 3 float
        Position of the sensor in the file's coordinates [m], for files in map coordinates (UTM), which
        float32 cannot hold. It is subtracted first.
    time_unit : float, optional
        What the file's times count in [s]: 1e-9 for nanoseconds, 1e-6 for microseconds. By default whole
        numbers count nanoseconds, others seconds. If times then last longer than 10 s, they count in s, ms, us or ns,
        whichever makes them last 2 ms to 2 s, or are left out.

    Returns
    -------
    Scan
        If the earliest time is beyond 10 s, the times are a clock's: `Scan.stamp` is then the earliest, and
        `Scan.time` counts from it. Otherwise `Scan.time` is as in the file, and `Scan.stamp` the number at
        the end of the file's name if that has 16 digits (microseconds, as in nuScenes) or 18 or 19
        (nanoseconds, as in Argoverse).
        `Scan.no_returns` is found in organised clouds whose raster is a spinning lidar's.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If the file is not what its name promises, is damaged, or has numbers that no scan has.
    ValueError
        If `axes`, `intensity_max`, `origin` or `time_unit` make no sense.
    ImportError
        If the format needs a package of the ``io`` extra that is not there.
    """
    return read_scan_file(path, axes, intensity_max=intensity_max, origin=origin, time_unit=time_unit)[0]


def read_scan_file(
    path: FilePath,
    axes: Axes = "flu",
    *,
    intensity_max: IntensityScale | None = None,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    time_unit: float | None = None,
) -> tuple[Scan, FileFacts]:
    """Read one scan as `read_scan` does, and return with it what else the file holds."""
    shift = np.asarray(origin, dtype=np.float64)
    if shift.shape != (3,) or not np.isfinite(shift).all():
        raise ValueError(f"origin must be x, y, z [m], got {origin!r}")
    rotation_to_flu(axes)  # refuses wrong axes, before the file is read
    check_scales(intensity_max, time_unit)
    data, inner = read_bytes(path)
    table = parse(data, inner)
    if table.format == "nuScenes" and isinstance(axes, str) and axes == "flu":
        axes = "nuscenes"
    moved = shift if shift.any() else None
    return scan_from_table(table, inner, axes, origin=moved, intensity_max=intensity_max, time_unit=time_unit)


def read_table(path: FilePath) -> Table:
    """Read the columns of a scan as they stand in its file; errors as for `read_scan`."""
    data, inner = read_bytes(path)
    return parse(data, inner)


def describe(scan: Scan, file: FileFacts) -> dict[str, str]:
    """Return what a scan holds, as names and values to print.

    Parameters
    ----------
    scan : Scan
        One sweep.
    file : FileFacts
        Of the file it was read from.

    Returns
    -------
    dict of str to str
        In the order to print; what the file does not have is left out.
    """
    facts = {"format": file.format, "fields": " ".join(file.fields), "points": str(len(scan.points))}
    if file.shape is not None:
        facts["raster"] = f"{file.shape[0]} x {file.shape[1]}"
    if file.dropped:
        facts["dropped"] = f"{file.dropped} rows without a point"
    if scan.no_returns is not None:
        facts["beams without echo"] = str(len(scan.no_returns))
    if scan.max_range is not None:
        facts["greatest range"] = f"{scan.max_range:g} m"
    if len(scan.points):
        for name, column in zip("xyz", scan.points.T, strict=False):
            facts[name] = f"{column.min():.2f} ... {column.max():.2f} m"
        if file.intensity_max is not None:
            low, high = scan.points[:, 3].min(), scan.points[:, 3].max()
            facts["intensity"] = f"{low:.3f} ... {high:.3f} (1 is {file.intensity_max:g} in the file)"
        if scan.ring is not None:
            facts["rings"] = f"{len(np.unique(scan.ring))} ({scan.ring.min()} ... {scan.ring.max()})"
        if scan.time is not None:
            facts["time"] = f"{scan.time.min():.4f} ... {scan.time.max():.4f} s"
    if scan.stamp is not None:
        facts["stamp"] = f"{scan.stamp:.6f} s"
    if (height := estimate_sensor_height(scan.points)) is not None:
        facts["ground"] = f"about {height:.2f} m below the origin"
    return facts
