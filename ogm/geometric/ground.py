"""Ground estimates: the height of the ground in each cell of a coarse grid, from one scan.

A ground estimate is a function ``(xyz, spec, ground_point) -> height`` of points in the vehicle frame, the grid to fill
and the ground under the sensor. `RayISM` takes any; this module has `flat_ground`, `local_ground` and
`patchwork_ground`.
"""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ogm.extras import install_line
from ogm.geometric.inputs import to_vehicle_frame
from ogm.geometric.kernels.arguments import Cells, GroundLimits, Points, Surface
from ogm.geometric.kernels.evidence import ground_evidence
from ogm.geometric.kernels.surface import fill, ground_heights, sample_many
from ogm.grid import GridSpec
from ogm.scan import Mount, Scan

GroundPoint = tuple[float, float, float]
GroundEstimate = Callable[[NDArray[np.float32], GridSpec, GroundPoint], NDArray[np.float32]]

MAX_SLOPE = 0.25  # greatest rise over run of ground; public roads reach 0.15, ramps and banks more
MAX_DESCENT = 0.15  # greatest mean descent from the vehicle; lower returns are taken for multipath
LOW_TOLERANCE = 0.4  # [m] greatest depth of a cell below its surroundings, in addition to that descent
BAND = 0.25  # [m] thickness of the layer of returns that is averaged into a cell's ground height
STEEP, STEEP_SHARE = math.radians(10), 0.02  # angle and share of returns by which a lidar points down
SENSOR_HEIGHT = 1.8  # [m] sensor height in the frame of the points passed to Patchwork++


def flat_ground(xyz: NDArray[np.float32], spec: GridSpec, ground_point: GroundPoint) -> NDArray[np.float32]:
    """Return the horizontal plane under the sensor; the points are not used.

    Parameters
    ----------
    xyz : (N, 3) float32
        Points in the vehicle frame [m].
    spec : GridSpec
        Cells to fill.
    ground_point : (float, float, float)
        x, y, z of the ground under the sensor, in the vehicle frame [m]; inside `spec`.

    Returns
    -------
    (nx, ny) float32
        Height of the ground at each cell centre [m].
    """
    return np.full(spec.shape, ground_point[2], np.float32)


def local_ground(
    xyz: NDArray[np.float32], spec: GridSpec, ground_point: GroundPoint, max_slope: float = MAX_SLOPE
) -> NDArray[np.float32]:
    """Estimate the ground as the highest surface below the points within the slope limit.

    1. Take the lowest return of each cell. Drop stray returns, which lie too far below the ground around them.
    2. Take the lower envelope of these heights and of the ground point under the slope limit (a cone grown from every
       cell). Walls, cars and crowns stand above the envelope, ramps and hills do not.
    3. A cell is ground if its lowest return touches the envelope. Its height is the mean of its lowest layer of
       returns. If the next layer is thin and holds ten times as many returns, the lowest returns are stray and that
       layer counts instead.
    4. Fill the other cells by a smooth surface through the ground cells (pull-push, Gortler et al. 1996).

    For parameters and result see `flat_ground`; `max_slope` is the greatest rise over run of ground.

    Raises
    ------
    ValueError
        If the ground point lies outside `spec`, or `spec` has fewer than 2 x 2 cells.
    """
    if not spec.contains(ground_point[0], ground_point[1]):
        raise ValueError(
            f"the ground point x={ground_point[0]:g}, y={ground_point[1]:g} m must lie inside the grid {spec.extent}"
        )
    if min(spec.shape) < 2:
        raise ValueError(f"a map of the ground needs 2 x 2 cells or more, got {spec.shape}")
    points = Points(*(np.ascontiguousarray(xyz[:, k]) for k in range(3)))
    limits = GroundLimits(float(max_slope), MAX_DESCENT, LOW_TOLERANCE, BAND)
    x, y, z = ground_point
    cells = Cells(*spec.origin, spec.resolution)
    return ground_heights(points, (float(x), float(y), float(z)), cells, spec.shape, limits)


