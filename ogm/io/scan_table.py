"""From named columns, of a file or a message, to a scan: metres, x forward, y left, z up."""

import logging
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.files import OgmError
from ogm.io.axes import Axes, rotation_to_flu
from ogm.io.columns import check_rings, check_whole, scale_intensities, split_times, times_from_stamp
from ogm.io.formats.table import DOPPLER, INTENSITY, POSITION, RCS, RING, TIME, Table, plain
from ogm.io.labels import REACH
from ogm.io.no_returns import directions_without_return
from ogm.pose import rotate
from ogm.scan import Scan

__all__ = ["FileFacts", "check_scales", "scan_from_table"]

log = logging.getLogger(__name__)


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
    moved = origin is not None or not np.array_equal(rotation, np.eye(3))
    xyz, returned = _positions([columns[name] for name in POSITION], exact=moved)
    kept: np.ndarray | slice = slice(None)
    dropped = returned.size - int(np.count_nonzero(returned))
    if dropped:
        kept = returned
        log.info("%s: %d of %d rows hold no point and are dropped", where, dropped, returned.size)

    # From the file's coordinates to x forward, y left, z up.
    if moved:
        xyz = rotate(rotation, xyz if origin is None else xyz - origin[:, None])
    no_returns = None
    if table.shape is not None:
        x, y, z = xyz.reshape(3, *table.shape)
        no_returns = directions_without_return(x, y, z, returned.reshape(table.shape))
    xyz = xyz[:, kept]
    reach = np.abs(xyz).max(initial=0.0)
    if reach > REACH:
        raise OgmError(
            f"{where} has coordinates up to {reach:.3g} m, wanted at most {REACH:g} m from the sensor: if they are map "
            "coordinates, give the sensor's position as origin; if not, the file is damaged or wrongly named"
        )
    points = np.zeros((returned.size - dropped, 4), np.float32)
    points[:, :3] = xyz.T

    # What else was measured.
    def known(names: tuple[str, ...]) -> NDArray | None:
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


def _positions(columns: list[NDArray], exact: bool) -> tuple[NDArray, NDArray[np.bool_]]:
    """Return x, y, z as (3, N), float64 if `exact` or a column is not float32, 0 where there is no point; and where."""
    short = not exact and all(column.dtype.newbyteorder("=") == np.float32 for column in columns)
    xyz = np.empty((3, len(columns[0])), np.float32 if short else np.float64)
    with np.errstate(invalid="ignore"):  # of signalling NaN, too, only NaN is left
        for row, column in zip(xyz, columns, strict=True):
            row[:] = column
    returned = np.any(xyz != 0, axis=0) & np.isfinite(xyz).all(axis=0)
    if not returned.all():
        xyz[:, ~returned] = 0.0
    return xyz, returned


def check_scales(intensity_max: float | None, time_unit: float | None) -> None:
    """Refuse an `intensity_max` or a `time_unit` that makes no sense."""
    if intensity_max is not None and not 0.0 < intensity_max < np.inf:
        raise ValueError(f"intensity_max must be above 0, got {intensity_max!r}")
    if time_unit is not None and not 0.0 < time_unit < np.inf:
        raise ValueError(f"time_unit must be above 0 [s], such as 1e-9 for nanoseconds, got {time_unit!r}")
