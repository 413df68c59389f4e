"""Pictures of panels side by side, with outlines, arrows, the vehicle, axes and legends."""

import math
import os
import unicodedata
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from ogm.dynamic_grid import DynamicGrid
from ogm.grid import EvidentialGrid, GridSpec
from ogm.plot.moving import dynamic_panel, heading_wheel
from ogm.plot.panels import Panel, colour_bytes, mass_panel, points_panel
from ogm.storage.files import atomic_write

Shown = EvidentialGrid | DynamicGrid | NDArray[Any] | Panel

MAX_HEIGHT, MAX_WIDTH, TARGET_HEIGHT = 1024, 1600, 900  # [px] of a panel; the target is for cells of whole pixels
GAP, MARGIN, AXIS = 26, 14, 84  # [px] between panels, around the picture, left of the first panel
TITLE, TICKS = 34, 50  # [px] heights of titles, and of numbers and name of the axis below
TEXT, SMALL = 20, 16  # [px] sizes of titles and of other texts
INK, FRAME = (20, 20, 20), (150, 150, 150)
MIN_STEPS = 4  # along an axis
MAX_TITLE = 100  # letters
TEXT_WIDTH, MAX_TEXT_SCALE = 1600, 2.2  # width of all panels [px] above which texts grow, and greatest factor


def show(*items: Shown, titles: Sequence[str] = ()) -> Image.Image:
    """Draw grids, point clouds and panels side by side.

    Parameters
    ----------
    *items : EvidentialGrid, DynamicGrid, (N, 4) array or Panel
        Grids are drawn by `mass_panel` or `dynamic_panel`, arrays by `points_panel` on the area of the first grid or
        panel.
    titles : sequence of str, optional
        One title per item.

    Returns
    -------
    PIL.Image.Image
        Displayed by notebooks; in a script, use its ``show()``, or `save_picture`.

    Raises
    ------
    ValueError
        If there are no items, `titles` has another length, or points have no grid.
    """
    return _draw(_panels(items, titles))


def save_picture(path: str | os.PathLike[str], *items: Shown, titles: Sequence[str] = ()) -> None:
    """Write the picture of `show` to a PNG file, in one step.

    Parameters
    ----------
    path : path
        Ends in ``.png``.
    *items, titles
        See `show`.
    """
    if Path(path).suffix.lower() != ".png":
        raise ValueError(f"a picture must end in .png, got {path}")
    picture = show(*items, titles=titles)
    with atomic_write(path) as file:
        picture.save(file, "PNG")  # optimize=True takes 8 times as long for 1.6 % fewer bytes


def _panels(items: Sequence[Shown], titles: Sequence[str]) -> list[Panel]:
    """Convert the items of `show` to panels."""
    if not items:
        raise ValueError("there is nothing to show: give a grid, points or a panel")
    if titles and len(titles) != len(items):
        raise ValueError(f"titles must be one per item, got {len(titles)} for {len(items)}")
    spec = next((item.spec for item in items if not isinstance(item, np.ndarray)), None)
    panels = []
    for item, title in zip(items, titles or [""] * len(items), strict=True):
        if isinstance(item, Panel):
            panels.append(item._replace(title=title or item.title))
        elif isinstance(item, EvidentialGrid):
            panels.append(mass_panel(item, title))
        elif isinstance(item, DynamicGrid):
            panels.append(dynamic_panel(item, title))
        elif spec is None:
            raise ValueError("points need an area: show them next to a grid, or as ogm.plot.points_panel(cloud, spec)")
        else:
            panels.append(points_panel(item, spec, title))
    return panels


def _size(panel: Panel) -> tuple[int, int]:
    """Return width and height of a panel [px]: whole pixels per cell if that fits."""
    rows, columns = panel.spec.shape
    scale = min(MAX_HEIGHT / rows, MAX_WIDTH / columns)
    if scale >= 1:
        scale = max(1, min(round(TARGET_HEIGHT / rows), int(scale)))
    return max(1, round(columns * scale)), max(1, round(rows * scale))


