"""Input of the geometric models: checks, and points taken to the vehicle frame."""

import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.grid import EvidentialGrid, GridSpec
from ogm.jit import kernel
from ogm.scan import Mount, Scan, check_mount, mount_of

_log = logging.getLogger(__name__)

REACH = 1e6  # [m] also keeps what follows from overflowing
BLOCK = 256  # points
NEAR = 1e3  # [m] within which half of the points of any lidar lie


def check_sensor_in_grid(spec: GridSpec, mount: Mount | None) -> None:
    """Raise an error if `mount` is no Mount, or its sensor lies outside the grid; None passes."""
    if mount is None:
        return
    check_mount(mount)
    x, y, _ = mount.ground_point
    if not spec.contains(x, y):
        raise ValueError(
            f"the sensor at x={x:g}, y={y:g} m lies outside the grid {spec.extent}; "
            "move or enlarge the grid so that it holds the sensor"
        )


def mount_in_grid(scan: Scan, spec: GridSpec, mount: Mount | None) -> Mount:
    """Return the mount by which a model maps a scan, see `ogm.scan.mount_of`; that of a scan is checked here."""
    found = mount_of(scan, mount)
    if mount is None:
        check_sensor_in_grid(spec, found)
    return found


def check_within(name: str, value: float, low: float, high: float) -> None:
    """Refuse a parameter outside the open interval (low, high)."""
    if not low < value < high:
        raise ValueError(f"{name} must lie between {low:g} and {high:g}, got {value}")


