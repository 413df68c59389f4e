"""Scans and contenders of `speed.py` and `ground.py`: ogm's models, slow references, other libraries."""

import _run as run  # first: it sets the number of threads

# isort: split
import importlib
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from _timing import Contender
from numpy.typing import NDArray

from ogm import GridSpec, Mount, read_points
from ogm.geometric import HeightBandISM, RayISM, local_ground, reference
from ogm.io import estimate_sensor_height

HEIGHT_BAND, RAY, COPY = "HeightBandISM", "RayISM", "copy of the bytes it must read and write"
PYTHON, NUMPY = "HeightBandISM in plain Python", "HeightBandISM in numpy"
OCTOMAP = "OctoMap"  # all of its contenders' names begin so
OCTOMAP_OPTIONS = {"": (False, False), ", lazy": (True, False), ", lazy, discretised": (True, True)}
KISS, LOCAL, PATCHWORK = "KISS-SLAM mapper", "local_ground", "Patchwork++"
STREET_HEIGHT = 1.9  # [m] of the sensor in the synthetic scan
CARS = ((8, 4), (16, 4), (31, -5), (-9, -5), (-22, 4), (-35, -5), (48, 3))  # [m] 4.4 x 1.8 x 1.5 m each


class NamedScan(NamedTuple):
    """Points in the sensor's frame, how high the sensor is [m], and where they come from."""

    name: str
    points: NDArray[np.float32]
    sensor_height: float
    source: str


def real_scans(path: Path | None) -> list[NamedScan]:
    """Return the user's scan, or those at hand: one ships with the package, one is the user's to download."""
    if path is not None:
        points = read_points(path)
        height = estimate_sensor_height(points)
        if height is None or height <= 0:
            raise SystemExit(f"{path}: no ground around the sensor, so its height is not known")
        source = f"{path.name}, sensor height estimated from the points"
        return [NamedScan(path.name, points, round(height, 2), source)]
    kitti, vls = run.DATA / "kitti_odometry_00" / "000000.bin", run.ROOT / "ogm/data/vls128_road.pcd.xz"
    scans = [NamedScan("VLS-128", read_points(vls), 1.98, "VLS-128 on a road, TIER IV nebula, Apache-2.0")]
    if not kitti.is_file():
        print(f"no {kitti.name} of KITTI odometry under {run.DATA}: done without it")
        return scans
    source = "KITTI odometry, sequence 00, scan 000000"
    return [NamedScan("KITTI HDL-64E", read_points(kitti), 1.73, source), *scans]


def thinned(points: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """Return `count` of the points, drawn without replacement and in their order."""
    if len(points) <= count:
        return points
    return points[np.sort(np.random.default_rng(0).choice(len(points), count, replace=False))]


def street(count: int, layers: int = 64) -> NDArray[np.float32]:
    """Return about `count` points of a street: a road with a slope of 3 %, house fronts all around, parked cars.

    Beams go -25 to +2 degrees up; every beam returns, from the nearest of them, with 2 cm of range noise.
    """
    columns, slope = round(count / layers), 0.03
    elevation = np.radians(np.linspace(2, -25, layers))[:, None]
    azimuth = (np.arange(columns) * 2 * math.pi / columns)[None, :]
    across = np.cos(elevation)
    beam = [across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation) + 0 * azimuth]
    beam = [np.where(np.abs(b) < 1e-9, 1e-9, b).ravel() for b in beam]
    climb = beam[2] - slope * beam[0]
    distance = np.where(climb < 0, -STREET_HEIGHT / np.minimum(climb, -1e-9), np.inf)  # road
    for k, wall in ((0, 70.0), (1, 14.0)):  # fronts at x = +-70 m, y = +-14 m
        distance = np.minimum(distance, wall / np.abs(beam[k]))
    for x, y in CARS:
        bottom = slope * x - STREET_HEIGHT
        enter, leave = np.zeros_like(distance), np.full_like(distance, np.inf)
        lowest, highest = (x - 2.2, y - 0.9, bottom), (x + 2.2, y + 0.9, bottom + 1.5)
        for b, low, high in zip(beam, lowest, highest, strict=True):
            enter = np.maximum(enter, np.minimum(low / b, high / b))
            leave = np.minimum(leave, np.maximum(low / b, high / b))
        distance = np.where(enter < leave, np.minimum(distance, enter), distance)
    distance += np.random.default_rng(0).normal(0, 0.02, distance.shape)
    return np.stack([*(distance * b for b in beam), np.full_like(distance, 0.5)], axis=1).astype(np.float32)


