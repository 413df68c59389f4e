"""Films of a drive: points, measurement, map and conflict of every scan, side by side, the vehicle facing up.

Frames are written or spooled to disk one by one, so that memory is bounded.

>>> import numpy as np
>>> from ogm import EvidentialGrid, GridSpec, plot
>>> from ogm.plot.movie import open_movie
>>> grid = EvidentialGrid.vacuous(GridSpec.centered(length=20.0, width=10.0, resolution=0.5))
>>> with open_movie("drive.gif", grid.spec, ["points", "scan", "map", "conflict"], ground_z=-1.8) as movie:
...     for k in range(2):
...         movie.add(np.zeros((0, 4), np.float32), [plot.mass_panel(grid)] * 3, f"scan {k}", 0.1 * k)
"""

import os
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray
from PIL import GifImagePlugin, Image, ImageDraw

from ogm import plot
from ogm.grid import GridSpec
from ogm.plot.colours import Colours, colours
from ogm.plot.figures import draw_legend, draw_marks, draw_vehicle, font, legend_width, plain, round_length, scaled
from ogm.plot.panels import APPEARED, BLACK, HIGHEST, LOWEST, NO_CONFLICT, WENT_AWAY, heading_colours, height_colours
from ogm.storage.files import atomic_write

__all__ = ["Movie", "open_movie"]

MAX_WIDTH, MAX_HEIGHT, MAX_HEIGHT_GIF = 1600, 800, 384  # [px] width of a frame; heights of a panel
MIN_WIDTH = 232  # [px] of a panel, for its title and legend
GAP, BAR, TITLE, LEGEND = 8, 32, 22, 26  # [px] between panels; heights of line, titles and legends
HEAD, WHEEL = 8.0, 34  # [px] length of arrow heads, width of the wheel of headings
BACKGROUND, INK, FAINT = (24, 24, 24), (240, 240, 240), (160, 160, 160)
MIN_TIME, MAX_TIME, LAST_TIME = 0.02, 2.0, 1.0  # [s] duration of a frame; least duration of the last frame
PANELS = 4

_Write = Callable[[Image.Image, float], None]  # writes a frame with its duration [s]


