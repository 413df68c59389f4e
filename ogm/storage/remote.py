"""Objects in S3, Google Cloud Storage or Azure, by obstore: paths that are read, whole objects at a time.

What is read stays in memory, the last `CACHE` bytes of it, so that the parts of a shard that Zarr asks for one after
the other are one request.
"""

import os
import threading
from collections import OrderedDict
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from ogm.extras import install_line

CACHE = 128e6  # [byte] of objects that a process keeps of each place
_NOT_KNOWN = object()


def is_remote(url: str | os.PathLike[str]) -> bool:
    """Return whether a place is in an object store, not on this machine."""
    return "://" in str(url) and not str(url).startswith("file://")


def object_store(url: str, storage: Mapping[str, str]) -> Any:
    """Return the obstore store of a URL; what `storage` does not give is taken from the environment.

    Raises
    ------
    ImportError
        If obstore is missing.
    """
    try:
        from obstore.store import from_url
    except ImportError as error:
        raise ImportError(
            f"{url} lies in an object store, which needs obstore ({error}): {install_line('world')}"
        ) from error
    client: Any = {"allow_http": True} if storage.get("endpoint", "").startswith("http://") else None
    config: Any = dict(storage)
    return from_url(url, config=config, client_options=client)


def as_path(place: "str | os.PathLike[str] | ObjectPath", storage: Mapping[str, str] | None = None) -> Any:
    """Return the path of a file or folder of this machine, or of an object.

    Parameters
    ----------
    place : str or path
        On this machine, or ``s3://bucket/prefix``, also ``gs://``, ``az://``.
    storage : mapping of str to str, optional
        Configuration of the object store, as obstore has it: ``endpoint``, ``access_key_id``, ``region``, ... What is
        not given is taken from the environment (``AWS_ENDPOINT_URL``, ``AWS_ACCESS_KEY_ID``, ..., ``AWS_ALLOW_HTTP``).

    Returns
    -------
    Path or ObjectPath

    Raises
    ------
    ValueError
        If there is a configuration for a path on this machine.
    """
    if isinstance(place, ObjectPath):
        return place
    if is_remote(place):
        return ObjectPath(str(place), storage)
    if storage:
        raise ValueError(f"storage is for object stores (s3://...), got {sorted(storage)} for {place}")
    return Path(place)


class ObjectPath:
    """A place in an object store, with those methods of `pathlib.Path` that reading needs.

    May be pickled; the key of an account in `storage` goes with it.

    Parameters
    ----------
    url : str
        ``s3://bucket/prefix`` of a data set.
    storage : mapping of str to str, optional
        As of `as_path`.
    key : str
        Of an object, below the URL.
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
        return f"ObjectPath({str(self)!r})"  # without the key of an account

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ObjectPath) and (str(self), self.storage) == (str(other), other.storage)

    def __hash__(self) -> int:
        return hash(str(self))

    @property
    def name(self) -> str:
        """The last part."""
        return str(self).rpartition("/")[2]

    def joinpath(self, *names: str) -> "ObjectPath":
        """Return a place below."""
        return self / "/".join(names)

    def absolute(self) -> "ObjectPath":
        """Return the place itself."""
        return self

    def exists(self) -> bool:
        """Return whether there is such an object."""
        return self.objects.read([self.key])[0] is not None

    def read_bytes(self) -> bytes:
        """Return an object.

        Raises
        ------
        FileNotFoundError
            If there is none.
        OSError
            If the store cannot be reached, or refuses.
        """
        (data,) = self.objects.read([self.key])
        if data is None:
            raise FileNotFoundError(f"there is no {self}")
        return bytes(data)

    def fetch(self, keys: Iterable[str]) -> None:
        """Read objects below the URL at the same time, where they are not in memory yet."""
        self.objects.read(list(keys))

    @property
    def objects(self) -> "KeptObjects":
        """The objects below the URL, of this process."""
        return _objects(self.url, tuple(sorted(self.storage.items())), os.getpid())


class KeptObjects:
    """Objects of a place; the last ones that were read are kept, whole.

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
        self._kept: OrderedDict[str, Any] = OrderedDict()  # None for what is not there
        self._size, self._lock = 0, threading.Lock()
        self.requests = self.bytes = 0

    @property
    def zarr(self) -> Any:
        """The objects as a Zarr store to read."""
        return _zarr_store()(self)

    def read(self, keys: list[str]) -> list[Any]:
        """Return objects, None for those that are not there; those that are not in memory are read at once."""
        from zarr.core.sync import sync

        with self._lock:
            found = [self._look_up(key) for key in keys]
        if any(one is _NOT_KNOWN for one in found):
            found = sync(self._read(keys))
        return found

    async def _read(self, keys: list[str]) -> list[Any]:
        import asyncio

        return list(await asyncio.gather(*map(self.get, keys)))

    async def get(self, key: str) -> Any:
        """Return an object, from memory or the store; None if it is not there.

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
        except Exception as error:  # obstore has many
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
    """Return the objects of a place, once per process: a fork has no connections."""
    return KeptObjects(url, dict(storage))


@lru_cache(1)
def _zarr_store() -> Any:
    """Return the class of Zarr stores over `KeptObjects`; Zarr is imported when it is needed."""
    from zarr.abc.store import OffsetByteRequest, RangeByteRequest, Store, SuffixByteRequest

    class ObjectsStore(Store):
        """Whole objects, of which Zarr takes parts."""

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
            raise OSError(f"the objects of {self.objects.url} are not listed, but read by name")

        list_prefix = list_dir = list

    return ObjectsStore
