"""Maps predict beams: a reference, laws of the prediction, and the cross-validation of a drive."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from cases import each, refused
from numpy.typing import NDArray
from scipy.special import ndtr

from ogm.evaluation import BEAM_METRICS, FusedMap, evaluate_beams
from ogm.grid import EvidentialGrid, GridSpec
from ogm.metrics.beams import BeamNoise, BeamScores, PlanarBeams, score_beams
from ogm.pose import pose
from ogm.scan import Frame, LazyFrame, Mount, Scan

SIDE, NOISE = 0.1, BeamNoise(max_range=8.0)
SPEC = GridSpec(SIDE, (60, 50), (-3.0, -2.0))
BASE_RATE = 0.02
ROOM = (-1.95, 2.05, -1.45, 1.55)  # x_min, x_max, y_min, y_max of the walls, in the middle of cells [m]
MOUNT = Mount(0.3, ego_footprint=(0, 0, 0, 0))


def random_map(seed: int, share: float = 0.06) -> EvidentialGrid:
    """Return a map of free cells with some obstacles and some unknown."""
    rng = np.random.default_rng(seed)
    occupied = np.where(rng.random(SPEC.shape) < share, rng.uniform(0, 1, SPEC.shape), 0.0)
    free = (1 - occupied) * rng.uniform(0.8, 1, SPEC.shape) * (rng.random(SPEC.shape) < 0.9)
    return EvidentialGrid(SPEC, np.stack([free, occupied], axis=-1).astype(np.float32))


def random_beams(count: int, seed: int) -> PlanarBeams:
    rng = np.random.default_rng(seed)
    azimuth = rng.uniform(-np.pi, np.pi, count)
    azimuth[:4] = np.arange(4) * np.pi / 2  # along the lines of cells
    direction = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    direction[:4] = np.round(direction[:4])
    echo = rng.random(count) < 0.9
    distance = np.where(echo, rng.uniform(0.05, 6, count), NOISE.max_range)
    return PlanarBeams(rng.uniform((-1, -1), (1, 1), (count, 2)), direction, distance, echo)


def chords(grid: EvidentialGrid, origin: NDArray[Any], direction: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return the ranges at which a beam crosses lines of cells, and the chance of an end in between where it comes."""
    lines = np.arange(-200, 200) * SIDE
    with np.errstate(divide="ignore", invalid="ignore"):
        crossed = [(lines + corner - o) / d for corner, o, d in zip(SPEC.origin, origin, direction, strict=True)]
    edges = np.concatenate([c[np.isfinite(c) & (c > 0) & (c < NOISE.max_range)] for c in crossed])
    edges = np.concatenate([[0.0], np.sort(edges), [NOISE.max_range]])
    middle = origin + direction * (edges[:-1, None] + np.diff(edges)[:, None] / 2)
    i, j = np.floor((middle - SPEC.origin) / SIDE).astype(int).T
    inside = (i >= 0) & (i < SPEC.shape[0]) & (j >= 0) & (j < SPEC.shape[1])
    mass = grid.mass[np.where(inside, i, 0), np.where(inside, j, 0)].astype(float)
    p = np.where(inside, mass[:, 1] + BASE_RATE * (1 - mass.sum(axis=1)), BASE_RATE)
    return edges, 1 - (1 - np.clip(p, 1e-6, 1 - 1e-6)) ** (np.diff(edges) / SIDE)


def free_at(grid: EvidentialGrid, point: NDArray[Any]) -> float:
    """Return the mass of free of the cell whose centre is nearest, 0 outside."""
    x, y = grid.spec.cell_centers
    i, j = int(abs(x[:, 0] - point[0]).argmin()), int(abs(y[0] - point[1]).argmin())
    near = max(abs(x[i, 0] - point[0]), abs(y[0, j] - point[1])) < SIDE / 2
    return float(grid.free[i, j]) if near else 0.0


