"""Towns: closed ground, lanes that lead on and stay free, kerbs and grades as streets have them."""

import hashlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from cases import each

from ogm.simulation.materials import GROUND, Material
from ogm.simulation.mesh import Mesh
from ogm.simulation.recipe import Country
from ogm.simulation.town import Lane, Town, build_town
from ogm.simulation.traffic.motion import Traffic

FROZEN = pytest.mark.slow  # frozen code: test_dataset.py compares what samples hold
SIZE = 240.0
CLEARANCE = 4.4  # [m] above a lane


@pytest.fixture
def town(kept_towns: Callable[..., Town]) -> Town:
    return kept_towns(3, SIZE, None)


def fingerprint(town: Town) -> str:
    arrays = [*town.mesh, town.height, town.bays, *(lane.points for lane in town.lanes), *town.walkways]
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    digest.update(repr([(lane.successors, lane.junction, lane.phase) for lane in town.lanes]).encode())
    digest.update(repr((town.loop, town.counter_loop)).encode())
    return digest.hexdigest()


def scene(mesh: Mesh, kept: np.ndarray | None = None) -> Any:
    from open3d import core, t

    triangles = mesh.triangles if kept is None else np.ascontiguousarray(mesh.triangles[kept])
    result = t.geometry.RaycastingScene(nthreads=1)
    result.add_triangles(core.Tensor(mesh.vertices), core.Tensor(triangles))
    return result


def cast(scene: Any, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    from open3d import core

    rays = np.concatenate([origins, np.broadcast_to(directions, origins.shape)], axis=1)
    return scene.cast_rays(core.Tensor(rays.astype(np.float32)), nthreads=1)["t_hit"].numpy()


def strips(lane: Lane) -> list[np.ndarray]:
    """Lines along a lane, from its right to its left edge."""
    ahead = np.gradient(lane.points[:, :2], axis=0)
    left = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1) / np.linalg.norm(ahead, axis=1, keepdims=True)
    half = 0.45 * min(lane.width, 3.0)
    return [
        np.column_stack([lane.points[:, :2] + offset * left, lane.points[:, 2]])
        for offset in np.linspace(-half, half, 7)
    ]


def length(town: Town, trip: tuple[int, ...]) -> float:
    return sum(town.lanes[k].length for k in trip)


def turning(town: Town, trip: tuple[int, ...]) -> float:
    """The area that a trip goes round; negative clockwise."""
    x, y = np.concatenate([town.lanes[k].points[:, :2] for k in trip]).T
    return float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum() / 2)


@FROZEN
def test_no_ray_falls_through_the_ground(town: Town) -> None:
    rng = np.random.default_rng(1)
    edge = -float(town.corner[0]) - 0.01
    xy = rng.uniform(-edge, edge, (200_000, 2))
    fallen = cast(scene(town.ground), np.column_stack([xy, np.full(len(xy), 100.0)]), np.array([0.0, 0, -1]))
    assert np.isfinite(fallen).all()
    # The raster message the same height, but for the cells that a kerb passes through.
    difference = abs(100.0 - fallen - town.ground_height(xy[:, 0], xy[:, 1]))
    assert np.median(difference) < 0.005
    assert (difference > 0.03).mean() < 0.03
    assert difference.max() < 0.3


@FROZEN
def test_same_seed_same_town_to_the_bit(town: Town) -> None:
    """And with no country asked for as without a word of it."""
    assert fingerprint(build_town(3, SIZE, Country(share=(0.0, 0.0)))) == fingerprint(town)


@FROZEN
def test_roads_climb_but_never_too_steeply(town: Town) -> None:
    grades = []
    for lane in town.lanes:
        run = np.linalg.norm(np.diff(lane.points[:, :2], axis=0), axis=1)
        grades.append(np.max(abs(np.diff(lane.points[:, 2])) / run))
    assert max(grades) < 0.09
    assert max(grades) > 0.03


@FROZEN
def test_lanes_lie_on_the_road(town: Town) -> None:
    points = np.concatenate([lane.points for lane in town.lanes])
    assert abs(points[:, 2] - town.ground_height(points[:, 0], points[:, 1])).max() < 0.05


@FROZEN
def test_kerbs_stand_8_to_16_cm_high_where_they_are_not_let_down(town: Town) -> None:
    kerb = town.mesh.triangles[town.mesh.material == Material.KERB]
    corners = town.mesh.vertices[kerb].astype(np.float64)
    heights = []
    for k in range(3):
        a, b = corners[:, k], corners[:, (k + 1) % 3]
        upright = (a[:, :2] == b[:, :2]).all(axis=1)
        heights.append(abs(a[upright, 2] - b[upright, 2]))
    height = np.concatenate(heights)
    assert height.max() < 0.16
    assert 0.08 < np.median(height) < 0.15
    assert (height > 0.08).mean() > 0.8
    assert (abs(town.mesh.normals[town.mesh.material == Material.KERB][:, 2]) < 0.05).all()


