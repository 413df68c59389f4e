"""The country around towns: banks and ditches as steep as stated, and fields that leave the roads free."""

from collections.abc import Callable

import numpy as np
import pytest
import shapely
from cases import each

from ogm.simulation.materials import GROUND, Material
from ogm.simulation.recipe import Country
from ogm.simulation.town import Town, build_town
from ogm.simulation.town.country import COVERS, MIN_SHARE, USES, crops, draw_profile, furrows, high_grass, turn_rural
from ogm.simulation.town.ground import STEEPEST

COUNTRY = Country(share=(0.7, 0.8))
FIELD = shapely.box(-15, -10, 15, 10)


def plane(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return 5.0 + 0.1 * x - 0.05 * y


@pytest.fixture
def town(kept_towns: Callable[..., Town]) -> Town:
    return kept_towns(3, 240.0, COUNTRY)


@pytest.fixture
def plain_town(kept_towns: Callable[..., Town]) -> Town:
    return kept_towns(3, 240.0, None)


def slopes(town: Town) -> tuple[np.ndarray, np.ndarray]:
    """Return the slope and the area of each triangle of the ground."""
    a, b, c = (town.ground.vertices[town.ground.triangles[:, k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1) / 2
    return np.hypot(normal[:, 0], normal[:, 1]) / np.maximum(np.abs(normal[:, 2]), 1e-12), area


def test_profiles_are_as_steep_and_as_high_as_stated() -> None:
    rng = np.random.default_rng(0)
    found = [draw_profile(Country(), rng) for _ in range(500)]
    for one in found:
        distance, height = np.array(one.distance), np.array(one.height)
        assert (np.diff(distance) > 0).all()
        slope = np.abs(np.diff(height) / np.diff(distance))
        steep = slope[slope > 0]
        assert (steep <= 1.0 + 1e-9).all()
        assert (MIN_SHARE * steep >= 0.2 - 1e-9).all()
        assert height[0] == 0
        assert -3.0 <= height.min() <= height.max() <= 3.0
    assert np.mean([min(one.height) < -0.3 for one in found]) > 0.5  # ditches, and land below the road
    assert np.mean([max(one.height) > 0.5 for one in found]) > 0.3  # land above it


@pytest.mark.slow
def test_banks_rise_20_to_100_percent_and_roads_do_not(town: Town, plain_town: Town) -> None:
    slope, area = slopes(town)
    assert area[slope > 0.4].sum() > 0.005 * area.sum()
    assert area[slope > 1.0 + STEEPEST + 0.1].sum() < 5e-4 * area.sum()
    road = np.isin(town.ground.material, (Material.ASPHALT, Material.MARKING))
    assert area[road & (slope > 0.2)].sum() < 0.002 * area[road].sum()
    before, size = slopes(plain_town)
    assert size[before > 0.4].sum() < 0.3 * area[slope > 0.4].sum()


@pytest.mark.slow
def test_part_of_a_town_is_country(town: Town, plain_town: Town) -> None:
    styles = [style for _, style in town.districts]
    assert "country" in styles
    assert "country" not in [style for _, style in plain_town.districts]
    faces = np.array([[x, y] for x in range(4) for y in range(4)], float) * 90
    for seed in range(20):
        found = turn_rural(["suburb"] * 16, faces, COUNTRY, np.random.default_rng(seed))
        assert 11 <= found.count("country") <= 13


@pytest.mark.slow
def test_nothing_that_grows_stands_on_a_lane(town: Town) -> None:
    corners = town.mesh.vertices[town.mesh.triangles[np.isin(town.mesh.material, (Material.FOLIAGE, Material.BARK))]]
    low = corners[(corners[..., 2] - town.ground_height(*corners[..., :2].reshape(-1, 2).T).reshape(-1, 3)).min(1) < 2]
    middles = shapely.points(low.mean(axis=1)[:, :2])
    lanes = shapely.union_all([shapely.LineString(lane.points).buffer(0.4 * lane.width) for lane in town.lanes])
    shapely.prepare(lanes)
    assert not shapely.intersects(lanes, middles).any()


@pytest.mark.slow
def test_the_same_seed_builds_the_same_country(town: Town) -> None:
    again = build_town(3, 240.0, COUNTRY)
    for one, other in zip((*town.mesh, town.height), (*again.mesh, again.height), strict=True):
        np.testing.assert_array_equal(one, other)


def test_shares_of_land_use_sum_to_one() -> None:
    assert sum(COVERS.values()) == pytest.approx(1)
    assert sum(USES.values()) == pytest.approx(1)
    assert {"ploughed", "wood", "meadow"} <= set(USES)


@each("plant", ["grass", "crop"])
def test_high_plants_stand_on_their_ground_in_their_field(plant: str) -> None:
    rng = np.random.default_rng(1)
    mesh = high_grass(FIELD, plane, rng, density=2.0) if plant == "grass" else crops(FIELD, plane, rng, tall=0.8)
    assert (mesh.material == Material.FOLIAGE).all()
    x, y, z = mesh.vertices.T.astype(np.float64)
    above = z - plane(x, y)
    assert above.min() > -0.2
    assert 0.25 < np.percentile(above, 90) < 1.6
    assert np.abs(x).max() < 16.5
    assert np.abs(y).max() < 11.5
    assert len(mesh.triangles) > 500


def test_furrows_are_ground_that_is_rough() -> None:
    mesh = furrows(FIELD, plane, np.random.default_rng(1))
    assert set(mesh.material.tolist()) <= {int(m) for m in GROUND}
    x, y, z = mesh.vertices.T.astype(np.float64)
    above = z - plane(x, y)
    assert 0.0 < above.min() < above.max() < 0.16
    assert above.std() > 0.005
    assert shapely.contains_xy(FIELD.buffer(1e-3), x, y).all()
