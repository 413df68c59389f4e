"""Radial velocities in the dynamic map: one component is measured at once, the other stays open, what stands stays."""

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import logsumexp

from ogm import EvidentialGrid, Frame, GridSpec, Mount, Scan
from ogm.fusion import BinaryBayesMapper, DynamicMapper, EvidentialMapper, update_map
from ogm.fusion.dynamic.measured_velocities import MeasuredVelocities
from ogm.fusion.dynamic.radial import MIN_DEVIATION, TURN_RATE, _solved, radial_evidence, with_radial_velocities
from ogm.fusion.dynamic.velocity_evidence import group_velocities
from ogm.geometric import RadarISM
from ogm.geometric.doppler import RadialVelocities, radial_velocities
from ogm.pose import pose

SPEC = GridSpec.centered(length=51.2, width=38.4, resolution=0.2)
FRONT = pose(3.7, 0.0, 0.6)
MOUNT = Mount(0.6, FRONT, ego_footprint=(-1.0, 3.9, -1.0, 1.0))
ISM = RadarISM(SPEC, MOUNT, keep_moving=True)
OWN, CAR, START, PERIOD = 5.0, np.array([-6.0, 0.0]), np.array([20.0, 2.0]), 0.05
BIRTH_SPEED = 6.0


def sweep(k: int, *, car: np.ndarray = CAR, rotation: float = 0.0) -> Frame:
    """Return sweep k, at 20 Hz, of walls and of the front of a car that approaches a vehicle."""
    rng, T = np.random.default_rng(k), pose(OWN * k * PERIOD, yaw=rotation)
    body = START + k * PERIOD * car + np.column_stack([rng.uniform(-2.2, -1.8, 5), rng.uniform(-0.9, 0.9, 5)])
    walls = np.column_stack([rng.uniform(-20, 60, 60), rng.choice([-9.0, 9.0], 60)])
    velocity = np.vstack([np.zeros((60, 2)), np.tile(car, (5, 1))])
    rays = np.vstack([walls, body]) - (T @ FRONT)[:2, 3]
    seen = (rays[:, 0] > 1) & (np.hypot(*rays.T) < 45)
    distance = np.hypot(*rays[seen].T)
    unit = rays[seen] / distance[:, None]
    doppler = (unit * (velocity[seen] - (OWN, 0))).sum(axis=1) + rng.normal(0, 0.08, len(unit))
    points = np.zeros((len(unit), 4), np.float32)
    points[:, :2] = unit * (distance + rng.normal(0, 0.1, len(unit)))[:, None]
    scan = Scan(points, doppler=doppler.astype(np.float32))
    return Frame(scan, MOUNT, None, None, T_map_sensor=T @ FRONT, stamp=k * PERIOD, name=str(k))


