"""The dynamic map: what moves gets a velocity, what stands keeps still, and masses stay masses."""

import numpy as np
import pytest
from cases import each, refused
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays as hypothesis_arrays

from ogm import evidence
from ogm.fusion import DynamicMapper, EvidentialMapper, fuse, make_mapper, rolling_window
from ogm.fusion.dynamic.cells import share_particles
from ogm.fusion.dynamic.prediction import predict_dynamic
from ogm.fusion.dynamic.settings import DynamicSettings
from ogm.fusion.dynamic.velocity_evidence import group_velocities
from ogm.grid import EvidentialGrid, GridSpec
from ogm.pose import pose
from ogm.scan import Frame, Mount, Scan

SPEC = GridSpec.centered(length=25.6, width=19.2, resolution=0.2)
SPEED, PERIOD = 4.0, 0.1  # [m/s], [s]


def centres(spec: GridSpec) -> tuple[np.ndarray, np.ndarray]:
    x, y = (spec.origin[k] + (np.arange(spec.shape[k]) + 0.5) * spec.resolution for k in (0, 1))
    return np.meshgrid(x, y, indexing="ij")


def street(k: int, spec: GridSpec = SPEC, x0: float = 0.0) -> tuple[EvidentialGrid, np.ndarray, np.ndarray]:
    """Scan k of a wall, a parked car and a moving one, all else free; the cells of what moves and of what stands."""
    x, y = centres(spec)
    x = x + x0
    standing = (abs(y - 6) < 0.3) | ((abs(x - 2) < 2) & (abs(y + 4) < 0.9))
    moving = (abs(x + 6 - SPEED * PERIOD * k) < 2) & (abs(y - 1) < 0.9)
    mass = np.where((standing | moving)[..., None], (0.05, 0.8), (0.6, 0.02)).astype(np.float32)
    return EvidentialGrid(spec, mass), moving, standing


def drive(mapper: DynamicMapper, scans: int = 25) -> tuple[np.ndarray, np.ndarray]:
    for k in range(scans):
        grid, moving, standing = street(k)
        mapper.update(grid, np.eye(4), stamp=PERIOD * k)
    return moving, standing


def arrays(mapper: DynamicMapper) -> list[np.ndarray]:
    grid = mapper.dynamic_grid
    p = mapper._particles
    n = p.start[-1]
    return [grid.mass, grid.velocity, grid.covariance, p.x[:n], p.y[:n], p.vx[:n], p.vy[:n], mapper.grid.mass]


@each("matching", [False, True])
def test_a_car_that_moves_is_dynamic_and_has_its_velocity(matching):
    mapper = DynamicMapper(SPEC, 50_000, matching=matching)
    moving, standing = drive(mapper)
    grid = mapper.dynamic_grid
    assert grid.dynamic[moving].mean() > (0.8 if matching else 0.6)
    assert grid.static[moving].mean() < (0.1 if matching else 0.3)
    error = np.hypot(*(grid.velocity[moving] - (SPEED, 0)).T)
    assert np.median(error) < (0.3 if matching else 1.0)
    assert grid.static[standing].mean() > 0.85
    assert (grid.dynamic[standing] > grid.static[standing]).mean() < 0.01


