"""Dynamic grids at a later time."""

import math
from dataclasses import replace

import numpy as np
import pytest
from cases import each, refused
from dynamic_scenes import SPEC, Block, scene
from hypothesis import given, settings
from hypothesis import strategies as st

from ogm.dynamic_grid import DynamicGrid
from ogm.fusion.dynamic import prediction
from ogm.fusion.dynamic.objects import Objects, find_objects
from ogm.fusion.dynamic.particles import Particles
from ogm.fusion.dynamic.prediction import PredictionSettings, predict_dynamic
from ogm.grid import GridSpec

CERTAIN = PredictionSettings(acceleration=0.0, uncertainty=0.0, moved_static=0.0)


def drawn(grid: DynamicGrid, count: int = 20_000, seed: int = 0) -> Particles:
    """Return particles of a grid: more where there is more dynamic mass, with the velocities of their cells."""
    rng = np.random.default_rng(seed)
    mass = grid.dynamic.ravel().astype(float)
    total = mass.sum()
    cell = np.sort(rng.choice(mass.size, count, p=mass / total)) if total else np.empty(0, int)
    i, j = np.unravel_index(cell, grid.spec.shape)
    x, y = (np.stack([i, j]) + rng.random((2, len(cell)))) * grid.spec.resolution * (1 - 1e-6)
    root = np.linalg.cholesky(grid.covariance[i, j].astype(float))
    v = grid.velocity[i, j] + np.einsum("kab,kb->ka", root, rng.normal(size=(len(cell), 2)))
    start = np.searchsorted(cell, np.arange(mass.size + 1)).astype(np.int32)
    return Particles(*(np.ascontiguousarray(c, np.float32) for c in (x, y, v[:, 0], v[:, 1])), start)


def turned(grid: DynamicGrid, *rates: float) -> Objects:
    """Return the objects of a grid with turn rates."""
    return replace(find_objects(grid), turn_rate=np.array(rates))


def random_grid(seed: int, shape: tuple[int, int] = (30, 20)) -> DynamicGrid:
    rng = np.random.default_rng(seed)
    mass = rng.dirichlet([0.5, 0.5, 0.5, 0.5], shape)[..., :3].astype(np.float32)
    mass[..., 2] *= rng.random(shape) < 0.5
    some = mass[..., 2] > 0
    velocity = np.where(some[..., None], rng.normal([3, 0], 2, (*shape, 2)), np.nan)
    covariance = np.where(some[..., None, None], np.eye(2) * rng.uniform(0.01, 1, (*shape, 1, 1)), np.nan)
    return DynamicGrid(GridSpec(0.25, shape, (7.0, -2.0)), mass, velocity, covariance)


