"""Objects in S3, Google Cloud Storage or Azure, by obstore: paths to read, in whole objects.

The last `CACHE` bytes read stay in memory. Zarr asks for the parts of a shard in turn, and the cache makes them one
request.
"""

import os
import threading
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from ogm.extras import install_line

CACHE = 128e6  # [byte] of objects that a process keeps per place
_NOT_KNOWN = object()


def is_remote(url: str | os.PathLike[str]) -> bool:
    """Return whether a place is in an object store, not on this machine."""
    return "://" in str(url) and not str(url).startswith("file://")


def object_store(url: str, storage: Mapping[str, str]) -> Any:
    """Return the obstore store of a URL; settings missing in `storage` are taken from the environment.

    Raises
    ------
    ImportError
        If obstore is missing.
    """
    try:
        from obstore.store import from_url
    except ImportError as error:
        raise ImportError(f"{url} needs the package obstore ({error}): {install_line('world')}") from error
    client: Any = {"allow_http": True} if storage.get("endpoint", "").startswith("http://") else None
    config: Any = dict(storage)
    return from_url(url, config=config, client_options=client)


def as_path(place: "str | os.PathLike[str] | ObjectPath", storage: Mapping[str, str] | None = None) -> Any:
    """Return the path of a local file or folder, or of an object.

    Parameters
    ----------
    place : str or path
        Local path, or ``s3://bucket/prefix``, also ``gs://``, ``az://``.
    storage : mapping of str to str, optional
        Configuration of the object store in the names of obstore: ``endpoint``, ``access_key_id``, ``region``, ...
        Missing settings are taken from the environment (``AWS_ENDPOINT_URL``, ``AWS_ACCESS_KEY_ID``, ...,
        ``AWS_ALLOW_HTTP``).

    Returns
    -------
    Path or ObjectPath

    Raises
    ------
    ValueError
        If a configuration is given for a local path.
    """
    if isinstance(place, ObjectPath):
        return place
    if is_remote(place):
        return ObjectPath(str(place), storage)
    if storage:
        raise ValueError(f"storage is for object stores (s3://...), got {sorted(storage)} for the local path {place}")
    return Path(place)


class ObjectPath:
    """Path in an object store, with the methods of `pathlib.Path` that reading needs.

    It can be pickled; an account key in `storage` is pickled with it.

    Parameters
    ----------
    url : str
        ``s3://bucket/prefix`` of a dataset.
    storage : mapping of str to str, optional
        Configuration of the object store, see `as_path`.
    key : str
        Key of an object, below the URL.
    """

    url: str
    storage: dict[str, str]
    key: str

    def __init__(self, url: str, storage: Mapping[str, str] | None = None, key: str = "") -> None:
        self.url, self.storage, self.key = url.rstrip("/"), dict(storage or {}), key

    def __truediv__(self, name: str) -> "ObjectPath":
        return ObjectPath(self.url, self.storage, f"{self.key}/{name}".lstrip("/"))

    def __str__(self) -> str:
        return f"{self.url}/{self.key}" if self.key else self.url

    def __repr__(self) -> str:
        return f"ObjectPath({str(self)!r})"  # without the account key

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ObjectPath) and (str(self), self.storage) == (str(other), other.storage)

    def __hash__(self) -> int:
        return hash(str(self))

    @property
    def name(self) -> str:
        """The last part of the path."""
        return str(self).rpartition("/")[2]

    def joinpath(self, *names: str) -> "ObjectPath":
        """Return a path below this path."""
        return self / "/".join(names)

    def absolute(self) -> "ObjectPath":
        """Return the path itself."""
        return self

    def exists(self) -> bool:
        """Return whether the object exists."""
        return self.objects.read([self.key])[0] is not None

    def read_bytes(self) -> bytes:
        """Return the bytes of the object.

        Raises
        ------
        FileNotFoundError
            If the object does not exist.
        OSError
            If the store cannot be reached, or refuses.
        """
        (data,) = self.objects.read([self.key])
        if data is None:
            raise FileNotFoundError(f"there is no {self}")
        return bytes(data)

    def fetch(self, keys: Iterable[str]) -> None:
        """Read objects below the URL concurrently, unless they are in memory."""
        self.objects.read(list(keys))

    @property
    def objects(self) -> "KeptObjects":
        """The objects below the URL, shared within this process."""
        return _objects(self.url, tuple(sorted(self.storage.items())), os.getpid())


