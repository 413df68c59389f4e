"""How kernels are compiled: the one place for numba's flags.

All kernels release the GIL and are cached on disk. numpy's error model spares divisions a branch that would
keep loops off the vector units.
"""

import logging
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Protocol, TypeVar

from numba import njit

__all__ = ["inline", "kernel", "log_compilation", "vector"]

Function = TypeVar("Function", bound=Callable[..., Any])


class Compiler(Protocol):
    """A decorator that compiles a function; types are checked as if it did not."""

    def __call__(self, function: Function, /) -> Function:
        """Return the compiled function."""


_njit: Any = njit  # its dispatchers hide the types of what they call
kernel: Compiler = _njit(cache=True, nogil=True, error_model="numpy")
inline: Compiler = _njit(cache=True, nogil=True, error_model="numpy", inline="always")
vector: Compiler = _njit(  # for loops whose input holds no NaN
    cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz", "nnan"}
)


@cache
def log_compilation(main_kernel: Any) -> None:
    """Log at level INFO, under the name of the kernel's package, that kernels will be compiled.

    Nothing is logged if they are in memory or in numba's cache on disk.

    Parameters
    ----------
    main_kernel : numba kernel
        The one that stands for all that a model needs.
    """
    stats = getattr(main_kernel, "stats", None)  # None where numba's compiler is switched off
    if stats is None or main_kernel.signatures:
        return
    if not any(Path(stats.cache_path).glob(f"*.{main_kernel.__name__}-*.nbi")):
        package = ".".join(main_kernel.__module__.split(".")[:2])
        logging.getLogger(package).info("compiling kernels, once per environment: up to a minute")