def slow_prediction(
    grid: DynamicGrid, p: Particles, seconds: float, objects: Objects, chosen: PredictionSettings
) -> DynamicGrid:
    """Move particle after particle, with complex numbers: the slow reference."""
    nx, ny = grid.spec.shape
    res, q = grid.spec.resolution, chosen.acceleration
    moments = np.zeros((nx, ny, 6))
    cell = np.repeat(np.arange(nx * ny), np.diff(p.start))
    for k in range(len(p.x)):
        i, j = divmod(int(cell[k]), ny)
        n = prediction._normals()[k % 4096].astype(float)
        here, v, b, turn = complex(p.x[k], p.y[k]), complex(p.vx[k], p.vy[k]), objects.label[i, j] - 1, 0.0
        m, center = float(grid.dynamic[i, j]), here
        if b >= 0:
            m += chosen.moved_static * float(grid.static[i, j])
            values, vectors = np.linalg.eigh(objects.covariance[b])
            error = chosen.uncertainty * (vectors * np.sqrt(values)) @ vectors.T @ n[:2]
            mean, turn = complex(*objects.velocity[b]), objects.turn_rate[b] * seconds
            v = mean + (1 - chosen.rigidity) * (v - mean) + complex(*error)
            center = complex(*(objects.boxes.center[b, :2] - grid.spec.origin))
        spin = np.exp(1j * turn)
        chord = v * seconds if turn == 0 else v * seconds * (spin - 1) / (1j * turn)
        there = center + spin * (here - center) + chord + q * math.sqrt(seconds**3 / 3) * complex(*n[2:])
        w = spin * v + q * math.sqrt(0.75 * seconds) * complex(*n[2:])
        i2, j2 = math.floor(there.real / res), math.floor(there.imag / res)
        if 0 <= i2 < nx and 0 <= j2 < ny:
            x, y = w.real, w.imag
            moments[i2, j2] += m / (p.start[cell[k] + 1] - p.start[cell[k]]) * np.array([1, x, y, x * x, x * y, y * y])
    static = grid.static * np.where(objects.label > 0, 1 - chosen.moved_static, 1)
    dynamic = np.minimum(moments[..., 0], 1 - static)
    room = np.minimum((1 - dynamic) / np.maximum(1 - grid.dynamic, 1e-6), 1)
    free = np.minimum(grid.free * 0.5 ** (seconds / chosen.free_half_life) * room, 1 - static - dynamic)
    with np.errstate(invalid="ignore"):
        mean = moments[..., 1:] / moments[..., :1]
    velocity, (xx, xy, yy) = mean[..., :2], np.moveaxis(mean[..., 2:], -1, 0)
    square = np.stack([xx, xy, xy, yy], axis=-1).reshape(nx, ny, 2, 2) - velocity[..., None] * velocity[..., None, :]
    covariance = square + q**2 * seconds / 4 * np.eye(2)
    return DynamicGrid(grid.spec, np.stack([free, static, dynamic], axis=-1), velocity, covariance)


@given(
    st.integers(0, 2**32),
    st.floats(0.05, 2.0),
    st.sampled_from([CERTAIN, PredictionSettings(), PredictionSettings(2.0, 2.0, 0.4, 0.5, 0.6)]),
)
@settings(max_examples=6, deadline=None)
def test_the_kernel_is_the_slow_reference(seed: int, seconds: float, chosen: PredictionSettings) -> None:
    grid = random_grid(seed, (12, 10))
    found = find_objects(grid)
    found = replace(found, turn_rate=np.random.default_rng(seed).uniform(-1, 1, len(found)))
    p = drawn(grid, 400, seed)
    one, other = predict_dynamic(grid, p, seconds, found, chosen), slow_prediction(grid, p, seconds, found, chosen)
    # Rounding may take a particle to the next cell: one or two in a run.
    alike = np.isclose(one.dynamic, other.dynamic, atol=1e-4)
    assert (~alike).sum() <= 4
    np.testing.assert_allclose(one.mass[alike], other.mass[alike], atol=2e-4)
    alike &= one.dynamic > 0.01
    np.testing.assert_allclose(one.velocity[alike], other.velocity[alike], atol=2e-3)
    np.testing.assert_allclose(one.covariance[alike], other.covariance[alike], atol=2e-2)


def test_no_time_is_no_change() -> None:
    grid = random_grid(1)
    assert predict_dynamic(grid, None, 0.0) is grid
    p = drawn(grid)
    held = np.diff(p.start).reshape(grid.spec.shape) > 0
    soon = predict_dynamic(grid, p, 1e-6)
    alike = held | (grid.dynamic == 0)
    np.testing.assert_allclose(soon.mass[alike], grid.mass[alike], atol=1e-3)


@given(st.integers(0, 2**32), st.floats(0, 3.0), st.booleans(), st.floats(0, 1))
@settings(max_examples=25, deadline=None)
def test_predictions_are_masses_and_unknown_shrinks_only_where_something_arrives(
    seed: int, seconds: float, cells_alone: bool, moved_static: float
) -> None:
    grid = random_grid(seed)
    chosen = PredictionSettings(moved_static=moved_static)
    later = predict_dynamic(grid, None if cells_alone else drawn(grid, 3000, seed), seconds, None, chosen)
    checked = DynamicGrid(later.spec, later.mass, later.velocity, later.covariance)  # raises unless masses
    np.testing.assert_array_equal(np.isnan(checked.speed), checked.dynamic == 0)
    some = checked.dynamic > 0
    assert (np.linalg.eigvalsh(checked.covariance[some].astype(float)) > -1e-3).all()
    assert (checked.unknown >= grid.unknown - checked.dynamic - 1e-6).all()
    gone = checked.dynamic <= 1e-3
    assert (checked.unknown[gone] >= grid.unknown[gone] - 2e-3).all()
    if moved_static == 0:
        np.testing.assert_array_equal(checked.static, grid.static)