def usable_points(points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which points are finite and within 1000 km, (N,); log how many are not."""
    usable = np.asarray((np.abs(points[:, :3]) < REACH).all(axis=1))
    if invalid := len(points) - int(np.count_nonzero(usable)):
        _warn(invalid, len(points))
    return usable


def shows_nothing(scan: Scan, grid: EvidentialGrid) -> bool:
    """Return whether a scan of a lidar has points, but leaves all cells unknown or lies beyond `NEAR` by half."""
    if scan.rcs is not None or not len(scan):
        return False
    near = scan.points[:, 0] ** 2 + scan.points[:, 1] ** 2 < NEAR**2
    return 2 * int(np.count_nonzero(near)) < len(scan) or not grid.known[1].any()


def explain_nothing(scan: Scan, spec: GridSpec, mount: Mount) -> str:
    """Return where the points of a scan that shows nothing lie, and the likely cause.

    Parameters
    ----------
    scan : Scan
        With points.
    spec : GridSpec
    mount : Mount
    """
    points = scan.points[(np.abs(scan.points[:, :3]) < REACH).all(axis=1), :3].astype(np.float64)
    lead = f"the scan shows nothing on the grid: of {len(scan)} points"
    if not len(points):
        return f"{lead} none lies within 1000 km; wanted metres, around the sensor"
    xyz = points @ mount.T_vehicle_points[:3, :3].T + mount.T_vehicle_points[:3, 3]
    count = int(spec.contains(xyz[:, 0], xyz[:, 1]).sum())
    cause = explain_coordinates(xyz, spec.length)
    if not cause and count:
        cause = f"the ground is expected at z {mount.ground_point[2]:.2f} m: check `sensor_height` and `axes`"
    elif not cause:
        cause = f"beyond the grid of {spec.length:g} x {spec.width:g} m? Give a larger `length` and `width`"
    return f"{lead}, {extent_text(xyz)}, {count} lie on it; {cause}"


def extent_text(xyz: NDArray[np.floating[Any]]) -> str:
    """Return the extent of points (N, 3) [m] in words."""
    ends = zip("xyz", xyz.min(axis=0), xyz.max(axis=0), strict=True)
    return ", ".join(f"{axis} {low:.0f} to {high:.0f} m" for axis, low, high in ends)


def explain_coordinates(xyz: NDArray[np.floating[Any]], near: float = NEAR / 10) -> str:
    """Return why points are not around their sensor or not in metres, as a question with the way out; else "".

    Parameters
    ----------
    xyz : (N, 3) float
        At least one finite point [m].
    near : float
        Distance [m] up to which the middle of the points lies around their sensor.
    """
    middle, spread = np.median(xyz, axis=0), float(np.ptp(xyz[:, :2], axis=0).max())
    if float(np.hypot(*middle[:2])) > max(spread / 2, near):
        centre = ", ".join(f"{value:.0f}" for value in middle)
        return f"in map coordinates, around ({centre}) m? Give `sensor_position`, or points around the sensor"
    return "in millimetres? Divide them by 1000" if spread > 2 * NEAR else ""


def _warn(invalid: int, count: int) -> None:
    _log.warning("dropped %d of %d points that are NaN, inf or beyond 1000 km", invalid, count)


def to_vehicle_frame(
    points: NDArray[np.float32], mount: Mount, ego_footprint: tuple[float, float, float, float]
) -> NDArray[np.float32]:
    """Take points to the vehicle frame; drop those that are not finite, and returns from the ego vehicle.

    Returns
    -------
    (K, 3) float32
        x, y, z [m]; each column is contiguous.
    """
    T, footprint = mount.T_vehicle_points[:3].astype(np.float32), np.array(ego_footprint, np.float32)
    xyz, invalid, ego = _transform_and_drop(np.ascontiguousarray(points), T, footprint)
    if invalid:
        _warn(invalid, len(points))
    if ego:
        _log.debug("dropped %d of %d points as returns from the ego vehicle", ego, len(points))
    kept: NDArray[np.float32] = xyz.T
    return kept


@kernel
def _transform_and_drop(points: Any, T: Any, footprint: Any) -> Any:
    """Return the points that stay as rows of x, y and z, how many were not finite, and how many from the ego vehicle.

    Parameters
    ----------
    points : (N, 3 or more) float32, T : (3, 4) float32, footprint : (4,) float32
    """
    r00, r01, r02, tx = T[0]
    r10, r11, r12, ty = T[1]
    r20, r21, r22, tz = T[2]
    x_min, x_max, y_min, y_max = footprint
    limit, width = np.float32(REACH), points.shape[1] & 0x7FFF
    flat, xyz = points.reshape(-1), np.empty((3, points.shape[0]), np.float32)
    xs, ys, zs = xyz[0], xyz[1], xyz[2]
    columns, state = np.empty((3, BLOCK), np.float32), np.empty(BLOCK, np.int32)
    kept, invalid, ego = 0, 0, 0
    for begin in range(0, points.shape[0], BLOCK):
        count, lost = min(points.shape[0] - begin, BLOCK), 0
        for n in range(count):
            at = ((begin + n) * width) & 0x7FFFFFFFFFFF
            columns[0, n], columns[1, n], columns[2, n] = flat[at], flat[at + 1], flat[at + 2]
        kept &= 0x7FFFFFFFFFFF
        for n in range(count):
            a, b, c = columns[0, n], columns[1, n], columns[2, n]
            x = r00 * a + r01 * b + r02 * c + tx
            y = r10 * a + r11 * b + r12 * c + ty
            usable = (abs(a) < limit) & (abs(b) < limit) & (abs(c) < limit)
            own = (x > x_min) & (x < x_max) & (y > y_min) & (y < y_max)
            state[n] = 2 if own else 0
            state[n] = state[n] if usable else 1
            lost += state[n]
            xs[kept + n], ys[kept + n], zs[kept + n] = x, y, r20 * a + r21 * b + r22 * c + tz
        if lost == 0:
            kept += count
            continue
        first = kept
        for n in range(count):
            x, y, z = xs[first + n], ys[first + n], zs[first + n]
            xs[kept], ys[kept], zs[kept] = x, y, z
            kept += int(state[n] == 0)
            invalid += int(state[n] == 1)
            ego += int(state[n] == 2)
    return xyz[:, :kept], invalid, ego
