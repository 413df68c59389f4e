"""Image files, opened by permitted decoders only and refused by their size before decoding."""

import os
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.storage.files import FilePath, OgmError
from ogm.storage.limits import current_limits, too_large

_BYTES = {"1": 1, "L": 1, "P": 1, "LA": 2, "PA": 2, "I;16": 2, "RGB": 4, "I": 4, "F": 4}  # of a pixel in Pillow, else 4


@contextmanager
def open_image(path: FilePath, formats: Sequence[str] = ("PNG",), data: bytes | None = None) -> Iterator[Any]:
    """Open an image for a ``with`` block that may decode it; errors of the block name the file.

    Parameters
    ----------
    path : path
        With `data`, the name of the image in errors.
    formats : sequence of str
        Permitted Pillow decoders, independent of the file's first bytes: others start programs (EPS) or read several
        pictures.
    data : bytes, optional
        Image of a message, instead of a file.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If it is damaged, has another format, or more pixels than `ogm.storage.limits.MemoryLimits` allows.
    """
    from PIL import Image

    try:
        if "PNG" in formats:
            _check_chunks(path if data is None else BytesIO(data))
        with Image.open(path if data is None else BytesIO(data), formats=tuple(formats)) as image:
            size = image.width * image.height * _BYTES.get(image.mode, 4)
            if size > current_limits().image:
                raise too_large(path, size, "image")
            yield image
    except (OgmError, FileNotFoundError, PermissionError, IsADirectoryError):
        raise
    except (OSError, SyntaxError, ValueError, EOFError, ArithmeticError, LookupError, TypeError, struct.error) as error:
        text = str(error).replace(str(path), "it") or type(error).__name__
        raise OgmError(f"{path} is damaged or no image ({text}), wanted {', '.join(formats)}") from error
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:  # by PIL.Image.MAX_IMAGE_PIXELS
        raise OgmError(f"{path} is damaged or no image that Pillow decodes: {error}") from error


def deep_pixels(path: FilePath, data: bytes | None = None) -> NDArray[np.uint16]:
    """Return the pixels of a PNG with 16-bit grey values, such as depths, (height, width).

    Parameters
    ----------
    path, data
        See `open_image`.

    Raises
    ------
    OgmError
        If it is another kind of image, or damaged.
    """
    with open_image(path, data=data) as image:
        if not image.mode.startswith("I"):
            raise OgmError(f"{path} is a PNG of mode {image.mode}, wanted 16-bit grey values (depths)")
        return np.asarray(image).astype(np.uint16)


def _check_chunks(source: FilePath | BytesIO) -> None:
    """Raise if a chunk of a PNG states more bytes than the file has: they would be allocated before reading."""
    with source if isinstance(source, BytesIO) else open(source, "rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(0)
        if file.read(8) != b"\x89PNG\r\n\x1a\n":
            return  # another format
        while len(head := file.read(8)) == 8:
            length, kind = struct.unpack(">I4s", head)
            if kind == b"IEND":
                return
            if file.seek(length + 4, os.SEEK_CUR) > size:
                raise ValueError(f"its chunk {kind!r} states {length} bytes")
