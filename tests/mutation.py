"""Mutation run: change one place of the package at a time and count the changes that no test notices.

    python tests/mutation.py [GROUP ...] [--count 40] [--seed 0] [--jobs N] [--results FILE] [--least 0.92]

Of each group of modules `--count` mutants are drawn. Each meets the tests of its group in a process of its own: first
those that reach the changed line, the fastest first, then the others, until one fails. The run fails if fewer than the
share `--least` is killed. Mutants that cannot be told from the original are listed in `mutation_equivalent.txt`, with
the reason, and are not drawn. Finished ones are kept in `--results`; the next run goes on from there while the sources
and tests of the group stay the same.

The tree is copied. One process imports what the tests need but not `ogm`, and forks for each mutant; the fork imports
the changed module in place of the one on disk. Kernels run as plain Python (NUMBA_DISABLE_JIT).

Why no library: mutmut 3.8 makes no mutant of a function with a decorator, which all kernels have, nor of a constant of
a module. cosmic-ray 8.7 starts a new Python for each mutant (3.7 s of processor time for one of `ogm.pose`, a fork
takes 0.4 s), changes the files in place, has one test command for all modules and draws no sample; the wrapper around
it would be as long as this file. mutatest 3.1 needs coverage < 6.
"""

import argparse
import contextlib
import hashlib
import importlib
import json
import os
import pickle
import random
import resource
import shutil
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable
from importlib.machinery import SourceFileLoader
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
from mutators import Mutant, mutants_of
from reach import Chosen, Reach, limit_examples, record, run_tests

GROUPS = {  # modules, and the tests that are theirs
    "evidence": ("ogm/evidence", ["tests/evidence", "--ignore=tests/evidence/test_evidence_docs.py"]),
    "metrics": ("ogm/metrics", ["tests/metrics"]),
    "grid": ("ogm/grid.py", ["tests/test_grid.py"]),
    "pose": ("ogm/pose.py", ["tests/test_pose.py"]),
    "truth": ("ogm/truth", ["tests/test_truth.py", "tests/test_truth_labels.py"]),
    "fusion": (  # kernels of dynamic maps need the compiler's arithmetic
        "ogm/fusion/*.py",
        [f"tests/fusion/test_{name}.py" for name in ("mapper", "bayes_mapper", "resample")],
    ),
    "geometric": ("ogm/geometric", ["tests/geometric", "--ignore=tests/geometric/test_scenes.py"]),
}
BUDGET = 40.0  # [s] of tests per mutant, by the times that they take without change
ENVIRONMENT = {"NUMBA_DISABLE_JIT": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
ROOT = Path(__file__).parents[1]
PROGRAMS = [ROOT / "tests" / name for name in ("mutation.py", "mutators.py", "reach.py")]


def try_mutant(mutant: Mutant, reach: Reach) -> int:
    """Import a mutant in place of its module and run the tests; return the exit code of the first failure, or 0."""
    lines = reach.lines.get(mutant.path, {})
    near = set().union(*(lines.get(line, set()) for line in mutant.lines))
    stages: list[list[str]] = [[], []]  # the others as well, since what is cached is computed by the first test alone
    spent = 0.0
    for name, seconds in sorted(reach.seconds.items(), key=lambda item: (item[0] not in near, item[1])):
        spent += seconds
        if spent < BUDGET:
            stages[name not in near].append(name)
    code, path, original = compile(mutant.apply(), mutant.path, "exec"), os.path.abspath(mutant.path), SourceFileLoader
    get_code = original.get_code
    original.get_code = lambda self, name: code if self.path == path else get_code(self, name)  # type: ignore
    for tests in filter(None, stages):
        failed = run_tests(sorted({name.partition("::")[0] for name in tests}), Chosen(tests))
        if failed:
            return failed
    return 0


def fork(work: Callable[[], int], *, quiet: bool, seconds: int) -> int:
    """Start a process that does some work and exits with its result; return its id."""
    child = os.fork()
    if child:
        return child
    code = 70
    try:
        if quiet:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, 1)
            os.dup2(nowhere, 2)
        resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))  # of the processor: a busy machine changes nothing
        signal.alarm(20 * seconds)
        code = work()
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        os._exit(code)


