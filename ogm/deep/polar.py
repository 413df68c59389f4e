"""Polar grid of a radar sweep: features for a network, and masses on a Cartesian grid from its evidence.

The polar grid is centred on the sensor and its x axis, after Wei et al. 2023, so it does not depend on the vehicle.
This module does not need torch.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.geometric import moving_detections, sensor_velocity
from ogm.geometric.doppler import unfolded
from ogm.grid import GridSpec
from ogm.jit import kernel
from ogm.pose import rotate
from ogm.scan import Mount, Scan

CHANNELS = (
    "static", "moving", "cross section", "Doppler", "range in cell", "azimuth in cell", "height", "detections before",
    "before the first", "range", "azimuth", "field of view", "azimuth noise",
)  # fmt: skip
BEAM = math.radians(2.25)  # half width of the sector in which a nearer detection is in front of a cell


@dataclass(frozen=True)
class RadarGrid:
    """Cells of range and azimuth around a radar, over 180 degrees by default.

    Parameters
    ----------
    shape : (ranges, azimuths)
        Numbers of cells.
    range_step, azimuth_step : float
        Sides of the cells [m, rad].
    """

    shape: tuple[int, int] = (144, 160)
    range_step: float = 0.5
    azimuth_step: float = math.radians(1.125)

    def __post_init__(self) -> None:
        good = all(type(n) is int and 0 < n <= 4096 for n in self.shape) and len(self.shape) == 2
        if not (good and 0 < self.range_step < 100 and 0 < self.azimuth_step * self.shape[1] <= 2 * math.pi + 1e-9):
            raise ValueError(f"a polar grid must have positive sizes and at most 360 degrees, got {self}")

    @property
    def reach(self) -> float:
        """Range of the outer edge [m]."""
        return self.shape[0] * self.range_step

    @property
    def edge(self) -> float:
        """Half width in azimuth [rad]."""
        return self.shape[1] * self.azimuth_step / 2


class RadarNoise(NamedTuple):
    """Field of view and errors of a radar, see `ogm.geometric.RadarISM`.

    Attributes
    ----------
    half_width : float
        Half width of the field of view in azimuth [rad].
    doppler_noise, azimuth_noise : float
        Standard deviations [m/s, rad].
    """

    half_width: float = math.radians(60)
    doppler_noise: float = 0.1
    azimuth_noise: float = math.radians(0.5)


def polar_features(scan: Scan, mount: Mount, noise: RadarNoise, polar: RadarGrid) -> NDArray[np.float32]:
    """Return the features of a sweep in each polar cell.

    The channels are:

    * static, moving: ln(1 + number of static or moving detections in the cell);
    * cross section: the largest of a detection in the cell, (rcs + 10 dBsm) / 20 dB;
    * Doppler, range in cell, azimuth in cell, height: of that detection, velocity over ground / 10 m/s, position in
      the cell from -1/2 to 1/2, and height above the ground / 3 m;
    * detections before: ln(1 + number of nearer detections within `BEAM`);
    * before the first: 1 if there are detections within `BEAM`, but no nearer ones;
    * range, azimuth: range / 40 m and absolute azimuth / 90 degrees;
    * field of view: 1 for cells in the field of view;
    * azimuth noise: standard deviation of the azimuth / 0.02 rad.

    The last four channels are the same for all sweeps of a radar.

    Parameters
    ----------
    scan : Scan
        Sweep with `doppler` and `rcs`; without them, all detections are static and cross sections are 0. Detections
        with NaN or inf, and detections in the ego footprint, are dropped.
    mount : Mount
        Mount of the radar.
    noise : RadarNoise
        Field of view and errors of the radar.
    polar : RadarGrid
        Polar cells.

    Returns
    -------
    (channels, ranges, azimuths) float32
        Features in the order of `CHANNELS`.
    """
    rows = _detections(scan, mount, noise)
    ranges, azimuths = polar.shape
    r, a = rows.distance / polar.range_step, (rows.azimuth + polar.edge) / polar.azimuth_step
    i, j = np.floor(r).astype(np.int64), np.floor(a).astype(np.int64)
    inside = (i < ranges) & (j >= 0) & (j < azimuths)
    i, j, r, a = i[inside], j[inside], r[inside], a[inside]
    moving, strength = rows.moving[inside], rows.strength[inside]
    result = np.zeros((len(CHANNELS), ranges, azimuths), np.float32)
    np.add.at(result[0], (i[~moving], j[~moving]), 1)
    np.add.at(result[1], (i[moving], j[moving]), 1)

    order = np.argsort(strength, kind="stable")  # the strongest detection of a cell is written last
    columns = (strength, rows.doppler[inside], r - i - 0.5, a - j - 0.5, rows.height[inside])
    for channel, column in enumerate(columns, 2):
        result[channel, i[order], j[order]] = column[order]

    count = result[0] + result[1]
    wide = math.ceil(BEAM / polar.azimuth_step - 1e-9)
    padded = np.pad(count, ((0, 0), (wide, wide)))
    around = np.sum([padded[:, k : k + azimuths] for k in range(2 * wide + 1)], axis=0)
    before = np.cumsum(around, axis=0) - around
    result[7], result[8] = np.log1p(before), (before == 0) & (before[-1] + around[-1] > 0)
    result[:2] = np.log1p(result[:2])
    result[9:] = _constant(polar, noise)
    return result


class _Detections(NamedTuple):
    """Detections in a level frame with the sensor's position and heading, scaled like the features."""

    distance: NDArray[np.float64]
    azimuth: NDArray[np.float64]
    moving: NDArray[np.bool_]
    strength: NDArray[np.float64]
    doppler: NDArray[np.float64]
    height: NDArray[np.float64]


