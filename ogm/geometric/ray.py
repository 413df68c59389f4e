"""Ray model for lidars: rays over a local ground, with separate marking and clearing."""

import logging
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple
from weakref import WeakSet

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.ground import GroundEstimate, flat_ground, local_ground, surface_of
from ogm.geometric.inputs import check_sensor_in_grid, check_within, mount_in_grid, to_vehicle_frame
from ogm.geometric.kernels.arguments import (
    Cells,
    Points,
    PolarGrid,
    RayLimits,
    RayNumbers,
    Rays,
    RayScan,
    Surface,
    WorkSpace,
)  # fmt: skip
from ogm.geometric.kernels.belief import clear_sectors, ray_mass
from ogm.geometric.kernels.breaks import empty_breaks
from ogm.geometric.kernels.chain import AGREE, AIM, PLACE, SORT, ray_step
from ogm.geometric.kernels.evidence import ground_evidence, mark_own_cells, shown_points
from ogm.geometric.kernels.polar import ROW_BITS, polar_lookup, ray_limits
from ogm.geometric.kernels.silence import silence_reliability
from ogm.grid import EvidentialGrid, GridSpec
from ogm.jit import log_compilation
from ogm.pose import rotate
from ogm.scan import Mount, Scan, as_scan
from ogm.threads import shared_threads, spans

_log = logging.getLogger(__name__)

ALL_SHOWN = np.empty(0, np.uint8)  # see `kernels.evidence.ground_evidence`
MAX_BINS = 2**15 - 1  # largest int16, the type of bin numbers in the kernels


class RayTrace(NamedTuple):
    """Rays of a scan, the ground below them and their masses, from which `ogm.models.layers` derives layers.

    Attributes
    ----------
    grid : EvidentialGrid
    mass : (nx, ny, 2) float32
        Masses of the rays alone; `grid` may combine several models.
    mount : Mount
    points : Points
        N returns in the vehicle frame; ``work.above`` begins with their heights above the ground [m].
    ground : Surface
    shown : (N,) or (0,) uint8
        Returns that show the ground, see `kernels.evidence.ground_evidence`.
    rays : Rays
    limits : RayLimits
    polar : PolarGrid
    numbers : RayNumbers
    work : WorkSpace
        Filled by `kernels.belief.clear_sectors`.
    """

    grid: EvidentialGrid
    mass: NDArray[np.float32]
    mount: Mount
    points: Points
    ground: Surface
    shown: NDArray[np.uint8]
    rays: Rays
    limits: RayLimits
    polar: PolarGrid
    numbers: RayNumbers
    work: WorkSpace


