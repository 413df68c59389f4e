"""Why cells are unknown: each cause in a cast scene of its own, and the kernels against loops over cells and beams."""

import math
from dataclasses import replace

import geometric_reference as reference
import numpy as np
import rooms
from cases import each, refused
from numpy.typing import NDArray

from ogm import EvidentialGrid, GridSpec, LayeredGrid, Mount, Scan, UnknownCause
from ogm.geometric import PlanarISM, RadarISM, RayISM, flat_ground
from ogm.geometric.causes import unknown_causes
from ogm.geometric.ground import local_ground
from ogm.models.combined import CombinedISM
from ogm.models.layers import ExplainedISM, map_layers
from ogm.models.named import load_model
from ogm.pose import pose
from ogm.state import predict_state

K = UnknownCause
SPEC, HEIGHT = GridSpec.centered(40.0, 30.0, 0.25), 1.8
MOUNT, OPEN = Mount(HEIGHT), (-200.0, -200.0, 0.0, 200.0, 200.0, 100.0)
AROUND = np.radians(np.arange(-180, 180, 0.3))
WALL, SIGN = (8.0, -2.0, 0.0, 8.4, 2.0, 2.6), (15.0, -3.0, 3.0, 15.4, 3.0, 5.0)


def cast(
    elevations: list[float], boxes: tuple = (), azimuth: NDArray = AROUND, max_range: float = 60.0, silent: bool = True
) -> Scan:
    """A lidar's scan of level ground and boxes by rings at elevations [deg]; `silent` keeps beams without echo."""
    angle, rise = (one.ravel() for one in np.meshgrid(azimuth, np.radians(elevations)))
    ways = np.column_stack([np.cos(angle) * np.cos(rise), np.sin(angle) * np.cos(rise), np.sin(rise)])
    reach = rooms.ranges(np.array([0, 0, HEIGHT]), ways, boxes, OPEN)
    hit = reach < max_range
    return Scan(
        (ways[hit] * reach[hit, None]).astype(np.float32), no_returns=ways[~hit].astype("f4") if silent else None
    )


def without_echo(scan: Scan, where: NDArray[np.bool_]) -> Scan:
    """The scan whose points are beams without echo where something holds."""
    ways = scan.points[where, :3] / np.linalg.norm(scan.points[where, :3], axis=1, keepdims=True)
    return Scan(scan.points[~where], no_returns=ways)


def cause_at(grid: LayeredGrid | EvidentialGrid, x: float, y: float) -> UnknownCause:
    cause = grid["cause"] if isinstance(grid, LayeredGrid) else grid.cause
    return K(int(cause[*grid.spec.index(x, y)]))


RINGS = [-15, -12, -9, -7, -5, -4, -3, -2, -1, 0, 1, 3, 5]
ROAD = cast(RINGS)
PIT = cast([-20, -12, -10, -2])
IN_PIT = (np.abs(PIT.points[:, 1]) < 3) & (PIT.points[:, 0] > 8) & (PIT.points[:, 0] < 11)


@each("scan, ray, place, cause", [
    (cast(RINGS, (WALL,)), {}, (12.0, 0.3), K.BEHIND_OBSTACLE),
    (cast(RINGS, (WALL,)), {}, (6.0, 0.3), K.KNOWN),
    (cast(RINGS, (WALL,)), {}, (8.1, 0.3), K.KNOWN),
    (Scan(np.where(IN_PIT[:, None], PIT.points * np.float32(1.6), PIT.points)), {}, (10.5, 0.0), K.BEHIND_OBSTACLE),
    (ROAD, {}, (0.3, 0.3), K.NEAR_VEHICLE),
    (ROAD, {}, (2.7, 0.3), K.NEAR_VEHICLE),
    (cast([-12, -2, 5]), {}, (12.0, 0.3), K.BETWEEN_BEAMS),
    (cast(RINGS, azimuth=AROUND[np.abs(AROUND) > 0.04]), {}, (12.0, 0.0), K.BETWEEN_BEAMS),
    (cast(RINGS, azimuth=AROUND[np.abs(AROUND) > 0.4]), {}, (12.0, 0.0), K.OUTSIDE_VIEW),
    (cast([-12, -8]), {}, (18.0, 0.3), K.OUTSIDE_VIEW),
    (without_echo(ROAD, np.hypot(*ROAD.points[:, :2].T) > 9), {}, (12.0, 0.3), K.NO_ECHO),
    (cast([-12, -8, 0.5], silent=False, boxes=((30.0, -30.0, 0.0, 30.5, -2.0, 9.0),)), {}, (18.0, 0.3), K.NO_ECHO),
    (cast([-12, 6, 7, 8], (SIGN,)), {}, (12.0, 0.3), K.ABOVE_CLEARANCE),
    (cast(RINGS, ((9.0, 0.0, 0.2, 9.01, 0.01, 1.0),)), {"p_false_alarm": 0.7}, (9.05, 0.05), K.CONTRADICTED),
    (Scan(np.zeros((0, 4), np.float32)), {}, (9.0, 3.0), K.OUTSIDE_VIEW),
])  # fmt: skip
def test_each_cause_of_rays_in_a_scene_of_its_own(scan: Scan, ray: dict, place: tuple, cause: UnknownCause) -> None:
    trace = RayISM(SPEC, MOUNT, ground=flat_ground, **ray).trace(scan)
    causes = unknown_causes(trace)
    assert K(int(causes[SPEC.index(*place)])) == cause
    np.testing.assert_array_equal(causes == 0, predict_state(trace.grid.mass) != 0)  # every unknown cell has a cause
    assert causes.max(initial=0) not in (K.FORGOTTEN,)


