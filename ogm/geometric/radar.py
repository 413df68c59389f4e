"""Sensor model of radars: detections mark ellipses, and clear sectors up to the first detection."""

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.causes import SECTOR, SectorTrace
from ogm.geometric.doppler import DirectionSectors, direction_sectors, moving_detections, nearest_in_direction
from ogm.geometric.inputs import REACH, check_sensor_in_grid, check_within, in_footprint, mount_in_grid, usable_points
from ogm.geometric.kernels.radar import clear_cells, mark_ellipses
from ogm.geometric.ray import polar_grid
from ogm.grid import EvidentialGrid, GridSpec
from ogm.jit import log_compilation
from ogm.pose import rotate
from ogm.scan import Mount, Scan, as_scan
from ogm.unknown_cause import UnknownCause

REFERENCE_SNR = 10**1.3  # at `RadarISM.reach`, and at the reach of `ogm.simulation.radars.RadarMode` for 0 dBsm
FALSE_ALARM = 1e-4  # probability per bin that sets the detection threshold


@dataclass(frozen=True, eq=False)
class RadarISM:
    """Geometric inverse sensor model of a radar with Doppler.

    **Marking.** A static detection at range r marks the ellipse of its errors, with standard deviations
    s_r = `range_noise` along the beam and s_t = r * `azimuth_noise` across it. At a distance of d standard deviations,
    occupied is ``hit_mass * min(1, extent / (2 pi s_r s_t)) * exp(-d**2 / 2)``, for an object of area `extent`
    somewhere in the ellipse. Behind another detection in the same direction it is multiplied by `behind`, because of
    ghosts by reflection. Several detections count as independent sources, 1 - prod(1 - m).

    **Clearing.** A direction is cleared up to its first detection, static or moving. Free is ``free_mass * P_D(r)``
    with the detection probability of a Swerling 1 target, ``P_D = P_FA**(1 / (1 + SNR))``; the SNR falls with the
    fourth power of the range. Directions without detection stay unknown, because an object may reflect the beam away
    from the radar.

    **Moving** detections (see `moving_detections`) do not mark, so they leave no trail in a static map. With
    `keep_moving` they mark like static detections.

    The masses, `extent`, `behind` and `beam` were fitted to simulated radars in training towns; `reach` and `margin`
    were chosen there so that about 5 % of the occupied cells are cleared. With a `margin` of 2 m instead of 7.5 m, an
    ARS548 clears 8.4 % instead of 4.9 %, an ARS408 8.0 % instead of 4.3 %, a corner radar 8.7 % instead of 5.4 %. A
    radar with more detections needs less: a real 4D radar with 830 to 3800 detections clears 3.3 % instead of 1.2 %.
    Sources: Clarke 2012, Werber 2015, Slutsky and Dobkin 2019, see docs/radar.md.

    Parameters
    ----------
    spec : GridSpec
        The grid to fill, in the vehicle frame; must hold the sensor.
    mount : Mount, optional
        Mount of the sensor; by default the mount of each scan, `Scan.mount`. The x axis of the sensor points to the
        middle of the field of view. Detections in the ego footprint are dropped, and its cells stay unknown.
    half_width : float
        Half the field of view in azimuth [rad].
    range_noise, azimuth_noise, doppler_noise : float
        Standard deviations of range [m], azimuth [rad] and Doppler [m/s].
    beam : float
        Half the width of the sector that a detection clears [rad].
    reach : float
        Range at which a target that must not be missed has a signal-to-noise ratio of 13 dB [m].
    free_mass, hit_mass : float
        Greatest mass of free in a scan, and of occupied from a detection, in (0, 1).
    extent : float
        Area of a detected object [m^2].
    behind : float
        Reliability of detections behind others, in [0, 1].
    margin : float
        Clearing ends this distance plus twice `range_noise` before a detection [m].
    clearance : float
        Greatest height above ground of detections that mark [m]; radars without elevation report no height.
    keep_moving : bool
        Whether moving detections mark.

    Raises
    ------
    ValueError
        If a number is out of its range, or the sensor lies outside the grid.
    """

    spec: GridSpec
    mount: Mount | None = None
    half_width: float = math.radians(60)
    range_noise: float = 0.2
    azimuth_noise: float = math.radians(0.5)
    doppler_noise: float = 0.1
    beam: float = math.radians(1.8)
    reach: float = 40.0
    free_mass: float = 0.97
    hit_mass: float = 0.6
    extent: float = 1.3
    behind: float = 0.5
    margin: float = 7.5
    clearance: float = 3.0
    keep_moving: bool = False

    def __post_init__(self) -> None:
        check_sensor_in_grid(self.spec, self.mount)
        check_within("half_width", self.half_width, 0, math.pi + 1e-9)
        for name, high in (("range_noise", 20), ("azimuth_noise", 0.5), ("doppler_noise", 20), ("beam", 0.5)):
            check_within(name, getattr(self, name), 1e-4, high)
        for name in ("free_mass", "hit_mass"):
            check_within(name, getattr(self, name), 0, 1)
        check_within("behind", self.behind, -1e-9, 1 + 1e-9)
        for name in ("reach", "extent", "clearance"):
            check_within(name, getattr(self, name), 0, 1e6)
        check_within("margin", self.margin, -1e-9, 100)

    def __call__(self, scan: Scan | NDArray[np.float32]) -> EvidentialGrid:
        """Map one scan.

        Parameters
        ----------
        scan : Scan or (N, 4) float32
            Uses x, y, z and `Scan.doppler`, relative to the sensor or over ground; without Doppler, all detections are
            static. Detections with NaN, inf or beyond 1000 km are dropped and counted in the log.

        Returns
        -------
        EvidentialGrid
            Vacuous for an empty scan.
        """
        return self._map(as_scan(scan))[0]

    def trace(self, scan: Scan | NDArray[np.float32]) -> SectorTrace:
        """Map one scan, and keep the causes of unknown cells; see `ogm.geometric.causes`.

        In a direction without detection, the cause is no echo. In other directions it is no echo up to `margin` before
        the first detection. Behind that it is an obstacle, or clearance if the detection lies above the clearance.
        """
        grid, mount, first, above = self._map(as_scan(scan))
        polar = polar_grid(self.spec, (float(mount.origin[0]), float(mount.origin[1])), mount.ego_footprint, SECTOR)
        bearing = np.angle(np.exp(1j * (np.arange(polar.sectors) + 0.5) * (2 * math.pi / polar.sectors)))
        of = direction_sectors(self.beam).of(bearing)
        until = np.maximum(first[of] - self.margin - 2 * self.range_noise, 0)
        beyond = np.where(above[of], UnknownCause.ABOVE_CLEARANCE, UnknownCause.BEHIND_OBSTACLE)
        beyond = np.where(np.isfinite(first[of]), beyond, UnknownCause.NO_ECHO)
        causes = np.stack([np.full_like(beyond, UnknownCause.NO_ECHO), beyond, beyond], axis=-1).astype(np.uint8)
        off = np.abs(np.angle(np.exp(1j * (bearing - _ahead(mount)))))
        causes[off > self.half_width] = UnknownCause.OUTSIDE_VIEW
        return SectorTrace(grid, mount, grid.mass, polar, np.stack([until, until], axis=-1), causes, math.inf)

    def _map(self, scan: Scan) -> tuple[EvidentialGrid, Mount, NDArray[np.float64], NDArray[np.bool_]]:
        """Return grid and mount, and by direction the range of the first detection [m] and if it is above clearance."""
        log_compilation(clear_cells)
        mount = mount_in_grid(scan, self.spec, self.mount)
        scan = scan.select(usable_points(scan.points))
        T = mount.T_vehicle_points
        x, y, z = rotate(T[:3, :3], scan.points[:, :3].T.astype(np.float64)) + T[:3, 3:]
        dx, dy = x - mount.origin[0], y - mount.origin[1]
        distance, bearing = np.hypot(dx, dy), np.arctan2(dy, dx)
        outside = ~in_footprint(mount, x, y) & (distance > 1e-3)

        # First detection in each direction
        layout = _layout(self.spec, mount, self.half_width, self.beam)
        first = nearest_in_direction(bearing[outside], distance[outside], layout.sectors)
        hidden = distance > first[layout.sectors.of(bearing)] + 2 * self.range_noise + self.margin

        free = np.zeros(self.spec.shape, np.float32)
        until = (first - self.margin - 2 * self.range_noise).astype(np.float32)
        until[~np.isfinite(first)] = 0
        clear_cells(layout.sector, layout.distance, until, _free_table(self.free_mass, self.reach, layout.metres), free)

        is_low = z - mount.ground_point[2] <= self.clearance
        above = nearest_in_direction(bearing[outside & is_low], distance[outside & is_low], layout.sectors) > first
        marks = outside & is_low
        if not self.keep_moving:
            sensor = np.zeros(3) if mount.points_in == "sensor" else mount.origin
            marks &= ~moving_detections(scan, self.doppler_noise, self.azimuth_noise, origin=sensor)
        across = np.maximum(distance * self.azimuth_noise, 1e-3)
        peak = self.hit_mass * np.minimum(1, self.extent / (2 * math.pi * self.range_noise * across))
        peak = np.where(hidden, self.behind, 1.0) * peak
        rows = np.stack([x, y, np.cos(bearing), np.sin(bearing), across, peak], axis=-1)[marks]
        mass = np.zeros((*self.spec.shape, 2), np.float32)
        place = np.array([*self.spec.origin, self.spec.resolution, self.range_noise])
        mark_ellipses(rows, place, free, layout.ego, mass)
        return EvidentialGrid.trusted(self.spec, mass), mount, first, above


