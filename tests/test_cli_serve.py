"""``ogm serve``: a drive and a log that play, scans from a driver, signals, and what it refuses."""

import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from cases import each
from click.testing import Result
from commands import ogm
from foxglove_client import Client, grid_fields

from ogm import Scan
from ogm.io.logs import LogWriter
from ogm.io.messages import StampedTransform, point_cloud2, tf_message
from ogm.live.stream import frame_bytes
from ogm.pose import inverse, pose, transform_points

ROOT = Path(__file__).parents[1]
HEIGHT = 1.8
SMALL = ("--sensor-height", HEIGHT, "--length", 20, "--width", 20, "--resolution", 0.25)


def serve(*words: object) -> Result:
    return ogm("serve", *words)


def scan_at(T: np.ndarray) -> np.ndarray:
    """Return what a sensor at some place sees of the ground and of a wall at x = 8 m."""
    rng = np.random.default_rng(0)
    ground, wall = rng.uniform(-8, 8, (6000, 4)), rng.uniform(-8, 8, (2000, 4))
    ground[:, 2], wall[:, 0], wall[:, 2] = 0.0, 8.1, rng.uniform(0, 2, len(wall))
    points = np.concatenate([ground, wall])
    points[:, 3] = 0.5
    return transform_points(inverse(T), points).astype(np.float32)


def pose_at(k: int) -> np.ndarray:
    return pose(0.05 * (k % 20), 0.1, HEIGHT, yaw=0.02 * (k % 20))


@pytest.fixture(scope="session")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """KITTI odometry of 40 s, of 20 scans again and again."""
    folder = tmp_path_factory.mktemp("drive")
    (folder / "velodyne").mkdir()
    for k in range(400):
        path = folder / "velodyne" / f"{k:06d}.bin"
        if k < 20:
            scan_at(pose_at(k)).tofile(path)
        else:
            path.symlink_to(folder / "velodyne" / f"{k % 20:06d}.bin")
    np.savetxt(folder / "poses.txt", [pose_at(k)[:3].ravel() for k in range(400)])
    np.savetxt(folder / "times.txt", 0.1 * np.arange(400))
    return folder


def counts(text: str) -> tuple[int, int, int]:
    """Return how many scans were mapped, dropped and failed by the last line."""
    mapped, dropped, failed = re.findall(r"(\d+) mapped, (\d+) dropped, (\d+) failed; latency p50 ", text)[-1]
    return int(mapped), int(dropped), int(failed)


def test_a_drive_plays_to_its_end(drive: Path) -> None:
    before = signal.getsignal(signal.SIGTERM)
    result = serve(drive, "--first", 8, "--rate", 2, "--port", 0, "--report-every", 0.2, *SMALL)
    assert result.exit_code == 0
    mapped, dropped, failed = counts(result.stdout)
    assert (mapped + dropped, failed) == (8, 0)
    assert mapped > 4
    assert re.search(r"serving /map, /points and /tf at ws://127.0.0.1:\d+; Ctrl-C stops", result.stdout)
    assert result.stderr.count("latency p50") >= 1
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)])
def test_a_viewer_sees_the_map_until_a_signal_stops_it(drive: Path, number: int) -> None:
    command = [sys.executable, "-m", "ogm.cli", "serve", str(drive), "--port", "0", *map(str, SMALL)]
    command += ["--inflation-radius", "1", "--inscribed-radius", "0.3"]
    pipes: dict = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=ROOT, env={**os.environ, "COLUMNS": "200"}, **pipes) as process:
        try:
            assert process.stdout is not None
            port = next(int(found[1]) for line in process.stdout if (found := re.search(r"ws://127.0.0.1:(\d+)", line)))
            with Client(port, ("/map",)) as client:
                grid = [client.receive(30) for _ in range(3)][-1].message
            fields = grid_fields(grid)
            x, y = (np.array([8.1, 1.0]) - [grid.pose.position.x, grid.pose.position.y]).tolist()
            assert fields["occupied"][int(x / 0.25), int(y / 0.25)] > 0.5  # the wall
            assert fields["cost"][int(x / 0.25), int(y / 0.25)] == 254
            assert fields["free"][int((x - 4) / 0.25), int(y / 0.25)] > 0.5  # the way to it
            with socket.create_connection(("127.0.0.1", port)):  # a client that sends nothing
                process.send_signal(number)
                stdout, stderr = process.communicate(timeout=5)
        finally:
            process.kill()
    assert process.returncode == 0, stderr
    mapped, _, failed = counts(stdout)
    assert mapped >= 3
    assert failed == 0
    assert "Traceback" not in stderr
    with socket.create_server(("127.0.0.1", port)):
        pass


HANGS = """
import sys, time
import ogm.live

class Hangs(ogm.live.FoxglovePublisher):
    def __call__(self, *arguments):
        print("now", flush=True)
        time.sleep(300)

ogm.live.FoxglovePublisher = Hangs
from ogm.cli import main
main()
"""


