"""Description of weights: NAME.json next to NAME.safetensors, or metadata of an exported network."""

import hashlib
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ogm.grid import GridSpec
from ogm.storage.files import OgmError, update_hint

FORMAT = "ogm.network/1"
_MAX_SIZE = 2**20  # [bytes]


def read_description(path: Path) -> dict[str, Any]:
    """Read and check the description of weights.

    Raises
    ------
    OgmError
        If the file is damaged or of another kind.
    """
    try:
        if path.stat().st_size > _MAX_SIZE:
            raise ValueError(f"it has {path.stat().st_size} bytes, wanted at most {_MAX_SIZE}")
        description: dict[str, Any] = json.loads(path.read_bytes())
        found = description["format"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise OgmError(f"{path} is no description of a network ({error!r}): restore the file") from error
    if found != FORMAT:
        hint = update_hint(found, FORMAT)
        raise OgmError(f"{path} has the format {found!r}, this version of ogm reads {FORMAT}{hint}")
    try:
        check_description(description)
    except ValueError as error:
        raise OgmError(f"{path} has {error}") from error
    return description


def description_checksum(description: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a description without its entry ``sha256``, as JSON with sorted keys."""
    rest = {name: value for name, value in description.items() if name != "sha256"}
    return hashlib.sha256(json.dumps(rest, sort_keys=True).encode()).hexdigest()


def check_description(description: dict[str, Any]) -> None:
    """Raise ValueError if the ranges of the training data, which `DeepISM` uses, are impossible."""
    ranges = description.get("seen", {})
    good = isinstance(ranges, dict) and set(ranges) <= {"height", "points", "intensity", "ground"}
    for pair in ranges.values() if isinstance(ranges, dict) else ():
        numbers = isinstance(pair, list) and len(pair) == 2 and all(type(n) in (int, float) for n in pair)
        good = good and numbers and -math.inf < pair[0] <= pair[1] < math.inf
    if not good:
        raise ValueError(f"impossible ranges of the training data under 'seen': {ranges}")


def grid_of(description: dict[str, Any]) -> GridSpec:
    """Return the grid of the training; raise ValueError, KeyError or TypeError without a valid grid."""
    place = description["spec"]
    return GridSpec(place["resolution"], tuple(place["shape"]), tuple(place["origin"]))