def of_the_car(mapper: DynamicMapper, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean velocity, standard deviation along and across the beam, and dynamic, of the occupied cells."""
    grid = mapper.dynamic_grid
    x, y = np.broadcast_arrays(*grid.spec.cell_centers)
    middle = START + k * PERIOD * CAR - (2.0, 0.0)
    cells = (abs(x - middle[0]) < 0.5) & (abs(y - middle[1]) < 1.1) & (grid.occupied > 0.5)
    assert cells.sum() >= 5
    beam = middle - (OWN * k * PERIOD + 3.7, 0)
    beam /= np.hypot(*beam)
    turn = np.array([beam, (-beam[1], beam[0])])
    covariance = turn @ grid.covariance[cells].mean(axis=0) @ turn.T
    return turn @ grid.velocity[cells].mean(axis=0), np.sqrt(np.diag(covariance)), grid.dynamic[cells].mean()


def detections(rng: np.random.Generator, count: int = 4) -> RadialVelocities:
    """Return detections of an object around (12, -5) m by a sensor at the origin."""
    xy = (12.0, -5.0) + rng.uniform(-2, 2, (count, 2))
    unit = xy / np.hypot(*xy.T)[:, None]
    speed = unit @ rng.normal(0, 0.7, 2) + rng.normal(0, 0.2, count)
    return RadialVelocities(xy, unit, speed, rng.uniform(0.1, 0.8, count), np.full((count, 2), 0.2))


def by_integration(radial: RadialVelocities) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean and covariance of the velocity, and the log ratio of likelihoods of moving and standing.

    Integrated over velocities and turn rates: the prior times the likelihood of each detection on a body that turns
    about its middle.
    """
    s = np.maximum(radial.deviation, MIN_DEVIATION)
    middle = np.average(radial.xy, axis=0, weights=s**-2)
    ux, uy = middle / np.hypot(*middle)
    along, across = np.arange(-600, 601)[:, None, None] * 0.05, np.arange(-40, 41)[:, None] * 1.0
    turn = np.linspace(-5, 5, 31) * TURN_RATE
    vx, vy = along * ux - across * uy, along * uy + across * ux
    log = -(turn**2) / (2 * TURN_RATE**2) + np.zeros_like(vx)
    for (x, y), u, speed, one in zip(radial.xy, radial.direction, radial.speed, s, strict=True):
        predicted = u[0] * (vx - turn * (y - middle[1])) + u[1] * (vy + turn * (x - middle[0]))
        log -= (speed - predicted) ** 2 / (2 * one**2)
    log_likelihood = logsumexp(log, axis=2)
    log_prior = -(vx[..., 0] ** 2 + vy[..., 0] ** 2) / (2 * BIRTH_SPEED**2)
    log_prior -= logsumexp(log_prior)
    evidence = logsumexp(log_prior + log_likelihood)
    posterior = np.exp(log_prior + log_likelihood - evidence)
    at = np.stack([vx[..., 0], vy[..., 0]], axis=-1)
    mean = (posterior[..., None] * at).sum(axis=(0, 1))
    covariance = np.einsum("ij,ijk,ijl->kl", posterior, at - mean, at - mean)
    return mean, covariance, evidence - log_likelihood[600, 40]


@pytest.mark.parametrize(("seed", "count"), [(0, 1), (1, 1), (2, 3), (3, 4), (4, 8)])
def test_births_and_odds_are_those_of_integration_over_velocities_and_turn_rates(seed, count):
    radial = detections(np.random.default_rng(seed), count)
    radial = radial._replace(speed=np.clip(radial.speed, *(np.median(radial.speed) + (-0.7, 0.7))))  # all agree
    information, weighted = radial_evidence(radial, np.ones(count, np.int32), 1)
    found = with_radial_velocities(
        MeasuredVelocities(np.zeros(SPEC.shape, np.int32), np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, bool)),
        radial._replace(extent=np.full((count, 2), 4.0)),  # one group
        np.full((SPEC.shape[0], 2 * SPEC.shape[1]), 0.4, np.float32)
        * np.tile([0, 1], SPEC.shape[1]).astype(np.float32),
        no_belief(),
        SPEC,
    )
    np.testing.assert_allclose(found.information, information, rtol=1e-9)
    np.testing.assert_allclose(found.information[0] @ found.velocity[0], weighted[0], rtol=1e-6)
    row = group_velocities(*found, BIRTH_SPEED, 1.0, 1e30).rows[1].astype(float)
    mean, covariance, log_odds = by_integration(radial)
    factor = np.array([[row[7], 0], [row[8], row[9]]])
    np.testing.assert_allclose(row[5:7], mean, atol=0.02)
    np.testing.assert_allclose(factor @ factor.T, covariance, rtol=0.02, atol=0.02)
    assert np.log(row[10]) == pytest.approx(max(log_odds, 0), abs=0.05)
    assert np.linalg.matrix_rank(information[0], tol=1e-9) == min(count, 2)


def test_a_component_that_is_measured_to_20_metres_per_second_only_is_not_measured():
    """Two detections side by side: float32 would lose their difference, and the prior is far more certain."""
    unit = np.array([(1.0, 0.0), (np.cos(0.005), np.sin(0.005))])
    information = (unit[:, :, None] * unit[:, None, :] / 0.3**2).sum(axis=0)
    weighted = (unit * np.array([4.0, 4.1])[:, None] / 0.3**2).sum(axis=0)
    (v,), (one,) = _solved(information[None], weighted[None])
    np.testing.assert_allclose(one, information, atol=2e-4)
    assert np.linalg.eigvalsh(one) == pytest.approx([0, np.linalg.eigvalsh(information)[1]], abs=1e-9)
    np.testing.assert_allclose(v, (4.05, 0.0025 * 4.05), atol=1e-3)  # not (4, 20)
    prior, both = np.eye(2) / BIRTH_SPEED**2, ((information, weighted), (one, one @ v))
    mean = [np.linalg.solve(prior + measured, vector) for measured, vector in both]
    np.testing.assert_allclose(mean[0], mean[1], atol=0.2)


