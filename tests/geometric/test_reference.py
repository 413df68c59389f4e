"""Every kernel against its slow reference."""

import math
from collections.abc import Callable

import geometric_reference as reference
import numpy as np
import pytest
from cases import each
from hypothesis import given, settings
from hypothesis import strategies as st

from ogm import GridSpec, Mount, Scan
from ogm.geometric import HeightBandISM, RayISM, flat_ground, ground_height
from ogm.geometric.ground import surface_of
from ogm.geometric.kernels import lines, polar, surface
from ogm.geometric.kernels.arguments import PolarGrid, RayNumbers, Rays, SectorRays
from ogm.geometric.kernels.breaks import FALL, HOLE, LEVEL, STEP, ground_breaks
from ogm.geometric.kernels.classify import GROUND, NO_RETURN, NONE, OBSTACLE, classify_rays
from ogm.geometric.reference import height_band_mass, line_cells
from ogm.pose import pose

SPEC = GridSpec.centered(16.0, 12.0, 0.5)
HEIGHT = 1.7


def cloud(seed: int, count: int = 300, height: float = HEIGHT) -> np.ndarray:
    """Points of a toy scene around a sensor: ground, obstacles, crowns, strays."""
    rng = np.random.default_rng(seed)
    azimuth, run = rng.uniform(0, 2 * math.pi, count), rng.uniform(1.0, 14, count)
    z = rng.choice([0, 0, 0, 0.6, 1.5, 3.0, -2.0], count) + rng.normal(0, 0.02, count) - height
    return np.stack([run * np.cos(azimuth), run * np.sin(azimuth), z, rng.uniform(0, 1, count)], 1).astype(np.float32)


def flat_cloud(seed: int, height: float, count: int = 300) -> np.ndarray:
    """As `cloud`, over ground without noise and without strays under it: nothing there looks like a step or a hole."""
    points = cloud(seed, count, height)
    points[points[:, 2] < 0.2 - height, 2] = -height
    return points


@given(st.integers(-40, 40), st.integers(-40, 40))
@settings(max_examples=200, deadline=None)
def test_the_kernel_draws_bresenhams_line(di: int, dj: int) -> None:
    state = np.zeros((96, 96), np.uint8)
    lines.draw_lines(state, np.array([[48 + di, 48 + dj]], np.int32), 48, 48)
    drawn = set(zip(*np.nonzero(state), strict=True))
    assert drawn == set(line_cells((48, 48), (48 + di, 48 + dj))) - {(48 + di, 48 + dj)}


@each("seed", range(4))
def test_height_band_equals_one_line_per_return(seed: int) -> None:
    points = cloud(seed)
    ism = HeightBandISM(SPEC, Mount(HEIGHT), evidence=3.0, min_range=1.0)
    slow = height_band_mass(points[:, :3], ism)
    np.testing.assert_array_equal(ism(points).mass, slow)
    assert slow[..., 0].any()
    assert slow[..., 1].any()


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3))])
@pytest.mark.parametrize(
    ("height", "position", "weight", "p_hidden"),
    [(1.7, (0.0, 0.0), 0.25, 0), (1.95, (2.3, -1.1), 1.0, 0.7), (3.0, (0.0, 0.0), 1.0, 0), (5.0, (2.3, -1.1), 0.25, 0)],
)
def test_ray_model_equals_the_loop_over_cells_and_rays(
    seed: int, height: float, position: tuple[float, float], weight: float, p_hidden: float
) -> None:
    points = flat_cloud(seed, height)
    rng = np.random.default_rng(seed + 100)
    no_returns = rng.normal(0, [1, 1, 0.05], (40, 3))
    no_returns = (no_returns / np.linalg.norm(no_returns, axis=1, keepdims=True)).astype(np.float32)
    x, y = position
    mount = Mount(height, pose(x, y))
    gaps = {"p_hidden": p_hidden, "noise_growth": 0.005 * p_hidden}
    ism = RayISM(SPEC, mount, ground=flat_ground, azimuth_step=2 * math.pi / 64, no_return_weight=weight, **gaps)
    x_min, x_max, y_min, y_max = mount.ego_footprint
    assert (x_min, x_max, y_min, y_max) == (x - 2.5, x + 2.5, y - 1.1, y + 1.1)
    xyz = points[:, :3].astype(np.float64) + [x, y, 0]
    ego = (xyz[:, 0] > x_min) & (xyz[:, 0] < x_max) & (xyz[:, 1] > y_min) & (xyz[:, 1] < y_max)
    slow = reference.ray_grid_mass(xyz[~ego], no_returns, -height, ism, sectors=64)
    fast = ism(Scan(points, no_returns=no_returns)).mass
    # A ray within rounding of a sector's or a bin's edge may be filed on the other side: few cells, not none.
    differ = np.abs(fast - slow).max(-1) > 2e-4
    assert differ.mean() < 0.01
    assert np.abs(fast - slow).mean() < 1e-3
    assert (slow[..., 0] > 0.1).mean() > 0.1
    assert (slow[..., 1] > 0.5).mean() > 0.02


