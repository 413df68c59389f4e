"""Processes of `tests/faults.py`: commands in sessions of their own, forked from this process or started anew."""

import atexit
import faulthandler
import importlib
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from fault_cases import Case, begun, contents, make_inputs, prepare

COLD = """
import signal, sys; sys.path.insert(0, {tests!r}); sys.argv = ["ogm", *{words!r}]
import fault_cases; fault_cases.prepare({stand_in!r}, {named!r})
from ogm.cli import main; main()
"""
LONGEST = 900.0  # [s] for any run


class Ended(NamedTuple):
    """A run that ended: its exit status (-n: killed by signal n), its time [s], and what it printed to stderr."""

    status: int
    seconds: float
    errors: str


MODULES = {  # what a command imports
    "simulate": ("ogm.simulation.dataset", "ogm.simulation.exchange", "zarr"),
    "train": ("ogm.deep.training", "ogm.datasets", "zarr", "matplotlib.figure"),
    "evaluate": ("ogm.evaluation", "ogm.datasets", "zarr", "matplotlib.figure", "jinja2"),
    "fuse": ("ogm.workflows", "ogm.models.named", "ogm.geometric", "ogm.plot.viewer", "mcap", "rosbags.rosbag1"),
    "convert": ("ogm.io.grids", "rasterio", "xarray", "netCDF4", "zarr", "mcap", "rosbags.rosbag1"),
    "world": ("ogm.world", "ogm.datasets", "ogm.models.named", "ogm.geometric", "rich.progress"),
    "serve": ("ogm.datasets", "ogm.models.named", "ogm.geometric", "ogm.live"),
}


def warm_up(command: str) -> None:
    """Import what a command needs, without starting a thread: forks share it."""
    for name in ("ogm.cli.commands", *MODULES[command]):
        importlib.import_module(name)


