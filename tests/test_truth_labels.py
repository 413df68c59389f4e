"""Truth of recordings: boxes alone, a map's road, other scans, and all of them together, on small drawn grids."""

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given, settings
from hypothesis import strategies as st

from ogm import GridSpec
from ogm.pose import inverse, pose, transform_points
from ogm.scan import Boxes
from ogm.state import CellState, Truth
from ogm.truth import cells_in_boxes, combine_truths, truth_from_boxes, truth_from_road, truth_from_scans
from ogm.truth.boxes import boxes_over_points, cells_in_areas, count_returns, moving_tracks
from ogm.truth.scans import contradicted, ignore_cells

UNKNOWN, FREE, OCCUPIED, IGNORE = CellState

SMALL = GridSpec.centered(7.0, 7.0, 1.0)  # 7 x 7 cells of 1 m around (0, 0)
LETTERS = "?.# "  # unknown, free, occupied, to be ignored
BOX = [1.0, 0.0, 0.0, 3.0, 2.0, -1.8, -0.3]


def boxes_of(*rows: list[float]) -> Boxes:
    """Return boxes given as x, y, yaw, length, width, bottom, top."""
    x, y, yaw, length, width, bottom, top = np.array(rows or np.empty((0, 7)), float).T
    return Boxes(np.stack([x, y, (bottom + top) / 2], 1), np.stack([length, width, top - bottom], 1), yaw)


def draw(truth: Truth) -> list[str]:
    """Return the grid as one sees it: row 0 is ahead, the first letter is left."""
    return ["".join(LETTERS[state] for state in row[::-1]) for row in truth.state[::-1]]


def drawn(*rows: str) -> Truth:
    """Make the truth that `draw` shows so."""
    state = np.array([[LETTERS.index(letter) for letter in row[::-1]] for row in rows[::-1]], np.uint8)
    return Truth(SMALL, state)


