"""Does `ogm serve` keep up with a lidar of 10 Hz for minutes: latency, dropped scans and memory of two models.

    python benchmarks/live.py [--minutes N] [--mcap] [--drive DATASET] [--out FILE] [--picture FILE]

The command runs in a process of its own; an independent viewer (websockets) in this one receives all that it
publishes. The drive is 24 KITTI scans, forwards and backwards again and again, as files or as one MCAP; or `--drive`,
with poses in it. Writes benchmarks/results/live.json and docs/pictures/live.png.
"""

import os

os.environ["OGM_CORES"] = "2"  # before _run, which pins to one core otherwise
import _run as run  # first: it sets the number of threads

# isort: split
import contextlib
import json
import math
import re
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from _charts import OURS, PEER, TWIN, caption, save_picture
from _timing import resident
from matplotlib.figure import Figure
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from ogm import open_dataset
from ogm.datasets import Dataset
from ogm.io.logs import LogWriter
from ogm.io.messages import StampedTransform, point_cloud2, tf_message
from ogm.pose import inverse, pose

RATE = 10.0  # [Hz]
ISMS = ("combined", "ray")  # the default model, and the fastest
SETTLED = 15.0  # [s] after which the last 64 scans are in memory, and memory must not grow any more
TOPICS = ("/tf", "/points", "/map")
LINE = re.compile(
    r"(\d+) s: (\d+) mapped, (\d+) dropped, (\d+) failed; latency p50 ([\d.]+) ms, p99 ([\d.]+) ms, worst ([\d.]+) ms"
)
NAMES = ("seconds", "mapped", "dropped", "failed", "p50 [ms]", "p99 [ms]", "worst [ms]")


def there_and_back(count: int, scans: int) -> Iterator[int]:
    """Yield `count` numbers: 0 to the last scan and back, again and again."""
    for k in range(scans):
        yield min(k % (2 * count - 2), (2 * count - 2) - k % (2 * count - 2))


def drive_of_files(folder: Path, dataset: Dataset, scans: int) -> Path:
    """Write KITTI odometry of many scans, which are links to few files."""
    (folder / "velodyne").mkdir(parents=True)
    for k, frame in enumerate(dataset):
        frame.scan.points.tofile(folder / f"{k}.bin")
    order = list(there_and_back(len(dataset), scans))
    for k, n in enumerate(order):
        (folder / "velodyne" / f"{k:06d}.bin").symlink_to(folder / f"{n}.bin")
    np.savetxt(folder / "poses.txt", [dataset.refs[n].T_map_sensor[:3].ravel() for n in order])
    np.savetxt(folder / "times.txt", np.arange(scans) / RATE)
    return folder


def drive_of_messages(folder: Path, dataset: Dataset, scans: int) -> Path:
    """Write the same as PointCloud2 and tf into one MCAP: 2 MB a scan."""
    height = dataset[0].mount.sensor_height
    frames = list(dataset)
    with LogWriter(folder / "drive.mcap") as log:
        mounted = StampedTransform("base_link", "velodyne", 1.0, pose(z=height))
        log.write("/tf_static", "tf2_msgs/msg/TFMessage", tf_message([mounted]), 1.0)
        for k, n in enumerate(there_and_back(len(dataset), scans)):
            stamp, T = 1 + k / RATE, frames[n].T_map_sensor @ inverse(pose(z=height))
            moved = StampedTransform("map", "base_link", stamp, T)
            log.write("/tf", "tf2_msgs/msg/TFMessage", tf_message([moved]), stamp)
            cloud = point_cloud2(frames[n].scan, frame_id="velodyne", stamp=stamp)
            log.write("/points", "sensor_msgs/msg/PointCloud2", cloud, stamp)
    return folder / "drive.mcap"


class Viewer(threading.Thread):
    """Receives all that a server publishes, until it stops; or for `stay` seconds, again and again, as long apart."""

    def __init__(self, port: int, stay: float = math.inf) -> None:
        super().__init__()
        self.port, self.stay, self.count, self.bytes = port, stay, Counter[str](), 0
        self.maps: list[float] = []  # when they came [s]
        self.connections = 0

    def run(self) -> None:
        """Connect until there is no server any more."""
        with contextlib.suppress(OSError, EOFError):
            while self.receive():
                time.sleep(self.stay)

    def receive(self) -> bool:
        """Receive, and decode nothing; return whether the server is still there."""
        url = f"ws://127.0.0.1:{self.port}"
        with connect(url, subprotocols=["foxglove.sdk.v1"], max_size=None, compression=None) as socket:
            self.connections += 1
            until = time.monotonic() + self.stay
            channels: dict[str, int] = {}
            while not channels.keys() >= set(TOPICS):
                event = json.loads(socket.recv())
                channels |= {one["topic"]: one["id"] for one in event.get("channels", ())}
            wanted = [{"id": k, "channelId": channels[topic]} for k, topic in enumerate(TOPICS)]
            socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
            try:
                while time.monotonic() < until:
                    data = socket.recv()
                    if isinstance(data, bytes) and data[0] == 1:
                        topic = TOPICS[int.from_bytes(data[1:5], "little")]
                        self.count[topic] += 1
                        self.bytes += len(data)
                        if topic == "/map":
                            self.maps.append(time.monotonic())
            except (ConnectionClosed, EOFError):
                return False
        return True


