"""Films of a drive: points, measurement, map and conflict of every scan, side by side, the vehicle facing up.

Frames are written, or spooled to disk, as they come: memory stays flat for any number of them.
"""

import io
import math
import os
import struct
import tempfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ogm import plot
from ogm.files import atomic_write
from ogm.grid import GridSpec

if TYPE_CHECKING:
    from PIL.Image import Image

__all__ = ["Movie", "check_movie", "open_movie"]

WIDEST, TALLEST, TALLEST_GIF = 1600, 800, 384  # [px] of a frame, of a panel, of a panel of a GIF
NARROWEST = 232  # [px] of a panel: its title and its legend must fit
GAP, BAR, TITLE, LEGEND = 8, 32, 22, 26  # [px] between panels; heights of line, titles and legends
BACKGROUND, INK, FAINT = (24, 24, 24), (240, 240, 240), (160, 160, 160)
SHORTEST, LONGEST, LAST = 0.02, 2.0, 1.0  # [s] for which a frame is shown; the last one at least
PANELS = 4


def check_movie(path: str | os.PathLike[str]) -> None:
    """Refuse a path that no film can be written to.

    Raises
    ------
    ValueError
        If the name does not end in ``.gif``, ``.webp`` or ``.png``.
    ImportError
        If Pillow is not installed.
    """
    if Path(path).suffix.lower() not in _WRITERS:
        raise ValueError(f"a movie is {', '.join(_WRITERS)} (animated PNG), got {path}")
    try:
        import PIL.Image  # noqa: F401
    except ImportError as error:
        raise ImportError('a movie needs Pillow: pip install "ogm-toolkit[viz]"', name="PIL") from error


@contextmanager
def open_movie(
    path: str | os.PathLike[str], spec: GridSpec, titles: Sequence[str], ground_z: float
) -> Iterator["Movie"]:
    """Open a film; the file appears, whole, when the block is left without an error.

    Parameters
    ----------
    path : path
        Ends in ``.gif``, ``.webp`` or ``.png`` (animated).
    spec : GridSpec
        The area of the panels, x forward and y left of the vehicle.
    titles : four str
        Of the panels: points, measurement, map, conflict.
    ground_z : float
        Height of the ground in the frame of the points [m].
    """
    check_movie(path)
    suffix = Path(path).suffix.lower()
    with atomic_write(path) as file, tempfile.TemporaryFile() as spool:
        movie = Movie(spec, titles, ground_z, TALLEST_GIF if suffix == ".gif" else TALLEST)
        movie.writer = _WRITERS[suffix](file, spool, movie.size)
        yield movie
        movie.close()


