"""What kernels take and return: arrays and numbers that belong together."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "BeamNumbers", "Breaks", "Cells", "Directions", "GroundLimits", "HeightBand", "HeightSpace", "BeamColumns",
    "Points", "PolarGrid", "RayLimits", "RayNumbers", "RayScan", "Rays", "SectorRays", "Surface", "WorkSpace",
]  # fmt: skip


class Cells(NamedTuple):
    """Where the cells of a grid lie."""

    x0: float  # corner of cell (0, 0) [m]
    y0: float
    resolution: float  # side of a cell [m]


class BeamColumns(NamedTuple):
    """Beams in the plane of a grid, in the order of their azimuths, echoes of one beam in that of their ranges."""

    x: NDArray[np.float64]  # (N,) cosine of the azimuth
    y: NDArray[np.float64]  # (N,) sine
    azimuth: NDArray[np.float64]  # (N,) [rad]
    reach: NDArray[np.float64]  # (N,) range of the end, or where the beam leaves the heights that count [m]
    echo: NDArray[np.bool_]  # (N,)
    marks: NDArray[np.bool_]  # (N,) the end is an echo, at a height that counts
    beyond: NDArray[np.uint8]  # (N,) `UnknownCause` of the cells beyond the end


class Directions(NamedTuple):
    """Directions that a planar laser measured, in the order of their azimuths; the last is before the first."""

    of_beam: NDArray[np.int64]  # (N,) direction of each beam
    x: NDArray[np.float64]  # (D,) cosine of the azimuth
    y: NDArray[np.float64]  # (D,) sine
    reach: NDArray[np.float64]  # (D,) range of the nearest echo, or up to which a beam without echo counts [m]
    silent: NDArray[np.bool_]  # (D,) no echo
    turn: NDArray[np.float64]  # (D,) angle to the next one [rad]
    jump: NDArray[np.float64]  # (D,) step of the range to the next one that one surface can explain [m]
    adjacent: NDArray[np.bool_]  # (D,) the next one is one step of the sensor away
    same: NDArray[np.bool_]  # (D,) and ends at the same surface
    limit: NDArray[np.float64]  # (D,) range beyond which neighbours contradict [m], infinity for none


class BeamNumbers(NamedTuple):
    """The parameters of `PlanarISM` that the comparison of beams uses."""

    free: float  # greatest mass
    occupied: float
    weak: float  # reliability of beams without echo, and of wide ones
    half_width: float  # tangent of half the width of a beam
    side: float  # of a cell [m]
    cone: bool  # beams have no neighbours


class Points(NamedTuple):
    """Points in the frame of the grid."""

    x: NDArray[np.float32]  # (N,) [m], as y and z
    y: NDArray[np.float32]
    z: NDArray[np.float32]


class Surface(NamedTuple):
    """Heights at the middles of the cells of a grid."""

    height: NDArray[np.float32]  # (gx, gy) [m], at least 2 x 2
    x0: np.float32  # corner of cell (0, 0) [m]
    y0: np.float32
    per_metre: np.float32  # cells per metre


class GroundLimits(NamedTuple):
    """What `local_ground` takes for ground; see the constants of `ogm.geometric.ground`."""

    max_slope: float  # rise over run from cell to cell
    max_descent: float  # rise over run on average, down from the ground point
    low_tolerance: float  # [m]
    band: float  # [m]


class HeightBand(NamedTuple):
    """Which returns `HeightBandISM` uses."""

    low: float  # open interval of heights in the frame of the grid [m]
    high: float
    min_range: float  # nearer returns are ignored [m]


class RayNumbers(NamedTuple):
    """The parameters of `RayISM` that kernels use; see there."""

    obstacle_height: float
    clearance: float
    below_ground: float
    hidden_height: float
    hidden_depth: float
    range_noise: float
    p_miss: float
    free_reliability_at_hits: float
    max_mass: float
    max_range: float
    no_return_weight: float
    noise_growth: float
    p_hidden: float


class PolarGrid(NamedTuple):
    """Sectors and rings around the sensor, and where each cell of a grid lies among them."""

    step: float  # depth of a bin [m]
    sectors: int
    rows: int  # coarse sectors in which the ground is sampled
    bins: int
    sector: NDArray[np.int16]  # (nx, ny) first sector that the cell touches, counted to the left from the x axis
    span: NDArray[np.int16]  # (nx, ny) how many sectors it subtends, at least one
    ring: NDArray[np.int16]  # (nx, ny) radial bin; -1 for a cell under the ego vehicle


class RayLimits(NamedTuple):
    """Slopes (rise over run) of the rays that meet the ground, and the clearance above it, in each polar bin."""

    ground: NDArray[np.float32]  # (rows, bins)
    clearance: NDArray[np.float32]  # (rows, bins)


class Rays(NamedTuple):
    """Rays, sorted by sector and in a sector by slope."""

    slope: NDArray[np.float32]  # (N,) rise over run
    run: NDArray[np.float32]  # (N,) of the return [m]
    above: NDArray[np.float32]  # (N,) height of the return above the ground [m]
    point: NDArray[np.int32]  # (N,) of the return among the points; -1 for a beam without echo
    starts: NDArray[np.int32]  # (sectors + 1,) where each sector begins


class Breaks(NamedTuple):
    """Where the ground rises or falls suddenly: one entry for each bin of each profile, see `kernels.breaks`."""

    kind: NDArray[np.int8]  # (profiles, count)
    limit: NDArray[np.float32]  # (profiles, count) height beyond which returns are in the break, from the sensor [m]
    begin: NDArray[np.int32]  # (profiles, count) polar bin of the ground before it
    end: NDArray[np.int32]  # (profiles, count) last bin of the profile in it
    reliability: NDArray[np.float32]  # (profiles, bins) of belief in free, in each polar bin
    broken: NDArray[np.bool_]  # (profiles,) that have a break
    width: int  # of a profile's bin, in polar bins


class SectorRays(NamedTuple):
    """The rays of one sector: what they hit, and the bins in which they are below clearance."""

    kind: NDArray[np.int8]  # (N,)
    start: NDArray[np.int32]  # (N,) first bin
    stop: NDArray[np.int32]  # (N,) first bin after these
    block: NDArray[np.int32]  # (N,) bin of an obstacle


class WorkSpace(NamedTuple):
    """Memory for the kernels of one scan, with arbitrary content."""

    sector: NDArray[np.int32]  # (N,) as all of one dimension but the records
    slope: NDArray[np.float32]
    run: NDArray[np.float32]
    above: NDArray[np.float32]
    records: NDArray[np.float32]  # (4 N,) slope, run and height above ground of each ray, by sectors
    indices: NDArray[np.int32]  # (4 N,) the same memory: the fourth value of a record is the number of the ray
    point: NDArray[np.int32]
    height: NDArray[np.float32]
    counts: NDArray[np.int32]  # (parts, sectors) rays
    hits: NDArray[np.int32]  # (parts, nx, ny)
    free: NDArray[np.float32]  # (sectors, bins)


class RayScan(NamedTuple):
    """One scan, from points over a known ground to sorted rays and breaks."""

    points: Points
    directions: NDArray[np.float32]  # (M, 3) of beams without echo, in the frame of the grid
    origin: NDArray[np.float32]  # (3,) the sensor [m]
    cells: Cells
    numbers: RayNumbers
    polar: PolarGrid
    ground: Surface
    shown: NDArray[np.uint8]  # (N,) or (0,) returns that show the ground
    limits: RayLimits
    rays: Rays
    breaks: Breaks
    work: WorkSpace


class HeightSpace(NamedTuple):
    """Layers of heights, and memory of their kernels with arbitrary content."""

    layers: NDArray[np.float32]  # (7, nx, ny); first it holds the sums over the returns of each cell
    wide: NDArray[np.float32]  # (2, nx, ny) highest and lowest surface along a row
    part: NDArray[np.float32]  # (PARTS,) of one row
