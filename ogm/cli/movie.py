"""A film of a drive: points, measurement, map and conflict of every scan, side by side, the vehicle facing up."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ogm import plot
from ogm.cli.animation import SUFFIXES, animation
from ogm.files import atomic_write
from ogm.grid import GridSpec

if TYPE_CHECKING:
    from PIL.Image import Image

    from ogm.cli.animation import Animation

__all__ = ["Movie", "check_movie", "movie"]

WIDEST, TALLEST, TALLEST_GIF = 1600, 800, 384  # [px] of a frame, of a panel, of a panel of a GIF
NARROWEST = 232  # [px] of a panel: its title and its legend must fit
GAP, BAR, TITLE, LEGEND = 8, 32, 22, 26  # [px] between panels; heights of what stands above and below them
BACKGROUND, INK, FAINT = (24, 24, 24), (240, 240, 240), (160, 160, 160)
SHORTEST, LONGEST, PAUSE = 0.02, 2.0, 1.0  # [s] that a frame is shown; the last one at least
PANELS = 4  # points, measurement, map, conflict


def check_movie(path: Path) -> None:
    """Refuse what no film can be written to.

    Raises
    ------
    ValueError
        If the name does not end as a film's does.
    ImportError
        If Pillow is not there.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"--movie writes {', '.join(SUFFIXES)} (animated PNG), got {path}")
    try:
        import PIL.Image  # noqa: F401
    except ImportError as error:
        raise ImportError('--movie needs Pillow: pip install "ogm-toolkit[viz]"', name="PIL") from error


@contextmanager
def movie(path: Path, spec: GridSpec, titles: Sequence[str], ground_z: float) -> Iterator["Movie"]:
    """Open a film; the file appears, whole, when the block is left without an error.

    Parameters
    ----------
    path : Path
        Ends in ``.gif``, ``.webp`` or ``.png``.
    spec : GridSpec
        What the panels show, x forward and y left of the vehicle.
    titles : four str
        Of the panels: points, measurement, map, conflict.
    ground_z : float
        Height of the ground in the frame of the points [m].
    """
    with atomic_write(path) as file:
        made = Movie(spec, titles, ground_z, TALLEST_GIF if path.suffix.lower() == ".gif" else TALLEST)
        made.film = animation(file, path, made.size, palette())
        yield made
        made.close()


class Movie:
    """The frames of a film: where the panels stand, and the frame that waits until it is known how long it lasts.

    Parameters
    ----------
    spec, titles, ground_z
        As for `movie`.
    tallest : int
        Most rows of a panel [px].

    Attributes
    ----------
    film : Animation
        Takes the frames.
    size : (int, int)
        Width and height of a frame [px].
    panel : (int, int)
        Width and height of a panel [px].
    """

    film: "Animation"

    def __init__(self, spec: GridSpec, titles: Sequence[str], ground_z: float, tallest: int) -> None:
        self.spec, self.titles, self.ground_z = spec, tuple(titles), ground_z
        self.panel = _panel_size(spec, tallest)
        width, height = self.panel
        self.size = PANELS * (width + GAP) + GAP, BAR + TITLE + height + LEGEND
        # Points are drawn on cells half as wide as those they are given: on the pixels.
        pixel = spec.length / height
        self.dots = GridSpec(2 * pixel, (-(-height // 2), -(-width // 2)), spec.origin)
        self.still: Image | None = None
        self.waiting: tuple[Image, float] | None = None
        self.lasted = 0.1  # [s] of the frame before

    def add(
        self, points: NDArray[np.float32], panels: Sequence["plot.Panel"], line: str, stamp: float
    ) -> None:
        """Append what was known at one scan.

        Parameters
        ----------
        points : (N, 4) float32
        panels : three Panel
            Measurement, map and conflict, or whatever the titles say.
        line : str
            What stands above the panels.
        stamp : float
            Of the scan [s]; the frame is shown until the next one's.
        """
        frame = self.frame(points, panels, line)
        if self.waiting is not None:
            last, since = self.waiting
            self.lasted = min(max(stamp - since, SHORTEST), LONGEST)
            self.film.add(last, self.lasted)
        self.waiting = frame, stamp

    def close(self) -> None:
        """Append the last frame, and finish.

        Raises
        ------
        ValueError
            If there is no frame.
        """
        if self.waiting is None:
            raise ValueError("a film has at least one frame, got none")
        self.film.add(self.waiting[0], max(self.lasted, PAUSE))
        self.film.close()

    def frame(self, points: NDArray[np.float32], panels: Sequence["plot.Panel"], line: str) -> "Image":
        """Compose one frame; parameters as for `add`."""
        from PIL import Image, ImageDraw

        width, height = self.panel
        dots = plot.points(points, self.dots, ground_z=self.ground_z)
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
        """Draw what all frames share, once: titles and legends."""
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


def palette() -> NDArray[np.uint8]:
    """Return the colours of all panels, (256, 3): the same for every frame, so that nothing flickers."""
    from matplotlib import colormaps

    steps = np.arange(0, 13) / 12
    free, occupied = (one.ravel() for one in np.meshgrid(steps, steps, indexing="ij"))
    kept = free + occupied < 1 + 1e-9
    belief = free[kept, None] * np.array(plot.GREEN) + occupied[kept, None] * np.array(plot.RED)
    levels = np.linspace(0, 1, 24)[:, None]
    grey = np.linspace(0, 1, 28)[:, None].repeat(3, axis=1)
    flat = [colour for colour in (BACKGROUND, INK, FAINT)]
    colours = np.concatenate(
        [
            belief,
            levels * np.array(plot.APPEARED),
            levels * np.array(plot.WENT_AWAY),
            colormaps["turbo"](np.linspace(0.12, 0.97, 64))[:, :3],
            grey,
            np.array(flat) / 255,
            np.full((1, 3), 0.08),
        ]
    )
    result = np.zeros((256, 3), np.uint8)
    result[: len(colours)] = np.round(255 * colours)
    return result


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
