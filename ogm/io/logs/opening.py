"""`open_log`: which kind of log a file is, and which files are parts of one."""

import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path

from ogm.io.logs.bag_file import BAG_MAGIC, BagFile
from ogm.io.logs.db3_file import DB3_MAGIC, Db3File
from ogm.io.logs.files import LogFile
from ogm.io.logs.mcap_file import MCAP_MAGIC, McapFile
from ogm.io.logs.reader import LogReader
from ogm.storage.files import FilePath, OgmError

LOG_ENDINGS = (".mcap", ".db3", ".bag")
_KINDS: dict[bytes, Callable[[Path], LogFile]] = {MCAP_MAGIC: McapFile, DB3_MAGIC: Db3File, BAG_MAGIC: BagFile}


def open_log(path: FilePath | Sequence[FilePath]) -> LogReader:
    """Open a log: a ROS 1 bag (``.bag``), a ROS 2 bag (``.db3``), an MCAP (``.mcap``), or a folder with parts of one.

    The first bytes of a file decide what it is. Parts of a recording that was split are one log. Neither
    ``metadata.yaml`` nor an index at the end of a file is needed: of a file that was cut, all whole messages before the
    cut are read, and `LogReader.warnings` states where it was cut.

    Parameters
    ----------
    path : path or sequence of paths

    Returns
    -------
    LogReader
        A context manager.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If it is no log, empty, or so damaged that nothing can be read.
    """
    given = [path] if isinstance(path, str | os.PathLike) else list(path)
    paths = [one for each in given for one in (log_files(Path(each)) if Path(each).is_dir() else [Path(each)])]
    if not paths:
        raise OgmError(f"{given[0] if given else 'nothing'} holds no log ({', '.join(LOG_ENDINGS)})")
    return LogReader(paths, [_opened(path) for path in paths])


def log_files(folder: Path) -> list[Path]:
    """Return the parts of a log that lie in a folder, with part 2 before part 10.

    Raises
    ------
    OgmError
        If they are of several kinds.
    """
    files = [one for one in folder.iterdir() if one.suffix.lower() in LOG_ENDINGS and one.is_file()]
    if len({one.suffix.lower() for one in files}) > 1:
        names = ", ".join(sorted(one.name for one in files))
        raise OgmError(f"{folder} holds logs of several kinds ({names}): give one of them")
    return sorted(files, key=lambda one: [int(part) if part.isdecimal() else part for part in _parts(one)])


def _parts(path: Path) -> list[str]:
    return re.split(r"(\d+)", path.name)


def _opened(path: Path) -> LogFile:
    if not path.exists():
        raise FileNotFoundError(f"there is no {path}: check the name and the folder")
    with open(path, "rb") as file:
        start = file.read(16)
    if not start:
        raise OgmError(f"{path} holds 0 bytes: was it recorded, or copied, to its end?")
    for magic, kind in _KINDS.items():
        if start.startswith(magic):
            return kind(path)
    packed = start.startswith(b"\x28\xb5\x2f\xfd")
    way = f"unpack it first: zstd -d {path.name}" if packed else "is its name right?"
    raise OgmError(f"{path} is no log: it begins with {start!r}, wanted an MCAP, a ROS 1 bag or a ROS 2 bag; {way}")