@each("seconds", [0.3, 1.0, 2.0])
@each("block", [Block(-8, 0, 5, 0), Block(0, -3, -2, 3), Block(-8, -3, 6, 0, turn=0.5), Block(5, 3, -5, -1, turn=-0.7)])
def test_a_block_is_predicted_onto_its_later_cells(block: Block, seconds: float) -> None:
    grid = scene(block)
    target = block.at(seconds)
    truth = target.cells(SPEC)
    # Its velocities vary by turn rate x half a length; what is joined is not in question here.
    found = turned(grid, block.turn)
    for particles in (drawn(grid, 50_000), None):
        predicted = predict_dynamic(grid, particles, seconds, found, CERTAIN)
        wrong = (predicted.dynamic > 0.4) != truth
        # Only cells that the outline crosses may differ, and some where cells are turned against cells.
        assert not (wrong & ~(target.cells(SPEC, 0.3) & ~target.cells(SPEC, -0.3))).any()
        assert wrong.sum() < 0.25 * truth.sum()
        assert predicted.dynamic.sum() == pytest.approx(grid.dynamic.sum(), rel=0.02)
        inside = predicted.dynamic > 0.4
        np.testing.assert_allclose(np.average(predicted.velocity[inside], axis=0), [target.vx, target.vy], atol=0.15)


def test_loose_particles_move_each_by_its_own_velocity() -> None:
    block = Block(-5, 0, 5, 0)
    grid = scene(block, variance=0.5)
    rigid = predict_dynamic(grid, drawn(grid), 1.0, None, CERTAIN)
    loose = predict_dynamic(grid, drawn(grid), 1.0, None, CERTAIN._replace(rigidity=0.0))
    none = predict_dynamic(grid, drawn(grid), 1.0, find_objects(scene()), CERTAIN)
    np.testing.assert_allclose(loose.mass, none.mass, atol=1e-6)
    assert _spread(rigid) < _spread(loose)
    assert _spread(loose) == pytest.approx(_spread(grid) + 2 * 0.5, rel=0.1)


def _middle(grid: DynamicGrid) -> np.ndarray:
    return np.array([np.average(k, weights=grid.dynamic) for k in np.indices(grid.spec.shape)]) * grid.spec.resolution


def _spread(grid: DynamicGrid) -> float:
    """Return the sum of the variances of the place of dynamic mass [m²]."""
    cells = np.indices(grid.spec.shape) * grid.spec.resolution - _middle(grid)[:, None, None]
    return float(np.average((cells**2).sum(axis=0), weights=grid.dynamic))


def test_uncertainty_grows_with_the_horizon_as_the_model_states() -> None:
    grid = scene(Block(-10, 0, 4, 0))
    found = replace(find_objects(grid), covariance=np.array([[[0.3, 0.1], [0.1, 0.2]]]))
    chosen = PredictionSettings(acceleration=0.8, uncertainty=1.5, moved_static=0.0)
    for seconds in (0.5, 1.0, 2.0):
        later = predict_dynamic(grid, drawn(grid, 50_000), seconds, found, chosen)
        grown = 1.5**2 * 0.5 * seconds**2 + 2 * 0.8**2 * seconds**3 / 3
        assert _spread(later) - _spread(grid) == pytest.approx(grown, rel=0.1)
        expected = 1.5**2 * found.covariance[0] + 0.8**2 * seconds * np.eye(2)
        some = later.dynamic > 0
        mean = np.average(later.velocity[some], axis=0, weights=later.dynamic[some])
        away = later.velocity[some] - mean
        total = later.covariance[some] + away[:, :, None] * away[:, None, :]
        np.testing.assert_allclose(np.average(total, axis=0, weights=later.dynamic[some]), expected, atol=0.05)


