"""Fault run: stop every command at random moments, fill its disk, and see that nothing finished is lost.

    python tests/faults.py [--kills 200] [--commands simulate,train,...] [--seed 0] [--json FILE] [--real 6]

Each command is run once to its end, then stopped `--kills` times by SIGINT, SIGTERM and SIGKILL in turn, at moments
that are uniform over its time. After each: SIGINT and SIGTERM end it within 5 s, with the status 130 or 143 and one
line; no process stays; no temporary file stays (after SIGKILL: once the next run has begun); every output is whole; the
command is repeated, or resumed, and its outputs are those of the run that was not stopped, byte for byte (NetCDF files
and state.pt: array for array; log.csv: but for the speed), and finished files were not made again.

Nine of ten runs are forked from a process that has the packages loaded; the tenth is a new Python, whose imports are
among the moments. Half of the forked runs have temporary files with names, as on file systems without O_TMPFILE. For
`simulate`, samples are made without towns, so that a run takes a second; `--real` runs are of real towns. Signals go to
the process, and each second SIGINT and SIGTERM to all of its session, as from a terminal or a service manager.

Then a disk is filled at every place, see `fault_disk.py`. The run fails if anything does not hold. Linux alone.
"""

import argparse
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import fault_disk
from fault_cases import Case, cases, contents, left_behind
from fault_runs import Command, Ended, Run, go_on, gone, in_fork, prepared

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
WITHIN = 5.0  # [s] from SIGINT or SIGTERM to the end
MOST = float(os.environ.get("FAULTS_SECONDS", "0"))  # [s] for a command, 0: no limit
ORPHANS = 15.0  # [s] after SIGKILL in which other processes of the command must notice
ROW = ("command", "SIGINT", "SIGTERM", "SIGKILL", "survived", "lost", "left behind", "slowest exit [s]")


@dataclass
class Row:
    """What became of the runs of a command."""

    command: str
    signals: Counter = field(default_factory=Counter)
    survived: int = 0
    lost: int = 0
    left: int = 0
    slowest: float = 0.0
    stopped: int = 0  # runs that did not reach their end
    failures: list[str] = field(default_factory=list)

    def record(self) -> dict:
        """Return the row as JSON holds it."""
        signals = {one.name: self.signals[one.name] for one in SIGNALS}
        found = {"command": self.command, **signals, "survived": self.survived, "lost": self.lost}
        found |= {
            "left behind": self.left,
            "slowest exit [s]": round(self.slowest, 2),
            "stopped before the end": self.stopped,
        }
        where = {"date": datetime.now(UTC).date().isoformat(), "load average": round(os.getloadavg()[2], 1)}
        return found | where | {"failures": self.failures[:20]}