TURN = np.radians(np.arange(-135, 135, 0.5))
BOX = (1.0, -1.0, 0.0, 1.2, 1.0, 2.0)
DUST = (np.abs(TURN - 0.8) < 1e-6) | (TURN[np.argmin(np.abs(TURN - 0.8))] == TURN)


def laser(reach: NDArray, azimuth: NDArray = TURN, rise: float = 0.0, **columns: object) -> Scan:
    """A planar laser's scan; beams of infinite range are without echo."""
    unit = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth + rise], axis=1)
    hit = np.isfinite(reach)
    points, silent = (unit[hit] * reach[hit, None]).astype(np.float32), unit[~hit].astype(np.float32)
    return Scan(points, no_returns=silent, **{"kind": "planar", "max_range": 4.0, **columns})  # type: ignore[arg-type]


FLAT, SEEN = GridSpec.centered(12.0, 12.0, 0.05), np.where(np.abs(TURN) < 0.7, 2.0, np.inf)


@each("scan, place, cause", [
    (laser(SEEN), (1.0, 0.0), K.KNOWN),
    (laser(SEEN), (3.0, 0.0), K.BEHIND_OBSTACLE),
    (laser(SEEN), (0.0, 2.0), K.NO_ECHO),
    (laser(SEEN, max_range=None), (0.0, 2.0), K.NO_ECHO),
    (laser(SEEN), (0.0, 5.0), K.OUTSIDE_VIEW),  # beyond the range
    (laser(SEEN), (-3.0, 0.0), K.OUTSIDE_VIEW),
    (laser(SEEN), (0.05, 0.05), K.NEAR_VEHICLE),
    (laser(SEEN[np.abs(TURN) > 0.04], TURN[np.abs(TURN) > 0.04]), (1.5, 0.0), K.BETWEEN_BEAMS),
    (laser(np.where(np.abs(TURN) < 1, 3.0, np.inf), rise=0.9), (2.8, 0.0), K.ABOVE_CLEARANCE),
    (laser(np.where(DUST, 1.0, 3.0)), (math.cos(0.8), math.sin(0.8)), K.CONTRADICTED),
    (laser(np.full(1, 2.0), np.zeros(1), kind="cone", beam_width=0.6), (1.0, 0.2), K.BETWEEN_BEAMS),
    (laser(np.full(1, np.inf), np.zeros(1), kind="cone", beam_width=0.6), (1.0, 0.2), K.NO_ECHO),
    (Scan(np.zeros((0, 4), np.float32), kind="planar"), (1.0, 1.0), K.OUTSIDE_VIEW),
])  # fmt: skip
def test_each_cause_of_planar_beams(scan: Scan, place: tuple, cause: UnknownCause) -> None:
    grid = ExplainedISM(PlanarISM(FLAT, Mount(0.3, ego_footprint=(-0.2, 0.2, -0.2, 0.2))))(scan)
    assert cause_at(grid, *place) == cause
    np.testing.assert_array_equal(grid.cause == 0, predict_state(grid.mass) != 0)


@each("points, place, cause", [
    ([(20, 0, 0)], (5.0, 0.1), K.KNOWN),
    ([(20, 0, 0)], (28.0, 0.1), K.BEHIND_OBSTACLE),
    ([(20, 0, 4)], (28.0, 0.1), K.ABOVE_CLEARANCE),
    ([(20, 0, 4), (20.5, 0, 0)], (28.0, 0.1), K.ABOVE_CLEARANCE),
    ([(20, 0, 0)], (20.0, 12.0), K.NO_ECHO),
    ([(20, 0, 0)], (-20.0, 0.0), K.OUTSIDE_VIEW),
    ([(20, 0, 0)], (0.0, 0.0), K.NEAR_VEHICLE),
])  # fmt: skip
def test_each_cause_of_a_radar(points: list, place: tuple, cause: UnknownCause) -> None:
    spec = GridSpec.centered()
    ism = RadarISM(spec, Mount(0.6, ego_footprint=(-1.0, 1.0, -1.0, 1.0)), half_width=1.0, margin=2.0)
    scan = Scan(np.pad(np.array(points, np.float32), ((0, 0), (0, 1))), rcs=np.zeros(len(points), np.float32))
    assert cause_at(ExplainedISM(ism)(scan), *place) == cause
    assert (
        cause_at(map_layers(load_model("ray+radar", spec), replace(scan, mount=Mount(0.6)), ["cause"])[1], -30, 0) > 0
    )