@FROZEN
def test_every_lane_leads_on_from_its_very_end(town: Town) -> None:
    for lane in town.lanes:
        assert lane.successors
        for k in lane.successors:
            following = town.lanes[k]
            assert np.linalg.norm(following.points[0] - lane.points[-1]) < 0.01
            out, on = (np.diff(p[:, :2], axis=0) for p in (lane.points[-2:], following.points[:2]))
            bend = np.arccos(np.clip(out[0] @ on[0] / np.linalg.norm(out) / np.linalg.norm(on), -1, 1))
            assert bend < np.deg2rad(20)


@FROZEN
def test_lanes_of_one_phase_do_not_cross(town: Town) -> None:
    """Lanes that may be driven at once start at the same arm, or belong to a ring that yields."""
    for k, lane in enumerate(town.lanes):
        for other in town.lanes[k + 1 :]:
            if lane.junction < 0 or lane.junction != other.junction or lane.phase < 0 or lane.phase != other.phase:
                continue
            assert np.linalg.norm(lane.points[0] - other.points[0]) < 12


@FROZEN
@each("name", ["loop", "counter_loop"])
def test_round_trips_close(town: Town, name: str) -> None:
    trip = getattr(town, name)
    for k, following in zip(trip, [*trip[1:], trip[0]], strict=True):
        assert following in town.lanes[k].successors
    assert len(set(trip)) == len(trip)
    assert length(town, trip) >= 600
    assert turning(town, trip) * (-1 if name == "loop" else 1) > 0


@FROZEN
def test_nothing_stands_on_a_lane_or_hangs_low_over_it(town: Town) -> None:
    solid = ~np.isin(town.mesh.material, [int(m) for m in GROUND])
    things = scene(town.mesh, solid)
    for lane in town.lanes:
        for strip in strips(lane):
            above = cast(things, strip + [0, 0, 0.05], np.array([0.0, 0, 1]))
            assert above.min() > CLEARANCE
            for height in (0.05, 0.3, 1.0, 2.5, 4.0):
                ahead = cast(things, strip[:-1] + [0, 0, height], np.diff(strip, axis=0))
                assert ahead.min() > 1.0


@FROZEN
def test_a_car_fits_into_every_bay(town: Town) -> None:
    solid = ~np.isin(town.mesh.material, [int(m) for m in GROUND])
    solid &= ~np.isin(town.mesh.material, [Material.KERB, Material.FOLIAGE])  # twigs may touch a roof
    things = scene(town.mesh, solid)
    for x, y, z, yaw, long, wide in town.bays:
        ahead = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        side = np.array([-ahead[1], ahead[0], 0.0])
        start = np.array([[x, y, z + h] for h in (0.6, 1.2)])
        for across in (-0.3, 0.0, 0.3):
            origins = start - 0.38 * long * ahead + across * wide * side
            assert cast(things, origins, 0.76 * long * ahead).min() > 1.0, (x, y)


@FROZEN
def test_walkways_lie_on_the_ground_and_off_the_houses(town: Town) -> None:
    assert len(town.walkways) > 20
    walls = np.isin(town.mesh.material, [Material.BRICK, Material.PLASTER_LIGHT, Material.PLASTER_DARK])
    houses = scene(town.mesh, walls)
    blocked = total = 0
    for line in town.walkways:
        assert abs(line[:, 2] - town.ground_height(line[:, 0], line[:, 1])).max() < 0.01
        hits = cast(houses, line[:-1] + [0, 0, 1.0], np.diff(line, axis=0)) < 1.0
        blocked, total = blocked + int(hits.sum()), total + len(hits)
    assert blocked < 0.01 * total


def edges_hit(things: Any, mesh: Mesh) -> bool:
    """Whether an edge of a mesh runs through something."""
    corners = mesh.vertices[mesh.triangles]
    begin, way = corners.reshape(-1, 3), (np.roll(corners, -1, axis=1) - corners).reshape(-1, 3)
    return bool((cast(things, begin, way) < 1.0).any())


@FROZEN
def test_participants_keep_clear_of_what_stands_still(town: Town) -> None:
    """Vehicles always; of pedestrians few brush a pole or a bin."""
    solid = ~np.isin(town.mesh.material, [*map(int, GROUND), Material.KERB, Material.FOLIAGE])
    things = scene(town.mesh, solid)
    traffic = Traffic(town, 11, clockwise=True)
    walking = []
    for time in (5.0, 35.0, 95.0):
        for one in traffic.at(time).objects:
            if one.label == "pedestrian":
                walking.append(edges_hit(things, one.mesh.moved(one.pose)))
            elif time < 6 or one.track < 1000:
                assert not edges_hit(things, one.mesh.moved(one.pose)), (one.label, one.pose[:3, 3])
    assert len(walking) > 60
    assert np.mean(walking) < 0.06


@each("name, value", [*(("size", one) for one in (0.0, -10.0, 239.0, 5000.0, np.nan, np.inf)),
                      *(("seed", one) for one in (-1, 1.5, True, "a"))])  # fmt: skip
def test_impossible_sizes_and_seeds_are_refused(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=f"{name} must be"):
        build_town(**{"seed": 1, name: value})  # type: ignore[arg-type]
