"""Permitted codecs of Zarr maps: decoders that crafted chunks cannot make read beyond their memory."""

import json
from pathlib import Path

from ogm.storage.files import OgmError

_CODECS = {"bytes", "crc32c", "gzip", "sharding_indexed", "transpose", "zstd"}


def check_packing(path: Path) -> None:
    """Raise OgmError if an array of a Zarr folder has another codec, such as Blosc."""
    for described in sorted(path.glob("*/zarr.json")):
        left = list(json.loads(described.read_bytes())["codecs"])
        while left:
            codec = left.pop()
            if codec["name"] not in _CODECS:
                raise OgmError(f"{described.parent} is packed by {codec['name']}, wanted {', '.join(sorted(_CODECS))}")
            inside = codec.get("configuration", {})
            left += [*inside.get("codecs", ()), *inside.get("index_codecs", ())]
