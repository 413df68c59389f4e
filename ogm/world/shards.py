"""Reading of tiles in a folder: shards of the Zarr specification, decoded in the calling thread.

Zarr hands over each chunk to other threads several times, which takes four times as long. It also opens the file for
each chunk. Here a file is opened once, so that all chunks are from the same moment while another process writes.
"""

from itertools import product
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ogm.world.layout import TILES, Box, WorldLayout

_EMPTY = 2**64 - 1  # offset of a chunk that is not stored: all its cells are 0


def read_shards(layout: WorldLayout, level: int, box: Box, layers: slice, folder: Path) -> NDArray[Any]:
    """Return layers of a box of cells in stored form, (L, nx, ny); cells without a tile are 0.

    Parameters
    ----------
    layout : WorldLayout
    level : int
    box : Box
        Cells of the level.
    layers : slice
    folder : Path
        Folder of the level's tiles, with a valid ``zarr.json``, see `ogm.world.layout.checked_array`.

    Raises
    ------
    ValueError, RuntimeError, OverflowError, MemoryError
        If a file is damaged.
    OSError
        If a file cannot be read.
    """
    from numcodecs import Zstd

    array, codec, dtype = layout.array(level), Zstd(), np.dtype(layout.dtype).newbyteorder("<")
    stored, side = array["shape"][0], array["chunks"][-1]
    numbers, per_tile = range(stored)[layers], layout.tile // side
    x0, x1, y0, y1 = box[0] // side, -(-box[1] // side), box[2] // side, -(-box[3] // side)  # chunks
    cells = np.zeros((len(numbers), (x1 - x0) * side, (y1 - y0) * side), layout.dtype)
    for tile in layout.tiles_of(box):
        try:
            file = folder.joinpath("c", "0", *(str(k + (TILES >> (level + 1))) for k in tile)).open("rb")
        except FileNotFoundError:
            continue
        with file:
            index = _index(file, (stored, per_tile, per_tile))
            rows = range(max(x0, tile[0] * per_tile), min(x1, (tile[0] + 1) * per_tile))
            columns = range(max(y0, tile[1] * per_tile), min(y1, (tile[1] + 1) * per_tile))
            for layer, i, j in product(range(len(numbers)), rows, columns):
                start, length = index[numbers[layer], i % per_tile, j % per_tile].tolist()
                if start != _EMPTY:
                    file.seek(start)
                    values = np.frombuffer(codec.decode(_checked(file.read(length))), dtype)
                    x, y = (i - x0) * side, (j - y0) * side
                    cells[layer, x : x + side, y : y + side] = values.reshape(side, side)
    return cells[:, box[0] - x0 * side : box[1] - x0 * side, box[2] - y0 * side : box[3] - y0 * side]


def _index(file: BinaryIO, chunks: tuple[int, int, int]) -> NDArray[np.uint64]:
    """Return the offsets and lengths [byte] of the chunks of a shard, (*chunks, 2), from its end."""
    size = 16 * int(np.prod(chunks)) + 4
    if file.seek(0, 2) < size:
        raise ValueError("it is cut off")
    file.seek(-size, 2)
    return np.frombuffer(_checked(file.read()), "<u8").reshape(*chunks, 2)


def _checked(content: bytes) -> NDArray[np.uint8]:
    """Return content without its CRC-32C; raise ValueError if this differs."""
    import google_crc32c

    found = np.frombuffer(content, np.uint8)
    computed, stated = google_crc32c.value(found[:-4]), int.from_bytes(content[-4:], "little")
    if computed != stated:
        raise ValueError(f"its checksum is {stated:08x}, computed {computed:08x}")
    return found[:-4]
