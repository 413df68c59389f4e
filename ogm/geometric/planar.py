"""Sensor model of planar lasers and single wide beams: Thrun's beam model in evidential form."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.causes import SECTOR, SectorTrace
from ogm.geometric.inputs import check_sensor_in_grid, check_within, mount_in_grid, to_vehicle_frame
from ogm.geometric.kernels.arguments import BeamColumns, BeamNumbers, Cells, Directions, PolarGrid
from ogm.geometric.kernels.beams import ends_of, fans_of, find_directions
from ogm.geometric.kernels.causes import GAP
from ogm.geometric.kernels.planar import TAIL, clear_fans, mark_ends, write_masses
from ogm.geometric.ray import polar_grid
from ogm.grid import EvidentialGrid, GridSpec, PartialGrid
from ogm.jit import log_compilation
from ogm.pose import rotate
from ogm.scan import Mount, Scan, as_scan
from ogm.unknown_cause import UnknownCause

MAX_WIDTH = math.radians(85)  # [rad] greatest full width of a beam; wider beams are narrowed to it
MIN_RANGE = 1e-3  # [m]


@dataclass(frozen=True, eq=False)
class PlanarISM:
    """The inverse beam model of planar lasers, sonars and infrared sensors.

    A beam with an echo at range z is an evidential form of Thrun's mixture (hit, short, maximum range, random). For a
    cell at distance d before or behind z, with d = 0 for the cell that holds the end:

    - **occupied** is ``(1 - p_false_alarm) * P(d)`` in cells on the axis of the beam, with P(0) = 1 and
      P(d) = Phi(-d / range_noise), the probability that the surface is at that distance from the end. Short and random
      returns are the false alarms.
    - **free** is ``(1 - p_miss) * (1 - exp(-d**2 / (2 range_noise**2)))`` before the end, 1 minus the relative
      likelihood of a surface. `p_miss` covers thin, transparent and specular objects.
    - Behind the end, cells stay unknown.

    Two neighbouring beams clear the fan between them, at least one cell wide, up to the nearer end. A cell takes the
    greatest mass of each state over all beams, in any order. Free is 0 where occupied exceeds `p_false_alarm`. Several
    beams through a cell are no more evidence than a single beam.

    Neighbouring beams may contradict each other (docs/geometric.md). An isolated echo between other surfaces (dust,
    mixed pixels at edges, glass) counts half. Beams through an opening of at most 0.3 m, or of at most 4 m if half of
    them have no echo, may have met a mirror or a pane. Beyond the edges of the opening they clear with the reliability
    `no_return_weight`, and without echo they clear nothing.

    Free holds **in the swept plane only**: `ogm.geometric.plane_text` returns its height.

    Parameters
    ----------
    spec : GridSpec
        The grid to fill, in the vehicle frame; must hold the sensor.
    mount : Mount, optional
        Mount of the sensor; by default the mount of each scan, `Scan.mount`. It levels a tilted sensor.
        Returns from the ego footprint are dropped, and its cells stay unknown.
    range_noise : float
        Standard deviation of a range [m]; 10 mm in the datasheet of the SICK LMS 291.
    p_miss : float
        Probability that a beam passes through an occupied cell, in (0, 1).
    p_false_alarm : float
        Probability that an echo comes from a free cell, in (0, 0.5).
    no_return_weight : float
        Reliability of free from beams without echo and from wide beams (`Scan.kind` "cone"), in [0, 1]. Beams without
        echo count up to `Scan.max_range`; without a maximum range they are ignored.
    beam_width : float, optional
        Full width of a beam [rad]; by default `Scan.beam_width`, or 0 if that is None. An end wider than a cell shares
        its mass of occupied over its arc.
    floor_margin : float
        Height above ground [m], at most half the sensor height. A lower beam may have met the floor, and neither
        clears nor marks.
    clearance : float
        Height above ground [m] from which a rising beam neither clears nor marks.

    Raises
    ------
    ValueError
        If a number is out of its range, or the sensor lies outside the grid.

    Notes
    -----
    Sources: Thrun, Burgard, Fox 2005, Sec. 6.3 (mixture) and 9.2 (inverse model); Shafer 1976, Ch. 11 (relative
    likelihood as plausibility).
    """

    spec: GridSpec
    mount: Mount | None = None
    range_noise: float = 0.01
    p_miss: float = 0.2
    p_false_alarm: float = 0.05
    no_return_weight: float = 0.25
    beam_width: float | None = None
    floor_margin: float = 0.05
    clearance: float = 2.0

    def __post_init__(self) -> None:
        check_sensor_in_grid(self.spec, self.mount)
        check_within("range_noise", self.range_noise, 1e-6, 10)
        check_within("p_miss", self.p_miss, 0, 1)
        check_within("p_false_alarm", self.p_false_alarm, 0, 0.5)
        check_within("no_return_weight", self.no_return_weight, -1e-9, 1 + 1e-9)
        check_within("floor_margin", self.floor_margin, -1e-9, 10)
        check_within("clearance", self.clearance, 0, 1e6)
        if self.beam_width is not None:
            check_within("beam_width", self.beam_width, -1e-9, math.pi / 2)

    def __call__(self, scan: Scan | NDArray[np.float32]) -> EvidentialGrid:
        """Map one scan.

        Parameters
        ----------
        scan : Scan or (N, 4) float32
            Uses x, y, z and, if present, `no_returns`, `max_range`, `beam_width` and `kind`. Several points in the same
            direction are echoes of the same beam. NaN and inf rows are dropped and counted in the log.

        Returns
        -------
        EvidentialGrid
            A `PartialGrid`: its masses are allocated on first access, and maps use only the rectangle that the scan
            reaches. Vacuous for an empty scan.
        """
        return self._map(as_scan(scan))[0]

    def trace(self, scan: Scan | NDArray[np.float32]) -> SectorTrace:
        """Map one scan, and keep the causes of unknown cells; see `ogm.geometric.causes`."""
        scan = as_scan(scan)
        grid, beams, directions, numbers, mount = self._map(scan)
        polar = polar_grid(self.spec, (float(mount.origin[0]), float(mount.origin[1])), mount.ego_footprint, SECTOR)
        silent = np.empty((0, 3))
        if scan.no_returns is not None and scan.max_range is None:  # these beams clear nothing
            silent = scan.no_returns[np.isfinite(scan.no_returns).all(axis=1)].astype(np.float64)
        x, y, _ = rotate(mount.T_vehicle_points[:3, :3], silent.T)
        return SectorTrace(
            grid, mount, grid.mass, polar, *_sector_causes(beams, directions, numbers, np.arctan2(y, x), polar)
        )

    def _map(self, scan: Scan) -> tuple[EvidentialGrid, BeamColumns, Directions, BeamNumbers, Mount]:
        """Return the grid of a scan with its beams, directions, numbers and mount."""
        log_compilation(clear_fans)
        mount, side = mount_in_grid(scan, self.spec, self.mount), self.spec.resolution
        place = mount.origin[:2] - self.spec.origin

        # Neighbouring beams, the fans between them, and the ends that count
        beams, cone = self._beams(scan, mount), scan.kind == "cone"
        width = self.beam_width if self.beam_width is not None else scan.beam_width or 0.0
        half_width = math.tan(min(width, MAX_WIDTH) / 2)
        numbers = BeamNumbers(1 - self.p_miss, 1 - self.p_false_alarm, self.no_return_weight, half_width, side, cone)
        directions = find_directions(beams, _step(beams.azimuth), cone)
        fans, ends = fans_of(directions, numbers), ends_of(beams, directions, numbers)

        # The rectangle of cells within reach, relative to the sensor
        corner, shape = _rectangle(fans, ends, place, self.spec, TAIL * self.range_noise + side)
        cells = Cells(corner[0] * side - place[0], corner[1] * side - place[1], side)

        # Fans along x clear rows; fans along y clear rows of the transposed array
        free, occupied = np.zeros((2, *shape), np.float32)
        along_x = np.abs(fans[:, 0]) >= np.abs(fans[:, 1])
        clear_fans(fans[along_x], cells, self.range_noise, free)
        turned = np.ascontiguousarray(fans[~along_x][:, [1, 0, 2, 3, 4, 5, 6]])
        clear_fans(turned, Cells(cells.y0, cells.x0, side), self.range_noise, free.T)

        # Ends mark; occupied wins over free from other beams
        mark_ends(ends, cells, self.range_noise, occupied)
        mass = np.empty((*shape, 2), np.float32)
        write_masses(free, occupied, self.p_false_alarm, mass)
        _clear_footprint(mass, cells, mount)
        grid = PartialGrid.of(self.spec, corner, mass, in_plane=True)
        return grid, beams, directions, numbers, mount

    def _beams(self, scan: Scan, mount: Mount) -> BeamColumns:
        """Return the beams of a scan, levelled by the mount."""
        offset = to_vehicle_frame(scan.points, mount, mount.ego_footprint).astype(np.float64) - mount.origin
        count, height = len(offset), mount.sensor_height
        if scan.no_returns is not None and scan.max_range is not None:
            unit = scan.no_returns[np.isfinite(scan.no_returns).all(axis=1)].astype(np.float64)
            offset = np.concatenate([offset, rotate(mount.T_vehicle_points[:3, :3], unit.T).T * scan.max_range])
        distance = np.hypot(offset[:, 0], offset[:, 1])
        echo, used = np.arange(len(offset)) < count, distance > MIN_RANGE

        # Range at which a beam leaves the heights from floor margin to clearance
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = offset[:, 2] / distance
            low = min(self.floor_margin, height / 2)
            end = np.where(slope < 0, (low - height) / slope, np.inf)
            if height < self.clearance:
                end = np.where(slope > 0, (self.clearance - height) / slope, end)
            x, y = offset[:, 0] / distance, offset[:, 1] / distance
        azimuth, reach = np.arctan2(y, x), np.minimum(distance, end)
        order = np.lexsort((reach, azimuth))
        order = order[used[order]]
        marks = echo & (distance <= end)
        leaves = np.where((slope > 0) & (distance > end), UnknownCause.ABOVE_CLEARANCE, UnknownCause.OUTSIDE_VIEW)
        beyond = np.where(marks, UnknownCause.BEHIND_OBSTACLE, leaves).astype(np.uint8)
        columns = BeamColumns(x, y, azimuth, reach, echo, marks, beyond)
        return BeamColumns._make(column[order] for column in columns)


def _step(azimuth: NDArray[np.float64]) -> float:
    """Return the median angle between neighbouring beams [rad]."""
    turn = np.diff(azimuth)
    turn = turn[turn > 1e-5]
    return float(np.partition(turn, len(turn) // 2)[len(turn) // 2]) if len(turn) else math.inf


def _sector_causes(
    beams: BeamColumns, directions: Directions, numbers: BeamNumbers, silent: NDArray[np.float64], polar: PolarGrid
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return `ends` and `causes` of a `SectorTrace`; `silent` are azimuths of unused beams without echo [rad]."""
    count, sectors = len(directions.reach), polar.sectors
    ends, causes = np.zeros((sectors, 2)), np.full((sectors, 3), UnknownCause.OUTSIDE_VIEW, np.uint8)
    middle = (np.arange(sectors) + 0.5) * (2 * math.pi / sectors)
    middle = np.where(middle > math.pi, middle - 2 * math.pi, middle)
    if not count:
        causes[:] = UnknownCause.NO_ECHO if len(silent) else UnknownCause.OUTSIDE_VIEW
        return ends, causes

    # The neighbouring directions of each sector; choose the shorter, or in a gap the nearer in angle
    nearest = np.lexsort((beams.reach, directions.of_beam))
    nearest = nearest[np.searchsorted(directions.of_beam, np.arange(count))]
    azimuth = beams.azimuth[nearest]
    left = (np.searchsorted(azimuth, middle) - 1) % count
    right = (left + 1) % count
    adjacent = directions.adjacent[left]
    off = np.stack([middle - azimuth[left], azimuth[right] - middle]) % (2 * math.pi)
    ends_first = directions.reach[left] <= directions.reach[right]
    chosen = np.where(np.where(adjacent, ends_first, off[0] <= off[1]), left, right)
    seen = adjacent | (off.min(axis=0) <= max(math.atan(numbers.half_width), math.pi / sectors))

    # Up to the nearer end, or up to an opening beyond which beams are contradicted
    other = np.where(adjacent, np.where(chosen == left, right, left), chosen)
    limit = np.minimum(directions.limit[chosen], directions.limit[other])
    ends[:, 1] = directions.reach[chosen]
    ends[:, 0] = np.minimum(limit, ends[:, 1])
    is_silent = directions.silent[chosen] | directions.silent[other]
    causes[:, 0] = np.where(is_silent, UnknownCause.NO_ECHO, UnknownCause.BETWEEN_BEAMS)
    causes[:, 1] = UnknownCause.CONTRADICTED
    causes[:, 2] = beams.beyond[nearest[chosen]]

    # Gaps: unused beams without echo, narrow gaps, and sectors outside the view
    heard = np.bincount((np.searchsorted(azimuth, silent) - 1) % count, minlength=count)[left] > 0
    narrow = directions.turn[left] <= 2 * math.pi / GAP + 2 * math.atan(numbers.half_width)
    gap = np.where(narrow, UnknownCause.BETWEEN_BEAMS, UnknownCause.OUTSIDE_VIEW)
    causes[~seen] = np.where(heard, UnknownCause.NO_ECHO, gap)[~seen, None]
    return ends, causes


