"""Conversion of named columns to a scan: metres, x forward, y left, z up, and beams without return."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.io.columns import (
    IntensityRange,
    IntensityScale,
    check_rings,
    intensity_range,
    scale_intensities,
    split_times,
    times_from_stamp,
    unknown_as_nan,
)
from ogm.io.formats.table import DOPPLER, INTENSITY, POSITION, RCS, RING, TIME, Table, plain
from ogm.io.labels import REACH
from ogm.io.notices import notice
from ogm.pose import rotate
from ogm.scan import Scan
from ogm.storage.files import OgmError

AXES: dict[str, tuple[str, str, str]] = {
    "flu": ("+x", "+y", "+z"),  # forward, left, up: REP 103
    "ros": ("+x", "+y", "+z"),
    "kitti": ("+x", "+y", "+z"),  # the lidar's frame
    "argoverse": ("+x", "+y", "+z"),  # the vehicle's frame: origin behind and below the sensors
    "nuscenes": ("+y", "-x", "+z"),  # the frame of LIDAR_TOP
    "sustech": ("-y", "+x", "+z"),  # the example of SUSTechPOINTS
}
"""Axes of a file that point forward, left and up, by name."""

Axes = str | Sequence[str] | np.ndarray

_WAYS = {"+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0), "+z": (0, 0, 1), "-z": (0, 0, -1)}
_WAY_OUT = f'give {", ".join(AXES)}, or the axes that point forward, left, up, such as ("+y", "-x", "+z")'


def rotation_to_flu(axes: Axes) -> np.ndarray:
    """Return the rotation from a file's axes to forward, left, up.

    Parameters
    ----------
    axes : str, 3 str or (3, 3) array
        A name from `AXES`, three signed axes, or the matrix itself.

    Returns
    -------
    rotation : (3, 3) float64
        Proper rotation, never a reflection.
    """
    if isinstance(axes, str):
        if axes not in AXES:
            raise ValueError(f"axes {axes!r} are not known: {_WAY_OUT}")
        axes = AXES[axes]
    if not isinstance(axes, Sequence | np.ndarray):
        raise ValueError(f"axes must be a name, three signed axes or a (3, 3) matrix, got {axes!r}: {_WAY_OUT}")
    if all(isinstance(axis, str) for axis in axes):
        if not set(axes) <= _WAYS.keys():
            raise ValueError(f"axes {tuple(axes)} are not three of {', '.join(_WAYS)}: {_WAY_OUT}")
        axes = np.array([_WAYS[axis] for axis in axes])
    try:
        rotation = np.asarray(axes, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"axes {axes!r} are no (3, 3) matrix of numbers: {_WAY_OUT}") from error
    if rotation.shape != (3, 3) or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6):
        raise ValueError(f"axes must be orthogonal unit vectors, got {rotation.tolist()}: {_WAY_OUT}")
    if np.linalg.det(rotation) < 0:
        raise ValueError(f"axes must be right-handed, got the reflection {rotation.tolist()}: {_WAY_OUT}")
    return rotation


def axes_text(rotation: NDArray[np.float64]) -> str:
    """Return a rotation by quarter turns as axes of the command line, such as ``+y,-x,+z``; see `rotation_to_flu`."""
    return ",".join(("-" if row.sum() < 0 else "+") + "xyz"[np.abs(row).argmax()] for row in rotation)


log: logging.Logger = logging.getLogger(__name__)

_BLOCK = 2**18  # rows converted at a time
_MISREAD = 0.05  # share of negative intensities, or of absurd coordinates, above which rows are read wrongly
_NO_MAP = 1e9  # [m] farther than any map coordinates


class FileFacts(NamedTuple):
    """Facts about the file of a scan.

    Attributes
    ----------
    dropped : int
        Rows without a point: x, y or z NaN, infinite or absurdly far, or (0, 0, 0).
    intensity_max : float or None
        Intensity of the file that became 1; None without intensities.
    format : str
        Name of the file format.
    fields : tuple of str
        Names of all fields per point.
    shape : (rows, columns) or None
        Raster of an organised file; None for a list of points.
    """

    dropped: int = 0
    intensity_max: float | None = None
    format: str = ""
    fields: tuple[str, ...] = ()
    shape: tuple[int, int] | None = None


def scan_from_table(
    table: Table,
    where: Path | str,
    axes: Axes = "flu",
    *,
    origin: NDArray[np.float64] | None = None,
    intensity_max: IntensityScale | None = None,
    time_unit: float | None = None,
    stamp: float | None = None,
) -> tuple[Scan, FileFacts]:
    """Return the scan and file facts of a table of columns.

    Parameters
    ----------
    table : Table
        Columns of a file or a message.
    where : Path or str
        Name for errors; without `stamp`, a file name, which may contain the stamp.
    axes, origin, intensity_max, time_unit
        See `read_scan`.
    stamp : float, optional
        Stamp of a message [s], the origin of its times, see `ogm.io.columns.times_from_stamp`.
    """
    rotation = rotation_to_flu(axes)
    check_scales(intensity_max, time_unit)
    fields = table.fields or tuple(table.columns)
    columns = _by_meaning(table)
    if not columns.keys() >= set(POSITION):
        raise OgmError(f"{where} has the fields {', '.join(fields) or 'none'}, wanted x, y, z among them")

    # Points are the rows with a finite position and a distance above 0; other columns are ignored.
    # Their coordinates become x forward, y left, z up.
    xyz, returned, reach = _positions([columns[name] for name in POSITION], rotation, origin)
    there = returned
    if reach > REACH:
        there = returned & (np.abs(xyz) <= REACH).all(axis=0)
        _check_far(table, int(np.count_nonzero(returned)), int(np.count_nonzero(there)), reach, where)
    kept: np.ndarray | slice = slice(None)
    if dropped := there.size - int(np.count_nonzero(there)):
        kept = there
        text = "%s: %d of %d rows hold no point and are dropped"
        notice(log, "rows without a point", text, where, dropped, there.size, level=logging.INFO)
    no_returns = None
    if table.shape is not None:  # a beam with an absurd range had an echo
        x, y, z = np.where(there, xyz, 0).reshape(3, *table.shape)
        no_returns = directions_without_return(x, y, z, there.reshape(table.shape), returned.reshape(table.shape))
    points = np.zeros((there.size - dropped, 4), np.float32)
    for axis in range(3):
        points[:, axis] = xyz[axis, kept]
    del xyz

    # Other measured columns.
    def known(names: tuple[str, ...]) -> NDArray[Any] | None:
        """Return the first existing column in native byte order, for the kept rows."""
        found = next((columns[name] for name in names if name in columns), None)
        return None if found is None else _native(found[kept])

    scale, intensity = None, _intensities(table, columns)
    if intensity is not None:
        intensity = _native(intensity[kept])
        if intensity_max is None or callable(intensity_max):
            _check_order(table, intensity, where)
        points[:, 3], scale = scale_intensities(intensity, intensity_max, table.intensity_max, where)
    if stamp is None:
        time, stamp = split_times(known(TIME), time_unit, Path(where))
    else:
        time, stamp = times_from_stamp(known(TIME), time_unit, str(where), stamp)
    scan = Scan(
        points,
        stamp=stamp,
        time=time,
        ring=check_rings(known(RING), where),
        no_returns=no_returns,
        doppler=unknown_as_nan(known(DOPPLER), "Doppler velocities", where),
        rcs=unknown_as_nan(known(RCS), "radar cross sections", where),
    )
    return scan, FileFacts(dropped, scale, table.format, fields, table.shape)


def _native(column: NDArray[Any]) -> NDArray[Any]:
    """Return a column in native byte order."""
    return np.ascontiguousarray(column, column.dtype.newbyteorder("="))


def _by_meaning(table: Table) -> dict[str, NDArray[Any]]:
    """Return the columns by the spelling of `plain`; duplicates, which are logged elsewhere, are dropped."""
    columns: dict[str, NDArray[Any]] = {}
    for name, column in table.columns.items():
        columns.setdefault(plain(name), column)
    return columns


def _check_far(table: Table, points: int, near: int, reach: float, where: Path | str) -> None:
    """Log absurdly far points, or raise if they are too many: the coordinates are then not the sensor's."""
    if table.headerless and points - near > _MISREAD * points and reach > _NO_MAP:
        raise OgmError(
            f"{where} has coordinates up to {reach:.3g} m, wanted rows of {len(table.columns)} float32 "
            f"({table.format}): numbers of another type, such as float64, must be converted"
        )
    if 2 * near > points:
        text = "%s: %d of %d points are farther than %g m, up to %.3g m, and dropped"
        notice(log, "far points", text, where, points - near, points, REACH, reach)
        return
    raise OgmError(
        f"{where} has coordinates up to {reach:.3g} m, wanted at most {REACH:g} m from the sensor: for map coordinates "
        "give the sensor's position as `origin`; otherwise the file is damaged or wrongly named"
    )


