"""Tables of cases that run as one test."""

import functools
import inspect
from collections.abc import Callable, Iterable
from typing import Any

import pytest


def each(names: str, cases: Iterable[Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that runs a test once for each case, as one item; the error of a case names the case.

    Parameters
    ----------
    names
        Parameters of the test that a case sets, separated by commas: ``"rows, message"``.
    cases
        Values of these parameters: tuples, or single values where there is one name. Each case has an empty folder as
        `tmp_path`, a `monkeypatch` of its own, and an empty `caplog`, `capsys` or `capfd`; other fixtures are shared by
        all cases. A case that is skipped skips the item after the other cases have run.
    """
    keys, table = [name.strip() for name in names.split(",")], list(cases)

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        signature = inspect.signature(test)

        @functools.wraps(test)
        def run(**fixtures: Any) -> None:
            skipped = None
            for number, case in enumerate(table):
                values = dict(zip(keys, case if len(keys) > 1 else (case,), strict=True))
                try:
                    _run_case(test, number, {**fixtures, **values})
                except pytest.skip.Exception as error:
                    skipped = error
                except BaseException as error:  # a failure of pytest.raises is no Exception
                    error.add_note(f"in case {number}: {values}")
                    raise
            if skipped:
                raise skipped

        fixtures = [parameter for name, parameter in signature.parameters.items() if name not in keys]
        run.__signature__ = signature.replace(parameters=fixtures)  # read by pytest
        return run

    return decorate


def _run_case(test: Callable[..., None], number: int, arguments: dict[str, Any]) -> None:
    if "caplog" in arguments:
        arguments["caplog"].clear()
    for name in {"capsys", "capfd"} & {*arguments}:
        arguments[name].readouterr()
    if "tmp_path" in arguments:
        arguments["tmp_path"] = arguments["tmp_path"] / f"case{number}"
        arguments["tmp_path"].mkdir()
    if "monkeypatch" not in arguments:
        return test(**arguments)
    with pytest.MonkeyPatch.context() as arguments["monkeypatch"]:
        return test(**arguments)
