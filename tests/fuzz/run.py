"""Fuzzing of every reader: inputs made from small files by `mutations`, each read once in a process of its own kind.

    python tests/fuzz/run.py [--inputs N] [--minutes M] [--target T] [--seed S] [--json PATH]
    python tests/fuzz/run.py --one FOUND            # reads one input again and shows its traceback
    python tests/fuzz/run.py --again FOLDER         # reads all inputs that are kept in a folder

`--inputs` is of each target, `--minutes` of processor time of all together, in equal shares; what
comes first ends a target. Input k of a target is a pure function of the seed, the target's name and k. A failure
is one of

  crash         the process died by a signal, or left without an answer
  hang          more than 2 s of processor time, or five minutes on the clock
  over limit    more memory than three times the limit of a file (`ogm.storage.limits`), and 100 MB; or MemoryError
  undocumented  another error than OgmError, or FileNotFoundError for a path that the file names; or a result that
                breaks what its class states

Of each target, kind of failure and place, the first input is kept in `--keep`, named TARGET.SEED.NUMBER, for `--one`.
The exit code is 1 if there is any. The limits are set low (`OGM_LIMITS`), so that one that is missed shows early.
"""

import argparse
import fnmatch
import importlib
import json
import os
import platform
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from worker import HANG, LIMIT, PEAK, Maker, Source, Watch, changed_files, kept_files, lay, work

STILL, START = 300.0, 1200.0  # [s] on the clock: of an input, and until the first one; busy machines stand still
BATCH = 20_000  # inputs of one process
PACKAGES = (
    "laspy", "pyarrow.feather", "rosbags.highlevel", "zarr", "rasterio", "xarray", "netCDF4", "PIL.Image", "h5py",
    "dask.array", "scipy.linalg",
)  # fmt: skip
Found = Callable[[int, str, str], None]


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

    def add(self, kind: str, what: str, number: int) -> bool:  # what: place, or how long a hang was
        """Count a failure; return whether it is the first of its kind and place."""
        name = {"crash": "crashes", "hang": "hangs", "over limit": "over_limit"}.get(kind, kind)
        setattr(self, name, getattr(self, name) + 1)
        key = kind if kind == "hang" else f"{kind}: {what}"
        entry = self.failures.setdefault(key, {"count": 0, "first": number, "text": what})
        entry["count"] += 1
        return bool(entry["count"] == 1)


