"""Storage of world maps as Zarr stores: a folder, a zip archive, or an object store such as S3."""

import errno
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from ogm.extras import import_extra
from ogm.storage.files import OgmError, errors_with_path
from ogm.storage.remote import is_remote, object_store

Url = str | os.PathLike[str]
Mode = Literal["r", "r+"]


def is_zip(url: Url) -> bool:
    """Return whether a URL is a local zip archive."""
    return not is_remote(url) and str(url).lower().endswith(".zip")


def local_path(url: Url) -> Path:
    """Return the local path of a map."""
    return Path(str(url).removeprefix("file://"))


def open_store(url: Url, mode: Mode, storage: Mapping[str, str] | None = None) -> Any:
    """Return the Zarr store of a URL, which need not exist.

    Parameters
    ----------
    url : str or path
        A folder, a ``.zip`` archive (read only), or ``s3://bucket/prefix``, also ``gs://``, ``az://``.
    mode : {"r", "r+"}
    storage : mapping of str to str, optional
        Configuration of the object store for obstore: ``endpoint``, ``access_key_id``, ``region``, ... Other values are
        taken from the environment (``AWS_ENDPOINT_URL``, ``AWS_ACCESS_KEY_ID``, ..., ``AWS_ALLOW_HTTP``).

    Raises
    ------
    ValueError
        If options are given for a folder, or a zip archive is opened for writing.
    ImportError
        If zarr is missing, or obstore for an object store.
    """
    zarr = import_extra("zarr", "world")
    if is_remote(url):
        with reading(url, "see ogm.world.stores.open_store for the options of object stores"):
            return zarr.storage.ObjectStore(object_store(str(url), storage or {}), read_only=mode == "r")
    if storage:
        raise ValueError(f"storage options are only for object stores (s3://...), got {sorted(storage)} for {url}")
    if is_zip(url):
        if mode != "r":
            raise ValueError(
                f"{url} is a zip archive, which cannot be changed: make the map in a folder or a bucket, then write "
                "the archive by WorldMap.copy_to"
            )
        if not local_path(url).is_file():
            raise FileNotFoundError(f"the archive {url} does not exist")
        with reading(url):
            return zarr.storage.ZipStore(local_path(url), mode="r")
    if local_path(url).is_file():
        raise OgmError(f"{url} is a file, wanted a folder, a .zip archive or the URL of an object store")
    return zarr.storage.LocalStore(local_path(url), read_only=mode == "r")


@contextmanager
def reading(subject: object, repair: str = "restore it from a copy") -> Iterator[None]:
    """Add the subject to errors of Zarr and of stores on reading; system errors stay unchanged."""
    try:
        yield
    except (OgmError, ImportError):
        raise
    except MemoryError as error:  # most likely from a wrong index or size
        raise OgmError(f"{subject} cannot be read: it states more bytes than there is memory for; {repair}") from error
    except Exception as error:  # Zarr, its codecs, zip archives and obstore raise many types
        if isinstance(error, OSError) and error.errno != errno.EINVAL:  # EINVAL: an invalid offset in an archive
            raise
        text = " ".join(str(error).split())[:300] or type(error).__name__
        raise OgmError(f"{subject} cannot be read ({text}): {repair}") from error


@contextmanager
def writing(url: Url, subject: object) -> Iterator[None]:
    """Add the subject to errors of a store on writing; system errors keep their numbers."""
    try:
        with errors_with_path(local_path(url)):
            yield
    except (OSError, OgmError, MemoryError):
        raise
    except Exception as error:
        text = " ".join(str(error).split())[:300] or type(error).__name__
        raise OSError(f"{subject} cannot be written ({text})") from error


def keys(store: Any, prefix: str) -> list[str]:
    """Return the keys of a store with a prefix, sorted."""
    return sorted(key for key in _listed(store.list_prefix, prefix) if not key.endswith(".partial"))


def children(store: Any, prefix: str) -> list[str]:
    """Return the names directly below a prefix, sorted."""
    return sorted(key.rstrip("/") for key in _listed(store.list_dir, prefix))


def _listed(listing: Any, prefix: str) -> list[str]:
    """Return the items of an asynchronous listing of a store."""

    async def found() -> list[str]:
        return [key async for key in listing(prefix)]

    return list(_sync(found()))


def read_object(store: Any, key: str) -> bytes | None:
    """Return the content of an object; None if it does not exist."""
    from zarr.core.buffer import default_buffer_prototype

    found = _sync(store.get(key, default_buffer_prototype()))
    return None if found is None else bytes(found.to_bytes())


def size(store: Any, prefix: str) -> int:
    """Return the total size of all objects with a prefix [byte]."""
    return int(_sync(store.getsize_prefix(prefix)))


def erase(store: Any, key: str) -> None:
    """Remove an object, if it exists."""
    _sync(store.delete(key))


def _sync(coroutine: Any) -> Any:
    """Return the result of a Zarr coroutine."""
    from zarr.core.sync import sync

    return sync(coroutine)