def numpy_height_band(xyz: NDArray, ism: HeightBandISM) -> NDArray[np.float32]:
    """Return the masses of the paper's geometric model, written in numpy: one line per return.

    All lines advance by one cell at a time, those that meet an occupied cell drop out. The sensor is at 0, 0.
    """
    spec, ground = ism.spec, ism.mount.ground_point[2]
    x, y = xyz[(xyz[:, 2] > ground + ism.z_min) & (xyz[:, 2] < ground + ism.z_max), :2].astype(np.float64).T
    x0, x1, y0, y1 = spec.extent
    inside, share = spec.contains(x, y), np.ones_like(x)  # share of the ray that lies in the grid
    for along, low, high in ((x, x0, x1), (y, y0, y1)):
        share = np.where(along < low, np.minimum(share, low / np.where(along < low, along, 1)), share)
        share = np.where(along >= high, np.minimum(share, high / np.where(along >= high, along, 1)), share)
    i, j = spec.index(x * share, y * share, unbounded=True)
    i, j = np.clip(i, 0, spec.shape[0] - 1), np.clip(j, 0, spec.shape[1] - 1)
    occupied, free = np.zeros(spec.shape, bool), np.zeros(spec.shape, bool)
    occupied[i[inside], j[inside]] = True
    i0, j0 = (int(index) for index in spec.index(0.0, 0.0))
    order = np.argsort(np.maximum(np.abs(i - i0), np.abs(j - j0)))
    di, dj = i[order] - i0, j[order] - j0
    steps = np.maximum(np.abs(di), np.abs(dj))
    for n in range(steps.max(initial=-1) + 1):
        begun = np.searchsorted(steps, n)  # lines that are as long as this
        di, dj, steps = di[begun:], dj[begun:], steps[begun:]
        whole = np.maximum(2 * steps, 1)
        u = i0 + np.sign(di) * ((2 * n * np.abs(di) + steps) // whole)
        v = j0 + np.sign(dj) * ((2 * n * np.abs(dj) + steps) // whole)
        going = ~occupied[u, v]
        free[u[going], v[going]] = True
        di, dj, steps = di[going], dj[going], steps[going]
    mass = np.zeros((*spec.shape, 2), np.float32)
    mass[free, 0] = mass[occupied, 1] = ism.evidence / (ism.evidence + 2)
    return mass


def contenders(spec: GridSpec, points: NDArray[np.float32], mount: Mount, slow: bool) -> dict[str, Contender]:
    """Return ogm's models, the yardstick of copying bytes, the ground estimate alone, and slow references."""
    band, ray, xyz = HeightBandISM(spec, mount), RayISM(spec, mount), np.ascontiguousarray(points[:, :3])
    coarse, mass = GridSpec(1.0, (82, 57), spec.origin), np.ones((*spec.shape, 2), np.float32)
    copies = np.empty_like(points), np.empty_like(mass)
    found = {
        HEIGHT_BAND: Contender(lambda _: band(points)),
        RAY: Contender(lambda _: ray(points)),
        COPY: Contender(lambda _: (np.copyto(copies[0], points), np.copyto(copies[1], mass))),
        LOCAL: Contender(lambda _: local_ground(xyz, coarse, mount.ground_point)),
    }
    if slow:
        found[NUMPY] = Contender(lambda _: numpy_height_band(xyz, band))
        found[PYTHON] = Contender(lambda _: reference.height_band_mass(xyz, band), slow=True)
    return found


def peers(
    spec: GridSpec, points: NDArray[np.float32], sensor_height: float
) -> tuple[dict[str, Contender], dict[str, str]]:
    """Return the peers that are installed, and for the others the reason why they are left out.

    Their points are put into the type they like best beforehand; a fresh, empty map is made for each call. 3D
    mappers stop at the grid's far corner.
    """
    max_range = math.hypot(spec.length, spec.width) / 2
    wide, narrow = points[:, :3].astype(np.float64), np.ascontiguousarray(points[:, :3])

    def octomap(package: str, variants: dict[str, tuple[bool, ...]]) -> dict[str, Contender]:
        tree_type = importlib.import_module("octomap" if package == "octomap-python" else package).OcTree
        make = partial(tree_type, spec.resolution)
        return {
            f"{OCTOMAP} ({package}){kind}": Contender(
                lambda tree, given=given: tree.insertPointCloud(wide, np.zeros(3), max_range, *given), make, slow=True
            )
            for kind, given in variants.items()
        }

    def kiss_slam() -> dict[str, Contender]:
        from kiss_slam.kiss_slam_pybind import kiss_slam_pybind as kiss

        vector, pose = kiss._Vector3fVector(narrow), np.eye(4)
        make = partial(kiss._OccupancyMapper, spec.resolution, max_range)
        return {KISS: Contender(lambda mapper: mapper._integrate_frame(vector, pose), make)}

    def patchwork() -> dict[str, Contender]:
        estimator = patchwork_estimator(sensor_height)
        return {PATCHWORK: Contender(lambda _: estimator.estimateGround(points))}

    makers: dict[str, Callable[[], dict[str, Contender]]] = {
        "pyoctomap": partial(octomap, "pyoctomap", OCTOMAP_OPTIONS),
        "octomap-python": partial(octomap, "octomap-python", {"": (False,), ", lazy": (True,)}),
        "kiss-slam": kiss_slam,
        "pypatchworkpp": patchwork,
    }
    found: dict[str, Contender] = {}
    reasons: dict[str, str] = {}
    for package, make in makers.items():
        try:
            found |= make()
        except ImportError as error:
            reasons[package] = str(error)
            print(f"left out: {package}: {error}")
    return found, reasons


def patchwork_estimator(sensor_height: float) -> Any:
    """Return a Patchwork++ estimator with its defaults and the sensor's height."""
    import pypatchworkpp

    parameters = pypatchworkpp.Parameters()
    parameters.verbose, parameters.sensor_height = False, sensor_height
    return pypatchworkpp.patchworkpp(parameters)
