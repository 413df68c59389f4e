"""The front door: any supported file to points in metres, x forward, y left, z up."""

import logging
import os
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ogm.io.axes import Axes, rotation_to_flu
from ogm.io.feather import parse_feather
from ogm.io.formats import parse_kitti, parse_las, parse_npy, parse_nuscenes
from ogm.io.names import INTENSITY, PLACE, RING, TIME, plain
from ogm.io.pcd import parse_pcd
from ogm.io.ply import parse_ply
from ogm.io.raster import missing_beams
from ogm.io.scan import FileFacts
from ogm.io.source import read_bytes, refuse_foreign
from ogm.scan import Scan

__all__ = ["read_points", "read_scan", "read_scan_file"]

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
_REACH = 1e5  # [m] beyond which float32 is coarser than a centimetre, and no lidar sees
_SWEEP = 10.0  # [s] longer than any sweep: times that begin later are a clock's
_FLASH = 1e-3  # [s] shorter than a sweep


def read_points(
    path: str | os.PathLike[str],
    axes: Axes = "flu",
    *,
    intensity_max: float | None = None,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    time_unit: float | None = None,
) -> np.ndarray:
    """Read the points of one scan.

    Parameters
    ----------
    path, axes, intensity_max, origin, time_unit
        As for `read_scan`, where the formats, the defaults and the errors are told too.

    Returns
    -------
    points : (N, 4) float32
        x forward, y left, z up [m], intensity [0, 1].
    """
    return read_scan(path, axes, intensity_max=intensity_max, origin=origin, time_unit=time_unit).points


def read_scan(
    path: str | os.PathLike[str],
    axes: Axes = "flu",
    *,
    intensity_max: float | None = None,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    time_unit: float | None = None,
) -> Scan:
    """Read one scan, with everything that the file tells about it.

    The file's name tells its format: ``.bin`` (KITTI), ``.pcd.bin`` (nuScenes), ``.pcd``, ``.ply``,
    ``.feather`` (Argoverse 2), ``.las``, ``.laz`` and ``.npy``, each also packed as ``.xz`` or ``.gz``.

    Rows without a point (x, y or z NaN or infinite, or all three 0 for "no return") are dropped, counted and
    logged. All others are kept as they are, those of the own vehicle and those far below the ground too: to
    tell them apart is up to the inverse sensor model. A file of no points gives (0, 4).

    What else a row lacks costs no point, for a wall that is dropped is taken for free: an intensity that is
    NaN or infinite becomes 0, counted and logged; rings, or times, of which one is, are left out altogether
    (None), with a warning in the log.

    Fields are known by their names, whether in capitals or not, and with or without the ``scalar_`` of
    CloudCompare.

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
        by 255 (which is logged, for another scan of the same sensor may seem to have another scale), and
        larger ones are an error. `read_scan_file` tells what was taken.
    origin : 3 float
        Where the sensor stands in the file's coordinates [m], for files in map coordinates (UTM), which
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
        `Scan.no_returns` is told from organised clouds whose raster is a spinning lidar's.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is not what its name says, is damaged, or has numbers that no scan has; or if `axes`,
        `intensity_max`, `origin` or `time_unit` make no sense.
    ImportError
        If the format needs a package of the ``io`` extra that is not there.
    """
    options = {"intensity_max": intensity_max, "origin": origin, "time_unit": time_unit}
    return read_scan_file(path, axes, **options)[0]  # type: ignore[arg-type]


def read_scan_file(
    path: str | os.PathLike[str],
    axes: Axes = "flu",
    *,
    intensity_max: float | None = None,
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    time_unit: float | None = None,
) -> tuple[Scan, FileFacts]:
    """Read one scan as `read_scan` does, and return with it what else the file holds."""
    rotation, shift = rotation_to_flu(axes), np.asarray(origin, dtype=np.float64)
    if shift.shape != (3,) or not np.isfinite(shift).all():
        raise ValueError(f"origin must be x, y, z [m], got {origin!r}")
    if intensity_max is not None and not 0.0 < intensity_max < np.inf:
        raise ValueError(f"intensity_max must be above 0, got {intensity_max!r}")
    if time_unit is not None and not 0.0 < time_unit < np.inf:
        raise ValueError(f"time_unit must be above 0 [s], such as 1e-9 for nanoseconds, got {time_unit!r}")
    data, inner = read_bytes(path)
    suffix = _suffix(inner)
    refuse_foreign(data, inner, suffix)
    table = _PARSERS[suffix](data, inner)
    if suffix == ".pcd.bin" and np.array_equal(rotation, np.eye(3)):
        log.warning('%s: nuScenes files have x right and y forward; axes="nuscenes" turns them', path)

    # Which rows are points? Those with a finite place and a distance; what else they lack is no matter.
    fields = table.fields or tuple(table.columns)
    columns = {plain(name): column for name, column in table.columns.items()}
    xyz = _coordinates(columns, fields, inner)
    returned = np.any(xyz != 0, axis=0) & np.isfinite(xyz).all(axis=0)
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
    intensity, ring, time = (_first(columns, names, kept) for names in (INTENSITY, RING, TIME))
    scale = None
    if intensity is not None:
        intensity = _known_intensity(intensity, inner)
        points[:, 3], scale = _scaled(intensity, intensity_max, table.intensity_max, inner)
    ring = _whole(ring, "rings", inner)
    ring = None if ring is None else _checked_ring(ring, inner)
    time, stamp = _times(_whole(time, "times", inner), time_unit, inner)
    scan = Scan(points, stamp=stamp, time=time, ring=ring, no_returns=missing)
    return scan, FileFacts(dropped, scale, table.format, fields, table.shape)