def reference(grid: EvidentialGrid, beams: PlanarBeams) -> BeamScores:
    """Return the same by crossings that are sorted, and normal distributions of scipy."""
    rows = []
    for origin, direction, z, echo in zip(*beams, strict=True):
        edges, end = chords(grid, origin, direction)
        a, b = edges[:-1], edges[1:]
        ends = end * np.concatenate([[1.0], np.cumprod(1 - end)[:-1]])
        mode = (a + b)[np.argmax(ends)] / 2
        overlap = np.clip(np.minimum(b, mode + 2 * SIDE) - np.maximum(a, mode - 2 * SIDE), 0, None)
        wide = b - a > 1e-12
        density = (
            ends[wide] * (ndtr((b - z) / NOISE.range_noise) - ndtr((a - z) / NOISE.range_noise))[wide] / (b - a)[wide]
        ).sum()
        blocked = np.flatnonzero(end > 0.5)
        first, last = (a[blocked[0]], b[blocked[0]]) if len(blocked) else (np.inf, np.inf)
        rows.append(
            (
                math.log(0.95 * density + 0.05 / NOISE.max_range) if echo else math.nan,
                echo and first - 2 * SIDE <= z <= last + 2 * SIDE,
                z > last + 2 * SIDE if echo else len(blocked) > 0,
                echo and free_at(grid, origin + direction * z) > 0.5,
                0.95 * (ends[wide] * overlap[wide] / (b - a)[wide]).sum() + 0.05 * 4 * SIDE / NOISE.max_range,
                echo and abs(z - mode) <= 2 * SIDE,
                np.prod(1 - end),
            )
        )
    return BeamScores(*map(np.array, zip(*rows, strict=True)))


def test_the_kernel_agrees_with_the_reference() -> None:
    for seed in range(3):
        grid, beams = random_map(seed), random_beams(40, seed)
        fast, slow = score_beams(grid, beams, NOISE, BASE_RATE), reference(grid, beams)
        for name, a, b in zip(BeamScores._fields, fast, slow, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6, err_msg=name)
    assert fast.passes_through.any()
    assert fast.ends_at.any()


def test_a_map_is_calibrated_for_beams_that_end_as_it_predicts() -> None:
    rng, grid, beams = np.random.default_rng(5), random_map(7, 0.02), random_beams(3000, 7)
    distance, echo = np.empty(3000), np.empty(3000, bool)
    for n in range(3000):
        edges, end = chords(grid, beams.origin[n], beams.direction[n])
        stops = np.flatnonzero(rng.random(len(end)) < end)
        echo[n] = len(stops) > 0
        distance[n] = rng.uniform(*edges[stops[0] : stops[0] + 2]) if echo[n] else NOISE.max_range
    scores = score_beams(grid, beams._replace(distance=distance, echo=echo), NOISE._replace(p_random=1e-6), BASE_RATE)
    assert scores.expected.mean() == pytest.approx(scores.hit.mean(), abs=0.03)
    assert scores.no_echo.mean() == pytest.approx(1 - echo.mean(), abs=0.03)
    far = score_beams(random_map(8, 0.02), beams._replace(distance=distance, echo=echo), NOISE, BASE_RATE)
    assert np.nanmean(scores.log_likelihood) > np.nanmean(far.log_likelihood) + 0.2


def room_map(frames: Sequence[Frame] = ()) -> EvidentialGrid:
    """Return the true map of the room: free inside, its walls occupied, unknown outside."""
    x, y = SPEC.cell_centers
    x0, x1, y0, y1 = ROOM
    inside = (x > x0 - SIDE / 2) & (x < x1 + SIDE / 2) & (y > y0 - SIDE / 2) & (y < y1 + SIDE / 2)
    free = (x > x0 + SIDE / 2) & (x < x1 - SIDE / 2) & (y > y0 + SIDE / 2) & (y < y1 - SIDE / 2)
    return EvidentialGrid(SPEC, np.stack([free * 0.98, (inside & ~free) * 0.98], axis=-1).astype(np.float32))


def room_drive(count: int, max_range: float | None = 8.0, **changes: Any) -> list[Frame]:
    """Return planar scans in the room, on a line, whose last beam has no echo; `changes` are of each scan."""
    rng, frames = np.random.default_rng(3), []
    for k in range(count):
        x, y, yaw = -1 + 2 * k / count, 0.2, 0.3 * k
        azimuth = np.radians(np.arange(0.5, 360, 3.0))
        u, v = np.cos(azimuth + yaw), np.sin(azimuth + yaw)
        reach = np.minimum(np.where(u > 0, ROOM[1] - x, ROOM[0] - x) / u, np.where(v > 0, ROOM[3] - y, ROOM[2] - y) / v)
        reach += rng.normal(0, 0.01, len(reach))
        columns = np.stack([reach * np.cos(azimuth), reach * np.sin(azimuth), 0 * reach], axis=1).astype(np.float32)
        silent = (columns[-1:] / np.linalg.norm(columns[-1])).astype(np.float32)
        scan = Scan(columns[:-1], no_returns=silent, **{"kind": "planar", "max_range": max_range, **changes})
        T = pose(x, y, 0.3, yaw=yaw)
        frames.append(Frame(scan, MOUNT, T_map_sensor=T, name=f"scan-{k}", sequence="room"))
    return frames