def plane_text(scan: Scan, mount: Mount) -> str:
    """Return the height of free in the grid of a planar scan, as "free at 0.30 m"; "" for other sensors.

    Parameters
    ----------
    scan : Scan
    mount : Mount
    """
    return f"free at {mount.sensor_height:.2f} m" if scan.kind in ("planar", "cone") else ""


def _rectangle(
    fans: NDArray[np.float64], ends: NDArray[np.float64], place: NDArray[np.float64], spec: GridSpec, pad: float
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the first cell and the shape of the rectangle within reach of fans and ends; at least 1 x 1."""
    low, high = place.copy(), place.copy()
    for rows, column in ((fans, 5), (ends, 2)):
        if len(rows):
            reach = rows[:, column]
            tips = rows[:, :2] * reach[:, np.newaxis] + place
            beside = (reach * rows[:, 2 if column == 5 else 3] + pad)[:, np.newaxis]
            low, high = np.minimum(low, (tips - beside).min(axis=0)), np.maximum(high, (tips + beside).max(axis=0))
    top = np.array(spec.shape) - 1
    first = np.clip(np.floor(low / spec.resolution), 0, top).astype(int)
    last = np.clip(np.floor(high / spec.resolution), first, top).astype(int)
    (i, j), (nx, ny) = first.tolist(), (last - first + 1).tolist()
    return (i, j), (nx, ny)


def _clear_footprint(mass: NDArray[np.float32], cells: Cells, mount: Mount) -> None:
    """Set cells with their centre in the ego footprint to unknown."""
    x0, x1, y0, y1 = np.array(mount.ego_footprint) - np.repeat(mount.origin[:2], 2)
    x, y = (low + (np.arange(n) + 0.5) * cells.resolution for low, n in zip(cells[:2], mass.shape[:2], strict=True))
    mass[np.ix_((x > x0) & (x < x1), (y > y0) & (y < y1))] = 0
