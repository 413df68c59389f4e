import logging

import numpy as np
import pytest
import torch
from cases import each, refused

from ogm.deep import DeepISM, PillarNetwork
from ogm.deep.torch_engine import TorchEngine
from ogm.grid import EvidentialGrid, GridSpec
from ogm.pose import pose
from ogm.scan import InverseSensorModel, Mount

MOUNT = Mount(1.8)


@pytest.fixture
def network(tiny, small):
    torch.manual_seed(0)
    return PillarNetwork(tiny, small).eval()


@pytest.fixture
def cloud(frames):
    return frames[0].scan.points


def test_it_is_an_inverse_sensor_model(network, cloud, small):
    ism = DeepISM(network, mount=MOUNT)
    assert isinstance(ism, InverseSensorModel)
    grid = ism(cloud)
    assert grid.spec == ism.spec == small
    EvidentialGrid(grid.spec, grid.mass)  # masses they are
    assert grid.mass.dtype == np.float32
    assert 0 < grid.unknown.min() < 1
    assert grid.at(0.0, 0.0).unknown == 1  # under the ego vehicle


def test_the_mass_is_the_evidence_over_the_strength(network, cloud, small):
    from ogm.deep.pillars import pillarize

    raised = cloud + np.array([0, 0, 1.8, 0], np.float32)
    with torch.no_grad():
        evidence = network(pillarize(raised, small, ego_footprint=(-2.5, 2.5, -1.1, 1.1)))[0].numpy()
    expected = evidence / (evidence.sum(-1, keepdims=True) + 2)
    x, y = small.cell_centers
    expected[(abs(x) < 2.5 + 0.32) & (abs(y) < 1.1 + 0.32)] = 0  # all cells of the ego footprint
    np.testing.assert_allclose(DeepISM(network, mount=MOUNT)(cloud).mass, expected, atol=1e-5)


def test_a_batch_is_its_scans_one_by_one(network, frames):
    ism = DeepISM(network, mount=MOUNT)
    clouds = [frame.scan.points for frame in frames[:3]]
    for alone, together in zip(map(ism, clouds), ism.batch(clouds), strict=True):
        np.testing.assert_allclose(alone.mass, together.mass, atol=1e-5)
    assert ism.batch([]) == []


def test_the_frame_of_the_points_does_not_matter(network, cloud):
    T = pose(1.2, 0.3, 1.9, yaw=0.7)
    in_sensor = DeepISM(network, mount=Mount(1.8, T))
    in_vehicle = DeepISM(network, mount=Mount(1.8, T, points_in="vehicle"))
    moved = cloud.copy()
    moved[:, :3] = cloud[:, :3] @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
    a, b = in_sensor(cloud), in_vehicle(moved)
    assert a.spec == b.spec
    assert np.abs(a.mass - b.mass).mean() < 1e-3  # points on the edges of cells may change cell


def test_the_grid_lies_around_the_sensor(network, small):
    ism = DeepISM(network, mount=Mount(1.8, pose(1.5, -0.5, 1.8)))
    assert ism.spec.origin == pytest.approx((small.origin[0] + 1.5, small.origin[1] - 0.5))
    assert ism.spec.shape == small.shape