def _intensities(table: Table, columns: dict[str, NDArray[Any]]) -> NDArray[Any] | None:
    """Return the first intensity column that is not mostly negative, else the first."""
    found = [columns[name] for name in INTENSITY if name in columns]
    if len(found) < 2:
        return found[0] if found else None
    return next((column for column in found if 2 * np.count_nonzero(column < 0) <= column.size), found[0])


def stated_range(table: Table) -> IntensityRange | None:
    """Return the intensities of a scan that become 0 and 1; None without any, or if defined by their type.

    Parameters
    ----------
    table : Table
        Columns of a file or a message.
    """
    raw = _intensities(table, _by_meaning(table))
    if raw is None or raw.dtype.newbyteorder("=") in (np.uint8, np.uint16):
        return None
    return intensity_range(raw, table.intensity_max)


def _check_order(table: Table, raw: NDArray[Any], where: Path | str) -> None:
    """Raise if rows without field names seem to have another number of values, which would corrupt x, y and z."""
    if table.headerless and np.count_nonzero(raw < 0) > _MISREAD * raw.size:
        raise OgmError(
            f"{where} has intensities down to {raw.min():.3g}, wanted none below 0 in rows of {len(table.columns)} "
            f"float32 ({table.format}): for rows of four values name it .bin (KITTI), for five .pcd.bin (nuScenes), "
            'for three numpy.save("scan.npy", numpy.fromfile(NAME, "f4").reshape(-1, 3)); if negative intensities '
            "are correct, give intensity_max"
        )


