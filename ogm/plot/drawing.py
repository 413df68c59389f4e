"""How a panel becomes a picture: cells as pixels, outlines, arrows, the vehicle, legends and the font."""

import math
import unicodedata
from functools import lru_cache
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ogm.grid import GridSpec
from ogm.plot.moving import heading_wheel
from ogm.plot.panels import Panel, colour_bytes

WHITE, BLACK = (255, 255, 255), (0, 0, 0)
SMOOTH = 3  # lines of large pictures are drawn this much larger, and shrunk


@lru_cache
def font(size: int) -> Any:
    """Return the font that Pillow brings (Aileron) at a size [px]. It knows ASCII only."""
    return ImageFont.load_default(size)


def plain(text: str) -> str:
    """Replace what the font does not have: accents are left out, other signs become ``?``."""
    parts = (one for one in unicodedata.normalize("NFKD", text) if not unicodedata.combining(one))
    return "".join(parts).encode("ascii", "replace").decode()


def scaled(panel: Panel, size: tuple[int, int]) -> Image.Image:
    """Return the cells of a panel at a size in pixels: repeated where they are fewer, else their means."""
    image = Image.fromarray(np.ascontiguousarray(panel.image))
    grows = image.width < size[0]
    return (
        image if image.size == size else image.resize(size, Image.Resampling.NEAREST if grows else Image.Resampling.BOX)
    )


def draw_marks(image: Image.Image, panel: Panel, head: float, wheel: int, smooth: int = 1) -> None:
    """Draw the outlines, the arrows and the wheel of a panel into its picture.

    Parameters
    ----------
    image : PIL.Image.Image
        The panel's cells, of any size.
    panel : Panel
    head, wheel : float, int
        Length of the head of an arrow, width of the wheel of headings [px].
    smooth : int
        By how much larger lines are drawn before they are shrunk, against steps.
    """
    if len(panel.outlines) or len(panel.arrows):
        width = head / 8  # of a line
        if smooth > 1:
            layer = Image.new("RGBA", (image.width * smooth, image.height * smooth))
            _draw_lines(layer, panel, smooth * head, smooth * width)
            layer = layer.resize(image.size, Image.Resampling.BOX)
            image.paste(layer, (0, 0), layer)
        else:
            _draw_lines(image, panel, head, width)
    if panel.wheel:
        ring = Image.fromarray(heading_wheel(wheel))
        image.paste(ring, (image.width - wheel - 4, 4), ring)


def _draw_lines(image: Image.Image, panel: Panel, head: float, width: float) -> None:
    (_, x_max, _, y_max), pixels = panel.spec.extent, image.height / panel.spec.length  # per metre
    draw, thin = ImageDraw.Draw(image), max(1, round(width))
    for corners in panel.outlines:
        dots = [tuple(one) for one in (np.array([y_max, x_max]) - corners[:, ::-1]) * pixels]
        draw.line([*dots, dots[0]], WHITE, 3 * thin)
        draw.line([*dots, dots[0]], BLACK, thin)
    for x, y, dx, dy in panel.arrows:
        start, way = np.array([y_max - y, x_max - x]) * pixels, -np.array([dy, dx]) * pixels
        long = way * min(1.0, head / max(math.hypot(*way), 1e-9))
        tip, neck, side = start + way, start + way - long, 0.45 * long[::-1] * (-1, 1)
        shaft, triangle = [tuple(start), tuple(neck)], [tuple(one) for one in (tip, neck + side, neck - side)]
        draw.line(shaft, WHITE, 4 * thin)
        draw.polygon(triangle, WHITE, WHITE, 2 * thin)
        draw.line(shaft, BLACK, 2 * thin)
        draw.polygon(triangle, BLACK)


def draw_vehicle(draw: Any, spec: GridSpec, corner: tuple[int, int], height: int, size: int) -> None:
    """Draw a triangle where the vehicle is, if a panel of some height [px] with its corner there shows that place."""
    x_min, x_max, y_min, y_max = spec.extent
    if x_min <= 0 < x_max and y_min <= 0 < y_max:
        pixels = height / spec.length  # per metre
        x, y = corner[0] + y_max * pixels, corner[1] + x_max * pixels
        draw.polygon([(x, y - 1.4 * size), (x - size, y + size), (x + size, y + size)], WHITE, BLACK)


def draw_legend(draw: Any, x: int, y: int, panel: Panel, size: int, inks: tuple[Any, Any]) -> None:
    """Draw what the colours of a panel mean, in a line; `size` is of the font [px], `inks` are of text and frames."""
    half = round(0.45 * size)
    for name, colour in panel.legend.items():
        filled = tuple(colour_bytes(np.array(colour)).tolist())
        draw.rectangle([x, y - half, x + 2 * half, y + half], filled, inks[1])
        draw.text((x + round(1.36 * size), y), plain(name), inks[0], font(size), anchor="lm")
        x += round(2.27 * size + font(size).getlength(plain(name)))


def legend_width(panel: Panel, size: int) -> int:
    """Return how wide the legend of a panel is [px]."""
    return sum(round(2.27 * size + font(size).getlength(plain(name))) for name in panel.legend)