@each(("static_share", "near"), [(1.0, 1e-6), (0.9, 0.05)])
def test_nothing_moves_in_a_static_scene_whatever_the_vehicle_does(static_share, near):
    """Ego motion resamples nothing: by whole cells the static map is that of a standing vehicle, cell by cell."""
    step = 0.4  # [m], two cells
    numbers = DynamicSettings(static_share=static_share, to_dynamic_rate=0.0)
    still, driven = (DynamicMapper(SPEC, 20_000, settings=numbers) for _ in range(2))
    inner = (slice(8, -8), slice(None))
    x, y = centres(SPEC)
    for k in range(10):
        at = step * k
        for mapper, x0 in ((still, 0.0), (driven, at)):
            occupied = (abs(y - 6) < 0.3) | ((abs(x + x0 - 2) < 2) & (abs(y + 4) < 0.9))
            mass = np.where(occupied[..., None], (0.0, 0.8), (0.6, 0.0)).astype(np.float32)
            mapper.update(EvidentialGrid(SPEC, mass), pose(x0), stamp=0.1 * k)
    shift = round(step * 9 / SPEC.resolution)
    a, b = still.dynamic_grid, driven.dynamic_grid
    assert b.spec.origin[0] == pytest.approx(a.spec.origin[0] + shift * SPEC.resolution)
    np.testing.assert_allclose(a.static[shift:][inner], b.static[:-shift][inner], atol=near)
    moving = ((b.dynamic > b.static) & (b.occupied > 0.5))[:-24]  # beyond: what the moving window just discovers
    assert moving.sum() == 0


def test_masses_are_masses_and_sum_to_one():
    rng = np.random.default_rng(0)
    mapper = DynamicMapper(SPEC, 5_000, settings=DynamicSettings(min_unknown=0.0))
    for k in range(12):
        mass = rng.dirichlet([1, 1, 0.2], size=SPEC.shape)[..., :2]
        mass[rng.random(SPEC.shape) < 0.1] = (1, 0)
        mass[rng.random(SPEC.shape) < 0.1] = (0, 1)  # total conflict, too
        grid = EvidentialGrid(SPEC, mass.astype(np.float32))
        mapper.update(grid, pose(0.7 * k, 0.2 * k, yaw=0.1 * k), stamp=0.1 * k)
        one = mapper.dynamic_grid
        total = one.mass.sum(axis=-1) + one.unknown
        np.testing.assert_allclose(total, 1, atol=1e-6)
        assert one.mass.min() >= 0
        assert one.mass.max() <= 1 + 1e-6
        has = one.dynamic > 0
        assert np.isfinite(one.velocity[has]).all()
        assert np.isnan(one.velocity[~has]).all()
        assert (np.linalg.eigvalsh(one.covariance[has].astype(float)) > -1e-3).all()
        np.testing.assert_allclose(mapper.grid.occupied, one.occupied, atol=1e-6)


@each("filter", ["hybrid", "nuss"])
def test_results_are_the_same_for_any_number_of_threads_and_from_run_to_run(filter):
    results = []
    for threads in (1, 1, 3):
        mapper = DynamicMapper(SPEC, 20_000, filter=filter, threads=threads)
        drive(mapper, 6)
        results.append(arrays(mapper))
    for other in results[1:]:
        for a, b in zip(results[0], other, strict=True):
            np.testing.assert_array_equal(a, b)
    other_seed = DynamicMapper(SPEC, 20_000, filter=filter, seed=1)
    drive(other_seed, 6)
    assert not np.array_equal(results[0][1], other_seed.dynamic_grid.velocity, equal_nan=True)


def test_particles_are_sorted_by_cell_and_share_the_mass_of_dynamic():
    mapper = DynamicMapper(SPEC, 30_000)
    drive(mapper, 8)
    p, grid = mapper._particles, mapper.dynamic_grid
    n = p.start[-1]
    assert abs(n - 30_000) <= 1
    cell = np.floor(p.x[:n] / 0.2).astype(int) * SPEC.shape[1] + np.floor(p.y[:n] / 0.2).astype(int)
    owner = np.repeat(np.arange(SPEC.shape[0] * SPEC.shape[1]), np.diff(p.start))
    assert (cell == owner).mean() > 0.999  # rounding at edges
    carried = np.diff(p.start) * mapper._particle_mass
    np.testing.assert_allclose(carried, grid.dynamic.reshape(-1), atol=1.01 * mapper._particle_mass)


