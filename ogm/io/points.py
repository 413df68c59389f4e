"""The front door: any supported file to points in metres, x forward, y left, z up."""

import logging
import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ogm.io.axes import Axes, rotation_to_flu
from ogm.io.formats import parse_feather, parse_kitti, parse_las, parse_npy, parse_nuscenes
from ogm.io.pcd import parse_pcd
from ogm.io.ply import parse_ply
from ogm.io.raster import missing_beams
from ogm.io.scan import Scan
from ogm.io.source import Table, read_bytes, refuse_foreign

__all__ = ["read_points", "read_scan"]

log = logging.getLogger(__name__)

_PARSERS = {
    ".pcd.bin": parse_nuscenes,  # before .bin: the first ending that fits is taken
    ".bin": parse_kitti,
    ".pcd": parse_pcd,
    ".ply": parse_ply,
    ".feather": parse_feather,
    ".las": parse_las,
    ".laz": parse_las,
    ".npy": parse_npy,
}
_INTENSITY = ("intensity", "reflectivity", "reflectance", "remission", "i")
_RING = ("ring", "laser_number", "channel", "laser_id", "line")
_TIME = ("time", "timestamp", "time_stamp", "t", "offset_ns", "offset_time", "gps_time")
_REACH = 1e5  # [m] beyond which float32 is coarser than a centimetre, and no lidar sees
_SWEEP = 10.0  # [s] longer than any sweep: times that begin later are a clock's


def read_points(
    path: str | os.PathLike[str],
    axes: Axes = "flu",
    *,
    intensity_max: float | None = None,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
) -> np.ndarray:
    """Read the points of one scan.

    Parameters
    ----------
    path, axes, intensity_max, origin
        As for `read_scan`, where the formats, the defaults and the errors are told too.

    Returns
    -------
    points : (N, 4) float32
        x forward, y left, z up [m], intensity [0, 1].
    """
    return read_scan(path, axes, intensity_max=intensity_max, origin=origin).points


def read_scan(
    path: str | os.PathLike[str],
    axes: Axes = "flu",
    *,
    intensity_max: float | None = None,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
) -> Scan:
    """Read one scan, with everything that the file tells about it.

    The file's name tells its format: ``.bin`` (KITTI), ``.pcd.bin`` (nuScenes), ``.pcd``, ``.ply``,
    ``.feather`` (Argoverse 2), ``.las``, ``.laz`` and ``.npy``, each also packed as ``.xz`` or ``.gz``.

    Rows without a point (NaN, infinite, or 0, 0, 0 for "no return") are dropped, counted and logged. All
    others are kept as they are, those of the own vehicle and those far below the ground too: to tell them
    apart is up to the inverse sensor model. A file of no points gives (0, 4).

    Parameters
    ----------
    path : path
        The file.
    axes : str, 3 str or (3, 3) array
        Which way the file's axes point; this is never guessed. Either a name from `AXES`; or the file's axes
        that point forward, left and up, such as ``("+y", "-x", "+z")``; or the rotation from the file's axes
        to those. The default, ``"flu"``, changes nothing.
    intensity_max : float, optional
        The file's intensity that means 1; larger ones count as 1. By default the format tells: 1 in KITTI,
        255 in nuScenes, 255 or 65535 where intensities are whole numbers of 8 or 16 bits without sign
        (Argoverse, PLY, LAS). Where it does not, intensities up to 1 stay as they are, up to 255 are divided
        by 255, and larger ones are an error. `Scan.intensity_max` says what was taken.
    origin : 3 float
        Where the sensor stands in the file's coordinates [m], for files in map coordinates (UTM), which
        float32 cannot hold. It is subtracted first.

    Returns
    -------
    Scan
        Whole numbers of time count as nanoseconds, others as seconds. If the earliest time is beyond 10 s,
        the times are a clock's: `Scan.stamp` is then the earliest, and `Scan.time` counts from it.
        Otherwise `Scan.time` is as in the file, and `Scan.stamp` the number at the end of the file's name if
        that has 16 digits (microseconds, as in nuScenes) or 18 or 19 (nanoseconds, as in Argoverse).
        `Scan.missing` is told from organised clouds whose raster is a spinning lidar's.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is not what its name says, is damaged, or has numbers that no scan has; or if `axes`,
        `intensity_max` or `origin` make no sense.
    ImportError
        If the format needs a package of the ``io`` extra that is not there.
    """
    rotation, shift = rotation_to_flu(axes), np.asarray(origin, dtype=np.float64)
    if shift.shape != (3,) or not np.isfinite(shift).all():
        raise ValueError(f"origin must be x, y, z [m], got {origin!r}")
    if intensity_max is not None and not 0.0 < intensity_max < np.inf:
        raise ValueError(f"intensity_max must be above 0, got {intensity_max!r}")
    data, inner = read_bytes(path)
    suffix = _suffix(inner)
    refuse_foreign(data, inner, suffix)
    table = _PARSERS[suffix](data, inner)
    if suffix == ".pcd.bin" and np.array_equal(rotation, np.eye(3)):
        log.warning('%s: nuScenes files have x right and y forward; axes="nuscenes" turns them', path)

    # Which rows are points? Those with finite numbers and a distance.
    xyz = _coordinates(table, inner)
    intensity, ring, time = (_first(table, names) for names in (_INTENSITY, _RING, _TIME))
    returned = np.any(xyz != 0, axis=0)
    for column in (*xyz, intensity, ring, time):
        if column is not None:
            returned &= np.isfinite(column)
    kept: np.ndarray | slice = slice(None)
    dropped = returned.size - int(np.count_nonzero(returned))
    if dropped:
        kept = returned
        log.info("%s: %d of %d rows hold no point and are dropped", path, dropped, returned.size)

    # From the file's coordinates to the house's.
    xyz[:, ~returned] = 0.0
    xyz = rotation @ (xyz - shift[:, None])
    missing = None
    if table.shape is not None:
        x, y, z = xyz.reshape(3, *table.shape)
        missing = missing_beams(x, y, z, returned.reshape(table.shape))
    points = np.zeros((returned.size - dropped, 4), np.float32)
    points[:, :3] = _within_reach(xyz[:, kept], inner).T

    # What else the sensor says.
    scale = None
    if intensity is not None:
        points[:, 3], scale = _scaled(intensity[kept], intensity_max, table.intensity_max, inner)
    ring = None if ring is None else _checked_ring(ring[kept], inner)
    time, stamp = _times(None if time is None else time[kept], inner)
    fields = tuple(table.columns)
    return Scan(points, ring, time, stamp, missing, dropped, scale, table.format, fields, table.shape)