def equivalents() -> dict[tuple[str, str, str, str], str]:
    """Return the reasons of `mutation_equivalent.txt` by path, function, original and changed line."""
    text = (ROOT / "tests" / "mutation_equivalent.txt").read_text()
    result = {}
    for block in filter(None, (block.strip() for block in text.split("\n\n") if not block.startswith("#"))):
        head, before, after, reason = block.split("\n", 3)
        path, _, function = head.partition(" ")
        result[path, function, before.removeprefix("- "), after.removeprefix("+ ")] = reason
    functions = {key[:2] for key in result}
    every = [mutant for path in {path for path, _ in functions} for mutant in mutants_of(ROOT, path)]
    if gone := result.keys() - {mutant.key() for mutant in every if (mutant.path, mutant.function) in functions}:
        raise SystemExit(f"mutation_equivalent.txt lists what is no mutant: {gone}")
    return result


def digest(paths: list[Path]) -> str:
    """Return a number that changes with any of some files, and with these programs."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in [*paths, *PROGRAMS])).hexdigest()[:16]


def files(paths: list[str]) -> list[Path]:
    """Return the Python files of folders and files, in the working directory."""
    paths = [path for path in paths if not path.startswith("--")]
    return [
        file
        for path in paths
        for file in (sorted(Path().glob(path)) if path.endswith(".py") else sorted(Path(path).rglob("*.py")))
    ]


def run_group(group: str, options: argparse.Namespace, results: Path) -> list[dict[str, Any]]:
    """Try the mutants of a group; return one record of each, and keep it in a file."""
    modules, tests = GROUPS[group]
    every, drawn = [mutant for path in files([modules]) for mutant in mutants_of(Path(), str(path))], []
    random.Random(f"{options.seed} {group}").shuffle(every)
    for mutant in every:
        if len(drawn) < options.count and mutant.key() not in options.known:
            drawn.append(mutant)
    version = digest(files([modules, *tests]))
    done = {tuple(one["mutant"]): one for one in map(json.loads, results.open()) if one["version"] == version}
    todo, running = [mutant for mutant in drawn if mutant.key() not in done], {}
    with tempfile.NamedTemporaryFile() as file:
        if todo:
            fork(lambda: record(tests, Path(file.name)), quiet=False, seconds=3600)
            if os.wait()[1]:
                raise SystemExit(f"the tests fail without any change: {' '.join(tests)}")
            reach = pickle.load(file)
            for name in reach.imports:  # for all forks
                with contextlib.suppress(ImportError):
                    importlib.import_module(name)
            print(f"{group}: {len(every)} mutants, {len(todo)} to try on {len(reach.seconds)} tests", flush=True)
        while todo or running:
            while todo and len(running) < options.jobs:
                mutant = todo.pop(0)
                running[fork(lambda: try_mutant(mutant, reach), quiet=True, seconds=int(2 * BUDGET))] = mutant  # noqa: B023
            child, status = os.wait()
            mutant, code = running.pop(child), os.waitstatus_to_exitcode(status)
            if code in (5, 70):
                raise SystemExit(f"no test could run on {mutant.key()}")
            outcome = "survived" if code == 0 else "killed" if code > 0 else "killed: too long"
            one = {"mutant": mutant.key(), "line": mutant.lines.start, "outcome": outcome, "version": version}
            with results.open("a") as kept:
                print(json.dumps(one), file=kept)
            done[mutant.key()] = one
            if code == 0:
                path, function, old, new = mutant.key()
                print(f"survived: {path}:{mutant.lines.start} {function}\n  - {old}\n  + {new}", flush=True)
    return [done[mutant.key()] for mutant in drawn]


def main() -> None:
    """Parse the command line, try the mutants of all groups, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("groups", nargs="*", metavar="GROUP", help=f"of {', '.join(GROUPS)}; all by default")
    parser.add_argument("--count", type=int, default=40, help="mutants of each group")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--results", type=Path, default=ROOT / "out" / "mutation.jsonl")
    parser.add_argument("--least", type=float, default=0.92, help="share that must be killed")
    options = parser.parse_args()
    options.known = equivalents()
    options.results.parent.mkdir(parents=True, exist_ok=True)
    options.results.touch()
    os.environ |= ENVIRONMENT
    with tempfile.TemporaryDirectory() as copy:
        for name in ("ogm", "tests"):
            shutil.copytree(ROOT / name, f"{copy}/{name}", ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", copy)
        os.chdir(copy)
        sys.path.insert(0, copy)
        os.environ["PYTHONPATH"] = copy
        limit_examples()
        table = {group: run_group(group, options, options.results.absolute()) for group in options.groups or GROUPS}
        os.chdir(ROOT)
    every = [one for records in table.values() for one in records]
    for group, records in [*table.items(), ("all", every)]:
        killed = sum(one["outcome"] != "survived" for one in records)
        print(f"{group:10} {killed:4} of {len(records):4} killed, {killed / len(records):.1%}")
    sys.exit(killed < options.least * len(every))


if __name__ == "__main__":
    main()
