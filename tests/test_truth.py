"""Truth grids: the rules on small grids drawn by hand, crops, boxes, and real recordings."""

import io
import lzma

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given, settings
from hypothesis import strategies as st

from ogm import GridSpec
from ogm.pose import inverse, pose
from ogm.scan import Boxes
from ogm.state import PARTICIPANT, CellState, Truth
from ogm.truth import HEIGHT_LIMITS, TRUTH_SPEC, Kind, cells_in_boxes, rays, truth_from_points
from ogm.truth.boxes import boxes_seen_from, cells_in_footprint, count_returns
from ogm.truth.observe import observe_points
from ogm.truth.points import finalize_truth, height_above_ground
from ogm.truth.rays import observe_rays

UNKNOWN, FREE, OCCUPIED, IGNORE = CellState
SMALL = GridSpec.centered(7.0, 7.0, 1.0)  # 7 x 7 cells of 1 m around (0, 0)
PAPER = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
LETTERS = " .#x"  # unknown, free, occupied, ignore


def draw(truth: Truth) -> list[str]:
    """Return the grid as one sees it: row 0 is ahead, the first letter is left."""
    return ["".join(LETTERS[state] for state in row[::-1]) for row in truth.state[::-1]]


def box(x: float, y: float, yaw: float, length: float, width: float, bottom: float = -50, top: float = 50) -> Boxes:
    """Return one box."""
    center, size = [x, y, (bottom + top) / 2], [length, width, top - bottom]
    return Boxes(np.array(center), np.array(size), np.array([yaw]))


def truth_of(hits: list[tuple], **known) -> Truth:
    """Return the truth of hits given as (x, y, kind, height)."""
    x, y, kind, height = np.array(hits or np.empty((0, 4)), float).T
    seen = np.zeros(SMALL.shape, np.uint8)
    observe_points(seen, x, y, kind.astype(int), height, SMALL)
    return finalize_truth(seen, SMALL, **known)


# --- Rules ------------------------------------------------------------------------------------------


def test_a_street_with_a_wall_looks_as_drawn() -> None:
    road = [(x, y, Kind.GROUND, 0.0) for x in range(-3, 3) for y in (-1, 0, 1)]
    wall = [(3, y, Kind.OBSTACLE, 1.0) for y in range(-3, 2)]
    assert draw(truth_of(road + wall)) == ["  #####", "  ...  ", "  ...  ", "  ...  ", "  ...  ", "  ...  ", "  ...  "]


def test_nothing_is_known_without_hits() -> None:
    assert (truth_of([]).state == UNKNOWN).all()


@each(("kind", "height", "state"), [
    *((Kind.GROUND, 0.0, FREE), (Kind.GROUND, -0.3, FREE), (Kind.GROUND, 1.9, FREE)),
    (Kind.GROUND, 2.5, UNKNOWN),  # the deck of a bridge is no evidence of the road below
    *((Kind.OBSTACLE, 0.02, UNKNOWN), (Kind.OBSTACLE, 0.05, OCCUPIED), (Kind.OBSTACLE, 1.99, OCCUPIED)),
    *((Kind.OBSTACLE, 2.0, UNKNOWN), (Kind.PLANT, 0.1, FREE), (Kind.PLANT, 0.3, OCCUPIED), (Kind.PLANT, 3.0, UNKNOWN)),
    *((Kind.STEP, 0.02, UNKNOWN), (Kind.STEP, 0.12, OCCUPIED), (Kind.OTHER, 1.0, UNKNOWN)),
])  # fmt: skip
def test_kind_and_height_decide(kind: Kind, height: float, state: int) -> None:
    truth = truth_of([(1, 2, kind, height)])
    assert truth.state[SMALL.index(1, 2)] == state
    assert np.count_nonzero(truth.state) == (state != UNKNOWN)


def test_occupied_wins_over_free_in_any_order() -> None:
    hits = [(0, 0, Kind.GROUND, 0.0), (0.3, 0.3, Kind.STEP, 0.12), (0.2, 0, Kind.GROUND, 0.0)]
    for k in range(3):
        assert truth_of(hits[k:] + hits[:k]).state[3, 3] == OCCUPIED


def test_a_bridge_does_not_block() -> None:
    road = [(x, 0, Kind.GROUND, 0.0) for x in range(-3, 4)]
    bridge = [(1, y, Kind.OBSTACLE, 4.5) for y in range(-3, 4)]
    assert (truth_of(road + bridge).state == truth_of(road).state).all()