class KeptObjects:
    """Objects below a URL; the last objects read are kept in memory.

    Parameters
    ----------
    url : str
    storage : mapping of str to str
    """

    url: str
    requests: int
    bytes: int

    def __init__(self, url: str, storage: Mapping[str, str]) -> None:
        self.url, self._store = url, object_store(url, storage)
        self._kept: OrderedDict[str, Any] = OrderedDict()  # None for an object that does not exist
        self._size, self._lock = 0, threading.Lock()
        self.requests = self.bytes = 0

    @property
    def zarr(self) -> Any:
        """The objects as a Zarr store to read."""
        return _zarr_store()(self)

    def read(self, keys: list[str]) -> list[Any]:
        """Return objects, None for missing objects; reads run concurrently."""
        from zarr.core.sync import sync

        with self._lock:
            found = [self._look_up(key) for key in keys]
        if any(data is _NOT_KNOWN for data in found):
            found = sync(self._read(keys))
        return found

    async def _read(self, keys: list[str]) -> list[Any]:
        import asyncio

        return list(await asyncio.gather(*map(self.get, keys)))

    async def get(self, key: str) -> Any:
        """Return an object, from memory or the store; None if it does not exist.

        Raises
        ------
        OSError
            If the store cannot be reached, or refuses.
        """
        import obstore

        with self._lock:
            found = self._look_up(key)
        if found is not _NOT_KNOWN:
            return found
        try:
            data: Any = await (await obstore.get_async(self._store, key)).bytes_async()
        except FileNotFoundError:
            data = None
        except Exception as error:  # obstore has many error classes
            text = " ".join(str(error).split())[:300] or type(error).__name__
            raise OSError(f"{self.url}/{key} cannot be read ({text})") from error
        with self._lock:
            if key not in self._kept:
                self._kept[key], self.requests = data, self.requests + 1
                self._size += 0 if data is None else len(data)
                self.bytes += 0 if data is None else len(data)
            while self._size > CACHE and len(self._kept) > 1:
                old = self._kept.popitem(last=False)[1]
                self._size -= 0 if old is None else len(old)
        return data

    def _look_up(self, key: str) -> Any:
        if key not in self._kept:
            return _NOT_KNOWN
        self._kept.move_to_end(key)
        return self._kept[key]


@lru_cache(8)
def _objects(url: str, storage: tuple[tuple[str, str], ...], process: int) -> KeptObjects:
    """Return the objects below a URL, once per process: connections do not survive a fork."""
    return KeptObjects(url, dict(storage))


@lru_cache(1)
def _zarr_store() -> Any:
    """Return the class of Zarr stores over `KeptObjects`; imports Zarr on first use."""
    from zarr.abc.store import OffsetByteRequest, RangeByteRequest, Store, SuffixByteRequest

    class ObjectsStore(Store):
        """Zarr store that reads whole objects and returns parts."""

        supports_writes = supports_deletes = supports_listing = False

        def __init__(self, objects: KeptObjects) -> None:
            super().__init__(read_only=True)
            self.objects = objects

        def __eq__(self, other: object) -> bool:
            return isinstance(other, ObjectsStore) and self.objects is other.objects

        async def get(self, key: str, prototype: Any, byte_range: Any = None) -> Any:
            data = await self.objects.get(key)
            if data is None:
                return None
            view = memoryview(data)
            if isinstance(byte_range, RangeByteRequest):
                view = view[byte_range.start : byte_range.end]
            elif isinstance(byte_range, OffsetByteRequest):
                view = view[byte_range.offset :]
            elif isinstance(byte_range, SuffixByteRequest):
                view = view[-byte_range.suffix :]
            return prototype.buffer.from_bytes(view)

        async def get_partial_values(self, prototype: Any, key_ranges: Any) -> list[Any]:
            return [await self.get(key, prototype, part) for key, part in key_ranges]

        async def exists(self, key: str) -> bool:
            return await self.objects.get(key) is not None

        async def set(self, key: str, value: Any) -> None:
            self._check_writable()

        async def delete(self, key: str) -> None:
            self._check_writable()

        def list(self, prefix: str = "") -> Any:
            raise OSError(f"cannot list the objects of {self.objects.url}: objects are read by name only")

        list_prefix = list_dir = list

    return ObjectsStore
