"""What the fast parts cost, as multiples of a numpy expression timed in the same process, in turn with them.

    asv continuous --factor 1.2 HEAD~1 HEAD      # two commits, in an environment of asv's
    asv run -E existing --set-commit-hash $(git rev-parse HEAD)      # what is installed here

Both are timed in pairs, one right after the other, by the time of the processor that the process has; what counts is
the ratio of the least times of both. Where other processes use all cores it is still wrong by up to 1.8.
"""

import contextlib
import itertools
import shutil
import tempfile
import time
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

import numpy as np

from ogm import EvidentialGrid, GridSpec, Mount, Scan, evidence, metrics
from ogm.datasets import open_dataset
from ogm.deep import DeepISM
from ogm.fusion import DynamicMapper, EvidentialMapper
from ogm.geometric import HeightBandISM, RayISM
from ogm.io import read_scan
from ogm.io.logs import LogWriter
from ogm.io.messages import point_cloud2
from ogm.pose import pose
from ogm.world import WorldMap

SPEC = GridSpec.centered()
PAIRS, SECONDS = 40, 8.0  # at most, of timing; at least FEWEST pairs
FEWEST, WARM = 7, 3
ROAD = files("ogm") / "data" / "vls128_road.pcd.xz"
A, B = np.random.default_rng(0).random((2, 1 << 20), np.float32)


def reference() -> None:
    """Read 8 MB, compute a root and a product, write 4 MB: about what a layer of a map costs."""
    np.sqrt(A * B + A)


class Speed:
    """One case per claim of speed in the docs."""

    params = [
        "RayISM", "HeightBandISM", "EvidentialMapper.update", "DynamicMapper.update", "DeepISM lite", "dempster",
        "read pcd", "read MCAP", "WorldMap.integrate", "WorldMap.window", "metrics",
    ]  # fmt: skip
    param_names = ["case"]
    timeout = 900  # [s], with the compilation of kernels
    unit = "x"

    def setup(self, case: str) -> None:
        """Prepare a case, and call it until its kernels are compiled."""
        self.folder = Path(tempfile.mkdtemp())
        self.open = contextlib.ExitStack()
        self.step = self.prepare(case)
        for _ in range(WARM):
            self.step()

    def teardown(self, case: str) -> None:
        """Remove what the case wrote."""
        self.open.close()
        shutil.rmtree(self.folder)

    def track_multiple(self, case: str) -> float:
        """Return the least time of the case by the least time of `reference`."""
        own, other, end = [], [], time.perf_counter() + SECONDS
        for k in range(PAIRS):
            for call, times in ((reference, other), (self.step, own)):
                start = time.process_time()
                call()
                times.append(time.process_time() - start)
            if k >= FEWEST and time.perf_counter() > end:
                break
        return min(own) / min(other)

    def prepare(self, case: str) -> Callable[[], object]:
        """Return what is timed: one scan, one update, one file."""
        if case.startswith("read"):
            return self.reading(case)
        if case.startswith("WorldMap"):
            return self.world(case)
        if case == "dempster":
            one, other = _masses(1), _masses(2)
            return lambda: evidence.dempster(one, other)
        if case == "metrics":
            mass, state = _masses(1), np.random.default_rng(3).integers(0, 3, SPEC.shape).astype(np.uint8)
            return lambda: metrics.score(metrics.accumulate(mass, state))
        stamps = itertools.count()
        if case == "EvidentialMapper.update":
            grid, mapper = EvidentialGrid(SPEC, _masses(1)), EvidentialMapper(SPEC)
            return lambda: mapper.update(grid, _driven(k := next(stamps)), stamp=0.1 * k)
        if case == "DynamicMapper.update":
            grid, moving = EvidentialGrid(SPEC, _masses(1)), DynamicMapper(SPEC, 200_000, matching=False)
            return lambda: moving.update(grid, _driven(k := next(stamps)), stamp=0.1 * k)
        scan, mount = read_scan(str(ROAD), axes=("+y", "-x", "+z")), Mount(1.98)
        if case == "RayISM":
            ray = RayISM(SPEC, mount)
            return lambda: ray(scan)
        if case == "HeightBandISM":
            band = HeightBandISM(SPEC, mount)
            return lambda: band(scan)
        lite = DeepISM.load("lite", spec=SPEC, mount=mount)
        return lambda: lite(scan)

    def reading(self, case: str) -> Callable[[], object]:
        """Return the reading of 100,000 points from a file."""
        points = np.random.default_rng(4).uniform((-50, -50, -2, 0), (50, 50, 3, 1), (100_000, 4)).astype(np.float32)
        if case == "read MCAP":
            path = self.folder / "drive.mcap"
            with LogWriter(path) as log:
                log.write(
                    "/points", "sensor_msgs/msg/PointCloud2", point_cloud2(Scan(points), frame_id="a", stamp=1.0), 1.0
                )
            return lambda: [frame.scan for frame in open_dataset(path, topic="/points", sensor_height=1.9)]
        path = self.folder / "scan.pcd"
        head = "VERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\nTYPE F F F F\nCOUNT 1 1 1 1\n"
        head += f"WIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA binary\n"
        path.write_bytes(head.encode() + points.tobytes())
        return lambda: read_scan(path)

    def world(self, case: str) -> Callable[[], object]:
        """Return a scan into, or a window of, a map in tiles."""
        world = self.open.enter_context(WorldMap.create(self.folder / "world"))
        grid, stamps = EvidentialGrid(SPEC, _masses(1)), itertools.count()
        for k in range(3):
            world.integrate(grid, _driven(k), stamp=0.1 * next(stamps))
        if case == "WorldMap.window":
            return lambda: world.window(SPEC)
        return lambda: world.integrate(grid, _driven(k := next(stamps)), stamp=0.1 * k)


def _masses(seed: int) -> np.ndarray:
    """Return masses of free and occupied in blocks of 16 x 16 cells, a third of them unknown, (nx, ny, 2) float32."""
    small = np.random.default_rng(seed).dirichlet([1, 1, 1], size=(32, 22))[..., :2].astype(np.float32)
    small[::3] = 0
    return small.repeat(16, axis=0).repeat(16, axis=1)


def _driven(k: int) -> np.ndarray:
    """Return where the vehicle is after k scans: round and round on a circle of 20 m."""
    return pose(20 * np.cos(0.02 * k), 20 * np.sin(0.02 * k), yaw=0.02 * k)
