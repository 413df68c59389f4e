"""A full disk at every place of the commands' outputs, for `tests/faults.py`.

As root on a disk in memory (tmpfs) that has room for so many pages; else by a limit of the size of files. Expected: one
line that names the output, exit status 1, earlier outputs as they were, no temporary file, and once there is room, the
command gives what it would have given.
"""

import os
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fault_cases import Case, contents, left_behind
from fault_runs import Command, Run, go_on, prepared

SIZE, PAGE = 2**26, 4096  # [byte] of the disk and of its pages
PLACES = 12  # of each command's outputs at which the disk is full


def fill(folder: Path, found: dict[str, Case]) -> dict:
    """Fill the disk at many places of every command's outputs; return what became of the runs."""
    rows: dict[str, dict[str, int]] = {}
    failures: list[str] = []
    for n, (name, case) in enumerate(found.items()):
        (folder / f"disk{n}").mkdir()
        wrong = _fill(prepared(case, folder / f"disk{n}", 0), rows.setdefault(name, {"full": 0, "survived": 0}))
        failures += [f"{name}, {text}" for text in wrong]
        print(f"full disk, {name}: {rows[name]}", *wrong, sep="\n  ", file=sys.stderr, flush=True)
    how = "tmpfs" if os.geteuid() == 0 else "RLIMIT_FSIZE"
    total = {key: sum(row[key] for row in rows.values()) for key in ("full", "survived")}
    return {"how": how, **total, "commands": rows, "failures": failures}


def _fill(one: Command, row: dict[str, int]) -> list[str]:
    """Run a command with less and less room; return what was wrong."""
    sizes = [path.stat().st_size for path in (one.first / "out").rglob("*") if path.is_file()]
    pages = sum(-(-size // PAGE) for size in sizes) if os.geteuid() == 0 else -(-max(sizes) // PAGE)
    wrong = []
    for room in sorted({0, 1, 2, 3, *(pages * k // PLACES for k in range(PLACES))}):
        folder = one.new()
        out = folder / "out"
        with _disk(out, room, one.first / "out" if one.case.words[0] in ("fuse", "convert") else None):
            before = contents(out)
            run = Run(one.case.words, folder, one.case.stand_in, False, False)
            with _limited(room):
                ended = run.wait()
            run.kill()
            if ended is not None and ended.status == 0:
                break  # there was room for all
            row["full"] += 1
            lines = [line for line in (ended.errors if ended else "").splitlines() if line.startswith("ogm: ")]
            bad = []
            if ended is None or ended.status != 1 or "Traceback" in ended.errors:
                bad.append(f"ended with {ended and (ended.status, ended.errors[-400:])}")
            elif not lines or "out" not in lines[-1]:
                bad.append(f"the path is not named: {lines}")
            if left := left_behind(folder):
                bad.append(f"{left[0]} stays")
            after = contents(out)
            if changed := [
                f"{name}, {len(after.get(name, b''))} bytes" for name in before if after.get(name) != before[name]
            ]:
                bad.append(f"earlier outputs were changed: {changed}")
            (out.resolve().parent / "ballast").unlink(missing_ok=True)
            bad += go_on(one, folder, out)
            row["survived"] += not bad
            wrong += [f"room for {room} pages: {text}" for text in bad]
        shutil.rmtree(folder, ignore_errors=True)
    return wrong


@contextmanager
def _disk(out: Path, room: int, earlier: Path | None) -> Iterator[None]:
    """Let `out` be a folder on a disk with room for so many pages, which may hold earlier outputs."""
    out.mkdir(exist_ok=True)
    if os.geteuid():
        if earlier is not None:
            shutil.copytree(earlier, out, dirs_exist_ok=True)
        yield
        return
    disk = Path(tempfile.mkdtemp(prefix="faults-disk-"))
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={SIZE}", "none", disk], check=True)
    try:
        (disk / "out").mkdir()
        if earlier is not None:
            shutil.copytree(earlier, disk / "out", dirs_exist_ok=True)
        (disk / "ballast").touch()
        status = os.statvfs(disk)
        with open(disk / "ballast", "wb") as file:
            os.posix_fallocate(file.fileno(), 0, (status.f_bavail - room) * PAGE)
        out.rmdir()
        out.symlink_to(disk / "out")
        yield
    finally:
        out.unlink(missing_ok=True)
        subprocess.run(["umount", disk], check=False)
        disk.rmdir()


@contextmanager
def _limited(room: int) -> Iterator[None]:
    """Limit the size of files that processes which are started inside write, unless a disk does."""
    if os.geteuid() == 0:
        yield
        return
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room * PAGE, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
