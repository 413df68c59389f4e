"""Making data sets: what is finished stays, whoever is killed; and the bytes are the plan's alone."""

import errno
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pytest
from cases import each, refused
from stand_in import BEAMS, stand_in

from ogm.simulation import workers
from ogm.simulation.mounts import LidarMount
from ogm.simulation.plan import DatasetPlan
from ogm.simulation.sample import SimulatedSample
from ogm.simulation.store import Store
from ogm.simulation.workers import Estimate, Made, begin, make_shards, missing_shards
from ogm.storage import workers as processes

PLAN = DatasetPlan(samples=23, validation=4, test=1, mounts=(LidarMount("small"), LidarMount("tall")))
FOLDERS = [str(Path(__file__).parents[k]) for k in (0, 1)]  # of modules that other processes import
SampleFunction = Callable[[DatasetPlan, str, int, int], SimulatedSample]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def run(path: Path, function: SampleFunction = stand_in, plan: DatasetPlan = PLAN) -> list:
    store = begin(path, plan, BEAMS, {"ogm": "0"})
    return list(make_shards(store, plan, function, workers=1))


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """All files of the data set, made in one go."""
    folder = tmp_path_factory.mktemp("workers") / "whole"
    run(folder)
    return contents(folder)


def test_an_estimate_comes_first_then_every_shard(tmp_path: Path) -> None:
    estimate, *made = run(tmp_path / "data")
    assert isinstance(estimate, Estimate)
    assert estimate.samples == 28
    assert estimate.seconds == estimate.start_up + 28 * estimate.per_sample  # another town, that of the test
    assert all(isinstance(one, Made) for one in made)
    assert sum(one.job.samples for one in made) == 28
    assert [one.job.split for one in made] == ["training"] * 3 + ["validation", "test"]
    real = sum(one.size for one in made)
    assert real / 3 < estimate.size < 3 * real
    assert missing_shards(Store.open(tmp_path / "data")) == []
    assert run(tmp_path / "data") == []


def test_a_run_that_breaks_is_taken_up_where_it_was(tmp_path: Path, whole: dict[str, bytes]) -> None:
    def breaks(plan: DatasetPlan, split: str, index: int, threads: int) -> SimulatedSample:
        if index == 17:
            raise KeyboardInterrupt
        return stand_in(plan, split, index, threads)

    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "data", breaks)
    assert Store.open(tmp_path / "data")["training"].finished.tolist() == list(range(10))
    asked = []

    def told(plan: DatasetPlan, split: str, index: int, threads: int) -> SimulatedSample:
        asked.append((split, index))
        return stand_in(plan, split, index, threads)

    run(tmp_path / "data", told)
    assert ("training", 3) not in asked
    assert contents(tmp_path / "data") == whole


def test_a_grown_data_set_is_as_one_made_in_one_go(tmp_path: Path, whole: dict[str, bytes]) -> None:
    run(tmp_path / "data", plan=replace(PLAN, samples=4, validation=0))
    run(tmp_path / "data")
    assert contents(tmp_path / "data") == whole


def test_another_plan_is_refused(tmp_path: Path) -> None:
    run(tmp_path / "data", plan=replace(PLAN, samples=1, validation=0))
    before = contents(tmp_path / "data")
    refused("begun with seed = 1, got 2", run, tmp_path / "data", plan=replace(PLAN, seed=2))
    assert contents(tmp_path / "data") == before


KILLED = """
import sys, time
sys.path[:0] = {tests!r}
from stand_in import SMALL, TALL, stand_in
from test_workers import PLAN
from ogm.simulation.workers import begin, make_shards
from ogm.simulation import store

write = store.Store.write
def slow(self, split, shard, samples):
    if shard == 1:
        for name in ("steps", "truth"):  # half a shard, and a file that is being written
            folder = self.path / split / name / "c" / "1"
            folder.mkdir(parents=True)
            (folder / "0.0123.partial").write_bytes(b"half")
        print("now", flush=True)
        time.sleep(60)
    return write(self, split, shard, samples)
store.Store.write = slow
data = begin({path!r}, PLAN, (SMALL, TALL), {{"ogm": "0"}})
list(make_shards(data, PLAN, stand_in, workers=1))
"""


def test_a_killed_run_is_taken_up_where_it_was(tmp_path: Path, whole: dict[str, bytes]) -> None:
    path = tmp_path / "data"
    code = KILLED.format(tests=FOLDERS, path=str(path))
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "now\n"
        child.send_signal(signal.SIGKILL)
    assert list(path.rglob("*.partial"))
    assert Store.open(path)["training"].finished.tolist() == list(range(10))
    run(path)
    assert contents(path) == whole


def test_a_full_disk_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = Store.write

    def full(self: Store, split: str, shard: int, samples: list[SimulatedSample]) -> int:
        if self.path == tmp_path / "data" and shard == 1:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "somewhere")
        return write(self, split, shard, samples)

    monkeypatch.setattr(Store, "write", full)
    refused("is full; finished shards are complete: free disk space.*--resume", run, tmp_path / "data", error=OSError)
    assert Store.open(tmp_path / "data")["training"].finished.tolist() == list(range(10))


def test_what_will_not_fit_is_not_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Usage:
        free = 1000

    monkeypatch.setattr(workers.shutil, "disk_usage", lambda _: Usage)
    refused(r"28 samples need about .* are free; free disk space", run, tmp_path / "data", error=OSError)


