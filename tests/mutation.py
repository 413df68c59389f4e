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
a module. cosmic-ray 8.7 starts a new Python for each mutant (4 s for the imports of `test_pose.py`, which run for
0.3 s), changes the files in place, has one test command for all modules and draws no sample. mutatest 3.1 needs
coverage < 6. All three would need a wrapper of this length.
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
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parent))
from mutators import Mutant, mutants_of

GROUPS = {  # modules, and the tests that are theirs
    "evidence": ("ogm/evidence", ["tests/evidence", "--ignore=tests/evidence/test_evidence_docs.py"]),
    "metrics": ("ogm/metrics", ["tests/metrics"]),
    "grid": ("ogm/grid.py", ["tests/test_grid.py"]),
    "pose": ("ogm/pose.py", ["tests/test_pose.py"]),
    "truth": ("ogm/truth", ["tests/test_truth.py", "tests/test_truth_labels.py"]),
    "geometric": ("ogm/geometric", ["tests/geometric"]),
}
EXAMPLES = 15  # of a hypothesis test, at most
SLOWEST = 5.0  # [s] a test that takes longer without the compiler is left out
BUDGET = 40.0  # [s] of tests per mutant, by the times that they take without change
ENVIRONMENT = {"NUMBA_DISABLE_JIT": "1", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
ROOT = Path(__file__).parents[1]


class Reach(NamedTuple):
    """The modules of others that the tests of a group import, their times [s], and those that reach a line of a file."""

    imports: list[str]
    seconds: dict[str, float]
    lines: dict[str, dict[int, set[str]]]


class Recorder:
    """A pytest plugin that records the time of each test and the lines that it reaches."""

    def __init__(self) -> None:
        import coverage

        self.coverage = coverage.Coverage(data_file=None, config_file=False, include=[f"{os.getcwd()}/ogm/*"])
        self.seconds: dict[str, float] = {}
        self.passed: set[str] = set()

    def pytest_fixture_setup(self, fixturedef: Any, request: Any) -> None:
        self.coverage.switch_context(request.node.nodeid if fixturedef.scope == "function" else "")

    def pytest_runtest_call(self, item: Any) -> None:
        self.coverage.switch_context(item.nodeid)
        signal.signal(signal.SIGPROF, self.skip)
        signal.setitimer(signal.ITIMER_PROF, SLOWEST)

    def skip(self, *_: object) -> None:
        import pytest

        pytest.skip("slow without the compiler")

    def pytest_runtest_teardown(self) -> None:
        signal.setitimer(signal.ITIMER_PROF, 0)
        self.coverage.switch_context("")

    def pytest_runtest_logreport(self, report: Any) -> None:
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0) + report.duration
        if report.when == "call" and report.passed:
            self.passed.add(report.nodeid)

    def reach(self) -> Reach:
        """Return what was recorded; a line that is run by an import or a shared fixture is reached by all tests."""
        data, lines = self.coverage.get_data(), {}
        for path in data.measured_files():
            lines[os.path.relpath(path)] = {
                line: self.passed if "" in tests else self.passed & set(tests)
                for line, tests in data.contexts_by_lineno(path).items()
            }
        here = os.getcwd()
        others = [
            name for name, one in sys.modules.items() if not (getattr(one, "__file__", "") or here).startswith(here)
        ]
        return Reach(others, {test: self.seconds[test] for test in sorted(self.passed)}, lines)


class Chosen:
    """A pytest plugin that keeps the chosen tests alone, in their order."""

    def __init__(self, tests: list[str]) -> None:
        self.place = {test: n for n, test in enumerate(tests)}

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        items[:] = sorted((i for i in items if i.nodeid in self.place), key=lambda item: self.place[item.nodeid])


def run_tests(paths: list[str], plugin: object) -> int:
    """Run pytest in this process; return its exit code."""
    import pytest

    options = [
        "-q",
        "-x",
        "-p",
        "no:cacheprovider",
        "-m",
        "not slow",
        "-W",
        "ignore::pytest.PytestAssertRewriteWarning",
    ]
    return int(pytest.main([*options, *paths], plugins=[plugin]))


def record(paths: list[str], to: Path) -> int:
    """Run the tests of a group without change and write their reach to a file."""
    recorder = Recorder()
    recorder.coverage.start()
    code = run_tests(paths, recorder)
    recorder.coverage.stop()
    assert sys.modules["ogm"].__file__ == str(Path("ogm/__init__.py").absolute())
    to.write_bytes(pickle.dumps(recorder.reach()))
    return code


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


def limit_examples() -> None:
    """Make hypothesis try few, always the same examples."""
    import hypothesis

    hypothesis.settings.register_profile(
        "few", max_examples=EXAMPLES, deadline=None, derandomize=True, database=None,
        phases=[hypothesis.Phase.explicit, hypothesis.Phase.generate],
    )  # fmt: skip
    hypothesis.settings.load_profile("few")
    plain = hypothesis.settings.__init__

    def few(self: Any, *parent: Any, **given: Any) -> None:
        if "max_examples" in given:
            given["max_examples"] = min(given["max_examples"], EXAMPLES)
        plain(self, *parent, **given)

    hypothesis.settings.__init__ = few  # type: ignore[method-assign]


def equivalents() -> dict[tuple[str, str, str, str], str]:
    """Return the reasons of `mutation_equivalent.txt` by path, function, original and changed line."""
    text = (ROOT / "tests" / "mutation_equivalent.txt").read_text()
    result = {}
    for block in filter(None, (block.strip() for block in text.split("\n\n") if not block.startswith("#"))):
        head, before, after, reason = block.split("\n", 3)
        path, _, function = head.partition(" ")
        result[path, function, before.removeprefix("- "), after.removeprefix("+ ")] = reason
    return result


def digest(paths: list[Path]) -> str:
    """Return a number that changes with any of some files, and with this one."""
    result = hashlib.sha256()
    for path in [*paths, Path(__file__), Path(__file__).with_name("mutators.py")]:
        result.update(path.read_bytes())
    return result.hexdigest()[:16]


def files(paths: list[str]) -> list[Path]:
    """Return the Python files of folders and files, in the working directory."""
    paths = [path for path in paths if not path.startswith("--")]
    return [
        file for path in paths for file in ([Path(path)] if path.endswith(".py") else sorted(Path(path).rglob("*.py")))
    ]


def run_group(group: str, options: argparse.Namespace, results: Path) -> list[dict[str, Any]]:
    """Try the mutants of a group; return one record of each, and keep it in a file."""
    modules, tests = GROUPS[group]
    known, drawn = equivalents(), []
    every = [mutant for path in files([modules]) for mutant in mutants_of(Path(), str(path))]
    listed = {mutant.key() for mutant in every if (mutant.path, mutant.function) in {key[:2] for key in known}}
    if gone := [key for key in known if Path(modules) in [Path(key[0]), *Path(key[0]).parents] and key not in listed]:
        raise SystemExit(f"mutation_equivalent.txt lists what is no mutant: {gone}")
    random.Random(f"{options.seed} {group}").shuffle(every)
    for mutant in every:
        if len(drawn) < options.count and mutant.key() not in known:
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
                print(
                    "survived: {}:{} {}\n  - {}\n  + {}".format(mutant.path, mutant.lines.start, *mutant.key()[1:]),
                    flush=True,
                )
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
