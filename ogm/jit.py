"""Compilation of kernels: numba's flags, and the cache of compiled kernels on disk.

All kernels release the GIL. numpy's error model removes a branch from divisions, which would prevent vectorised loops.
Compilation takes tens of seconds. Four habits keep it short: loops instead of array expressions (`np.where`, assigned
slices); variables instead of constants, because each constant is a signature of its own; `inline` only if the result
needs it; combination rules as constants of a kernel's closure, so that other rules are not compiled.

numba's own cache checks only the file of a kernel, and keeps outdated machine code of helpers in other files. Here the
compiled kernels of a module lie in a folder with a hash in its name. The hash covers the source of the module and of
all modules of ogm that it imports, the versions of numba and Python, and the processor. It does not depend on the path
of the installation, so that a new clone finds the kernels of an older clone with the same sources. The folders are
below ``$NUMBA_CACHE_DIR/ogm``, else ``$XDG_CACHE_HOME/ogm``, else ``~/.cache/ogm``. Without write access each process
compiles its own kernels.
"""

import fcntl
import hashlib
import logging
import os
import re
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any, Protocol, Self, TypeVar

import numba
from llvmlite.binding import get_host_cpu_name
from numba import njit
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.compiler_lock import global_compiler_lock
from numba.core.runtime import rtsys

Function = TypeVar("Function", bound=Callable[..., Any])
KEPT_VERSIONS = 3  # number of folders of a module to keep, the most recently used first
_PACKAGE = Path(__file__).parent
_IMPORT = re.compile(r"^(?:from (ogm[\w.]*) import (\([^)]*\)|[^\n]*)|import (ogm[\w.]*))", re.MULTILINE)

_log = logging.getLogger(__name__)


class Compiler(Protocol):
    """Decorator that compiles a function, and keeps its type for type checkers."""

    def __call__(self, function: Function, /) -> Function:
        """Return the compiled function."""


def _compiler(**flags: Any) -> Compiler:
    """Return a decorator for kernels with flags of numba."""
    compiler: Any = njit(nogil=True, error_model="numpy", no_cfunc_wrapper=True, **flags)

    def compiled(function: Any) -> Any:
        kernel = compiler(function)
        folder = cache_folder(Path(function.__code__.co_filename), function.__module__)
        if kernel is not function and folder is not None:  # equal if numba's compiler is switched off
            kernel.compile = _cached_compile(kernel, folder)
        return kernel

    return compiled


@cache
def cache_folder(path: Path, module: str) -> Path | None:
    """Return the folder of a module's compiled kernels, or None without a source file or write access.

    Parameters
    ----------
    path : Path
        Source file of the module.
    module : str
        Dotted name of the module.
    """
    root = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    try:
        parts = [numba.__version__, sys.implementation.cache_tag or "", get_host_cpu_name()]
        digest = hashlib.sha256("\0".join([*parts, *(_text(source)[0] for source in _sources(path))]).encode())
        folder = Path(root).expanduser() / "ogm" / f"{module}-{digest.hexdigest()[:16]}"
        if not folder.is_dir():
            folder.mkdir(parents=True, exist_ok=True)
            for outdated in sorted(folder.parent.glob(f"{module}-*"), key=os.path.getmtime)[:-KEPT_VERSIONS]:
                shutil.rmtree(outdated, ignore_errors=True)
        os.utime(folder)
    except (OSError, RuntimeError):  # RuntimeError: no home directory
        return None
    return folder if os.access(folder, os.W_OK) else None


def _sources(path: Path) -> list[Path]:
    """Return the files of a module and of all modules of ogm that it imports, directly or not, in a fixed order."""
    found, queue = {path}, [path]
    while queue:
        new = set(_text(queue.pop())[1]) - found
        found |= new
        queue += new
    return [path, *sorted(found - {path})]


@cache
def _text(path: Path) -> tuple[str, tuple[Path, ...]]:
    """Return the text of a module, and the files of the modules of ogm that it imports at its top level."""
    text, names = path.read_text(encoding="utf-8"), set()
    for package, imported, module in _IMPORT.findall(text):
        names.add(package or module)
        names |= {f"{package}.{name}" for name in re.findall(r"\w+", imported)}
    return text, tuple(file for file in map(_file_of, names) if file is not None)


