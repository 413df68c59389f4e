"""No ray, no free: where no beam went, a scan of a sector leaves the cells unknown."""

from collections.abc import Callable
from functools import cache
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import pytest
from cases import each
from numpy.typing import NDArray

from ogm import Mount, Scan, load_model, read_scan
from ogm.deep import DeepISM
from ogm.deep.engines import load_engine
from ogm.grid import GridSpec

SPEC = GridSpec.centered()
VELODYNE = ("+y", "-x", "+z")
SECTORS = [(0, 60), (140, 120), (-100, 200), (60, 270)]  # middle and width [degrees]
SCANS = {  # axes, height of the sensor above ground [m]: stated, or that of the lowest returns near it
    "nebula_apache2/hesai/40p.pcd": ("flu", 0.7),
    "nebula_apache2/hesai/ot128.pcd": ("flu", 2.5),
    "nebula_apache2/hesai/qt128.pcd": ("flu", 0.5),
    "nebula_apache2/hesai/xt32.pcd": ("flu", 0.7),
    "nebula_apache2/vls128/*.pcd": (VELODYNE, 1.98),
    "autoware_apache2/test.pcd.xz": ("flu", 1.9),
    "kitti_odometry_00/000000.bin": ("flu", 1.73),
    "nuscenes_n015/*.pcd.bin": ("nuscenes", 1.84),
}


@cache
def engine():
    return load_engine("lite")


def test_the_combined_model_frees_nothing_behind_a_sector() -> None:
    with as_file(files("ogm") / "data" / "vls128_road.pcd.xz") as path:
        points = read_scan(path, axes=VELODYNE).points
    ahead = distance(points[:, 0], points[:, 1], 0.0) <= np.radians(60)
    grid = load_model("combined", SPEC, Mount(1.98))(Scan(points[ahead]))
    x, y = np.broadcast_arrays(*SPEC.cell_centers)
    behind = distance(x, y, 0.0) > np.radians(90)
    assert (grid.free[behind] > 0.3).mean() <= 0.005
    assert (grid.free[~behind] > 0.5).mean() > 0.1  # the map is not empty


def share_of_free_outside(scan: Scan, height: float, middle: float, width: float) -> float:
    """Return the share of cells outside a sector and one cell more whose free is above 0.3; angles in degrees."""
    middle, half = np.radians(middle), np.radians(width / 2)
    x, y = np.broadcast_arrays(*SPEC.cell_centers)
    next_to = 1.5 * SPEC.resolution / np.maximum(np.hypot(x, y), 1.0)  # angle of one cell and of half its diagonal
    grid = DeepISM(engine(), SPEC, Mount(height))(Scan(scan.points[distance(*scan.points[:, :2].T, middle) <= half]))
    return float((grid.free[distance(x, y, middle) > half + next_to] > 0.3).mean())


def distance(x: NDArray, y: NDArray, bearing: float) -> NDArray:
    """Return the angle between the bearings of places and another [rad]."""
    return np.abs(np.angle(np.exp(1j * (np.arctan2(y, x) - bearing))))


@each("middle, width", SECTORS)
def test_the_shipped_scan_cut_to_a_sector(middle: float, width: float) -> None:
    with as_file(files("ogm") / "data" / "vls128_road.pcd.xz") as path:
        scan = read_scan(path, axes=VELODYNE)
    assert share_of_free_outside(scan, 1.98, middle, width) <= 0.005


@pytest.mark.slow
@each("name", SCANS)
def test_recorded_scans_cut_to_sectors(name: str, real: Callable[[str], Path]) -> None:
    axes, height = SCANS[name]
    scan = read_scan(real(name), axes=axes)
    shares = [share_of_free_outside(scan, height, *sector) for sector in SECTORS]
    assert max(shares) <= 0.005, np.round(shares, 4)


def test_the_shipped_sector_of_an_at128() -> None:
    with as_file(files("ogm") / "data" / "at128_sector.pcd.xz") as path:
        scan = read_scan(path)
    bearings = np.sort(np.arctan2(scan.points[:, 1], scan.points[:, 0]))
    gap = int(np.diff(bearings, append=bearings[0] + 2 * np.pi).argmax())  # where no beam goes
    first, last = bearings[(gap + 1) % len(bearings)], bearings[gap]
    width = np.degrees((last - first) % (2 * np.pi))
    assert 100 < width < 140
    assert share_of_free_outside(scan, 0.45, np.degrees(first) + width / 2, width + 0.1) <= 0.005
