"""How tiles are packed, and what must hold of an array and of numbers that are read."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.world.kernels import CONFLICT_STEPS, COUNT_LIMIT, MASS_STEPS
from ogm.world.layout import LAYERS, WorldLayout


def codecs(level: int = 3) -> dict[str, Any]:
    """Return what chunks are packed and checked by, with a level of zstd, as `zarr.create_array` takes it.

    Blosc packs 9 % better, but reads beyond its memory where a crafted chunk has a right checksum.
    """
    from zarr.codecs import Crc32cCodec, ZstdCodec

    return {"compressors": [ZstdCodec(level=level), Crc32cCodec()], "filters": None, "fill_value": 0}


def checked_array(array: Any, **wanted: Any) -> Any:
    """Return a Zarr array, if its description is that of a map: damage there would show other numbers.

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
    names, endian = [one["name"] for one in codecs], codecs[0].get("configuration", {}).get("endian")
    key = described["chunk_key_encoding"]
    if names != ["bytes", "zstd", "crc32c"] or endian != "little" or array.fill_value != 0:
        raise ValueError(f"it is packed by {', '.join(names)}, {endian} endian, filled with {array.fill_value}")
    if key["name"] != "default" or key.get("configuration", {}).get("separator", "/") != "/":
        raise ValueError(f"its tiles are named by {key}")
    return array


def checked_layers(stored: NDArray[Any], layers: slice = slice(None)) -> NDArray[Any]:
    """Return stored layers (L, nx, ny), if the masses among them are masses, and the conflict is one.

    Raises
    ------
    ValueError
        If masses are negative, NaN or above 1 together, or other layers out of their range.
    """
    first = layers.start or 0
    last = first + len(stored)
    floats = stored.dtype != np.uint16
    if (first, last >= 2) == (0, True):
        free, occupied = stored[0], stored[1]
        if floats:
            fits = bool(np.all((free >= 0) & (occupied >= 0) & (free + occupied <= np.float32(1 + 1e-5))))
        else:  # their sum overflows, or not
            full = np.uint16(MASS_STEPS)
            fits = bool(free.max(initial=0) <= full and np.all(occupied <= full - free))
        if not fits:
            raise ValueError("its masses are negative or above 1")
    limits = (1, 1, COUNT_LIMIT, COUNT_LIMIT, COUNT_LIMIT) if floats else (CONFLICT_STEPS, CONFLICT_STEPS)
    for k, most in enumerate(limits, 2):
        if first <= k < last and not np.all((stored[k - first] >= 0) & (stored[k - first] <= most)):
            raise ValueError(f"{LAYERS[k]} is out of its range, 0 to {most}")
    return stored


def mass_of(stored: NDArray[Any], layout: WorldLayout) -> NDArray[np.float32]:
    """Return stored masses (2, nx, ny) as masses (nx, ny, 2)."""
    mass = np.empty((*stored.shape[1:], 2), np.float32)
    np.multiply(stored[0], np.float32(layout.steps["mass"]), out=mass[..., 0])
    np.multiply(stored[1], np.float32(layout.steps["mass"]), out=mass[..., 1])
    return mass
