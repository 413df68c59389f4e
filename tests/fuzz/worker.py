"""The process that reads inputs one after the other, and what it shares with the one that watches it."""

import logging
import mmap
import os
import random
import resource
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

LIMIT = 2**24  # [byte]
_LIMITS = ("file", "text", "lines", "json", "tables", "grid", "image")
os.environ["OGM_LIMITS"] = " ".join(f"{name}={LIMIT}" for name in _LIMITS)
os.environ |= dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
sys.path[:0] = [str(Path(__file__).parents[k]) for k in range(3)]

from mutations import change  # noqa: E402
from targets import Target  # noqa: E402

from ogm.storage.files import OgmError  # noqa: E402

__all__ = ["HANG", "LIMIT", "PEAK", "Maker", "Source", "Watch", "changed_files", "kept_files", "lay", "work"]

HANG = 2.0  # [s] of processor time
PEAK = 3 * LIMIT + 100 * 2**20  # [byte] as `ogm.storage.limits` states it
ROOM = 2**29  # [byte] of addresses above what a process has when it begins: a huge array fails at once
STATE = struct.Struct("<qqddqqqqq")  # count, number, clock and processor time, read, refused, peak, next number, count
SHARED = Path("/dev/shm")
Maker = Callable[[Path], Target]
Source = Callable[[Target, int], dict[str, bytes]]  # of an input, the files that are not as the target has them


class Watch:
    """Memory that a process and the one that watches it share."""

    def __init__(self) -> None:
        self._memory, self._count = mmap.mmap(-1, STATE.size), 0
        self.set(-1, 0.0, 0, 0, 0, 0)

    def set(self, number: int, processor: float, *rest: int) -> None:
        """Write down which input begins, and what came of those before."""
        self._count += 1
        STATE.pack_into(self._memory, 0, self._count, number, time.monotonic(), processor, *rest, self._count)

    def get(self) -> tuple[int, float, float, int, int, int, int] | None:
        """Return what was written last; None while it is being written."""
        first, *state, last = STATE.unpack_from(self._memory)
        return tuple(state) if first == last > 0 else None  # type: ignore[return-value]  # `pack_into` begins by zeros


def changed_files(name: str, seed: int) -> Source:
    """Return a source of inputs: one or two files of a target, changed by what follows from the seed and a number."""

    def files(target: Target, number: int) -> dict[str, bytes]:
        rng = random.Random(f"{seed} {name} {number}")
        names = target.changed or tuple(target.files)
        pool = list(target.files.values())
        count = 1 if rng.random() < 0.9 or len(names) < 2 else 2
        return {one: change(rng, one, target.files[one], pool) for one in rng.sample(names, k=count)}

    return files


def kept_files(folders: list[Path]) -> Source:
    """Return a source of inputs: those that earlier runs kept."""

    def files(target: Target, number: int) -> dict[str, bytes]:
        found = sorted(path for path in folders[number].rglob("*") if path.is_file())
        return {str(path.relative_to(folders[number])): path.read_bytes() for path in found}

    return files


def lay(folder: Path, files: dict[str, bytes]) -> None:
    """Write files into a folder."""
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)


class Memory:
    """How far the memory of this process grows [byte]."""

    def __init__(self) -> None:
        with suppress(OSError):  # not there but on Linux
            self._reset: Any = open("/proc/self/clear_refs", "w")  # noqa: SIM115
            self._size: Any = open("/proc/self/statm")  # noqa: SIM115

    def begin(self) -> int:
        """Let the peak begin anew; return what there is now."""
        self._reset.write("5")
        self._reset.flush()
        self._size.seek(0)
        return int(self._size.read().split()[1]) * resource.getpagesize()

    def peak(self) -> int:
        """Return the peak since then."""
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def judge(target: Target, folder: Path, changed: dict[str, bytes], refused: list[int]) -> list[tuple[str, str]]:
    """Read one input; return its failures as (kind, place)."""
    failures = []
    given = next(iter(changed.values())) if target.in_memory and changed else folder
    if target.in_memory and not changed:
        given = next(iter(target.files.values()))
    begun = time.process_time()
    try:
        target.read(given)
    except (OgmError, FileNotFoundError):
        refused[0] += 1
    except MemoryError as error:
        failures.append(("over limit", place(error)))
    except BaseException as error:  # noqa: BLE001 - a panic of a library in Rust is no Exception
        failures.append(("undocumented", place(error)))
    if time.process_time() - begun > HANG:
        failures.append(("hang", f"{time.process_time() - begun:.1f} s"))
    return failures


def place(error: BaseException) -> str:
    """Return the type of an error and where it was raised: in the library, and at the bottom."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [one for one in frames if "/ogm/" in one.filename and "/tests/" not in one.filename][-1:]
    where = dict.fromkeys(f"{Path(one.filename).name}:{one.lineno}" for one in (*own, *frames[-1:]))
    return f"{type(error).__name__} in {' > '.join(where)}" + (f": {error}" if type(error) is AssertionError else "")


def work(
    make: Maker, source: Source, numbers: range, seconds: float, watch: Watch, tell: Callable[[Any], None]
) -> None:
    """Read inputs one after the other and tell the failures; `seconds` are of processor time."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1), os.dup2(nowhere, 2)  # what native code prints
    with tempfile.TemporaryDirectory(dir=SHARED if SHARED.is_dir() else None, prefix="fuzz.") as made:
        (scratch := Path(made, "made")).mkdir()
        (folder := Path(made, "read")).mkdir()
        target = make(scratch)
        lay(folder, target.files)
        failures = judge(target, folder, {}, refused := [0])  # packages are imported, kernels compiled
        if refused[0] or any(kind != "hang" for kind, _ in failures):
            raise RuntimeError(f"its own files are not read, {failures}")
        have = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (have + ROOM, have + ROOM))
        memory, failed, most, number, first = Memory(), 0, 0, numbers.start, numbers.start
        ready = time.process_time()
        for number in numbers:
            changed = source(target, number)
            if not target.in_memory:
                lay(folder, changed)
            before = memory.begin()
            done = number - first - refused[0] - failed
            watch.set(number, time.process_time(), done, refused[0], most, number)
            failures = judge(target, folder, changed, refused)
            grown = max(memory.peak() - before, 0)
            most = max(most, grown)
            if grown > PEAK and not any(kind == "over limit" for kind, _ in failures):
                failures.append(("over limit", "its peak"))
            failed += bool(failures)
            for kind, what in failures:
                tell([number, kind, what])
            if not target.in_memory:
                lay(folder, {one: target.files[one] for one in changed})
            if time.process_time() - ready > seconds:
                break
        watch.set(
            -2, time.process_time() - ready, number + 1 - first - refused[0] - failed, refused[0], most, number + 1
        )