def test_hits_outside_the_grid_count_for_nothing() -> None:
    outside = [(3.5, 0, Kind.OBSTACLE, 1.0), (-3.51, 0, Kind.GROUND, 0.0), (0, 1e9, Kind.OBSTACLE, 1.0)]
    assert (truth_of(outside).state == UNKNOWN).all()


BOX = box(1.0, 1.0, 0.0, 3.0, 2.0)  # covers the middles of x 0..2, y 0..2


def test_a_participant_with_enough_returns_is_filled() -> None:
    ground = [(1, 1, Kind.GROUND, 0.0)]
    assert draw(truth_of(ground, boxes=BOX, returns=[50])) == [
        "       ",
        " ###   ",
        " ###   ",
        " ###   ",
        "       ",
        "       ",
        "       ",
    ]


def test_a_participant_with_fewer_returns_is_occupied_where_hit() -> None:
    hits = [(0, 0, Kind.OBSTACLE, 0.5), (1, 1, Kind.GROUND, 0.0)]
    assert (truth_of(hits, boxes=BOX, returns=[49]).state == truth_of(hits).state).all()
    filled = truth_of(hits, boxes=BOX, returns=[50])
    assert np.count_nonzero(filled.state == OCCUPIED) == 9


def test_cells_under_the_ego_vehicle_are_ignored() -> None:
    ego = cells_in_footprint((-1.1, 1.1, -0.4, 0.4), SMALL)
    truth = truth_of([(0, 0, Kind.OBSTACLE, 0.5)], unobserved=ego, boxes=BOX, returns=[99])
    assert (truth.state[2:5, 3] == IGNORE).all()
    assert truth.ignored.sum() == 3


def test_turning_hits_and_boxes_by_a_quarter_turns_the_truth() -> None:
    rng = np.random.default_rng(1)
    hits = [
        (x, y, k, h)
        for x, y, k, h in zip(*rng.uniform(-3, 3, (2, 40)), rng.integers(0, 5, 40), rng.uniform(-1, 3, 40), strict=True)
    ]
    turned = [(-y, x, k, h) for x, y, k, h in hits]
    there, quarter = box(1.0, -1.2, 0.4, 3.0, 1.5), pose(yaw=np.pi / 2)
    truth = truth_of(hits, boxes=there, returns=[60], unobserved=cells_in_footprint((0, 1, -1, 1), SMALL))
    footprint = cells_in_footprint((-1, 1, 0, 1), SMALL)
    other = truth_of(turned, boxes=there.moved(quarter), returns=[60], unobserved=footprint)
    np.testing.assert_array_equal(np.rot90(truth.state, 1), other.state)


def test_cells_beyond_the_world_are_ignored_unless_hit() -> None:
    seen = np.array([[0, 1], [2, 0]], np.uint8)
    truth = finalize_truth(seen, GridSpec(1.0, (2, 2), (0, 0)), beyond=np.array([[True, True], [True, False]]))
    assert truth.state.tolist() == [[IGNORE, FREE], [OCCUPIED, UNKNOWN]]


# --- Rays -------------------------------------------------------------------------------------------