@dataclass(frozen=True, eq=False)
class RayISM:
    """Recommended geometric model: local ground, separate marking and clearing, belief from counts.

    Each return is a ray. Obstacle returns (between `obstacle_height` and `clearance` above the *local* ground)
    mark their cell, and so do sudden steps and holes in the ground. All rays clear the cells they pass: rays to
    obstacles, to the ground, to tree crowns and, if given, beams without echo. A ray clears less the higher it passes
    above ground, and not at all above `clearance`. A cell stays unknown if no ray passes low enough, or if a nearer
    obstacle hides some heights above it.

    If a scan does not show the ground, like the scan of a planar laser, the ground is the plane under the mount. All
    returns from 0.05 m above this plane mark, except returns that show the ground; see
    `kernels.evidence.ground_evidence`. The log has a line about it, once for each model. With `flat_ground` the plane
    is always the ground, and returns mark from `obstacle_height` on.

    Counts become belief: R returns give occupied ``1 - p_false_alarm**R`` (as in Bosch's evidential occupancy, CVPR
    2024). Rays give free ``1 - E_H[p_miss**N(H)]``, with the number N(H) of rays below the unknown height H of an
    obstacle; see `kernels.belief.clear_sectors`.

    Parameters
    ----------
    spec : GridSpec
        Grid to fill, in the vehicle frame. It must contain the sensor.
    mount : Mount, optional
        Mount of the sensor; by default the mount of each scan, `Scan.mount`. Returns from the ego footprint are
        dropped, and its cells stay unknown.
    ground : function
        `local_ground`, `flat_ground`, `patchwork_ground` or another function ``(xyz, spec, ground_point) -> height``.
    obstacle_height : float
        Lowest height above the ground map of a return that marks [m]. Steps in the ground mark from 0.2 m on.
    clearance : float
        Height that a vehicle needs [m]. Higher returns do not mark. The paper's band ends at 2.0 m.
    below_ground : float
        Depth below ground, beyond which a return is in a hole or multipath [m].
    hidden_height : float
        Largest thickness of a hanging obstacle behind a nearer obstacle that stops the rays [m].
    hidden_depth : float
        Largest distance of such an obstacle behind the nearer obstacle [m].
    range_noise : float
        Standard deviation of a range [m]; +-3 cm in the VLP-32C's data sheet.
    p_miss : float
        Chance that a ray passes an occupied cell unnoticed. With 0.5, a single ray predicts no far cell free. The
        likeliest value is lower (docs/geometric.md); Bosch's belief model has 0.8.
    p_false_alarm : float
        Chance that a return comes from a free cell. Bosch's belief model has 0.05; two fits on training towns gave
        0.02 and 0.03.
    free_reliability_at_hits : float
        Shafer reliability of the rays that pass a cell with returns of the same scan. With 1, rays and returns are
        evidence of the same state (Bosch's belief model: walls at a grazing angle fade). With 0, only the returns
        count. The default is low because rays pass next to or above the obstacles that other rays hit.
    max_mass : float
        Largest mass from a single scan. The limit lets later scans change a map.
    max_range : float
        Range of an obstacle that a beam would detect, for beams without echo [m].
    no_return_weight : float
        Reliability of beams without echo. Black and wet surfaces give no echo either.
    noise_growth : float
        Growth of the standard deviation of a range with its square [1/m], added to `range_noise`; 0 for lidars. If
        this part exceeds a cell (at least 0.1 m), returns do not mark. Rays still clear up to two deviations before
        the return.
    p_hidden : float
        Chance of a hidden obstacle between two rays, below the lowest or above the highest ray. 0 for lidars, with
        known steps between rays. 1 for depth cameras: pixels without depth and the limits of the view leave gaps.
    azimuth_step : float
        Width of the polar sectors in which rays are counted [rad]. Sectors finer than the sensor's azimuth step
        break free space into streaks. 0.35 deg is a cell of 0.16 m at 26 m.
    ground_cell : float
        Side of the cells of the ground map, at least `spec.resolution` [m].
    threads : int
        Number of threads for each scan, at least 1. It has no effect on results.

    Raises
    ------
    ValueError
        If a number is out of range, or the sensor lies outside the grid.
    """

    spec: GridSpec
    mount: Mount | None = None
    ground: GroundEstimate = local_ground
    obstacle_height: float = 0.15
    clearance: float = 2.0
    below_ground: float = 0.3
    hidden_height: float = 0.5
    hidden_depth: float = 10.0
    range_noise: float = 0.03
    p_miss: float = 0.5
    p_false_alarm: float = 0.05
    free_reliability_at_hits: float = 0.2
    max_mass: float = 0.98
    max_range: float = 100.0
    no_return_weight: float = 0.25
    noise_growth: float = 0.0
    p_hidden: float = 0.0
    azimuth_step: float = 2 * math.pi / 1024
    ground_cell: float = 1.0
    threads: int = 1

    def __post_init__(self) -> None:
        check_sensor_in_grid(self.spec, self.mount)
        if not 0 < self.obstacle_height < self.clearance < math.inf:
            raise ValueError(
                f"obstacle_height must lie above 0 and below clearance, got {self.obstacle_height}, {self.clearance}"
            )
        for name in ("p_miss", "p_false_alarm", "max_mass"):
            check_within(name, getattr(self, name), 0, 1)
        for name in ("below_ground", "hidden_height", "hidden_depth", "max_range", "ground_cell"):
            check_within(name, getattr(self, name), 0, 1e6)
        check_within("range_noise", self.range_noise, -1e-9, 10)
        check_within("noise_growth", self.noise_growth, -1e-9, 1)
        check_within("p_hidden", self.p_hidden, -1e-9, 1 + 1e-9)
        check_within("free_reliability_at_hits", self.free_reliability_at_hits, -1e-9, 1 + 1e-9)
        check_within("no_return_weight", self.no_return_weight, -1e-9, 1 + 1e-9)
        check_within("azimuth_step", self.azimuth_step, 2 * math.pi / 2**15, math.pi / 2)
        if not self.threads >= 1 or self.threads != int(self.threads):
            raise ValueError(f"threads must be a whole number of at least 1, got {self.threads}")

    def __call__(self, scan: Scan | NDArray[np.float32]) -> EvidentialGrid:
        """Map a scan.

        Parameters
        ----------
        scan : Scan or (N, 4) float32
            Uses x, y, z and, if present, the beams without echo (`Scan.no_returns`). NaN and inf rows are dropped and
            counted in the log.

        Returns
        -------
        EvidentialGrid
            Vacuous for an empty scan.
        """
        return self.trace(scan).grid

    def trace(self, scan: Scan | NDArray[np.float32]) -> RayTrace:
        """Map a scan like ``self(scan)``, and return its rays, ground and grid."""
        log_compilation(clear_sectors)
        scan, spec = as_scan(scan), self.spec
        mount = mount_in_grid(scan, spec, self.mount)
        numbers = RayNumbers(*(float(getattr(self, name)) for name in RayNumbers._fields))
        origin = mount.origin.astype(np.float32)
        place = float(origin[0]), float(origin[1])
        polar = polar_grid(spec, place, mount.ego_footprint, self.azimuth_step)
        cells = Cells(*spec.origin, spec.resolution)

        # Points in the vehicle frame, without returns from the ego vehicle
        xyz = to_vehicle_frame(scan.points, mount, mount.ego_footprint)
        points, directions = Points(*xyz.T), _no_return_directions(scan, mount)

        # The ground, from the returns that show it, and the slopes of rays to the ground and the clearance
        threads, is_plane = shared_threads(int(self.threads)), self.ground is flat_ground

        def find_ground(k: int) -> Any:
            if k == self.threads - 1:
                return ALL_SHOWN if is_plane else ground_evidence(points, origin, mount.sensor_height)
            return self._surface(xyz, mount) if k == 0 else None

        found = threads.run(find_ground)
        ground, shown = found[0] if self.threads > 1 else None, found[-1]
        if len(shown):
            self._explain_unseen_ground(int(np.count_nonzero(shown)), mount)
        if ground is None or len(shown):
            ground = self._surface(shown_points(points, shown).T if len(shown) else xyz, mount)
        limits = ray_limits(ground, origin, numbers.clearance, polar)

        # Every beam is a ray
        work = _work_space(len(xyz) + len(directions), polar, threads.count)
        rays = Rays(work.slope, work.run, work.height, work.point, np.empty(polar.sectors + 1, np.int32))
        breaks = empty_breaks(polar)
        returns = RayScan(points, directions, origin, cells, numbers, polar, ground, shown, limits, rays, breaks, work)
        parts = [(*span, k) for k, span in enumerate(spans(len(xyz), threads.count))]
        turn = [(first << ROW_BITS, last << ROW_BITS) for first, last in spans(polar.rows, 2 * threads.count)]
        turns = [[(*span, k) for span in turn[k :: threads.count]] for k in range(threads.count)]  # two opposite spans
        threads.run(lambda k: ray_step(AIM, parts[k], returns))
        threads.run(lambda k: ray_step(PLACE, parts[k], returns))
        threads.run(lambda k: [ray_step(SORT, part, returns) for part in turns[k]])
        ray_step(AGREE, parts[0], returns)
        silence = silence_reliability(rays, limits, polar) if len(directions) else np.ones(polar.bins, np.float32)

        # Rays clear the cells they pass, and mark the steps and holes that stop them
        def clear(k: int) -> None:
            for part in turns[k]:
                clear_sectors(rays, points, limits, polar, cells, breaks, silence, numbers, part, work)

        threads.run(clear)
        if len(shown):
            mark_own_cells(points, work.above, cells, numbers, work.hits)

        # Counts become belief
        mass, rows = np.empty((*spec.shape, 2), np.float32), spans(spec.shape[0], threads.count)
        alarms = _powers(math.sqrt(self.p_false_alarm))
        threads.run(lambda k: ray_mass(work, polar, alarms, numbers, *rows[k], mass))
        grid = EvidentialGrid.trusted(spec, mass)
        return RayTrace(grid, mass, mount, points, ground, shown, rays, limits, polar, numbers, work)

    def _surface(self, xyz: NDArray[np.float32], mount: Mount) -> Surface:
        """Return the surface of the ground from points (N, 3) of a scan."""
        coarse = _ground_spec(self.spec, self.ground_cell)
        return surface_of(_checked_height(self.ground(xyz, coarse, mount.ground_point), coarse), coarse)

    def _explain_unseen_ground(self, shown: int, mount: Mount) -> None:
        """Log, once for each model, that the mount's height sets the ground."""
        if self in _explained:
            return
        _explained.add(self)
        seen = f"only {shown} returns show" if shown else "no return shows"
        _log.warning(
            "%s the ground: the model puts it %.2f m below the sensor, and higher returns mark obstacles; "
            "check `sensor_height`, and use the model `planar` for a planar laser",
            seen,
            mount.sensor_height,
        )