@pytest.mark.parametrize(("seed", "reach"), [(0, 4.0), (1, 9.0), (2, 100.0)])
def test_ray_model_equals_the_loop_in_fog(seed: int, reach: float) -> None:
    """The farther a return, the more likely it is lost."""
    points, rng = flat_cloud(seed, HEIGHT, count=900), np.random.default_rng(seed)
    lost = rng.random(len(points)) > np.exp(-((np.hypot(points[:, 0], points[:, 1]) / reach) ** 2))
    up = np.stack([np.cos(angle := np.linspace(0, 6, 90)), np.sin(angle), 0 * angle + 0.02], 1)
    beams = np.concatenate([points[lost, :3], up])
    beams = (beams / np.linalg.norm(beams, axis=1, keepdims=True)).astype(np.float32)
    mount = Mount(HEIGHT, ego_footprint=(0.0, 0.0, 0.0, 0.0))
    ism = RayISM(SPEC, mount, ground=flat_ground, azimuth_step=2 * math.pi / 64, no_return_weight=1.0)
    kept = points[~lost]
    slow = reference.ray_grid_mass(kept[:, :3].astype(np.float64), beams, -HEIGHT, ism, sectors=64)
    fast = ism(Scan(kept, no_returns=beams)).mass
    assert (np.abs(fast - slow).max(-1) > 2e-4).mean() < 0.01
    assert np.abs(fast - slow).mean() < 1e-3
    trust = reference.silence_reliability(kept[:, :3].astype(np.float64), beams, -HEIGHT, ism)
    assert (np.diff(trust) <= 1e-12).all()
    assert trust[0] > 0.8
    assert trust[-1] > 0.8 if reach == 100 else trust[-1] < trust[0] - 0.2
    assert (trust[-1] == 0) or reach > 4  # echoes from beyond the grid count in the last bin


@pytest.mark.parametrize(
    ("height", "p_miss", "range_noise", "seed"),
    [(1.0, 1e-4, 0.03, 0), (1.7, 0.05, 0.03, 1), (2.5, 1e-4, 1.0, 0), (5.0, 1e-4, 0.03, 1)],
)
def test_ray_model_equals_the_loop_where_so_many_rays_pass_that_some_are_not_counted(
    height: float, p_miss: float, range_noise: float, seed: int
) -> None:
    """Also behind obstacles that stop some of them, from where these may be, and with beams without echo among them."""
    points = flat_cloud(seed, height, count=700)
    rng = np.random.default_rng(seed + 100)
    no_returns = rng.normal(0, [1, 1, 0.1], (100, 3))
    no_returns = (no_returns / np.linalg.norm(no_returns, axis=1, keepdims=True)).astype(np.float32)
    mount = Mount(height, ego_footprint=(0.0, 0.0, 0.0, 0.0))
    options = {"azimuth_step": 2 * math.pi / 16, "p_miss": p_miss, "max_mass": 0.9999, "hidden_height": 1.5}
    ism = RayISM(SPEC, mount, ground=flat_ground, range_noise=range_noise, **options)
    slow = reference.ray_grid_mass(points[:, :3].astype(np.float64), no_returns, -height, ism, sectors=16)
    fast = ism(Scan(points, no_returns=no_returns)).mass
    np.testing.assert_allclose(fast, slow, atol=2e-4)
    assert ((slow[..., 0] > 0.1) & (slow[..., 0] < 0.9)).mean() > 0.1