@cache
def _file_of(name: str) -> Path | None:
    """Return the file of a module of ogm, or None for another name."""
    base = f"{_PACKAGE.parent}/{name.replace('.', '/')}"
    return next((Path(file) for file in (f"{base}.py", f"{base}/__init__.py") if os.path.isfile(file)), None)


class _Locator:
    """Folder of a module's compiled code, as numba's cache locator."""

    def __init__(self, function: Any, folder: Path) -> None:
        self.folder, self.line = folder, function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: Any, path: str) -> Self | None:
        folder = cache_folder(Path(path), function.__module__)
        return None if folder is None else cls(function, folder)

    def ensure_cache_path(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)

    def get_cache_path(self) -> str:
        return str(self.folder)

    def get_source_stamp(self) -> str:
        return self.folder.name

    def get_disambiguator(self) -> str:
        return str(self.line)


class _Implementation(CompileResultCacheImpl):  # type: ignore[misc]
    """Content of a file of compiled code."""

    _locator_classes = (_Locator,)

    def reduce(self, form: Any) -> tuple[Any, ...]:
        """Return a compiled form for the pickle, without references to unused modules of numba.

        Each reference is an import at loading: for example, `numba.np.arraymath` imports `scipy.linalg`.
        """
        *parts, environments = super().reduce(form)
        return *parts, tuple(e for e in environments if e.consts or not e.globals["__name__"].startswith("numba."))


class _KernelCache(FunctionCache):  # type: ignore[misc]
    """Compiled forms of a kernel on disk. A form that cannot be written is compiled again by the next process."""

    _impl_class = _Implementation

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return a compiled form, or None.

        numba would first load its declarations of functions and types, for about a second. Only compilation needs them.
        """
        rtsys.initialize(target_context)  # symbols of memory management for compiled code
        with self._guard_against_spurious_io_errors():
            form = self._load_overload(signature, target_context)
            if form is not None:
                return form
        target_context.refresh()
        return None

    def save_overload(self, signature: Any, data: Any) -> None:
        try:
            super().save_overload(signature, data)
        except OSError as error:  # a full disk, or a deleted folder
            _log.warning("%s is compiled but not cached on disk: %s", self._py_func.__name__, error)


def _cached_compile(kernel: Any, folder: Path) -> Callable[[Any], Any]:
    """Return a kernel's `compile` with the cache on disk, opened at the first call.

    It runs in a single process at a time; other processes then find its result on disk.
    """
    compile_kernel = kernel.compile

    def compiled(signature: Any) -> Any:
        with global_compiler_lock:
            if not isinstance(kernel._cache, _KernelCache):
                kernel._cache = _KernelCache(kernel.py_func)
            with _file_lock(folder / f"{kernel._cache._impl.filename_base}.lock"):  # same order in all threads
                return compile_kernel(signature)

    return compiled


@contextmanager
def _file_lock(path: Path) -> Iterator[None]:
    """Lock a file, if the file system supports locks."""
    file = None
    with suppress(OSError):
        file = path.open("w")
        fcntl.flock(file, fcntl.LOCK_EX)
    try:
        yield
    finally:
        if file is not None:
            with suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_UN)  # needed: a process forked meanwhile has the file open, too
            file.close()


kernel = _compiler()
inline = _compiler(inline="always")
vector = _compiler(fastmath={"contract", "nsz", "nnan"})  # for loops over input without NaN


@cache
def log_compilation(main_kernel: Any) -> None:
    """Log that kernels will be compiled, at level INFO, under the name of the kernel's package.

    Kernels in memory or in the cache on disk are not logged.

    Parameters
    ----------
    main_kernel : numba kernel
        Kernel that represents all kernels of a model.
    """
    if not is_compiled(main_kernel):
        package = ".".join(main_kernel.__module__.split(".")[:2])
        logging.getLogger(package).info("compiling kernels, once per environment: up to a minute")


def is_compiled(compiled: Any) -> bool:
    """Return whether a kernel is in memory or in the cache on disk, or numba's compiler is switched off."""
    if not hasattr(compiled, "signatures") or compiled.signatures:
        return True
    folder = cache_folder(Path(compiled.py_func.__code__.co_filename), compiled.__module__)
    return folder is not None and any(folder.glob(f"*.{compiled.__name__}-*.nbi"))
