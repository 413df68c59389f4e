"""Measure the records of benchmarks/results again, in order, and make the tables of the pages from them.

    python benchmarks/remake.py FOLDER [NAME ...] [--since COMMIT]
    python benchmarks/remake.py --list

records.txt lists the commands. A record is kept if it is not outdated and was measured at COMMIT or later, by default
the last commit that changed `ogm` or a benchmark: the same command goes on after an interruption. Data sets that a
record needs are simulated in FOLDER. Without recordings (OGM_DATA, see README.md) records of these are left out.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from itertools import groupby
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
TABLE, RESULTS = ROOT / "benchmarks" / "records.txt", ROOT / "benchmarks" / "results"
RECORDINGS = Path(os.environ.get("OGM_DATA", ROOT.parent / "shared" / "data" / "real"))
CODE = ("ogm", "benchmarks/*.py")


def read_table() -> tuple[dict[str, list[str]], dict[str, list[str]]]:
    """Return minutes, need of recordings and commands of the records, and the options of the data sets, by name."""
    lines = [line.split() for line in TABLE.read_text().splitlines() if line and not line.startswith("#")]
    data = {name: words for name, *words in lines if words[0].startswith("--")}
    return {name: words for name, *words in lines if name not in data}, data


def git(*words: str) -> str | None:
    """Return the output of git in the checkout; None if it fails."""
    done = subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=False)
    return None if done.returncode else done.stdout.strip()


def parts_of(record: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """Yield the parts of a record that have a command and a date."""
    if {"command", "date"} <= record.keys():
        yield record
    for part in record.values():
        if isinstance(part, Mapping):
            yield from parts_of(part)


def is_current(name: str, since: str) -> bool:
    """Tell whether a record was measured at a commit or later, and is not outdated."""
    path = RESULTS / f"{name}.json"
    time_of_commit = git("log", "-1", "--date=format-local:%Y-%m-%d %H:%M", "--format=%cd", since) or ""
    for part in parts_of(json.loads(path.read_text(encoding="utf-8"))) if path.is_file() else [{"date": ""}]:
        if commit := part.get("commit"):
            newer = git("merge-base", "--is-ancestor", since, commit) is not None  # "-dirty" is no commit
        else:
            newer = part["date"] >= time_of_commit[: len(part["date"]) or None]
        if not newer:
            return False
    sys.path.insert(0, str(ROOT / "docs"))
    from record_tables import outdated  # only now: --list needs no numpy

    return not outdated(name)


def python(*words: str | Path) -> bool:
    """Run Python in the checkout; return whether it succeeded."""
    print("remake: python", *words, flush=True)
    return subprocess.run([sys.executable, *map(str, words)], cwd=ROOT, check=False).returncode == 0


def simulate(path: Path, options: list[str]) -> bool:
    """Make a data set, or the rest of it; return whether it is whole."""
    resume = ["--resume"] if path.exists() else []
    whole = (path / "contact-sheet.png").is_file()  # its last file
    return whole or python("-m", "ogm.cli", "simulate", path, *options, *resume)


def remake(name: str, folder: Path) -> bool:
    """Measure a record, with its data sets; return whether all commands succeeded."""
    records, data = read_table()
    minutes, _, *words = records[name]
    print(f"remake: {name}, about {minutes} minutes", flush=True)
    start, wanted = time.monotonic(), {word.partition("=")[0] for word in words}
    done = all(simulate(folder / one, options) for one, options in data.items() if one in wanted)
    placed = [str(folder / word) if word.partition("=")[0].isupper() else word for word in words]
    for is_end, command in groupby(placed, ";".__eq__):
        done = done and (is_end or python(*command))
    print(f"remake: {name} {'took' if done else 'failed after'} {(time.monotonic() - start) / 60:.1f} minutes")
    return done


def main() -> int:
    """Measure the chosen records."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="where data sets are simulated")
    parser.add_argument("names", nargs="*", metavar="NAME", help="records (default: all)")
    parser.add_argument("--since", metavar="COMMIT", help="keep records of this commit or later")
    parser.add_argument("--list", action="store_true", help="print commands, minutes and data sets; measure nothing")
    given, (records, _) = parser.parse_args(), read_table()
    if given.list or given.folder is None:
        print(TABLE.read_text(), end="")
        return int(not given.list)
    if unknown := sorted(set(given.names) - records.keys()):
        parser.error(f"records.txt has no {unknown[0]}")
    if git("diff", "--quiet", "HEAD", "--", *CODE) is None:
        parser.error("ogm or benchmarks differ from the commit that records would name: commit first")
    since = given.since or git("log", "-1", "--format=%H", "--", *CODE)
    if not since or git("cat-file", "-e", f"{since}^{{commit}}") is None:
        parser.error(f"this checkout has no commit {since or ''}")
    folder, failed = given.folder.resolve(), []
    folder.mkdir(parents=True, exist_ok=True)
    for name in given.names or records:
        if records[name][1] == "real" and not RECORDINGS.is_dir():
            print(f"remake: {name} is left out: there are no recordings in {RECORDINGS}")
        elif is_current(name, since):
            print(f"remake: {name} is kept")
        elif not remake(name, folder):
            failed.append(name)
    built = python("docs/build.py")
    print(f"remake: failed: {', '.join(failed) or 'none'}")
    return int(bool(failed) or not built)


if __name__ == "__main__":
    sys.exit(main())