def _positions(
    columns: list[NDArray[Any]], rotation: NDArray[np.float64], origin: NDArray[np.float64] | None
) -> tuple[NDArray[np.float32], NDArray[np.bool_], float]:
    """Return x, y, z (3, N) in axes forward, left, up, the mask of rows with a point, and the largest coordinate [m].

    Rows without a point hold 0 or arbitrary numbers. Conversions other than of the type are done in float64, in blocks
    of `_BLOCK` rows to limit memory.
    """
    turned = not np.array_equal(rotation, np.eye(3))
    short = origin is None and not turned and all(c.dtype.newbyteorder("=") == np.float32 for c in columns)
    xyz, returned = np.empty((3, len(columns[0])), np.float32), np.empty(len(columns[0]), np.bool_)
    reach = 0.0
    for start in range(0, len(returned), _BLOCK):
        part = slice(start, start + _BLOCK)
        block = np.empty((3, len(returned[part])), np.float32 if short else np.float64)
        with np.errstate(invalid="ignore", over="ignore"):  # signalling NaN become NaN; infinite reach is refused
            for row, column in zip(block, columns, strict=True):
                row[:] = column[part]
            there = np.any(block != 0, axis=0) & np.isfinite(block).all(axis=0)
            if not there.all():
                block[:, ~there] = 0.0
            if origin is not None:
                block -= origin[:, None] * there
            if turned:
                block = rotate(rotation, block)
            reach = max(reach, float(block.max(initial=0.0)), -float(block.min(initial=0.0)))
            xyz[:, part], returned[part] = block, there
    return xyz, returned, reach


def check_scales(intensity_max: IntensityScale | None, time_unit: float | None) -> None:
    """Raise ValueError for an invalid `intensity_max` or `time_unit`."""
    if isinstance(intensity_max, tuple):
        if not -np.inf < intensity_max[0] < intensity_max[1] < np.inf:
            raise ValueError(f"intensity_max must be two increasing numbers, for 0 and 1, got {intensity_max}")
    elif isinstance(intensity_max, int | float) and not 0.0 < intensity_max < np.inf:
        raise ValueError(f"intensity_max must be above 0, got {intensity_max!r}")
    if time_unit is not None and not 0.0 < time_unit < np.inf:
        raise ValueError(f"time_unit must be above 0 [s], such as 1e-9 for nanoseconds, got {time_unit!r}")


