"""Readers of scans: any supported file to points in metres, x forward, y left, z up."""

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
    """Read the points of a scan.

    Parameters
    ----------
    path, axes
        See `read_scan`, which also lists formats, defaults and errors.
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
    """Read one scan, with all per-point data of the file.

    The file name gives the format: ``.bin`` (KITTI), ``.pcd.bin`` (nuScenes), ``.pcd``, ``.ply``, ``.feather``
    (Argoverse 2), ``.las``, ``.laz`` and ``.npy``, each also packed as ``.xz`` or ``.gz``. Fields are recognised by
    name, ignoring case and the prefix ``scalar_`` of CloudCompare.

    Rows without a point (x, y or z NaN or infinite, or all three 0 for "no return") are dropped, counted and
    logged. All other rows are kept, including points of the ego vehicle and far below the ground: the inverse sensor
    model decides about them. A file without points gives (0, 4). Points beyond 100 km are dropped too; if most points
    lie so far, the file is in map coordinates, which is an error.

    Other invalid values drop no point, because a dropped wall would become free space. A NaN or infinite intensity
    becomes 0. A time that is NaN, infinite or far from the others is interpolated between the neighbouring rows. If any
    ring is no integer from 0 to 65535, or the times fit no sweep, the whole column is left out (None). All of this is
    logged, once per drive.

    Parameters
    ----------
    path : path
    axes : str, 3 str or (3, 3) array
        Axes of the file: a name from `AXES`; the file's axes that point forward, left and up, such as
        ``("+y", "-x", "+z")``; or the rotation from the file's axes to forward, left, up. The default, ``"flu"``,
        changes only files of nuScenes, which have the known axes ``"nuscenes"``.
    intensity_max : float or (float, float), optional
        Intensity of the file that becomes 1, or a pair that becomes 0 and 1; values beyond are clipped. The default is
        defined by the format: 1 in KITTI, 255 in nuScenes, 255 or 65535 for unsigned 8-bit or 16-bit integers
        (Argoverse, PLY, LAS). For other formats, or if more than 1 % are larger, it is the smallest of 1, 255 and
        65535 that covers 99 % of the intensities, or else their 99 % quantile. If most intensities are negative they
        are decibels, and the range of the middle 98 % is used. Guesses are logged; the scans of a drive share one
        range, see `ogm.datasets.recording.Recording.intensities`. `read_scan_file` returns the value used.
    origin : 3 float
        Position of the sensor in the file's coordinates [m], for files in map coordinates (UTM), which float32 cannot
        hold. It is subtracted first.
    time_unit : float, optional
        Unit of the file's times [s]: 1e-9 for nanoseconds, 1e-6 for microseconds. Default: nanoseconds for integers,
        seconds for floats. If the times then last longer than 10 s, their unit is s, ms, us or ns such that they last
        2 ms to 2 s; if none fits, they are left out.

    Returns
    -------
    Scan
        If the earliest time is beyond 10 s, the times belong to a clock: `Scan.stamp` is then the earliest, and
        `Scan.time` counts from it. Otherwise `Scan.time` is the file's time, and `Scan.stamp` the number at the end of
        the file name if it has 16 digits (microseconds, as in nuScenes) or 18 or 19 (nanoseconds, as in Argoverse).
        `Scan.no_returns` is computed for organised clouds with the raster of a spinning lidar.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If the file does not match its name, is damaged, or has implausible numbers.
    ValueError
        If `axes`, `intensity_max`, `origin` or `time_unit` is invalid.
    ImportError
        If the format needs a missing package of the ``io`` extra.
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
    """Read one scan like `read_scan`, and return it with further facts about the file."""
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
    """Read the columns of a scan without conversion; errors: see `read_scan`."""
    data, inner = read_bytes(path)
    return parse(data, inner)


def describe(scan: Scan, file: FileFacts) -> dict[str, str]:
    """Return the content of a scan, as names and values to print.

    Parameters
    ----------
    scan : Scan
        One sweep.
    file : FileFacts
        Facts about its file.

    Returns
    -------
    dict of str to str
        Entries in printing order; missing data is left out.
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