def _detections(scan: Scan, mount: Mount, noise: RadarNoise) -> _Detections:
    scan = scan.select(np.flatnonzero(np.isfinite(scan.points[:, :3]).all(axis=1)))
    T = mount.T_vehicle_points
    x, y, z = rotate(T[:3, :3], scan.points[:, :3].T.astype(np.float64)) + T[:3, 3:]
    ahead = _heading(mount)
    c, s, (ox, oy, _) = math.cos(ahead), math.sin(ahead), mount.origin
    local = np.zeros((len(scan), 4))
    local[:, 0], local[:, 1] = c * (x - ox) + s * (y - oy), c * (y - oy) - s * (x - ox)
    flat = Scan(local.astype(np.float32), doppler=scan.doppler, doppler_interval=scan.doppler_interval)
    distance, azimuth = np.hypot(*local[:, :2].T), np.arctan2(local[:, 1], local[:, 0])

    moving, doppler = np.zeros(len(scan), np.bool_), np.zeros(len(scan))
    velocity = sensor_velocity(flat, doppler_noise=noise.doppler_noise)
    if velocity is not None and scan.doppler is not None:
        moving = moving_detections(flat, noise.doppler_noise, noise.azimuth_noise)
        over_ground = scan.doppler + np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1) @ velocity
        doppler = unfolded(over_ground, scan.doppler_interval)
    strength = np.zeros(len(scan)) if scan.rcs is None else (scan.rcs.astype(np.float64) + 10) / 20
    height = z - mount.ground_point[2]
    x0, x1, y0, y1 = mount.ego_footprint
    keep = ~((x > x0) & (x < x1) & (y > y0) & (y < y1)) & (distance > 1e-3)
    scaled = (np.nan_to_num(column, nan=0.0) for column in (strength, doppler / 10, height / 3))
    strength, doppler, height = (np.clip(column, -3, 3) for column in scaled)
    return _Detections(*(column[keep] for column in (distance, azimuth, moving, strength, doppler, height)))


def _heading(mount: Mount) -> float:
    """Return the heading of the sensor's x axis in the vehicle frame [rad]."""
    return math.atan2(mount.T_vehicle_sensor[1, 0], mount.T_vehicle_sensor[0, 0])


@lru_cache(maxsize=16)
def _constant(polar: RadarGrid, noise: RadarNoise) -> NDArray[np.float32]:
    """Return the channels that are the same for all sweeps, (4, ranges, azimuths)."""
    r = (np.arange(polar.shape[0]) + 0.5) * polar.range_step
    azimuth = np.abs((np.arange(polar.shape[1]) + 0.5) * polar.azimuth_step - polar.edge)
    columns: Any = (r[:, None] / 40, azimuth / (math.pi / 2), azimuth <= noise.half_width, noise.azimuth_noise / 0.02)
    result = np.stack([np.broadcast_to(np.asarray(column, np.float32), polar.shape) for column in columns])
    result.flags.writeable = False
    return result


