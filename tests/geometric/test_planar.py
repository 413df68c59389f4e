"""PlanarISM: scans of a laser in one plane, cast in rooms of walls, panes and posts."""

import math
from dataclasses import replace

import numpy as np
from cases import each, refused
from geometric_reference import planar_mass
from numpy.typing import NDArray

from ogm import EvidentialGrid, GridSpec, Mount, Scan
from ogm.evidence import check_mass
from ogm.geometric import PlanarISM, plane_text
from ogm.pose import pose
from ogm.state import CellState, predict_state

SPEC = GridSpec.centered(12.0, 12.0, 0.05)
SMALL = GridSpec.centered(3.0, 2.4, 0.1)
MOUNT = Mount(0.3, ego_footprint=(0, 0, 0, 0))
ISM = PlanarISM(SPEC, MOUNT)
ROOM = [((-3.02, -2.51), (4.03, -2.51)), ((4.03, -2.51), (4.03, 3.01)), ((4.03, 3.01), (-3.02, 3.01))]
ROOM += [((-3.02, 3.01), (-3.02, -2.51))]
Wall = tuple[tuple[float, float], tuple[float, float]]


def ranges(walls: list[Wall], azimuth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the range of the nearest wall along each beam from (0, 0), infinity for none."""
    nearest = np.full(azimuth.shape, np.inf)
    for (x, y), (p, q) in walls:
        c, s, ex, ey = np.cos(azimuth), np.sin(azimuth), p - x, q - y
        with np.errstate(divide="ignore", invalid="ignore"):
            along, share = (x * ey - y * ex) / (c * ey - s * ex), (x * s - y * c) / (c * ey - s * ex)
        nearest = np.where((along > 0) & (share >= 0) & (share <= 1), np.minimum(nearest, along), nearest)
    return nearest


def scan_of(reach: NDArray[np.float64], azimuth: NDArray[np.float64], **columns: object) -> Scan:
    """Return a planar scan; beams of infinite range are without echo."""
    unit = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1)
    hit = np.isfinite(reach)
    points, silent = (unit[hit] * reach[hit, None]).astype(np.float32), unit[~hit].astype(np.float32)
    return Scan(points, no_returns=silent, **{"kind": "planar", "max_range": 8.0, **columns})  # type: ignore[arg-type]


def circle(count: int = 720) -> NDArray[np.float64]:
    return (np.arange(count) + 0.3) * 2 * np.pi / count - np.pi


def states(grid: EvidentialGrid, points: NDArray[np.float32]) -> NDArray[np.uint8]:
    return predict_state(grid.at(points[:, 0], points[:, 1]))


def test_the_walls_of_a_room_are_occupied_and_nothing_is_free_behind_them() -> None:
    rng, azimuth = np.random.default_rng(0), circle()
    scan = scan_of(ranges(ROOM, azimuth) + rng.normal(0, 0.01, azimuth.size), azimuth)
    grid = ISM(scan)
    check_mass(grid.mass)
    found = states(grid, scan.points)
    assert (found == CellState.OCCUPIED).mean() >= 0.9
    assert not (found == CellState.FREE).any()
    x, y = np.broadcast_arrays(*SPEC.cell_centers)
    outside = (x < -3.1) | (x > 4.1) | (y < -2.6) | (y > 3.1)
    assert not grid.free[outside].any()
    inside = (x > -2.8) & (x < 3.8) & (y > -2.3) & (y < 2.8)
    assert (grid.free[inside] > 0.5).all()
    thickness = (grid.occupied[:, SPEC.index(0, 0)[1]] > 0.5).sum()
    assert 2 <= thickness <= 4  # two walls


def test_the_order_of_beams_is_irrelevant_and_a_turned_scan_gives_a_turned_grid() -> None:
    rng, azimuth = np.random.default_rng(1), circle(360)
    reach = ranges([*ROOM, ((1.0, -0.4), (1.1, 0.4))], azimuth)
    reach[rng.random(360) < 0.1] = np.inf
    scan = scan_of(reach, azimuth)
    wanted, order = ISM(scan).mass, rng.permutation(len(scan))
    assert (ISM(scan.select(order)).mass == wanted).all()
    for quarter in (1, 2, 3):
        c, s = round(math.cos(quarter * math.pi / 2)), round(math.sin(quarter * math.pi / 2))
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], np.float32)
        points = np.c_[scan.points[:, :3] @ turn, scan.points[:, 3]]
        turned = replace(scan, points=points, no_returns=scan.no_returns @ turn)
        np.testing.assert_allclose(ISM(turned).mass, np.rot90(wanted, quarter), atol=1e-4)


@each("seed", range(6))
def test_masses_are_those_of_the_slow_reference(seed: int) -> None:
    rng = np.random.default_rng(seed)
    azimuth = np.sort(rng.uniform(-math.pi, math.pi) + np.deg2rad(2) * (np.arange(90) + rng.uniform(-0.2, 0.2, 90)))
    azimuth = (azimuth[rng.random(90) > 0.1] + math.pi) % (2 * math.pi) - math.pi
    levels = rng.uniform(0.3, 1.8, 30)
    reach = np.repeat(levels, rng.integers(1, 9, 30))[: azimuth.size]
    azimuth = azimuth[: reach.size]
    reach = reach + rng.normal(0, 0.02, reach.size)
    reach[rng.random(reach.size) < 0.2] = np.inf
    scan = scan_of(reach, azimuth, max_range=1.7)
    points = scan.points.copy()
    points[:, 2] = rng.choice([0, 0, 0, -0.2, -0.4, 2.5], len(points))
    scan = replace(scan, points=points)
    mount = Mount(0.3, pose(0.12, -0.31), ego_footprint=(-0.3, 0.1, -0.5, 0.0))
    ism = PlanarISM(SMALL, mount, range_noise=0.03, p_false_alarm=0.05 if seed else 0.4)
    wanted, got = planar_mass(scan, ism), ism(scan).mass
    check_mass(got)
    assert (wanted > 0.1).sum() > 50
    np.testing.assert_allclose(got, wanted, atol=1e-3)


def test_a_fan_of_many_beams_through_one_cell_is_no_more_evidence_than_one() -> None:
    azimuth = circle(3600)
    few, many = (ISM(scan_of(np.full(a.size, 2.0), a)) for a in (azimuth[::10], azimuth))
    assert many.at(0.3, 0.02).free == few.at(0.3, 0.02).free == np.float32(1 - ISM.p_miss)


FRONT = circle()[np.abs(circle()) < 0.7]
WALL = [((3.02, -9.0), (3.02, 9.0))]
PANE, MIRROR = (np.abs(3.02 * np.tan(FRONT) - 0.3) < half for half in (0.5, 0.12))


@each(
    "inside, behind",
    [
        (PANE, np.full(PANE.sum(), np.inf)),  # glass: no echo
        (PANE, np.where(np.arange(PANE.sum()) % 3 == 0, 4.5, np.inf)),  # glass: some echoes from behind
        (MIRROR, 5.0 + np.zeros(MIRROR.sum())),
    ],
)
def test_a_pane_or_a_mirror_in_a_wall_opens_no_free_space(
    inside: NDArray[np.bool_], behind: NDArray[np.float64]
) -> None:
    reach = ranges(WALL, FRONT)
    reach[inside] = behind
    grid = ISM(scan_of(reach, FRONT))
    x, _ = np.broadcast_arrays(*SPEC.cell_centers)
    assert not (predict_state(grid.mass)[x > 3.02] == CellState.FREE).any()
    assert grid.at(2.8, -0.8).free > 0.5
    if not np.isfinite(behind).any():
        assert not grid.free[x > 3.02].any()


def test_a_door_is_open_and_a_wide_view_without_echo_is_weak() -> None:
    reach = ranges(WALL, FRONT)
    door = np.abs(3.02 * np.tan(FRONT)) < 0.5
    grid = ISM(scan_of(np.where(door, 5.0, reach), FRONT))
    assert grid.at(4.0, 0.0).free > 0.5
    silent = ISM(scan_of(np.full(FRONT.size, np.inf), FRONT))
    assert silent.at(2.0, 0.0).free == np.float32(0.8 * 0.25)
    unknown = replace(scan_of(np.full(FRONT.size, np.inf), FRONT), max_range=None)
    for empty in (unknown, Scan(np.zeros((0, 4), np.float32))):
        assert not ISM(empty).mass.any()


def test_mixed_pixels_between_two_surfaces_count_half_and_clear_nothing_beyond_them() -> None:
    reach = np.where(FRONT < 0.2, 2.0, 5.0)
    k = int(np.searchsorted(FRONT, 0.2))
    reach[k] = 3.3
    grid = ISM(scan_of(reach, FRONT))
    at = 3.3 * math.cos(FRONT[k]), 3.3 * math.sin(FRONT[k])
    assert 0 < grid.at(*at).occupied < 0.5
    assert grid.at(2.0 * math.cos(0.1), 2.0 * math.sin(0.1)).occupied > 0.9


def test_a_beam_that_meets_the_floor_marks_no_wall() -> None:
    pitched = Mount(0.3, pose(z=0.3, pitch=0.1), ego_footprint=(0, 0, 0, 0))
    ism = PlanarISM(SPEC, pitched)
    azimuth = circle()[np.abs(circle()) < 0.3]
    floor = 0.3 / (math.sin(0.1) * np.cos(azimuth))
    grid = ism(scan_of(floor, azimuth))
    assert not grid.occupied.any()
    assert grid.at(1.5, 0.0).free > 0.5
    assert not grid.free[SPEC.index(2.6, 0)[0] :].any()  # lower than the margin above the floor
    wall = ism(scan_of(1.5 / np.cos(azimuth), azimuth))
    assert wall.at(1.5 * math.cos(0.1), 0.01).occupied > 0.9


def test_a_cone_shares_its_mass_over_its_arc_and_clears_weakly() -> None:
    scan = Scan(np.array([[2.02, 0, 0, 0]], np.float32), kind="cone", beam_width=0.5)
    grid = ISM(scan)
    arc = [(2.02 * math.cos(a), 2.02 * math.sin(a)) for a in (-0.2, 0.0, 0.2)]
    occupied = [grid.at(*place).occupied for place in arc]
    np.testing.assert_allclose(occupied, 0.95 * 0.05 / (4.04 * math.tan(0.25)), rtol=1e-3)
    assert 0 < grid.at(1.0, 0.2).free == np.float32(0.8 * 0.25)
    assert grid.at(1.0, 0.4).free == grid.at(2.2, 0.0).free == 0


def test_the_height_of_the_plane_is_named() -> None:
    assert plane_text(scan_of(np.ones(3), np.arange(3.0)), MOUNT) == "free at 0.30 m"
    assert plane_text(Scan(np.zeros((1, 4), np.float32)), MOUNT) == ""


@each(
    "options",
    [{"range_noise": 0.0}, {"p_miss": 1.0}, {"p_false_alarm": 0.6}, {"no_return_weight": 1.2}, {"beam_width": 2.0},
     {"floor_margin": -1.0}, {"clearance": 0.0}],
)  # fmt: skip
def test_numbers_out_of_their_range_are_refused(options: dict[str, float]) -> None:
    refused(next(iter(options)), PlanarISM, SPEC, MOUNT, **options)
