"""From named columns, of a file or a message, to a scan: metres, x forward, y left, z up."""

import logging
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.io.axes import Axes, rotation_to_flu
from ogm.io.columns import check_rings, check_whole, scale_intensities, split_times, times_from_stamp
from ogm.io.formats.table import DOPPLER, INTENSITY, POSITION, RCS, RING, TIME, Table, plain
from ogm.io.labels import REACH
from ogm.io.no_returns import directions_without_return
from ogm.pose import rotate
from ogm.scan import Scan
from ogm.storage.files import OgmError

log: logging.Logger = logging.getLogger(__name__)

_BLOCK = 2**18  # rows that are converted at a time


class FileFacts(NamedTuple):
    """What a file of a scan holds besides the scan.

    Attributes
    ----------
    dropped : int
        Rows of the file that hold no point: x, y or z NaN or infinite, or (0, 0, 0).
    intensity_max : float or None
        The file's intensity that became 1; None where it has none.
    format : str
        What the file is, in words.
    fields : tuple of str
        What the file holds per point, under its own names.
    shape : (rows, columns) or None
        The raster of an organised file; None for a list of points.
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
    intensity_max: float | None = None,
    time_unit: float | None = None,
    stamp: float | None = None,
) -> tuple[Scan, FileFacts]:
    """Return the scan that columns of numbers hold, and what else there is to know of them.

    Parameters
    ----------
    table : Table
        Of a file or a message.
    where : Path or str
        Its name, for errors; without `stamp`, that of a file, which may hold one.
    axes, origin, intensity_max, time_unit
        As for `read_scan`.
    stamp : float, optional
        Of a message [s]: its times count from there, see `ogm.io.columns.times_from_stamp`.
    """
    rotation = rotation_to_flu(axes)
    check_scales(intensity_max, time_unit)
    fields = table.fields or tuple(table.columns)
    columns = {plain(name): column for name, column in table.columns.items()}
    if not columns.keys() >= set(POSITION):
        raise OgmError(f"{where} has the fields {', '.join(fields) or 'none'}, wanted x, y, z among them")

    # Points are the rows with a finite position and a distance, whatever else they lack.
    # They go from the file's coordinates to x forward, y left, z up.
    xyz, returned, reach = _positions([columns[name] for name in POSITION], rotation, origin)
    kept: np.ndarray | slice = slice(None)
    dropped = returned.size - int(np.count_nonzero(returned))
    if dropped:
        kept = returned
        log.info("%s: %d of %d rows hold no point and are dropped", where, dropped, returned.size)
    if reach > REACH:
        raise OgmError(
            f"{where} has coordinates up to {reach:.3g} m, wanted at most {REACH:g} m from the sensor: if they are map "
            "coordinates, give the sensor's position as origin; if not, the file is damaged or wrongly named"
        )
    no_returns = None
    if table.shape is not None:
        x, y, z = xyz.reshape(3, *table.shape)
        no_returns = directions_without_return(x, y, z, returned.reshape(table.shape))
    points = np.zeros((returned.size - dropped, 4), np.float32)
    for axis in range(3):
        points[:, axis] = xyz[axis, kept]
    del xyz

    # What else was measured.
    def known(names: tuple[str, ...]) -> NDArray[Any] | None:
        """Return the first column that is there, in the machine's order of bytes."""
        found = next((columns[name] for name in names if name in columns), None)
        return None if found is None else np.ascontiguousarray(found[kept], found.dtype.newbyteorder("="))

    scale, intensity = None, known(INTENSITY)
    if intensity is not None:
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
        doppler=check_whole(known(DOPPLER), "Doppler velocities", where),
        rcs=check_whole(known(RCS), "radar cross sections", where),
    )
    return scan, FileFacts(dropped, scale, table.format, fields, table.shape)


def _positions(
    columns: list[NDArray[Any]], rotation: NDArray[np.float64], origin: NDArray[np.float64] | None
) -> tuple[NDArray[np.float32], NDArray[np.bool_], float]:
    """Return x, y, z as (3, N) in our axes, 0 or without meaning where there is no point; where; and their reach [m].

    Computed in float64 where something changes but the type, in blocks of `_BLOCK` rows: the whole would take a
    multiple of the memory of the points.
    """
    turned = not np.array_equal(rotation, np.eye(3))
    short = origin is None and not turned and all(c.dtype.newbyteorder("=") == np.float32 for c in columns)
    xyz, returned = np.empty((3, len(columns[0])), np.float32), np.empty(len(columns[0]), np.bool_)
    reach = 0.0
    for start in range(0, len(returned), _BLOCK):
        part = slice(start, start + _BLOCK)
        block = np.empty((3, len(returned[part])), np.float32 if short else np.float64)
        with np.errstate(invalid="ignore", over="ignore"):  # of signalling NaN only NaN is left; reach is refused
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


def check_scales(intensity_max: float | None, time_unit: float | None) -> None:
    """Refuse an `intensity_max` or a `time_unit` that makes no sense."""
    if intensity_max is not None and not 0.0 < intensity_max < np.inf:
        raise ValueError(f"intensity_max must be above 0, got {intensity_max!r}")
    if time_unit is not None and not 0.0 < time_unit < np.inf:
        raise ValueError(f"time_unit must be above 0 [s], such as 1e-9 for nanoseconds, got {time_unit!r}")