@each("p_miss", [0.8, 0.3])
@pytest.mark.parametrize("heights", [
    [0.0, *[1.0] * 20], [0.3], [1.0] * 5, [0.0, 0.1, 0.25, 0.25, 0.6, 0.9, 1.4], [1.5, 0.05, 1.5, 0.8],
    list(np.linspace(0, 1.6, 30)),
])  # fmt: skip
def test_belief_in_free_is_the_chance_that_an_obstacle_would_have_been_noticed(
    heights: list[float], p_miss: float
) -> None:
    """No formula: obstacles of random heights, whose rays pass them unnoticed or not, each for itself."""
    # A bin far from the sensor, with rays in all sectors alike; `power` is that of one ray in a cell there
    spec, sectors, k, top = GridSpec.centered(40.0, 40.0, 0.5), 64, 16, 1.9
    run, power = (k + 0.5) * spec.resolution, sectors / (math.pi * (2 * k + 1))
    angle = (np.arange(sectors) + 0.5) * 2 * math.pi / sectors
    far = np.array([run * top / (top - h) for h in heights])  # where each ray meets the ground
    points = np.stack(
        [np.outer(far, np.cos(angle)), np.outer(far, np.sin(angle)), np.full((len(far), sectors), -top)], -1
    )
    ism = RayISM(
        spec,
        Mount(top),
        ground=flat_ground,
        azimuth_step=2 * math.pi / sectors,
        p_miss=p_miss ** (1 / power),
        max_mass=0.9999,
    )
    grid = ism(points.reshape(-1, 3).astype(np.float32))
    cx, cy = spec.cell_centers
    free = grid.free[(np.hypot(cx, cy) / spec.resolution).astype(int) == k]
    np.testing.assert_allclose(free, free[0], atol=1e-5)

    rng = np.random.default_rng(11)
    obstacle = rng.uniform(0, ism.clearance, 1_000_000)
    is_unnoticed = np.ones(len(obstacle), bool)
    for height in heights:
        is_unnoticed &= (height >= obstacle) | (rng.random(len(obstacle)) < p_miss)
    assert free[0] == pytest.approx(1 - is_unnoticed.mean(), abs=2e-3)
    if len(heights) == 21 and p_miss == 0.8:
        assert free[0] == pytest.approx(0.595, abs=1e-3)


def test_the_rays_that_meet_ground_and_clearance_follow_the_ground_along_each_sector() -> None:
    """On a map that is another one when its axes are swapped, at every bin of every row."""
    coarse = GridSpec(1.0, (16, 12), (-8.0, -6.0))
    cx, cy = coarse.cell_centers
    height = (-1.7 + 0.05 * cx + 0.002 * cx * cy - 0.1 * cy).astype(np.float32)
    origin = np.float32([1.0, -0.5, 0.3])
    unused = np.zeros((1, 1), np.int16)
    limits = polar.ray_limits(
        surface_of(height, coarse), origin, 2.0, PolarGrid(0.25, 256, 32, 20, unused, unused, unused)
    )
    angle, run = (np.arange(32) + 0.5) * 2 * math.pi / 32, (np.arange(20) + 0.5) * 0.25
    x, y = origin[0] + np.outer(np.cos(angle), run), origin[1] + np.outer(np.sin(angle), run)
    at = np.stack([x.ravel(), y.ravel()], 1).astype(np.float32)
    ground = ground_height(height, coarse, at).reshape(x.shape)
    np.testing.assert_allclose(limits.ground * run, ground - origin[2], atol=0.01)
    np.testing.assert_allclose(limits.clearance * run, ground - origin[2] + 2.0, atol=0.01)
    sampled = slice(None, None, 4)
    np.testing.assert_allclose((limits.ground * run)[:, sampled], (ground - origin[2])[:, sampled], atol=1e-4)


