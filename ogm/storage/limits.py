"""Memory limits for the decoded content of a file: adjustable, checked before or during decoding.

A small file can unpack to any size. The decoded arrays or text of a reader stay within these limits, and its peak
within three times the limit plus 100 MB.
"""

import os
from dataclasses import dataclass, fields, replace

from ogm.storage.files import OgmError

__all__ = ["MemoryLimits", "current_limits", "set_limits", "too_large"]


@dataclass(frozen=True)
class MemoryLimits:
    """Upper bounds for the decoded content of a file [byte].

    The environment variable ``OGM_LIMITS`` sets them for a process, as in ``OGM_LIMITS="file=4e9 json=8e9"``;
    `set_limits` changes them later.

    Parameters
    ----------
    file : int
        A file, a message or a chunk of a log, unpacked. Default 1 GiB, 67 million points of 16 bytes.
    text : int
        The points of a cloud in text. Default 256 MiB, about 10 million points.
    lines : int
        A file of lines: poses, labels, calibrations. Default 64 MiB, 370,000 poses of KITTI.
    json : int
        The Python objects of a JSON file, estimated before decoding. Default 1 GiB.
    tables : int
        The Python objects of the nuScenes tables, its index. Default 16 GiB; the full dataset needs about 7.
    grid : int
        The arrays of a grid file. Default 2 GiB, the masses of 2**28 cells.
    image : int
        The pixels of an image. Default 1 GiB.

    Raises
    ------
    ValueError
        If a limit is not a whole number above 0.
    """

    file: int = 2**30
    text: int = 2**28
    lines: int = 2**26
    json: int = 2**30
    tables: int = 2**34
    grid: int = 2**31
    image: int = 2**30

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (isinstance(value, int | float) and 1 <= value < float("inf") and value == int(value)):
                raise ValueError(f"the limit {field.name} must be a whole number of bytes above 0, got {value!r}")
            object.__setattr__(self, field.name, int(value))


def current_limits() -> MemoryLimits:
    """Return the limits of this process."""
    return _now[0]


def set_limits(limits: MemoryLimits | None = None, /, **changes: float) -> MemoryLimits:
    """Change limits for this process, in all threads; return the previous limits.

    Parameters
    ----------
    limits : MemoryLimits, optional
        All limits, such as returned by an earlier call.
    **changes
        Single limits by name [byte].

    Raises
    ------
    TypeError
        If there is no limit of that name.
    ValueError
        If a limit is not a whole number above 0.

    Examples
    --------
    >>> before = set_limits(file=4 * 2**30)
    >>> set_limits(before).file == 4 * 2**30
    True
    """
    before = _now[0]
    _now[0] = replace(limits or before, **changes)  # type: ignore[arg-type]
    return before


def too_large(where: object, size: int | None, limit: str) -> OgmError:
    """Return the error for content beyond a limit.

    Parameters
    ----------
    where : path or str
        Name of the content.
    size : int or None
        Its size [byte]; None if only known to exceed the limit.
    limit : str
        Name of a field of `MemoryLimits`.
    """
    max_bytes = getattr(current_limits(), limit)
    got = f"more than {max_bytes}" if size is None else str(size)
    return OgmError(
        f"{where} holds {got} bytes when decoded, wanted at most {max_bytes}: split it, make it coarser, or raise the "
        f"limit by ogm.storage.limits.set_limits({limit}=...) or OGM_LIMITS={limit}=..."
    )


def _from_environment(text: str) -> MemoryLimits:
    try:
        pairs = (pair.split("=") for pair in text.replace(",", " ").split())
        return MemoryLimits(**{name: float(value) for name, value in pairs})  # type: ignore[arg-type]
    except (ValueError, TypeError, OverflowError) as error:
        names = ", ".join(field.name for field in fields(MemoryLimits))
        raise ValueError(f"OGM_LIMITS must be pairs such as file=4e9, of {names}, got {text!r}") from error


_now = [_from_environment(os.environ.get("OGM_LIMITS", ""))]