@each("seed, height, position", [(0, 1.7, (0.0, 0.0)), (1, 1.95, (2.3, -1.1)), (2, 3.0, (0.0, 0.0))])
def test_causes_of_rays_are_those_of_a_loop_over_cells_and_rays(seed: int, height: float, position: tuple) -> None:
    rng, spec, count = np.random.default_rng(seed), GridSpec.centered(16.0, 12.0, 0.5), 150
    azimuth, run = rng.uniform(0, 2 * math.pi, count), rng.uniform(1.0, 14, count)
    z = rng.choice([0, 0, 0, 0.6, 1.5, 3.0, -2.0], count) - height
    points = np.stack([run * np.cos(azimuth), run * np.sin(azimuth), z], 1).astype(np.float32)
    points = points[np.abs(azimuth - 2) > 0.3]
    silent = rng.normal(0, [1, 1, 0.1], (20, 3))
    silent = (silent / np.linalg.norm(silent, axis=1, keepdims=True)).astype(np.float32)
    mount = Mount(height, pose(*position))
    ism = RayISM(spec, mount, ground=flat_ground, azimuth_step=2 * math.pi / 64, below_ground=0.3)
    trace = ism.trace(Scan(points, no_returns=silent))
    x_min, x_max, y_min, y_max = mount.ego_footprint
    xyz = points.astype(np.float64) + [*position, 0]
    ego = (xyz[:, 0] > x_min) & (xyz[:, 0] < x_max) & (xyz[:, 1] > y_min) & (xyz[:, 1] < y_max)
    slow = reference.ray_causes(xyz[~ego], silent, -height, ism, sectors=64)
    fast, unknown = unknown_causes(trace), predict_state(trace.grid.mass) == 0
    counted = unknown & (fast != K.CONTRADICTED)
    assert (fast[counted] != slow[counted]).mean() < 0.01
    assert len(set(slow[counted].tolist())) >= 5


def test_causes_of_planar_beams_are_those_of_a_loop_over_cells_and_beams() -> None:
    rng, azimuth, spec = (
        np.random.default_rng(3),
        np.radians(np.arange(-120, 120, 2.0)),
        GridSpec.centered(6.0, 6.0, 0.1),
    )
    reach = np.repeat(rng.choice([1.0, 1.6, 2.5, np.inf], 24), 5) + rng.normal(0, 0.01, 120)
    kept = rng.random(120) > 0.03
    scan, ism = laser(reach[kept], azimuth[kept], max_range=2.8), PlanarISM(spec, Mount(0.3, ego_footprint=(-0.2,) * 4))
    trace = ism.trace(scan)
    fast, slow = unknown_causes(trace), reference.planar_causes(scan, ism)
    counted = (predict_state(trace.grid.mass) == 0) & (fast != K.CONTRADICTED)
    assert (fast[counted] != slow[counted]).mean() < 0.03  # cells on the edges of sectors
    assert {K.OUTSIDE_VIEW, K.BEHIND_OBSTACLE, K.NO_ECHO} <= set(slow[counted].tolist())


def test_several_models_agree_or_contradict_and_layers_of_beams_are_no_heights() -> None:
    ray = RayISM(SPEC, MOUNT, ground=local_ground)

    def other(scan: Scan) -> EvidentialGrid:
        mass = np.zeros((*SPEC.shape, 2), np.float32)
        mass[SPEC.index(6.0, 0.3)] = 0.0, 0.42
        return EvidentialGrid(SPEC, mass)

    other.spec = SPEC  # type: ignore[attr-defined]
    scan = cast(RINGS, (WALL,))
    both = CombinedISM([ray, other], reliability=[0.5, 1.0])
    grid, layers = map_layers(both, scan, ["cause"])
    np.testing.assert_array_equal(grid.mass, both(scan).mass)
    assert cause_at(layers, 6.0, 0.3) == K.CONTRADICTED
    assert cause_at(layers, 12.0, 0.3) == K.BEHIND_OBSTACLE
    assert cause_at(layers, 4.0, 2.0) == K.BETWEEN_BEAMS
    assert ExplainedISM(other)(scan).cause is None  # type: ignore[arg-type]
    refused(
        "layer 'ground_height' needs scans with ground",
        map_layers,
        PlanarISM(FLAT, MOUNT),
        laser(SEEN),
        ["cause", "ground_height"],
    )
    refused("need a model with rays", map_layers, other, scan, ["cause"])
