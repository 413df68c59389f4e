"""Changes of logs: rows of SQLite, records of MCAP and ROS 1 bags, with lengths and checksums made right again."""

import random
import sqlite3
import struct
import zlib
from collections.abc import Callable
from typing import Any

__all__ = ["COUNTS", "Inner", "change_bag", "change_database", "change_mcap"]

Inner = Callable[..., bytes]
COUNTS = (0, 1, -1, 2, 3, 2**16, 2**31 - 1, 2**31, 2**40, 2**62, 2**64)


def change_database(rng: random.Random, data: bytes, inner: Inner) -> bytes:
    """Change the rows and tables of a database of SQLite, as another program could have written them."""
    base = sqlite3.connect(":memory:", isolation_level=None)
    try:
        base.deserialize(data)
        base.execute("PRAGMA writable_schema = ON")
        tables = [row[0] for row in base.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
        table = rng.choice(tables)
        columns = [row[1] for row in base.execute(f"PRAGMA table_info('{table}')")]
        column = rng.choice(columns)
        match rng.randrange(6):
            case 0:
                base.execute(f"DROP TABLE '{table}'")
            case 1:
                base.execute(f"ALTER TABLE '{table}' RENAME COLUMN '{column}' TO other")
            case 2:
                base.execute(f"DELETE FROM '{table}' WHERE rowid % ? = 0", (rng.choice((1, 2, 3)),))
            case _:
                rows = base.execute(f"SELECT rowid, \"{column}\" FROM '{table}'").fetchall()
                number, old = rng.choice(rows)
                if isinstance(old, bytes | str) and rng.random() < 0.7:
                    new: Any = inner(rng, old if isinstance(old, bytes) else old.encode())
                    new = new if isinstance(old, bytes) else new.decode("latin-1")
                else:
                    new = rng.choice((None, -1, 0, 2**62, -(2**63), 1e300, "", "x", b"", b"\0" * 9, "\0", "sqlite"))
                base.execute(f"UPDATE '{table}' SET \"{column}\" = ? WHERE rowid = ?", (new, number))
        return bytes(base.serialize())
    except sqlite3.Error:  # a column that must be unique, and such
        return inner(rng, data)
    finally:
        base.close()


def change_mcap(rng: random.Random, data: bytes, inner: Inner) -> bytes:
    """Change, drop, double or swap records, also those in chunks, which are packed and summed up anew."""
    return data[:8] + _changed_records(rng, data[8:-8], inner) + data[-8:]


def _changed_records(rng: random.Random, data: bytes, inner: Inner) -> bytes:
    records, at = [], 0
    while at + 9 <= len(data):
        code, size = struct.unpack_from("<BQ", data, at)
        records.append((code, data[at + 9 : at + 9 + size]))
        at += 9 + size
    if not records:
        return inner(rng, data)
    k = rng.randrange(len(records))
    code, content = records[k]
    match rng.randrange(6):
        case 0:
            records.pop(k)
        case 1:
            records.insert(rng.randrange(len(records)), records[k])
        case 2:
            records[k] = (rng.choice((code + 1, 0, 255, *range(1, 16))) % 256, content)
        case _:
            if code == 6 and rng.random() < 0.8:  # a chunk: two times, size, sum, packing, records
                start, end, _, _, length = struct.unpack_from("<QQQII", content)
                packing = content[32 : 32 + length]
                body = content[40 + length :]
                body = _changed_records(rng, _unpacked(packing, body), inner)
                size = rng.choice((len(body),) * 4 + (0, 2**31, 2**62, len(body) + 1))
                head = struct.pack("<QQQII", start, end, size, zlib.crc32(body), length)
                body = _packed(packing, body)
                content = head + packing + struct.pack("<Q", len(body)) + body
            elif code == 5 and rng.random() < 0.8:  # a message: channel, number, two times, bytes
                content = content[:22] + inner(rng, content[22:])
            else:
                content = inner(rng, content)
            records[k] = (code, content)
    out = [struct.pack("<BQ", code, len(content)) + content for code, content in records]
    if out and rng.random() < 0.1:
        k = rng.randrange(len(out))
        code = out[k][0]
        out[k] = struct.pack("<BQ", code, rng.choice(COUNTS) % 2**64) + out[k][9:]
    return b"".join(out)


def _unpacked(packing: bytes, body: bytes) -> bytes:
    if packing == b"zstd":
        from ogm.io.logs.chunks import unpack_zstd

        return bytes(unpack_zstd(body, 2**24))
    return body


def _packed(packing: bytes, body: bytes) -> bytes:
    if packing == b"zstd":
        import zstandard

        return zstandard.ZstdCompressor(1).compress(body)
    return body


def change_bag(rng: random.Random, data: bytes, inner: Inner) -> bytes:
    """Change, drop or double records of a ROS 1 bag, also those in chunks: each has fields and content."""
    records, at = [], 13
    while at + 8 <= len(data):
        head, at = _block(data, at)
        body, at = _block(data, at)
        records.append([head, body])
    return data[:13] + _bag_records(rng, records, inner)


def _block(data: bytes, at: int) -> tuple[bytes, int]:
    (size,) = struct.unpack_from("<I", data, at)
    return data[at + 4 : at + 4 + size], at + 4 + size


def _bag_records(rng: random.Random, records: list[list[bytes]], inner: Inner) -> bytes:
    k = rng.randrange(len(records))
    match rng.randrange(6):
        case 0:
            records.pop(k)
        case 1:
            records.insert(rng.randrange(len(records)), records[k])
        case 2 | 3:
            fields, at = [], 0
            while at + 4 <= len(records[k][0]):
                field, at = _block(records[k][0], at)
                fields.append(field)
            n = rng.randrange(len(fields))
            name, _, value = fields[n].partition(b"=")
            whole = rng.choice(COUNTS) % 2**64
            new = rng.choice((inner(rng, value), whole.to_bytes(8, "little")[: len(value)], b""))
            fields[n] = rng.choice((name + b"=" + new, name + new, fields[n - 1]))
            records[k] = [b"".join(len(one).to_bytes(4, "little") + one for one in fields), records[k][1]]
        case _:
            records[k] = [records[k][0], inner(rng, records[k][1])]
    return b"".join(len(part).to_bytes(4, "little") + part for record in records for part in record)
