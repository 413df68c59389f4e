"""Fuzzing of every reader: inputs made from small files by `mutations`, each read once in a process of its own kind.

    python tests/fuzz/run.py [--inputs N] [--minutes M] [--target T] [--seed S] [--json PATH]
    python tests/fuzz/run.py --one FOUND            # reads one input again and shows its traceback

`--inputs` is of each target, `--minutes` of all together; what comes first ends a target. Input k of a target is a pure
function of the seed, the target's name and k. A failure is one of

  crash         the process died by a signal, or left without an answer
  hang          more than 2 s of processor time, or a minute without any
  over limit    more memory than `ogm.limits` promises: three times the limit of a file, and 100 MB; or MemoryError
  undocumented  another error than OgmError, or FileNotFoundError for a path that the file names; or a result that
                breaks what its class states

Of each target, kind of failure and place, the first input is kept in `--keep`, named TARGET.SEED.NUMBER, for `--one`.
The exit code is 1 if there is any. The limits are set low (`OGM_LIMITS`), so that one that is missed shows early.
"""

import argparse
import fnmatch
import importlib
import json
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
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

LIMIT = 2**24  # [byte]
os.environ["OGM_LIMITS"] = " ".join(f"{name}={LIMIT}" for name in "file text lines json tables grid image".split())
os.environ |= dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[2])]

from mutations import change  # noqa: E402
from targets import Target  # noqa: E402

from ogm.files import OgmError  # noqa: E402

HANG = 2.0  # [s] of processor time
STILL, START = 60.0, 300.0  # [s] on the clock: of an input, and until the first one
PEAK = 3 * LIMIT + 100 * 2**20  # [byte] as `ogm.limits` states it
ROOM = 2**29  # [byte] of addresses above what a process has when it begins: a huge array fails at once
BATCH = 20_000  # inputs of one process
STATE = struct.Struct("<qddqqqq")  # number, clock and processor time of its start, read, refused, peak, next number
SHARED = Path("/dev/shm")


@dataclass
class Row:
    """What came of a target."""

    target: str
    inputs: int = 0
    accepted: int = 0
    refused: int = 0
    undocumented: int = 0
    crashes: int = 0
    hangs: int = 0
    over_limit: int = 0
    peak: int = 0  # [byte] above what the process had before an input, the largest
    seconds: float = 0.0
    failures: dict[str, dict[str, Any]] = field(default_factory=dict)

    def add(self, kind: str, what: str, number: int) -> bool:
        """Count a failure; return whether it is the first of its kind and place."""
        name = {"crash": "crashes", "hang": "hangs", "over limit": "over_limit"}.get(kind, kind)
        setattr(self, name, getattr(self, name) + 1)
        entry = self.failures.setdefault(f"{kind}: {what}", {"count": 0, "first": number})
        entry["count"] += 1
        return bool(entry["count"] == 1)


class Watch:
    """Memory that a process and the one that watches it share."""

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, STATE.size)
        self.set(-1, 0.0, 0, 0, 0, 0)

    def set(self, number: int, processor: float, *rest: int) -> None:
        """Write down which input begins, and what came of those before."""
        STATE.pack_into(self._memory, 0, number, time.monotonic(), processor, *rest)

    def get(self) -> tuple[int, float, float, int, int, int, int]:
        """Return what was written last."""
        return STATE.unpack_from(self._memory)  # type: ignore[return-value]


# ---- in the process that reads


def changed_files(target: Target, name: str, seed: int, number: int) -> dict[str, bytes]:
    """Return the files that an input changes."""
    rng = random.Random(f"{seed} {name} {number}")
    names = target.changed or tuple(target.files)
    pool = list(target.files.values())
    count = 1 if rng.random() < 0.9 or len(names) < 2 else 2
    return {one: change(rng, one, target.files[one], pool) for one in rng.sample(names, k=count)}


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
    own = [one for one in frames if "/ogm/" in one.filename][-1:]
    where = dict.fromkeys(f"{Path(one.filename).name}:{one.lineno}" for one in (*own, *frames[-1:]))
    return f"{type(error).__name__} in {' > '.join(where)}" + (f": {error}" if type(error) is AssertionError else "")