class Run:
    """A command that runs in a folder, as the leader of a session.

    Parameters
    ----------
    words : list of str
        Its command line.
    folder : Path
        Where it runs, and where its stderr goes.
    stand_in, named : bool
        For `fault_cases.prepare`.
    cold : bool
        Start a new Python, rather than fork this process.
    """

    def __init__(self, words: Sequence[str], folder: Path, stand_in: bool, named: bool, cold: bool) -> None:
        self.errors = folder / "stderr"
        self.errors.touch()
        self.start = time.monotonic()
        self._child: subprocess.Popen | None = None
        self._status: int | None = None
        if cold:
            plain = [sys.executable, "-m", "ogm.cli", *words]
            code = COLD.format(tests=str(Path(__file__).parent), words=list(words), stand_in=stand_in, named=named)
            with open(self.errors, "wb") as errors:
                self._child = subprocess.Popen(
                    [sys.executable, "-c", code] if stand_in or named else plain, cwd=folder,
                    stdout=subprocess.DEVNULL, stderr=errors, start_new_session=True,
                )  # fmt: skip
            self.pid = self._child.pid
        else:
            self.pid = fork(lambda: _command(words, stand_in, named), folder, self.errors)

    def wait(self, seconds: float = LONGEST) -> Ended | None:
        """Wait for the end; None if it does not come."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if self._status is None:
                self._status = self._child.poll() if self._child else reap(self.pid)
            if self._status is not None:
                return Ended(self._status, time.monotonic() - self.start, self.errors.read_text(errors="replace"))
            time.sleep(0.005)
        return None

    def stacks(self) -> str:
        """Return where the main thread of a forked run is."""
        if self._child or self._status is not None:
            return ""
        before = self.errors.stat().st_size
        os.kill(self.pid, signal.SIGUSR1)
        time.sleep(0.5)
        with open(self.errors, errors="replace") as errors:
            errors.seek(before)
            lines = errors.read().partition("Current thread")[2].splitlines()[1:]
        return " < ".join(" ".join(line.split()[1:]) for line in lines[:12])

    def kill(self) -> None:
        """End whatever is left of the session."""
        for pid in living(self.pid):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.wait(5)


class Command:
    """A command with its inputs, expected outputs and times.

    Parameters
    ----------
    case : Case
    folder : Path
        Holds the inputs as ``in``, and gets a folder for each run.
    """

    def __init__(self, case: Case, folder: Path) -> None:
        self.case, self.folder, self.count = case, folder, 0
        self.seconds: dict[bool, float] = {}  # of a run, forked and new
        self.first = self.new()
        self.end(self.case.words, self.first, cold=False)
        self.expected = contents(self.first / "out") if case.outputs else {}

    def new(self) -> Path:
        """Make the folder of a run."""
        self.count += 1
        folder = self.folder / str(self.count)
        (folder / "out").mkdir(parents=True) if self.case.words[0] not in ("simulate", "train") else folder.mkdir()
        return folder

    def end(self, words: list[str], folder: Path, cold: bool) -> Ended:
        """Run to the end."""
        run = Run(words, folder, self.case.stand_in, False, cold)
        ended = run.wait()
        run.kill()
        if ended is None or ended.status:
            raise RuntimeError(f"{' '.join(words)} ended with {ended}")
        return ended

    def time(self, cold: bool) -> float:
        """Return how long a run takes [s]."""
        if cold not in self.seconds:
            folder = self.new()
            self.seconds[cold] = self.end(self.case.words, folder, cold).seconds
            shutil.rmtree(folder)
        return self.seconds[cold]


def prepared(case: Case, folder: Path, number: int) -> Command:
    """Import what a command needs, make its input in a folder, and run it once."""
    warm_up(case.words[0])
    if not (folder / "in").exists():
        (folder / "in").mkdir()
        if error := in_fork(lambda: make_inputs(case.words[0], folder / "in"), folder):
            raise RuntimeError(error)
    (folder / str(number)).mkdir()
    (folder / str(number) / "in").symlink_to(folder / "in")
    return Command(case, folder / str(number))


def go_on(one: Command, folder: Path, out: Path) -> list[str]:
    """Repeat or resume a command; return what differs from the outputs of the run that was not stopped."""
    nothing_begun = one.case.words[0] == "simulate" and in_fork(lambda: begun(out), folder)
    words = one.case.words if nothing_begun else one.case.again
    run = Run(words, folder, one.case.stand_in, False, False)
    ended = run.wait()
    run.kill()
    if ended is None or ended.status:
        return [f"cannot go on: {ended and ended.errors.strip()[-300:]}"]
    got = contents(out)
    odd = sorted(name for name in got.keys() | one.expected.keys() if got.get(name) != one.expected.get(name))
    odd = [name for name in odd if ".ogm-" not in name]
    return [f"{len(odd)} files differ, such as {odd[0]}"] if odd else []


def fork(work: Callable[[], int], folder: Path, errors: Path) -> int:
    """Do something in a forked process, the leader of a session; return its id."""
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid:
        return pid
    status = 70
    try:
        os.setsid()
        os.chdir(folder)
        for number, path in ((0, os.devnull), (1, os.devnull), (2, errors)):
            os.dup2(os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND), number)
        faulthandler.register(signal.SIGUSR1, file=2)
        status = work()
        threading._shutdown()  # type: ignore[attr-defined]
        atexit._run_exitfuncs()
    except KeyboardInterrupt:  # before the command began, as when Python itself is starting
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(status)


def _command(words: Sequence[str], stand_in: bool, named: bool) -> int:
    from ogm.cli import main

    sys.argv = ["ogm", *words]
    prepare(stand_in, named)
    try:
        main()
    except SystemExit as end:
        return int(end.code or 0)
    return 0


def in_fork(work: Callable[[], object], folder: Path) -> str:
    """Do something that may start threads in a forked process; return the last line of its error, if any."""

    def safely() -> int:
        work()
        return 0

    pid = fork(safely, folder, folder / "checked")
    while (status := reap(pid)) is None:
        time.sleep(0.005)
    lines = (folder / "checked").read_text(errors="replace").strip().splitlines()
    return "" if status == 0 else (lines or [f"status {status}"])[-1][:300]


def reap(pid: int) -> int | None:
    """Return the exit status of a child that ended."""
    found, status = os.waitpid(pid, os.WNOHANG)
    return os.waitstatus_to_exitcode(status) if found else None


def living(session: int) -> list[int]:
    """Return the processes of a session that run."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            with suppress(OSError, IndexError):
                words = (entry / "stat").read_text().rpartition(")")[2].split()
                if int(words[3]) == session and words[0] not in "ZX":
                    found.append(int(entry.name))
    return found


def gone(session: int, seconds: float) -> bool:
    """Wait until a session has no process that runs."""
    end = time.monotonic() + seconds
    while living(session):
        if time.monotonic() > end:
            return False
        time.sleep(0.02)
    return True
