"""What does a log cost: to open, to read, to make a map of? Does its length cost memory? Measured.

    python benchmarks/logs.py [--scans N] [--rounds N] [--quick]

Scans of 120,000 points (22 bytes each: x, y, z, intensity, ring, time) at 10 Hz, with transforms at 100 Hz, in an MCAP
(plain, and zstd), a ROS 2 db3 and a ROS 1 bag, all written here. One core. The peers decode the same messages and make
the same (N, 4) array: `rosbags`, and `mcap-ros2-support` for MCAP. Writes benchmarks/results/logs.json and
docs/pictures/logs.png.
"""

import _run as run  # first: it sets the number of threads
from _contenders import street

# isort: split
import gc
import math
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from _charts import PEER, caption, draw_times, save_picture
from _timing import Contender, measure
from matplotlib.figure import Figure
from mcap_ros2.reader import read_ros2_messages
from numpy.typing import NDArray
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from ogm import GridSpec, Mount, Scan
from ogm.datasets import open_dataset
from ogm.fusion import EvidentialMapper, fuse, rolling_window
from ogm.geometric import RayISM
from ogm.io import GridLog, PlacedGrid
from ogm.io.logs import LogWriter
from ogm.io.messages import StampedTransform, point_cloud2, tf_message
from ogm.pose import pose

POINTS, LAYERS, HEIGHT, START = 120_000, 64, 1.9, 1000.0
STEP, TURN, PERIOD, TRANSFORMS = 0.8, 0.01, 0.1, 10  # [m], [rad], [s] from scan to scan, transforms per scan
FORMATS = {"MCAP": ("drive.mcap", ""), "MCAP, zstd": ("zstd.mcap", "zstd"), "db3": ("drive.db3", ""),
           "bag": ("drive.bag", "")}  # fmt: skip
TOPIC = "/points"
READ = """
import pathlib, sys, _timing, logs
for _ in logs.read_by_ogm(pathlib.Path(sys.argv[1])):
    pass
print(_timing.peak_memory())
"""


