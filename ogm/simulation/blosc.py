"""Blosc with the sizes of a chunk compared: its decoder trusts them, and reads beyond its memory if they are wrong."""

import math
from typing import Any

from zarr.codecs import BloscCodec

_HEADER = 16  # [byte]: versions, flags, size of a number, then the size unpacked, of a block and packed, 4 each


class CheckedBlosc(BloscCodec):
    """Zarr's codec, which refuses a chunk whose header states other sizes than it has."""

    async def _decode_single(self, chunk_bytes: Any, chunk_spec: Any) -> Any:
        packed = chunk_bytes.as_numpy_array()
        unpacked, block, size = (int.from_bytes(packed[at : at + 4].tobytes(), "little") for at in (4, 8, 12))
        whole = math.prod(chunk_spec.shape) * chunk_spec.dtype.item_size
        if len(packed) < _HEADER or unpacked != whole or not 0 < block <= whole or size != len(packed):
            raise ValueError(f"{len(packed)} bytes packed by Blosc do not hold a chunk of {whole} bytes")
        return await super()._decode_single(chunk_bytes, chunk_spec)
