from dataclasses import dataclass, replace

import numpy as np
import pytest
from cases import each, refused

from ogm.simulation.materials import Material
from ogm.simulation.town import Lane
from ogm.simulation.traffic.bodies import CARS, VANS, car, ego_vehicle
from ogm.simulation.traffic.departure import Density
from ogm.simulation.traffic.heavy import bus, trailer, truck
from ogm.simulation.traffic.motion import Traffic
from ogm.simulation.traffic.parked import overlap
from ogm.simulation.traffic.people import bicycle, motorcycle, standing, walking
from ogm.truth.boxes import boxes_seen_from
from ogm.truth.motion import track_motion

pytestmark = pytest.mark.usefixtures("kept_towns")  # for its worker: kernels of the traffic take half a minute
FROZEN = pytest.mark.slow  # frozen code: test_dataset.py compares what samples hold
M = Material
SIZES = {  # [m] plausible length, width, height
    "car": ((3.3, 5.2), (1.7, 2.3), (1.25, 1.85)),
    "van": ((4.1, 6.1), (1.9, 2.5), (1.7, 2.8)),
    "truck": ((6.5, 9.3), (2.3, 3.0), (2.9, 4.0)),
    "trailer": ((5.0, 7.5), (2.2, 2.6), (3.0, 4.0)),
    "bus": ((9.0, 12.5), (2.4, 3.0), (2.8, 3.3)),
    "motorcycle": ((1.8, 2.4), (0.6, 1.0), (1.3, 1.9)),
    "bicycle": ((1.6, 2.0), (0.4, 0.9), (1.3, 2.0)),
    "pedestrian": ((0.25, 2.1), (0.3, 1.2), (0.9, 2.4)),
}


@dataclass(frozen=True, eq=False)
class Village:
    """A block of streets: two lanes round it, a shortcut through it with crossings at its ends."""

    lanes: tuple[Lane, ...]
    bays: np.ndarray
    walkways: tuple[np.ndarray, ...]
    loop: tuple[int, ...]
    counter_loop: tuple[int, ...]

    def ground_height(self, x, y):
        return 0.04 * np.asarray(x) + 0.02 * np.asarray(y)


def _line(*corners):
    corners = np.array(corners, float)
    way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    even = np.linspace(0, way[-1], int(way[-1]) + 1)
    x, y = (np.interp(even, way, corners[:, k]) for k in (0, 1))
    return np.column_stack([x, y, 0.04 * x + 0.02 * y])


def _arc(center, radius, start, stop):
    angle = np.deg2rad(np.linspace(start, stop, 15))
    return [(center[0] + radius * np.cos(a), center[1] + radius * np.sin(a)) for a in angle]