def stop(one: Command, row: Row, number: signal.Signals, rng: random.Random, cold: bool, named: bool) -> None:
    """Stop a run, look at what it leaves, and go on with it."""
    case, folder, out = one.case, one.new(), one.folder / str(one.count) / "out"
    before = case.words[0] in ("fuse", "convert") and rng.random() < 0.5  # outputs of an earlier run are there
    if before:
        shutil.copytree(one.first / "out", out, dirs_exist_ok=True)
    group = number != signal.SIGKILL and rng.random() < 0.5
    moment = rng.uniform(0, one.time(cold))
    run = Run(case.words, folder, case.stand_in, named, cold)
    early = run.wait(moment)
    sent = time.monotonic()
    if early is None:
        row.stopped += 1
        (os.killpg if group else os.kill)(run.pid, number) if gone_to(run.pid, group) else None
    ended = early or run.wait(WITHIN)
    where = "" if ended else run.stacks()
    ended = ended or run.wait(60)
    wrong: list[str] = []
    if ended is None:
        wrong.append(f"does not end within 60 s: {where}")
    else:
        seconds = time.monotonic() - sent if early is None else 0.0
        if number != signal.SIGKILL:
            row.slowest = max(row.slowest, seconds)
            if seconds > WITHIN:
                wrong.append(f"ended after {seconds:.1f} s: {where}")
        wrong += check_end(case, ended, number)
    stays = not gone(run.pid, ORPHANS if number == signal.SIGKILL else WITHIN)
    temporary = left_behind(folder) if number != signal.SIGKILL else []
    run.kill()
    lost: list[str] = []
    if case.outputs:
        lost += [f"{text} after the signal" for text in [in_fork(lambda: case.whole(out), folder)] if text]
        if before and set(one.expected) - set(contents(out)):
            lost.append("an earlier output is gone")
        kept = {path: path.stat().st_mtime_ns for path in out.glob(case.finished)} if case.finished else {}
        lost += go_on(one, folder, out)
        lost += [f"{path.name} was made again" for path, at in kept.items() if path.stat().st_mtime_ns != at]
        temporary += left_behind(folder)
    row.signals[number.name] += 1
    row.lost += bool(lost)
    row.left += bool(stays or temporary)
    wrong += lost + (["a process stays"] if stays else []) + [f"{name} stays" for name in temporary[:2]]
    row.survived += not wrong
    if wrong:
        kind = f"{'new' if cold else 'forked'}, {'named, ' * named}{number.name}{' to all' * group} at {moment:.2f} s"
        row.failures.append(f"{kind}: {'; '.join(wrong)}")
        print(f"{row.command}: {row.failures[-1]}", file=sys.stderr, flush=True)
    shutil.rmtree(folder, ignore_errors=True)


def gone_to(pid: int, group: bool) -> bool:
    """Wait until a forked run leads its session, as a signal for all of it must not come before."""
    while group and os.getpgid(pid) != pid:
        time.sleep(0.001)
    return True


def check_end(case: Case, ended: Ended, number: signal.Signals) -> list[str]:
    """Return what is wrong with exit status and message."""
    if number == signal.SIGKILL:
        return [] if ended.status in (0, -9) else [f"status {ended.status}: {ended.errors[-300:]}"]
    if ended.status == -number:  # Python itself was just starting, or all was done
        return []
    if ended.status not in (0, 128 + number) or "Traceback" in ended.errors:
        return [f"status {ended.status}: {ended.errors[-300:]!r}"]
    lines = [line for line in ended.errors.splitlines() if "nterrupted" in line]
    if len(lines) != (ended.status != 0):
        return [f"status {ended.status} with the message {ended.errors[-300:]!r}"]
    return []


def stop_all(name: str, chosen: list[Case], kills: int, seed: int, folder: Path) -> dict:
    """Stop a command so many times, in a process that has its packages loaded; return its row."""
    result = folder / "row.json"
    child = os.fork()
    if child:
        os.waitpid(child, 0)
        return json.loads(result.read_text())
    status = 1
    try:
        place = Path(tempfile.mkdtemp(dir=folder))
        result.write_text(json.dumps(_stop_all(name, chosen, kills, seed, place).record()))
        shutil.rmtree(place)
        status = 0
    except BaseException:
        traceback.print_exc()
    finally:
        result.exists() or result.write_text(json.dumps(Row(name, failures=["the run broke off"]).record()))
        sys.stderr.flush()
        os._exit(status)


