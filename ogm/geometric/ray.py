"""The model to use: rays over a local ground, marking apart from clearing."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ogm.geometric.core.belief import clear_sectors, ray_mass
from ogm.geometric.core.polar import ROW_BITS, level_ray_weight, polar_lookup
from ogm.geometric.core.rays import aim_missing, mark_and_aim, sort_rays
from ogm.geometric.ground import GroundEstimate, local_ground
from ogm.geometric.mount import check_sensor_in_grid, check_within, scratch, to_vehicle_frame
from ogm.grid import EvidentialGrid, GridSpec
from ogm.scan import Mount, Scan, as_scan

__all__ = ["RayISM"]

MOST_BINS = 2**15 - 1  # what the kernels count in int16


@dataclass(frozen=True, eq=False)
class RayISM:
    """The geometric model to use: local ground, marking apart from clearing, counts turned into belief.

    Each return is a ray. Obstacle returns (between `obstacle_height` and `clearance` above the *local* ground)
    mark their cell. All rays, also those to the ground, to tree crowns and, if given, those that came back
    empty, clear the cells they pass, the less the higher above ground they pass and not at all above
    `clearance`. Where no ray passes low enough, the cell stays unknown.

    Counts become belief: R returns give occupied ``1 - p_false_alarm**R``, T rays at the ground give free
    ``1 - p_miss**T`` (count-based belief, as in Bosch's evidential occupancy, CVPR 2024), and rays that pass
    higher give less, see `core.belief.clear_sectors`.

    Parameters
    ----------
    spec : GridSpec
        The grid to fill, in the vehicle frame; must hold the sensor.
    mount : Mount
        Where the sensor is mounted. Returns from the ego footprint are dropped, its cells stay unknown.
    ground : function
        `local_ground`, `flat_ground`, `patchwork_ground` or any other ``(xyz, spec, foot) -> height``.
    obstacle_height : float
        Lowest return above ground that marks [m]; kerbs are 0.08 to 0.15 m high.
    clearance : float
        Height that a vehicle needs [m]; what hangs above does not mark. The paper's band ends at 2.0 m.
    below_ground : float
        Returns further below ground are mirror images and are ignored [m].
    range_noise : float
        Standard deviation of a range [m]; +-3 cm in the VLP-32C's data sheet.
    p_miss : float
        Chance that a ray passes an occupied cell unnoticed; 0.8 in Bosch's belief model.
    p_false_alarm : float
        Chance that a return comes from an empty cell; 0.05 in Bosch's belief model.
    free_reliability_at_hits : float
        Shafer reliability of the rays that pass a cell in which others of the same scan were returned. 1
        takes both for witnesses of one state (Bosch's belief model, walls seen at a grazing angle fade); 0
        lets returns win outright. Rays pass beside or above what others hit, hence a low default.
    max_mass : float
        No mass of one scan exceeds this, so that a map can change its mind.
    max_range : float
        How far an obstacle would be seen, for beams that came back empty [m].
    no_return_weight : float
        Weight of such a beam against one that came back: black and wet surfaces swallow beams too.
    azimuth_step : float
        Width of the polar sectors that rays are counted in [rad]; not finer than the sensor's azimuth step,
        or free space falls into streaks. 0.35 deg is a cell of 0.16 m at 26 m.

    Raises
    ------
    ValueError
        If a number is out of its range, or the sensor lies outside the grid.
    """

    spec: GridSpec
    mount: Mount
    ground: GroundEstimate = local_ground
    obstacle_height: float = 0.1
    clearance: float = 2.0
    below_ground: float = 0.3
    range_noise: float = 0.03
    p_miss: float = 0.8
    p_false_alarm: float = 0.05
    free_reliability_at_hits: float = 0.2
    max_mass: float = 0.98
    max_range: float = 100.0
    no_return_weight: float = 0.2
    azimuth_step: float = 2 * math.pi / 1024

    def __post_init__(self) -> None:
        check_sensor_in_grid(self.spec, self.mount)
        if not 0 < self.obstacle_height < self.clearance < math.inf:
            raise ValueError(
                f"obstacle_height must lie above 0 and below clearance, got {self.obstacle_height}, {self.clearance}"
            )
        for name in ("p_miss", "p_false_alarm", "max_mass"):
            check_within(name, getattr(self, name), 0, 1)
        for name in ("below_ground", "max_range"):
            check_within(name, getattr(self, name), 0, 1e6)
        check_within("range_noise", self.range_noise, -1e-9, 10)
        check_within("free_reliability_at_hits", self.free_reliability_at_hits, -1e-9, 1 + 1e-9)
        check_within("no_return_weight", self.no_return_weight, -1e-9, 1 + 1e-9)
        check_within("azimuth_step", self.azimuth_step, 2 * math.pi / 2**15, math.pi / 2)

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
        scan, mount, spec, step = as_scan(scan), self.mount, self.spec, self.spec.resolution
        missing = np.empty((0, 3), np.float32) if scan.no_returns is None else scan.no_returns
        missing = missing[np.isfinite(missing).all(axis=1)]
        xyz = to_vehicle_frame(scan.points, mount, mount.ego_footprint)
        origin = mount.origin.astype(np.float32)

        # The ground, and what a level ray would say above it
        polar = _polar_grid(spec, tuple(origin.tolist()), mount.ego_footprint, self.azimuth_step)
        coarse = _ground_spec(spec)
        height = _checked_height(self.ground(xyz, coarse, mount.ground_point), coarse)
        level = scratch("level", (polar.rows, polar.bins), np.float32)
        level_ray_weight(height, *coarse.origin, coarse.resolution, origin, self.clearance, step, level)

        # Obstacles mark their cells, and every beam is a ray
        hits = scratch("hits", spec.shape, np.int32)
        hits[:] = 0
        rays = scratch("rays", (len(xyz), 3), np.float32)
        starts = mark_and_aim(
            *xyz.T,
            origin,
            height,
            *coarse.origin,
            coarse.resolution,
            level,
            self.obstacle_height,
            self.clearance,
            self.below_ground,
            self.range_noise,
            step,
            polar.sectors,
            *spec.origin,
            spec.resolution,
            hits,
            scratch("sector", (len(xyz),), np.int32),
            scratch("slope", (len(xyz),), np.float32),
            scratch("run", (len(xyz),), np.float32),
            rays,
        )
        directions = (missing @ mount.T_vehicle_points[:3, :3].astype(np.float32).T).astype(np.float32)
        sector, aimed = np.empty(len(missing), np.int32), np.empty((len(missing), 3), np.float32)
        aim_missing(directions, level, self.clearance, step, self.max_range, polar.sectors, sector, aimed)
        empty_rays = np.empty_like(aimed)
        empty_starts = sort_rays(sector, aimed, polar.sectors, empty_rays)

        # Rays clear what they pass
        free = scratch("free", (polar.sectors, polar.bins), np.float32)
        clear_sectors(
            rays,
            starts,
            empty_rays,
            empty_starts,
            self.no_return_weight,
            level,
            self.clearance,
            step,
            polar.sectors / math.pi,
            self.p_miss,
            free,
        )

        # Belief
        mass = np.empty((*spec.shape, 2), np.float32)
        ray_mass(
            free,
            hits,
            polar.sector,
            polar.span,
            polar.ring,
            _powers(math.sqrt(self.p_false_alarm)),
            self.free_reliability_at_hits,
            self.max_mass,
            mass,
        )
        return EvidentialGrid.trusted(spec, mass)


def _checked_height(height: NDArray, spec: GridSpec) -> NDArray[np.float32]:
    """Check what a ground estimate returned: the kernels trust it."""
    if not isinstance(height, np.ndarray) or height.shape != spec.shape or not np.isfinite(height).all():
        got = f"shape {height.shape}" if isinstance(height, np.ndarray) else type(height).__name__
        raise ValueError(f"a ground estimate must return {spec.shape} finite heights [m], got {got}")
    return np.ascontiguousarray(height, np.float32)


@dataclass(frozen=True, eq=False)
class _PolarGrid:
    """Sectors and rings around the sensor, and where each cell of a grid lies among them."""

    sectors: int
    bins: int
    rows: int  # coarse sectors in which the ground is sampled
    sector: NDArray[np.int16]
    span: NDArray[np.int16]
    ring: NDArray[np.int16]


@lru_cache(maxsize=16)
def _polar_grid(
    spec: GridSpec,
    origin: tuple[float, float, float],
    box: tuple[float, float, float, float],
    azimuth_step: float,
) -> _PolarGrid:
    """Lay the polar grid over a spec; computed once for each mount."""
    together = 2**ROW_BITS
    sectors = together * math.ceil(2 * math.pi / azimuth_step / together - 1e-9)
    x0, x1, y0, y1 = spec.extent
    far = math.hypot(max(x1 - origin[0], origin[0] - x0), max(y1 - origin[1], origin[1] - y0))
    bins = math.ceil(far / spec.resolution) + 1
    if max(bins, math.ceil(far)) > MOST_BINS:
        raise ValueError(
            f"a grid of one scan may reach at most {MOST_BINS} cells and {MOST_BINS} m from the sensor, "
            f"this one reaches {far:g} m, {bins} cells; use coarser cells or a smaller grid"
        )
    sector, span, ring = (np.empty(spec.shape, np.int16) for _ in range(3))
    polar_lookup(
        *spec.origin,
        spec.resolution,
        np.array(origin, np.float32),
        np.array(box, np.float32),
        sectors,
        spec.resolution,
        bins,
        sector,
        span,
        ring,
    )
    return _PolarGrid(sectors, bins, sectors // together, sector, span, ring)


@lru_cache(maxsize=16)
def _ground_spec(spec: GridSpec, resolution: float = 1.0) -> GridSpec:
    """Return cells of about 1 m over the area of a grid."""
    nx, ny = (max(math.ceil(size / resolution), 2) for size in (spec.length, spec.width))
    return GridSpec(resolution, (nx, ny), spec.origin)


@lru_cache(maxsize=64)
def _powers(base: float) -> NDArray[np.float32]:
    """Tabulate ``base ** n`` until it does not matter in float32."""
    return np.append(base ** np.arange(min(math.ceil(-17 / math.log(base)), 2**12)), 0).astype(np.float32)