def test_another_grid_is_filled_with_the_same_beliefs(network, cloud, small):
    wide = GridSpec.centered(length=2 * small.length, width=small.width, resolution=small.resolution)
    a, b = DeepISM(network, mount=MOUNT)(cloud), DeepISM(network, wide, MOUNT)(cloud)
    assert b.spec == wide
    part = b.mass[small.shape[0] // 2 : -small.shape[0] // 2]
    inner = (slice(12, -12), slice(None))  # what is far from the edge that one of them does not have
    assert np.abs(a.mass[inner] - part[inner]).mean() < 0.01


def test_grids_that_do_not_suit_the_network_are_refused(network, small):
    refused("cells of 0.64 m", DeepISM, network, GridSpec.centered(length=10.24, width=10.24, resolution=0.32))
    with pytest.raises(ValueError, match="multiples of 8 cells"):
        DeepISM(network, GridSpec.centered(length=9 * 0.64, width=8 * 0.64, resolution=0.64))


def test_points_that_are_not_finite_are_left_out(network, cloud, caplog):
    ism = DeepISM(network, mount=MOUNT)
    worse = np.concatenate([cloud, np.full((3, 4), np.nan, np.float32), np.full((2, 4), np.inf, np.float32)])
    np.testing.assert_array_equal(ism(cloud).mass, ism(worse).mass)
    assert "dropped 5 of" in caplog.text


@each("count", [0, 1])
def test_scans_of_no_points_give_unknown_grids(network, cloud, count):
    seen = {"height": [1.7, 1.9], "points": [100, 9000], "intensity": [0.0, 1.0]}
    ism = DeepISM(network, mount=MOUNT, description={"seen": seen})
    for grid in (ism(cloud[:count]), ism.batch([cloud, cloud[:count]])[1]):
        assert (grid.unknown == 1).all()  # a dead sensor sees no free road
    assert ism.batch([cloud, cloud[:count]])[0].unknown.min() < 1


def test_scans_without_intensities_are_mapped(network, cloud):
    dark = cloud.copy()
    dark[:, 3] = 0
    ism = DeepISM(network, mount=MOUNT)
    np.testing.assert_array_equal(ism(cloud[:, :3]).mass, ism(dark).mass)


def test_intensities_on_another_scale_are_refused(network, cloud):
    with pytest.raises(ValueError, match=r"intensities must lie in \[0, 1\]"):
        DeepISM(network, mount=MOUNT)(cloud * np.array([1, 1, 1, 255], np.float32))


def test_a_scan_unlike_those_of_training_is_logged_once(network, cloud, caplog):
    seen = {"height": [1.7, 1.9], "points": [100, len(cloud) // 2]}
    dark = cloud[:, :3]
    with caplog.at_level(logging.WARNING):
        for _ in range(3):  # objects of one model
            DeepISM(network, mount=Mount(3.5), description={"seen": seen})(dark)
    messages = [record.getMessage() for record in caplog.records]
    for reason in ("sensor_height 3.5", "a scan of", "the ground near the sensor"):
        assert sum(reason in line for line in messages) == 1, reason
    with caplog.at_level(logging.WARNING):
        DeepISM(network, mount=Mount(3.5), description={"seen": seen, "card": "other.md"})(dark)
    assert sum("other, unlike the training data: sensor_height 3.5" in line for line in caplog.messages) == 1


def test_intensities_of_another_calibration_are_left_out(network, cloud, caplog):
    dark = cloud.copy()
    dark[:, 3] = 0
    ism = DeepISM(network, mount=MOUNT, description={"seen": {"intensity": [0.01, 0.02]}})
    for _ in range(2):
        np.testing.assert_array_equal(ism(cloud).mass, ism(dark).mass)
    assert len([record for record in caplog.records if "intensities of" in record.getMessage()]) == 1
    assert cloud[:, 3].any()  # the caller's points stay as they are


def test_a_scan_like_those_of_training_is_not_logged(network, cloud, caplog):
    seen = {"height": [1.7, 1.9], "points": [100, 2 * len(cloud)], "intensity": [0.0, 1.0]}
    DeepISM(network, mount=MOUNT, description={"seen": seen})(cloud)
    assert not caplog.records


def test_without_ego_footprint_no_cell_is_blank(network, cloud):
    assert DeepISM(network, mount=Mount(1.8, ego_footprint=(0, 0, 0, 0)))(cloud).unknown.max() < 1


def test_devices_that_are_not_there_are_refused(network):
    refused("use cpu", TorchEngine, network, device="warp")


def test_the_error_for_unknown_weights_names_the_known_ones(tmp_path):
    refused("'lite'", DeepISM.load, "litte", error=FileNotFoundError)
    refused("ogm train", DeepISM.load, tmp_path, error=FileNotFoundError)


def test_a_number_is_no_mount(network):
    refused("ogm.Mount", DeepISM, network, error=TypeError, mount=1.8)


@each("points", [np.zeros((3, 2), np.float32), np.zeros(4, np.float32)])
def test_shapes_that_are_no_points_are_refused(network, points):
    with pytest.raises(ValueError, match="points must have shape"):
        DeepISM(network)(points)


def test_integer_points_are_refused(network):
    with pytest.raises(TypeError, match="float array"):
        DeepISM(network)(np.zeros((3, 4), int))


def test_the_shipped_weights_read_a_real_scan(caplog):
    from importlib.resources import as_file, files

    from ogm import read_scan

    with as_file(files("ogm") / "data" / "vls128_road.pcd.xz") as path:
        scan = read_scan(path, axes=("+y", "-x", "+z"))
    deep = DeepISM.load("lite", mount=Mount(1.98))
    assert set(deep.description["seen"]) == {"height", "points", "intensity", "ground"}
    grid = deep(scan)
    assert not caplog.records  # within what training saw
    assert grid.spec.shape == (512, 352)
    assert grid.at(20, 5).free > 0.7  # the lane ahead
    assert grid.at(10, 9.2).occupied > 0.5  # its left border
    assert grid.at(-1.0, 15.0).unknown > 0.7  # behind that border
    assert deep(scan.select(slice(0))).unknown.min() == 1
