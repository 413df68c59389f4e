"""Every kernel against its slow twin."""

import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ogm import GridSpec
from ogm.geometric import HeightBandISM, RayISM, flat_ground, ground_height, twins
from ogm.geometric.core import lines, polar, surface

SPEC = GridSpec.centered(16.0, 12.0, 0.5)
HEIGHT = 1.7


def cloud(seed: int, count: int = 300, height: float = HEIGHT) -> np.ndarray:
    """Points of a toy scene around a sensor: ground, obstacles, crowns, strays."""
    rng = np.random.default_rng(seed)
    azimuth, run = rng.uniform(0, 2 * math.pi, count), rng.uniform(1.0, 14, count)
    z = rng.choice([0, 0, 0, 0.6, 1.5, 3.0, -2.0], count) + rng.normal(0, 0.02, count) - height
    return np.stack([run * np.cos(azimuth), run * np.sin(azimuth), z, rng.uniform(0, 1, count)], 1).astype(
        np.float32
    )


@given(st.integers(-40, 40), st.integers(-40, 40))
@settings(max_examples=200, deadline=None)
def test_the_kernel_draws_bresenhams_line(di: int, dj: int) -> None:
    state = np.zeros((96, 96), np.uint8)
    lines.draw_lines(state, np.array([[48 + di, 48 + dj]], np.int32), 48, 48)
    drawn = set(zip(*np.nonzero(state), strict=True))
    assert drawn == set(twins.line_cells((48, 48), (48 + di, 48 + dj))) - {(48 + di, 48 + dj)}


@pytest.mark.parametrize("seed", range(8))
def test_height_band_equals_one_line_per_return(seed: int) -> None:
    points = cloud(seed)
    ism = HeightBandISM(SPEC, sensor_height=HEIGHT, evidence=3.0, min_range=1.0)
    slow = twins.height_band_mass(points[:, :3], (0, 0, 0), 0.5 - HEIGHT, 2.0 - HEIGHT, 1.0, SPEC, 3.0)
    np.testing.assert_array_equal(ism(points).mass, slow)
    assert slow[..., 0].any()
    assert slow[..., 1].any()


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("position", [(0.0, 0.0), (2.3, -1.1)])
@pytest.mark.parametrize("height", [1.7, 3.0, 5.0])
def test_ray_model_equals_the_loop_over_cells_and_rays(
    seed: int, position: tuple[float, float], height: float
) -> None:
    points = cloud(seed, height=height)
    rng = np.random.default_rng(seed + 100)
    missing = rng.normal(0, [1, 1, 0.05], (40, 3))
    missing = (missing / np.linalg.norm(missing, axis=1, keepdims=True)).astype(np.float32)
    T = np.eye(4)
    T[:2, 3] = position
    ism = RayISM(SPEC, height, T_vehicle_sensor=T, ground=flat_ground, azimuth_step=2 * math.pi / 64)
    x, y = position
    box = (x - 2.5, x + 2.5, y - 1.1, y + 1.1)
    xyz = points[:, :3].astype(np.float64) + [x, y, 0]
    own = (xyz[:, 0] > box[0]) & (xyz[:, 0] < box[1]) & (xyz[:, 1] > box[2]) & (xyz[:, 1] < box[3])
    slow = twins.ray_grid_mass(
        xyz[~own],
        (x, y, 0.0),
        -height,
        SPEC,
        box,
        64,
        missing,
        **{
            name: getattr(ism, name)
            for name in (
                "obstacle_height",
                "clearance",
                "below_ground",
                "range_noise",
                "p_miss",
                "p_false_alarm",
                "free_reliability_at_hits",
                "max_mass",
                "max_range",
                "no_return_weight",
            )
        },
    )
    fast = ism(points, missing).mass
    # A ray within rounding of a sector's or a bin's edge may be filed on the other side: few cells, not none.
    differ = np.abs(fast - slow).max(-1) > 2e-4
    assert differ.mean() < 0.01
    assert np.abs(fast - slow).mean() < 1e-3
    assert (slow[..., 0] > 0.1).mean() > 0.1
    assert (slow[..., 1] > 0.5).mean() > 0.02


def test_level_say_is_the_ground_along_each_sector() -> None:
    """On a map that is another one when its axes are swapped, at every bin of every row."""
    coarse = GridSpec(1.0, (16, 12), (-8.0, -6.0))
    cx, cy = coarse.cell_centers
    height = (-1.7 + 0.05 * cx + 0.002 * cx * cy - 0.1 * cy).astype(np.float32)
    origin, level = np.float32([1.0, -0.5, 0.3]), np.empty((32, 20), np.float32)
    polar.level_ray_weight(height, *coarse.origin, 1.0, origin, 2.0, 0.25, level)
    angle, run = (np.arange(32) + 0.5) * 2 * math.pi / 32, (np.arange(20) + 0.5) * 0.25
    x, y = origin[0] + np.outer(np.cos(angle), run), origin[1] + np.outer(np.sin(angle), run)
    at = np.stack([x.ravel(), y.ravel()], 1).astype(np.float32)
    ground = ground_height(height, coarse, at).reshape(level.shape)
    np.testing.assert_allclose(level, 1 - (origin[2] - ground) / 2.0, atol=5e-3)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_lower_envelope_is_the_least_cone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    height = rng.uniform(-1, 5, (9, 7)).astype(np.float32)
    height[rng.random(height.shape) < 0.5] = np.inf
    fast = height.copy()
    surface.lower_envelope(fast, np.float32(0.25))
    np.testing.assert_allclose(fast, twins.lower_envelope(height, 0.25), rtol=1e-5, atol=1e-6)


@given(st.floats(-100, 100, width=32), st.floats(-100, 100, width=32))
@settings(max_examples=300, deadline=None)
def test_azimuth_polynomial(x: float, y: float) -> None:
    if max(abs(x), abs(y)) < 1e-6:
        return
    got = float(polar.azimuth(np.float32(x), np.float32(y)))
    assert abs((got - math.atan2(y, x) + math.pi) % (2 * math.pi) - math.pi) < 2e-6


def test_without_the_jit_the_kernels_say_the_same(tmp_path: Path) -> None:
    """The same scan through the kernels as plain Python, in another process."""
    script = """
import sys, numpy as np
from ogm import GridSpec
from ogm.geometric import HeightBandISM, RayISM
from tests.geometric.test_twins import cloud
spec, points = GridSpec.centered(10.0, 8.0, 0.5), cloud(3, 150)
up = np.array([[0.6, 0.0, 0.8], [0.99, 0.1, -0.1]], np.float32)
np.savez(sys.argv[1], a=HeightBandISM(spec, 1.7)(points).mass, b=RayISM(spec, 1.7)(points, up).mass,
         c=HeightBandISM.as_released(spec)(points).mass)
"""
    root = Path(__file__).parents[2]
    results = []
    for switch in ("0", "1"):
        path = tmp_path / f"{switch}.npz"
        run = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", script, path],
            env={**os.environ, "NUMBA_DISABLE_JIT": switch},
            cwd=root,
            capture_output=True,
            text=True,
            check=False,
        )
        assert run.returncode == 0, run.stderr
        results.append(dict(np.load(path)))
    for name in "abc":
        assert results[0][name].any()
        np.testing.assert_allclose(results[0][name], results[1][name], atol=2e-3)
