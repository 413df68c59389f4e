"""One writer of a map at a time: a lock of the folder, or a lease in the object store.

A folder is locked by the system (`ogm.storage.locks`), which frees the lock when a process ends, however it ends.
Object stores have no locks: there the object ``writer.json`` is a lease, written on the condition that no other has
written it, and renewed every `RENEWED` seconds. A lease that has not changed for `DEAD` seconds, by the clock of the
waiting process, belongs to a killed process and is taken over.

In both, the object holds a token of the writer. Workers compare it before they write, so that those of a client that
was killed do not write into what the next one makes. What a worker has begun to write at that moment is written.
"""

import errno
import json
import logging
import os
import platform
import secrets
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from ogm.storage.files import finish_zarr
from ogm.storage.locks import locked
from ogm.storage.remote import is_remote
from ogm.world.stores import Url, local_path, read_object, reading, writing

WRITER = "writer.json"  # key of the object
RENEWED, DEAD = 5.0, 30.0  # [s] between renewals; without one after which a writer counts as dead
_log = logging.getLogger("ogm.world")


@contextmanager
def one_writer(url: Url, place: Any) -> Iterator[str]:
    """Keep other writers out of a map for the time of the ``with`` block; yield the token of this one.

    Parameters
    ----------
    url : str or path
    place : Zarr store
        Of the map, see `ogm.world.stores.open_store`.

    Raises
    ------
    BlockingIOError
        If another process writes to the map.
    OSError
        If the place cannot be written.
    """
    token = secrets.token_hex(8)
    with _in_store(url, place.store, token) if is_remote(url) else _in_folder(local_path(url), token):
        yield token


def check_writer(url: str, place: Any, token: str) -> None:
    """Raise BlockingIOError if another process has become the writer of a map."""
    with reading(url):
        found = read_object(place, WRITER)
    if found is None or _Lease.of(found).token != token:
        raise BlockingIOError(errno.EWOULDBLOCK, "another process has begun to write to this map", url)


class _Lease(NamedTuple):
    """What ``writer.json`` holds, and the version of the object that it was read from."""

    token: str  # empty: it is free
    who: str = ""
    version: dict[str, str] | None = None

    @classmethod
    def of(cls, content: bytes, version: dict[str, str] | None = None) -> "_Lease":
        try:
            found = json.loads(content)
            return cls(str(found["token"]), str(found["who"]), version)
        except (ValueError, TypeError, KeyError):  # not ours, and not renewed
            return cls("unknown", "unknown", version)


def _content(token: str, count: int = 0) -> bytes:
    who = f"process {os.getpid()} on {platform.node()}"
    return json.dumps({"token": token, "who": who, "renewed": count}).encode()


@contextmanager
def _in_folder(folder: Path, token: str) -> Iterator[None]:
    with writing(folder, folder):
        folder.mkdir(parents=True, exist_ok=True)
    with locked(folder):
        mark = folder / WRITER
        if mark.exists():  # the last writer was killed
            _sweep(folder)
        try:
            with writing(folder, folder):
                mark.write_bytes(_content(token))
            yield
        finally:
            finish_zarr()
            mark.unlink(missing_ok=True)
            _sweep(folder)  # of an interrupt, or of a worker that was killed


def _sweep(folder: Path) -> None:
    """Remove what Zarr had begun to write below a folder; no one must write there."""
    for parent, _, names in os.walk(folder):
        for name in names:
            if name.endswith(".partial"):
                Path(parent, name).unlink(missing_ok=True)


@contextmanager
def _in_store(url: Url, store: Any, token: str) -> Iterator[None]:
    with writing(url, url):
        version = _take(url, store, token)
    if version is None:
        _log.warning("%s takes no conditional writes: start one writer at a time", url)
        yield
        return
    ended, held = threading.Event(), [version]
    thread = threading.Thread(target=_renew, args=(store, token, held, ended), daemon=True, name="ogm lease")
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        with suppress(Exception):  # taken over, or out of reach: then it is taken over in `DEAD` seconds
            _put(store, _content(""), held[0])


def _take(url: Url, store: Any, token: str) -> dict[str, str] | None:
    """Take the lease, at once or when it has not changed for long; None where there are no conditional writes."""
    first: dict[str, str] | None = None
    since = 0.0
    while True:
        found = _found(store)
        if found.token == token:  # the answer to a write was lost
            return found.version
        free = not found.token
        if not free and first is not None and found.version != first:
            raise BlockingIOError(errno.EWOULDBLOCK, f"another process is writing to this map: {found.who}", str(url))
        if free or (first is not None and time.monotonic() - since > DEAD):
            try:
                return _put(store, _content(token), found.version)
            except Exception as error:
                if type(error).__name__ in ("NotSupportedError", "NotImplementedError"):
                    return None
                if type(error).__name__ not in ("AlreadyExistsError", "PreconditionError"):
                    raise
                first = None  # another one was faster
                continue
        if first is None:
            _log.info("%s was being written by %s: waiting for a sign of life", url, found.who)
            first, since = found.version, time.monotonic()
        time.sleep(min(0.5, RENEWED / 4))


def _renew(store: Any, token: str, held: list[dict[str, str]], ended: threading.Event) -> None:
    """Renew a lease until it has ended, or was taken over."""
    count = 0
    while not ended.wait(RENEWED):
        count += 1
        try:
            held[0] = _put(store, _content(token, count), held[0])
        except Exception as error:
            if type(error).__name__ == "PreconditionError":
                with suppress(Exception):
                    found = _found(store)
                    if found.token != token:
                        return  # `check_writer` tells who writes
                    held[0] = found.version or held[0]


def _found(store: Any) -> _Lease:
    """Return what the object holds; a free lease if there is none."""
    import obstore

    with suppress(FileNotFoundError):
        got = obstore.get(store, WRITER)
        return _Lease.of(bytes(got.bytes()), _version(got.meta))
    return _Lease("")


def _put(store: Any, content: bytes, version: dict[str, str] | None) -> dict[str, str]:
    """Write the lease if it is still of a version, or if there is none; return its version."""
    import obstore

    mode: Any = version or "create"  # TypedDict of obstore
    return _version(obstore.put(store, WRITER, content, mode=mode))


def _version(meta: Any) -> dict[str, str]:
    return {key: meta[key] for key in ("e_tag", "version") if meta.get(key) is not None}