def test_each_scan_is_left_out_once_and_the_true_map_is_best() -> None:
    frames, made = room_drive(10), list[set[str]]()

    def watched(mapped: Sequence[Frame]) -> EvidentialGrid:
        made.append({frame.name for frame in mapped})
        return room_map()

    def shifted(mapped: Sequence[Frame]) -> EvidentialGrid:
        grid = room_map()
        return EvidentialGrid(GridSpec(SIDE, SPEC.shape, (SPEC.origin[0] + 0.3, SPEC.origin[1])), grid.mass)

    def nothing(mapped: Sequence[Frame]) -> EvidentialGrid:
        return EvidentialGrid(SPEC, np.zeros((*SPEC.shape, 2), np.float32))

    result = evaluate_beams(frames, {"true": watched, "shifted": shifted, "nothing": nothing}, every=5, p_random=1e-3)
    assert [sorted({frame.name for frame in frames} - one) for one in made] == [
        [f"scan-{k}", f"scan-{k + 5}"] for k in range(5)
    ]
    value = {name: [result.interval(one, name).value for one in result.methods] for name in BEAM_METRICS}
    true, moved, empty = value["log_likelihood"]
    assert true > max(moved, empty) + 1
    assert value["ends_at"][0] == 1
    assert value["passes_through"][0] == value["passes_through"][2] == 0
    assert value["passes_through"][1] > 0.2
    assert value["ends_in_free"][0] == value["ends_in_free"][2] == 0
    assert value["ends_in_free"][1] > 0.1
    assert value["no_echo_blocked"][::2] == [1, 0]
    assert value["ece"][0] < 0.03
    assert (result.echoes == 119).all()
    assert (result.no_echoes == 1).all()
    assert (evaluate_beams(room_drive(5, None), {"true": room_map}).no_echoes == 0).all()
    assert result.record()["methods"]["true"]["ends_at"].value == 1


@each(
    "change, message",
    [
        (dict(every=1), "every must be 2 or more"),
        (dict(p_random=0.0), "range_noise must be above 0 m and p_random"),
        (dict(frames=[]), "no scan has a pose"),
        (dict(frames=room_drive(3)), "'room' needs 5 scans with poses or more, got 3"),
        (dict(frames=room_drive(5, kind="depth")), "scan-0 must be a scan of a planar laser, got 'depth'"),
        (dict(frames=room_drive(5, kind="")), "scan-0 must be a scan of a planar laser, got a lidar or radar"),
    ],
)
def test_what_decides_the_result_is_refused(change: dict[str, Any], message: str) -> None:
    given: dict[str, Any] = {"frames": room_drive(5), "methods": {"true": room_map}, **change}
    refused(message, evaluate_beams, given.pop("frames"), given.pop("methods"), **given)


def test_a_tilted_laser_and_a_dynamic_map_are_refused() -> None:
    frames = room_drive(5)
    lean = pose(pitch=0.2)
    leaning = [Frame(frame.scan, MOUNT, T_map_sensor=lean, name=frame.name, sequence="room") for frame in frames]
    refused("scan-0 must be tilted by 5 degrees at most, got 11 degrees", evaluate_beams, leaning, {"true": room_map})
    refused("must be of a static map", FusedMap, None, "dynamic")


def test_a_scan_that_cannot_be_read_is_left_out() -> None:
    def broken() -> Scan:
        raise ValueError("cut off")

    lost, errors = LazyFrame(broken, lambda: MOUNT, T_map_sensor=np.eye(4), sequence="room"), list[str]()
    frames = [*room_drive(5), lost, Frame(room_drive(1)[0].scan, MOUNT, sequence="room")]
    result = evaluate_beams(frames, {"true": room_map}, on_error=lambda frame, error: errors.append(str(error)))
    assert (result.frames, errors) == (tuple(f"scan-{k}" for k in range(5)), ["cut off"])
