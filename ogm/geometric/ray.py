"""The model to use: rays over a local ground, marking apart from clearing."""

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
MAX_BINS = 2**15 - 1  # what the kernels count in int16


class RayTrace(NamedTuple):
    """The rays of one scan, the ground below them and their masses: `ogm.models.layers` derives layers from them.

    Attributes
    ----------
    grid : EvidentialGrid
    mass : (nx, ny, 2) float32
        Masses by the rays alone; `grid` may hold several models combined.
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
        As `kernels.belief.clear_sectors` filled it.
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
    """The geometric model to use: local ground, marking apart from clearing, counts turned into belief.

    Each return is a ray. Obstacle returns (between `obstacle_height` and `clearance` above the *local* ground)
    mark their cell, and so do sudden steps and holes in the ground. All rays, also those to the ground, to tree
    crowns and, if given, beams without echo, clear the cells they pass, the less the higher above ground they pass
    and not at all above `clearance`. Where no ray passes low enough, or an obstacle before the cell hides some
    heights above it, the cell stays unknown.

    Where a scan does not show the ground, as that of a planar laser, the plane under the mount is the ground, and all
    returns from 0.05 m above it mark, except those of beams that meet one surface one behind another; see
    `kernels.evidence.ground_evidence`. A line in the log states it, once for each model. With `flat_ground` the plane
    is the ground in any case, and returns mark from `obstacle_height` on.

    Counts become belief: R returns give occupied ``1 - p_false_alarm**R`` (as in Bosch's evidential occupancy, CVPR
    2024), and rays give free ``1 - E_H[p_miss**N(H)]`` with N(H) the number of rays below the unknown height H of an
    obstacle, see `kernels.belief.clear_sectors`.

    Parameters
    ----------
    spec : GridSpec
        The grid to fill, in the vehicle frame; must hold the sensor.
    mount : Mount, optional
        Where the sensor is mounted; by default each scan's own, `Scan.mount`.
        Returns from the ego footprint are dropped, its cells stay unknown.
    ground : function
        `local_ground`, `flat_ground`, `patchwork_ground` or any other ``(xyz, spec, ground_point) -> height``.
    obstacle_height : float
        Lowest return above the ground map that marks [m]. Steps in the ground mark from 0.1 m on, whatever this is.
    clearance : float
        Height that a vehicle needs [m]; what hangs above does not mark. The paper's band ends at 2.0 m.
    below_ground : float
        Returns further below ground are in a hole or multipath [m].
    hidden_height : float
        Largest thickness of something that hangs where no ray passes, because an obstacle before it stops them [m].
    hidden_depth : float
        How far such a thing may reach back from that obstacle [m].
    range_noise : float
        Standard deviation of a range [m]; +-3 cm in the VLP-32C's data sheet.
    p_miss : float
        Chance that a ray passes an occupied cell unnoticed. With 0.5, one ray alone predicts no far cell free; the
        likeliest value is lower (docs/geometric.md), and 0.8 in Bosch's belief model.
    p_false_alarm : float
        Chance that a return comes from an empty cell; 0.05 in Bosch's belief model; two fits on training towns gave
        0.02 and 0.03.
    free_reliability_at_hits : float
        Shafer reliability of the rays that pass a cell in which others of the same scan were returned. With 1,
        both are evidence of one state (Bosch's belief model: walls at a grazing angle fade); with 0, only the
        returns count. Rays pass beside or above what others hit, hence a low default.
    max_mass : float
        No mass of one scan exceeds this, so that a map can change its mind.
    max_range : float
        How far an obstacle would be seen, for beams without echo [m].
    no_return_weight : float
        Reliability of these beams as a source: black and wet surfaces swallow beams too.
    noise_growth : float
        Growth of the standard deviation of a range with its square [1/m], added to `range_noise`: 0 for lidars. Where
        it exceeds a cell (0.1 m at least), returns do not mark, and rays still clear up to two deviations before.
    p_hidden : float
        Chance that something is hidden between two rays, below the lowest or above the highest one, though no ray shows
        it. 0 for lidars, whose rays differ by known steps; 1 for depth cameras: what has no depth, and what lies
        outside of the view, leaves a gap.
    azimuth_step : float
        Width of the polar sectors that rays are counted in [rad]; not finer than the sensor's azimuth step,
        or free space falls into streaks. 0.35 deg is a cell of 0.16 m at 26 m.
    ground_cell : float
        Side of the cells of the ground map, at least that of the grid's cells [m].
    threads : int
        Number of threads for each scan, at least 1. Results are identical for any number of threads.

    Raises
    ------
    ValueError
        If a number is out of its range, or the sensor lies outside the grid.
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
        """Map one scan.

        Parameters
        ----------
        scan : Scan or (N, 4) float32
            Uses x, y, z and, where it has them, the beams without echo (`Scan.no_returns`). NaN and inf rows are
            dropped and counted in the log.

        Returns
        -------
        EvidentialGrid
            Vacuous for an empty scan.
        """
        return self.trace(scan).grid

    def trace(self, scan: Scan | NDArray[np.float32]) -> RayTrace:
        """Map one scan, and keep its rays and its ground. The parameter is that of a call."""
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

        # The ground, by the returns that show it, and the rays that meet it and the clearance above it
        threads, is_plane = shared_threads(int(self.threads)), self.ground is flat_ground  # whatever the returns show

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
        turns = [[(*span, k) for span in turn[k :: threads.count]] for k in range(threads.count)]  # two opposite ones
        threads.run(lambda k: ray_step(AIM, parts[k], returns))
        threads.run(lambda k: ray_step(PLACE, parts[k], returns))
        threads.run(lambda k: [ray_step(SORT, part, returns) for part in turns[k]])
        ray_step(AGREE, parts[0], returns)
        silence = silence_reliability(rays, limits, polar) if len(directions) else np.ones(polar.bins, np.float32)

        # Rays clear what they pass, and mark steps and holes that stop them
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
        """Return the surface of the ground by some points (N, 3) of a scan."""
        coarse = _ground_spec(self.spec, self.ground_cell)
        return surface_of(_checked_height(self.ground(xyz, coarse, mount.ground_point), coarse), coarse)

    def _explain_unseen_ground(self, shown: int, mount: Mount) -> None:
        """Log, once for each model, that the mount's height decides what is ground."""
        if self in _explained:
            return
        _explained.add(self)
        seen = f"only {shown} returns show" if shown else "no return shows"
        _log.warning(
            "%s the ground: it is taken to lie %.2f m below the sensor, and what rises above it is an obstacle; "
            "check `sensor_height`, and use the model `planar` for a laser in one plane",
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
    """Check what a ground estimate returned: the kernels trust it."""
    if not isinstance(height, np.ndarray) or height.shape != spec.shape or not np.isfinite(height).all():
        got = f"shape {height.shape}" if isinstance(height, np.ndarray) else type(height).__name__
        raise ValueError(f"a ground estimate must return {spec.shape} finite heights [m], got {got}")
    return np.ascontiguousarray(height, np.float32)


@lru_cache(maxsize=16)
def polar_grid(
    spec: GridSpec, place: tuple[float, float], ego_footprint: tuple[float, ...], azimuth_step: float
) -> PolarGrid:
    """Lay the polar grid over a spec; computed once for each place of a sensor."""
    together = 2**ROW_BITS
    sectors = together * math.ceil(2 * math.pi / azimuth_step / together - 1e-9)
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
    return PolarGrid(spec.resolution, sectors, sectors // together, bins, *lookup)


def _work_space(count: int, polar: PolarGrid, parts: int) -> WorkSpace:
    """Allocate the work space for `count` rays in one piece.

    The allocator keeps one large piece for the next scan; the pages of many it would return to the system, and
    fresh pages cost as much time as the rays.
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
    """Return cells of the ground map over the area of a grid; not finer than those of the grid."""
    size = max(cell, spec.resolution)
    return GridSpec(size, (max(math.ceil(spec.length / size), 2), max(math.ceil(spec.width / size), 2)), spec.origin)


@lru_cache(maxsize=64)
def _powers(base: float) -> NDArray[np.float32]:
    """Tabulate ``base ** n`` until it does not matter in float32."""
    return np.append(base ** np.arange(min(math.ceil(-17 / math.log(base)), 2**12)), 0).astype(np.float32)
