"""How much memory the content of one file may take: stated here, adjustable, checked before or while it is decoded.

A small file can be made that unpacks to any size. What a reader decodes, arrays or text, stays within these limits, and
its peak within three times that and 100 MB.
"""

import os
from dataclasses import dataclass, fields, replace

from ogm.storage.files import OgmError

__all__ = ["MemoryLimits", "current_limits", "set_limits", "too_large"]


@dataclass(frozen=True)
class MemoryLimits:
    """Upper bounds for the decoded content of one file [byte].

    The environment variable ``OGM_LIMITS`` sets them for a process, as in ``OGM_LIMITS="file=4e9 json=8e9"``, and
    `set_limits` from then on.

    Parameters
    ----------
    file : int
        Of a file, a message or a chunk of a log, unpacked: by default 1 GiB, 67 million points of 16 bytes.
    text : int
        Of the points of a cloud in text; by default 256 MiB, some 10 million points.
    lines : int
        Of a file of lines: poses, labels, calibrations; by default 64 MiB, 370,000 poses of KITTI.
    json : int
        Of what a JSON file becomes in Python, estimated before; by default 1 GiB.
    tables : int
        The same of the tables of nuScenes, which are its index; by default 16 GiB. The full data set needs about 7.
    grid : int
        Of the arrays of a grid file; by default 2 GiB, the masses of 2**28 cells.
    image : int
        Of the pixels of an image; by default 1 GiB.

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
        for one in fields(self):
            value = getattr(self, one.name)
            if not (isinstance(value, int | float) and 1 <= value < float("inf") and value == int(value)):
                raise ValueError(f"the limit {one.name} must be a whole number of bytes above 0, got {value!r}")
            object.__setattr__(self, one.name, int(value))


def current_limits() -> MemoryLimits:
    """Return the limits of this process."""
    return _now[0]


def set_limits(limits: MemoryLimits | None = None, /, **changes: float) -> MemoryLimits:
    """Change limits for this process, in all threads; return what they were.

    Parameters
    ----------
    limits : MemoryLimits, optional
        All of them, such as an earlier call returned.
    **changes
        Single ones by their names [byte].

    Raises
    ------
    TypeError
        If there is no limit of that name.
    ValueError
        If one is not a whole number above 0.

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
        What holds it.
    size : int or None
        Its size [byte]; None where only more than the limit is known.
    limit : str
        Name of a field of `MemoryLimits`.
    """
    most = getattr(current_limits(), limit)
    got = f"more than {most}" if size is None else str(size)
    return OgmError(
        f"{where} holds {got} bytes when decoded, wanted at most {most}: split it, make it coarser, or raise the "
        f"limit by ogm.storage.limits.set_limits({limit}=...) or OGM_LIMITS={limit}=..."
    )


def _from_environment(text: str) -> MemoryLimits:
    try:
        pairs = (one.split("=") for one in text.replace(",", " ").split())
        return MemoryLimits(**{name: float(value) for name, value in pairs})  # type: ignore[arg-type]
    except (ValueError, TypeError, OverflowError) as error:
        names = ", ".join(one.name for one in fields(MemoryLimits))
        raise ValueError(f"OGM_LIMITS must be pairs such as file=4e9, of {names}, got {text!r}") from error


_now = [_from_environment(os.environ.get("OGM_LIMITS", ""))]