def test_nuss_filter_has_no_static_and_its_walls_stand_still():
    mapper = DynamicMapper(SPEC, 100_000, filter="nuss")
    moving, standing = drive(mapper)
    grid = mapper.dynamic_grid
    assert grid.static.max() == 0
    assert not mapper.matching
    assert grid.dynamic[standing].mean() > 0.85
    assert np.hypot(*(grid.velocity[moving].mean(axis=0) - (SPEED, 0))) < 1.0
    parked = standing & (centres(SPEC)[1] < 0)
    assert np.hypot(*grid.velocity[parked].mean(axis=0)) < 0.7


def test_what_stops_becomes_static_and_what_starts_becomes_dynamic():
    mapper = DynamicMapper(SPEC, 50_000)
    for k in range(60):
        at = min(max(k - 10, 0), 20)
        grid, moving, _ = street(at)
        mapper.update(grid, np.eye(4), stamp=PERIOD * k)
        if k == 9:
            assert mapper.dynamic_grid.static[moving].mean() > 0.8
        if k == 29:
            assert mapper.dynamic_grid.dynamic[moving].mean() > 0.7
    grid = mapper.dynamic_grid
    assert np.nanmedian(grid.speed[moving] * (grid.dynamic / grid.occupied)[moving]) < 0.5


def test_static_scenes_are_mapped_as_by_dempsters_rule():
    """Without conflict, births or forgetting the masses of free and occupied are those of `EvidentialMapper`."""
    numbers = DynamicSettings(
        free_half_life=np.inf, static_half_life=np.inf, dynamic_half_life=np.inf, to_dynamic_rate=0, static_share=1
    )
    mapper = DynamicMapper(SPEC, 1000, settings=numbers)
    other = EvidentialMapper(SPEC, evidence.dempster, np.inf, moving_half_life=np.inf)
    rng = np.random.default_rng(1)
    for k in range(6):
        grid = EvidentialGrid(SPEC, rng.dirichlet([1, 1, 2], size=SPEC.shape)[..., :2].astype(np.float32))
        for one in (mapper, other):
            one.update(grid, pose(0.5 * k, yaw=0.2 * k), stamp=0.1 * k)
    np.testing.assert_allclose(mapper.grid.mass, other.grid.mass, atol=1e-5)
    for name, layer in mapper.conflict.layers.items():
        np.testing.assert_allclose(layer, other.conflict.layers[name], atol=1e-5)
    view, other_view = mapper.conflict_view(), other.conflict_view()
    for name, layer in view.layers.items():
        np.testing.assert_allclose(layer, other_view.layers[name], atol=1e-5)
    np.testing.assert_allclose(mapper.view().mass, other.view().mass, atol=1e-5)


@each("rate", [5, 40])
def test_forgetting_does_not_depend_on_the_rate(rate):
    numbers = DynamicSettings(free_half_life=1.0, static_half_life=2.0, static_share=1.0, to_dynamic_rate=0.0)
    mapper = DynamicMapper(SPEC, 1000, matching=False, settings=numbers)
    mapper.update(street(0)[0], np.eye(4), stamp=0)
    before = mapper.dynamic_grid
    for k in range(1, 2 * rate + 1):
        mapper.update(EvidentialGrid.vacuous(SPEC), np.eye(4), stamp=k / rate)
    after = mapper.dynamic_grid
    np.testing.assert_allclose(after.free, before.free / 4, atol=1e-5)
    np.testing.assert_allclose(after.static, before.static / 2, atol=1e-5)


def test_the_noise_of_velocities_does_not_depend_on_the_rate():
    spread = []
    for rate in (5, 40):
        numbers = DynamicSettings(birth_speed=0.0, velocity_noise=2.0, birth_rate=0.0, dynamic_half_life=np.inf)
        mapper = DynamicMapper(SPEC, 20_000, filter="nuss", settings=numbers)
        mass = np.zeros((*SPEC.shape, 2), np.float32)
        mass[60:68, 44:52] = (0, 0.5)
        mapper.update(EvidentialGrid(SPEC, mass), np.eye(4), stamp=0)
        for k in range(1, rate + 1):
            mapper.update(EvidentialGrid.vacuous(SPEC), np.eye(4), stamp=k / rate)
        p = mapper._particles
        spread.append(p.vx[: p.start[-1]].std())
    assert spread == pytest.approx([2.0, 2.0], rel=0.05)


