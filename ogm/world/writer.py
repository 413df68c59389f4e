"""Exclusive writing to a map: a lock of the folder, or a lease in the object store.

A folder is locked by the operating system (`ogm.storage.locks`), which releases the lock however the process ends.
Object stores have no locks. There the object ``writer.json`` is a lease: it is written only if no other process has
written it, and renewed every `RENEWAL_INTERVAL` seconds. A lease that has not changed for `LEASE_TIMEOUT` seconds, by
the clock of the waiting process, belongs to a killed process and is taken over.

In both cases the object contains a token of the writer. Workers check it before they write, so that workers of a killed
client do not write into the map of the next one. A write that has begun at that moment is completed.
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
RENEWAL_INTERVAL, LEASE_TIMEOUT = 5.0, 30.0  # [s] between renewals; without renewal until a lease is taken over
_log = logging.getLogger("ogm.world")


@contextmanager
def one_writer(url: Url, place: Any) -> Iterator[str]:
    """Keep other writers out of a map during a ``with`` block; yield the token of this writer.

    Parameters
    ----------
    url : str or path
    place : Zarr store
        Store of the map, see `ogm.world.stores.open_store`.

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
        raise BlockingIOError(errno.EWOULDBLOCK, "another process has become the writer of this map", url)


class _Lease(NamedTuple):
    """Content of ``writer.json``, and the version of the object from which it was read."""

    token: str  # empty if the lease is free
    who: str = ""
    version: dict[str, str] | None = None

    @classmethod
    def of(cls, content: bytes, version: dict[str, str] | None = None) -> "_Lease":
        try:
            found = json.loads(content)
            return cls(str(found["token"]), str(found["who"]), version)
        except (ValueError, TypeError, KeyError):  # of an unknown program, and not renewed
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
        if mark.exists():  # left by a killed writer
            _sweep(folder)
        try:
            with writing(folder, folder):
                mark.write_bytes(_content(token))
            yield
        finally:
            finish_zarr()
            mark.unlink(missing_ok=True)
            _sweep(folder)  # after an interrupt, or a killed worker


def _sweep(folder: Path) -> None:
    """Remove unfinished Zarr writes below a folder; no process may write there."""
    for parent, _, names in os.walk(folder):
        for name in names:
            if name.endswith(".partial"):
                Path(parent, name).unlink(missing_ok=True)


@contextmanager
def _in_store(url: Url, store: Any, token: str) -> Iterator[None]:
    with writing(url, url):
        version = _take(url, store, token)
    if version is None:
        _log.warning("%s has no conditional writes: start only one writer at a time", url)
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
        with suppress(Exception):  # if it was taken over or is out of reach, the lease expires
            _put(store, _content(""), held[0])


def _take(url: Url, store: Any, token: str) -> dict[str, str] | None:
    """Take the lease, at once or when it has expired; None if the store has no conditional writes."""
    first: dict[str, str] | None = None
    since = 0.0
    while True:
        found = _found(store)
        if found.token == token:  # the reply to a write was lost
            return found.version
        free = not found.token
        if not free and first is not None and found.version != first:
            raise BlockingIOError(errno.EWOULDBLOCK, f"another process is writing to this map: {found.who}", str(url))
        if free or (first is not None and time.monotonic() - since > LEASE_TIMEOUT):
            try:
                return _put(store, _content(token), found.version)
            except Exception as error:
                if type(error).__name__ in ("NotSupportedError", "NotImplementedError"):
                    return None
                if type(error).__name__ not in ("AlreadyExistsError", "PreconditionError"):
                    raise
                first = None  # another process has taken it
                continue
        if first is None:
            _log.info("%s was last written by %s: waiting for a renewal of the lease", url, found.who)
            first, since = found.version, time.monotonic()
        time.sleep(min(0.5, RENEWAL_INTERVAL / 4))


def _renew(store: Any, token: str, held: list[dict[str, str]], ended: threading.Event) -> None:
    """Renew a lease until it ends or is taken over."""
    count = 0
    while not ended.wait(RENEWAL_INTERVAL):
        count += 1
        try:
            held[0] = _put(store, _content(token, count), held[0])
        except Exception as error:
            if type(error).__name__ == "PreconditionError":
                with suppress(Exception):
                    found = _found(store)
                    if found.token != token:
                        return  # `check_writer` raises at the next write
                    held[0] = found.version or held[0]


def _found(store: Any) -> _Lease:
    """Return the lease in the object, or a free lease if there is no object."""
    import obstore

    with suppress(FileNotFoundError):
        got = obstore.get(store, WRITER)
        return _Lease.of(bytes(got.bytes()), _version(got.meta))
    return _Lease("")


def _put(store: Any, content: bytes, version: dict[str, str] | None) -> dict[str, str]:
    """Write the lease if the object still has a version, or does not exist if None; return the new version."""
    import obstore

    mode: Any = version or "create"  # TypedDict of obstore
    return _version(obstore.put(store, WRITER, content, mode=mode))


def _version(meta: Any) -> dict[str, str]:
    return {key: meta[key] for key in ("e_tag", "version") if meta.get(key) is not None}
