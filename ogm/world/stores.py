"""Places of world maps: a folder, a zip archive, or an object store such as S3, as Zarr stores."""

import errno
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from ogm.extras import import_extra
from ogm.storage.files import OgmError, naming
from ogm.storage.remote import is_remote, object_store

Url = str | os.PathLike[str]
Mode = Literal["r", "r+"]


def is_zip(url: Url) -> bool:
    """Return whether a map lies in a zip archive."""
    return not is_remote(url) and str(url).lower().endswith(".zip")


def local_path(url: Url) -> Path:
    """Return the path of a map on this machine."""
    return Path(str(url).removeprefix("file://"))


def open_store(url: Url, mode: Mode, storage: Mapping[str, str] | None = None) -> Any:
    """Return the Zarr store of a place, whether it exists or not.

    Parameters
    ----------
    url : str or path
        A folder, a ``.zip`` archive to read, or ``s3://bucket/prefix``, also ``gs://``, ``az://``.
    mode : {"r", "r+"}
    storage : mapping of str to str, optional
        Configuration of the object store, as obstore has it: ``endpoint``, ``access_key_id``, ``region``, ... What is
        not given is taken from the environment (``AWS_ENDPOINT_URL``, ``AWS_ACCESS_KEY_ID``, ..., ``AWS_ALLOW_HTTP``).

    Raises
    ------
    ValueError
        If options are given for a folder, or a zip archive is to be written.
    ImportError
        If zarr, or for an object store obstore, is missing.
    """
    zarr = import_extra("zarr", "world")
    if is_remote(url):
        with reading(url, "see ogm.world.stores.open_store for the options of object stores"):
            return zarr.storage.ObjectStore(object_store(str(url), storage or {}), read_only=mode == "r")
    if storage:
        raise ValueError(f"storage options are for object stores (s3://...), got {sorted(storage)} for {url}")
    if is_zip(url):
        if mode != "r":
            raise ValueError(
                f"{url} is a zip archive, in which nothing can be replaced: make the map in a folder or a bucket, then "
                "WorldMap.copy_to writes the archive in one go"
            )
        if not local_path(url).is_file():
            raise FileNotFoundError(f"there is no archive {url}")
        with reading(url):
            return zarr.storage.ZipStore(local_path(url), mode="r")
    if local_path(url).is_file():
        raise OgmError(f"{url} is a file; a world map is a folder, a .zip archive or the URL of an object store")
    return zarr.storage.LocalStore(local_path(url), read_only=mode == "r")


@contextmanager
def reading(what: object, way: str = "restore it from a copy") -> Iterator[None]:
    """Give errors of Zarr and of stores on reading the name of what is read; those of the system stay."""
    try:
        yield
    except (OgmError, ImportError):
        raise
    except MemoryError as error:  # a made-up index or size, most likely
        raise OgmError(f"{what} cannot be read: it states more bytes than there is memory for; {way}") from error
    except Exception as error:  # Zarr, its codecs, zip archives and obstore have many
        if isinstance(error, OSError) and error.errno != errno.EINVAL:  # that is a place no file has, in an archive
            raise
        text = " ".join(str(error).split())[:300] or type(error).__name__
        raise OgmError(f"{what} cannot be read ({text}): {way}") from error


@contextmanager
def writing(url: Url, what: object) -> Iterator[None]:
    """Give errors of a store on writing the name of what is written; those of the system keep their numbers."""
    try:
        with naming(local_path(url)):
            yield
    except (OSError, OgmError, MemoryError):
        raise
    except Exception as error:
        text = " ".join(str(error).split())[:300] or type(error).__name__
        raise OSError(f"{what} cannot be written ({text})") from error


def keys(store: Any, prefix: str) -> list[str]:
    """Return the keys of a store that begin with a prefix, sorted."""
    return sorted(key for key in _listed(store.list_prefix, prefix) if not key.endswith(".partial"))


def children(store: Any, prefix: str) -> list[str]:
    """Return the names directly below a prefix, sorted."""
    return sorted(key.rstrip("/") for key in _listed(store.list_dir, prefix))


def _listed(listing: Any, prefix: str) -> list[str]:
    """Return what an asynchronous method of a store lists."""

    async def found() -> list[str]:
        return [key async for key in listing(prefix)]

    return list(_sync(found()))


def read_object(store: Any, key: str) -> bytes | None:
    """Return the content of an object; None if there is none."""
    from zarr.core.buffer import default_buffer_prototype

    found = _sync(store.get(key, default_buffer_prototype()))
    return None if found is None else bytes(found.to_bytes())


def size(store: Any, prefix: str) -> int:
    """Return the bytes of all objects whose keys begin with a prefix."""
    return int(_sync(store.getsize_prefix(prefix)))


def erase(store: Any, key: str) -> None:
    """Remove an object; nothing happens if there is none."""
    _sync(store.delete(key))


def _sync(coroutine: Any) -> Any:
    """Return the result of a coroutine of Zarr."""
    from zarr.core.sync import sync

    return sync(coroutine)