def test_measured_velocities_steer_survivors_and_births():
    """The slot for any measurement of velocities: full, along one direction, and none."""
    label = np.zeros(SPEC.shape, np.int32)
    label[:40], label[40:80], label[80:] = 1, 2, 3
    information = np.array([np.eye(2) / 0.2**2, np.diag([1 / 0.2**2, 0.0]), np.zeros((2, 2))])
    velocity, moving = np.array([[5.0, -3.0], [5.0, np.nan], [np.nan, np.nan]]), np.zeros(3, bool)
    slot = group_velocities(label, velocity, information, moving, 6.0, 1.0)
    mapper = DynamicMapper(SPEC, 100_000, filter="nuss")
    mapper._measured_velocities = lambda scan, states, cells: slot
    mass = np.full((*SPEC.shape, 2), (0.0, 0.6), np.float32)
    for k in range(3):
        mapper.update(EvidentialGrid(SPEC, mass), np.eye(4), stamp=0.1 * k)
    p = mapper._particles
    v = np.stack([p.vx, p.vy], axis=1)[: p.start[-1]]
    inner = np.zeros_like(label)
    for group in (1, 2, 3):  # where few particles of other groups come
        inner[40 * group - 30 : 40 * group - 10, 20:-20] = group
    groups = np.repeat(inner.reshape(-1), np.diff(p.start))
    for group, mean, spread in ((1, (5, -3), (0.2, 0.2)), (2, (5, 0), (0.2, 6)), (3, (0, 0), (6, 6))):
        np.testing.assert_allclose(v[groups == group].mean(axis=0), mean, atol=0.4)
        np.testing.assert_allclose(v[groups == group].std(axis=0), spread, rtol=0.35)


def test_a_view_turns_velocities_into_the_axes_of_the_vehicle():
    mapper = DynamicMapper(SPEC, 50_000)
    moving, _ = drive(mapper)
    straight = mapper.dynamic_view()
    np.testing.assert_array_equal(straight.mass, mapper.dynamic_grid.mass)
    np.testing.assert_allclose(straight.velocity, mapper.dynamic_grid.velocity, rtol=1e-5)
    square = GridSpec.centered(length=12.8, width=12.8, resolution=0.2)
    plain = mapper.dynamic_view(square)
    turned = mapper.dynamic_view(square, pose(yaw=np.pi / 2))  # looks along y: (vx, vy) is (vy, -vx)
    back = np.rot90(plain.velocity, -1)
    seen = np.isfinite(back[..., 0])
    np.testing.assert_allclose(turned.velocity[seen], np.stack([back[seen][:, 1], -back[seen][:, 0]], 1), atol=1e-4)
    covariance = np.rot90(plain.covariance, -1)[seen]
    np.testing.assert_allclose(turned.covariance[seen][:, 0, 0], covariance[:, 1, 1], atol=1e-3)
    np.testing.assert_allclose(turned.covariance[seen][:, 0, 1], -covariance[:, 0, 1], atol=1e-3)
    np.testing.assert_allclose(mapper.view(square).occupied, plain.occupied, atol=1e-6)


def test_memory_is_flat_over_many_scans():
    mapper = DynamicMapper(SPEC, 2_000)
    sizes = []
    for k in range(60):
        mapper.update(street(k % 20)[0], pose(0.3 * k), stamp=0.1 * k)
        held = [*mapper._particles, *mapper._predicted, *mapper._cells, *mapper._next_cells, *mapper._moments]
        sizes.append((sum(one.nbytes for one in held), len(mapper._history._scans)))
    assert len({held for held, _ in sizes}) == 1
    assert max(kept for _, kept in sizes) < 10


