"""Flipped bits for tests of files: what is read is what was written, or an `OgmError` names the file."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ogm import OgmError


def check_flips(path: Path, read: Callable[[], Any], most: int = 10**9, named: str = "") -> Counter[str]:
    """Flip a bit of every byte of a file, or of `most` bytes spread over it, one at a time, and read.

    Either the content is that of the whole file, or an `OgmError` has the name of the file, or `named`.
    """
    wanted, found = read(), Counter[str]()
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for at in np.unique(np.linspace(0, len(whole) - 1, min(most, len(whole))).astype(int)).tolist():
        bit = int(rng.integers(8))
        what = f"bit {bit} of byte {at} of {path}"
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1 << bit]) + whole[at + 1 :])
        told = ""
        try:
            content = read()
        except OgmError as error:
            told = str(error)
        found["refused" if told else "harmless"] += 1
        if told:
            assert (named or path.name) in told, f"{what} is refused without a name: {told}"
        else:
            assert content == wanted, f"{what} changed what is read"
    path.write_bytes(whole)
    assert read() == wanted
    return found
