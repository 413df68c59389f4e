"""Directions of beams without a return, from the raster of an organised cloud."""

import numpy as np

_MOST = 2**20  # cells of a raster; that of a lidar of 512 lasers has as many, and the search takes 100 bytes for each
_PER_ROW, _PER_COLUMN = 8, 2  # returns at least, before the angle of a row or a column is believed
_TOLERANCE = np.radians(1.0)  # [rad] within which 9 of 10 returns must lie on the raster
_STEP = 8  # every 8th column gives the rows' offsets, where it has enough returns


def directions_without_return(x: np.ndarray, y: np.ndarray, z: np.ndarray, returned: np.ndarray) -> np.ndarray | None:
    """Return the directions of the beams without a return.

    A spinning lidar's raster has one elevation per row and one azimuth per column, plus, on some sensors, an
    offset of the azimuth per row. All three are found from the returns. Rows with fewer than 8 returns and
    columns with fewer than 2 give no angle, so their beams without return are left out.

    Parameters
    ----------
    x, y, z : (rows, columns) float
        Points as seen from the sensor, forward, left, up [m].
    returned : (rows, columns) bool
        Where there is a point.

    Returns
    -------
    directions : (M, 3) float32 or None
        Unit vectors. None if the raster is no spinning lidar's, seen from the origin: if 1 of 10 returns or
        more lies over 1 degree off its row's elevation or its column's azimuth; or if it has more than 2**20 cells.
    """
    if returned.size > _MOST:
        return None
    if returned.shape[0] > returned.shape[1]:  # some drivers write a column of lasers after the other
        x, y, z, returned = x.T, y.T, z.T, returned.T
    while True:
        rows = np.count_nonzero(returned, axis=1) >= _PER_ROW
        columns = np.count_nonzero(returned, axis=0) >= _PER_COLUMN
        if rows.all() and columns.all():
            break
        x, y, z, returned = (image[rows][:, columns] for image in (x, y, z, returned))
    if min(returned.shape) < 2:
        return None

    # Directions in the plane as unit complex numbers: a turn is a product.
    x, y, z = (np.ascontiguousarray(image, np.float32) for image in (x, y, z))
    distance = np.hypot(x, y)
    elevations = np.arctan2(z, distance)
    elevation = _median(elevations, returned)
    with np.errstate(invalid="ignore", divide="ignore"):
        ways = np.where(returned & (distance > 0), (x + 1j * y) / distance, 0)

    # The azimuth of the columns, the rows' offset from it, the columns' again without that offset, and so on.
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

    elevation, azimuth = np.broadcast_to(elevation, returned.shape)[~returned], azimuth[~returned]
    level = np.cos(elevation)
    return np.stack((level * azimuth.real, level * azimuth.imag, np.sin(elevation)), axis=1).astype(np.float32)


def _median(angle: np.ndarray, returned: np.ndarray) -> np.ndarray:
    """Take the median of each row over its returns; as `numpy.nanmedian`, but three times as fast."""
    number = np.count_nonzero(returned, axis=1)[:, None]
    ordered = np.sort(np.where(returned, angle, angle.dtype.type(np.inf)), axis=1)
    low, high = (np.take_along_axis(ordered, at, axis=1) for at in ((number - 1) // 2, number // 2))
    return np.asarray((low + high) / 2)


def _unit(way: np.ndarray) -> np.ndarray:
    """Bring complex numbers to length 1; 0, where all directions cancel, becomes 1."""
    length = np.abs(way)
    return np.where(length > 0, way / np.maximum(length, np.finfo(way.real.dtype).tiny), 1)
