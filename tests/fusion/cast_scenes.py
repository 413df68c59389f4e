"""Scans of blocks on a level road, cast ray by ray, and the measures of a dynamic map along them."""

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from dynamic_scenes import Block

from ogm.dynamic_grid import DynamicGrid
from ogm.fusion import DynamicMapper, rolling_window
from ogm.geometric import RayISM
from ogm.metrics.motion import predicted_moving
from ogm.pose import pose
from ogm.scan import Mount, Scan
from ogm.simulation.sensors import LIDARS

REACH, NOISE = 100.0, 0.02  # [m] of the beams, and of their ranges
MOUNT, BEAMS = Mount(1.9), LIDARS["hdl-32e"].directions().reshape(-1, 3).astype(np.float64)
Things = Callable[[float], Sequence[tuple[Block, float]]]  # blocks at a time, and their heights [m]


class Look(NamedTuple):
    """A dynamic map after a scan, on cells around the vehicle, next to the truth of the first block."""

    stamp: float
    shown: np.ndarray  # cells that the scan measures as occupied
    moving: np.ndarray  # cells that are predicted moving
    view: DynamicGrid
    cells: np.ndarray  # of the first block
    near: np.ndarray  # those within 0.3 m of it
    objects: int  # that are confirmed

    @property
    def share(self) -> float:
        """Share of the cells of the first block that the scan shows, which are predicted moving."""
        cells = self.near & self.shown
        return float((self.moving & cells).sum() / max(cells.sum(), 1))


def looks(ism: RayISM, things: Things, seconds: float, speed: float = 0.0) -> Iterator[Look]:
    """Yield the map after each scan of a scene, from a vehicle that drives along x at a speed [m/s]."""
    mapper = DynamicMapper(rolling_window(ism.spec), 50_000)
    for k in range(round(10 * seconds) + 1):
        stamp = k / 10
        blocks = [(block._replace(x=block.x - speed * stamp), height) for block, height in things(stamp)]
        grid = ism(_cast(blocks, np.random.default_rng(k)))
        mapper.update(grid, pose(speed * stamp, 0.0, MOUNT.sensor_height), stamp=stamp)
        view = mapper.dynamic_view(ism.spec)
        cells, near = (blocks[0][0].cells(ism.spec, margin) for margin in (0.0, 0.3))
        objects = len(mapper.objects().confirmed)
        yield Look(stamp, grid.occupied > 0.5, predicted_moving(view), view, cells, near, objects)


def _cast(blocks: Sequence[tuple[Block, float]], rng: np.random.Generator) -> Scan:
    """Return the scan of blocks that stand on the road around the sensor."""
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(BEAMS[:, 2] < 0, -MOUNT.sensor_height / BEAMS[:, 2], np.inf)
        for block, height in blocks:
            np.minimum(distance, _to_block(block, height), out=distance)
    hit = distance < REACH
    reach = distance[hit] + rng.normal(0, NOISE, np.count_nonzero(hit))
    points = np.column_stack([BEAMS[hit] * reach[:, None], np.full(len(reach), 0.5)]).astype(np.float32)
    return Scan(points, no_returns=BEAMS[~hit].astype(np.float32), mount=MOUNT)


def _to_block(block: Block, height: float) -> np.ndarray:
    """Return the distance at which the beams hit an upright block, (N,) [m]; inf where they miss it."""
    yaw = np.arctan2(block.vy, block.vx) if block.yaw is None else block.yaw
    c, s = np.cos(yaw), np.sin(yaw)
    starts = -c * block.x - s * block.y, s * block.x - c * block.y, MOUNT.sensor_height - height / 2
    slopes = c * BEAMS[:, 0] + s * BEAMS[:, 1], c * BEAMS[:, 1] - s * BEAMS[:, 0], BEAMS[:, 2]
    near, far = np.zeros(len(BEAMS)), np.full(len(BEAMS), np.inf)
    for start, slope, half in zip(starts, slopes, (block.length / 2, block.width / 2, height / 2), strict=True):
        a, b = (-half - start) / slope, (half - start) / slope
        near, far = np.maximum(near, np.minimum(a, b)), np.minimum(far, np.maximum(a, b))
    return np.where(near < far, near, np.inf)


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