_MAX_CELLS = 2**20  # of a raster, as many as a lidar of 512 lasers has; the search takes 100 bytes per cell
_PER_ROW, _PER_COLUMN = 8, 2  # least returns for the angle of a row or a column
_TOLERANCE = np.radians(1.0)  # [rad] within which 9 of 10 returns must lie on the raster
_STEP = 8  # the rows' offsets are computed from every 8th column if these have enough returns


def directions_without_return(
    x: np.ndarray, y: np.ndarray, z: np.ndarray, returned: np.ndarray, echoed: np.ndarray | None = None
) -> np.ndarray | None:
    """Return the directions of the beams without a return.

    A spinning lidar's raster has one elevation per row and one azimuth per column, and on some sensors an azimuth
    offset per row. All three are estimated from the returns. Rows with fewer than 8 returns and columns with fewer
    than 2 give no angle, so their beams without return are left out.

    Parameters
    ----------
    x, y, z : (rows, columns) float
        Points relative to the sensor, forward, left, up [m].
    returned : (rows, columns) bool
        Mask of points.
    echoed : (rows, columns) bool, optional
        Mask of echoes; by default `returned`.

    Returns
    -------
    directions : (M, 3) float32 or None
        Unit vectors. None if the raster is no spinning lidar's, seen from the origin: if 1 of 10 returns or more lies
        over 1 degree off its row's elevation or its column's azimuth; or if it has more than 2**20 cells.
    """
    if returned.size > _MAX_CELLS:
        return None
    echoed = returned if echoed is None else echoed
    if returned.shape[0] > returned.shape[1]:  # some drivers write one column of lasers after the other
        x, y, z, returned, echoed = x.T, y.T, z.T, returned.T, echoed.T
    while True:
        rows = np.count_nonzero(returned, axis=1) >= _PER_ROW
        columns = np.count_nonzero(returned, axis=0) >= _PER_COLUMN
        if rows.all() and columns.all():
            break
        x, y, z, returned, echoed = (image[rows][:, columns] for image in (x, y, z, returned, echoed))
    if min(returned.shape) < 2:
        return None

    # Horizontal directions as unit complex numbers: a rotation is a product.
    x, y, z = (np.ascontiguousarray(image, np.float32) for image in (x, y, z))
    distance = np.hypot(x, y)
    elevations = np.arctan2(z, distance)
    elevation = _median(elevations, returned)
    with np.errstate(invalid="ignore", divide="ignore"):
        ways = np.where(returned & (distance > 0), (x + 1j * y) / distance, 0)

    # Alternate between the azimuth of the columns and the rows' offset from it.
    enough = np.count_nonzero(returned[:, ::_STEP], axis=1) >= _PER_ROW
    some = np.s_[:, :: _STEP if enough.all() else 1]
    offset = np.ones((len(ways), 1), ways.dtype)
    for _ in range(4):
        column = _unit((ways[some] * offset.conj()).sum(axis=0, keepdims=True))
        offset = _median(np.angle(ways[some] * column.conj()), returned[some])
        offset = np.cos(offset) + 1j * np.sin(offset)
    azimuth = offset * _unit((ways * offset.conj()).sum(axis=0, keepdims=True))
    residual = np.hypot(elevations - elevation, np.angle(ways * azimuth.conj()))
    if np.quantile(residual[returned], 0.9) > _TOLERANCE:
        return None

    elevation, azimuth = np.broadcast_to(elevation, returned.shape)[~echoed], azimuth[~echoed]
    level = np.cos(elevation)
    return np.stack((level * azimuth.real, level * azimuth.imag, np.sin(elevation)), axis=1).astype(np.float32)


def _median(angle: np.ndarray, returned: np.ndarray) -> np.ndarray:
    """Return the median of each row over its returns; like `numpy.nanmedian`, but three times as fast."""
    number = np.count_nonzero(returned, axis=1)[:, None]
    ordered = np.sort(np.where(returned, angle, angle.dtype.type(np.inf)), axis=1)
    low, high = (np.take_along_axis(ordered, at, axis=1) for at in ((number - 1) // 2, number // 2))
    return np.asarray((low + high) / 2)


def _unit(way: np.ndarray) -> np.ndarray:
    """Scale complex numbers to length 1; 0, if all directions cancel, becomes 1."""
    length = np.abs(way)
    return np.where(length > 0, way / np.maximum(length, np.finfo(way.real.dtype).tiny), 1)
