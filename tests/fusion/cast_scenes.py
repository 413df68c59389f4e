"""Scans of blocks on a level road, cast ray by ray, and the measures of a dynamic map along them."""

from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from dynamic_scenes import Block

from ogm.dynamic_grid import DynamicGrid
from ogm.fusion import DynamicMapper, rolling_window
from ogm.grid import EvidentialGrid
from ogm.metrics.motion import predicted_moving
from ogm.pose import pose
from ogm.scan import Mount, Scan
from ogm.simulation.sensors import LIDARS

HEIGHT, REACH, NOISE, PERIOD = 1.9, 100.0, 0.02, 0.1  # [m] of the lidar, of its beams, of ranges; [s] of a turn
MOUNT = Mount(HEIGHT)
Path = Callable[[float], np.ndarray]  # pose of the sensor at a time, (4, 4)
Things = Callable[[float], Sequence[tuple[Block, float]]]  # blocks at a time, and their heights [m]


@cache
def _beams(lidar: str) -> tuple[np.ndarray, np.ndarray]:
    """Return directions (N, 3) and times within the turn (N,) [s], the last of which is 0."""
    directions = LIDARS[lidar].directions()
    time = np.linspace(-PERIOD, 0, directions.shape[1], endpoint=False)
    return directions.reshape(-1, 3).astype(np.float64), np.tile(time, directions.shape[0])


def cast(things: Things, path: Path, stamp: float, *, distorted: bool = False, lidar: str = "vlp-32c") -> Scan:
    """Return the scan of a lidar; distorted: each beam starts where the sensor is at its time."""
    directions, time = _beams(lidar)
    rng = np.random.default_rng(round(stamp / PERIOD))
    T = path(stamp)
    yaw, at = np.arctan2(T[1, 0], T[0, 0]), np.broadcast_to(T[:3, 3], directions.shape)
    if distorted:
        columns, turn = np.unique(time, return_inverse=True)
        poses = np.array([path(stamp + t) for t in columns])[turn]
        yaw, at = np.arctan2(poses[:, 1, 0], poses[:, 0, 0]), poses[:, :3, 3]
    c, s = np.cos(yaw), np.sin(yaw)
    ways = np.stack(
        [c * directions[:, 0] - s * directions[:, 1], s * directions[:, 0] + c * directions[:, 1], directions[:, 2]],
        axis=1,
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(ways[:, 2] < 0, -at[:, 2] / ways[:, 2], np.inf)
        for block, height in things(stamp):
            np.minimum(distance, _to_block(block, height, at, ways), out=distance)
    hit = distance < REACH
    reach = distance[hit] + rng.normal(0, NOISE, np.count_nonzero(hit))
    points = np.column_stack([directions[hit] * reach[:, None], np.full(len(reach), 0.5)])
    missed = np.ascontiguousarray(directions[~hit], np.float32)
    return Scan(points.astype(np.float32), time=time[hit], no_returns=missed, mount=MOUNT, stamp=stamp)


def _to_block(block: Block, height: float, at: np.ndarray, ways: np.ndarray) -> np.ndarray:
    """Return the distance at which rays hit an upright block, (N,) [m]; inf where they miss it."""
    yaw = np.arctan2(block.vy, block.vx) if block.yaw is None else block.yaw
    c, s, dx, dy = np.cos(yaw), np.sin(yaw), at[:, 0] - block.x, at[:, 1] - block.y
    starts = c * dx + s * dy, c * dy - s * dx, at[:, 2] - height / 2
    slopes = c * ways[:, 0] + s * ways[:, 1], c * ways[:, 1] - s * ways[:, 0], ways[:, 2]
    near, far = np.zeros(len(at)), np.full(len(at), np.inf)
    for start, slope, half in zip(starts, slopes, (block.length / 2, block.width / 2, height / 2), strict=True):
        a, b = (-half - start) / slope, (half - start) / slope
        near, far = np.maximum(near, np.minimum(a, b)), np.minimum(far, np.maximum(a, b))
    return np.where(near < far, near, np.inf)


class Look(NamedTuple):
    """A dynamic map after a scan, on cells around the vehicle, next to the truth."""

    stamp: float
    shown: np.ndarray  # cells that the scan measures as occupied
    moving: np.ndarray  # cells that are predicted moving
    view: DynamicGrid
    cells: list[np.ndarray]  # of each block
    near: list[np.ndarray]  # cells of each block with a margin of 0.3 m
    objects: int  # that are confirmed


def looks(
    ism: Callable[[Scan], EvidentialGrid],
    things: Things,
    path: Path,
    times: Sequence[float],
    *,
    distorted: bool = False,
    lidar: str = "vlp-32c",
    mapper: DynamicMapper | None = None,
) -> Iterator[Look]:
    """Yield the map after each scan of a scene."""
    spec = ism.spec
    mapper = mapper or DynamicMapper(rolling_window(spec), 50_000)
    for stamp in times:
        T = path(stamp)
        grid = ism(cast(things, path, stamp, distorted=distorted, lidar=lidar))
        mapper.update(grid, T, stamp=stamp)
        view = mapper.dynamic_view(spec)
        around = [_seen_from(T, block) for block, _ in things(stamp)]
        cells, near = ([block.cells(spec, margin) for block in around] for margin in (0.0, 0.3))
        objects = len(mapper.objects().confirmed)
        yield Look(stamp, grid.occupied > 0.5, predicted_moving(view), view, cells, near, objects)


def _seen_from(T: np.ndarray, block: Block) -> Block:
    """Return a block in the axes of the vehicle; its velocity is still over ground."""
    yaw = np.arctan2(T[1, 0], T[0, 0])
    turn, at = np.exp(-1j * yaw), (block.x - T[0, 3]) + 1j * (block.y - T[1, 3])
    v = (block.vx + 1j * block.vy) * turn
    heading = np.arctan2(block.vy, block.vx) if block.yaw is None else block.yaw
    return block._replace(x=(at * turn).real, y=(at * turn).imag, vx=v.real, vy=v.imag, yaw=heading - yaw)


def driving(speed: float, turn: float = 0.0) -> Path:
    """Return the path of a sensor that passes the origin at time 0, at a speed [m/s] and turn rate [rad/s]."""

    def path(seconds: float) -> np.ndarray:
        half = turn * seconds / 2
        chord = speed * seconds * np.sinc(half / np.pi)
        return pose(chord * np.cos(half), chord * np.sin(half), HEIGHT, yaw=2 * half)

    return path


def braking(block: Block, start: float, deceleration: float) -> Callable[[float], Block]:
    """Return a block at any time that brakes to a stop from some time on [s], at a deceleration [m/s²]."""
    speed, yaw = np.hypot(block.vx, block.vy), np.arctan2(block.vy, block.vx)

    def at(seconds: float) -> Block:
        braked = min(max(seconds - start, 0.0), speed / deceleration)
        left = 1 - deceleration * braked / speed
        way = min(seconds, start) + braked * (1 + left) / 2  # of constant speed [s]
        x, y = block.x + block.vx * way, block.y + block.vy * way
        return block._replace(x=x, y=y, vx=block.vx * left, vy=block.vy * left, yaw=yaw)

    return at
