"""Imports at first use: packages of extras, and names of a package."""

import importlib
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any


def install_line(extra: str) -> str:
    """Return the pip command that installs an extra, from the clone or the package index.

    Parameters
    ----------
    extra : str
        Names of extras, separated by commas.
    """
    clone = Path(__file__).parents[1]
    if (clone / "pyproject.toml").is_file():
        return f'{sys.executable} -m pip install -e "{clone}[{extra}]"'
    return f'pip install "ogm-toolkit[{extra}]"'


def import_extra(module: str, extra: str) -> Any:
    """Import a module of an extra; the error for a missing module has the remedy.

    Parameters
    ----------
    module : str
        Dotted name of the module.
    extra : str
        Name of the extra, see ``pip install "ogm-toolkit[extra]"``.

    Raises
    ------
    ImportError
        If the module is missing, or a system library that it loads.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(import_problem(module, extra, error), name=error.name) from error


def import_problem(module: str, extra: str, error: ImportError) -> str:
    """Return what an import needs: the install command of its extra, or the system library that is missing.

    Parameters
    ----------
    module : str
        Dotted name of the module.
    extra : str
        Names of extras, separated by commas.
    error : ImportError
        Error of the import.
    """
    package = module.split(".")[0].replace("_", "-")
    if isinstance(error, ModuleNotFoundError):
        return f"{package} is not installed: {install_line(extra)}"
    libraries = ": apt install libusb-1.0-0 libgl1 libgomp1 (Debian, Ubuntu)" if package == "open3d" else ""
    return f"{package} is installed, but cannot be loaded, {error}: install the system library that it names{libraries}"


def lazy_names(package: str, modules: Mapping[str, str]) -> Callable[[str], object]:
    """Return a ``__getattr__`` that imports the names of a package at their first use.

    Parameters
    ----------
    package : str
        Dotted name of the package.
    modules : mapping of str to str
        Module of each name; for a submodule its own dotted name.
    """

    def load(name: str) -> object:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module = importlib.import_module(modules[name])
        value = module if modules[name] == f"{package}.{name}" else getattr(module, name)
        setattr(sys.modules[package], name, value)
        return value

    return load
