"""Where the ground is: from one scan to a map of ground heights.

A ground estimate is a function ``(xyz, spec, ground_point) -> height``: points in the vehicle frame, the coarse
grid to fill and the ground under the sensor go in, one height per cell comes out. `RayISM` takes any;
`flat_ground`, `local_ground` and `patchwork_ground` are the ones at hand.
"""

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

MAX_SLOPE = 0.25  # rise over run that still counts as ground; public roads reach 0.15, ramps and banks more
MAX_DESCENT = 0.15  # average descent from the vehicle below which returns are taken for multipath
LOW_TOLERANCE = 0.4  # [m] what a cell may lie below its surroundings beyond that descent
BAND = 0.25  # [m] thickness of the layer of returns that is averaged into a cell's ground height
SENSOR_HEIGHT = 1.8  # [m] of the sensor in the frame that Patchwork++ is given


def flat_ground(xyz: NDArray[np.float32], spec: GridSpec, ground_point: GroundPoint) -> NDArray[np.float32]:
    """Take the ground to be the plane under the sensor, whatever the points are.

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
        Height of the ground at each cell's middle [m].
    """
    return np.full(spec.shape, ground_point[2], np.float32)


def local_ground(
    xyz: NDArray[np.float32], spec: GridSpec, ground_point: GroundPoint, max_slope: float = MAX_SLOPE
) -> NDArray[np.float32]:
    """Estimate the ground as the highest surface below the points that nowhere climbs faster than a road can.

    1. the lowest return of each cell; what lies too far below the ground around it is stray and dropped;
    2. the lower envelope of these heights, and of the ground point, under the slope limit (a cone grown from every
       cell): walls, cars and crowns stand above it, ramps and hills do not;
    3. cells whose lowest return touches the envelope are ground; the mean of their lowest layer of returns is the
       height, or of the layer above it, where that is thin and holds ten times the returns (the lowest are
       stray);
    4. cells without ground take a smooth surface through the known ones (pull-push, Gortler et al. 1996).

    Parameters and result are those of `flat_ground`; `max_slope` is the steepest rise over run that is ground.

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

    Parameters, returns : see `flat_ground`

    Raises
    ------
    ImportError
        If the package is absent; the message holds the pip command that adds it.
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
    shift = np.array([x, y, z + SENSOR_HEIGHT], np.float32)  # it wants the sensor at (0, 0, 0)
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
    """Return whether a scan as a whole shows the ground, see `ground_evidence`; True without points."""
    xyz = to_vehicle_frame(scan.points, mount, mount.ego_footprint)
    return not len(ground_evidence(Points(*xyz.T), mount.origin.astype(np.float32), mount.sensor_height))


def ground_height(height: NDArray[np.float32], spec: GridSpec, xyz: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the ground's height under each point, bilinear between the cells' middles.

    Parameters
    ----------
    height : (nx, ny) float32
        What a ground estimate returned for `spec` [m].
    spec : GridSpec
    xyz : (N, 3 or more) float32
        Points in the frame of `spec` [m]. Beyond the outermost middles the edge's height holds.

    Returns
    -------
    (N,) float32
        Height of the ground [m]; ``xyz[:, 2]`` minus this is the height above ground.
    """
    x, y = np.ascontiguousarray(xyz[:, 0], np.float32), np.ascontiguousarray(xyz[:, 1], np.float32)
    return sample_many(surface_of(height, spec), x, y)


def surface_of(height: NDArray[np.float32], spec: GridSpec) -> Surface:
    """Return heights on the cells of a grid as kernels take them: at least 2 x 2."""
    if 1 in height.shape:
        height = np.pad(height, [(0, int(n == 1)) for n in height.shape], mode="edge")
    x0, y0 = spec.origin
    return Surface(height, np.float32(x0), np.float32(y0), np.float32(1.0 / spec.resolution))