@each("workers", [0, -1, 10**6])
def test_impossible_numbers_of_workers_are_reported(tmp_path: Path, workers: int) -> None:
    store = begin(tmp_path / "data", PLAN, BEAMS, {})
    refused("workers must be in 1 ...", next, make_shards(store, PLAN, stand_in, workers=workers))


def test_other_versions_that_go_on_are_named(tmp_path: Path) -> None:
    begin(tmp_path / "data", PLAN, BEAMS, {"ogm": "0", "numpy": "2"})
    for _ in range(2):
        begin(tmp_path / "data", PLAN, BEAMS, {"ogm": "1", "numpy": "2"})
    assert Store.open(tmp_path / "data").versions == {"ogm": "0, 1", "numpy": "2"}


def test_an_unreachable_scheduler_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "SCHEDULER_TIMEOUT", 0.5)
    store = begin(tmp_path / "data", PLAN, BEAMS, {})
    with pytest.raises(OSError, match="tcp://127.0.0.1:9"):
        next(make_shards(store, PLAN, stand_in, workers=1, scheduler="tcp://127.0.0.1:9"))


class DiesOnce(NamedTuple):
    """Makes samples; at some of them, once each, its process is killed."""

    folder: Path
    indices: tuple[int, ...]

    def __call__(self, plan: DatasetPlan, split: str, index: int, threads: int) -> SimulatedSample:
        if split == "training" and index in self.indices:
            try:
                (self.folder / str(index)).touch(exist_ok=False)
            except FileExistsError:
                pass
            else:
                os.kill(os.getpid(), signal.SIGKILL)
        return stand_in(plan, split, index, threads)


@pytest.mark.slow
def test_two_workers_make_the_same_bytes_though_one_dies(tmp_path: Path, whole: dict[str, bytes]) -> None:
    died = tmp_path / "died"
    died.mkdir()
    store = begin(tmp_path / "data", PLAN, BEAMS, {"ogm": "0"})
    dies_once = DiesOnce(died, (0, 14))  # while the first sample is measured, and in the middle
    events = list(make_shards(store, PLAN, dies_once, workers=2))
    assert {file.name for file in died.iterdir()} == {"0", "14"}
    assert isinstance(events[0], Estimate)
    assert events[0].workers == 2
    assert sum(one.job.samples for one in events[1:]) == 28
    assert contents(tmp_path / "data") == whole


@pytest.mark.slow
def test_workers_that_die_again_and_again_are_an_error(tmp_path: Path) -> None:
    died = tmp_path / "died"
    died.mkdir()
    store = begin(tmp_path / "data", PLAN, BEAMS, {"ogm": "0"})
    with pytest.raises(OSError, match=r"workers died .*: use fewer `workers`, then `ogm simulate .*--resume`"):
        list(make_shards(store, PLAN, DiesOnce(died, (14, 15, 16)), workers=2))


class Sleeps(NamedTuple):
    """Says that it has begun, and sleeps."""

    begun: Path

    def __call__(self, plan: DatasetPlan, split: str, index: int, threads: int) -> SimulatedSample:
        self.begun.write_text(str(os.getpid()))
        time.sleep(600)
        raise AssertionError


def wait_for(path: Path) -> None:
    while not (path.exists() and path.read_text()):
        time.sleep(0.02)


def test_an_interrupt_ends_busy_workers_at_once(tmp_path: Path) -> None:
    begun, sent = tmp_path / "begun", []

    def interrupt() -> None:
        wait_for(begun)
        sent.append(time.monotonic())
        os.kill(os.getpid(), signal.SIGINT)

    store = begin(tmp_path / "data", PLAN, BEAMS, {"ogm": "0"})
    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        list(make_shards(store, PLAN, Sleeps(begun), workers=2))
    assert time.monotonic() - sent[0] < 60  # asked to end, they would sleep on
    assert not multiprocessing.active_children()


@pytest.mark.slow
def test_an_interrupt_ends_workers_that_are_starting(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(processes, "_end_with_parent", SleepsFirst(tmp_path / "starting"))
    store = begin(tmp_path / "data", PLAN, BEAMS, {"ogm": "0"})
    sent = []

    def interrupt() -> None:
        wait_for(tmp_path / "starting")
        sent.append(time.monotonic())
        os.kill(os.getpid(), signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt):
        list(make_shards(store, PLAN, stand_in, workers=2))
    assert time.monotonic() - sent[0] < 60
    assert not multiprocessing.active_children()


class SleepsFirst(NamedTuple):
    """The start of a worker that takes long."""

    begun: Path

    def __call__(self) -> None:
        self.begun.write_text(str(os.getpid()))
        time.sleep(600)


LEADER = """
import sys
sys.path[:0] = {tests!r}
from pathlib import Path
from stand_in import SMALL, TALL
from test_workers import PLAN, Sleeps
from ogm.simulation.workers import begin, make_shards

if __name__ == "__main__":
    data = begin({path!r}, PLAN, (SMALL, TALL), {{"ogm": "0"}})
    list(make_shards(data, PLAN, Sleeps(Path({begun!r})), workers=2))
"""


def test_workers_end_when_their_leader_is_killed(tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    (tmp_path / "leader.py").write_text(LEADER.format(tests=FOLDERS, path=str(tmp_path / "data"), begun=str(begun)))
    with subprocess.Popen([sys.executable, tmp_path / "leader.py"]) as leader:
        wait_for(begun)
        leader.kill()
    worker = Path("/proc", begun.read_text())
    end = time.monotonic() + 60
    while worker.exists() and worker.joinpath("stat").read_text().rpartition(")")[2].split()[0] != "Z":
        assert time.monotonic() < end
        time.sleep(0.05)
