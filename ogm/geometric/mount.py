"""What both models share: where the sensor sits, which points are its own, work space, checks of numbers."""

import logging
import math
import threading

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.core.frame import own_frame
from ogm.grid import GridSpec
from ogm.scan import Mount

__all__ = ["check_sensor_in_grid", "check_within", "scratch", "to_vehicle_frame"]

KEPT_BYTES = 2**25  # [bytes] a larger work array (clouds of millions of points) is given back after the scan

_log = logging.getLogger(__name__)


def check_sensor_in_grid(spec: GridSpec, mount: Mount) -> Mount:
    """Return the mount of a sensor that stands in the grid, or refuse it."""
    if not isinstance(mount, Mount):
        raise TypeError(f"mount must be an ogm.Mount, got {mount!r}; give Mount(sensor_height=...) [m]")
    x, y, _ = mount.ground_point
    if not spec.contains(x, y):
        raise ValueError(
            f"the sensor at x={x:g}, y={y:g} m lies outside the grid {spec.extent}; "
            "move or enlarge the grid so that it holds the sensor"
        )
    return mount


def to_vehicle_frame(
    points: NDArray[np.float32], mount: Mount, ego_footprint: tuple[float, float, float, float]
) -> NDArray[np.float32]:
    """Take points to the vehicle frame; drop what is not finite, or a return from the ego vehicle."""
    points = np.ascontiguousarray(points)
    rows = scratch("xyz", (3, len(points)), np.float32)
    kept, invalid, own = own_frame(
        points, mount.T_vehicle_points[:3].astype(np.float32), np.array(ego_footprint, np.float32), rows
    )
    if invalid:
        _log.warning("dropped %d of %d points that are NaN, inf or beyond 1000 km", invalid, len(points))
    if own:
        _log.debug("dropped %d of %d points as returns from the ego vehicle", own, len(points))
    return rows[:, :kept].T


def check_within(name: str, value: float, low: float, high: float) -> None:
    """Refuse a parameter outside the open interval (low, high)."""
    if not low < value < high:
        raise ValueError(f"{name} must lie between {low:g} and {high:g}, got {value}")


class Scratch(threading.local):
    """Work space that a thread keeps from scan to scan: fresh pages would cost as much as the ray casting."""

    def __init__(self) -> None:
        self.arrays: dict[str, NDArray] = {}

    def __call__(self, name: str, shape: tuple[int, ...], dtype: type) -> NDArray:
        """Return an array with arbitrary content, valid until the next call with the same name."""
        size = math.prod(shape)
        array = self.arrays.get(name)
        if array is None or array.size < size or array.dtype != dtype:
            array = np.empty(size, dtype)
            if array.nbytes <= KEPT_BYTES:
                self.arrays[name] = array
        return array[:size].reshape(shape)


scratch = Scratch()
