"""Tables of cases that run as one test."""

import functools
import importlib.util
import inspect
import itertools
import re
import reprlib
from collections.abc import Callable, Iterable
from typing import Any

import pytest


def needs(*packages: str) -> None:
    """Skip the module that calls this where a package is missing; none is imported, as that takes long."""
    for package in packages:
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"no {package}", allow_module_level=True)


def each(names: str | tuple[str, ...], cases: Iterable[Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Return a decorator that runs a test once for each case, as one item; the error of a case names the case.

    Parameters
    ----------
    names
        Parameters of the test that a case sets, separated by commas, ``"rows, message"``, or in a tuple.
    cases
        Values of these parameters: tuples, or single values where there is one name. Each case has an empty folder as
        `tmp_path`, a `monkeypatch` of its own, and an empty `caplog`, `capsys` or `capfd`; other fixtures are shared by
        all cases. A case that is skipped skips the item after the other cases have run.
    """
    keys = [name.strip() for name in names.split(",")] if isinstance(names, str) else list(names)
    table = list(cases)

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        signature = inspect.signature(test)
        own = [parameter for name, parameter in signature.parameters.items() if name not in keys]

        @functools.wraps(test)
        def run(*arguments: Any, **others: Any) -> None:  # hypothesis gives arguments by their place
            fixtures = {parameter.name: value for parameter, value in zip(own, arguments, strict=False)} | others
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

        run.__signature__ = signature.replace(parameters=own)  # type: ignore[attr-defined]  # read by pytest
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


def refused(
    match: str, call: Callable[..., object], /, *arguments: Any, error: type[Exception] = ValueError, **options: Any
) -> str:
    """Call a function that must raise an error whose text matches a pattern; return the text."""
    words = [*map(reprlib.repr, arguments), *(f"{name}={reprlib.repr(value)}" for name, value in options.items())]
    case = f"{getattr(call, '__qualname__', call)}({', '.join(words)})"
    try:
        call(*arguments, **options)
    except error as raised:
        text = str(raised)
        assert re.search(match, text), f"{case} is refused by {text!r}, wanted {match!r}"
        return text
    except Exception as raised:
        raise AssertionError(f"{case} raises {type(raised).__name__}, wanted {error.__name__} {match!r}") from raised
    raise AssertionError(f"{case} raises nothing, wanted {error.__name__} {match!r}")


def fail_call(
    monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, number: int, error: BaseException | None = None
) -> None:
    """Let the n-th call of a function, from 1, raise an error instead of doing anything: by default an interrupt."""
    real, calls = getattr(owner, name), itertools.count(1)

    def counted(*arguments: Any, **options: Any) -> Any:
        if next(calls) == number:
            raise error or KeyboardInterrupt
        return real(*arguments, **options)

    monkeypatch.setattr(owner, name, counted)
