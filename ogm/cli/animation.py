"""Animated pictures, written frame by frame: memory stays flat for any number of frames.

Pillow packs each frame; the containers are written here, for Pillow would keep all frames until the last. A frame
is written in one step: what was interrupted between two frames is a whole film.
"""

import io
import struct
import zlib
from pathlib import Path
from typing import IO, TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["SUFFIXES", "Animation", "Apng", "Gif", "WebP", "animation"]

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"


class Animation(Protocol):
    """An animated picture that is being written; it plays for ever."""

    def add(self, frame: "Image", seconds: float) -> None:
        """Append a frame, RGB and of the size given at first, that is shown for some time."""
        ...

    def close(self) -> None:
        """Write what stands behind the last frame, and the sizes that were not known before."""
        ...


def indices(frame: "Image", palette: "Image") -> "Image":
    """Give each pixel the nearest colour of a palette; no dithering, which would flicker."""
    from PIL import Image

    return frame.quantize(palette=palette, dither=Image.Dither.NONE)


class Gif:
    """GIF89a: one palette for all frames, times in steps of 10 ms.

    Parameters
    ----------
    file : binary file that can be written
    size : (int, int)
        Width and height [px].
    palette : (256, 3) uint8
    """

    def __init__(self, file: IO[bytes], size: tuple[int, int], palette: NDArray[np.uint8]) -> None:
        self.file, self.palette = file, _palette_image(palette)
        file.write(b"GIF89a" + struct.pack("<HHBBB", *size, 0b1111_0111, 0, 0) + palette.tobytes())
        file.write(b"\x21\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00")  # for ever

    def add(self, frame: "Image", seconds: float) -> None:
        """Append a frame."""
        packed = io.BytesIO()
        indices(frame, self.palette).save(packed, "GIF", optimize=False)
        control = b"\x21\xf9\x04\x00" + struct.pack("<H", round(100 * seconds)) + b"\x00\x00"
        self.file.write(control + _gif_image(packed.getvalue()))

    def close(self) -> None:
        """Write the trailer."""
        self.file.write(b";")


def _gif_image(data: bytes) -> bytes:
    """Return the image block of a GIF of one frame: its descriptor and its pixels, without palette."""
    at = 13 + (3 << (data[10] & 7) + 1 if data[10] & 0x80 else 0)
    while data[at : at + 1] == b"!":  # extensions: a type, then blocks up to an empty one
        at += 2
        while data[at]:
            at += 1 + data[at]
        at += 1
    return data[at:-1]


class Apng:
    """APNG with a palette: sharp, and smaller than GIF; a viewer that does not know it shows the first frame.

    Parameters
    ----------
    file : binary file that can be written and sought
    size, palette
        As for `Gif`.
    """

    def __init__(self, file: IO[bytes], size: tuple[int, int], palette: NDArray[np.uint8]) -> None:
        self.file, self.size, self.palette = file, size, _palette_image(palette)
        self.frames = 0
        file.write(PNG_SIGNATURE + _chunk(b"IHDR", struct.pack(">IIBBBBB", *size, 8, 3, 0, 0, 0)))
        self.counted_at = file.tell()
        file.write(_chunk(b"acTL", struct.pack(">II", 1, 0)) + _chunk(b"PLTE", palette.tobytes()))

    def add(self, frame: "Image", seconds: float) -> None:
        """Append a frame."""
        rows = np.asarray(indices(frame, self.palette))
        packed = zlib.compress(np.pad(rows, ((0, 0), (1, 0))).tobytes(), 6)  # 0 before each row: no filter
        control = struct.pack(">IIIIHHBB", *self.size, 0, 0, round(1000 * seconds), 1000, 0, 0)
        number = max(0, 2 * self.frames - 1)  # all chunks of frames are counted, but for the first IDAT
        data = _chunk(b"fcTL", struct.pack(">I", number) + control)
        if self.frames:
            data += _chunk(b"fdAT", struct.pack(">I", number + 1) + packed)
        else:
            data += _chunk(b"IDAT", packed)
        self.file.write(data)
        self.frames += 1

    def close(self) -> None:
        """Write the end, and at the beginning how many frames there are."""
        self.file.write(_chunk(b"IEND", b""))
        self.file.seek(self.counted_at)
        self.file.write(_chunk(b"acTL", struct.pack(">II", self.frames, 0)))


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


class WebP:
    """Animated WebP, lossy: all colours, and by far the smallest.

    Parameters
    ----------
    file, size, palette
        As for `Apng`; the palette is not used.
    """

    def __init__(self, file: IO[bytes], size: tuple[int, int], palette: NDArray[np.uint8]) -> None:
        self.file, self.size = file, size
        file.write(b"RIFF\0\0\0\0WEBP")
        self._chunk(b"VP8X", b"\x02\0\0\0" + _three(size[0] - 1) + _three(size[1] - 1))
        self._chunk(b"ANIM", b"\0\0\0\xff\0\0")

    def add(self, frame: "Image", seconds: float) -> None:
        """Append a frame."""
        packed = io.BytesIO()
        frame.save(packed, "WEBP", quality=80, method=2)
        data = packed.getvalue()[12:]
        if data[:4] == b"VP8X":
            data = data[18:]
        place = _three(0) + _three(0) + _three(self.size[0] - 1) + _three(self.size[1] - 1)
        self._chunk(b"ANMF", place + _three(round(1000 * seconds)) + b"\x02" + data)

    def close(self) -> None:
        """Write at the beginning how long the file is."""
        length = self.file.tell()
        self.file.seek(4)
        self.file.write(struct.pack("<I", length - 8))

    def _chunk(self, kind: bytes, data: bytes) -> None:
        self.file.write(kind + struct.pack("<I", len(data)) + data + b"\0" * (len(data) % 2))


def _three(number: int) -> bytes:
    return struct.pack("<I", number)[:3]


def _palette_image(palette: NDArray[np.uint8]) -> "Image":
    from PIL import Image

    if palette.shape != (256, 3) or palette.dtype != np.uint8:
        raise ValueError(f"a palette has 256 colours, (256, 3) uint8, got {palette.dtype} {palette.shape}")
    image = Image.new("P", (1, 1))
    image.putpalette(palette.tobytes())
    return image


SUFFIXES: dict[str, type[Gif] | type[Apng] | type[WebP]] = {".gif": Gif, ".webp": WebP, ".png": Apng}


def animation(
    file: IO[bytes], name: Path, size: tuple[int, int], palette: NDArray[np.uint8]
) -> "Gif | Apng | WebP":
    """Begin the kind of animation that a file's name asks for.

    Parameters
    ----------
    file : binary file that can be written and sought
    name : Path
        Ends in one of `SUFFIXES`.
    size : (int, int)
        Width and height [px].
    palette : (256, 3) uint8
        The colours of kinds that have few.
    """
    return SUFFIXES[name.suffix.lower()](file, size, palette)