def _suffix(path: Path) -> str:
    for suffix in _PARSERS:
        if path.name.lower().endswith(suffix):
            return suffix
    raise ValueError(
        f"{path} ends in {path.suffix or 'no suffix'}, wanted {', '.join(_PARSERS)}, or one of these "
        "and .xz or .gz: name the file after its format"
    )


def _first(table: Table, names: tuple[str, ...]) -> np.ndarray | None:
    return next((table.columns[name] for name in names if name in table.columns), None)


def _coordinates(table: Table, path: Path) -> np.ndarray:
    """Gather x, y, z as (3, N) float64."""
    if not {"x", "y", "z"} <= table.columns.keys():
        raise ValueError(
            f"{path} has the fields {', '.join(table.columns) or 'none'}, wanted x, y, z among them"
        )
    with np.errstate(invalid="ignore"):  # of signalling NaN, too, only NaN is left
        return np.array([table.columns[name] for name in "xyz"], dtype=np.float64)


def _within_reach(xyz: np.ndarray, path: Path) -> np.ndarray:
    reach = np.abs(xyz).max(initial=0.0)
    if reach > _REACH:
        raise ValueError(
            f"{path} has coordinates up to {reach:.3g} m, wanted at most {_REACH:g} m from the sensor: if "
            "they are map coordinates, give the sensor's place as origin; if not, the file is damaged or "
            "wrongly named"
        )
    return xyz


def _scaled(
    raw: np.ndarray, chosen: float | None, of_format: float | None, path: Path
) -> tuple[np.ndarray, float]:
    """Bring intensities to [0, 1]; return them and the value that became 1."""
    low, high = float(raw.min(initial=0)), float(raw.max(initial=0))
    if low < 0.0:
        raise ValueError(f"{path} has intensities down to {low:g}, wanted none below 0: is its name right?")
    if chosen is not None:
        if high > chosen:
            log.info("%s: %d intensities above %g count as 1", path, np.count_nonzero(raw > chosen), chosen)
        return np.minimum(raw / chosen, 1.0), float(chosen)
    if of_format is not None:
        scale = of_format
    elif raw.dtype in (np.uint8, np.uint16):
        scale = float(np.iinfo(raw.dtype).max)
    else:
        scale = 1.0 if high <= 1.0 else 255.0
    if high > scale:
        raise ValueError(
            f"{path} has intensities up to {high:g}, wanted at most {scale:g}: give as intensity_max the one "
            "that means 1, if the file is what its name says"
        )
    return raw / scale, scale


def _checked_ring(raw: np.ndarray, path: Path) -> np.ndarray:
    ring = np.clip(raw.astype(np.float64), 0, 2**16 - 1).astype(np.uint16)
    if not np.array_equal(ring, raw):
        raise ValueError(
            f"{path} has rings from {raw.min():g} to {raw.max():g}, wanted whole numbers from 0 to 65535: "
            "is its name right?"
        )
    return ring


def _times(raw: np.ndarray | None, path: Path) -> tuple[np.ndarray | None, float | None]:
    """Give the times of the points, counted from the stamp, and the stamp [s]."""
    digits = re.search(r"(?<!\d)(\d{16}|\d{18,19})$", path.name.split(".")[0])
    stamp = None if digits is None else int(digits[1]) * (1e-6 if len(digits[1]) == 16 else 1e-9)
    if raw is None:
        return None, stamp
    time = raw.astype(np.float64) * (1e-9 if raw.dtype.kind in "iu" else 1.0)
    earliest = float(time.min(initial=np.inf))
    if _SWEEP < abs(earliest) < np.inf:
        return time - earliest, earliest
    return time, stamp