def test_two_steps_are_one_in_the_mean() -> None:
    block = Block(-8, 0, 4, 1, turn=0.4)
    grid = scene(block)
    once = predict_dynamic(grid, None, 1.4, turned(grid, 0.4), CERTAIN)
    half = predict_dynamic(grid, None, 0.6, turned(grid, 0.4), CERTAIN)
    twice = predict_dynamic(half, None, 0.8, turned(half, 0.4), CERTAIN)
    np.testing.assert_allclose(_middle(twice), _middle(once), atol=0.1)
    np.testing.assert_allclose(twice.dynamic.sum(), once.dynamic.sum(), rtol=0.03)
    np.testing.assert_array_equal(twice.static, once.static)
    away = (once.dynamic == 0) & (half.dynamic == 0) & (twice.dynamic == 0)
    np.testing.assert_allclose(twice.free[away], once.free[away], atol=1e-6)


def test_free_becomes_unknown_with_time_and_faster_where_something_arrives() -> None:
    grid = scene(Block(-8, 0, 5, 0))
    later = predict_dynamic(grid, None, 1.0, None, CERTAIN._replace(free_half_life=2.0))
    far = (later.dynamic == 0) & (grid.dynamic == 0)
    np.testing.assert_allclose(later.free[far], grid.free[far] * math.sqrt(0.5), rtol=1e-5)
    left = (grid.dynamic > 0) & (later.dynamic == 0)
    assert left.any()
    assert (later.unknown[left] > 0.8).all(), "what was under the object is not known to be free"
    arrived = (later.dynamic > 0.5) & (grid.dynamic == 0)
    assert (later.free[arrived] < 0.3).all()


def test_static_mass_in_an_objects_cells_may_move_with_it() -> None:
    grid = scene(Block(-5, 0, 5, 0))
    later = predict_dynamic(grid, None, 2.0, None, CERTAIN._replace(moved_static=0.75))
    cells = grid.dynamic > 0
    np.testing.assert_allclose(later.static[cells], 0.25 * grid.static[cells], rtol=1e-5)
    np.testing.assert_array_equal(later.static[~cells], grid.static[~cells])
    assert later.dynamic.sum() == pytest.approx(grid.dynamic.sum() + 0.75 * grid.static[cells].sum(), rel=0.02)


def test_what_leaves_the_grid_is_lost_and_nothing_else() -> None:
    grid = scene(Block(16, 0, 10, 0), Block(0, 0, 0, 0.0001))
    later = predict_dynamic(grid, drawn(grid), 1.5, None, CERTAIN)
    left = (grid.dynamic > 0) & (np.arange(SPEC.shape[0]) * SPEC.resolution > 25)[:, None]
    assert later.dynamic.sum() == pytest.approx(grid.dynamic[~left].sum(), rel=0.02)


def test_predictions_are_the_same_from_run_to_run() -> None:
    grid = random_grid(5)
    p = drawn(grid)
    one, other = predict_dynamic(grid, p, 0.7), predict_dynamic(grid, p, 0.7)
    np.testing.assert_array_equal(one.mass, other.mass)
    np.testing.assert_array_equal(one.velocity, other.velocity)


def test_the_normals_are_normal() -> None:
    table = prediction._normals().astype(float)
    np.testing.assert_allclose(np.cov(table.T), np.eye(4), atol=0.02)
    np.testing.assert_allclose(table.mean(axis=0), 0, atol=1e-6)
    few = table[100:116]  # those of one cell
    assert np.abs(few.mean(axis=0)).max() < 0.3


def test_an_empty_grid_stays_empty() -> None:
    grid = scene()
    for particles in (None, drawn(grid)):
        later = predict_dynamic(grid, particles, 1.0)
        assert later.dynamic.sum() == 0
        assert np.isnan(later.velocity).all()


def test_impossible_times_and_particles_or_objects_of_other_grids_are_refused() -> None:
    grid, other = random_grid(0), scene(Block(0, 0, 5, 0))
    for seconds in (-0.1, math.nan, math.inf):
        refused("seconds", predict_dynamic, grid, None, seconds)
    refused("particles", predict_dynamic, grid, drawn(other), 1.0)
    refused("objects", predict_dynamic, grid, None, 1.0, find_objects(other))