def test_rays_and_points_give_the_same_observation() -> None:
    """On cells so small that most hold one hit or none: each hit counts."""
    rng = np.random.default_rng(3)
    count, spec = 6_000, GridSpec.centered(7.0, 6.0, 0.1, center=(0.5, 0.0))
    directions = rng.normal(size=(count, 3)).astype(np.float32)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distance = rng.uniform(0.1, 8, count).astype(np.float32)
    distance[:50], distance[50:60], distance[60:62] = np.inf, np.nan, 1e6
    kind = rng.integers(0, len(Kind), count).astype(np.uint8)
    ground = rng.uniform(-2, -1, spec.shape).astype(np.float32)
    ground[30] = np.nan
    rise = rng.uniform(0, 0.1, spec.shape).astype(np.float32)

    fast, uncompiled = np.zeros((2, *spec.shape), np.uint8)
    highest, also = np.zeros((2, *spec.shape), np.float32)
    hits = (distance, directions, kind, ground, rise)
    observe_rays(fast, highest, *hits, spec)
    rules = rays._Rules(spec.resolution, *spec.origin, HEIGHT_LIMITS)
    getattr(rays._observe_rays, "py_func", rays._observe_rays)(uncompiled, also, *hits, rules)
    np.testing.assert_array_equal(fast, uncompiled)
    np.testing.assert_array_equal(highest, also)

    x, y, z = (distance[:, None].astype(float) * directions)[60:].T
    kind, inside = kind[60:], spec.contains(x, y)
    x, y, z, kind = x[inside], y[inside], z[inside], kind[inside]
    height = z - ground[spec.index(x, y)]
    known = height < 2.0
    height = np.where(kind == Kind.STEP, rise[spec.index(x, y)], height)
    slow = np.zeros(spec.shape, np.uint8)
    observe_points(slow, x[known], y[known], kind[known], height[known], spec)
    np.testing.assert_array_equal(fast, slow)
    assert (np.bincount(fast.ravel(), minlength=4) > 50).all()
    assert (fast[30] == 0).all()
    slow_highest = np.zeros(spec.shape, np.float32)
    limit = np.select([kind == Kind.PLANT, (kind == Kind.OBSTACLE) | (kind == Kind.STEP)], [0.25, 0.05], np.inf)
    obstacle = known & (height >= limit)
    np.maximum.at(slow_highest, spec.index(x[obstacle], y[obstacle]), height[obstacle])
    np.testing.assert_allclose(highest, slow_highest, rtol=1e-5)
    assert ((highest > 0) == (fast >= 2)).all()


def test_heights_are_kept_in_centimetres_and_participants_have_none_of_their_own() -> None:
    seen = np.array([[2, 3, 1], [2, 0, 2]], np.uint8)
    highest = np.array([[0.052, 1.9999, 0.0], [0.5, 0.0, 0.3]], np.float32)
    car = box(1.5, 1.5, 0.0, 0.5, 0.5)
    truth = finalize_truth(
        seen, GridSpec(1.0, (2, 3), (0, 0)), boxes=car, returns=[50], unobserved=np.eye(2, 3, 2, bool), highest=highest
    )
    assert truth.height_cm is not None
    assert truth.height_cm.tolist() == [[5, 200, 0], [50, PARTICIPANT, 30]]
    turned = truth.crop(GridSpec(1.0, (3, 2), (-3, 0)), yaw=np.pi / 2)
    assert turned.height_cm is not None
    assert turned.height_cm.tolist() == [[0, 30], [200, PARTICIPANT], [5, 50]]
    mirrored = truth.mirrored().height_cm
    assert mirrored is not None
    assert mirrored.tolist() == [[0, 200, 5], [30, PARTICIPANT, 50]]


@each(
    ("x", "y", "z", "kind", "bits"),
    [
        (-3.5, 0.0, 0.0, Kind.GROUND, 1),  # the lower edges are inside
        (0.0, -3.5, 0.0, Kind.GROUND, 1),
        (3.5, 0.0, 0.0, Kind.GROUND, 0),
        (0.0, 3.5, 0.0, Kind.GROUND, 0),
        (1.0, 0.0, 0.9, Kind.GROUND, 1),  # the ground lies at -1 m, the clearance at 1 m
        (1.0, 0.0, 1.0, Kind.GROUND, 0),
        (1.0, 0.0, 0.5, Kind.OBSTACLE, 2),
        (1.0, 0.0, 1.0, Kind.OBSTACLE, 0),
        (1.0, 0.0, -0.95, Kind.OBSTACLE, 2),
        (1.0, 0.0, -0.96, Kind.OBSTACLE, 0),
        (1.0, 0.0, -0.8, Kind.PLANT, 1),
        (1.0, 0.0, -0.75, Kind.PLANT, 2),
        (1.0, 0.0, -0.8, Kind.STEP, 2),  # the ground rises by 0.1 m
        (1.0, 0.0, -0.8, Kind.OTHER, 0),
    ],
)
def test_each_kind_of_hit_leaves_its_bits(x: float, y: float, z: float, kind: Kind, bits: int) -> None:
    at = np.array([[x, y, z]])
    distance = np.linalg.norm(at, axis=1)
    ground, rise = np.full(SMALL.shape, -1.0, np.float32), np.full(SMALL.shape, 0.1, np.float32)
    seen = np.zeros(SMALL.shape, np.uint8)
    hit = distance, at / distance[:, None], np.array([kind], np.uint8)
    observe_rays(seen, np.zeros(SMALL.shape, np.float32), *hit, ground, rise, SMALL)
    assert seen.sum() == bits
    other = np.zeros(SMALL.shape, np.uint8)
    height = np.array([0.1 if kind == Kind.STEP else z + 1.0])
    observe_points(other, at[:, 0], at[:, 1], np.array([kind]), height, SMALL)
    np.testing.assert_array_equal(other, seen)