def processor_time(process: int) -> float:
    """Return the processor time of a process [s]."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def run_batch(make: Maker, source: Source, row: Row, numbers: range, seconds: float, found: Found) -> tuple[int, float]:
    """Read inputs in a process of their own until one fails to return.

    Return the number of the next input, and the processor time that the inputs took [s].
    """
    watch = Watch()
    read, write = os.pipe()
    process = os.fork()
    if not process:
        os.close(read)
        code = 1
        try:
            work(
                make, source, numbers, seconds, watch,
                lambda one: os.write(write, json.dumps(one).encode() + b"\n") and None,
            )  # fmt: skip
            code = 0
        except BaseException:  # noqa: BLE001
            tell(write, [-1, "broken", traceback.format_exc()])
        os._exit(code)
    os.close(write)
    os.set_blocking(read, False)
    status, killed, told = None, "", b""
    while status is None:
        time.sleep(0.005)
        told += _drained(read)
        done, code = os.waitpid(process, os.WNOHANG)
        if done:
            status = code
            break
        if (state := watch.get()) is None or not state[1]:  # being written
            continue
        number, clock, before, *_ = state
        spent = processor_time(process) - before if number >= 0 else 0.0
        waited = time.monotonic() - clock
        if spent > HANG + 0.5 or waited > (STILL if number >= 0 else START):
            killed = f"killed after {spent:.1f} s of processor time, {waited:.0f} s on the clock"
            os.kill(process, signal.SIGKILL)
    told += _drained(read)
    os.close(read)
    number, _, spent, accepted, refused, peak, after = watch.get() or (-1, 0, 0.0, 0, 0, 0, numbers.start)
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
    row.inputs += after - numbers.start
    return after, spent


def tell(pipe: int, one: Any) -> None:
    """Write a line."""
    os.write(pipe, json.dumps(one).encode() + b"\n")


def _drained(pipe: int) -> bytes:
    parts = []
    with suppress(BlockingIOError):
        while part := os.read(pipe, 65536):
            parts.append(part)
    return b"".join(parts)


def fuzz(make: Maker, row: Row, source: Source, inputs: int, seconds: float, keep: str = "") -> None:
    """Read inputs of a target, as many as wanted or as the processor time allows; keep the first of each failure."""
    begun, number = time.monotonic(), 0

    def found(at: int, kind: str, what: str) -> None:
        if row.add(kind, what, at) and keep:
            keep_input(make, source, at, Path(f"{keep}.{at}"))

    while number < inputs and seconds > 0:
        number, spent = run_batch(make, source, row, range(number, min(number + BATCH, inputs)), seconds, found)
        seconds -= spent
    row.seconds += time.monotonic() - begun


def keep_input(make: Maker, source: Source, number: int, folder: Path) -> None:
    """Write an input down, in a process of its own: this one must not start threads."""
    process = os.fork()
    if not process:
        with suppress(BaseException), tempfile.TemporaryDirectory() as scratch:
            lay(folder, source(make(Path(scratch)), number))
        os._exit(0)
    os.waitpid(process, 0)


# ---- the command


HEAD = ("inputs", "read", "refused", "undoc.", "crashes", "hangs", "memory", "MB")


def line(row: Row, seed: int) -> str:
    """Return a row as text."""
    counts = (row.inputs, row.accepted, row.refused, row.undocumented, row.crashes, row.hangs, row.over_limit)
    text = f"{row.target:26}" + "".join(f"{one:9}" for one in (*counts, round(row.peak / 2**20)))
    for what, entry in row.failures.items():
        how = f" ({entry['text']})" if what == "hang" else ""
        text += f"\n    {what}{how}, {entry['count']} times, first {row.target}.{seed}.{entry['first']}"
    return text


def replay(makers: dict[str, Maker], one: Path) -> None:
    """Read a kept input, or one that is made anew by its name."""
    name, seed, number = one.name.rsplit(".", 2)
    source = kept_files([one]) if one.is_dir() else changed_files(name, int(seed))
    with tempfile.TemporaryDirectory() as made:
        (scratch := Path(made, "made")).mkdir()
        target = makers[name](scratch)
        changed = source(target, 0 if one.is_dir() else int(number))
        (folder := Path(made, "read")).mkdir()
        lay(folder, target.files | changed)
        print(f"{name}: changed {', '.join(changed)}")
        print(target.read(next(iter(changed.values())) if target.in_memory else folder))


def main() -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=10**9, help="of each target")
    parser.add_argument(
        "--minutes", type=float, default=None, help="of processor time of all targets, in equal shares; by default 1"
    )
    parser.add_argument("--target", default="*", help="a pattern, such as 'grid-*'")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--one", type=Path, help="a kept input, or TARGET.SEED.NUMBER")
    parser.add_argument("--again", type=Path, help="read all inputs that a folder keeps, and no other")
    parser.add_argument("--keep", type=Path, default=Path("out/fuzz"), help="where failing inputs are kept")
    parser.add_argument("--json", type=Path, help="write what came of it")
    parser.add_argument("--targets-of", default="targets", help="module with the function every_target")
    given = parser.parse_args()
    makers = importlib.import_module(given.targets_of).every_target()
    if given.one:
        replay(makers, given.one)
        return 0
    kept: dict[str, list[Path]] = {}
    for path in sorted(given.again.iterdir()) if given.again else ():
        kept.setdefault(path.name.rsplit(".", 2)[0], []).append(path)
    names = [name for name in kept or makers if fnmatch.fnmatch(name, given.target)]
    if not names:
        parser.error(f"no target is {given.target!r}; there are {', '.join(makers)}")
    bounded = given.inputs < 10**9 or given.again
    minutes = given.minutes if given.minutes is not None else 1e6 if bounded else 1.0
    for package in PACKAGES:
        with suppress(ImportError):
            importlib.import_module(package)  # once, not in every process
    print(f"{'target':26}" + "".join(f"{name:>9}" for name in HEAD), flush=True)
    rows: list[Row] = []
    share = 60 * minutes / len(names)
    for name in names:
        rows.append(Row(name))
        if given.again:
            fuzz(makers[name], rows[-1], kept_files(kept[name]), len(kept[name]), share)
        else:
            keep = str(given.keep / f"{name}.{given.seed}")
            fuzz(makers[name], rows[-1], changed_files(name, given.seed), given.inputs, share, keep)
        print(line(rows[-1], given.seed), flush=True)
        total = Row("all", *(sum(getattr(row, one) for row in rows) for one in list(Row.__dataclass_fields__)[1:8]))
        total.peak = max(row.peak for row in rows)
        if given.json:  # as far as it is, for a run that is stopped
            given.json.write_text(json.dumps(record(rows, total, given.seed), indent=1) + "\n")
    print(line(total, given.seed))
    return int(total.undocumented + total.crashes + total.hangs + total.over_limit > 0)


def machine() -> dict[str, Any]:
    """Return what the times must be read with."""
    cpu = platform.processor() or platform.machine()
    with suppress(OSError):
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next((one.partition(":")[2].strip() for one in lines if one.startswith("model name")), cpu)
    date = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
    return {"date": date, "cpu": cpu, "cores": os.cpu_count(), "python": platform.python_version()}


def record(rows: list[Row], total: Row, seed: int) -> dict[str, Any]:
    """Return what came of it, as it is written."""
    words = " ".join(Path(word).name if Path(word).is_absolute() else word for word in sys.argv[1:])
    top: dict[str, Any] = {"command": f"python tests/fuzz/run.py {words}", **machine()}
    top |= {"seed": seed, "inputs": total.inputs, "accepted": total.accepted, "refused": total.refused}
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
