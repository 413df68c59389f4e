"""Many drives: a folder for each that is whole or not there, whoever is killed."""

import json
import os
import signal
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import refused

from ogm.pose import pose
from ogm.scan import Frame, Mount, Scan
from ogm.storage.files import OgmError
from ogm.workflows import FusedDrive, drives, fuse_drives


def frame(name: str, k: int) -> Frame:
    return Frame(Scan(np.zeros((0, 4), np.float32)), Mount(1.0), None, None, pose(k), float(k), f"{name} {k}")


DRIVES = {name: [frame(name, k) for k in range(3)] for name in "abcde"}


@dataclass(frozen=True)
class Names:
    """Writes the names of the frames; at a drive its process is killed or it fails, once."""

    option: int = 1
    dies: str = field(default="", repr=False)
    fails: str = field(default="", repr=False)
    marker: str = field(default="", repr=False)

    def __call__(self, frames: Sequence[Frame], folder: Path) -> dict[str, Any]:
        drive = frames[0].name[0]
        (folder / "names.txt").write_text(" ".join(one.name for one in frames))
        if drive in (self.dies, self.fails) and not os.path.exists(self.marker):
            Path(self.marker).touch()
            if drive == self.dies:
                os.kill(os.getpid(), signal.SIGKILL)
            raise ValueError("a bad drive")
        return {"frames": len(frames)}


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def fused(folder: Path, how: Names = Names(), **options: Any) -> dict[str, FusedDrive]:  # noqa: B008
    return {one.name: one for one in fuse_drives(DRIVES, how, folder, **options)}


def test_a_drive_that_is_finished_is_not_fused_again(tmp_path: Path) -> None:
    marker = str(tmp_path / "marker")
    found = fused(tmp_path / "out", Names(fails="c", marker=marker))
    assert found["c"] == FusedDrive("c", {}, "a bad drive")
    assert found["d"] == FusedDrive("d", {"frames": 3})
    assert sorted(os.listdir(tmp_path / "out")) == ["a", "b", "d", "e"]
    again = fused(tmp_path / "out", Names(fails="c", marker=marker))
    assert {name for name, one in again.items() if one.reused} == set("abde")
    assert not any(one.error for one in again.values())
    assert (tmp_path / "out" / "c" / "names.txt").read_text() == "c 0 c 1 c 2"
    refused("of other frames or options", fused, tmp_path / "out", Names(option=2), error=OgmError)


def test_what_was_not_fused_here_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    refused("no result of this command", fused, tmp_path, error=OgmError)
    (tmp_path / "b" / "drive.json").write_text("[1")
    refused("cannot be read", fused, tmp_path, error=OgmError)
    (tmp_path / "b" / "drive.json").write_text(json.dumps({"format": "ogm.fused/9", "key": "", "facts": {}}))
    refused("frames or options", fused, tmp_path, error=OgmError)
    refused("must be a valid folder name", list, fuse_drives({"../a": DRIVES["a"]}, Names(), tmp_path))


class Drive(list[Frame]):
    """Frames that can be pickled: their refs alone."""

    def __reduce__(self) -> Any:
        return Drive.named, (self[0].name[0],)

    @staticmethod
    def named(name: str) -> "Drive":
        return Drive(DRIVES[name])


def test_two_workers_give_the_files_of_one_though_one_is_killed(tmp_path: Path) -> None:
    drives = {name: Drive(frames) for name, frames in DRIVES.items()}
    one = list(fuse_drives(drives, Names(), tmp_path / "one"))
    dies = Names(dies="b", marker=str(tmp_path / "marker"))
    two = list(fuse_drives(drives, dies, tmp_path / "two", workers=2))
    assert (tmp_path / "marker").exists()
    assert sorted(two) == one
    assert contents(tmp_path / "two") == contents(tmp_path / "one")


def test_what_a_worker_finished_before_it_died_is_taken(tmp_path: Path) -> None:
    task, job = drives._Task(Names(), tmp_path), drives._Job("a", "key", DRIVES["a"])
    assert task(job) == task(job) == FusedDrive("a", {"frames": 3})


@pytest.mark.slow
def test_a_dask_cluster_gives_the_same_files(tmp_path: Path) -> None:
    from distributed import LocalCluster

    drives = {name: Drive(frames) for name, frames in DRIVES.items()}
    list(fuse_drives(drives, Names(), tmp_path / "one"))
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        list(fuse_drives(drives, Names(), tmp_path / "two", scheduler=cluster.scheduler_address))
    assert contents(tmp_path / "two") == contents(tmp_path / "one")