def test_an_observation_may_be_built_up_in_parts() -> None:
    rng = np.random.default_rng(4)
    x, y = rng.uniform(-3, 3, (2, 60))
    kind, height = rng.integers(0, 5, 60), rng.uniform(0, 3, 60)
    seen, whole = np.zeros((2, *SMALL.shape), np.uint8)
    for part in np.array_split(rng.permutation(60), 7):
        observe_points(seen, x[part], y[part], kind[part], height[part], SMALL)
    observe_points(whole, x, y, kind, height, SMALL)
    np.testing.assert_array_equal(seen, whole)


# --- Crops ------------------------------------------------------------------------------------------


@given(st.floats(-10, 10))
@settings(max_examples=40, deadline=None)
def test_the_truth_extent_covers_the_papers_grid_at_any_turn(yaw: float) -> None:
    truth = Truth(TRUTH_SPEC, np.full(TRUTH_SPEC.shape, FREE, np.uint8))
    assert (truth.crop(PAPER, yaw).state == FREE).all()


# --- Boxes ------------------------------------------------------------------------------------------


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-4, 4), st.floats(0.3, 5), st.floats(0.3, 3))
@settings(max_examples=50, deadline=None)
def test_a_box_covers_the_cells_whose_middles_it_holds(x, y, yaw, length, width) -> None:
    spec = SMALL.refined(4)
    covered = cells_in_boxes(box(x, y, yaw, length, width), spec)
    cx, cy = np.broadcast_arrays(*spec.cell_centers)
    middles = np.stack([cx, cy, 0 * cx, 0 * cx + 1]).reshape(4, -1)
    u, v = (inverse(pose(x, y, yaw=yaw)) @ middles)[:2]
    expected = ((np.abs(u) <= length / 2) & (np.abs(v) <= width / 2)).reshape(spec.shape)
    extra = covered & ~expected
    assert not (expected & ~covered).any()
    assert extra.sum() <= 1
    assert not extra.any() or covered[spec.index(x, y)]


def test_a_box_too_small_for_any_middle_covers_one_cell() -> None:
    assert np.argwhere(cells_in_boxes(box(0.4, 0.4, 0.3, 0.1, 0.1), SMALL)).tolist() == [[3, 3]]


def test_a_box_beyond_the_grid_covers_nothing() -> None:
    for beyond in (box(9, 0, 0, 2, 2), box(-9, -9, 1, 2, 2)):
        assert not cells_in_boxes(beyond, SMALL).any()


def test_a_footprint_covers_the_cells_whose_centers_it_holds() -> None:
    covered = np.argwhere(cells_in_footprint((-1.0, 2.4, 0.5, 1.0), SMALL))
    assert covered.tolist() == [[2, 4], [3, 4], [4, 4], [5, 4]]


def test_returns_are_counted_in_turned_boxes() -> None:
    T = pose(4.0, -2.0, 0.5, yaw=0.6)
    inside = np.random.default_rng(0).uniform((-2, -0.9, 0), (2, 0.9, 1.5), (70, 3))
    outside = inside + np.array([0, 2.0, 0])
    points = np.concatenate([inside, outside]) @ T[:3, :3].T + T[:3, 3]
    two = box(4.0, -2.0, 0.6, 4.0, 1.8, 0.5, 2.0), box(4.0, -2.0, 0.6, 4.0, 1.8, 8, 9.5)
    both = Boxes(*(np.concatenate([getattr(one, name) for one in two]) for name in ("center", "size", "yaw")))
    assert count_returns(points, both).tolist() == [70, 0]
    assert count_returns(points + [0, 0, 7.5], both).tolist() == [0, 70]
    higher = np.count_nonzero(inside[:, 2] >= 0.4)
    assert count_returns(points, two[0], above_bottom=0.4).tolist() == [higher]
    assert 0 < higher < 70
    assert count_returns(np.full((3, 3), np.nan), both).tolist() == [0, 0]
    assert count_returns(points, Boxes.empty()).tolist() == []