class _Layout(NamedTuple):
    """Sector (-1 outside the field of view) and distance of each grid cell, as seen from the sensor."""

    sector: NDArray[np.int32]
    distance: NDArray[np.float32]
    ego: NDArray[np.bool_]
    sectors: DirectionSectors
    metres: int  # greatest distance of a cell, rounded up


def _ahead(mount: Mount) -> float:
    """Return the azimuth of the centre of the field of view [rad]."""
    return math.atan2(mount.T_vehicle_sensor[1, 0], mount.T_vehicle_sensor[0, 0])


@lru_cache(maxsize=16)
def _layout(spec: GridSpec, mount: Mount, half_width: float, beam: float) -> _Layout:
    """Return the layout of the sectors on a grid; cached per mount."""
    sectors = direction_sectors(beam)
    x, y = np.broadcast_arrays(*spec.cell_centers)
    bearing = np.arctan2(y - mount.origin[1], x - mount.origin[0])
    off = np.abs(np.angle(np.exp(1j * (bearing - _ahead(mount)))))
    sector = sectors.of(bearing).astype(np.int32)
    ego = in_footprint(mount, x, y)
    sector[(off > half_width) | ego] = -1
    distance = np.hypot(x - mount.origin[0], y - mount.origin[1]).astype(np.float32)
    metres = int(min(distance.max(), REACH)) + 1
    return _Layout(np.ascontiguousarray(sector), distance, ego, sectors, metres)


@lru_cache(maxsize=16)
def _free_table(free_mass: float, reach: float, metres: int) -> NDArray[np.float32]:
    """Return the mass of free at each metre of range."""
    distance = np.maximum(np.arange(metres), 1.0)
    return (free_mass * FALSE_ALARM ** (1 / (1 + REFERENCE_SNR * (reach / distance) ** 4))).astype(np.float32)