class Movie:
    """The frames of a film: their layout, and the last frame, whose duration the next one decides.

    Parameters
    ----------
    spec, titles, ground_z
        As for `open_movie`.
    tallest : int
        Greatest height of a panel [px].
    """

    writer: "_Gif | _Apng | _WebP"

    def __init__(self, spec: GridSpec, titles: Sequence[str], ground_z: float, tallest: int) -> None:
        self.spec, self.titles, self.ground_z = spec, tuple(titles), ground_z
        self.panel = _panel_size(spec, tallest)
        width, height = self.panel
        self.size = PANELS * (width + GAP) + GAP, BAR + TITLE + height + LEGEND
        # Points are drawn on cells half as wide as those of their spec: on the pixels.
        pixel = spec.length / height
        self.dots = GridSpec(2 * pixel, (-(-height // 2), -(-width // 2)), spec.origin)
        self.still: Image | None = None
        self.waiting: tuple[Image, float] | None = None
        self.duration = 0.1  # [s] of the frame before

    def add(self, points: NDArray[np.float32], panels: Sequence["plot.Panel"], line: str, stamp: float) -> None:
        """Append a frame: one scan.

        Parameters
        ----------
        points : (N, 4) float32
        panels : three Panel
            Measurement, map and conflict, as the titles have it.
        line : str
            The text above the panels.
        stamp : float
            Of the scan [s]; the frame is shown until that of the next one.
        """
        frame = self.frame(points, panels, line)
        if self.waiting is not None:
            last, since = self.waiting
            self.duration = min(max(stamp - since, SHORTEST), LONGEST)
            self.writer.add(last, self.duration)
        self.waiting = frame, stamp

    def close(self) -> None:
        """Append the last frame, and finish."""
        if self.waiting is None:
            raise ValueError("a movie has at least one frame, got none")
        self.writer.add(self.waiting[0], max(self.duration, LAST))
        self.writer.close()

    def frame(self, points: NDArray[np.float32], panels: Sequence["plot.Panel"], line: str) -> "Image":
        """Compose one frame; parameters as for `add`."""
        from PIL import Image, ImageDraw

        width, height = self.panel
        dots = plot.points_panel(points, self.dots, ground_z=self.ground_z)
        shown = (dots._replace(image=dots.image[-height:, -width:]), *panels)
        if self.still is None:
            self.still = self._still([panel.legend for panel in shown])
        frame = self.still.copy()
        draw = ImageDraw.Draw(frame)
        for k, panel in enumerate(shown):
            one = Image.fromarray(np.ascontiguousarray(panel.image))
            if one.size != self.panel:
                way = Image.Resampling.NEAREST if one.size[0] < width else Image.Resampling.BOX
                one = one.resize(self.panel, way)
            frame.paste(one, self._corner(k))
            self._mark(draw, k)
        draw.text((GAP, BAR // 2), line, INK, _font(13, "DejaVuSansMono"), anchor="lm")
        return frame

    def _corner(self, k: int) -> tuple[int, int]:
        """Return the upper left pixel of a panel."""
        return GAP + k * (self.panel[0] + GAP), BAR + TITLE

    def _mark(self, draw: Any, k: int) -> None:
        """Draw the vehicle, and into the first panel a scale."""
        left, top = self._corner(k)
        width, height = self.panel
        x_min, x_max, y_min, y_max = self.spec.extent
        pixels = height / self.spec.length  # per metre
        if x_min <= 0 < x_max and y_min <= 0 < y_max:
            x, y = left + y_max * pixels, top + x_max * pixels
            draw.polygon([(x, y - 7), (x - 5, y + 5), (x + 5, y + 5)], (255, 255, 255), (0, 0, 0))
        if k == 0:
            metres = _round_length(self.spec.width / 3)
            x, y = left + 8, top + height - 9
            draw.line([(x, y), (x + metres * pixels, y)], INK, 2)
            draw.text((x, y - 5), f"{metres:g} m", INK, _font(12), anchor="ls")

    def _still(self, legends: Sequence[dict[str, tuple[float, float, float]]]) -> "Image":
        """Draw what all frames share: titles and legends."""
        from PIL import Image, ImageDraw

        frame = Image.new("RGB", self.size, BACKGROUND)
        draw = ImageDraw.Draw(frame)
        for k, (title, legend) in enumerate(zip(self.titles, legends, strict=True)):
            left, top = self._corner(k)
            draw.text((left, top - TITLE // 2), title, INK, _font(13), anchor="lm")
            x, y = left, top + self.panel[1] + LEGEND // 2
            for name, colour in legend.items():
                fill = tuple(round(255 * one) for one in colour)
                draw.rectangle([x, y - 5, x + 10, y + 5], fill, FAINT)
                draw.text((x + 15, y), name, INK, _font(11), anchor="lm")
                x += 25 + round(_font(11).getlength(name))
        return frame


@lru_cache
def palette() -> "Image":
    """Return an image with the colours of all panels as its palette: the same for every frame, against flicker."""
    from matplotlib import colormaps
    from PIL import Image

    steps = np.arange(0, 13) / 12
    free, occupied = (one.ravel() for one in np.meshgrid(steps, steps, indexing="ij"))
    kept = free + occupied < 1 + 1e-9
    belief = free[kept, None] * np.array(plot.GREEN) + occupied[kept, None] * np.array(plot.RED)
    levels = np.linspace(0, 1, 24)[:, None]
    grey = np.linspace(0, 1, 28)[:, None].repeat(3, axis=1)
    colours = np.concatenate(
        [
            belief,
            levels * np.array(plot.APPEARED),
            levels * np.array(plot.WENT_AWAY),
            colormaps["turbo"](np.linspace(0.12, 0.97, 64))[:, :3],
            grey,
            np.array([BACKGROUND, INK, FAINT]) / 255,
            np.full((1, 3), 0.08),
        ]
    )
    image = Image.new("P", (1, 1))
    image.putpalette(np.round(255 * np.pad(colours, ((0, 256 - len(colours)), (0, 0)))).astype(np.uint8).tobytes())
    return image


def _indexed(frame: "Image") -> "Image":
    """Return each pixel's nearest colour of the palette; no dithering, which would flicker."""
    from PIL import Image

    return frame.quantize(palette=palette(), dither=Image.Dither.NONE)


def _panel_size(spec: GridSpec, tallest: int) -> tuple[int, int]:
    """Return width and height of a panel [px]: the cells' number or a whole multiple of it, if that fits."""
    rows, columns = spec.shape
    widest = (WIDEST - GAP) // PANELS - GAP
    grow = max(1, min(tallest // rows, widest // columns, -(-NARROWEST // columns)))
    shrink = min(1.0, tallest / rows, widest / columns)
    scale = grow if shrink == 1.0 else shrink
    return max(1, round(columns * scale)), max(1, round(rows * scale))


def _round_length(most: float) -> float:
    """Return the largest of 1, 2, 5, 10, 20, 50, ... m that is at most some length."""
    power = 10.0 ** math.floor(math.log10(most))
    return max(one * power for one in (1, 2, 5) if one * power <= most)


@lru_cache
def _font(size: int, name: str = "DejaVuSans") -> Any:
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / f"{name}.ttf", size)


class _Gif:
    """GIF with one palette, by Pillow's writer of single frames; times in steps of 10 ms."""

    def __init__(self, file: IO[bytes], spool: IO[bytes], size: tuple[int, int]) -> None:
        from PIL import GifImagePlugin, Image

        self.file, self.encode = file, GifImagePlugin.getdata
        first = Image.new("P", size)
        first.putpalette(palette().getpalette())
        file.write(b"".join(GifImagePlugin.getheader(first, info={"loop": 0, "optimize": False})[0]))

    def add(self, frame: "Image", seconds: float) -> None:
        """Write a frame at once, so that an interrupt leaves whole frames."""
        parts = self.encode(_indexed(frame), duration=10 * round(100 * seconds))
        self.file.write(b"".join(parts))
        parts.clear()  # Pillow holds the list in a reference cycle

    def close(self) -> None:
        """Write the trailer."""
        self.file.write(b";")


class _Apng:
    """APNG with a palette; a viewer that does not know it shows the first frame.

    Pillow writes animated PNG only with all frames in memory, so the chunks of frames are written here.
    """

    def __init__(self, file: IO[bytes], spool: IO[bytes], size: tuple[int, int]) -> None:
        self.file, self.size, self.frames = file, size, 0
        file.write(b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", struct.pack(">IIBBBBB", *size, 8, 3, 0, 0, 0)))
        self.counted_at = file.tell()
        colours = bytes(palette().getpalette())
        file.write(_chunk(b"acTL", struct.pack(">II", 1, 0)) + _chunk(b"PLTE", colours))

    def add(self, frame: "Image", seconds: float) -> None:
        """Write a frame at once, so that an interrupt leaves whole frames."""
        rows = np.pad(np.asarray(_indexed(frame)), ((0, 0), (1, 0)))  # 0 before each row: no filter
        packed, number = zlib.compress(rows.tobytes(), 6), max(0, 2 * self.frames - 1)
        shown = struct.pack(">IIIIIHHBB", number, *self.size, 0, 0, round(1000 * seconds), 1000, 0, 0)
        kind, head = (b"fdAT", struct.pack(">I", number + 1)) if self.frames else (b"IDAT", b"")
        self.file.write(_chunk(b"fcTL", shown) + _chunk(kind, head + packed))
        self.frames += 1

    def close(self) -> None:
        """Write the end, and the number of frames at the beginning."""
        self.file.write(_chunk(b"IEND", b""))
        self.file.seek(self.counted_at)
        self.file.write(_chunk(b"acTL", struct.pack(">II", self.frames, 0)))


def _chunk(kind: bytes, data: bytes) -> bytes:
    from PIL.PngImagePlugin import putchunk

    file = io.BytesIO()
    putchunk(file, kind, data)
    return file.getvalue()


class _WebP:
    """Animated WebP, lossy: all colours, and by far the smallest. Pillow writes it at the end, from spooled frames."""

    def __init__(self, file: IO[bytes], spool: IO[bytes], size: tuple[int, int]) -> None:
        self.file, self.spool, self.size = file, spool, size
        self.places: list[tuple[int, int]] = []  # where each frame begins in the spool, and its length
        self.milliseconds: list[int] = []

    def add(self, frame: "Image", seconds: float) -> None:
        """Spool a frame."""
        packed = zlib.compress(frame.tobytes(), 1)
        self.places.append((self.spool.seek(0, os.SEEK_END), len(packed)))
        self.spool.write(packed)
        self.milliseconds.append(round(1000 * seconds))

    def close(self) -> None:
        """Encode all frames; one at a time is in memory."""
        from PIL import Image

        image = Image.new("RGB", self.size)

        def seek(frame: int) -> None:
            place, length = self.places[frame]
            self.spool.seek(place)
            image.frombytes(zlib.decompress(self.spool.read(length)))

        image.n_frames, image.seek, image.tell = len(self.places), seek, lambda: 0
        seek(0)
        image.save(self.file, "WEBP", save_all=True, duration=self.milliseconds, loop=0, quality=80, method=2)


_WRITERS: dict[str, type[_Gif] | type[_Apng] | type[_WebP]] = {".gif": _Gif, ".webp": _WebP, ".png": _Apng}
