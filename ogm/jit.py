"""Compilation of kernels: numba's flags, and the cache of compiled kernels on disk.

All kernels release the GIL. numpy's error model spares divisions a branch that would keep loops off the vector units.
Compilation takes tens of seconds, and the less there is to compile the better: loops rather than array expressions
(`np.where`, slices that are assigned), no constants where a variable does (each is a signature of its own), `inline`
only where the result needs it, and rules as constants of a kernel's closure, so that the others are left out.

numba's own cache looks at the file of a kernel alone, so that it keeps machine code of helpers that have changed in
another file. Here the compiled kernels of a module lie in a folder whose name has a hash of the module's source and of
all modules of ogm that it imports, of the versions of numba and Python, and of the processor. It does not depend on the
place of the installation: a new clone of the same sources finds the kernels of an older one. The folders are below
``$NUMBA_CACHE_DIR/ogm`` or else ``$XDG_CACHE_HOME/ogm`` or ``~/.cache/ogm``; if that cannot be written, each process
compiles for itself.
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
KEPT_VERSIONS = 3  # folders of a module that stay when it is compiled anew, the last used first
_PACKAGE = Path(__file__).parent
_IMPORT = re.compile(r"^(?:from (ogm[\w.]*) import (\([^)]*\)|[^\n]*)|import (ogm[\w.]*))", re.MULTILINE)

_log = logging.getLogger(__name__)


class Compiler(Protocol):
    """A decorator that compiles a function; types are checked as if it did not."""

    def __call__(self, function: Function, /) -> Function:
        """Return the compiled function."""


def _compiler(**flags: Any) -> Compiler:
    """Return the decorator of kernels with some flags of numba."""
    compiler: Any = njit(nogil=True, error_model="numpy", no_cfunc_wrapper=True, **flags)

    def compiled(function: Any) -> Any:
        kernel = compiler(function)
        folder = cache_folder(Path(function.__code__.co_filename), function.__module__)
        if kernel is not function and folder is not None:  # the same if numba's compiler is switched off
            kernel.compile = _kept(kernel, folder)
        return kernel

    return compiled


@cache
def cache_folder(path: Path, module: str) -> Path | None:
    """Return the folder of a module's compiled kernels, or None if it has no source or no folder can be written.

    Parameters
    ----------
    path : Path
        Source of the module.
    module : str
        Its name.
    """
    root = os.environ.get("NUMBA_CACHE_DIR") or os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    try:
        parts = [numba.__version__, sys.implementation.cache_tag or "", get_host_cpu_name()]
        digest = hashlib.sha256("\0".join([*parts, *(_text(one)[0] for one in _sources(path))]).encode())
        folder = Path(root).expanduser() / "ogm" / f"{module}-{digest.hexdigest()[:16]}"
        if not folder.is_dir():
            folder.mkdir(parents=True, exist_ok=True)
            for old in sorted(folder.parent.glob(f"{module}-*"), key=os.path.getmtime)[:-KEPT_VERSIONS]:
                shutil.rmtree(old, ignore_errors=True)
        os.utime(folder)
    except (OSError, RuntimeError):  # RuntimeError: there is no home
        return None
    return folder if os.access(folder, os.W_OK) else None


def _sources(path: Path) -> list[Path]:
    """Return a module's file and those of all modules of ogm that it imports, directly or not, in a fixed order."""
    found, left = {path}, [path]
    while left:
        new = set(_text(left.pop())[1]) - found
        found |= new
        left += new
    return [path, *sorted(found - {path})]


@cache
def _text(path: Path) -> tuple[str, tuple[Path, ...]]:
    """Return the text of a module, and the files of ogm's modules that it imports at its top level."""
    text, names = path.read_text(encoding="utf-8"), set()
    for package, imported, module in _IMPORT.findall(text):
        names.add(package or module)
        names |= {f"{package}.{name}" for name in re.findall(r"\w+", imported)}
    return text, tuple(file for file in map(_file_of, names) if file is not None)


@cache
def _file_of(name: str) -> Path | None:
    """Return the file of a module of ogm, or None if the name is of something else."""
    base = f"{_PACKAGE.parent}/{name.replace('.', '/')}"
    return next((Path(file) for file in (f"{base}.py", f"{base}/__init__.py") if os.path.isfile(file)), None)


class _Locator:
    """numba's interface of a place of compiled code: the folder of a module."""

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
    """The content of a file of compiled code."""

    _locator_classes = (_Locator,)

    def reduce(self, form: Any) -> tuple[Any, ...]:
        """Return a compiled form as it is pickled, without references to modules of numba that it does not read.

        Each reference is an import at loading: `numba.np.arraymath`, say, brings in `scipy.linalg`.
        """
        *parts, environments = super().reduce(form)
        return *parts, tuple(e for e in environments if e.consts or not e.globals["__name__"].startswith("numba."))


class _KernelCache(FunctionCache):  # type: ignore[misc]
    """The compiled forms of a kernel on disk. A form that cannot be written costs the next process its compilation."""

    _impl_class = _Implementation

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return a compiled form, or None.

        numba loads its declarations of functions and types first, for about a second. Compilation alone needs them.
        """
        rtsys.initialize(target_context)  # the symbols of memory management in compiled code
        with self._guard_against_spurious_io_errors():
            form = self._load_overload(signature, target_context)
            if form is not None:
                return form
        target_context.refresh()
        return None

    def save_overload(self, signature: Any, data: Any) -> None:
        try:
            super().save_overload(signature, data)
        except OSError as error:  # a full disk, or a folder that is gone
            _log.warning("%s is compiled but not kept: %s", self._py_func.__name__, error)


def _kept(kernel: Any, folder: Path) -> Callable[[Any], Any]:
    """Return a kernel's `compile` with the cache on disk, which is opened at the first call.

    It runs in one process at a time; the others then find its result on disk.
    """
    compile_kernel = kernel.compile

    def compiled(signature: Any) -> Any:
        with global_compiler_lock:
            if not isinstance(kernel._cache, _KernelCache):
                kernel._cache = _KernelCache(kernel.py_func)
            with _file_lock(folder / f"{kernel._cache._impl.filename_base}.lock"):  # in this order in all threads
                return compile_kernel(signature)

    return compiled


@contextmanager
def _file_lock(path: Path) -> Iterator[None]:
    """Lock a file, if the file system can."""
    file = None
    with suppress(OSError):
        file = path.open("w")
        fcntl.flock(file, fcntl.LOCK_EX)
    try:
        yield
    finally:
        if file is not None:
            with suppress(OSError):
                fcntl.flock(file, fcntl.LOCK_UN)  # a process that was forked meanwhile has the file open, too
            file.close()


kernel = _compiler()
inline = _compiler(inline="always")
vector = _compiler(fastmath={"contract", "nsz", "nnan"})  # for loops whose input holds no NaN


@cache
def log_compilation(main_kernel: Any) -> None:
    """Log at level INFO, under the name of the kernel's package, that kernels will be compiled.

    Nothing is logged if they are in memory or in the cache on disk.

    Parameters
    ----------
    main_kernel : numba kernel
        The one that stands for all that a model needs.
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