def polar_places(
    x: NDArray[np.float64], y: NDArray[np.float64], mount: Mount, noise: RadarNoise, polar: RadarGrid
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return the coordinates of positions on the polar grid, and whether the radar sees them.

    Positions beyond the polar grid, outside the field of view and in the ego footprint are not seen.

    Parameters
    ----------
    x, y : float64 arrays of equal shape
        Positions in the vehicle frame [m].
    mount, noise, polar
        See `polar_features`.

    Returns
    -------
    row, column : float64 arrays
        Range and azimuth in cells; integers are the centres of polar cells.
    seen : bool array
        Whether the radar sees the positions.
    """
    dx, dy = x - mount.origin[0], y - mount.origin[1]
    distance = np.hypot(dx, dy)
    ahead = _heading(mount)
    c, s = math.cos(ahead), math.sin(ahead)
    azimuth = np.arctan2(c * dy - s * dx, c * dx + s * dy)
    x0, x1, y0, y1 = mount.ego_footprint
    ego = (x > x0) & (x < x1) & (y > y0) & (y < y1)
    seen = (np.abs(azimuth) <= min(noise.half_width, polar.edge)) & (distance < polar.reach) & ~ego
    return distance / polar.range_step - 0.5, (azimuth + polar.edge) / polar.azimuth_step - 0.5, seen


class PolarView(NamedTuple):
    """Cells of a grid that a radar sees, in memory order, and their positions on its polar grid.

    Attributes
    ----------
    cell : (N,) int32
        Flat index of the cell in the grid.
    corner : (N,) int32
        Flat index of the polar cell with the lowest range and azimuth of the four surrounding polar cells.
    share : (N, 2) float32
        Fraction of the way to the next range and the next azimuth, 0 to 1.
    """

    cell: NDArray[np.int32]
    corner: NDArray[np.int32]
    share: NDArray[np.float32]


@lru_cache(maxsize=16)
def view_of(spec: GridSpec, mount: Mount, noise: RadarNoise, polar: RadarGrid) -> PolarView:
    """Return the cells that a radar sees; cached for each mount."""
    x, y = np.broadcast_arrays(*spec.cell_centers)
    row, column, seen = polar_places(x, y, mount, noise, polar)
    cell = np.flatnonzero(seen)
    row, column = np.clip(row[seen], 0, polar.shape[0] - 1), np.clip(column[seen], 0, polar.shape[1] - 1)
    i, j = np.minimum(row.astype(int), polar.shape[0] - 2), np.minimum(column.astype(int), polar.shape[1] - 2)
    share = np.stack([row - i, column - j], axis=-1).astype(np.float32)
    return PolarView(cell.astype(np.int32), (i * polar.shape[1] + j).astype(np.int32), share)


@kernel
def write_masses(evidence: NDArray[Any], width: int, view: PolarView, mass: NDArray[Any]) -> None:
    """Write the masses of visible cells, with evidence interpolated bilinearly between polar cells.

    Parameters
    ----------
    evidence : (2, polar cells) float32
        Evidence for free and occupied.
    width : int
        Number of azimuths of the polar grid.
    view : PolarView
        Visible cells.
    mass : (cells, 2) float32
        Output; rows of other cells are not changed.
    """
    for n in range(len(view.cell)):
        k, u, v = view.corner[n], view.share[n, 0], view.share[n, 1]
        a, b, c, d = (1 - u) * (1 - v), (1 - u) * v, u * (1 - v), u * v
        free = a * evidence[0, k] + b * evidence[0, k + 1] + c * evidence[0, k + width] + d * evidence[0, k + width + 1]
        occupied = (
            a * evidence[1, k] + b * evidence[1, k + 1] + c * evidence[1, k + width] + d * evidence[1, k + width + 1]
        )
        scale = 1 / (free + occupied + 2)
        mass[view.cell[n], 0], mass[view.cell[n], 1] = free * scale, occupied * scale