def test_fuse_and_make_mapper_take_it():
    mount = Mount(1.7)
    frames = [
        Frame(Scan(np.zeros((1, 4), np.float32)), mount, None, None, T_map_sensor=pose(0.1 * k), stamp=0.1 * k)
        for k in range(3)
    ]

    class Model:
        spec = SPEC

        def __call__(self, scan):
            return street(0)[0]

    for rule in ("dynamic", "nuss"):
        mapper = make_mapper(rule, SPEC)
        steps = list(fuse(frames, Model(), mapper))
        assert [step.error for step in steps] == [None] * 3
        assert (mapper.filter == "nuss") == (rule == "nuss")
        assert mapper.scans == 3
        assert rule.replace("dynamic", "hybrid") in repr(mapper)
    assert make_mapper("dynamic", SPEC, 3.0).settings.static_half_life == 3.0


def test_objects_keep_their_number_and_predictions_lie_where_the_car_will_be():
    mapper = DynamicMapper(SPEC, 50_000)
    assert len(mapper.objects()) == 0
    numbers = []
    for k in range(25):
        grid, _, _ = street(k)
        mapper.update(grid, np.eye(4), stamp=PERIOD * k)
        objects = mapper.objects().confirmed
        numbers += [set(objects.boxes.track)] if k >= 8 else []
    assert len(numbers[0]) == 1
    assert numbers == [numbers[0]] * len(numbers)
    np.testing.assert_allclose(objects.velocity, [(SPEED, 0)], atol=0.3)
    np.testing.assert_allclose(objects.boxes.center[0, :2], (-6 + SPEED * PERIOD * 24, 1), atol=0.4)
    later, (_, moving, standing) = mapper.predicted(0.5), street(29)
    assert later.dynamic[moving].mean() > 0.6
    assert later.static[standing].mean() > 0.85
    left = street(24)[1] & ~moving
    assert later.occupied[left].mean() < 0.3
    same = predict_dynamic(mapper.dynamic_grid, mapper._particles, 0.5, mapper.objects())
    for name in ("mass", "velocity", "covariance"):
        np.testing.assert_array_equal(getattr(later, name), getattr(same, name))
        np.testing.assert_array_equal(getattr(mapper.predicted(0), name), getattr(mapper.dynamic_grid, name))
    refused("seconds must be 0 or more", mapper.predicted, -0.1)
    mapper.reset()
    assert len(mapper.objects()) == 0


