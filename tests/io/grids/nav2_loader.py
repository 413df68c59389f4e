"""Loader of nav2's map_server in plain Python, pixel by pixel, by the rules of ``nav2_map_server/src/map_io.cpp``.

Shares no code with `ogm`: a YAML parser of "key: value" lines, and its own parser of binary PGM files; PNG by Pillow.
"""

import math
from pathlib import Path
from typing import NamedTuple

from PIL import Image


class OccupancyGrid(NamedTuple):
    """As nav_msgs/OccupancyGrid: values row by row, the first at the origin, x fastest."""

    resolution: float
    width: int
    height: int
    origin: tuple[float, float, float]
    data: list[int]

    def at(self, x: float, y: float) -> int:
        """Return the value at a point of the map frame, as a ROS node looks it up."""
        x0, y0, yaw = self.origin
        dx, dy = x - x0, y - y0
        column = math.floor((math.cos(yaw) * dx + math.sin(yaw) * dy) / self.resolution)
        row = math.floor((math.cos(yaw) * dy - math.sin(yaw) * dx) / self.resolution)
        assert 0 <= column < self.width
        assert 0 <= row < self.height
        return self.data[row * self.width + column]


def load_map(path: Path) -> OccupancyGrid:
    """Load a map as nav2 does."""
    doc = dict(line.split(": ", 1) for line in path.read_text().splitlines())
    origin = [float(one) for one in doc["origin"].strip("[]").split(",")]
    occupied, free, mode = float(doc["occupied_thresh"]), float(doc["free_thresh"]), doc["mode"]
    negate = bool(int(doc["negate"]))
    width, height, pixels, matte = _image(path.parent / doc["image"])
    data = [0] * (width * height)
    for y in range(height):
        for x in range(width):
            red, green, blue, alpha = pixels[y][x]
            channels = [red, green, blue]
            if mode == "trinary" and matte:
                channels.append(alpha)
            shade = sum(channels) / len(channels) / 255
            occ = shade if negate else 1.0 - shade
            cell = -1
            if mode == "trinary":
                if occupied < occ:
                    cell = 100
                elif occ < free:
                    cell = 0
            elif mode == "scale":
                if alpha != 255:
                    cell = -1
                elif occupied < occ:
                    cell = 100
                elif occ < free:
                    cell = 0
                else:
                    cell = round((occ - free) / (occupied - free) * 100.0)
            elif 0 <= round(shade * 255) <= 100:
                cell = round(shade * 255)
            data[width * (height - y - 1) + x] = cell
    return OccupancyGrid(float(doc["resolution"]), width, height, (origin[0], origin[1], origin[2]), data)


def _image(path: Path) -> tuple[int, int, list[list[tuple[int, int, int, int]]], bool]:
    """Return width, height, rows of red, green, blue, alpha, and whether there is alpha."""
    if path.suffix == ".pgm":
        raw = path.read_bytes()
        head = 4 if raw.startswith(b"P5\n#") else 3
        magic, *_, size, depth, body = raw.split(b"\n", head)
        width, height = map(int, size.split())
        assert (magic, depth, len(body)) == (b"P5", b"255", width * height)
        rows = [[(g, g, g, 255) for g in body[y * width : (y + 1) * width]] for y in range(height)]
        return width, height, rows, False
    with Image.open(path) as image:
        matte = image.mode in ("LA", "RGBA") or "transparency" in image.info
        flat = image.convert("RGBA")
    pixels = [[flat.getpixel((x, y)) for x in range(flat.width)] for y in range(flat.height)]
    return flat.width, flat.height, pixels, matte
