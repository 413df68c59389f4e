"""Beams without a return."""

import numpy as np
import pytest
from cases import each

from ogm.io import read_scan, read_scan_file

ROWS, COLUMNS = 16, 360


@pytest.fixture
def spinning():
    """Give directions, ranges and holes of a lidar with an offset of the azimuth per row."""
    rng = np.random.default_rng(8)
    elevation = np.radians(np.linspace(12, -18, ROWS))[:, None]
    azimuth = np.radians(180 - np.arange(COLUMNS) + np.tile([2.0, 0.7, -0.7, -2.0], ROWS // 4)[:, None])
    way = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth]
    )
    distance = rng.uniform(3, 60, (ROWS, COLUMNS))
    returned = rng.random((ROWS, COLUMNS)) < np.linspace(0.3, 0.95, ROWS)[:, None]  # the sky returns little
    return way, distance, returned


def save(path, image):
    np.save(path / "a.npy", np.moveaxis(image, 0, -1))
    return path / "a.npy"


def angles(a, b):
    return np.degrees(np.arccos(np.clip((a * b).sum(axis=1), -1, 1)))


@each("nothing", [0.0, np.nan])
def test_beams_without_return_are_found(nothing, spinning, tmp_path):
    way, distance, returned = spinning
    scan, facts = read_scan_file(save(tmp_path, np.where(returned, way * distance, nothing)))
    assert len(scan.no_returns) == facts.dropped == np.count_nonzero(~returned)
    assert scan.no_returns.dtype == np.float32
    assert len(scan.points) + len(scan.no_returns) == ROWS * COLUMNS
    assert angles(scan.no_returns, way[:, ~returned].T).max() < 0.05


def test_beams_without_return_turn_with_the_points(spinning, tmp_path):
    way, distance, returned = spinning
    path = save(tmp_path, np.where(returned, way * distance, 0.0))
    x, y, z = read_scan(path).no_returns.T
    np.testing.assert_allclose(read_scan(path, "nuscenes").no_returns.T, [y, -x, z], atol=1e-5)


def test_beams_without_return_do_not_mind_which_way_the_raster_lies(spinning, tmp_path):
    way, distance, returned = spinning
    upright = read_scan(save(tmp_path, np.where(returned, way * distance, 0.0))).no_returns
    lying = read_scan(save(tmp_path, np.where(returned, way * distance, 0.0).swapaxes(1, 2))).no_returns
    assert len(upright) == len(lying)
    assert angles(np.array(sorted(upright.tolist())), np.array(sorted(lying.tolist()))).max() < 0.05


def test_beams_without_return_survive_noise(spinning, tmp_path):
    way, distance, returned = spinning
    noise = np.random.default_rng(9).normal(0, 0.02, way.shape)
    scan = read_scan(save(tmp_path, np.where(returned, way * distance + noise, 0.0)))
    assert angles(scan.no_returns, way[:, ~returned].T).max() < 0.5


def test_rows_and_columns_that_tell_no_angle_are_left_out(spinning, tmp_path):
    way, distance, returned = spinning
    returned[0] = False
    returned[0, 5:10] = True
    returned[:, 77] = False
    scan = read_scan(save(tmp_path, np.where(returned, way * distance, 0.0)))
    known = ~returned
    known[0], known[:, 77] = False, False
    assert angles(scan.no_returns, way[:, known].T).max() < 0.05


def test_a_raster_seen_from_elsewhere_has_no_beams(spinning, tmp_path):
    way, distance, returned = spinning
    image = np.where(returned, way * distance + np.array([1.5, 0, 1.6])[:, None, None], 0.0)
    assert read_scan(save(tmp_path, image)).no_returns is None
    assert read_scan(save(tmp_path, image), origin=(1.5, 0, 1.6)).no_returns is not None


def test_a_raster_in_no_order_has_no_beams(spinning, tmp_path):
    way, distance, returned = spinning
    image = np.where(returned, way * distance, 0.0).reshape(3, -1)
    image = image[:, np.random.default_rng(1).permutation(ROWS * COLUMNS)].reshape(way.shape)
    assert read_scan(save(tmp_path, image)).no_returns is None


@each("shape", [(0, 10), (10, 0), (1, 50), (4, 5)])
def test_a_small_raster_has_no_beams(shape, tmp_path):
    assert read_scan(save(tmp_path, np.ones((3, *shape)))).no_returns is None
    assert read_scan(save(tmp_path, np.zeros((3, *shape)))).no_returns is None


def test_a_list_of_points_has_no_beams(cloud, tmp_path):
    np.save(tmp_path / "a.npy", cloud)
    assert read_scan(tmp_path / "a.npy").no_returns is None