def test_a_measured_velocity_is_evidence_of_motion_or_of_rest():
    """Odds by the ratio of likelihoods: of a velocity many deviations from 0 the greatest; near 0 that of rest."""
    label = np.kron(np.arange(1, 5), np.ones((SPEC.shape[0] // 4, SPEC.shape[1]), np.int32).T).T.astype(np.int32)
    velocity, resting = np.array([[3.0, 0.0], [0.1, 0.0], [0.1, 0.0], [3.0, 0.0]]), np.array([False, False, True, True])
    information = np.repeat(np.eye(2)[None] / 0.3**2, 4, axis=0)
    slot = group_velocities(label, velocity, information, resting, 6.0, 0.95, 100.0)
    factors = slot.rows[1:, 10]
    np.testing.assert_allclose(factors, [100, 1, 0.01, 100], rtol=1e-5)
    maps = [DynamicMapper(SPEC, 20_000, matching=False) for _ in range(2)]
    maps[1]._measured_velocities = lambda scan, states, cells: slot
    mass = np.full((*SPEC.shape, 2), (0.0, 0.6), np.float32)
    for mapper in maps:
        mapper.update(EvidentialGrid(SPEC, mass), np.eye(4), stamp=0.0)
    plain, weighed = (mapper.dynamic_grid for mapper in maps)
    np.testing.assert_allclose(weighed.occupied, plain.occupied, atol=1e-6)
    odds = plain.dynamic / plain.static
    np.testing.assert_allclose(weighed.dynamic / weighed.static, factors[label - 1] * odds, rtol=1e-3)


def test_scans_of_one_moment_fill_cells_whose_static_belief_has_all_but_vanished():
    """Nothing appears within no time: all of occupied goes to what little there was, however little."""
    spec = GridSpec(0.5, (40, 25), (0.0, 0.0))
    mass = {name: np.zeros((40, 25, 2), np.float32) for name in ("free", "occupied")}
    mass["free"][..., 0] = np.linspace(0.3, 0.95, 1000).reshape(40, 25)  # belief vanishes here soon, there late
    mass["occupied"][..., 1] = 0.8
    grids = {name: EvidentialGrid(spec, one) for name, one in mass.items()}
    mapper = DynamicMapper(spec, 1000, window="fixed", matching=False)
    mapper.update(grids["occupied"], np.eye(4), stamp=0.0)
    for k in range(1, 36):
        mapper.update(grids["free"], np.eye(4), stamp=0.1 * k)
        if k == 35:
            mapper.update(grids["occupied"], np.eye(4), stamp=0.1 * k)
        found = mapper.dynamic_grid.mass
        assert np.isfinite(found).all()
        assert found.min() >= 0
        assert found.sum(axis=-1).max() <= 1 + 1e-5


@given(
    hypothesis_arrays(np.float32, 12, elements=st.floats(0, np.float32(np.inf), width=32)),
    st.floats(1e-30, 1.0),
    st.floats(0, 0.99),
)
def test_particles_never_exceed_the_space_for_them(masses, mass, offset):
    survivors, start = np.zeros(6, np.int32), np.zeros(7, np.int32)
    share_particles((masses[:6], masses[6:]), mass, offset, 50, survivors, start)
    assert start[0] == 0
    assert (np.diff(start) >= survivors).all()
    assert (survivors >= 0).all()
    assert start[-1] <= 50


# What the border of the measurement grid cuts.


def seen_on_the_way(k: int, speed: float, turn: float, *oncoming: float) -> tuple[EvidentialGrid, np.ndarray]:
    """Scan k between two long walls and beside parked cars, and where it was; cars come towards it from a place [m]."""
    yaw = turn * PERIOD * k
    T = pose(speed * PERIOD * k, 0.0, 0.0, yaw=yaw)
    x, y = centres(SPEC)
    X, Y = T[0, 0] * x + T[0, 1] * y + T[0, 3], T[1, 0] * x + T[1, 1] * y + T[1, 3]
    occupied = (abs(abs(Y) - 8) < 0.25) | ((abs(Y + 5) < 0.9) & (X % 6 < 4.2))
    for place in oncoming:
        occupied |= (abs(X - place + SPEED * PERIOD * k) < 2) & (abs(Y - 3) < 0.9)
    mass = np.where(occupied[..., None], (0.05, 0.8), (0.6, 0.02)).astype(np.float32)
    return EvidentialGrid(SPEC, mass), T


@each("turn", [0.0, 0.1])
def test_what_the_border_cuts_does_not_move(turn):
    mapper = DynamicMapper(rolling_window(SPEC), 50_000)
    tracked = 0
    for k in range(30):
        grid, T = seen_on_the_way(k, 10.0, turn)
        mapper.update(grid, T, stamp=PERIOD * k)
        tracked += len(mapper.objects().confirmed.boxes.center)
    assert tracked == 0
    grid = mapper.dynamic_grid
    assert not (grid.dynamic > grid.static).any()


def test_a_car_that_comes_over_the_border_is_tracked():
    mapper = DynamicMapper(rolling_window(SPEC), 50_000)
    for k in range(16):  # its front is at the border in the second scan, its rear in the sixth
        grid, T = seen_on_the_way(k, 4.0, 0.0, 16.0)
        mapper.update(grid, T, stamp=PERIOD * k)
        confirmed = mapper.objects().confirmed
    (center,), (velocity,) = confirmed.boxes.center, confirmed.velocity
    assert np.hypot(*(center[:2] - [16.0 - SPEED * PERIOD * k, 3.0])) < 1.0
    assert np.hypot(*(velocity - [-SPEED, 0.0])) < 1.0
