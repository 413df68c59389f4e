"""What both models share: where the sensor sits, which points are its own, work space, checks of numbers."""

import logging
import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ogm.geometric.core.frame import own_frame
from ogm.grid import GridSpec
from ogm.pose import check_pose

__all__ = ["Frame", "Mount", "check_box", "check_within", "mount_sensor", "own_points", "scratch"]

Frame = Literal["sensor", "vehicle"]
KEPT_BYTES = 2**25  # [bytes] a larger work array (clouds of millions of points) is given back after the scan

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Mount:
    """Where the sensor sits, and in which frame its points come."""

    T_vehicle_points: NDArray[np.float32]  # (3, 4)
    origin: NDArray[np.float32]  # (3,) the sensor in the vehicle frame [m]
    foot: tuple[float, float, float]  # the ground under the sensor, in the vehicle frame [m]


def mount_sensor(
    spec: GridSpec, sensor_height: float, T_vehicle_sensor: ArrayLike | None, points_in: Frame
) -> Mount:
    """Check where a sensor sits, and work out what the models need of it."""
    T = np.eye(4) if T_vehicle_sensor is None else check_pose(T_vehicle_sensor, "T_vehicle_sensor")
    if not 0 < sensor_height < 100:
        raise ValueError(f"sensor_height must be above ground and below 100 m, got {sensor_height}")
    if points_in not in ("sensor", "vehicle"):
        raise ValueError(f'points_in must be "sensor" or "vehicle", got {points_in!r}')
    x, y, z = T[:3, 3]
    if not spec.contains(x, y):
        raise ValueError(
            f"the sensor at x={x:g}, y={y:g} m lies outside the grid {spec.extent}; "
            "move or enlarge the grid so that it holds the sensor"
        )
    points_T = (T if points_in == "sensor" else np.eye(4))[:3].astype(np.float32)
    return Mount(points_T, T[:3, 3].astype(np.float32), (x, y, z - sensor_height))


def own_points(
    points: NDArray[np.float32], mount: Mount, own_box: tuple[float, float, float, float]
) -> NDArray[np.float32]:
    """Check the points once, take them to the vehicle frame, drop what is not finite or the vehicle itself."""
    if not isinstance(points, np.ndarray) or points.dtype.kind != "f":
        got = getattr(points, "dtype", type(points).__name__)
        raise TypeError(f"points must be a float array of shape (N, 4) [x, y, z, intensity], got {got}")
    if points.ndim != 2 or points.shape[1] < 3:
        raise ValueError(
            f"points must have shape (N, 4) [x, y, z, intensity] (or at least 3 columns), got {points.shape}"
        )
    points = np.ascontiguousarray(points, np.float32)
    rows = scratch("xyz", (3, len(points)), np.float32)
    kept, invalid, own = own_frame(points, mount.T_vehicle_points, np.array(own_box, np.float32), rows)
    if invalid:
        _log.warning("dropped %d of %d points that are NaN, inf or beyond 1000 km", invalid, len(points))
    if own:
        _log.debug("dropped %d of %d points as returns from the own vehicle", own, len(points))
    return rows[:, :kept].T


def check_box(box: Sequence[float]) -> tuple[float, float, float, float]:
    """Return an own-vehicle box as numbers, or refuse one that is none."""
    numbers = tuple(float(edge) for edge in box)
    if (
        len(numbers) != 4
        or not np.isfinite(numbers).all()
        or numbers[0] > numbers[1]
        or numbers[2] > numbers[3]
    ):
        raise ValueError(f"own_box must be finite x_min <= x_max, y_min <= y_max [m], got {box}")
    return numbers


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
