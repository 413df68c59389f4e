"""Which tests reach a line, and how to run some of them: for `mutation.py`, in the processes that it forks."""

import os
import pickle
import signal
import sys
from pathlib import Path
from typing import Any, NamedTuple

EXAMPLES = 15  # of a hypothesis test, at most
SLOWEST = 20.0  # [s] a test that takes longer without the compiler is left out


class Reach(NamedTuple):
    """What some tests import (without the package), their times [s], and those that reach a line of a file."""

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

    options = ["-q", "-x", "-p", "no:cacheprovider", "-W", "ignore::pytest.PytestAssertRewriteWarning"]
    return int(pytest.main([*options, "-m", "not slow", *paths], plugins=[plugin]))


def record(paths: list[str], to: Path) -> int:
    """Run the tests of a group without change and write their reach to a file."""
    recorder = Recorder()
    recorder.coverage.start()
    code = run_tests(paths, recorder)
    recorder.coverage.stop()
    assert sys.modules["ogm"].__file__ == str(Path("ogm/__init__.py").absolute())
    to.write_bytes(pickle.dumps(recorder.reach()))
    return code


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
