"""Heights of one scan: closed-form planes, steps, walls and bars, kernels next to numpy, and where a vehicle drives."""

import numpy as np
import pytest
from cases import each, refused
from geometric_reference import terrain

from ogm import EvidentialGrid, GridSpec, LayeredGrid, Mount
from ogm.geometric import RayISM, VehicleLimits, height_layers, traversability
from ogm.geometric.ray import RayTrace
from ogm.state import CellState, predict_state

pytestmark = pytest.mark.xdist_group("heights")  # the kernels are compiled once

SPEC, HEIGHT = GridSpec.centered(24.0, 16.0, 0.16 * 1.25), 1.8
ISM = RayISM(SPEC, Mount(HEIGHT, ego_footprint=(-1, 1, -1, 1)))
X, Y = (np.broadcast_to(axis, SPEC.shape) for axis in SPEC.cell_centers)
NEAR = (np.hypot(X, Y) > 2) & (np.abs(X) < 9) & (np.abs(Y) < 6)


def ground(height: object, noise: float = 0.0, seed: int = 0) -> np.ndarray:
    """Return returns of a surface ``height(x, y)`` above the road under the sensor, 400 in a square metre, (N, 3)."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform((-12, -8), (12, 8), (150_000, 2))
    z = height(*xy.T) + rng.normal(0, noise, len(xy)) if noise else height(*xy.T)
    return np.column_stack([xy, z - HEIGHT]).astype(np.float32)


def trace(*parts: np.ndarray) -> RayTrace:
    return ISM.trace(np.concatenate(parts))


@each("rise, heading", [(0.0, 0.0), (0.1, 0.0), (0.14, 2.5), (-0.1, 1.0)])
def test_a_plane_has_its_height_and_its_slope_and_no_steps(rise: float, heading: float) -> None:
    def plane(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return rise * (x * np.cos(heading) + y * np.sin(heading))

    layers = height_layers(trace(ground(plane)))
    error = layers["ground_height"] - (plane(X, Y) - HEIGHT)
    assert np.abs(error[NEAR]).max() < 0.005
    np.testing.assert_allclose(layers["slope"][NEAR], np.arctan(abs(rise)), atol=0.005)
    for name in ("step", "roughness", "highest_obstacle"):
        assert layers[name][NEAR].max() < 0.005, name
    assert np.isnan(layers["clearance"][NEAR]).all()


@each("step, rise", [(0.1, 0.0), (0.15, 0.1), (0.3, 0.0), (-0.15, 0.0)])
def test_a_step_is_found_where_it_is_and_as_high_as_it_is(step: float, rise: float) -> None:
    layers = height_layers(trace(ground(lambda x, y: rise * x + np.where(y > 3, step, 0))))
    beside = (np.abs(X) < 8) & (np.abs(Y - 3) < 0.15)
    away = (np.abs(X) < 8) & (np.abs(Y - 3) > 1) & NEAR
    assert np.median(layers["step"][beside]) == pytest.approx(abs(step), abs=0.03)
    assert (layers["step"][beside] > 0.7 * abs(step)).mean() > 0.9
    assert np.quantile(layers["step"][away], 0.95) < 0.04
    on_it = (np.abs(X) < 8) & (Y > 4) & (Y < 6)
    assert np.abs(layers["ground_height"][on_it] - rise * X[on_it] - step + HEIGHT).mean() < 0.02


def box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float], count: int = 4000) -> np.ndarray:
    """Return returns within a box with heights above the road [m], (N, 3)."""
    xyz = np.random.default_rng(1).uniform(*np.transpose([x, y, z]), (count, 3))
    return (xyz - [0, 0, HEIGHT]).astype(np.float32)


def within(x: tuple[float, float], y: tuple[float, float]) -> np.ndarray:
    return (x[0] < X) & (x[1] > X) & (y[0] < Y) & (y[1] > Y)


def test_what_stands_and_what_hangs_have_their_heights() -> None:
    at = (6.01, 6.19)
    wall, bar = box(at, (-3, -1), (0, 1)), box(at, (1, 3), (1.2, 1.4))
    bridge = box((-6, -5), (-3, 3), (4.0, 4.1), 20_000)
    layers = height_layers(trace(ground(lambda x, y: 0 * x), wall, bar, bridge))
    of_wall, of_bar, under = within(at, (-2.8, -1.2)), within(at, (1.2, 2.8)), within((-5.8, -5.2), (-2.8, 2.8))
    np.testing.assert_allclose(layers["highest_obstacle"][of_wall], 1.0, atol=0.05)
    assert (layers["step"][of_wall] > 0.9).all()
    np.testing.assert_allclose(layers["clearance"][of_bar], 1.2, atol=0.03)
    assert np.median(layers["step"][of_bar]) < 0.05  # it hangs
    np.testing.assert_allclose(layers["clearance"][under], 4.0, atol=0.03)
    assert (layers["highest_obstacle"][under] == 0).all()
    assert np.abs(layers["ground_height"][of_wall | of_bar | under] + HEIGHT).max() < 0.02


def test_variance_covers_the_error_and_far_ground_is_unknown() -> None:
    wavy = ground(lambda x, y: 0.1 * np.sin(x) + 0.05 * y, noise=0.02)
    sparse = wavy[(np.floor(wavy[:, 0] * 2) % 3 == 0) & (wavy[:, 0] < 4)]  # strips 1 m apart
    layers = height_layers(trace(sparse))
    error = layers["ground_height"] - (0.1 * np.sin(X) + 0.05 * Y - HEIGHT)
    seen = NEAR & (X < 3.5)
    assert (error[seen] ** 2 < 9 * layers["ground_variance"][seen]).mean() > 0.95
    strip = np.floor(X * 2) % 3 == 0
    between, on = (np.nanmean(layers["ground_variance"][seen & cells]) for cells in (~strip, strip))
    assert between > 2 * on
    for name in ("ground_height", "ground_variance", "slope", "step", "roughness", "highest_obstacle"):
        assert np.isnan(layers[name][X > 8]).all()


def test_the_kernels_give_what_numpy_gives() -> None:
    rng = np.random.default_rng(2)
    points = ground(lambda x, y: 0.1 * x + np.where(y > 3, 0.15, 0) + np.where(x > 4, -0.3, 0), noise=0.02)
    parts = (
        points[rng.random(len(points)) < 0.1],
        box((1.5, 4), (-3, -1), (0.9, 1.1)),
        box((2, 3), (2, 4), (0.2, 2)),
        box((-5, -3), (-3, 3), (1, 4), 2000),
    )
    spec = GridSpec.centered(12.8, 9.6, 0.2)
    found = RayISM(spec, ISM.mount).trace(np.concatenate(parts))
    layers, wanted = height_layers(found), terrain(found)
    for name, values in wanted.items():
        np.testing.assert_allclose(layers[name], values, atol=2e-3, err_msg=name)


def test_the_roof_of_a_car_that_hides_the_ground_is_no_ground() -> None:
    road, roof = ground(lambda x, y: 0.02 * x), box((3, 7), (-1, 1), (0.5, 0.6), 20_000)
    hidden = (road[:, 0] > 0.5) & (road[:, 0] < 9.5) & (np.abs(road[:, 1]) < 3.5)
    found = trace(road[~hidden], roof)
    layers, on_roof = height_layers(found), within((3.5, 6.5), (-0.5, 0.5))
    assert np.median(found.work.above[: len(found.points.x)][-len(roof) :]) < 0.1  # RayISM takes it for ground
    assert np.isnan(layers["ground_height"][on_roof]).all()
    assert np.isnan(traversability(layers, found.grid)[on_roof]).all()
    assert np.nanmax(np.abs(layers["ground_height"] - (0.02 * X - HEIGHT))[NEAR]) < 0.1


def test_ground_beyond_a_drop_is_unknown() -> None:
    layers = height_layers(trace(ground(lambda x, y: np.where(x > 5, -3.0, 0))))
    assert np.isnan(layers["ground_height"][X > 6]).all()
    assert np.abs(layers["ground_height"][NEAR & (X < 4.5)] + HEIGHT).max() < 0.01


def test_traversability_agrees_with_the_masses() -> None:
    wall = box((6.01, 6.19), (-3, -1), (0, 1.8))
    found = trace(ground(lambda x, y: np.where(y > 3, 0.3 * (y - 3), 0.0)), wall)
    layers, state = height_layers(found), predict_state(found.grid.mass)
    value = traversability(layers, found.grid)
    assert (value[state == CellState.OCCUPIED] == 0).all()
    assert np.isnan(value[state == CellState.UNKNOWN]).all()
    assert np.nanmedian(value[NEAR & (Y < 2) & (state == CellState.FREE)]) > 0.8
    bank = (Y > 3.6) & (Y < 6) & (np.abs(X) < 6) & (state == CellState.FREE)
    assert (traversability(layers, found.grid, VehicleLimits(max_slope=0.2))[bank] == 0).all()
    free = EvidentialGrid(SPEC, np.full((*SPEC.shape, 2), (0.9, 0.05), np.float32))
    bar = LayeredGrid(SPEC, {"slope": 0 * X, "step": np.full(SPEC.shape, np.nan), "clearance": np.where(X > 0, 1.5, 3)})
    low, high = (traversability(bar, free, VehicleLimits(height=height)) for height in (2.0, 1.2))
    assert (low == np.where(X > 0, 0, 1)).all()
    assert (high == 1).all()


def test_wrong_limits_and_cells_are_refused() -> None:
    for name, value in (("max_slope", 0.0), ("max_step", -1.0), ("height", np.inf)):
        refused(f"{name} must lie between", VehicleLimits, **{name: value})
    layers = LayeredGrid(SPEC, {})
    refused("must have the same cells", traversability, layers, EvidentialGrid.vacuous(GridSpec.centered(8, 8, 0.5)))
