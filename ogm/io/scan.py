"""Reading scans: any supported file to points in metres, x forward, y left, z up; the sensor's height by a scan."""

import logging
from collections.abc import Sequence
from typing import Any

import numpy as np

from ogm.io.formats import parse
from ogm.io.reading import read_bytes
from ogm.io.scan_table import Axes, FileFacts, check_scales, rotation_to_flu, scan_from_table
from ogm.scan import Scan
from ogm.storage.files import FilePath, OgmError

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
    intensity_max: float | None = None,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    time_unit: float | None = None,
) -> Scan:
    """Read one scan, with everything that the file holds about it.

    The file's name gives its format: ``.bin`` (KITTI), ``.pcd.bin`` (nuScenes), ``.pcd``, ``.ply``,
    ``.feather`` (Argoverse 2), ``.las``, ``.laz`` and ``.npy``, each also packed as ``.xz`` or ``.gz``.

    Rows without a point (x, y or z NaN or infinite, or all three 0 for "no return") are dropped, counted and
    logged. All others are kept as they are, those of the ego vehicle and those far below the ground too: the
    inverse sensor model decides about them. A file of no points gives (0, 4).

    What else a row lacks drops no point, for a wall that is dropped is taken for free: an intensity that is
    NaN or infinite becomes 0, counted and logged; rings, or times, of which one is, are left out altogether
    (None), with a warning in the log.

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
    intensity_max : float, optional
        The file's intensity that means 1; larger ones count as 1. By default that of the format: 1 in KITTI,
        255 in nuScenes, 255 or 65535 where intensities are whole numbers of 8 or 16 bits without sign
        (Argoverse, PLY, LAS). Else intensities up to 1 stay as they are, those up to 255 are divided by 255
        (which is logged, for another scan of the same sensor may seem to have another scale), and larger ones
        are an error. `read_scan_file` returns what was taken.
    origin : 3 float
        Position of the sensor in the file's coordinates [m], for files in map coordinates (UTM), which
        float32 cannot hold. It is subtracted first.
    time_unit : float, optional
        What the file's times count in [s]: 1e-9 for nanoseconds, 1e-6 for microseconds. By default whole
        numbers count nanoseconds, others seconds, and times that then last longer than 10 s are an error.

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
    intensity_max: float | None = None,
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


PLAUSIBLE_HEIGHTS = (0.5, 5.0)  # [m] of a sensor above ground: from a small robot's to one on a truck or a mast
_SQUARES = 30  # square metres that must agree before a height is estimated from them


def plausible_sensor_height(height: float, where: object = "the scan") -> float:
    """Return an estimated height of the sensor if it is plausible: 0.5 m to 5 m above ground.

    The origin of clouds in the vehicle frame lies near the ground (about 0.3 m above it in Argoverse 2). A model
    that takes it for the sensor's height starts its rays at the wrong point.

    Parameters
    ----------
    height : float
        From `estimate_sensor_height` [m].
    where : path or str
        What was read, for the error.

    Raises
    ------
    OgmError
        If it lies outside of `PLAUSIBLE_HEIGHTS`.
    """
    low, high = PLAUSIBLE_HEIGHTS
    if not low <= height <= high:
        raise OgmError(
            f"the sensor height of {where} is {height:.2f} m, estimated from points, which is not plausible "
            f"({low:g} to {high:g} m): if the points are in the vehicle frame, give `sensor_position`; "
            "if not, give `sensor_height` and check `axes`"
        )
    return height


def estimate_sensor_height(points: np.ndarray) -> float | None:
    """Estimate how far the ground lies below the origin of the points.

    A plane is laid through the lowest point of every square metre within 10 m, and its height taken at the
    origin. On the real scans that the project is tested with, the result
    lies within 5 cm of the known height. It is a hint, not a calibration.

    Parameters
    ----------
    points : (N, 4) float
        x, y, z [m], intensity.

    Returns
    -------
    height : float or None
        [m], positive where the ground lies below the origin. None where there is no plane: where fewer
        than 30 of the squares, or less than half of them, agree on one.
    """
    near = points[np.hypot(points[:, 0], points[:, 1]) < 10.0, :3].astype(np.float64)
    # The lowest point of every square that has points.
    column = np.floor(near[:, :2]).astype(np.int64) @ np.array([100, 1])
    order = np.lexsort((near[:, 2], column))
    lowest = near[order][np.unique(column[order], return_index=True)[1]]
    if len(lowest) < _SQUARES:
        return None
    # Begin with the commonest height, to 0.1 m, then drop what lies off the plane, ever more strictly.
    layer = np.floor(lowest[:, 2] / 0.1).astype(np.int64)
    count = np.bincount(layer - layer.min())
    plane = np.array([0.0, 0.0, (layer.min() + np.argmax(np.convolve(count, [1, 1, 1], "same")) + 0.5) * 0.1])
    place = np.column_stack([lowest[:, :2], np.ones(len(lowest))])
    for tolerance in (0.3, 0.25, 0.2, 0.15, 0.15):  # [m]
        on_plane = np.abs(lowest[:, 2] - place @ plane) < tolerance
        if np.count_nonzero(on_plane) < max(_SQUARES, len(lowest) / 2):
            return None
        plane = np.linalg.lstsq(place[on_plane], lowest[on_plane, 2], rcond=None)[0]
    return float(-plane[2])