def work(make: Callable[[Path], Target], name: str, seed: int, first: int, last: int, end: float, watch: Watch,
         tell: Callable[[Any], None]) -> None:  # fmt: skip
    """Read inputs one after the other and tell the failures; `end` is on the clock."""
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
            raise RuntimeError(f"{name}: its own files are not read, {failures}")
        have = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (have + ROOM, have + ROOM))
        memory, failed, most, number = Memory(), 0, 0, first
        for number in range(first, last):
            changed = changed_files(target, name, seed, number)
            if not target.in_memory:
                lay(folder, changed)
            begun, before = time.monotonic(), memory.begin()
            done = number - first - refused[0] - failed
            watch.set(number, time.process_time(), done, refused[0], most, number)
            failures = judge(target, folder, changed, refused)
            grown = max(memory.peak() - before, 0)
            most = max(most, grown)
            if grown > PEAK and not any(kind == "over limit" for kind, _ in failures):
                failures.append(("over limit", f"{grown / 2**20:.0f} MB"))
            failed += bool(failures)
            for kind, what in failures:
                tell([number, kind, what])
            if not target.in_memory:
                lay(folder, {one: target.files[one] for one in changed})
            if begun > end:
                break
        watch.set(-2, 0.0, number + 1 - first - refused[0] - failed, refused[0], most, number + 1)


# ---- in the process that watches