_explained: WeakSet[RayISM] = WeakSet()  # models that have logged that their scans show no ground


def _no_return_directions(scan: Scan, mount: Mount) -> NDArray[np.float32]:
    """Return the directions of a scan's beams without echo in the vehicle frame, (M, 3)."""
    if scan.no_returns is None:
        return np.empty((0, 3), np.float32)
    directions = scan.no_returns[np.isfinite(scan.no_returns).all(axis=1)]
    return np.ascontiguousarray(rotate(mount.T_vehicle_points[:3, :3], directions.T).T, np.float32)


def _checked_height(height: NDArray[Any], spec: GridSpec) -> NDArray[np.float32]:
    """Check the result of a ground estimate, because the kernels do not."""
    if not isinstance(height, np.ndarray) or height.shape != spec.shape or not np.isfinite(height).all():
        got = f"shape {height.shape}" if isinstance(height, np.ndarray) else type(height).__name__
        raise ValueError(f"a ground estimate must return {spec.shape} finite heights [m], got {got}")
    return np.ascontiguousarray(height, np.float32)


@lru_cache(maxsize=16)
def polar_grid(
    spec: GridSpec, place: tuple[float, float], ego_footprint: tuple[float, ...], azimuth_step: float
) -> PolarGrid:
    """Return the polar grid of a spec, computed once for each place of a sensor."""
    row_sectors = 2**ROW_BITS
    sectors = row_sectors * math.ceil(2 * math.pi / azimuth_step / row_sectors - 1e-9)
    (x, y), (x0, x1, y0, y1) = place, spec.extent
    far = math.hypot(max(x1 - x, x - x0), max(y1 - y, y - y0))
    bins = math.ceil(far / spec.resolution) + 1
    if bins > MAX_BINS:
        raise ValueError(
            f"a grid of one scan may reach at most {MAX_BINS} cells from the sensor, this one reaches {bins}; "
            "use coarser cells or a smaller grid"
        )
    cells, footprint = Cells(*spec.origin, spec.resolution), np.array(ego_footprint, np.float32)
    lookup = polar_lookup(cells, spec.shape, np.array([x, y, 0], np.float32), footprint, sectors, bins)
    return PolarGrid(spec.resolution, sectors, sectors // row_sectors, bins, *lookup)


def _work_space(count: int, polar: PolarGrid, parts: int) -> WorkSpace:
    """Allocate the work space for `count` rays in one piece.

    The allocator keeps a single large piece for the next scan. It would return many small pieces to the system, and
    new pages cost as much time as the rays.
    """
    rays: tuple[int, ...] = (count,)
    shapes = [rays, rays, rays, rays, (4 * count,), rays, rays]
    shapes += [(parts, polar.sectors), (parts, *polar.ring.shape), (polar.sectors, polar.bins)]
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    pieces = np.split(np.empty(ends[-1], np.float32), ends[:-1])
    sector, slope, run, above, records, point, height, counts, hits, free = (
        piece.reshape(shape) for piece, shape in zip(pieces, shapes, strict=True)
    )
    return WorkSpace(
        *(sector.view(np.int32), slope, run, above, records, records.view(np.int32), point.view(np.int32), height),
        *(counts.view(np.int32), hits.view(np.int32), free),
    )


@lru_cache(maxsize=16)
def _ground_spec(spec: GridSpec, cell: float) -> GridSpec:
    """Return the spec of the ground map over the area of a grid, with cells at least as large."""
    size = max(cell, spec.resolution)
    return GridSpec(size, (max(math.ceil(spec.length / size), 2), max(math.ceil(spec.width / size), 2)), spec.origin)


@lru_cache(maxsize=64)
def _powers(base: float) -> NDArray[np.float32]:
    """Tabulate ``base ** n`` until it is negligible in float32."""
    return np.append(base ** np.arange(min(math.ceil(-17 / math.log(base)), 2**12)), 0).astype(np.float32)
