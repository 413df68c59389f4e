"""Input checks of the geometric models, and transformation of points to the vehicle frame."""

import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.grid import EvidentialGrid, GridSpec
from ogm.jit import kernel
from ogm.scan import Mount, Scan, check_mount, mount_of

_log = logging.getLogger(__name__)

REACH = 1e6  # [m] greatest coordinate; nothing computed from it overflows
BLOCK = 256  # points
NEAR = 1e3  # [m] at least half of the points of any lidar lie within this distance


def check_sensor_in_grid(spec: GridSpec, mount: Mount | None) -> None:
    """Raise an error if `mount` is not a Mount or its sensor lies outside the grid; None passes."""
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
    """Return the mount that a model uses for a scan, see `ogm.scan.mount_of`; the mount of a scan is checked here."""
    found = mount_of(scan, mount)
    if mount is None:
        check_sensor_in_grid(spec, found)
    return found


def check_within(name: str, value: float, low: float, high: float) -> None:
    """Raise ValueError for a parameter outside the open interval (low, high)."""
    if not low < value < high:
        raise ValueError(f"{name} must lie between {low:g} and {high:g}, got {value}")


def in_footprint(mount: Mount, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return a mask of the points inside the ego footprint; x and y [m] are in the vehicle frame."""
    x0, x1, y0, y1 = mount.ego_footprint
    return (x > x0) & (x < x1) & (y > y0) & (y < y1)


def usable_points(points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return a mask (N,) of the points that are finite and within 1000 km; log the number of others."""
    usable = np.asarray((np.abs(points[:, :3]) < REACH).all(axis=1))
    if invalid := len(points) - int(np.count_nonzero(usable)):
        _warn(invalid, len(points))
    return usable


def shows_nothing(scan: Scan, grid: EvidentialGrid) -> bool:
    """Return whether a lidar scan with points leaves all cells unknown, or has most points beyond `NEAR`."""
    if scan.rcs is not None or not len(scan):
        return False
    near = scan.points[:, 0] ** 2 + scan.points[:, 1] ** 2 < NEAR**2
    return 2 * int(np.count_nonzero(near)) < len(scan) or not grid.known[1].any()


def explain_nothing(scan: Scan, spec: GridSpec, mount: Mount) -> str:
    """Return the extent of the points of a scan that shows nothing, and the likely cause, as text.

    Parameters
    ----------
    scan : Scan
        Scan with at least one point.
    spec : GridSpec
    mount : Mount
    """
    points = scan.points[(np.abs(scan.points[:, :3]) < REACH).all(axis=1), :3].astype(np.float64)
    lead = f"the scan shows nothing on the grid: of {len(scan)} points"
    if not len(points):
        return f"{lead} none is within 1000 km; expected coordinates around the sensor, in metres"
    xyz = points @ mount.T_vehicle_points[:3, :3].T + mount.T_vehicle_points[:3, 3]
    count = int(spec.contains(xyz[:, 0], xyz[:, 1]).sum())
    cause = explain_coordinates(xyz, spec.length)
    if not cause and count:
        cause = f"the ground is expected at z {mount.ground_point[2]:.2f} m: check `sensor_height` and `axes`"
    elif not cause:
        cause = f"the grid of {spec.length:g} x {spec.width:g} m is too small: give a larger `length` and `width`"
    return f"{lead}, {extent_text(xyz)}, {count} lie on it; {cause}"


def extent_text(xyz: NDArray[np.floating[Any]]) -> str:
    """Return the extent of points (N, 3) [m] as text."""
    ends = zip("xyz", xyz.min(axis=0), xyz.max(axis=0), strict=True)
    return ", ".join(f"{axis} {low:.0f} to {high:.0f} m" for axis, low, high in ends)


def explain_coordinates(xyz: NDArray[np.floating[Any]], near: float = NEAR / 10) -> str:
    """Return the likely error in coordinates or units of points, with the remedy, else "".

    Parameters
    ----------
    xyz : (N, 3) float
        At least one finite point [m].
    near : float
        Greatest distance of the median point from the sensor [m]; the point cloud's half extent is also allowed.
    """
    middle, spread = np.median(xyz, axis=0), float(np.ptp(xyz[:, :2], axis=0).max())
    if float(np.hypot(*middle[:2])) > max(spread / 2, near):
        centre = ", ".join(f"{value:.0f}" for value in middle)
        return f"probably map coordinates, around ({centre}) m: give `sensor_position`, or points around the sensor"
    return "probably millimetres: divide them by 1000" if spread > 2 * NEAR else ""


def _warn(invalid: int, count: int) -> None:
    _log.warning("dropped %d of %d points that are NaN, inf or beyond 1000 km", invalid, count)


def to_vehicle_frame(
    points: NDArray[np.float32], mount: Mount, ego_footprint: tuple[float, float, float, float]
) -> NDArray[np.float32]:
    """Transform points to the vehicle frame; drop invalid points and returns from the ego vehicle.

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
    """Return the kept points (3, K), the number of invalid points and the number from the ego vehicle.

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