class _Layout(NamedTuple):
    """Sizes of texts and their margins [px]; larger for wide pictures, which pages shrink."""

    gap: int
    margin: int
    axis: int
    title: int
    ticks: int
    text: int
    small: int

    @classmethod
    def of(cls, widths: int) -> "_Layout":
        """Return the sizes for panels of a total width [px]."""
        factor = min(max(widths / TEXT_WIDTH, 1.0), MAX_TEXT_SCALE)
        return cls(*(round(factor * size) for size in (GAP, MARGIN, AXIS, TITLE, TICKS, TEXT, SMALL)))


def _shown(title: str, width: int, size: int) -> str:
    """Shorten a title to the width of its panel, and replace characters that the font does not have."""
    text = title = plain(title)
    letters = min(len(title), MAX_TITLE)
    while letters > 8 and font(size).getlength(title) > width:
        letters -= 1
        title = f"{text[: letters // 2 - 1]}...{text[-letters // 2 + 2 :]}"
    return title


def _draw(panels: Sequence[Panel]) -> Image.Image:
    sizes = [_size(panel) for panel in panels]
    at = _Layout.of(sum(width for width, _ in sizes))
    legends = [_rows(panel, at.small, size[0]) for size, panel in zip(sizes, panels, strict=True)]
    slots = [
        max(size[0], *(legend_width(row, at.small) for row in rows)) for size, rows in zip(sizes, legends, strict=True)
    ]
    tallest = max(height for _, height in sizes)
    width = at.axis + sum(slots) + at.gap * (len(panels) - 1) + at.margin
    line = at.title
    picture = Image.new(
        "RGB", (width, at.margin + at.title + tallest + at.ticks + line * max(map(len, legends))), "white"
    )
    draw, left, top = ImageDraw.Draw(picture), at.axis, at.margin + at.title
    for k, (panel, (wide, high), slot, rows) in enumerate(zip(panels, sizes, slots, legends, strict=True)):
        corner = left + (slot - wide) // 2, top
        image = scaled(panel, (wide, high))
        draw_marks(image, panel, 16, 80, SMOOTH)
        picture.paste(image, corner)
        draw.rectangle([corner[0] - 1, top - 1, corner[0] + wide, top + high], outline=FRAME)
        draw_vehicle(draw, panel.spec, corner, high, round(0.3 * at.text))
        title = _shown(panel.title, slot, at.text)
        draw.text((left + slot // 2, top - at.title // 2), title, INK, font(at.text), anchor="mm")
        _draw_axes(picture, panel, corner, (wide, high), at, first=k == 0)
        start = left + (slot - max(legend_width(row, at.small) for row in rows)) // 2
        for number, row in enumerate(rows):
            draw_legend(draw, start, top + high + at.ticks + line // 2 + line * number, row, at.small, (INK, FRAME))
        left += slot + at.gap
    return picture


def _rows(panel: Panel, size: int, width: int) -> list[Panel]:
    """Return a panel for each row of the legend, rows being at most `width` px wide."""
    rows = [panel._replace(legend={})]
    for name, colour in panel.legend.items():
        longer = rows[-1]._replace(legend=rows[-1].legend | {name: colour})
        if rows[-1].legend and legend_width(longer, size) > width:
            rows.append(panel._replace(legend={name: colour}))
        else:
            rows[-1] = longer
    return rows


def _draw_axes(
    picture: Image.Image, panel: Panel, corner: tuple[int, int], size: tuple[int, int], at: _Layout, first: bool
) -> None:
    """Draw numbers [m] and names of the axes of a panel; x only for the first panel."""
    (left, top), (wide, high), draw = corner, size, ImageDraw.Draw(picture)
    x_min, x_max, y_min, y_max = panel.spec.extent
    pixels = high / panel.spec.length  # per metre
    step = round_length((min(x_max - x_min, y_max - y_min) if first else y_max - y_min) / MIN_STEPS)
    for y in np.arange(np.ceil(y_min / step), np.floor(y_max / step) + 1) * step:
        column = left + (y_max - y) * pixels
        draw.line([(column, top + high), (column, top + high + 5)], INK)
        draw.text((column, top + high + 7), f"{y + 0:g}", INK, font(at.small), anchor="ma")
    below = top + high + at.ticks - round(1.375 * at.small)
    draw.text((left + wide // 2, below), "y, left [m]", INK, font(at.small), anchor="ma")
    if first:
        for x in np.arange(np.ceil(x_min / step), np.floor(x_max / step) + 1) * step:
            row = top + (x_max - x) * pixels
            draw.line([(left - 6, row), (left - 1, row)], INK)
            draw.text((left - 9, row), f"{x + 0:g}", INK, font(at.small), anchor="rm")
        name = Image.new("L", (high, at.small + 6))
        ImageDraw.Draw(name).text((high // 2, name.height // 2), "x, forward [m]", 255, font(at.small), anchor="mm")
        upright = name.transpose(Image.Transpose.ROTATE_90)
        picture.paste(INK, (at.margin, top), upright)


def round_length(limit: float) -> float:
    """Return the largest of ..., 0.5, 1, 2, 5, 10, 20, ... m up to a limit [m]."""
    power = 10.0 ** math.floor(math.log10(limit))
    return max(digit * power for digit in (1, 2, 5) if digit * power <= limit)


WHITE, BLACK = (255, 255, 255), (0, 0, 0)
SMOOTH = 3  # factor by which lines of large pictures are drawn larger and then shrunk


@lru_cache
def font(size: int) -> Any:
    """Return Pillow's built-in font (Aileron, ASCII only) at a size [px]."""
    return ImageFont.load_default(size)


def plain(text: str) -> str:
    """Remove accents, and replace other characters that the font does not have by ``?``."""
    parts = (letter for letter in unicodedata.normalize("NFKD", text) if not unicodedata.combining(letter))
    return "".join(parts).encode("ascii", "replace").decode()


def scaled(panel: Panel, size: tuple[int, int]) -> Image.Image:
    """Return the cells of a panel at a size [px]: repeated if there are fewer cells, else averaged."""
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
        Length of arrow heads, width of the wheel of headings [px].
    smooth : int
        Factor by which lines are drawn larger and then shrunk, for smooth edges.
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
        dots = [tuple(dot) for dot in (np.array([y_max, x_max]) - corners[:, ::-1]) * pixels]
        draw.line([*dots, dots[0]], WHITE, 3 * thin)
        draw.line([*dots, dots[0]], BLACK, thin)
    for x, y, dx, dy in panel.arrows:
        start, arrow = np.array([y_max - y, x_max - x]) * pixels, -np.array([dy, dx]) * pixels
        length = arrow * min(1.0, head / max(math.hypot(*arrow), 1e-9))  # of the head
        tip, neck, side = start + arrow, start + arrow - length, 0.45 * length[::-1] * (-1, 1)
        shaft, triangle = [tuple(start), tuple(neck)], [tuple(dot) for dot in (tip, neck + side, neck - side)]
        draw.line(shaft, WHITE, 4 * thin)
        draw.polygon(triangle, WHITE, WHITE, 2 * thin)
        draw.line(shaft, BLACK, 2 * thin)
        draw.polygon(triangle, BLACK)


def draw_vehicle(draw: Any, spec: GridSpec, corner: tuple[int, int], height: int, size: int) -> None:
    """Draw a triangle at the vehicle, if the panel with this corner and height [px] shows it."""
    x_min, x_max, y_min, y_max = spec.extent
    if x_min <= 0 < x_max and y_min <= 0 < y_max:
        pixels = height / spec.length  # per metre
        x, y = corner[0] + y_max * pixels, corner[1] + x_max * pixels
        draw.polygon([(x, y - 1.4 * size), (x - size, y + size), (x + size, y + size)], WHITE, BLACK)


def draw_legend(draw: Any, x: int, y: int, panel: Panel, size: int, inks: tuple[Any, Any]) -> None:
    """Draw the legend of a panel in a line; `size` is of the font [px], `inks` are of text and frames."""
    half = round(0.45 * size)
    for name, colour in panel.legend.items():
        filled = tuple(colour_bytes(np.array(colour)).tolist())
        draw.rectangle([x, y - half, x + 2 * half, y + half], filled, inks[1])
        draw.text((x + round(1.36 * size), y), plain(name), inks[0], font(size), anchor="lm")
        x += round(2.27 * size + font(size).getlength(plain(name)))


def legend_width(panel: Panel, size: int) -> int:
    """Return the width of a panel's legend [px]."""
    return sum(round(2.27 * size + font(size).getlength(plain(name))) for name in panel.legend)
