"""Parameters and results of the kernels, as named tuples of arrays and numbers."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "BeamNumbers", "Breaks", "Cells", "Directions", "GroundLimits", "HeightBand", "HeightSpace", "BeamColumns",
    "Points", "PolarGrid", "RayLimits", "RayNumbers", "RayScan", "Rays", "SectorRays", "Surface", "WorkSpace",
]  # fmt: skip


class Cells(NamedTuple):
    """Position and size of the cells of a grid."""

    x0: float  # corner of cell (0, 0) [m]
    y0: float
    resolution: float  # side of a cell [m]


class BeamColumns(NamedTuple):
    """Beams in the plane of a grid, sorted by azimuth; the echoes of a beam are sorted by range."""

    x: NDArray[np.float64]  # (N,) cosine of the azimuth
    y: NDArray[np.float64]  # (N,) sine
    azimuth: NDArray[np.float64]  # (N,) [rad]
    reach: NDArray[np.float64]  # (N,) range of the end, or of the point that leaves the band of heights [m]
    echo: NDArray[np.bool_]  # (N,)
    marks: NDArray[np.bool_]  # (N,) the end is an echo within the band of heights
    beyond: NDArray[np.uint8]  # (N,) `UnknownCause` of the cells beyond the end


class Directions(NamedTuple):
    """Directions that a planar laser measured, sorted by azimuth; the first follows the last."""

    of_beam: NDArray[np.int64]  # (N,) direction of each beam
    x: NDArray[np.float64]  # (D,) cosine of the azimuth
    y: NDArray[np.float64]  # (D,) sine
    reach: NDArray[np.float64]  # (D,) range of the nearest echo, or range of a beam without echo [m]
    silent: NDArray[np.bool_]  # (D,) no echo
    turn: NDArray[np.float64]  # (D,) angle to the next direction [rad]
    jump: NDArray[np.float64]  # (D,) largest step of the range to the next direction on one surface [m]
    adjacent: NDArray[np.bool_]  # (D,) the next direction is one step of the sensor away
    same: NDArray[np.bool_]  # (D,) the next direction is adjacent and ends at the same surface
    limit: NDArray[np.float64]  # (D,) range beyond which neighbours contradict [m]; infinite without contradiction


class BeamNumbers(NamedTuple):
    """Parameters of `PlanarISM` for the comparison of beams."""

    free: float  # largest mass of free
    occupied: float  # largest mass of occupied
    weak: float  # reliability of beams without echo and of wide beams
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
    """Limits of the ground of `local_ground`; see the constants of `ogm.geometric.ground`."""

    max_slope: float  # rise over run from cell to cell
    max_descent: float  # rise over run on average, down from the ground point
    low_tolerance: float  # [m]
    band: float  # [m]


class HeightBand(NamedTuple):
    """Band of heights and minimum range of the returns that `HeightBandISM` uses."""

    low: float  # open interval of heights in the frame of the grid [m]
    high: float
    min_range: float  # nearer returns are ignored [m]


class RayNumbers(NamedTuple):
    """Parameters of `RayISM` for the kernels; see `ogm.geometric.RayISM`."""

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
    """Sectors and rings around the sensor, and the sector and ring of each cell of a grid."""

    step: float  # depth of a bin [m]
    sectors: int
    rows: int  # coarse sectors in which the ground is sampled
    bins: int
    sector: NDArray[np.int16]  # (nx, ny) first sector that the cell touches, counted to the left from the x axis
    span: NDArray[np.int16]  # (nx, ny) number of sectors that the cell subtends, at least 1
    ring: NDArray[np.int16]  # (nx, ny) radial bin; -1 for a cell under the ego vehicle


class RayLimits(NamedTuple):
    """Slopes (rise over run) of the rays that meet the ground or the clearance in each polar bin."""

    ground: NDArray[np.float32]  # (rows, bins)
    clearance: NDArray[np.float32]  # (rows, bins)


class Rays(NamedTuple):
    """Rays, sorted by sector, then by slope."""

    slope: NDArray[np.float32]  # (N,) rise over run
    run: NDArray[np.float32]  # (N,) run of the return [m]
    above: NDArray[np.float32]  # (N,) height of the return above the ground [m]
    point: NDArray[np.int32]  # (N,) index of the return among the points; -1 for a beam without echo
    starts: NDArray[np.int32]  # (sectors + 1,) first ray of each sector


class Breaks(NamedTuple):
    """Sudden rises and falls of the ground in each bin of each profile; see `kernels.breaks`."""

    kind: NDArray[np.int8]  # (profiles, count)
    limit: NDArray[np.float32]  # (profiles, count) height limit of the returns in the break, from the sensor [m]
    begin: NDArray[np.int32]  # (profiles, count) polar bin of the ground before the break
    end: NDArray[np.int32]  # (profiles, count) last bin of the break in the profile
    reliability: NDArray[np.float32]  # (profiles, bins) reliability of free in each polar bin
    broken: NDArray[np.bool_]  # (profiles,) the profile has a break
    width: int  # width of a bin of a profile [polar bins]


class SectorRays(NamedTuple):
    """Class of each ray of a sector, and its bins below clearance."""

    kind: NDArray[np.int8]  # (N,)
    start: NDArray[np.int32]  # (N,) first bin
    stop: NDArray[np.int32]  # (N,) last bin + 1
    block: NDArray[np.int32]  # (N,) bin of an obstacle


class WorkSpace(NamedTuple):
    """Memory for the kernels of a scan, with arbitrary content."""

    sector: NDArray[np.int32]  # (N,), as every array of one dimension except `records` and `indices`
    slope: NDArray[np.float32]
    run: NDArray[np.float32]
    above: NDArray[np.float32]
    records: NDArray[np.float32]  # (4 N,) slope, run and height above ground of each ray, sorted by sector
    indices: NDArray[np.int32]  # (4 N,) the same memory; the fourth value of a record is the ray number
    point: NDArray[np.int32]
    height: NDArray[np.float32]
    counts: NDArray[np.int32]  # (parts, sectors) number of rays
    hits: NDArray[np.int32]  # (parts, nx, ny)
    free: NDArray[np.float32]  # (sectors, bins)


class RayScan(NamedTuple):
    """Points of a scan, the ground below them, and memory for sorted rays and breaks."""

    points: Points
    directions: NDArray[np.float32]  # (M, 3) directions of beams without echo, in the frame of the grid
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
    """Height layers, and memory for their kernels, with arbitrary content."""

    layers: NDArray[np.float32]  # (7, nx, ny) at first the sums over the returns of each cell
    wide: NDArray[np.float32]  # (2, nx, ny) highest and lowest surface along a row
    part: NDArray[np.float32]  # (PARTS,) values of a row