def random_sectors(rng: np.random.Generator) -> list[list[reference.Beam]]:
    """Rays of eight sectors over a random ground: slopes, steps, dips, obstacles; multipath, beams that miss."""
    x = np.arange(0.0207, 60, 0.0201)  # hardly ever on the edge of a bin
    even = rng.choice([0, 0, 0.05, -0.05]) * np.maximum(x - rng.uniform(5, 20), 0)
    for _ in range(rng.integers(0, 4)):
        begin, length = rng.uniform(3, 30), rng.choice([0.3, 3, 40])
        even[(x > begin) & (x < begin + length)] += rng.choice([0.08, 0.12, 0.3, -0.2, -1, -3, 1.5, 2.5])
    slopes, sectors = np.append(-HEIGHT / rng.uniform(1, 50, rng.integers(1, 60)), rng.uniform(0, 0.3, 5)), []
    for _ in range(8):
        surface = even + rng.normal(0, rng.choice([0, 0.01, 0.02]), x.size) - HEIGHT
        if rng.random() < 0.2:
            surface[x > 10] += rng.choice([0.3, -1.0])
        beams = []
        for slope in np.sort(np.repeat(slopes, 2) + rng.normal(0, 1e-4, 2 * len(slopes))).tolist():
            below = np.flatnonzero(slope * x <= surface)
            run = float(x[below[0]]) if below.size else 60.0
            run *= rng.uniform(1.1, 2) if rng.random() < 0.02 else 1.0
            beams.append(reference.Beam(slope, run, slope * run + HEIGHT, bool(below.size)))
        sectors.append(beams)
    return sectors