def observe(drive: Path, seconds: float, stay: float = math.inf, ism: str = "combined") -> dict[str, Any]:
    """Run the command on a drive with a viewer that may come and go; return what it printed and its process took."""
    every = f"{max(5.0, seconds / 120):g}"
    words = ["serve", str(drive), "--ism", ism, "--port", "0", "--duration", f"{seconds:g}", "--report-every", every]
    command = [sys.executable, "-m", "ogm.cli", *words]
    environment = {**os.environ, "COLUMNS": "200"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=run.ROOT, env=environment, **pipes) as process:
        lines: list[str] = []
        reader = threading.Thread(target=lambda: lines.extend(process.stderr))
        reader.start()
        found = (re.search(r"ws://127\.0\.0\.1:(\d+)", line) for line in process.stdout)
        port = next((int(one[1]) for one in found if one), None)
        if port is None:
            reader.join()
            raise SystemExit("".join(lines))
        viewer, start, memory, handles = Viewer(port, stay), time.monotonic(), [], []
        viewer.start()
        watched = psutil.Process(process.pid)
        while process.poll() is None:
            with contextlib.suppress(psutil.Error):  # it may have ended
                used, at = watched.cpu_times(), time.monotonic() - start
                handles.append((at, watched.num_fds(), watched.num_threads(), used.user + used.system))
                memory.append((at, resident(process.pid)))
            time.sleep(1.0)
        last = process.stdout.read()
        reader.join()
    viewer.join()
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    reports = [dict(zip(NAMES, map(float, one), strict=True)) for one in LINE.findall("".join(lines))]
    memory = [(at, mb) for at, mb in memory if mb][:-2]  # without those of its end
    settled = [mb for at, mb in memory if at > SETTLED] or [mb for _, mb in memory]
    tenth = max(len(settled) // 10, 1)
    return {
        "result": dict(zip(NAMES, map(float, LINE.findall(last)[-1]), strict=True)),
        "reports": reports,
        "memory at start [MB]": float(np.median(settled[:tenth])),
        "memory at end [MB]": float(np.median(settled[-tenth:])),
        "memory [s, MB]": [(round(at, 1), round(mb, 1)) for at, mb in memory],
        "handles [s, files, threads, processor s]": handles[:-2],
        "process time [s]": round(used.ru_utime + used.ru_stime, 1),
        "viewer": {
            "messages": dict(viewer.count),
            "connections": viewer.connections,
            "MB/s": round(viewer.bytes / 1e6 / seconds, 1),
            "longest time between maps [ms]": round(1e3 * float(np.diff(viewer.maps).max(initial=0.0)), 1),
        },
    }


def verdicts(models: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    rows: list[tuple[str, float, str, float, str]] = []
    for ism, found in models.items():
        result, grown = found["result"], found["memory at end [MB]"] - found["memory at start [MB]"]
        rows += [
            (f"`{ism}`: scans mapped per second", result["mapped"] / result["seconds"], ">=", 0.99 * RATE, ""),
            (f"`{ism}`: p99 of the latency", result["p99 [ms]"], "<=", 100.0, "ms"),
            (f"`{ism}`: dropped scans", result["dropped"], "<=", 0.0, ""),
            (f"`{ism}`: failed scans", result["failed"], "<=", 0.0, ""),
            (f"`{ism}`: memory grown", grown, "<=", 10.0, "MB"),
        ]
    return run.verdicts(rows)


def picture(record: Mapping[str, Any], path: Path) -> None:
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for (ism, found), style in zip(record["models"].items(), ("-", "--"), strict=True):
        at = [report["seconds"] for report in found["reports"]]
        for name, colour in (("p50 [ms]", OURS), ("p99 [ms]", PEER), ("worst [ms]", TWIN)):
            latencies = [report[name] for report in found["reports"]]
            left.plot(at, latencies, style, color=colour, lw=1.2, label=f"{ism}, {name.split()[0]}")
        right.plot(*zip(*found["memory [s, MB]"], strict=True), style, color=OURS, lw=1.2, label=ism)
    left.axhline(100, color="0.4", lw=0.8, ls=":")
    left.set(xlabel="time [s]", ylabel="latency so far [ms]", ylim=(0, None), title="due to published")
    for axes in (left, right):
        axes.legend(frameon=False, fontsize=8)
    right.set(xlabel="time [s]", ylabel="memory of ogm serve [MB]", ylim=(0, None), title="resident memory")
    save_picture(figure, path, caption(record["environment"]))


def main() -> None:
    parser = run.Parser(__doc__, picture=True)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--mcap", action="store_true", help="play it from one MCAP; needs 1.2 GB a minute on disk")
    parser.add_argument("--drive", type=Path, help="a data set or a log with poses in it, at least as long")
    given = parser.parse_args()
    record, seconds = {"environment": run.environment(*ISMS, "revise")}, 60 * given.minutes
    with tempfile.TemporaryDirectory(prefix="ogm-live-") as folder:
        drive = given.drive
        if drive is None:
            write = drive_of_messages if given.mcap else drive_of_files
            dataset = open_dataset(run.DATA / "kitti_raw_0005")
            drive = write(Path(folder), dataset, int((seconds + 30) * RATE))  # more than will be played
        models = {ism: observe(drive, seconds, ism=ism) for ism in ISMS}
    record |= {
        "drive": "kitti_raw_0005, 24 scans there and back" if given.drive is None else given.drive.name,
        "from": "MCAP" if given.mcap else "files" if given.drive is None else "drive",
        "models": models,
        "verdicts": verdicts(models),
    }
    run.write_record(given.out, record)
    picture(record, given.picture)


if __name__ == "__main__":
    main()