def test_boxes_are_seen_from_the_sensor() -> None:
    T_world_sensor = pose(10, 5, 1.9, yaw=1.0)
    T_sensor_object = pose(7, 3, -1.9, yaw=0.3)
    boxes = boxes_seen_from(inverse(T_world_sensor), [T_world_sensor @ T_sensor_object], [[4.0, 1.8, 1.5]])
    np.testing.assert_allclose(boxes.center, [[7, 3, -1.15]], atol=1e-12)
    np.testing.assert_allclose(boxes.size, [[4.0, 1.8, 1.5]], atol=1e-12)
    np.testing.assert_allclose(boxes.yaw, [0.3], atol=1e-12)
    assert len(boxes_seen_from(np.eye(4), np.empty((0, 4, 4)), np.empty((0, 3)))) == 0


def test_a_box_seen_from_a_tilted_sensor_holds_all_its_corners_in_height() -> None:
    tilted = pose(0, 0, 1.9, pitch=0.1, roll=-0.05)
    seen = boxes_seen_from(inverse(tilted), [pose(10, 0, 0)], [[4.0, 2.0, 1.5]])
    corners = np.array([(10 + x, y, z) for x in (-2, 2) for y in (-1, 1) for z in (0, 1.5)])
    z = (np.c_[corners, np.ones(8)] @ inverse(tilted).T)[:, 2]
    np.testing.assert_allclose((seen.bottom[0], seen.top[0]), (z.min(), z.max()), atol=1e-9)


# --- Bad input --------------------------------------------------------------------------------------


def test_no_boxes_are_boxes_too() -> None:
    truth = truth_of([(0, 0, Kind.GROUND, 0.0)], boxes=Boxes.empty(), returns=np.zeros(0, int))
    assert np.count_nonzero(truth.state) == 1


def test_wrong_points_are_refused() -> None:
    three, nothing = np.zeros((3, 3)), np.zeros(3, int)
    for returns in (None, [1, 2], 50):
        refused(r"returns must have shape \(1,\)", truth_of, [], boxes=BOX, returns=returns)
    refused("points must have shape", count_returns, np.zeros((3, 2)), BOX)
    refused("1 poses and 2 sizes", boxes_seen_from, np.eye(4), [np.eye(4)], np.ones((2, 3)))
    refused("points must have shape", truth_from_points, np.zeros((3, 2)), nothing, SMALL)
    for kind in (np.zeros(2, int), np.array([0, 5, 0]), np.array([0, -1, 0])):
        refused("one Kind per point", truth_from_points, three, kind, SMALL)
    for xyz, is_ground, message in (
        (np.zeros(3), np.zeros(3, bool), "xyz must have shape"),
        (three, nothing, "is_ground must be 3 booleans"),
        (three * np.nan, np.ones(3, bool), "xyz must be finite"),
        (np.diag([1e30, 1e30, 0]), np.ones(3, bool), "got a point at .*: drop it"),
        (np.array([[0, 0, 1e9], [2e4, 3e4, 0]]), np.ones(2, bool), r"got a point at \[20000.0, 30000.0\] m"),
    ):
        refused(message, height_above_ground, xyz, is_ground)


# --- Recordings -------------------------------------------------------------------------------------


def slope(x, y):
    return 0.08 * x - 0.05 * y - 1.7


def test_height_above_ground_follows_a_slope() -> None:
    rng = np.random.default_rng(0)
    xy = rng.uniform(-20, 20, (4000, 2))
    lifted = np.where(rng.random(4000) < 0.3, rng.uniform(0.1, 2, 4000), 0.0)
    xyz = np.column_stack([xy, slope(*xy.T) + lifted])
    error = height_above_ground(xyz, lifted == 0) - lifted
    assert np.abs(error).max() < 0.12
    assert np.sqrt(np.mean(error**2)) < 0.03


def test_the_ground_is_linear_between_the_medians_of_squares() -> None:
    from scipy.interpolate import RegularGridInterpolator

    rng = np.random.default_rng(1)
    median = rng.normal(size=(9, 6))
    squares = np.argwhere(np.ones((9, 6)))  # the first point, at (0, 0), is the middle of the first square
    shifts = rng.permuted(np.tile([-0.5, -0.1, 0.0, 2.0], (54, 1)), axis=1)  # of an even number, the upper median
    ground = np.column_stack([np.repeat(squares, 4, 0), (median.reshape(-1, 1) + shifts).ravel()])
    places = rng.uniform((0, 0), (8, 5), (300, 2))
    z = rng.normal(size=300)
    xyz = np.concatenate([ground, np.column_stack([places, z])])
    height = height_above_ground(xyz, np.arange(len(xyz)) < len(ground))[len(ground) :]
    middles = np.arange(9.0), np.arange(6.0)
    np.testing.assert_allclose(height, z - RegularGridInterpolator(middles, median)(places), atol=1e-9)