def hits(x: float, y: float, high: float, count: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Return points of one scan in one cell, and their heights; z is of another origin."""
    return np.tile([x, y, -99.0], (count, 1)), np.full(count, high)


def scan_of(*parts: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    return np.concatenate([a for a, _ in parts]), np.concatenate([b for _, b in parts])


def seen(scans: list[tuple[np.ndarray, np.ndarray]], **how) -> int:
    """Return the state of the cell at (0, 0)."""
    truth = truth_from_scans([a for a, _ in scans], [b for _, b in scans], SMALL, **how)
    assert np.count_nonzero(truth.state != IGNORE) <= 1
    return int(truth.state[3, 3])


# --- Boxes ------------------------------------------------------------------------------------------


def test_a_box_with_enough_returns_is_occupied_and_nothing_else_is_known() -> None:
    truth = truth_from_boxes(boxes_of(BOX, [-2, 2, 0, 2, 2, 0, 1]), [50, 49], SMALL)
    assert draw(truth) == ["       ", "  ###  ", "  ###  ", "  ###  ", "       ", "       ", "       "]


def test_what_does_not_fit_is_refused() -> None:
    refused(r"shape \(1,\), one per box, got \(2,\)", truth_from_boxes, boxes_of(BOX), [50, 50], SMALL)
    refused("one stamp per frame", moving_tracks, [0.0], [boxes_of(BOX)] * 2)
    refused(r"shape \(N, 2\), got \(3,\)", cells_in_areas, [[1, 2, 3]], SMALL)
    refused("one height for every point", truth_from_scans, [GROUND[0]], [np.zeros(2)], SMALL)
    refused("min_scans must be 1 or more, got 0", truth_from_scans, [], [], SMALL, min_scans=0)
    finer = GridSpec.centered(7.0, 7.0, 0.5)
    truths = [drawn(*["......."] * 7), Truth(finer, np.zeros(finer.shape, np.uint8))]
    refused("on one grid", combine_truths, truths)
    refused("got none", combine_truths, [])


@settings(max_examples=30, deadline=None)
@given(st.floats(-20, 20), st.floats(-20, 20), st.floats(-3, 3), st.integers(0, 100))
def test_moved_boxes_hold_the_same_points(x: float, y: float, yaw: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    boxes = boxes_of(BOX, [-3, 2, 0.7, 2, 1, -1, 1])
    points = rng.uniform(-4, 4, (400, 3))
    T = pose(x, y, 0.3, yaw=yaw)
    there = transform_points(T, points)
    assert (count_returns(there, boxes.moved(T)) == count_returns(points, boxes)).all()
    assert (boxes_over_points(there, boxes.moved(T)) == boxes_over_points(points, boxes)).all()
    back = boxes.moved(T).moved(inverse(T))
    for name in ("center", "size", "yaw"):
        np.testing.assert_allclose(getattr(back, name), getattr(boxes, name), atol=1e-9)


def test_wider_boxes_hold_what_lies_beside() -> None:
    beside = np.array([[2.6, 0.0, -5.0], [1.0, 1.2, 9.0], [2.6, 1.2, 0.0], [3.0, 0.0, 0.0]])
    box = boxes_of(BOX)
    assert not boxes_over_points(beside, box).any()
    assert boxes_over_points(beside, box.widened(0.3)).tolist() == [True, True, True, False]
    assert (box.widened(0.3).bottom[0], box.widened(0.3).top[0]) == pytest.approx((-2.1, 0.0))


def test_no_boxes_are_no_boxes() -> None:
    none = Boxes.empty()
    assert len(none.moved(np.eye(4))) == len(none.widened(1.0)) == 0
    assert not cells_in_boxes(none, SMALL).any()
    assert not boxes_over_points(np.zeros((2, 3)), none).any()
    assert (truth_from_boxes(none, [], SMALL).state == IGNORE).all()


def test_cells_in_boxes_join_what_each_covers() -> None:
    covered = cells_in_boxes(boxes_of(BOX, [-2, 2, 0, 1, 1, 0, 1]), SMALL)
    assert draw(Truth(SMALL, np.where(covered, OCCUPIED, IGNORE).astype(np.uint8))) == [
        "       ",
        "  ###  ",
        "  ###  ",
        "  ###  ",
        "       ",
        " #     ",
        "       ",
    ]


def test_which_tracks_move() -> None:
    tracks = {
        "parked": [(0.0, 0, 0), (1.0, 0.2, 0), (2.0, 0, 0.1)],
        "drives": [(0.0, 0, 0), (2.0, 2.1, 0)],
        "slower": [(0.0, 0, 0), (2.0, 1.9, 0)],
        "drives and waits": [(0.0, 0, 0), (2.0, 3.1, 0), (20.0, 3.1, 0)],
        "there and back": [(0.0, 0, 0), (4.0, 3.5, 0), (8.0, 0, 0)],
        "seen once": [(0.0, 50, 0)],
        "": [(0.0, 0, 0), (1.0, 90, 0)],
    }
    rows = [(name, *row) for name, track in tracks.items() for row in track]
    order = np.random.default_rng(0).permutation(len(rows))  # a track need not come in order
    stamps, boxes = [], []
    for name, stamp, x, y in (rows[n] for n in order):
        stamps.append(stamp + 1000)
        boxes.append(Boxes(np.array([x, y, 0]), np.ones(3), np.zeros(1), track=[name]))
    assert moving_tracks(stamps, boxes) == {"drives", "drives and waits", "there and back"}


# --- A map's road -----------------------------------------------------------------------------------


def test_an_area_looks_as_drawn() -> None:
    shape = [[[-3.5, -3.5], [-3.5, 0.1], [0.1, 0.1], [0.1, 3.5], [3.5, 3.5], [3.5, -3.5]]]  # an L in a mirror
    inside = cells_in_areas(shape, SMALL)
    assert draw(Truth(SMALL, np.where(inside, FREE, IGNORE).astype(np.uint8))) == [
        ".......",
        ".......",
        ".......",
        "   ....",
        "   ....",
        "   ....",
        "   ....",
    ]


@each("seed", range(2))
def test_areas_are_those_of_matplotlib(seed: int) -> None:
    from matplotlib.path import Path

    rng = np.random.default_rng(seed)
    spec = GridSpec.centered(32.0, 24.0, 0.16)
    angle = np.sort(rng.uniform(0, 2 * np.pi, 17))
    star = rng.uniform(2, 15, (17, 1)) * np.column_stack([np.cos(angle), np.sin(angle)]) + rng.uniform(-3, 3, 2)
    square = rng.uniform(-9, 9, 2) + np.array([[0, 0], [4, 1], [3, 5], [-1, 4]])
    x, y = np.broadcast_arrays(*spec.cell_centers)
    places = np.column_stack([x.ravel(), y.ravel()])
    wanted = Path(star).contains_points(places) | Path(square).contains_points(places)
    assert (cells_in_areas([star, square], spec).ravel() == wanted).all()


def road_with(points: list[list[float]], *boxes: list[float], near: float = 0.0) -> Truth:
    """Return the road of a flat street, all of it drivable, 1.8 m below the sensor."""
    xyz = np.array(points or np.empty((0, 3)), float).reshape(-1, 3)
    everywhere, ground = np.ones(SMALL.shape, bool), np.full(SMALL.shape, -1.8)
    return truth_from_road(everywhere, ground, xyz, xyz[:, 2] + 1.8, SMALL, boxes=boxes_of(*boxes), min_range=near)


def test_an_empty_street_is_free() -> None:
    assert (road_with([]).state == FREE).all()
    assert draw(road_with([], near=1.2))[2:5] == ["... ...", "..   ..", "... ..."]


def test_a_return_hides_the_road_behind_it() -> None:
    """It is 1.7 m high at 1 m ahead: the sensor sees over it only from 17 m on."""
    truth = road_with([[1.0, 0.0, -0.1]])
    assert draw(truth) == ["... ...", "... ...", "... ...", ".......", ".......", ".......", "......."]


def test_low_returns_stand_but_they_hide_little() -> None:
    """0.5 m high at 1 m: the line of sight over it meets the road at 1.8 / 1.3 m."""
    assert draw(road_with([[1.0, 0.0, -1.3]]))[:3] == [".......", ".......", "... ..."]


def test_what_lies_on_the_line_of_sight_hides_the_road() -> None:
    """The line from the sensor to the road at 2 m, 1.8 m below it, is 0.9 m below it at 1 m."""
    assert draw(road_with([[1.0, 0.0, -0.9]]))[:3] == [".......", "... ...", "... ..."]


def test_returns_hide_the_road_in_their_sector_alone() -> None:
    """By every pair of a cell and a return: in one sector of 0.4 deg, nearer, on the line of sight or above."""
    rng = np.random.default_rng(5)
    spec = GridSpec(0.5, (80, 50), (-20.0, -15.0))
    azimuth, away = rng.uniform(-np.pi, np.pi, 400), rng.uniform(2, 15, 400)
    xyz = np.column_stack([away * np.cos(azimuth), away * np.sin(azimuth), rng.uniform(-1.8, 0.5, 400)])
    ground = rng.uniform(-2.0, -1.6, spec.shape)
    truth = truth_from_road(np.ones(spec.shape, bool), ground, xyz, xyz[:, 2] + 1.8, spec)

    x, y = (one[..., None] for one in np.broadcast_arrays(*spec.cell_centers))
    stands = (xyz[:, 2] + 1.8 > 0.3) & (xyz[:, 2] + 1.8 < 2.0)
    sector = np.floor(np.degrees(np.arctan2(y, x)) / 0.4) == np.floor(np.degrees(azimuth) / 0.4)
    distance = np.hypot(x, y)
    hidden = (sector & (away < distance) & (xyz[:, 2] / away >= ground[..., None] / distance) & stands).any(-1)
    stands &= spec.contains(*xyz[:, :2].T)
    hidden[spec.index(*xyz[stands, :2].T)] = True
    np.testing.assert_array_equal(truth.state, np.where(hidden, IGNORE, FREE))
    assert 0.1 < hidden.mean() < 0.9


@each("high", [0.1, 0.29, 2.0, 2.5])
def test_road_and_bridges_hide_nothing(high: float) -> None:
    assert (road_with([[1.0, 0.0, high - 1.8]]).state == FREE).all()


def test_boxes_are_no_road_however_few_returns_they_have() -> None:
    truth = road_with([], [2.0, 2.0, 0.0, 1.0, 1.0, -1.8, 0.0])
    assert draw(truth)[:2] == [".......", ". ....."]


def test_only_drivable_cells_are_free() -> None:
    drivable = np.zeros(SMALL.shape, bool)
    drivable[5, 1:4] = True
    truth = truth_from_road(drivable, np.full(SMALL.shape, -1.8), np.empty((0, 3)), np.empty(0), SMALL)
    assert (truth.state == np.where(drivable, FREE, IGNORE)).all()


# --- Other scans ------------------------------------------------------------------------------------

GROUND, KERB, WALL, SKY = hits(0, 0, 0.0), hits(0, 0, 0.2), hits(0, 0, 1.0), hits(0, 0, 3.0)
NOTHING = (np.empty((0, 3)), np.empty(0))


@each(("scans", "state"), [
    *(([GROUND, GROUND], FREE), ([GROUND, NOTHING], IGNORE)),  # one scan is not enough
    ([hits(0, 0, 0.0, 1), hits(0, 0, 0.0, 1)], IGNORE),  # nor are two returns
    *(([hits(0, 0, 0.0, 1), hits(0, 0, 0.0, 2)], FREE), ([WALL, WALL], OCCUPIED), ([KERB, KERB], IGNORE)),
    ([scan_of(GROUND, WALL), scan_of(GROUND, WALL)], OCCUPIED),
    ([scan_of(GROUND, hits(0, 0, 0.2, 1)), GROUND], IGNORE),  # not free where something low lies
    *(([SKY, SKY], IGNORE), ([scan_of(GROUND, SKY), GROUND], FREE)),
    ([WALL, WALL, GROUND, GROUND], OCCUPIED),  # half of them: it counts
    ([WALL, WALL, NOTHING, NOTHING, NOTHING], OCCUPIED),  # of those that saw the cell
    *(([hits(0, 0, z)] * 2, FREE) for z in (-0.3, 0.149)),
    *(([hits(0, 0, z)] * 2, IGNORE) for z in (-0.4, 0.15, 0.299, 2.0)),  # the first lies below the ground
    *(([hits(0, 0, z)] * 2, OCCUPIED) for z in (0.3, 1.999)),
    ([WALL, WALL, GROUND, GROUND, GROUND], IGNORE),  # it came or went
    ([hits(9, 0, 1.0), hits(9, 0, 1.0)], IGNORE),  # outside
])  # fmt: skip
def test_what_scans_agree_on(scans, state) -> None:
    assert seen(scans) == state


def test_scans_are_counted_in_the_cells_that_hold_their_points() -> None:
    spec = GridSpec(0.5, (8, 5), (-1.0, -2.0))
    truth = truth_from_scans(*zip(*[scan_of(hits(2.8, 0.4, 1.0), hits(-0.9, -1.9, 0.0))] * 2, strict=True), spec)
    expected = np.full(spec.shape, IGNORE)
    expected[7, 4], expected[0, 0] = OCCUPIED, FREE
    np.testing.assert_array_equal(truth.state, expected)


def test_one_scan_is_enough_where_min_scans_is_one() -> None:
    assert seen([WALL], min_scans=1) == OCCUPIED
    assert seen([GROUND], min_scans=1) == FREE
    assert seen([GROUND], min_scans=1, moving=np.ones(SMALL.shape, bool)) == IGNORE


def against(truth: Truth, *parts: tuple[np.ndarray, np.ndarray], reach: float = 1.0) -> list[str]:
    where = contradicted(truth, *scan_of(*parts), reach)
    return draw(Truth(SMALL, np.where(where, OCCUPIED, IGNORE).astype(np.uint8)))[2:5]


def test_what_came_since_is_contradicted() -> None:
    street = drawn(*["......."] * 6, "#######")
    assert against(street, hits(0, 0, 1.0)) == ["   #   ", "  ###  ", "   #   "]
    assert against(street, hits(0, 0, 0.0)) == ["       "] * 3


def test_what_left_since_is_contradicted() -> None:
    street = drawn(".......", ".......", "..###..", "..###..", "..###..", ".......", ".......")
    assert against(street, hits(0, 0, 0.0)) == ["   #   ", "  ###  ", "   #   "]
    assert against(street, hits(0, 0, 0.0), hits(1, 1, 1.0)) == ["       "] * 3  # it still stands there
    assert against(street, hits(0, 0, 1.0)) == ["       "] * 3


@each(
    ("high", "of_free", "of_occupied"),
    [
        *((-0.301, False, False), (-0.3, False, True), (0.149, False, True), (0.15, False, False)),
        *((0.299, False, False), (0.3, True, False), (1.999, True, False), (2.0, False, False)),
    ],
)
def test_heights_that_contradict(high: float, of_free: bool, of_occupied: bool) -> None:
    for state, contradicts in ((FREE, of_free), (OCCUPIED, of_occupied)):
        truth = Truth(SMALL, np.full(SMALL.shape, state, np.uint8))
        assert contradicted(truth, *hits(0, 0, high)).any() == contradicts


@each(("reach", "cells"), [(0.3, 1), (0.5, 1), (0.51, 2), (1.0, 2), (0.0, 1)])
def test_a_contradiction_reaches_so_far(reach: float, cells: int) -> None:
    truth = Truth(GridSpec(0.5, (9, 8), (-2.0, -2.0)), np.full((9, 8), FREE, np.uint8))
    found = np.argwhere(contradicted(truth, *hits(0.2, 0.3, 1.0), reach)) - [4, 4]
    expected = [(x, y) for x in range(-4, 5) for y in range(-4, 4) if abs(x) + abs(y) <= cells]
    assert sorted(map(tuple, found)) == expected


def test_an_obstacle_stands_for_its_eight_neighbours_and_no_further() -> None:
    """Ground in an occupied cell is no contradiction as long as an obstacle was seen in one of the nine cells."""
    truth = Truth(SMALL, np.full(SMALL.shape, OCCUPIED, np.uint8))
    for x in range(-3, 4):
        for y in range(-3, 4):
            cells = contradicted(truth, *scan_of(hits(0, 0, 0.0), hits(x, y, 1.0)))
            assert cells[3, 3] == (max(abs(x), abs(y)) > 1), (x, y)


# --- All together -----------------------------------------------------------------------------------


def test_sources_add_up_and_contradictions_are_ignored() -> None:
    rows = ["       "] * 6
    one = drawn(*rows, ".#.# ? ")
    other = drawn(*rows, ".##.? .")
    assert draw(combine_truths([one, other]))[6] == ".#    ."
    assert draw(combine_truths([other, one]))[6] == ".#    ."
    assert draw(combine_truths([one]))[6] == ".#.#   "


def test_boxes_win_and_uncertain_cells_are_never_free() -> None:
    rows = ["       "] * 6
    scans, boxes = drawn(*rows, "..##   "), drawn(*rows, "# #    ")
    assert draw(combine_truths([scans], boxes=boxes))[6] == "#.##   "
    uncertain = np.ones(SMALL.shape, bool)
    assert draw(combine_truths([scans], boxes=boxes, uncertain=uncertain))[6] == "# ##   "
    unobserved = np.ones(SMALL.shape, bool)
    assert (combine_truths([scans], boxes=boxes, unobserved=unobserved).state == IGNORE).all()
    assert draw(combine_truths([], boxes=boxes)) == draw(boxes)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.permutations(range(3)))
def test_the_order_of_sources_does_not_matter(seed: int, order: list[int]) -> None:
    rng = np.random.default_rng(seed)
    sources = [Truth(SMALL, rng.integers(0, 4, SMALL.shape).astype(np.uint8)) for _ in range(3)]
    state = combine_truths(sources).state
    assert (state == combine_truths([sources[n] for n in order]).state).all()
    assert not (state == UNKNOWN).any()
    for known in (FREE, OCCUPIED):
        assert (np.any([one.state == known for one in sources], axis=0) | (state != known)).all()


def test_ignored_cells_are_those_and_the_truth_stays_as_it_was() -> None:
    rows = ["       "] * 6
    truth, cells = drawn(*rows, "..##   "), np.zeros(SMALL.shape, bool)
    cells[0, 5] = True
    assert draw(ignore_cells(truth, cells))[6] == ". ##   "
    assert draw(truth)[6] == "..##   "
