"""Packages that come with an extra: imported where they are needed."""

import importlib
from typing import Any

__all__ = ["import_extra"]


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
        raise ImportError(f'{package} is not installed: pip install "ogm-toolkit[{extra}]"', name=error.name) from error