def _suffix(path: Path) -> str:
    for suffix in _PARSERS:
        if path.name.lower().endswith(suffix):
            return suffix
    raise ValueError(
        f"{path} ends in {path.suffix or 'no suffix'}, wanted {', '.join(_PARSERS)}, or one of these "
        "and .xz or .gz: name the file after its format"
    )


def _first(
    columns: dict[str, np.ndarray], names: tuple[str, ...], kept: np.ndarray | slice
) -> np.ndarray | None:
    return next((columns[name][kept] for name in names if name in columns), None)


def _coordinates(columns: dict[str, np.ndarray], fields: tuple[str, ...], path: Path) -> np.ndarray:
    """Gather x, y, z as (3, N) float64."""
    if not columns.keys() >= set(PLACE):
        raise ValueError(f"{path} has the fields {', '.join(fields) or 'none'}, wanted x, y, z among them")
    with np.errstate(invalid="ignore"):  # of signalling NaN, too, only NaN is left
        return np.array([columns[name] for name in PLACE], dtype=np.float64)


def _known_intensity(raw: np.ndarray, path: Path) -> np.ndarray:
    """Give points of unknown intensity 0: they are points all the same."""
    known = np.isfinite(raw)
    if known.all():
        return raw
    log.info("%s: %d of %d intensities are no number and become 0", path, np.sum(~known), raw.size)
    return np.where(known, raw, 0)


def _whole(raw: np.ndarray | None, what: str, path: Path) -> np.ndarray | None:
    """Leave a column out that is not known of every point: no number could stand for the unknown."""
    if raw is None or np.isfinite(raw).all():
        return raw
    log.warning(
        "%s: %d of %d points have %s that are no number; all %s are left out",
        path, np.count_nonzero(~np.isfinite(raw)), raw.size, what, what,
    )  # fmt: skip
    return None


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
        if 1.0 < high <= scale:
            log.info(
                "%s: intensities up to %g are divided by 255; give intensity_max if they mean something else, "
                "or if those of another scan are not divided",
                path, high,
            )  # fmt: skip
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


def _times(raw: np.ndarray | None, unit: float | None, path: Path) -> tuple[np.ndarray | None, float | None]:
    """Give the times of the points, counted from the stamp, and the stamp [s]."""
    digits = re.search(r"(?<!\d)(\d{16}|\d{18,19})$", path.name.split(".")[0])
    stamp = None if digits is None else int(digits[1]) * (1e-6 if len(digits[1]) == 16 else 1e-9)
    if raw is None or not raw.size:
        return raw if raw is None else raw.astype(np.float64), stamp
    guess = 1e-9 if raw.dtype.kind in "iu" else 1.0
    time = raw.astype(np.float64) * (guess if unit is None else unit)
    earliest, latest = float(time.min()), float(time.max())
    if unit is None and latest - earliest > _SWEEP:
        raise ValueError(
            f"{path} has times that last {latest - earliest:.3g} s if they count in {guess:g} s ({raw.dtype}), "
            f"wanted at most {_SWEEP:g} s for one sweep: give as time_unit [s] what they count in, 1e-9 for "
            "nanoseconds, 1e-6 for microseconds, 1e-3 for milliseconds (1 to take seconds as they are)"
        )
    if unit is None and guess < 1.0 and 0.0 < latest - earliest < _FLASH:
        log.warning(
            "%s: its times last %.3g s if they count nanoseconds; if not, give time_unit (1e-6: microseconds)",
            path, latest - earliest,
        )  # fmt: skip
    if abs(earliest) > _SWEEP:
        return time - earliest, earliest
    return time, stamp