def processor_time(process: int) -> float:
    """Return the processor time of a process [s]."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def run_batch(make: Callable[[Path], Target], row: Row, seed: int, first: int, last: int, end: float,
              found: Callable[[int, str, str], None]) -> int:  # fmt: skip
    """Read inputs in a process of their own until one fails to return; return the number of the next input."""
    watch = Watch()
    read, write = os.pipe()
    process = os.fork()
    if not process:
        os.close(read)
        code = 1
        try:
            work(make, row.target, seed, first, last, end, watch,
                 lambda told: os.write(write, json.dumps(told).encode() + b"\n") and None)  # fmt: skip
            code = 0
        except BaseException:  # noqa: BLE001
            os.write(write, json.dumps([-1, "broken", traceback.format_exc()]).encode() + b"\n")
        os._exit(code)
    os.close(write)
    os.set_blocking(read, False)
    status, killed, told, late = None, "", b"", -1
    while status is None:
        time.sleep(0.005)
        told += _drained(read)
        done, code = os.waitpid(process, os.WNOHANG)
        if done:
            status = code
            break
        number, clock, before, *_ = watch.get()
        spent = processor_time(process) - before if number >= 0 else 0.0
        waited = time.monotonic() - clock
        too_long = spent > HANG + 0.5 or waited > (STILL if number >= 0 else START)
        if too_long and late != number:  # look again: the other process may just be writing
            late = number
        elif too_long:
            killed = f"killed after {spent:.1f} s of processor time, {waited:.0f} s on the clock"
            os.kill(process, signal.SIGKILL)
    told += _drained(read)
    os.close(read)
    number, _, _, accepted, refused, peak, after = watch.get()
    row.accepted, row.refused, row.peak = row.accepted + accepted, row.refused + refused, max(row.peak, peak)
    for line in told.splitlines():
        at, kind, what = json.loads(line)
        if kind == "broken":
            raise RuntimeError(f"the harness failed on {row.target}, after input {number}:\n{what}")
        found(at, kind, what)
    if status != 0 or killed:
        if number < 0:
            raise RuntimeError(f"{row.target} did not read its own files: status {status} {killed}")
        found(number, "hang" if killed else "crash", killed or f"signal {status & 127}, code {status >> 8}")
        after = number + 1
    row.inputs += after - first
    return after


def _drained(pipe: int) -> bytes:
    parts = []
    with suppress(BlockingIOError):
        while part := os.read(pipe, 65536):
            parts.append(part)
    return b"".join(parts)


def fuzz(make: Callable[[Path], Target], name: str, seed: int, inputs: int, seconds: float, keep: Path | None) -> Row:
    """Read inputs of a target, as many as wanted or as the time allows."""
    row, begun, number = Row(name), time.monotonic(), 0

    def found(at: int, kind: str, what: str) -> None:
        if row.add(kind, "" if kind == "hang" else what, at) and keep is not None:
            keep_input(make, name, seed, at, keep)

    while number < inputs and time.monotonic() - begun < seconds:
        number = run_batch(make, row, seed, number, min(number + BATCH, inputs), begun + seconds, found)
    row.seconds = time.monotonic() - begun
    return row


def keep_input(make: Callable[[Path], Target], name: str, seed: int, number: int, keep: Path) -> None:
    """Write an input down; a process of its own makes it, as this one must not start threads."""
    process = os.fork()
    if not process:
        with suppress(BaseException), tempfile.TemporaryDirectory() as folder:
            lay(keep / f"{name}.{seed}.{number}", changed_files(make(Path(folder)), name, seed, number))
        os._exit(0)
    os.waitpid(process, 0)


# ---- the command


HEAD = f"{'target':28}{'inputs':>9}{'read':>9}{'refused':>9}{'undoc.':>8}{'crashes':>8}{'hangs':>7}{'memory':>8}{'MB':>6}"


def line(row: Row) -> str:
    """Return a row as text."""
    counts = (row.inputs, row.accepted, row.refused)
    failures = f"{row.undocumented:8}{row.crashes:8}{row.hangs:7}{row.over_limit:8}"
    text = f"{row.target:28}" + "".join(f"{one:9}" for one in counts) + failures + f"{row.peak / 2**20:6.0f}"
    for what, entry in row.failures.items():
        text += f"\n    {what}, {entry['count']} times, first {row.target}.{{seed}}.{entry['first']}"
    return text


def replay(makers: dict[str, Callable[[Path], Target]], one: Path) -> None:
    """Read a kept input, or one that is made anew by its name."""
    name, seed, number = one.name.rsplit(".", 2)
    with tempfile.TemporaryDirectory() as made:
        (scratch := Path(made, "made")).mkdir()
        target = makers[name](scratch)
        changed = changed_files(target, name, int(seed), int(number))
        if one.is_dir():
            changed = {str(p.relative_to(one)): p.read_bytes() for p in sorted(one.rglob("*")) if p.is_file()}
        (folder := Path(made, "read")).mkdir()
        lay(folder, target.files | changed)
        print(f"{name}: changed {', '.join(changed)}")
        print(target.read(next(iter(changed.values())) if target.in_memory else folder))


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=10**9, help="of each target")
    parser.add_argument("--minutes", type=float, default=None, help="of all targets together; by default 1")
    parser.add_argument("--target", default="*", help="a pattern, such as 'grid-*'")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--one", type=Path, help="a kept input, or TARGET.SEED.NUMBER")
    parser.add_argument("--keep", type=Path, default=Path("fuzz_found"), help="where failing inputs are kept")
    parser.add_argument("--json", type=Path, help="write what came of it")
    parser.add_argument("--targets-of", default="targets", help="module with the function every_target")
    given = parser.parse_args()
    makers = importlib.import_module(given.targets_of).every_target()
    if given.one:
        replay(makers, given.one)
        return 0
    names = [name for name in makers if fnmatch.fnmatch(name, given.target)]
    if not names:
        parser.error(f"no target is {given.target!r}; there are {', '.join(makers)}")
    minutes = given.minutes if given.minutes is not None else 1.0 if given.inputs == 10**9 else 1e6
    for package in ("laspy", "pyarrow.feather", "rosbags.highlevel", "zarr", "rasterio", "xarray", "netCDF4", "PIL.Image"):
        with suppress(ImportError):
            importlib.import_module(package)  # once, not in every process
    print(HEAD, flush=True)
    rows: list[Row] = []
    end = time.monotonic() + 60 * minutes
    for k, name in enumerate(names):
        share = (end - time.monotonic()) / (len(names) - k)  # what earlier ones left is for later ones
        rows.append(fuzz(makers[name], name, given.seed, given.inputs, share, given.keep))
        print(line(rows[-1]).format(seed=given.seed), flush=True)
    total = Row("all", *(sum(getattr(row, one) for row in rows) for one in list(Row.__dataclass_fields__)[1:8]))
    total.peak = max(row.peak for row in rows)
    print(line(total))
    if given.json:
        given.json.write_text(json.dumps(record(rows, total, given.seed), indent=1) + "\n")
    return int(total.undocumented + total.crashes + total.hangs + total.over_limit > 0)


def record(rows: list[Row], total: Row, seed: int) -> dict[str, Any]:
    """Return what came of it, as it is written."""
    top = {"seed": seed, "inputs": total.inputs, "accepted": total.accepted, "refused": total.refused}
    top |= {"undocumented": total.undocumented, "crashes": total.crashes, "hangs": total.hangs}
    top |= {"over limit": total.over_limit, "peak [MB]": round(total.peak / 2**20, 1)}
    top |= {"allowed peak [MB]": round(PEAK / 2**20, 1), "limit of a file [MB]": LIMIT / 2**20, "hang [s]": HANG}
    targets = []
    for row in rows:
        entry = asdict(row) | {"over limit": row.over_limit, "peak [MB]": round(row.peak / 2**20, 1)}
        targets.append({name: value for name, value in entry.items() if name not in ("over_limit", "peak")})
    return top | {"targets": targets}


if __name__ == "__main__":
    sys.exit(main())
