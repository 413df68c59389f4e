"""Many cases of a test in one item: a failure names its case."""

import functools
import inspect
import re
import reprlib
from collections.abc import Callable, Iterable
from typing import Any


def each(names: str | tuple[str, ...], cases: Iterable[Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Run a test for each case, as `pytest.mark.parametrize` does, in one item: fixtures are made once."""
    table = [(case,) if isinstance(names, str) else tuple(case) for case in cases]
    columns = (names,) if isinstance(names, str) else names

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        own = inspect.signature(test)
        others = [parameter for name, parameter in own.parameters.items() if name not in columns]

        @functools.wraps(test)
        def run(*arguments: Any, **fixtures: Any) -> None:  # hypothesis gives arguments by their place
            fixtures |= {parameter.name: value for parameter, value in zip(others, arguments, strict=False)}
            for case in table:
                values = dict(zip(columns, case, strict=True))
                try:
                    test(**fixtures, **values)
                except BaseException as error:
                    error.add_note(f"case: {', '.join(f'{name}={value!r}' for name, value in values.items())}")
                    raise

        run.__signature__ = own.replace(parameters=others)  # type: ignore[attr-defined]
        return run

    return decorate


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