@pytest.mark.parametrize(("seed", "step"), [(seed, step) for step in (0.16, 1.0) for seed in range(6)])
def test_breaks_and_what_rays_hit_are_those_of_the_reference(seed: int, step: float) -> None:
    """Rounding to float32 may turn a few; few scenes in each part, as these run without the compiler, too."""
    rng, bins, count, kinds = np.random.default_rng(seed), int(48 / step), np.zeros(4, int), np.zeros(7, int)
    numbers = RayNumbers(*(float(getattr(RayISM(SPEC, Mount(HEIGHT)), name)) for name in RayNumbers._fields))
    unused, middle = np.zeros((1, 1), np.int16), ((np.arange(bins) + 0.5) * step).astype(np.float32)
    plane = polar.RayLimits((-HEIGHT / middle)[None], ((2 - HEIGHT) / middle)[None])
    grid, differ, hit_differ = PolarGrid(step, 8, 1, bins, unused, unused, unused), [], []
    for _ in range(15):
        sectors = random_sectors(rng)
        beams = [beam for sector in sectors for beam in sector]
        table = np.array([beam[:3] for beam in beams], np.float32)
        index = np.array([k if beam.is_return else -1 for k, beam in enumerate(beams)], np.int32)
        starts = np.cumsum([0, *map(len, sectors)]).astype(np.int32)
        rays = Rays(*table.T.copy(), index, starts)
        fast = ground_breaks(rays, plane, grid, numbers)
        profiles = reference.profiles_of(sectors, step, numbers.obstacle_height, bins)
        slow, reliability = reference.find_breaks(profiles, -HEIGHT, step, bins, numbers.below_ground)
        for row, found in enumerate(slow):
            broken = np.flatnonzero(fast.kind[row])
            here = {k: (fast.kind[row, k], fast.begin[row, k], fast.end[row, k]) for k in broken}
            same = here == {k: (one.kind, one.begin, one.end) for k, one in found.items()}
            differ.append(not same or (reliability[row] != fast.reliability[row]).any())
            count += np.bincount([one.kind for one in found.values()], minlength=4)
            if not differ[-1]:
                for k, one in found.items():
                    assert fast.limit[row, k] == pytest.approx(one.limit, abs=1e-4)
        for s, sector in enumerate(sectors):
            hits = SectorRays(np.zeros(len(sector), np.int8), *np.zeros((3, len(sector)), np.int32))
            classify_rays(rays, s, plane, grid, fast, numbers, hits)
            expected = reference.classify(sector, slow[s // 2], step, numbers)
            hit_differ.append(hits.kind.tolist() != expected and not differ[-4 + s // 2])
            kinds += np.bincount(expected, minlength=7)
    assert np.mean(differ) < 0.01
    assert np.mean(hit_differ) < 0.01
    assert count.sum() > 0
    assert (kinds[[NONE, GROUND, OBSTACLE, NO_RETURN]] > 0).all(), kinds


def test_the_random_sectors_that_breaks_are_compared_on_hold_every_kind() -> None:
    rng, step, bins, count, kinds = np.random.default_rng(8), 0.16, 300, np.zeros(4, int), np.zeros(7, int)
    numbers = RayNumbers(*(float(getattr(RayISM(SPEC, Mount(HEIGHT)), name)) for name in RayNumbers._fields))
    for _ in range(70):
        sectors = random_sectors(rng)
        profiles = reference.profiles_of(sectors, step, numbers.obstacle_height, bins)
        found, _ = reference.find_breaks(profiles, -HEIGHT, step, bins, numbers.below_ground)
        count += np.bincount([one.kind for some in found for one in some.values()], minlength=4)
        for s, sector in enumerate(sectors):
            kinds += np.bincount(reference.classify(sector, found[s // 2], step, numbers), minlength=7)
    assert (count[[FALL, STEP, HOLE]] > 5).all(), count
    assert (kinds > 20).all(), kinds


def breaks_on(rise: Callable[[np.ndarray], np.ndarray]) -> list[tuple[int, float]]:
    """Kinds and limits of the breaks where the ground rises so much along each sector, under beams 0.1 m apart."""
    step, bins, sectors, x = 0.16, 300, 8, np.arange(0.02, 70, 0.01)
    beams = []
    for slope in -HEIGHT / np.arange(2.0, 40.0, 0.1):
        below = np.flatnonzero(slope * x <= rise(x) - HEIGHT)
        if below.size:
            beams.append((slope, x[below[0]], 0.0))  # the map follows the ground
    table, starts = np.array(beams * sectors, np.float32), np.arange(sectors + 1, dtype=np.int32) * len(beams)
    unused, middle = np.zeros((1, 1), np.int16), ((np.arange(bins) + 0.5) * step).astype(np.float32)
    plane = polar.RayLimits((-HEIGHT / middle)[None], ((2 - HEIGHT) / middle)[None])
    numbers = RayNumbers(*(float(getattr(RayISM(SPEC, Mount(HEIGHT)), name)) for name in RayNumbers._fields))
    grid = PolarGrid(step, sectors, 1, bins, unused, unused, unused)
    rays = Rays(*table.T.copy(), np.arange(len(table), dtype=np.int32), starts)
    found = ground_breaks(rays, plane, grid, numbers)
    assert (found.kind == found.kind[0]).all()
    return [(int(found.kind[0, k]), float(found.limit[0, k])) for k in np.flatnonzero(found.kind[0])]


@each(
    ("rise", "kind", "limit"),
    [
        *[(0.055, LEVEL, 0), (0.065, STEP, math.inf), (0.19, STEP, math.inf), (0.21, STEP, 0.05), (0.49, STEP, 0.05)],
        *[(0.52, LEVEL, 0), (-0.14, LEVEL, 0), (-0.16, FALL, -math.inf), (-0.28, FALL, -math.inf), (-0.4, HOLE, -0.32)],
    ],
)
def test_how_much_the_ground_may_rise_or_fall_at_once(rise: float, kind: int, limit: float) -> None:
    """At 10 m: 6 cm are a step, whose face marks if it has 20 cm; 50 cm are a slope; 15 cm down are a fall."""
    found = breaks_on(lambda x: np.where(x > 10, rise, 0.0))
    assert {one for one, _ in found} == ({kind} if kind else set())
    if found:
        assert found[0][1] == pytest.approx(limit - HEIGHT, abs=0.005)


def test_ramps_and_short_bumps_are_no_steps() -> None:
    for incline in (0.1, 0.2, 0.3):
        assert not breaks_on(lambda x, incline=incline: incline * np.maximum(x - 10, 0))
    for length, is_step in ((1.0, False), (1.5, False), (2.5, True)):
        found = breaks_on(lambda x, length=length: np.where((x > 10) & (x < 10 + length), 0.12, 0.0))
        assert bool(found) == is_step


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_lower_envelope_is_the_least_cone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    height = rng.uniform(-1, 5, (9, 7)).astype(np.float32)
    height[rng.random(height.shape) < 0.5] = np.inf
    fast = height.copy()
    surface.lower_envelope(fast, np.float32(0.25))
    np.testing.assert_allclose(fast, reference.lower_envelope(height, 0.25), rtol=1e-5, atol=1e-6)


@given(st.floats(-100, 100, width=32), st.floats(-100, 100, width=32))
@settings(max_examples=300, deadline=None)
def test_azimuth_polynomial(x: float, y: float) -> None:
    if max(abs(x), abs(y)) < 1e-6:
        return
    got = float(polar.azimuth(np.float32(x), np.float32(y)))
    assert abs((got - math.atan2(y, x) + math.pi) % (2 * math.pi) - math.pi) < 2e-6
