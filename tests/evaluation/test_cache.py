"""Frames that an evaluation kept: what is damaged is made anew, whatever the damage."""

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from ogm.evaluation.cache import ResultCache

HEADERS = [
    b"\x93NUMPY\x01\x00\x06\x00{'a':\n",  # its text ends too early
    b"\x93NUMPY\x01\x00\x02\x00((",
    b"\x93NUMPY\x01\x00\x04\x00None",
    b"\x93NUMPY\x01\x00\x3a\x00" + b"{'descr': [1], 'fortran_order': False, 'shape': (1,)}     ",
    b"\x93NUMPY\x01\x00\x50\x00" + b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,)}".ljust(80),
    b"",
]


@pytest.mark.parametrize("header", HEADERS)
def test_a_damaged_frame_is_missing(header: bytes, tmp_path: Path) -> None:
    cache = ResultCache(tmp_path, {"a": 1})
    key = io.BytesIO()
    np.save(key, np.array(cache.key))
    with zipfile.ZipFile(tmp_path / "000000.npz", "w") as archive:
        archive.writestr("key.npy", key.getvalue())
        for name in ("truth", "sums counts", "sums log_loss"):
            archive.writestr(f"{name}.npy", header)
    (tmp_path / "000001.npz").write_bytes(b"PK")
    assert cache.missing([0, 1, 2]) == [0, 1, 2]
