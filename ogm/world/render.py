"""Tiles of a world map from the sub-maps of its drives: which belong to a tile, and the tile they give."""

import hashlib
from collections.abc import Iterable, Mapping
from itertools import groupby
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.window import affine_between
from ogm.storage.files import error_context
from ogm.world.drives import Drive, drive_array, submap_key
from ogm.world.kernels import discount, merge, moved
from ogm.world.layout import LAYERS, WORLD_RULES, TileIndex, corners
from ogm.world.packing import checked_layers
from ogm.world.stores import reading
from ogm.world.tiles import TileStore


class Part(NamedTuple):
    """A sub-map that may have cells in a tile.

    Attributes
    ----------
    drive : str
    number : int
        Of the sub-map in the drive.
    tiles : tuple of (int, int)
        Tiles of the sub-map that the tile may need.
    correction : (4, 4) float64 or None
        What takes the sub-map's cells to where they belong; None if they stand there.
    """

    drive: str
    number: int
    tiles: tuple[TileIndex, ...]
    correction: NDArray[np.float64] | None


def parts_of_tiles(store: TileStore, drives: Iterable[Drive]) -> dict[TileIndex, list[Part]]:
    """Return the parts of every tile, in the order in which they are combined: by drive, then by sub-map.

    The order, and so the map to the last bit, does not depend on the order in which drives are built, nor on workers.

    Raises
    ------
    OgmError
        If a sub-map is moved beyond the map.
    """
    found: dict[TileIndex, list[Part]] = {}
    for drive in sorted(drives, key=lambda one: one.name):
        for number, one in enumerate(drive.submaps):
            correction = one.correction
            needed: dict[TileIndex, list[TileIndex]] = {}
            for tile in one.tiles or ():
                for target in [tile] if correction is None else _targets(store, tile, correction):
                    needed.setdefault(target, []).append(tile)
            for target, tiles in needed.items():
                found.setdefault(target, []).append(Part(drive.name, number, tuple(sorted(tiles)), correction))
    return dict(sorted(found.items()))


def _targets(store: TileStore, tile: TileIndex, correction: NDArray[np.float64]) -> list[TileIndex]:
    """Return the tiles that a moved tile may have cells in."""
    layout = store.layout
    box = layout.around(corners(layout.spec(layout.box_of(tile)), correction))
    with error_context(f"a sub-map of a drive of {store.url} is moved too far"):
        layout.check_box(box)
    return layout.tiles_of(box)


def fingerprint(parts: Iterable[Part], sources: Mapping[str, str]) -> np.uint64:
    """Return 64 bits of what a tile is made from, never 0: another drive, model or pose gives another one."""
    sums = hashlib.sha256()
    for one in parts:
        sums.update(f"{one.drive} {sources[one.drive]} {one.number} {one.tiles}".encode())
        sums.update(b"" if one.correction is None else one.correction.tobytes())
    return np.uint64(int.from_bytes(sums.digest()[:8], "big") | 1)


def render_tile(store: TileStore, index: TileIndex, parts: Iterable[Part]) -> NDArray[Any]:
    """Return a tile, (7, tile, tile), combined from its parts by the rule of the map.

    The sub-maps of a drive are combined first; what they give is discounted, and combined with the other drives.
    Sub-maps that were moved are resampled once, by nearest cells.
    """
    layout, drives = store.layout, _Drives(store)
    tile, rule, most = layout.empty_tile(), WORLD_RULES[layout.rule], 1 - layout.min_unknown
    for _, of_drive in groupby(parts, lambda one: one.drive):
        drive = layout.empty_tile()
        for one in of_drive:
            part = drives.read(one, index) if one.correction is None else _moved_tile(drives, index, one)
            merge(drive, part, rule, most)
        discount(drive, layout.drive_reliability)
        merge(tile, drive, rule, most)
    return tile


def _moved_tile(drives: "_Drives", index: TileIndex, part: Part) -> NDArray[Any]:
    """Return what a sub-map that was moved has in a tile."""
    assert part.correction is not None
    layout = drives.layout
    rows, columns = zip(*part.tiles, strict=True)
    i, j, n = min(rows), min(columns), layout.tile
    tile = layout.empty_tile()
    source = np.zeros((len(LAYERS), (max(rows) - i + 1) * n, (max(columns) - j + 1) * n), tile.dtype)
    for at in part.tiles:
        a, b = (at[0] - i) * n, (at[1] - j) * n
        source[:, a : a + n, b : b + n] = drives.read(part, at)
    area = layout.spec((i * n, i * n + source.shape[1], j * n, j * n + source.shape[2]))
    moved(source, affine_between(layout.spec(layout.box_of(index)), area, part.correction), tile)
    return tile


class _Drives:
    """The arrays of the drives that a tile needs."""

    def __init__(self, store: TileStore) -> None:
        self.layout, self._store, self._arrays = store.layout, store, dict[str, Any]()

    def read(self, part: Part, index: TileIndex) -> NDArray[Any]:
        """Return a tile of a sub-map, (7, tile, tile)."""
        store = self._store
        i, k, j, m = store.layout.box_of(index)
        offset = store.layout.cells // 2
        what = f"tile {index} of sub-map {part.number} of drive {part.drive} of {store.url}"
        key = submap_key(store, part.drive, part.number, index)
        with reading(what, f"remove {key}, and `ogm world build` with that drive makes it anew"):
            if part.drive not in self._arrays:
                self._arrays[part.drive] = drive_array(store, part.drive)
            rows, columns = slice(i + offset, k + offset), slice(j + offset, m + offset)
            return checked_layers(np.asarray(self._arrays[part.drive][part.number, :, rows, columns]))
