"""One sweep of a lidar, and what there is to tell about it."""

from typing import NamedTuple

import numpy as np

from ogm.scan import Scan

__all__ = ["FileFacts", "describe", "estimate_sensor_height"]

_SQUARES = 30  # square metres that must agree before the height of the sensor is told from them


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


def describe(scan: Scan, file: FileFacts) -> dict[str, str]:
    """Tell what a scan holds, as names and values to print.

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
    height = estimate_sensor_height(scan.points)
    if height is not None:
        facts["ground"] = f"about {height:.2f} m below the origin"
    return facts


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
        [m], positive where the ground lies below the origin. None where there is no plane to see: where fewer
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