@pytest.mark.slow
def test_a_second_signal_ends_it_at_once(drive: Path) -> None:
    command = [sys.executable, "-c", HANGS, "serve", str(drive), "--port", "0", *map(str, SMALL)]
    pipes: dict = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=ROOT, **pipes) as process:
        try:
            assert process.stdout is not None
            assert any(line == "now\n" for line in process.stdout)
            process.send_signal(signal.SIGINT)
            with pytest.raises(subprocess.TimeoutExpired):  # it waits for the scan that is being mapped
                process.wait(0.5)
            process.send_signal(signal.SIGTERM)
            assert process.wait(2) == 130
        finally:
            process.kill()


@each("suffix", [".mcap", ".db3"])
def test_a_log_plays(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"drive{suffix}"
    lidars = {"front": pose(z=HEIGHT)}
    if suffix == ".db3":
        lidars["rear"] = pose(-1.0, 0.0, HEIGHT, yaw=np.pi)
    with LogWriter(path) as log:
        mounted = [StampedTransform("base_link", name, 100.0, T) for name, T in lidars.items()]
        log.write("/tf_static", "tf2_msgs/msg/TFMessage", tf_message(mounted), 100.0)
        for k in range(6):
            stamp, T_odom_base = 100.0 + 0.1 * k, pose_at(k) @ pose(z=-HEIGHT)
            moved = StampedTransform("odom", "base_link", stamp, T_odom_base)
            log.write("/tf", "tf2_msgs/msg/TFMessage", tf_message([moved]), stamp)
            for name, T in lidars.items():
                cloud = point_cloud2(Scan(scan_at(T_odom_base @ T)), frame_id=name, stamp=stamp)
                log.write(f"/{name}", "sensor_msgs/msg/PointCloud2", cloud, stamp)
    topics = [word for name in lidars for word in ("--topic", f"/{name}")]
    result = serve(path, *topics, "--frame", "odom", "--port", 0, *SMALL[2:])
    assert result.exit_code == 0, result.stderr
    mapped, dropped, failed = counts(result.stdout)
    assert (mapped + dropped, failed) == (6 * len(lidars), 0)
    assert mapped >= 3


def test_scans_of_a_driver_are_mapped() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]

    def driver() -> None:
        until = time.monotonic() + 20
        while time.monotonic() < until:
            with suppress(ConnectionRefusedError), socket.create_connection(("127.0.0.1", port), 5) as connection:
                for k in range(5):
                    scan = Scan(scan_at(pose_at(k)), stamp=50 + 0.1 * k)
                    connection.sendall(frame_bytes(scan, pose_at(k)))
                    time.sleep(0.1)
                return
            time.sleep(0.02)

    thread = threading.Thread(target=driver)
    thread.start()
    result = serve("--listen", port, "--duration", 2, "--port", 0, *SMALL)
    thread.join()
    assert result.exit_code == 0, result.stderr
    mapped, dropped, failed = counts(result.stdout)
    assert (mapped + dropped, failed) == (5, 0)
    assert f"receiving scans at 127.0.0.1:{port}" in result.stderr
    assert "ended after 5 scans: closed by the sender" in result.stderr


def test_damaged_scans_are_skipped_with_a_line_and_exit_code_2(drive: Path, tmp_path: Path) -> None:
    (tmp_path / "velodyne").mkdir()
    for k in range(4):
        (tmp_path / "velodyne" / f"{k:06d}.bin").write_bytes((drive / "velodyne" / f"{k:06d}.bin").read_bytes())
    (tmp_path / "velodyne" / "000000.bin").write_bytes(b"cut")
    for name in ("poses.txt", "times.txt"):
        (tmp_path / name).write_text("".join((drive / name).read_text().splitlines(keepends=True)[:4]))
    result = serve(tmp_path, "--port", 0, *SMALL)
    assert result.exit_code == 2
    assert counts(result.stdout)[2] == 1
    assert "000000 is skipped: " in result.stderr


def test_what_makes_no_sense_is_refused_in_one_line(drive: Path, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as busy:
        port = busy.getsockname()[1]
        refused = {
            (): "give either SCANS to play, or --listen",
            (drive, "--listen", 0): "give either SCANS to play, or --listen",
            ("--listen", 0): "--listen needs --sensor-height",
            ("--listen", 0, "--sensor-height", 2, "--rate", 1): "excludes --rate",
            ("--listen", "here", "--sensor-height", 2): "--listen must be PORT or HOST:PORT",
            ("--listen", 70000, "--sensor-height", 2): "--listen must be PORT or HOST:PORT",
            ("--listen", port, "--sensor-height", 2): f"--listen cannot listen at {port}: .*in use",
            (drive, "--port", port, *SMALL): f"cannot serve at 127.0.0.1:{port}: ",
            (drive, "--port", 70000, *SMALL): "port must be from 0",
            (drive, "--port", 0, "--rate", 0, *SMALL): "rate must be above 0",
            (drive, "--port", 0, "--duration", -1, *SMALL): "duration must be above 0 s",
            (drive, "--rule", "none", *SMALL): "there is no rule",
            (drive, "--rule", "bayes", "--layers", "cause", *SMALL): "--layers takes cause, for evidential maps",
            (drive / "velodyne", *SMALL): "the scans have no poses",
            (tmp_path / "nothing.mcap",): "there is no",
        }
        for words, line in refused.items():
            result = serve(*words)
            assert result.exit_code == 2, words
            (told,) = (text for text in result.stderr.splitlines() if not text.startswith("sensor model ray: "))
            assert re.match(f"ogm: .*{line}", told), (words, result.stderr)
