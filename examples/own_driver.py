"""An own driver as a live map: `frames` and `main` are all there is to it.

    python examples/own_driver.py

Then open ws://127.0.0.1:8765 in Foxglove or Lichtblick.
"""

import time
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from ogm import Frame, GridSpec, Mount, Scan
from ogm.fusion import EvidentialMapper, rolling_window
from ogm.geometric import RayISM
from ogm.live import FoxglovePublisher, LiveReport, serve, warm_up
from ogm.pose import pose

SPEC, MOUNT = GridSpec.centered(length=40.0, width=40.0, resolution=0.2), Mount(sensor_height=1.8)

Sweep = tuple[NDArray[np.float32], NDArray[np.float64], float]  # points (N, 4), T_map_sensor (4, 4), stamp [s]


def frames(sweeps: Iterable[Sweep]) -> Iterator[Frame]:
    for points, T_map_sensor, stamp in sweeps:
        yield Frame(Scan(points, stamp), MOUNT, None, None, T_map_sensor=T_map_sensor, stamp=stamp)


def main(sweeps: Iterable[Sweep], port: int = 8765) -> LiveReport:
    ism, mapper = RayISM(SPEC, MOUNT), EvidentialMapper(rolling_window(SPEC))
    warm_up(ism, mapper)  # compiles the kernels now, not when the first scan is there
    with FoxglovePublisher(port=port) as publisher:
        print(f"serving at {publisher.url}; Ctrl-C stops")
        return serve(frames(sweeps), ism, mapper, publisher, on_report=print)


def driver(count: int | None = None, rate: float = 10.0) -> Iterator[Sweep]:
    """Yield what a lidar on its way through a round yard would measure; put your own driver here."""
    azimuth = np.linspace(-np.pi, np.pi, 1024, endpoint=False)
    directions = np.column_stack([np.cos(azimuth), np.sin(azimuth)])
    start, k = time.monotonic(), 0
    while count is None or k < count:
        x = 3.0 * np.sin(0.05 * k)  # [m] of the sensor; the wall stands 15 m around (0, 0)
        along = directions[:, 0] * x
        wall = -along + np.sqrt(along**2 - x**2 + 15.0**2)
        rings = []
        for elevation in np.deg2rad(np.arange(-24.0, 4.0, 2.0)):
            ground = 1.8 / np.tan(-elevation) if elevation < 0 else np.inf
            distance = np.minimum(wall, ground)
            z = distance * np.tan(elevation)
            rings.append(np.column_stack([directions * distance[:, None], z, np.full(z.size, 0.5)]))
        yield np.concatenate(rings).astype(np.float32), pose(x=x, z=1.8), time.time()
        k += 1
        time.sleep(max(start + k / rate - time.monotonic(), 0.0))


if __name__ == "__main__":
    print(main(driver()))