@contextmanager
def open_movie(path: str | Path, spec: GridSpec, titles: Sequence[str], ground_z: float) -> Iterator["Movie"]:
    """Open a film; the file appears when the block ends without an error.

    Parameters
    ----------
    path : path
        Ends in ``.gif``, ``.webp`` or ``.png`` (animated).
    spec : GridSpec
        The area of the panels, x forward and y left of the vehicle.
    titles : four str
        Titles of the panels: points, measurement, map, conflict.
    ground_z : float
        Height of the ground in the frame of the points [m].

    Raises
    ------
    ValueError
        If the ending is another, or no frame is added.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in _WRITERS:
        raise ValueError(f"a movie must end in {', '.join(_WRITERS)} (animated PNG), got {path}")
    movie = Movie(spec, titles, ground_z, MAX_HEIGHT_GIF if suffix == ".gif" else MAX_HEIGHT)
    with atomic_write(path) as file, _WRITERS[suffix](file, movie.size) as movie.write:
        yield movie
        movie.finish()


class Movie:
    """Layout of a film's frames, and the pending frame, which is written with the next stamp.

    Parameters
    ----------
    spec, titles, ground_z
        See `open_movie`.
    max_height : int
        Greatest height of a panel [px].
    """

    spec: GridSpec
    titles: tuple[str, ...]
    ground_z: float
    panel: tuple[int, int]
    size: tuple[int, int]
    dots: GridSpec
    duration: float
    write: _Write

    def __init__(self, spec: GridSpec, titles: Sequence[str], ground_z: float, max_height: int) -> None:
        self.spec, self.titles, self.ground_z = spec, tuple(titles), ground_z
        self.panel = width, height = _panel_size(spec, max_height)
        self.size = PANELS * (width + GAP) + GAP, BAR + TITLE + height + LEGEND
        # Points are drawn on cells half as wide as the spec's, here on the pixels.
        pixel = spec.length / height
        self.dots = GridSpec(2 * pixel, (-(-height // 2), -(-width // 2)), spec.origin)
        self.waiting: tuple[Image.Image, float] | None = None
        self.duration = 0.1  # [s] of the previous frame

    def add(self, points: NDArray[np.float32], panels: Sequence[plot.Panel], line: str, stamp: float) -> None:
        """Append a frame for one scan.

        Parameters
        ----------
        points : (N, 4) float32
        panels : three Panel
            Measurement, map and conflict, in the order of the titles.
        line : str
            Text above the panels.
        stamp : float
            Scan time [s]. The frame is shown until the next scan.
        """
        frame = self.frame(points, panels, line)
        if self.waiting is not None:
            last, since = self.waiting
            self.duration = min(max(stamp - since, MIN_TIME), MAX_TIME)
            self.write(last, self.duration)
        self.waiting = frame, stamp

    def finish(self) -> None:
        """Append the last frame."""
        if self.waiting is None:
            raise ValueError("a movie must have at least one frame, got none")
        self.write(self.waiting[0], max(self.duration, LAST_TIME))

    def frame(self, points: NDArray[np.float32], panels: Sequence[plot.Panel], line: str) -> Image.Image:
        """Return the composed frame; for parameters see `add`."""
        width, height = self.panel
        dots = plot.points_panel(points, self.dots, ground_z=self.ground_z)
        shown = (dots._replace(image=dots.image[-height:, -width:]), *panels)
        frame = Image.new("RGB", self.size, BACKGROUND)
        draw = ImageDraw.Draw(frame)
        draw.text((GAP, BAR // 2), plain(line), INK, font(13), anchor="lm")
        left, top = GAP, BAR + TITLE
        for panel, title in zip(shown, self.titles, strict=True):
            draw.text((left, top - TITLE // 2), plain(title), INK, font(13), anchor="lm")
            if panel.wheel and legend_width(panel, 11) > width + GAP:  # the wheel shows the directions
                panel = panel._replace(legend=dict(list(panel.legend.items())[:3]))
            draw_legend(draw, left, top + height + LEGEND // 2, panel, 11, (INK, FAINT))
            cells = scaled(panel, self.panel)
            draw_marks(cells, panel, HEAD, WHEEL)
            frame.paste(cells, (left, top))
            self._mark(draw, left, top)
            left += width + GAP
        return frame

    def _mark(self, draw: Any, left: int, top: int) -> None:
        """Draw the vehicle, and a scale into the first panel."""
        draw_vehicle(draw, self.spec, (left, top), self.panel[1], 5)
        if left == GAP:
            pixels = self.panel[1] / self.spec.length  # per metre
            metres = round_length(self.spec.width / 3)
            x, y = left + 8, top + self.panel[1] - 9
            draw.line([(x, y), (x + metres * pixels, y)], INK, 2)
            draw.text((x, y - 5), f"{metres:g} m", INK, font(12), anchor="ls")


def palette() -> Image.Image:
    """Return an image with the colours of all panels as its palette, common to all frames to prevent flicker."""
    return _palette_with(colours())


@cache
def _palette_with(chosen: Colours) -> Image.Image:
    steps = np.arange(11) / 10
    masses = [(free, occupied) for free in steps for occupied in steps if free + occupied < 1 + 1e-9]
    belief = chosen.mix(np.array(masses))
    conflict = (np.linspace(NO_CONFLICT, colour, 16) for colour in (APPEARED, WENT_AWAY))
    heights = height_colours(np.linspace(LOWEST, HIGHEST, 48))
    grey = np.linspace(BLACK, (1, 1, 1), 28)
    headings = heading_colours(np.arange(24) * np.pi / 12)
    moving = (headings, 0.75 * headings, 0.5 * headings)  # mixed with the black of unknown
    drawn = np.array([BACKGROUND, INK, FAINT]) / 255
    used = np.concatenate([belief, *conflict, heights, grey, *moving, drawn, np.full((1, 3), 0.08)])
    image = Image.new("P", (1, 1))
    padded = np.pad(used, ((0, 256 - len(used)), (0, 0)))
    image.putpalette(np.round(255 * padded).astype(np.uint8).tobytes())
    return image


def _indexed(frame: Image.Image) -> Image.Image:
    """Return a frame in the nearest colours of the palette, without dithering, which flickers."""
    return frame.quantize(palette=palette(), dither=Image.Dither.NONE)


def _panel_size(spec: GridSpec, max_height: int) -> tuple[int, int]:
    """Return width and height of a panel [px]: whole pixels per cell if that fits."""
    rows, columns = spec.shape
    max_width = (MAX_WIDTH - GAP) // PANELS - GAP
    grow = max(1, min(max_height // rows, max_width // columns, -(-MIN_WIDTH // columns)))
    shrink = min(1.0, max_height / rows, max_width / columns)
    scale = grow if shrink == 1.0 else shrink
    return max(1, round(columns * scale)), max(1, round(rows * scale))


@contextmanager
def _gif(file: IO[bytes], size: tuple[int, int]) -> Iterator[_Write]:
    """Write a GIF with one palette by Pillow's single-frame writer; times have steps of 10 ms."""
    file.write(b"".join(GifImagePlugin.getheader(palette().resize(size), info={"loop": 0, "optimize": False})[0]))

    def write(frame: Image.Image, seconds: float) -> None:
        parts = GifImagePlugin.getdata(_indexed(frame), duration=10 * round(100 * seconds))
        file.write(b"".join(parts))  # in one step, so that an interrupt leaves complete frames
        parts.clear()  # Pillow holds the list in a reference cycle

    yield write
    file.write(b";")


