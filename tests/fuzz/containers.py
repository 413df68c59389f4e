"""Changes of what formats are made of: members of archives, chunks, records, fields, with checksums made right again.

A change takes the random numbers, the content, and a function that changes what lies inside, given the ending of its
name. `CHANGES` lists them with the test whether a file is of their kind.
"""

import ast
import io
import random
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import google_crc32c
import numcodecs
import numpy as np
from records import COUNTS, Inner, change_bag, change_database, change_mcap

__all__ = ["CHANGES"]

EXTRA = (b"tEXt", b"zTXt", b"iCCP", b"acTL", b"fdAT", b"PLTE", b"tRNS", b"gAMA", b"eXIf", b"iTXt")  # chunks
KINDS = ("<f8", ">f4", "<f2", "<i4", "|u1", "|b1", "<c8", "|O", "<U5", "|S3", "<M8[s]", "|V7", "f4,f4", "x", "<f16", "")


def change_zip(rng: random.Random, data: bytes, inner: Inner) -> bytes:
    """Drop, rename or change a member, pack it in another way, or change the archive's own entries."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = [(info.filename, archive.read(info)) for info in archive.infolist()]
    k = rng.randrange(len(members))
    name, content = members[k]
    match rng.randrange(8):
        case 0:
            members.pop(k)
        case 1:
            members[k] = (rng.choice(("../x.npy", "/abs/x.npy", "mass", "x.npy", name[:-4], name + "\udc80")), content)
        case 2:
            wild = (np.array("x"), np.array(1j), np.zeros((2, 2)), np.zeros(0), np.array([["a"]]), np.array(7), 1e308)
            members[k] = (name, _npy(np.asarray(rng.choice(wild))))
        case 3:
            members.insert(rng.randrange(len(members)), members[k])
        case _:
            members[k] = (name, inner(rng, content, ".npy"))
    out = io.BytesIO()
    with warnings.catch_warnings(action="ignore"), zipfile.ZipFile(out, "w", rng.choice((0, 8, 8, 12, 14))) as archive:
        for name, content in members:
            archive.writestr(name.encode("utf-8", "replace").decode(), content)
    packed = bytearray(out.getvalue())
    if rng.random() < 0.15:  # sizes that the entries claim
        at = packed.find(rng.choice((b"PK\x01\x02", b"PK\x03\x04", b"PK\x05\x06")))
        struct.pack_into("<I", packed, at + rng.randrange(4, 18), rng.choice(COUNTS) % 2**32)
    return bytes(packed)


def change_npy(rng: random.Random, data: bytes, inner: Inner) -> bytes:
    """Change type, shape and order that the header of an array states."""
    size = int.from_bytes(data[8:10], "little")
    head: Any = ast.literal_eval(data[10 : 10 + size].decode())
    shape = list(head["shape"])
    match rng.randrange(4):
        case 0:
            head["descr"] = rng.choice(KINDS)
        case 1:
            head["fortran_order"] = rng.choice((True, False, None, 1))
        case 2 if shape:
            k = rng.randrange(len(shape))
            shape[k] = rng.choice((*COUNTS, shape[k] + 1, shape[k] - 1, 1.5, "a"))
        case _:
            shape = rng.choice(([], shape[::-1], [*shape, 1], [1, *shape], [1] * 40, [0, 2**62, 2**62], shape[:-1]))
    text = repr(head | {"shape": tuple(shape)}).encode() + b"\n"
    return data[:8] + (len(text) % 2**16).to_bytes(2, "little") + text + data[10 + size :]


def change_shard(rng: random.Random, data: bytes, inner: Inner) -> bytes:
    """Change a chunk of a shard of Zarr, packed or not, or where the index places it; the sums are right again."""
    count = next((n for n in range(1, min(33, len(data) // 16)) if _sum(data[-16 * n - 4 : -4]) == data[-4:]), 0)
    if not count:
        raise ValueError("no shard")
    index = list(struct.iter_unpack("<QQ", data[-16 * count - 4 : -4]))
    chunks = [data[at : at + size - 4] if size < 2**32 else None for at, size in index]
    k = rng.choice([n for n, chunk in enumerate(chunks) if chunk])
    match rng.randrange(6):
        case 0:
            chunks[k] = rng.choice(chunks)
        case 1:
            chunks[k] = None
        case 2 | 3:
            blosc = numcodecs.Blosc("zstd", 1, rng.choice((0, 1, 2)), typesize=rng.choice((1, 2, 4)))
            codec = numcodecs.Zstd(1) if chunks[k][:4] == b"\x28\xb5\x2f\xfd" else blosc
            chunks[k] = codec.encode(inner(rng, codec.decode(chunks[k])))
        case _:
            chunks[k] = inner(rng, chunks[k] or b"")
    out, entries = b"", []
    for chunk in chunks:
        entries.append((len(out), len(chunk) + 4) if chunk is not None else (2**64 - 1, 2**64 - 1))
        out += b"" if chunk is None else chunk + _sum(chunk)
    if rng.random() < 0.15:
        entries[k] = (rng.choice(COUNTS) % 2**64, rng.choice(COUNTS) % 2**64)
    packed = b"".join(struct.pack("<QQ", *one) for one in entries)
    return out + packed + _sum(packed)


def _sum(data: bytes) -> bytes:
    return struct.pack("<I", google_crc32c.value(data))


def change_png(rng: random.Random, data: bytes, inner: Inner) -> bytes:
    """Change, double, drop or insert a chunk."""
    chunks, at = [], 8
    while at < len(data):
        size = int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : at + 8 + size]))
        at += 12 + size
    k = rng.randrange(len(chunks))
    kind, content = chunks[k]
    match rng.randrange(6):
        case 0:
            chunks.insert(rng.randrange(len(chunks)), chunks[k])
        case 1:
            chunks.pop(k)
        case 2:
            extra = rng.choice(
                (b"tEXt", b"zTXt", b"iCCP", b"acTL", b"fdAT", b"PLTE", b"tRNS", b"gAMA", b"eXIf", b"iTXt")
            )
            bomb = b"a\0\0" + zlib.compress(bytes(2**22), 9)
            chunks.insert(rng.randrange(len(chunks)), (extra, rng.choice((rng.randbytes(20), bomb, b"a\0" + bytes(8)))))
        case 3 if kind == b"IDAT":
            chunks[k] = (kind, zlib.compress(inner(rng, zlib.decompress(content)), 1))
        case 4:
            head = bytearray(chunks[0][1])
            at = rng.choice((0, 4))
            head[at : at + 4] = (rng.choice(COUNTS) % 2**32).to_bytes(4, "big")
            chunks[0] = (b"IHDR", bytes(head))
        case _:
            chunks[k] = (kind, inner(rng, content))
    parts = (len(c).to_bytes(4, "big") + t + c + zlib.crc32(t + c).to_bytes(4, "big") for t, c in chunks)
    return data[:8] + b"".join(parts)


def change_tiff(rng: random.Random, data: bytes, inner: Inner) -> bytes:
    """Change an entry of the first directory: its tag, type, count or value."""
    out = bytearray(data)
    (first,) = struct.unpack_from("<I", out, 4)
    (count,) = struct.unpack_from("<H", out, first)
    at = first + 2 + 12 * rng.randrange(count)
    place, form, bits = rng.choice(((0, "<H", 16), (2, "<H", 16), (4, "<I", 32), (8, "<I", 32)))
    value = rng.choice(
        (*COUNTS, struct.unpack_from(form, out, at + place)[0] + rng.choice((-1, 1, 4)), rng.getrandbits(8))
    )
    struct.pack_into(form, out, at + place, value % 2**bits)
    return bytes(out)


def change_hdf5(rng: random.Random, data: bytes, inner: Inner) -> bytes:
    """Change a dataset: values, a column, its type, shape, storage or filters; or put a link or a group there."""
    import h5py

    with h5py.File("a.h5", "w", driver="core", backing_store=False, libver=rng.choice(("earliest", "latest"))) as file:
        with h5py.File(io.BytesIO(data), "r") as old:
            tables = {name: old[name][...] for name in old}
        name = rng.choice(sorted(tables))
        rows, options = tables.pop(name), {}
        for other, content in tables.items():
            file[other] = content
        column = rng.choice(rows.dtype.names)
        match rng.randrange(10):
            case 0:
                kept = [one for one in rows.dtype.names if one != column]
                rows = rows[kept].astype([(one, rows.dtype[one]) for one in kept])
            case 1:
                kinds = ("<f8", ">i4", "u1", "S3", "<f2", "(2,)<f4", "?", h5py.string_dtype(), h5py.ref_dtype)
                kind = np.dtype(
                    [(one, rng.choice(kinds) if one == column else rows.dtype[one]) for one in rows.dtype.names]
                )
                rows = np.zeros(len(rows), kind)
            case 2:
                wild = (0, -1, 1e300, float("nan"), float("inf"), 2**63 - 1, 255)
                with warnings.catch_warnings(action="ignore"):
                    rows[column][rng.randrange(len(rows))] = np.float64(rng.choice(wild)).astype(rows.dtype[column])
            case 3:
                rows = rng.choice((rows[:0], rows[:3], rows[::-1], np.tile(rows, 50), rows[None], rows[0]))
            case 4:
                filters = ({"compression": "gzip"}, {"compression": "lzf"}, {"shuffle": True}, {"fletcher32": True})
                options = {"chunks": (rng.choice((1, 5, len(rows))),), **rng.choice(filters)}
            case 5:
                size = rng.choice((2**20, 2**24, 2**40))
                options = {
                    "shape": (size,),
                    "chunks": (rng.choice((9, 2**16, min(size, 2**22))),),
                    "compression": "gzip",
                }
            case 6:
                options = {"shape": (len(rows),), "external": [("/etc/passwd", 0, 2**30)]}
            case 7:
                links = (
                    h5py.SoftLink("/"), h5py.SoftLink(f"/{name}"), h5py.ExternalLink("a.h5", name), np.dtype("<f4"),
                )  # fmt: skip
                file[name] = rng.choice(links)
            case 8:
                file.create_group(name)
            case _:
                rows = np.frombuffer(inner(rng, rows.tobytes()).ljust(rows.nbytes, b"\0")[: rows.nbytes], rows.dtype)
        if name not in file and file.get(name, getlink=True) is None:
            file.create_dataset(name, **({"dtype": rows.dtype} if "shape" in options else {"data": rows}), **options)
        file.flush()
        return file.id.get_file_image()


def change_protobuf(rng: random.Random, data: bytes, inner: Inner) -> bytes:
    """Change, drop, double or move a field of a protocol buffer; the lengths around it stay right."""
    fields, at = [], 0
    try:
        while at < len(data):
            key, at = _varint(data, at)
            if key & 7 == 0:
                value, at = _varint(data, at)
                fields.append((key, value.to_bytes(10, "little")))
                continue
            size, at = _varint(data, at) if key & 7 == 2 else ({1: 8, 5: 4}[key & 7], at)
            fields.append((key, data[at : at + size]))
            at += size
    except (IndexError, KeyError, OverflowError):
        return inner(rng, data)
    if not fields:
        return inner(rng, data)
    k = rng.randrange(len(fields))
    key, content = fields[k]
    match rng.randrange(7):
        case 0:
            fields.pop(k)
        case 1:
            fields.insert(rng.randrange(len(fields)), fields[k])
        case 2:
            fields[k] = (rng.choice((key ^ 1, key + 8, key & 7, key ^ 2, key ^ 7)), content)
        case 3 if key & 7 == 0:
            fields[k] = (key, (rng.choice(COUNTS) % 2**64).to_bytes(10, "little"))
        case 4 | 5 if key & 7 == 2:
            fields[k] = (key, change_protobuf(rng, content, inner))
        case _:
            fields[k] = (key, inner(rng, content))
    out = bytearray()
    for key, content in fields:
        out += _as_varint(key)
        out += _as_varint(int.from_bytes(content[:8], "little")) if key & 7 == 0 else b""
        out += (_as_varint(len(content)) if key & 7 == 2 else b"") + content if key & 7 else b""
    return bytes(out)


def _varint(data: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at


def _as_varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def _npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


CHANGES: tuple[tuple[Callable[[str, bytes], bool], Callable[[random.Random, bytes, Inner], bytes]], ...] = (
    (lambda name, data: data[:4] == b"PK\x03\x04", change_zip),
    (lambda name, data: data[:8] == b"\x93NUMPY\x01\x00", change_npy),
    (lambda name, data: data[:4] == b"\x89PNG", change_png),
    (lambda name, data: data[:4] == b"II*\0" and len(data) > 200, change_tiff),
    (lambda name, data: data[:8] == b"\x89HDF\r\n\x1a\n" and name.endswith(".h5"), change_hdf5),
    (lambda name, data: data[:8] == b"SQLite f" and len(data) >= 4096, change_database),
    (lambda name, data: data[:5] == b"\x89MCAP" and data[-8:] == data[:8], change_mcap),
    (lambda name, data: data[:13] == b"#ROSBAG V2.0\n", change_bag),
    (lambda name, data: "/c/" in name, change_shard),
    (lambda name, data: name.endswith((".onnx", ".pb")), change_protobuf),
)