def _stop_all(name: str, chosen: list[Case], kills: int, seed: int, folder: Path) -> Row:
    row, rng, began = Row(name), random.Random(f"{name} {seed}"), time.monotonic()
    commands: dict[int, Command] = {}
    for k in range(kills):
        n = k % len(chosen)
        if n not in commands:
            commands[n] = prepared(chosen[n], folder, n)
        cold = k % 10 == 9 or name.endswith("towns")
        named = not cold and rng.random() < 0.5
        stop(commands[n], row, SIGNALS[(k + k // 10) % 3], rng, cold, named)
        if MOST and time.monotonic() - began > MOST:
            break
        if k % 10 == 9:
            print(f"{name}: {k + 1} of {kills}, {row.survived} survived", file=sys.stderr, flush=True)
    return row


def matches(name: str, words: str) -> bool:
    """Return whether the option `--commands` names a command."""
    if words == "all" or words in cases():  # names of commands may have a comma
        return words in ("all", name)
    return any(name.startswith(word) for word in words.split(","))


def chosen_cases(words: str) -> Iterator[tuple[str, list[Case]]]:
    """Yield the commands of the option, all that have the same name before a kind of file together."""
    found: dict[str, list[Case]] = {}
    for name, case in cases().items():
        group = name.partition(" ")[0] if name.startswith(("fuse", "convert")) else name
        if matches(name, words):
            found.setdefault(group, []).append(case)
    yield from found.items()


def main() -> int:
    """Run what the options ask for."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--commands", default="all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, help="rows of commands that were not run now stay as they are there")
    parser.add_argument("--real", type=int, default=6, help="runs of `ogm simulate` with towns")
    parser.add_argument("--disk", action=argparse.BooleanOptionalAction, default=True, help="fill the disk, too")
    options = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = "1"
    signal.signal(signal.SIGINT, signal.default_int_handler)  # shells start what is in the background without it
    rows: dict[str, dict] = {}
    folder = Path(tempfile.mkdtemp(prefix="faults-"))  # forked commands would remove a TemporaryDirectory
    for command, found in chosen_cases(options.commands):
        kills = options.real if command.endswith("towns") else options.kills
        if kills:
            rows[command] = stop_all(command, found, kills, options.seed, folder)
            write_record(rows, None, options.json)
    full = {name: one for name, one in cases().items() if matches(name, options.commands)}
    full = {name: one for name, one in full.items() if one.outputs and not name.endswith(("2 workers", "towns"))}
    disk = fault_disk.fill(folder, full) if options.disk else None
    shutil.rmtree(folder, ignore_errors=True)
    return report(rows, disk, options.json)


def write_record(rows: dict[str, dict], disk: dict | None, path: Path | None) -> dict:
    """Return the record, with what the file holds of other commands, and write it there if a file is given."""
    if path is not None and path.exists():
        record = json.loads(path.read_text())
        rows = {one["command"]: one for one in record["commands"]} | rows
        disk = with_others(disk, record["full disk"])
    found = list(rows.values())
    record = {
        "injected": sum(one[number.name] for one in found for number in SIGNALS),
        **{key: sum(one[key] for one in found) for key in ("survived", "lost", "left behind")},
        "slowest exit [s]": max((one["slowest exit [s]"] for one in found), default=0.0),
        "commands": found,
        "full disk": disk or {},
        "command": "python tests/faults.py",
        "date": max((one.get("date", "") for one in found), default=""),
    }
    if path is not None:
        path.write_text(json.dumps(record, indent=1) + "\n")
    return record


def with_others(disk: dict | None, record: dict) -> dict:
    """Return the full disks of this run, with those of other commands in a record."""
    if not (disk and record):
        return disk or record
    rows = record["commands"] | disk["commands"]
    kept = [one for one in record["failures"] if one.partition(",")[0] not in disk["commands"]]
    counts = {key: sum(one[key] for one in rows.values()) for key in ("full", "survived")}
    return {"how": disk["how"], **counts, "commands": rows, "failures": [*kept, *disk["failures"]]}


def report(rows: dict[str, dict], disk: dict | None, path: Path | None) -> int:
    """Write the record, print a table, and return the exit code."""
    record = write_record(rows, disk, path)
    print("  ".join(ROW))
    for one in record["commands"]:
        print("  ".join(f"{one[key]:>{len(key)}}" for key in ROW))
    print(f"full disk: {disk}")
    return int(record["survived"] != record["injected"] or bool(disk and disk["failures"]))


if __name__ == "__main__":
    sys.exit(main())
