"""Blosc codec with checks of the chunk sizes, because its decoder reads out of bounds if they are wrong."""

import math
from typing import Any

from zarr.codecs import BloscCodec

_HEADER = 16  # [byte] versions, flags and item size, then sizes of data unpacked, block, and data packed, 4 bytes each


class CheckedBlosc(BloscCodec):
    """Zarr's Blosc codec, which rejects chunks whose header states wrong sizes."""

    async def _decode_single(self, chunk_bytes: Any, chunk_spec: Any) -> Any:
        packed = chunk_bytes.as_numpy_array()
        unpacked, block, size = (int.from_bytes(packed[at : at + 4].tobytes(), "little") for at in (4, 8, 12))
        whole = math.prod(chunk_spec.shape) * chunk_spec.dtype.item_size
        if len(packed) < _HEADER or unpacked != whole or not 0 < block <= whole or size != len(packed):
            raise ValueError(f"{len(packed)} bytes of Blosc data do not contain a chunk of {whole} bytes")
        return await super()._decode_single(chunk_bytes, chunk_spec)
