"""Directions of beams without a return, from the raster of an organised cloud."""

import numpy as np

__all__ = ["directions_without_return"]

_PER_ROW, _PER_COLUMN = 8, 2  # returns at least, before the angle of a row or a column is believed
_TOLERANCE = np.radians(1.0)  # [rad] within which 9 of 10 returns must lie on the raster


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
        more lies over 1 degree off its row's elevation or its column's azimuth.
    """
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

    elevation = _median(np.arctan2(z, np.hypot(x, y)), returned)
    # The azimuth of the columns, the rows' offset from it, the columns' again without that offset, and so on.
    azimuth = np.arctan2(y, x)
    offset = np.zeros((len(azimuth), 1))
    for _ in range(4):
        around = np.where(returned, np.exp(1j * (azimuth - offset)), 0)
        column = np.angle(around.sum(axis=0, keepdims=True))
        offset = _median(_wrap(azimuth - column), returned)
    residual = np.hypot(np.arctan2(z, np.hypot(x, y)) - elevation, _wrap(azimuth - column - offset))
    if np.quantile(residual[returned], 0.9) > _TOLERANCE:
        return None

    elevation, azimuth = (angle[~returned] for angle in np.broadcast_arrays(elevation, column + offset))
    directions = (np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation))
    return np.stack(directions, axis=1).astype(np.float32)


def _median(angle: np.ndarray, returned: np.ndarray) -> np.ndarray:
    """Take the median of each row over its returns; as `numpy.nanmedian`, but three times as fast."""
    number = np.count_nonzero(returned, axis=1)[:, None]
    ordered = np.sort(np.where(returned, angle, np.inf), axis=1)
    low, high = (np.take_along_axis(ordered, at, axis=1) for at in ((number - 1) // 2, number // 2))
    return (low + high) / 2


def _wrap(angle: np.ndarray) -> np.ndarray:
    """Angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
