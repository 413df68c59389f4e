"""Targets: files of point clouds."""

import gzip
import io
import lzma
import struct
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from targets import Target, check_scan, cloud

from ogm.io import read_scan_file


def pcd(encoding: str, organised: bool = False) -> bytes:
    """Return a PCD of 24 points with ring and time."""
    p = cloud()
    ring, t = (np.arange(len(p)) % 4).astype(np.uint16), np.linspace(0, 0.09, len(p))
    width, height = (6, 4) if organised else (len(p), 1)
    head = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity ring time\nSIZE 4 4 4 4 2 8\n"
        f"TYPE F F F F U F\nCOUNT 1 1 1 1 1 1\nWIDTH {width}\nHEIGHT {height}\nVIEWPOINT 0 0 0 1 0 0 0\n"
        f"POINTS {len(p)}\nDATA {encoding}\n"
    ).encode()
    if encoding == "ascii":
        rows = [f"{a[0]} {a[1]} {a[2]} {a[3]} {r} {s}" for a, r, s in zip(p, ring, t, strict=True)]
        return head + "\n".join(rows).encode() + b"\n"
    kind = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("i", "<f4"), ("r", "<u2"), ("t", "<f8")])
    table = np.zeros(len(p), kind)
    for k, name in enumerate("xyzi"):
        table[name] = p[:, k]
    table["r"], table["t"] = ring, t
    if encoding == "binary":
        return head + table.tobytes()
    import lzf

    raw = b"".join(table[name].tobytes() for name in kind.names or ())
    packed = lzf.compress(raw, 2 * len(raw)) or b""
    return head + struct.pack("<II", len(packed), len(raw)) + packed


def ply(encoding: str) -> bytes:
    """Return a PLY of 24 points with ring."""
    p = cloud()
    head = (
        f"ply\nformat {encoding} 1.0\ncomment made here\nelement vertex {len(p)}\nproperty float x\nproperty float y\n"
        "property double z\nproperty uchar intensity\nproperty ushort ring\nelement face 0\n"
        "property list uchar int vertex_indices\nend_header\n"
    ).encode()
    order = ">" if "big" in encoding else "<"
    kind = np.dtype([("x", f"{order}f4"), ("y", f"{order}f4"), ("z", f"{order}f8"), ("i", "u1"), ("r", f"{order}u2")])
    table = np.zeros(len(p), kind)
    table["x"], table["y"], table["z"], table["i"], table["r"] = *p[:, :3].T, p[:, 3] * 255, np.arange(len(p)) % 16
    if encoding == "ascii":
        return head + "\n".join(" ".join(map(str, row)) for row in table.tolist()).encode() + b"\n"
    return head + table.tobytes()


def npy(array: np.ndarray) -> bytes:
    """Return an array as .npy."""
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def las(version: str, form: int, packed: bool) -> bytes:
    """Return a LAS or LAZ of 24 points."""
    import laspy

    p = cloud()
    header = laspy.LasHeader(version=version, point_format=form)
    header.scales, header.offsets = [0.001] * 3, [0.0] * 3
    data = laspy.LasData(header)
    data.x, data.y, data.z = p[:, :3].T.astype(np.float64)
    data.intensity = (p[:, 3] * 65535).astype(np.uint16)
    data.gps_time = np.linspace(0, 0.09, len(p))
    stream = io.BytesIO()
    data.write(stream, do_compress=packed)
    return stream.getvalue()


def feather(columns: dict[str, Any], compression: str = "uncompressed") -> bytes:
    """Return a table of Arrow."""
    import pyarrow as pa
    from pyarrow import feather as file

    stream = io.BytesIO()
    file.write_feather(pa.table(columns), stream, compression=compression)
    return stream.getvalue()


def sweep(compression: str) -> bytes:
    """Return a sweep of Argoverse 2."""
    p = cloud()
    columns = {name: p[:, k].astype(np.float16) for k, name in enumerate("xyz")}
    columns |= {
        "intensity": (p[:, 3] * 255).astype(np.uint8),
        "laser_number": (np.arange(len(p)) % 64).astype(np.uint8),
    }
    return feather(columns | {"offset_ns": np.arange(len(p), dtype=np.int32) * 4_000_000}, compression)


def _scan(name: str, make: Callable[[], bytes], folder: Path) -> Target:
    return Target({name: make()}, lambda files: check_scan(read_scan_file(files / name)[0]))


_SCANS: dict[str, tuple[str, Callable[[], bytes]]] = {
    **{f"pcd-{kind}": ("a.pcd", partial(pcd, kind)) for kind in ("ascii", "binary", "binary_compressed")},
    "pcd-organised": ("a.pcd", partial(pcd, "binary", True)),
    **{f"ply-{kind}": ("a.ply", partial(ply, kind)) for kind in ("ascii", "binary_little_endian", "binary_big_endian")},
    "bin": ("000001.bin", lambda: cloud().tobytes()),
    "pcd-bin": ("a.pcd.bin", lambda: np.column_stack([cloud(), np.zeros(24)]).astype("<f4").tobytes()),
    "npy": ("a.npy", lambda: npy(cloud())),
    "npy-organised": ("a.npy", lambda: npy(np.asfortranarray(cloud().reshape(4, 6, 4)))),
    "las12": ("a.las", partial(las, "1.2", 3, False)),
    "las14": ("a.las", partial(las, "1.4", 6, False)),
    "laz12": ("a.laz", partial(las, "1.2", 1, True)),
    "laz14": ("a.laz", partial(las, "1.4", 6, True)),
    **{f"feather-{kind}": ("a.feather", partial(sweep, kind)) for kind in ("uncompressed", "lz4", "zstd")},
    "pcd-xz": ("a.pcd.xz", lambda: lzma.compress(pcd("binary"))),
    "pcd-gz": ("a.pcd.gz", lambda: gzip.compress(pcd("ascii"))),
}
TARGETS: dict[str, Callable[[Path], Target]] = {name: partial(_scan, *given) for name, given in _SCANS.items()}