def no_belief():
    return DynamicMapper(SPEC, 1)._cells


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.floats(1e-3, 10))
def test_information_is_never_negative_and_velocities_are_finite(seed, count, deviation):
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-19, 19, (count, 2))
    unit = xy / np.hypot(*xy.T)[:, None]
    radial = RadialVelocities(xy, unit, rng.normal(0, 50, count), np.full(count, deviation), np.full((count, 2), 0.5))
    measured = rng.dirichlet([1, 1, 1], SPEC.shape)[..., :2].astype(np.float32).reshape(SPEC.shape[0], -1)
    label = np.kron(np.arange(16).reshape(4, 4), np.ones((64, 48), np.int32)).astype(np.int32)
    information = np.array([k % 2 * np.eye(2) for k in range(15)])
    matched = MeasuredVelocities(label, rng.normal(0, 5, (15, 2)), information, np.zeros(15, bool))
    for before in (matched, MeasuredVelocities(0 * label, np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0, bool))):
        found = with_radial_velocities(before, radial, measured, no_belief(), SPEC)
        assert found.label.max() <= len(found.velocity)
        assert (np.linalg.eigvalsh(found.information) > -1e-9).all()
        rows = group_velocities(*found, 6.0, 0.95, 100.0).rows
        assert np.isfinite(rows).all()
        assert rows[:, 10].min() >= 1


def test_a_matched_group_takes_the_information_of_its_detections_and_others_stay():
    label = np.zeros(SPEC.shape, np.int32)
    label[100:140, 60:80], label[200:220, 20:40], label[60:90, 100:130] = 1, 2, 3  # the last without a match
    measured = np.zeros((*SPEC.shape, 2), np.float32)
    measured[label > 0] = 0.1, 0.8
    measured[30:40, 150:160] = 0.1, 0.8  # occupied, and in no group
    information = np.array([np.eye(2) / 0.5**2, np.eye(2), np.zeros((2, 2))])
    velocity = np.array([[4.0, 1.0], [1.0, 1.0], [9.0, 9.0]])
    matched = MeasuredVelocities(label, velocity, information, np.ones(3, bool))
    x, y = SPEC.cell_centers
    places = [(x[i, 0], y[0, j]) for i, j in ((120, 70), (35, 155), (75, 115), (10, 10))]  # the last on nothing
    speed, extent = np.array([2.0, 3.0, 5.0, 9.0]), np.full((4, 2), 0.2)
    radial = RadialVelocities(np.array(places), np.tile([0.0, 1.0], (4, 1)), speed, np.full(4, 0.5), extent)
    found = with_radial_velocities(matched, radial, measured.reshape(SPEC.shape[0], -1), no_belief(), SPEC)
    matches = (label == 1) | (label == 2)
    np.testing.assert_array_equal(found.label[matches], label[matches])
    own = found.label[35, 155], found.label[75, 115]
    assert own == (4, 5)
    for number in own:
        assert 4 <= (found.label == number).sum() <= 25
    assert found.label.max() == 5
    wanted = [np.diag([4, 8]), np.eye(2), np.zeros((2, 2)), np.diag([0, 4]), np.diag([0, 4])]
    np.testing.assert_allclose(found.information, wanted, atol=1e-12)
    np.testing.assert_allclose(found.velocity[[0, 1, 3, 4]], [(4, 1.5), (1, 1), (0, 3), (0, 5)], atol=1e-9)
    assert matched.label.max() == 3  # not changed


def test_one_that_differs_from_its_group_counts_nothing_and_two_that_contradict_measure_nothing():
    unit = np.tile([1.0, 0.0], (5, 1))
    radial = RadialVelocities(np.zeros((5, 2)), unit, np.array([5.0, 5, 30, 4, -9]), np.full(5, 0.5), np.ones((5, 2)))
    information, weighted = radial_evidence(radial, np.array([1, 1, 1, 2, 2], np.int32), 2)
    np.testing.assert_allclose(information[:, 0, 0], [2 / 0.5**2, 0])
    np.testing.assert_allclose(weighted, [(10 / 0.5**2, 0), (0, 0)])


@pytest.fixture(scope="module")
def maps() -> list[dict[int, tuple]]:
    """The car in maps with and without radial velocities, after some sweeps."""
    found = []
    for radial in (True, False):
        mapper, states = DynamicMapper(SPEC, 50_000), {}
        for k in range(8):
            frame = sweep(k)
            if radial:
                update_map(mapper, ISM(frame.scan), frame)
            else:
                mapper.update(ISM(frame.scan), pose(OWN * k * PERIOD), stamp=frame.stamp)
            states[k] = of_the_car(mapper, k) if radial or k in (0, 3) else ()
        found.append(states)
    return found