def make_village():
    """Round a square: inner lane clockwise, outer lane counter-clockwise; a street across the middle."""

    def ring(half, radius, sense):
        corners = [(half - radius) * np.array(c) for c in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
        points = [(half, 0.0)]
        for k, c in enumerate(corners):
            points += _arc(c, radius, 90 * k, 90 * k + 90)
        points = np.array([*points, (half, 0.0)])
        return points if sense > 0 else points[::-1]

    def cut(points, cuts):
        """Split a ring where it comes through the y axis: four junction pieces and the rest."""
        line = _line(*points)
        inside = np.abs(line[:, 0]) < cuts
        edges = np.flatnonzero(np.diff(inside.astype(int))) + 1
        parts = np.split(line, edges)
        whole = [np.concatenate([parts[-1], parts[0][1:]]), *parts[1:-1]]
        return [np.concatenate([a, b[:1]]) for a, b in zip(whole, whole[1:] + whole[:1], strict=True)]

    clockwise = cut(ring(60.0, 12.0, -1), 10)
    counter = cut(ring(63.4, 15.4, 1), 10)
    lanes = []
    for first, parts in ((0, clockwise), (4, counter)):
        for k, part in enumerate(parts):
            junction = -1 if k % 2 == 0 else (0 if part[:, 1].mean() > 0 else 1)
            lanes.append(Lane(part, 3.2, 12.0, (first + (k + 1) % 4,), junction, -1 if junction < 0 else first // 4))
    # The shortcut leaves the inner ring in the south, runs north and merges into it again.
    south = next(k for k in range(4) if lanes[k].junction == 1)
    north = next(k for k in range(4) if lanes[k].junction == 0)
    begin, end = lanes[south].points[0, :2], lanes[north].points[-1, :2]
    into = _line(*_arc((begin[0], begin[1] + 8), 8, -90, -180))
    back = _line(*_arc((end[0], end[1] - 8), 8, 180, 90))
    middle = _line(into[-1, :2], back[0, :2])
    lanes[south - 1] = replace(lanes[south - 1], successors=(south, 8))
    lanes.append(Lane(into, 3.2, 8.0, (9,), 1, 2))
    lanes.append(Lane(middle, 3.2, 12.0, (10,), -1, -1))
    lanes.append(Lane(back, 3.2, 8.0, lanes[north].successors, 0, 2))
    bays = np.array([(56.8 * s, y, 0.0, np.pi / 2, 6.0, 2.1) for s in (-1, 1) for y in np.arange(-40, 41, 6.5)])
    walkways = (_line((-66, 30), (-50, 30)), _line((68, -45), (68, 45)), _line((-52, -45), (-52, 45)))
    return Village(tuple(lanes), bays, walkways, (0, 1, 2, 3), (4, 5, 6, 7))


@pytest.fixture(scope="module")
def village():
    return make_village()


@pytest.fixture(scope="module")
def traffic(village):
    return Traffic(village, 1, clockwise=True)


def bodies():
    rng = np.random.default_rng(0)
    return [
        *[car(shape, M.PAINT_DARK) for shape in CARS.values()],
        *[car(shape, M.PAINT_LIGHT, label="van") for shape in VANS.values()],
        *[truck(rng, M.PAINT_MEDIUM) for _ in range(3)], *[trailer(rng) for _ in range(3)],
        *[bus(rng, M.PAINT_MEDIUM) for _ in range(2)], motorcycle(rng, M.PAINT_BLACK), bicycle(rng), standing(rng),
        *walking(rng), *walking(rng, grown=False),
    ]  # fmt: skip


def through(body, origin, direction):
    """Distance along a ray to each of a body's triangles that it meets (Moller and Trumbore)."""
    a, b, c = (body.mesh.vertices[body.mesh.triangles[:, k]].astype(float) for k in range(3))
    p = np.cross(direction, c - a)
    det = np.einsum("nk,nk->n", b - a, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = np.einsum("nk,nk->n", origin - a, p) / det
        q = np.cross(origin - a, b - a)
        v = np.einsum("nk,k->n", q, direction) / det
        t = np.einsum("nk,nk->n", c - a, q) / det
        return np.flatnonzero((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0))


@each("body", bodies())
def test_bodies_have_plausible_exact_centred_bounds(body):
    low, high = body.mesh.vertices.min(axis=0), body.mesh.vertices.max(axis=0)
    np.testing.assert_allclose(high - low, body.size, atol=1e-6)
    np.testing.assert_allclose((low + high)[:2], 0, atol=1e-5)
    assert low[2] == 0
    for size, (least, most) in zip(body.size, SIZES[body.label], strict=True):
        assert least < size < most
    assert 150 <= len(body.mesh.triangles) <= 700
    assert body.mesh.triangles.max() < len(body.mesh.vertices)


@each("shape", [*CARS.values(), *VANS.values()])
def test_cars_stand_on_four_wheels_with_a_gap_below_and_glass_above(shape):
    body = car(shape, M.PAINT_LIGHT)
    used = {Material(m) for m in body.mesh.material}
    assert {M.CAR_GLASS, M.TYRE, M.PLATE, M.LAMP, M.PAINT_LIGHT} <= used
    feet = body.mesh.vertices[body.mesh.vertices[:, 2] < 0.03]
    for x in body.axles:
        for side in (-1, 1):
            assert ((np.abs(feet[:, 0] - x) < 0.2) & (feet[:, 1] * side > 0.4)).any()
    side = np.array([0.0, 1.0, 0.0])
    assert len(through(body, np.array([0.05, -5.0, 0.09]), side)) == 0  # below the floor
    middle = np.array([0.05, -5.0, 0.6])
    assert len(through(body, middle, side)) >= 2
    # Not a box: the bonnet lies well below the roof.
    front = body.mesh.vertices[body.mesh.vertices[:, 0] > body.size[0] / 2 - 0.5]
    assert front[:, 2].max() < 0.75 * body.size[2]


@FROZEN
def test_ego_vehicle_is_an_estate_of_one_material():
    mesh = ego_vehicle()
    assert set(mesh.material) == {M.EGO_VEHICLE}
    assert 1.4 < mesh.vertices[:, 2].max() <= 1.5
    assert 4.6 < np.ptp(mesh.vertices[:, 0]) < 4.95


def same(a, b):
    assert len(a.objects) == len(b.objects)
    np.testing.assert_array_equal(a.ego, b.ego)
    for p, q in zip(a.objects, b.objects, strict=True):
        assert (p.label, p.track) == (q.label, q.track)
        np.testing.assert_array_equal(p.pose, q.pose)
        np.testing.assert_array_equal(p.velocity, q.velocity)
        np.testing.assert_array_equal(p.mesh.vertices, q.mesh.vertices)


@FROZEN
def test_a_frame_does_not_depend_on_what_was_asked_before(village):
    first, second = (Traffic(village, 4, clockwise=True) for _ in range(2))
    first.at(100.0)
    for time in (5.0, 33.37, 0.0):
        same(first.at(time), second.at(time))


@FROZEN
@each("clockwise", [True, False])
def test_the_yaw_rate_is_the_turn_to_the_left(village, clockwise):
    traffic, dt = Traffic(village, 7, clockwise=clockwise), 0.05
    rates = []
    for time in np.arange(1.0, 60.0, 0.7):
        before, now, after = (traffic.at(time + k * dt) for k in (-1, 0, 1))
        turned = np.linalg.inv(before.ego) @ after.ego
        rates.append((now.ego_yaw_rate, np.arctan2(turned[1, 0], turned[0, 0]) / (2 * dt)))
    told, found = np.array(rates).T
    np.testing.assert_allclose(told, found, atol=0.01)
    assert told.mean() * (-1 if clockwise else 1) > 0.02


@FROZEN
@each("clockwise", [True, False])
def test_the_ego_vehicle_drives_round_the_right_way(village, clockwise):
    traffic = Traffic(village, 7, clockwise=clockwise)
    places = np.array([traffic.at(t).ego[:2, 3] for t in np.arange(0, 300, 1.0)])
    angle = np.unwrap(np.arctan2(places[:, 1], places[:, 0]))
    turned = (angle[-1] - angle[0]) / (2 * np.pi)
    assert (turned < -1) if clockwise else (turned > 1)
    moved = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert moved.mean() > 3
    assert moved.max() < 14


@FROZEN
def test_corners_of_boxes_move_by_velocity_and_yaw_rate(traffic):
    """The yaw rate of a track, with the velocity that is stated, moves all corners as they move (v + ω × r)."""
    dt, farthest = 0.1, 0.0

    def corners(boxes):
        c, s, half = np.cos(boxes.yaw), np.sin(boxes.yaw), boxes.size[:, :2] / 2
        u, v = (np.array(side) * half[:, k, None] for k, side in enumerate(([1, 1, -1, -1], [1, -1, -1, 1])))
        r = np.stack([c[:, None] * u - s[:, None] * v, s[:, None] * u + c[:, None] * v], axis=-1)
        return r, boxes.center[:, None, :2] + r

    for start in (20.0, 28.0, 36.0, 61.3):
        states = [[one for one in traffic.at(start + k * dt).objects if one.label != "pedestrian"] for k in range(3)]
        frames = [boxes_seen_from(np.eye(4), [o.pose for o in now], [o.size for o in now]) for now in states]
        frames = [replace(one, track=[str(o.track) for o in now]) for one, now in zip(frames, states, strict=True)]
        turn = track_motion(1, [0.0, dt, 2 * dt], frames, reach=0.15, needed=0).yaw_rate[:, None]
        r, _ = corners(frames[1])
        velocity = np.array([one.velocity[:2] for one in states[1]])[:, None]
        want = velocity + np.stack([-turn * r[..., 1], turn * r[..., 0]], axis=-1)
        found = (corners(frames[2])[1] - corners(frames[0])[1]) / (2 * dt)
        np.testing.assert_allclose(found, want, atol=0.2)
        farthest = max(farthest, np.abs(want - velocity).max())
    assert farthest > 0.8  # without the yaw rate, corners of what turns would be wrong by this


def test_density_multiplies_vehicles_people_and_the_share_of_bicycles(village):
    def count(density):
        things = Traffic(village, 3, clockwise=True, density=density).at(50.0).objects
        moving = [thing.label for thing in things if thing.track < 1000]
        people = sum(label == "pedestrian" for label in moving)
        return len(moving) - people, people, sum(label == "bicycle" for label in moving)

    usual, dense = count(Density()), count(Density(vehicles=2, people=5))
    assert dense[1] == 5 * usual[1] > 0
    assert 1.6 * usual[0] < dense[0] <= 2 * (usual[0] + 1)
    same(*(Traffic(village, 3, clockwise=True, **given).at(9.0) for given in ({}, {"density": Density()})))
    cycling = count(Density(vehicles=2, bicycles=100))
    assert cycling[2] > 0.7 * cycling[0]


def rectangles(frame):
    own = ego_vehicle().vertices
    poses = np.array([frame.ego] + [o.pose for o in frame.objects])
    size = np.array([np.ptp(own, axis=0)] + [o.size for o in frame.objects])
    return np.column_stack([poses[:, 0, 3], poses[:, 1, 3], np.arctan2(poses[:, 1, 0], poses[:, 0, 0]), size[:, :2]])


@FROZEN
def test_vehicles_do_not_drive_through_each_other(village, traffic):
    own, others, pairs = 0, 0, 0
    for time in np.arange(0, 400, 2.0):
        frame = traffic.at(time)
        boxes = rectangles(frame)
        labels = ["own"] + [o.label for o in frame.objects]
        far = np.hypot(*(boxes[:, None, :2] - boxes[None, :, :2]).transpose(2, 0, 1))
        reach = np.hypot(boxes[:, 3], boxes[:, 4]) / 2
        for a, b in np.argwhere(np.triu(far < reach[:, None] + reach, 1)):
            coupled = {labels[a], labels[b]} == {"truck", "trailer"}
            if coupled or labels[a] == labels[b] == "pedestrian":
                continue
            pairs += 1
            hit = overlap(boxes[a], boxes[b])
            own += hit and a == 0
            others += hit and a > 0
    assert own == 0
    assert others <= 0.01 * pairs


@FROZEN
def test_parked_vehicles_keep_off_the_lanes(village, traffic):
    parked = [o for o in traffic.at(0).objects if o.track >= 1000]
    assert len(parked) > 5
    lanes = np.concatenate([lane.points[:, :2] for lane in village.lanes])
    for o in parked:
        assert not o.velocity.any()
        corners = np.array([(sx, sy, 0, 1) for sx in (-0.5, 0.5) for sy in (-0.5, 0.5)]) * [*o.size[:2], 0, 1]
        corners = (o.pose @ corners.T).T[:, :2]
        gap = np.linalg.norm(corners[:, None] - lanes[None], axis=2).min()
        assert gap > 1.5


@FROZEN
@each("time", [-0.1, 1200.5, np.nan, np.inf])
def test_times_outside_the_scenario_are_refused(traffic, time):
    refused("time must be in", traffic.at, time)


@each("seed", [-1, 1.5, True, "x"])
def test_bad_seeds_are_refused(village, seed):
    refused("seed must be", Traffic, village, seed, clockwise=True)
