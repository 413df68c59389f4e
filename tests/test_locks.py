"""One process writes to a folder at a time; what killed ones left is swept, and nothing of those that run."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from cases import each

import ogm.storage.files
from ogm.storage import locks
from ogm.storage.files import atomic_write, temporary_folder
from ogm.storage.locks import locked, sweep
from ogm.storage.whole_path import whole_path

pytestmark = pytest.mark.skipif(locks.fcntl is None, reason="this system has no flock")

HOLDS = """
import os, sys
from ogm.storage.locks import locked
with locked(sys.argv[1]):
    if os.fork() == 0:  # as loaders of training data are
        print("now", flush=True)
    sys.stdin.read()
"""
WRITES = """
import os, sys
from pathlib import Path
import ogm.storage.files
if sys.argv[2] == "named" and hasattr(os, "O_TMPFILE"):
    del os.O_TMPFILE
folder = Path(sys.argv[1])
with ogm.storage.files.atomic_write(folder / "a.bin") as file, ogm.storage.files.temporary_folder(folder) as work:
    file.write(b"half")
    (work / "b").write_bytes(b"half")
    print("now", flush=True)
    sys.stdin.read()
"""


class Other:
    """Another process, which has come to its "now"."""

    def __init__(self, code: str, *words: object) -> None:
        command = [sys.executable, "-c", code, *map(str, words)]
        self.child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def __enter__(self) -> subprocess.Popen:
        assert self.child.stdout is not None
        assert self.child.stdout.readline() == "now\n"
        return self.child

    def __exit__(self, *error: object) -> None:
        self.child.kill()
        self.child.wait()
        for pipe in (self.child.stdin, self.child.stdout):  # its fork ends with its input
            assert pipe is not None
            pipe.close()


def test_a_folder_has_one_writer_and_a_kill_frees_it_though_a_fork_lives(tmp_path: Path) -> None:
    with Other(HOLDS, tmp_path) as child:
        with (
            pytest.raises(BlockingIOError, match="another process is writing to this folder") as caught,
            locked(tmp_path),
        ):
            pass
        assert caught.value.filename == str(tmp_path)
        child.send_signal(signal.SIGKILL)
        child.wait()
        with locked(tmp_path):  # at once: its fork, which still waits for input, does not hold the lock
            assert not os.listdir(tmp_path)
            with pytest.raises(BlockingIOError), locked(tmp_path):
                pass
    with locked(tmp_path):
        pass


def test_what_a_killed_process_left_is_swept_by_the_next_that_writes(tmp_path: Path) -> None:
    with Other(WRITES, tmp_path, "named") as child:
        assert len(os.listdir(tmp_path)) == 2
        child.kill()
        child.wait()
        assert len(os.listdir(tmp_path)) == 2
        with atomic_write(tmp_path / "c.bin") as file:
            file.write(b"c")
    assert os.listdir(tmp_path) == ["c.bin"]


@each("kind", ["named", "unnamed"])
def test_what_a_running_process_writes_is_not_swept(tmp_path: Path, kind: str) -> None:
    (tmp_path / ".ogm-0123456789abcdef.tmp").write_bytes(b"of a killed one")
    (tmp_path / ".ogm-mine.tmp").write_bytes(b"of someone else")
    with Other(WRITES, tmp_path, kind) as child:
        sweep(tmp_path)
        assert not (tmp_path / ".ogm-0123456789abcdef.tmp").exists()
        assert child.stdin is not None
        child.stdin.close()
        assert child.wait() == 0
    assert sorted(os.listdir(tmp_path)) == [".ogm-mine.tmp", "a.bin"]
    assert (tmp_path / "a.bin").read_bytes() == b"half"


def test_without_locks_only_what_is_old_is_swept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(22, "no locks here")

    monkeypatch.setattr(locks.fcntl, "flock", refuse)
    old, new = (tmp_path / f".ogm-{k:016x}.tmp" for k in range(2))
    for path in (old, new):
        path.mkdir()
    os.utime(old, (time.time() - 2 * locks.MAX_AGE,) * 2)
    sweep(tmp_path)
    assert os.listdir(tmp_path) == [new.name]
    with locked(tmp_path), locked(tmp_path):  # nothing is locked
        pass


def test_a_temporary_folder_is_made_again_if_another_process_sweeps_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    swept = []

    def sweeps(folder: Path) -> object:
        if not swept:
            swept.append(folder)
            folder.rmdir()
        return locked(folder)

    monkeypatch.setattr(ogm.storage.files, "locked", sweeps)
    with temporary_folder(tmp_path) as folder:
        assert folder.is_dir()
        assert folder != swept[0]
    assert not os.listdir(tmp_path)


@each("exchange", [True, False])
def test_a_folder_takes_the_place_of_another_whole(
    tmp_path: Path, exchange: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not exchange:
        monkeypatch.setattr("ctypes.CDLL", lambda *_, **__: object())
    path = tmp_path / "m.zarr"
    for text in ("old", "new"):
        with whole_path(path) as temporary:
            temporary.mkdir()
            (temporary / text).write_text(text)
    assert os.listdir(path) == ["new"]
    assert os.listdir(tmp_path) == ["m.zarr"]