def test_after_one_sweep_the_velocity_along_the_beam_is_right_and_across_it_open(maps):
    beam = START - (2.0 + 3.7, 0)
    wanted = CAR @ beam / np.hypot(*beam)
    (along, across), deviation, dynamic = maps[0][0]
    assert along == pytest.approx(wanted, abs=0.5)
    assert abs(across) < 1.5
    assert deviation[0] < 1.5  # with a share of births that did not make the measurement
    assert deviation[1] > 4.5
    assert dynamic > 0.3
    for k in (0, 3):
        velocity, spread, dynamic = maps[1][k]
        assert abs(velocity[0] - wanted) > 2
        assert spread[0] > 2
        assert dynamic < 0.1


def test_sweep_by_sweep_the_car_stays_right_along_the_beam_and_is_less_uncertain_across(maps):
    states = maps[0]
    for k in range(3, 8):
        velocity, deviation, dynamic = states[k]
        assert velocity[0] == pytest.approx(CAR[0], abs=0.7)
        assert deviation[0] < 1.0
        assert dynamic > 0.55
    assert states[7][1][1] < 0.6 * states[0][1][1]


def test_a_standing_world_stays_static():
    mapper, without = (DynamicMapper(SPEC, 20_000, matching=False) for _ in range(2))
    for k in range(8):
        frame = sweep(k, car=np.zeros(2))
        assert len(radial_velocities(frame.scan, MOUNT).speed) == 0
        update_map(mapper, ISM(frame.scan), frame)
        without.update(ISM(frame.scan), pose(OWN * k * PERIOD), stamp=frame.stamp)
    grid, plain = mapper.dynamic_grid, without.dynamic_grid
    assert (grid.dynamic > grid.static)[grid.occupied > 0.5].mean() < 0.01
    for name in ("mass", "velocity", "covariance"):  # nothing moves: as without
        np.testing.assert_array_equal(getattr(grid, name), getattr(plain, name))


def test_beside_what_moves_what_stands_stays_as_static_as_without():
    with_radial, without = (DynamicMapper(SPEC, 20_000, matching=False) for _ in range(2))
    for k in range(6):
        frame = sweep(k)
        update_map(with_radial, ISM(frame.scan), frame)
        without.update(ISM(frame.scan), pose(OWN * k * PERIOD), stamp=frame.stamp)
    grid, plain = with_radial.dynamic_grid, without.dynamic_grid
    x, y = np.broadcast_arrays(*grid.spec.cell_centers)
    walls = (abs(abs(y) - 9) < 1) & (plain.occupied > 0.5)
    assert walls.sum() > 50
    np.testing.assert_allclose(grid.static[walls], plain.static[walls], atol=0.1)
    assert grid.static[walls].mean() == pytest.approx(plain.static[walls].mean(), abs=0.01)


def block(k: int, speed: float = 4.0) -> EvidentialGrid:
    """Return scan k, at 10 Hz, of a lidar: a car in free space."""
    x, y = np.broadcast_arrays(*SPEC.cell_centers)
    car = (abs(x + 6 - speed * 0.1 * k) < 2) & (abs(y - 4) < 0.9)
    return EvidentialGrid(SPEC, np.where(car[..., None], (0.05, 0.8), (0.6, 0.02)).astype(np.float32))


NOTHING = RadialVelocities.empty()


def test_sparse_scans_are_not_matched_and_dense_ones_are():
    """A radar's sweeps between those of a lidar leave the matched velocities as they are."""
    alone, between, dense = (DynamicMapper(SPEC, 20_000) for _ in range(3))
    specks = np.zeros((*SPEC.shape, 2), np.float32)
    specks[::7, ::7] = 0.0, 0.6
    for k in range(6):
        for mapper in (alone, between, dense):
            radial = NOTHING._replace(dense=True) if mapper is dense else None
            mapper.update(block(k), np.eye(4), stamp=0.1 * k, radial=radial)
        between.update(EvidentialGrid(SPEC, specks), np.eye(4), stamp=0.1 * k + 0.05, radial=NOTHING)
        assert len(between._groups.rows) == 1
    histories = [[(stamp, cells.sum()) for stamp, _, cells in mapper._history._scans] for mapper in (alone, between)]
    assert histories[0] == histories[1]
    np.testing.assert_array_equal(alone.dynamic_grid.mass, dense.dynamic_grid.mass)
    np.testing.assert_array_equal(alone.dynamic_grid.velocity, dense.dynamic_grid.velocity)
    assert len(dense._groups.rows) > 1


