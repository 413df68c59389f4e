"""Imports at first use: of packages that come with an extra, and of the names of a package."""

import importlib
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any


def install_line(extra: str) -> str:
    """Return the command that installs an extra: into the environment of a clone, or from the package index.

    Parameters
    ----------
    extra : str
        One or more, with commas between.
    """
    clone = Path(__file__).parents[1]
    if (clone / "pyproject.toml").is_file():
        return f'{sys.executable} -m pip install -e "{clone}[{extra}]"'
    return f'pip install "ogm-toolkit[{extra}]"'


def import_extra(module: str, extra: str) -> Any:
    """Return a module that an extra of ogm installs, or raise an error with the command that adds it.

    Parameters
    ----------
    module : str
        Its dotted name.
    extra : str
        As in ``pip install "ogm-toolkit[extra]"``.

    Raises
    ------
    ImportError
        If it is missing.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.split(".")[0].replace("_", "-")
        raise ImportError(f"{package} is not installed: {install_line(extra)}", name=error.name) from error


def lazy_names(package: str, homes: Mapping[str, str]) -> Callable[[str], object]:
    """Return the ``__getattr__`` of a package whose names are imported when they are first used.

    Parameters
    ----------
    package : str
        Its dotted name.
    homes : mapping of str to str
        Module of each name; that of a module is the module itself.
    """

    def load(name: str) -> object:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = importlib.import_module(homes[name])
        value = module if homes[name] == f"{package}.{name}" else getattr(module, name)
        setattr(sys.modules[package], name, value)
        return value

    return load