def write_log(path: Path, compression: str, scans: int) -> None:
    """Write a drive round a bend: the same street again and again."""
    points = street(POINTS, LAYERS)
    ring = np.repeat(np.arange(LAYERS), len(points) // LAYERS)
    time = np.tile(np.linspace(-PERIOD, 0.0, len(points) // LAYERS, endpoint=False), LAYERS)
    scan, radius = Scan(points, ring=ring, time=time), STEP / TURN
    with LogWriter(path, compression) as log:
        mounted = StampedTransform("base_link", "lidar", START, pose(z=HEIGHT))
        log.write("/tf_static", "tf2_msgs/msg/TFMessage", tf_message([mounted]), START)
        for k in range(scans * TRANSFORMS):
            stamp, yaw = START + k * PERIOD / TRANSFORMS, k * TURN / TRANSFORMS
            T = pose(radius * math.sin(yaw), radius * (1 - math.cos(yaw)), yaw=yaw)
            moved = tf_message([StampedTransform("map", "base_link", stamp, T)])
            log.write("/tf", "tf2_msgs/msg/TFMessage", moved, stamp)
            if k % TRANSFORMS == 0:
                cloud = point_cloud2(scan, frame_id="lidar", stamp=stamp)
                log.write(TOPIC, "sensor_msgs/msg/PointCloud2", cloud, stamp)


def columns(message: Any) -> NDArray[np.float32]:
    """Return x, y, z and intensity of a message whose layout is known, (N, 4)."""
    fields = [(field.name, {7: "<f4", 4: "<u2"}[field.datatype]) for field in message.fields]
    table = np.frombuffer(message.data, np.dtype(fields))
    return np.stack([table[name] for name in ("x", "y", "z", "intensity")], axis=1)


def read_by_ogm(path: Path) -> Iterator[NDArray[np.float32]]:
    for frame in open_dataset(path, topic=TOPIC, sensor_height=HEIGHT):
        yield frame.scan.points


def read_by_rosbags(path: Path) -> Iterator[NDArray[np.float32]]:
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        wanted = [one for one in reader.connections if one.topic == TOPIC]
        for connection, _, raw in reader.messages(wanted):
            yield columns(reader.deserialize(raw, connection.msgtype))


def read_by_mcap_ros2(path: Path) -> Iterator[NDArray[np.float32]]:
    for message in read_ros2_messages(path, topics=[TOPIC]):
        yield columns(message.ros_msg)


def reading(read: Callable[[Path], Iterator[NDArray[np.float32]]], path: Path) -> Contender:
    """Return the reading of a whole log; its points must be those that were written."""
    expected = street(POINTS, LAYERS)

    def step(_: None) -> None:
        for points in read(path):  # noqa: B007  the last is checked
            pass
        assert np.array_equal(points, expected)

    return Contender(step, gc.collect)  # data sets hold cycles, and automatic collection is off


def mapping(path: Path, out: Path) -> Contender:
    """Return the way from a log to a log with the map after each scan."""
    spec = GridSpec.centered()
    ism = RayISM(spec, Mount(HEIGHT, pose(z=HEIGHT)))

    def step(_: None) -> None:
        mapper = EvidentialMapper(rolling_window(spec))
        dataset = open_dataset(path, topic=TOPIC, sensor_height=HEIGHT)
        with GridLog(out) as log:
            for one in fuse(dataset, ism, mapper):
                if one.error is not None:
                    raise one.error
                log.write(PlacedGrid(mapper.grid, stamp=one.frame.stamp))

    return Contender(step, gc.collect)


def reading_memory(path: Path) -> float:
    """Return the greatest memory of a process that reads a whole log [MB]."""
    return float(run.in_new_process(READ, [path], cwd=Path(__file__).parent))


def measured(folder: Path, scans: int, rounds: int) -> dict[str, Any]:
    """Return all figures."""
    paths = {}
    for name, (file, compression) in FORMATS.items():
        paths[name] = folder / file
        write_log(paths[name], compression, scans)
    contenders = {
        f"ogm, open: {name}": Contender(lambda _, path=path: open_dataset(path, topic=TOPIC))  # type: ignore
        for name, path in paths.items()
    }
    contenders |= {f"ogm, read: {name}": reading(read_by_ogm, path) for name, path in paths.items()}
    contenders |= {f"rosbags, read: {name}": reading(read_by_rosbags, path) for name, path in paths.items()}
    for name in ("MCAP", "MCAP, zstd"):
        contenders[f"mcap-ros2-support, read: {name}"] = reading(read_by_mcap_ros2, paths[name])
        contenders[f"ogm, RayISM, map, written: {name}"] = mapping(paths[name], folder / "maps.mcap")
    times = measure(contenders, rounds)
    per_scan = {name: one.median / scans for name, one in times.items()}
    longer = folder / "longer.mcap"
    write_log(longer, "", 4 * scans)
    memory = {str(scans): reading_memory(paths["MCAP"]), str(4 * scans): reading_memory(longer)}
    written = 1e3 / per_scan["ogm, RayISM, map, written: MCAP"]
    rows = [
        ("read a scan of a plain MCAP", per_scan["ogm, read: MCAP"], "<=", 12.0, "ms"),
        ("MCAP to a written map", written, ">=", 25.0, "scans/s"),
    ]
    return {
        "scans": scans,
        "points": POINTS,
        "times [ms]": times,
        "times per scan [ms]": per_scan,
        "peak memory by number of scans [MB]": memory,
        "verdicts": run.verdicts(rows),
    }


def main() -> None:
    parser = run.Parser(__doc__, picture=True, quick=True, rounds=5)
    parser.add_argument("--scans", type=int, default=80)
    given = parser.parse_args()
    found = run.environment("ray", "cautious")
    with tempfile.TemporaryDirectory() as folder:
        figures = measured(Path(folder), *((5, 1) if given.quick else (given.scans, given.rounds)))
    record = {"environment": found, **figures}
    run.write_record(given.out, record)
    figure = Figure(figsize=(10, 4.6), layout="constrained")
    colours = {name: PEER for name in figures["times [ms]"] if not name.startswith("ogm")}
    draw_times(figure.subplots(), figures["times per scan [ms]"], colours, "one scan of 120,000 points")
    save_picture(figure, given.picture, caption(found))


if __name__ == "__main__":
    main()
