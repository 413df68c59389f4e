"""Signals end commands with a line and a status; full disks and files that change while they are read are errors."""

import errno
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from cases import each, refused

from ogm.datasets import open_dataset
from ogm.grid import EvidentialGrid, GridSpec
from ogm.io.grids.files import write_grid
from ogm.io.grids.logged import GridLog
from ogm.io.grids.placed import PlacedGrid
from ogm.io.logs import LogWriter, open_log
from ogm.io.messages import StampedTransform, tf_message
from ogm.storage.files import OgmError

WAITS = """
import sys, time
import ogm.io.grids.files

def wait(*_, **__):
    from ogm.storage.files import atomic_write

    with atomic_write("map.tif") as file:
        file.write(b"half")
        print("now", flush=True)
        time.sleep(300)

ogm.io.grids.files.write_grid = wait
sys.argv = ["ogm", "convert", "map.npz", "map.tif"]
from ogm.cli import main
main()
"""


def grid(seed: int = 0) -> EvidentialGrid:
    spec, rng = GridSpec(0.5, (40, 30), (-10.0, -7.5)), np.random.default_rng(seed)
    free = rng.uniform(0, 0.6, spec.shape)
    return EvidentialGrid(spec, np.stack([free, 0.9 * (1 - free)], -1).astype(np.float32))


# ---- signals


@pytest.mark.parametrize(
    ("sent", "status"), [([signal.SIGINT], 130), ([signal.SIGTERM], 143), ([signal.SIGTERM, signal.SIGTERM], 143)]
)
def test_a_signal_ends_a_command_with_one_line_and_nothing_half_done(
    tmp_path: Path, sent: list[signal.Signals], status: int
) -> None:
    grid().save(tmp_path / "map.npz")
    (tmp_path / "map.tif").write_bytes(b"old")
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", WAITS], cwd=tmp_path, **pipes) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "now\n"
        for number in sent:  # `timeout` sends its signal twice
            child.send_signal(number)
        _, errors = child.communicate(timeout=60)
    assert child.returncode == status
    assert errors == "ogm: interrupted; finished files are complete, no other was written\n"
    assert (tmp_path / "map.tif").read_bytes() == b"old"
    assert sorted(os.listdir(tmp_path)) == ["map.npz", "map.tif"]


# ---- a full disk


@contextmanager
def file_size_limit(size: int) -> Iterator[None]:
    """Let files grow to a size only [byte]: beyond it, writing fails as on a full disk."""
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@each("ending", [".npz", ".yaml", ".tif", ".nc", ".zarr", ".png", ".mcap", ".db3", ".bag"])
def test_a_full_disk_is_an_error_that_names_the_file_and_leaves_the_earlier_one(tmp_path: Path, ending: str) -> None:
    folder = tmp_path / ending
    folder.mkdir()
    path = folder / f"map{ending}"
    write_grid(path, PlacedGrid(grid(0)))
    before = contents(folder)
    for room in (0, 100, 3000):
        if max(len(data) for data in before.values()) <= room:
            continue
        with file_size_limit(room), pytest.raises(OSError, match=f"map{ending}|map.pgm") as caught:
            write_grid(path, PlacedGrid(grid(1)))
        assert caught.value.errno in (errno.EFBIG, errno.EIO, errno.ENOSPC)
        assert caught.value.filename in (str(path), str(path.with_suffix(".pgm")))
        assert contents(folder) == before, room


@each("ending", [".mcap", ".db3", ".bag"])
def test_a_disk_that_fills_while_a_log_is_written(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"maps{ending}"

    def write() -> None:
        with GridLog(path) as log:
            for k in range(100):
                log.write(PlacedGrid(grid(k), stamp=float(k)))

    with file_size_limit(20_000), pytest.raises(OSError, match=f"maps{ending}"):
        write()
    assert not os.listdir(tmp_path)


# ---- files that change while they are read


@each("ending", [".mcap", ".db3", ".bag"])
@each("change", ["cut", "gone"])
def test_of_a_log_that_is_cut_or_gone_while_it_is_read_no_message_is_lost_in_silence(
    tmp_path: Path, ending: str, change: str
) -> None:
    path = tmp_path / f"{change}{ending}"
    with LogWriter(path) as log:
        for k in range(1500):
            T = np.eye(4)
            T[0, 3] = k
            log.write("/tf", "tf2_msgs/msg/TFMessage", tf_message([StampedTransform("map", "car", k, T)]), k)
    with open_log(path) as reader:
        messages = iter(reader.messages())
        next(messages)
        if change == "cut":
            os.truncate(path, 5000)
        else:
            path.unlink()
        count = 1 + sum(1 for _ in messages)
    if count != 1500:  # an open file stays readable
        assert change == "cut"
        lost = [int(line.split()[0]) for line in reader.warnings if str(path) in line]
        assert count + sum(lost) == 1500


def test_scans_that_are_cut_or_gone_after_a_folder_was_opened_are_errors(tmp_path: Path) -> None:
    for k in range(3):
        np.ones((50, 4), np.float32).tofile(tmp_path / f"{k:06d}.bin")
    dataset = open_dataset(tmp_path, sensor_height=1.8)
    (tmp_path / "000001.bin").unlink()
    os.truncate(tmp_path / "000002.bin", 77)
    assert len(dataset[0].scan) == 50
    refused("000001.bin", lambda: dataset[1].scan, error=FileNotFoundError)
    refused("000002.bin", lambda: dataset[2].scan, error=OgmError)


LOST = """
import os, signal, time, weakref
from ogm.cli.interrupts import watch_signals

class Node:
    pass

watch_signals()
node = Node()
reference = weakref.ref(node, lambda _: os.kill(os.getpid(), signal.SIGINT) or [None for _ in range(100)])
try:
    del node  # the interrupt is raised in the callback, whose errors are lost
    time.sleep(60)
except KeyboardInterrupt:
    print("interrupted")
"""


def test_an_interrupt_in_a_callback_is_not_lost() -> None:
    done = subprocess.run([sys.executable, "-c", LOST], capture_output=True, text=True, timeout=50)
    assert done.stdout == "interrupted\n", done.stderr