def test_squares_without_ground_take_the_nearest_up_to_10_m() -> None:
    xyz = np.array([[0, 0, -1.7], [10, 0, 0], [0, 10, 0], [11, 0, 0], [8, 8, 0], [6, 6, 0], [25, 0, -0.7], [24, 0, 0]])
    xyz = np.column_stack([xyz, np.full(8, np.nan)])  # without intensities
    height = height_above_ground(xyz, np.isin(np.arange(8), [0, 6]))
    np.testing.assert_allclose(height, [0, 1.7, 1.7, np.nan, np.nan, 1.7, 0, 0.7], atol=1e-9)


def test_height_far_from_any_ground_is_not_known() -> None:
    xyz = np.array([[0, 0, -1.7], [0.2, 0, -0.7], [30, 0, 0.0]])
    height = height_above_ground(xyz, np.array([True, False, False]))
    np.testing.assert_allclose(height, [0, 1.0, np.nan], atol=1e-9)
    assert np.isnan(height_above_ground(xyz, np.zeros(3, bool))).all()


def test_recorded_cells_are_known_only_where_points_are() -> None:
    rng = np.random.default_rng(0)
    xy = np.concatenate([rng.uniform((-3, -1), (1, 1), (100, 2)), [[3, 0], [3, 1], [np.nan, 0]]])
    points = np.column_stack([xy, slope(*xy.T), np.full(103, np.nan)]).astype(np.float32)  # without intensities
    points[100:102, 2] += (1.0, 4.0)  # a post, and a branch above
    kind = np.array([Kind.GROUND] * 100 + [Kind.OBSTACLE] * 3)
    truth = truth_from_points(points, kind, SMALL)
    holding = np.zeros(SMALL.shape, bool)
    holding[SMALL.index(*xy[:100].T)] = True
    np.testing.assert_array_equal(truth.state == FREE, holding)
    assert truth.state[6, 3] == OCCUPIED
    assert truth.known.sum() == holding.sum() + 1


def kinds_of(classes: np.ndarray, ground: tuple, plants: tuple, other: tuple) -> np.ndarray:
    kind = np.full(len(classes), Kind.OBSTACLE, int)
    for group, value in ((ground, Kind.GROUND), (plants, Kind.PLANT), (other, Kind.OTHER)):
        kind[np.isin(classes, group)] = value
    return kind


@pytest.mark.parametrize(
    ("name", "ground", "plants", "other"),
    [("semantic_kitti/0", (9, 10, 11, 12, 17), (15,), (0,)), ("nuscenes/25611", (0, 1), (4,), (10,))],
)
def test_a_labelled_scan_makes_a_plausible_truth(real, name, ground, plants, other) -> None:
    path = real(f"labelled_range_images/{name}.npy.xz")
    image = np.load(io.BytesIO(lzma.decompress(path.read_bytes()))).reshape(-1, 6)
    image = image[image[:, 4] > 3.0]
    kind = kinds_of(image[:, 5].astype(int), ground, plants, other)
    truth = truth_from_points(
        image[:, :3], kind, PAPER, unobserved=cells_in_footprint((-2.25, 2.25, -0.95, 0.95), PAPER)
    )
    shares = truth.shares()
    assert 0.02 < shares.free < 0.3
    assert 0.002 < shares.occupied < 0.1
    # where only ground was labelled, the cell is free; what stands on the ground makes cells occupied
    hits = np.zeros((*PAPER.shape, 5), bool)
    inside = PAPER.contains(image[:, 0], image[:, 1])
    hits[(*PAPER.index(*image[inside, :2].T), kind[inside])] = True
    only_ground = hits[..., Kind.GROUND] & ~hits[..., Kind.OBSTACLE] & ~hits[..., Kind.PLANT] & ~truth.ignored
    assert (truth.state[only_ground] == FREE).all()
    nothing = ~hits.any(axis=2) & ~truth.ignored
    assert (truth.state[nothing] == UNKNOWN).all()