def test_doppler_of_a_dense_scan_joins_the_matched_velocity():
    mapper = DynamicMapper(SPEC, 20_000)
    for k in range(6):
        place = np.array([(-4.0 + 0.4 * k, 4.0)])
        radial = RadialVelocities(place, np.array([[1.0, 0.0]]), np.full(1, 4.4), np.full(1, 0.1), np.full((1, 2), 0.3))
        mapper.update(block(k), np.eye(4), stamp=0.1 * k, radial=radial._replace(dense=True))
    information = mapper._groups.rows[1:, 2:5]
    matched = DynamicMapper(SPEC, 20_000)
    for k in range(6):
        matched.update(block(k), np.eye(4), stamp=0.1 * k)
    assert len(matched._groups.rows) == len(mapper._groups.rows) == 2
    more = information[0] - matched._groups.rows[1, 2:5]
    np.testing.assert_allclose(more, [MIN_DEVIATION**-2, 0, 0], atol=2.0)
    assert matched._groups.rows[1, 0] < mapper._groups.rows[1, 0] < 4.4


def test_a_detection_measures_what_the_map_holds_as_dynamic_where_the_scan_marks_nothing():
    """`RadarISM` leaves moving detections out by default: their Doppler is of the lidar's car nevertheless."""
    place, direction, extent = np.array([(0.0, 4.0)]), np.array([(1.0, 0.0)]), np.full((1, 2), 0.6)
    measured, velocities = RadialVelocities(place, direction, np.full(1, 5.0), np.full(1, 0.3), extent), []
    for radial in (NOTHING, measured):
        mapper = DynamicMapper(SPEC, 50_000)
        for k in range(6):
            mapper.update(block(k), np.eye(4), stamp=0.1 * k)
        mapper.update(EvidentialGrid.vacuous(SPEC), np.eye(4), stamp=1.5, radial=radial)
        x, y = np.broadcast_arrays(*SPEC.cell_centers)
        velocities.append(mapper.dynamic_grid.velocity[np.hypot(x, y - 4) < 0.5][:, 0].mean())
    assert velocities[0] == pytest.approx(4, abs=0.3)  # a second after the last scan, particles have spread
    assert velocities[1] == pytest.approx(5, abs=0.4)


@each("make", [EvidentialMapper, BinaryBayesMapper])
def test_other_maps_ignore_radial_velocities(make):
    a, b = make(SPEC, half_life=2.0), make(SPEC, half_life=2.0)
    for k in range(3):
        frame = sweep(k)
        update_map(a, ISM(frame.scan), frame)
        b.update(ISM(frame.scan), pose(OWN * k * PERIOD), stamp=frame.stamp)
    assert a.grid == b.grid


@each("make", [EvidentialMapper, lambda spec: DynamicMapper(spec, 100)])
def test_what_is_no_radial_velocities_is_refused_and_the_map_stays(make):
    mapper, later = make(SPEC), (block(1), np.eye(4))
    mapper.update(block(0), np.eye(4), stamp=0.0)
    before, wrong = mapper.grid, NOTHING._replace(xy=np.zeros((3, 2)))
    message = "radial must be RadialVelocities, got list"
    refused(message, mapper.update, *later, stamp=0.1, radial=[], error=TypeError)
    refused("must have shape", mapper.update, *later, stamp=0.1, radial=wrong)
    assert mapper.grid == before
    assert mapper.stamp == 0


def test_a_turned_vehicle_measures_along_the_beams_of_the_map():
    """Places and directions are in the frame of the grid, and turn with its pose."""
    mapper = DynamicMapper(SPEC, 20_000)
    mass = np.zeros((*SPEC.shape, 2), np.float32)
    mass[SPEC.index(np.array([10.1]), np.array([0.1]))] = 0.0, 0.8
    radial = RadialVelocities(
        np.array([(10.1, 0.1)]), np.array([(1.0, 0.0)]), np.full(1, -5.0), np.full(1, 0.3), np.full((1, 2), 0.1)
    )
    mapper.update(EvidentialGrid(SPEC, mass), pose(yaw=np.pi / 2), stamp=0.0, radial=radial)
    grid = mapper.dynamic_grid
    i, j = grid.spec.index(np.array([-0.1]), np.array([10.1]))
    np.testing.assert_allclose(grid.velocity[i, j], [(0, -5)], atol=0.5)
    assert grid.covariance[i, j][0, 0, 0] > 20