def patchwork_ground(xyz: NDArray[np.float32], spec: GridSpec, ground_point: GroundPoint) -> NDArray[np.float32]:
    """Estimate the ground with Patchwork++ (Lee et al. 2022), if ``pypatchworkpp`` is installed.

    For parameters and result see `flat_ground`.

    Raises
    ------
    ImportError
        If the package is not installed; the message has the pip command.
    """
    try:
        import pypatchworkpp
    except ImportError as error:
        raise ImportError(f"patchwork_ground needs pypatchworkpp: {install_line('ground')}") from error
    parameters = pypatchworkpp.Parameters()
    parameters.verbose = False
    parameters.sensor_height = SENSOR_HEIGHT
    estimator = pypatchworkpp.patchworkpp(parameters)
    x, y, z = ground_point
    shift = np.array([x, y, z + SENSOR_HEIGHT], np.float32)  # Patchwork++ expects the sensor at (0, 0, 0)
    estimator.estimateGround(np.pad(xyz - shift, ((0, 0), (0, 1))))  # intensity 0 for all
    ground = xyz[np.asarray(estimator.getGroundIndices(), np.int64)]
    total, count = np.zeros(spec.shape), np.zeros(spec.shape)
    inside = spec.contains(ground[:, 0], ground[:, 1])
    cell = spec.index(ground[inside, 0], ground[inside, 1])
    np.add.at(total, cell, ground[inside, 2])
    np.add.at(count, cell, 1)
    height = np.zeros(spec.shape, np.float32)
    height[count > 0] = total[count > 0] / count[count > 0]
    fill(height, np.minimum(count, 8).astype(np.float32), np.float32(ground_point[2]))
    return height


def shows_ground(scan: Scan, mount: Mount) -> bool:
    """Return whether a scan shows the ground, see `kernels.evidence.ground_evidence`; True without points."""
    xyz = to_vehicle_frame(scan.points, mount, mount.ego_footprint)
    return not len(ground_evidence(Points(*xyz.T), mount.origin.astype(np.float32), mount.sensor_height))


def points_down(scan: Scan, mount: Mount) -> bool:
    """Return whether `STEEP_SHARE` of the returns come from more than `STEEP` below the horizon; False without points.

    Beams that point down reach the ground within six times the sensor's height, unless something hides it.
    """
    x, y, z = (to_vehicle_frame(scan.points, mount, mount.ego_footprint)[:, :3] - mount.origin).T
    steep = -z > math.tan(STEEP) * np.hypot(x, y)
    return bool(steep.sum() > STEEP_SHARE * len(steep))


def ground_height(height: NDArray[np.float32], spec: GridSpec, xyz: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the ground height under each point, bilinear between cell centres.

    Parameters
    ----------
    height : (nx, ny) float32
        Result of a ground estimate for `spec` [m].
    spec : GridSpec
    xyz : (N, 3 or more) float32
        Points in the frame of `spec` [m]. Beyond the outermost cell centres the height is constant.

    Returns
    -------
    (N,) float32
        Height of the ground [m]; ``xyz[:, 2]`` minus this is the height above ground.
    """
    x, y = np.ascontiguousarray(xyz[:, 0], np.float32), np.ascontiguousarray(xyz[:, 1], np.float32)
    return sample_many(surface_of(height, spec), x, y)


def surface_of(height: NDArray[np.float32], spec: GridSpec) -> Surface:
    """Return the heights of grid cells as input of the kernels, padded to at least 2 x 2 cells."""
    if 1 in height.shape:
        height = np.pad(height, [(0, int(n == 1)) for n in height.shape], mode="edge")
    x0, y0 = spec.origin
    return Surface(height, np.float32(x0), np.float32(y0), np.float32(1.0 / spec.resolution))
