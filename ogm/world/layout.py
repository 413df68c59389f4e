"""Layout of a stored world map: a lattice through the map's origin, tiles, layers, levels, and the packing of tiles."""

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ogm.fusion.kernels import CAUTIOUS, CUMULATIVE, DEMPSTER
from ogm.grid import GridSpec
from ogm.world.kernels import CONFLICT_STEPS, COUNT_LIMIT, MASS_STEPS

LAYERS = ("free", "occupied", "free_to_occupied", "occupied_to_free", "count", "seen_high", "seen_low")
TILES = 2**22  # along each axis of the lattice, half of them below 0: 172,000 km either way at 512 cells of 0.16 m
WORLD_RULES = {"cautious": CAUTIOUS, "dempster": DEMPSTER, "cumulative": CUMULATIVE}
_CHUNK = 256  # [cells] side of a chunk: the part of a tile that is packed and read separately
_ALIGNED = 1e-4  # [cells] rounding error of the corner of an aligned window

StoredType = Literal["uint16", "float32"]
WorldRule = Literal["cautious", "dempster", "cumulative"]
TileIndex = tuple[int, int]
Box = tuple[int, int, int, int]  # first and last + 1 cell along x, the same along y


@dataclass(frozen=True)
class WorldLayout:
    """Parameters of a world map, which never change.

    Cell (i, j) covers ``resolution * [i, i + 1) x [j, j + 1)`` in map coordinates, for whole i and j of either sign;
    tile (a, b) holds the cells ``tile * [a, a + 1) x tile * [b, b + 1)``. Level k has cells of ``2**k`` times the side.

    Parameters
    ----------
    resolution : float
        Side of a cell [m].
    tile : int
        Cells along a side of a tile: a power of two, 16 to 4096.
    dtype : {"uint16", "float32"}
        Type of the stored layers. In uint16 masses are rounded to the nearest n / 4095, conflict to n / 255.
    rule : {"cautious", "dempster", "cumulative"}
    min_unknown : float
        Lower bound of unknown, [1 / 4095, 1), in float32 [1e-4, 1).
    drive_reliability : float
        Shafer's discount of the map of a drive before it is combined with other drives, (0, 1].

    Raises
    ------
    ValueError
        If a number is out of its range.
    """

    resolution: float = 0.16
    tile: int = 512
    dtype: StoredType = "uint16"
    rule: WorldRule = "cautious"
    min_unknown: float = 0.02
    drive_reliability: float = 0.8

    def __post_init__(self) -> None:
        GridSpec(self.resolution, (1, 1), (0.0, 0.0))  # raises for an invalid resolution
        if not (isinstance(self.tile, int) and 16 <= self.tile <= 4096 and self.tile & (self.tile - 1) == 0):
            raise ValueError(f"tile must be a power of two from 16 to 4096 cells, got {self.tile!r}")
        if not math.isfinite(self.resolution * self.cells):
            raise ValueError(f"resolution must leave the map's corner finite [m], got {self.resolution}")
        if self.dtype not in ("uint16", "float32"):
            raise ValueError(f"dtype must be uint16 or float32, got {self.dtype!r}")
        if self.rule not in WORLD_RULES:
            raise ValueError(
                f"rule must be one of {', '.join(WORLD_RULES)}, got {self.rule!r}: others depend on the order of scans"
            )
        lowest = 1e-4 if self.dtype == "float32" else 1 / MASS_STEPS  # so that two masses rounded up fit in 1
        if not lowest <= self.min_unknown < 1:
            raise ValueError(f"min_unknown must be in [{lowest:.3g}, 1) for {self.dtype}, got {self.min_unknown}")
        if not 0 < self.drive_reliability <= 1:
            raise ValueError(f"drive_reliability must be in (0, 1], got {self.drive_reliability}")

    @property
    def cells(self) -> int:
        """Number of cells of level 0 along each axis."""
        return TILES * self.tile

    @property
    def steps(self) -> dict[str, float]:
        """Values of 1 in stored layers: of masses, and of conflict."""
        if self.dtype == "float32":
            return {"mass": 1.0, "conflict": 1.0}
        return {"mass": 1 / MASS_STEPS, "conflict": 1 / CONFLICT_STEPS}

    def array(self, level: int) -> dict[str, Any]:
        """Return shape, shards and chunks of the Zarr array of a level."""
        layers, side = len(LAYERS) if level == 0 else 2, self.cells >> level
        chunk = min(self.tile, _CHUNK)
        return {
            "shape": (layers, side, side),
            "shards": (layers, self.tile, self.tile),
            "chunks": (1, chunk, chunk),
            "dtype": self.dtype,
        }

    def empty_tile(self, layers: int = len(LAYERS)) -> NDArray[Any]:
        """Return a tile without seen cells, (layers, tile, tile)."""
        return np.zeros((layers, self.tile, self.tile), self.dtype)

    def spec(self, box: Box, level: int = 0) -> GridSpec:
        """Return the grid of a box of cells of a level, in map coordinates."""
        side = self.resolution * 2**level
        return GridSpec(side, (box[1] - box[0], box[3] - box[2]), (box[0] * side, box[2] * side))

    def box_of(self, index: TileIndex) -> Box:
        """Return the cells of a tile, of any level."""
        i, j = index[0] * self.tile, index[1] * self.tile
        return i, i + self.tile, j, j + self.tile

    def tiles_of(self, box: Box) -> list[TileIndex]:
        """Return the tiles with cells in a box, in order."""
        first, last = (box[0] // self.tile, box[2] // self.tile), ((box[1] - 1) // self.tile, (box[3] - 1) // self.tile)
        return [(i, j) for i in range(first[0], last[0] + 1) for j in range(first[1], last[1] + 1)]

    def check_box(self, box: Box, level: int = 0) -> None:
        """Raise ValueError if cells lie beyond the lattice."""
        half = self.cells >> (level + 1)
        if min(box) < -half or max(box) > half:
            reach = half * self.resolution * 2**level / 1e3
            raise ValueError(f"cells {box} lie beyond the map, which reaches {reach:.6g} km from its origin")

    def aligned(self, spec: GridSpec, level: int = 0) -> Box | None:
        """Return the box of a grid whose cells are cells of the map, else None."""
        side = self.resolution * 2**level
        if abs(spec.resolution / side - 1) * max(spec.shape) > _ALIGNED:
            return None
        i, j = spec.origin[0] / side, spec.origin[1] / side
        if max(abs(i - round(i)), abs(j - round(j))) > _ALIGNED:
            return None
        return round(i), round(i) + spec.shape[0], round(j), round(j) + spec.shape[1]

    def around(self, points: NDArray[np.float64], level: int = 0, margin: int = 1) -> Box:
        """Return the box of cells that contains all points (K, 2) [m] of the map, with a margin of cells."""
        side = self.resolution * 2**level
        low, high = points.min(axis=0) / side, points.max(axis=0) / side
        if not np.abs([low, high]).max() < 2**52:
            raise ValueError(f"points {points.tolist()} m are too far from the map's origin")
        (i, j), (k, n) = (math.floor(x) - margin for x in low), (math.ceil(x) + margin for x in high)
        return i, k, j, n


def corners(spec: GridSpec, T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the corners of a grid in another frame, (4, 2) [m], projected along the vertical of this frame."""
    x0, x1, y0, y1 = spec.extent
    xy = np.array([(x0, y0), (x0, y1), (x1, y0), (x1, y1)])
    return xy @ T[:2, :2].T + T[:2, 3]


def codecs(level: int = 3) -> dict[str, Any]:
    """Return the codecs of chunks, with a level of zstd and a checksum, as arguments of `zarr.create_array`.

    Blosc compresses 9 % better, but reads beyond its memory in a crafted chunk with a correct checksum.
    """
    from zarr.codecs import Crc32cCodec, ZstdCodec

    return {"compressors": [ZstdCodec(level=level), Crc32cCodec()], "filters": None, "fill_value": 0}


def checked_array(array: Any, **wanted: Any) -> Any:
    """Return a Zarr array if its description is valid for a map: damage of it would change the values read.

    Raises
    ------
    ValueError
        If it has another shape, type, chunks or packing.
    """
    for name, value in wanted.items():
        found = getattr(array, name, None)
        if found != (np.dtype(value) if name == "dtype" else value):
            raise ValueError(f"its {name} is {found}, wanted {value}")
    described = array.metadata.to_dict()
    codecs = described["codecs"]
    if codecs[0]["name"] == "sharding_indexed":
        codecs = codecs[0]["configuration"]["codecs"]
    names, endian = [codec["name"] for codec in codecs], codecs[0].get("configuration", {}).get("endian")
    key = described["chunk_key_encoding"]
    if names != ["bytes", "zstd", "crc32c"] or endian != "little" or array.fill_value != 0:
        raise ValueError(f"it is packed by {', '.join(names)}, {endian} endian, filled with {array.fill_value}")
    if key["name"] != "default" or key.get("configuration", {}).get("separator", "/") != "/":
        raise ValueError(f"its tiles are named by {key}")
    return array


def checked_layers(stored: NDArray[Any], layers: slice = slice(None)) -> NDArray[Any]:
    """Return stored layers (L, nx, ny) if their values are in range.

    Raises
    ------
    ValueError
        If masses are negative, NaN or above 1 in sum, or other layers are out of range.
    """
    first = layers.start or 0
    last = first + len(stored)
    floats = stored.dtype != np.uint16
    if (first, last >= 2) == (0, True):
        free, occupied = stored[0], stored[1]
        if floats:
            fits = bool(np.all((free >= 0) & (occupied >= 0) & (free + occupied <= np.float32(1 + 1e-5))))
        else:  # written so that the sum cannot overflow
            full = np.uint16(MASS_STEPS)
            fits = bool(free.max(initial=0) <= full and np.all(occupied <= full - free))
        if not fits:
            raise ValueError("its masses are negative or above 1")
    limits = (1, 1, COUNT_LIMIT, COUNT_LIMIT, COUNT_LIMIT) if floats else (CONFLICT_STEPS, CONFLICT_STEPS)
    for k, limit in enumerate(limits, 2):
        if first <= k < last and not np.all((stored[k - first] >= 0) & (stored[k - first] <= limit)):
            raise ValueError(f"{LAYERS[k]} is out of its range, 0 to {limit}")
    return stored


def mass_of(stored: NDArray[Any], layout: WorldLayout) -> NDArray[np.float32]:
    """Return stored masses (2, nx, ny) as masses (nx, ny, 2)."""
    mass = np.empty((*stored.shape[1:], 2), np.float32)
    np.multiply(stored[0], np.float32(layout.steps["mass"]), out=mass[..., 0])
    np.multiply(stored[1], np.float32(layout.steps["mass"]), out=mass[..., 1])
    return mass