@contextmanager
def _apng(file: IO[bytes], size: tuple[int, int]) -> Iterator[_Write]:
    """Write an APNG with a palette; viewers without support show the first frame.

    Pillow needs all frames in memory for an animated PNG, so the chunks are written here.
    """
    frames = 0
    file.write(b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", struct.pack(">IIBBBBB", *size, 8, 3, 0, 0, 0)))
    counted_at = file.tell()
    file.write(_chunk(b"acTL", struct.pack(">II", 1, 0)) + _chunk(b"PLTE", bytes(palette().getpalette() or ())))

    def write(frame: Image.Image, seconds: float) -> None:
        nonlocal frames
        rows = np.pad(np.asarray(_indexed(frame)), ((0, 0), (1, 0)))  # 0 before each row: no filter
        packed, number = zlib.compress(rows.tobytes(), 6), max(0, 2 * frames - 1)
        shown = struct.pack(">IIIIIHHBB", number, *size, 0, 0, round(1000 * seconds), 1000, 0, 0)
        kind, head = (b"fdAT", struct.pack(">I", number + 1)) if frames else (b"IDAT", b"")
        file.write(_chunk(b"fcTL", shown) + _chunk(kind, head + packed))
        frames += 1

    yield write
    file.write(_chunk(b"IEND", b""))
    file.seek(counted_at)
    file.write(_chunk(b"acTL", struct.pack(">II", frames, 0)))


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


@contextmanager
def _webp(file: IO[bytes], size: tuple[int, int]) -> Iterator[_Write]:
    """Write a lossy animated WebP, with all colours and the smallest files; Pillow writes it from spooled frames."""
    spooled: list[tuple[int, int, int]] = []  # offset, length and duration [ms] of each frame
    image: Any = Image.new("RGB", size)
    with tempfile.TemporaryFile() as spool:

        def write(frame: Image.Image, seconds: float) -> None:
            packed = zlib.compress(frame.tobytes(), 1)
            spooled.append((spool.seek(0, os.SEEK_END), len(packed), round(1000 * seconds)))
            spool.write(packed)

        def seek(frame: int) -> None:
            spool.seek(spooled[frame][0])
            image.frombytes(zlib.decompress(spool.read(spooled[frame][1])))

        yield write
        image.n_frames, image.seek, image.tell = len(spooled), seek, lambda: 0
        seek(0)
        durations = [duration for *_, duration in spooled]
        image.save(file, "WEBP", save_all=True, duration=durations, loop=0, quality=80, method=2)


_WRITERS = {".gif": _gif, ".webp": _webp, ".png": _apng}
