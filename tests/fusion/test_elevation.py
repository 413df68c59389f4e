"""`ElevationMapper`: closed forms of its filter, a window that moves, drift of the poses' heights."""

import numpy as np
import pytest
from cases import each, refused

from ogm import GridSpec, LayeredGrid
from ogm.fusion import ElevationMapper, PoseJump
from ogm.geometric.heights import HEIGHT_LAYERS
from ogm.pose import pose

SPEC = GridSpec.centered(8.0, 6.0, 0.2)
X, Y = (np.broadcast_to(axis, SPEC.shape) for axis in SPEC.cell_centers)


def layers(height: object, variance: float = 1e-3, **others: object) -> LayeredGrid:
    found = dict.fromkeys(HEIGHT_LAYERS, np.nan) | {"ground_height": height, "ground_variance": variance} | others
    return LayeredGrid(SPEC, {name: np.broadcast_to(np.float32(value), SPEC.shape) for name, value in found.items()})


def plain(**options: object) -> ElevationMapper:
    return ElevationMapper(SPEC, **({"drift": 0, "process_noise": 0, "independent_scans": np.inf} | options))


@each("independent, variance", [(np.inf, 0.04 / 5), (2.0, 0.02)])
def test_scans_of_one_place_give_their_mean(independent: float, variance: float) -> None:
    mapper, heights = plain(independent_scans=independent), [0.1, 0.2, 0.0, 0.15, 0.05]
    for height in heights:
        mapper.update(layers(height - 100, 0.04), pose(z=300.0))
    np.testing.assert_allclose(mapper.layers["ground_variance"], variance, rtol=1e-4)
    if independent == np.inf:
        np.testing.assert_allclose(mapper.layers["ground_height"], 200 + np.mean(heights), atol=1e-4)
    assert mapper.scans == len(heights)


def test_the_window_moves_and_heights_stay_where_they_are_in_the_map() -> None:
    mapper = plain()
    road = 0.1 * X + 0.02 * Y
    for place in (0.0, 1.0, 3.0):  # a road in map coordinates, seen from a vehicle that is pitched and turned
        T = pose(place, 0.4, 2.0, yaw=0.3, pitch=-0.1)
        x, y = T[0, 0] * X + T[0, 1] * Y + T[0, 3], T[1, 0] * X + T[1, 1] * Y + T[1, 3]
        seen = (0.1 * x + 0.02 * y - 2.0 - T[2, 0] * X - T[2, 1] * Y) / T[2, 2]
        mapper.update(layers(seen), T)
    found, (mx, my) = mapper.layers, mapper.spec.cell_centers
    known = np.isfinite(found["ground_height"])
    assert 0.6 < known.mean() < 1
    assert mapper.spec.origin[0] == pytest.approx(SPEC.origin[0] + 3.0)
    assert np.abs(found["ground_height"] - (0.1 * mx + 0.02 * my))[known].max() < 0.03  # a cell is 0.2 m wide
    np.testing.assert_allclose(np.median(found["slope"][known]), np.arctan(np.hypot(0.1, 0.02)), atol=0.01)
    mapper.reset()
    assert mapper.scans == 0
    assert np.isnan(mapper.layers["ground_height"]).all()
    assert road.shape == SPEC.shape


@each("estimate", [True, False])
def test_drift_of_the_poses_is_estimated_or_stated(estimate: bool) -> None:
    mapper, rng = plain(drift=0.05, estimate_drift=estimate), np.random.default_rng(0)
    for k in range(20):  # the ground is level, and the pose rises by 2 cm per metre
        mapper.update(layers(-1.0 + rng.normal(0, 0.02, SPEC.shape)), pose(0.5 * k, z=1.0 + 0.01 * k))
    found, ahead = mapper.layers, mapper.spec.cell_centers[0][:, 0] > 8.0
    if estimate:
        assert mapper.height_offset[0] == pytest.approx(0.19, abs=0.02)
        assert np.nanquantile(np.abs(found["ground_height"]), 0.95) < 0.05
    else:
        assert np.nanmedian(found["ground_height"][ahead]) == pytest.approx(0.17, abs=0.03)  # that of the last poses
        assert np.nanmin(found["ground_variance"]) > np.nanmin(layers(0.0)["ground_variance"]) / 10


def test_a_contradiction_raises_the_variance_and_the_last_obstacle_counts() -> None:
    mapper = plain()
    for _ in range(9):
        mapper.update(layers(0.0, 0.01**2), np.eye(4))
    before = mapper.layers["ground_variance"].max()
    mapper.update(layers(1.0, 0.01**2, step=0.3, highest_obstacle=0.0, clearance=2.5), np.eye(4))
    found = mapper.layers
    assert found["ground_variance"].min() > 5 * before
    np.testing.assert_allclose(found["ground_height"], 1.0, atol=0.01)
    for name, value in (("step", 0.3), ("highest_obstacle", 0.0), ("clearance", 2.5), ("roughness", np.nan)):
        np.testing.assert_allclose(found[name], value, atol=1e-6)


def test_what_cannot_be_fused_is_refused_and_leaves_the_map() -> None:
    for name in ("drift", "process_noise"):
        refused("must be 0 or more", ElevationMapper, SPEC, **{name: -1.0})
    refused("independent_scans must be at least 1", ElevationMapper, SPEC, independent_scans=0.5)
    mapper = ElevationMapper(SPEC)
    refused("stamp is missing", mapper.update, layers(0.0), np.eye(4))
    mapper.update(layers(0.0), np.eye(4), 0.0)
    refused("jumps by", mapper.update, layers(0.0), pose(50.0), 0.1, error=PoseJump)
    refused("no layer 'ground_height'", mapper.update, LayeredGrid(SPEC, {}), np.eye(4), 0.1, error=KeyError)
    assert mapper.scans == 1
    assert "drift estimated, 1 scans" in repr(mapper)
