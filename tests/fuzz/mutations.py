"""Changes of files: of bytes, words and lines, and of what formats are made of (`containers`)."""

import gzip
import json
import lzma
import random
import re
import struct
import zlib
from contextlib import suppress
from typing import Any

import containers

from ogm.storage.archive import attributes_checksum

__all__ = ["change"]

INTEGERS = (
    0, 1, 2, 7, 127, 128, 255, 256, 32767, 65535, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1,
)  # fmt: skip
WORDS = (
    b"nan", b"inf", b"-inf", b"-1", b"0", b"1", b"1e400", b"1e38", b"-1e-400", b"9" * 20, b"4294967295", b"2147483647",
    b"1_0", b"0x10", b"\xc2\xb2", b"\xd9\xa3", b"1,5", b"''", b"None", b"#", b"True", b"1e5", b"-0", b"1000000000",
    b"9007199254740993", b"NaT", b"2011-13-45", b"\x00", b"x", b"_", b"../../etc/passwd", b"a" * 300, b"9" * 5000,
    b"[1, 2]", b"{}", b"\xff\xfe", b"F", b"U", b"8", b"binary", b"ascii", b"binary_compressed", b"double", b"list",
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 0.5, 1e308, float("nan"), float("inf"), 10**30, 10**400, 2**63, "", "x", "1",
    "a" * 300, "../../etc/passwd", "/etc/passwd", "\ud800", "\0", [], {}, [[]], [None], [1, 2], {"a": 1}, [1e308] * 4,
    {"x": None},
)  # fmt: skip


def change(rng: random.Random, name: str, data: bytes, pool: list[bytes]) -> bytes:
    """Return a file's content changed: half of the time by what its format is made of, else anywhere.

    Parameters
    ----------
    rng : random.Random
        All that the change depends on.
    name : str
        Of the file.
    data : bytes
    pool : list of bytes
        Contents that parts may come from.
    """

    def again(rng: random.Random, inner: bytes, ending: str = "") -> bytes:
        return change(rng, ending or "inner", inner, pool)

    if name.endswith((".gz", ".xz")) and rng.random() < 0.6:
        packing: Any = gzip if name.endswith(".gz") else lzma
        inner = again(rng, packing.decompress(data), name[:-3])
        return gzip.compress(inner, 1) if packing is gzip else lzma.compress(inner, preset=0)
    if rng.random() < 0.55:
        with suppress(ArithmeticError, LookupError, SyntaxError, TypeError, ValueError, struct.error, zlib.error):
            return _by_format(rng, name, data, again)  # a part that only begins like its format is changed below
    out = bytearray(data)
    text = _is_text(out)
    kinds = (_bytes, _bytes, _words, _words, _lines) if text else (_bytes, _bytes, _counts, _words)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        rng.choice(kinds)(rng, out, pool)
    return bytes(out)


def _by_format(rng: random.Random, name: str, data: bytes, again: containers.Inner) -> bytes:
    """Change a file by what it is made of; a ValueError if nothing of it is known."""
    if name.endswith("zarr.json") and b'"sha256"' in data:
        return change_attributes(rng, data)
    if name.endswith(".json"):
        return change_json(rng, data)
    if name.endswith(".safetensors"):
        size = int.from_bytes(data[:8], "little")
        head = change_json(rng, data[8 : 8 + size])
        return len(head).to_bytes(8, "little") + head + data[8 + size :]
    for fits, how in containers.CHANGES:
        if fits(name, data):
            return how(rng, data, again)
    raise ValueError("of no known format")


def _is_text(data: bytearray) -> bool:
    return all(b in b"\t\n\r" or 32 <= b < 127 for b in data[:200])


def _bytes(rng: random.Random, out: bytearray, pool: list[bytes]) -> None:
    """Flip, overwrite, cut, insert, move, or continue with another file."""
    n = len(out)
    near = min(n, 400) if rng.random() < 0.5 else n
    at = rng.randrange(near) if near else 0
    match rng.randrange(9):
        case 0 if n:
            out[at] ^= 1 << rng.randrange(8)
        case 1 if n:
            out[at] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, 0x20, 0x0A, rng.randrange(256)))
        case 2:
            size = rng.choice((2, 4, 8))
            value = rng.choice(INTEGERS) if rng.random() < 0.7 else rng.getrandbits(64)
            out[at : at + size] = (value % 2 ** (8 * size)).to_bytes(size, rng.choice(("little", "little", "big")))
        case 3:
            del out[rng.randrange(n + 1) :]
        case 4:
            out += rng.randbytes(rng.choice((1, 4, 16, 4096)))
        case 5:
            del out[at : at + rng.choice((1, 2, 4, 8, 64))]
        case 6:
            out[at:at] = rng.randbytes(rng.choice((1, 2, 4, 8, 64)))
        case 7:
            size, to = rng.choice((4, 16, 64, 256)), rng.randrange(n + 1)
            out[to : to + size] = out[at : at + size]
        case _:
            other = rng.choice(pool)
            out[at:] = other[rng.randrange(len(other) + 1) :]


def _counts(rng: random.Random, out: bytearray, pool: list[bytes]) -> None:
    """Change what may be a length or a count: a small whole number of 2, 4 or 8 bytes."""
    size = rng.choice((2, 4, 4, 4, 8))
    for _ in range(20):
        at = rng.randrange(max(len(out) - size, 1))
        value = int.from_bytes(out[at : at + size], "little")
        if 0 < value <= 4 * len(out):
            break
    new = rng.choice(
        (value + 1, value - 1, 2 * value, value // 2, value << 8, 2 ** (8 * size - 1), -1, 0, value * 1000)
    )
    out[at : at + size] = (new % 2 ** (8 * size)).to_bytes(size, "little")


def _words(rng: random.Random, out: bytearray, pool: list[bytes]) -> None:
    """Change a word of the text, or of the header that a file begins with."""
    end = len(out) if _is_text(out) else min(len(out), 600)
    spans = [m.span() for m in re.finditer(rb"[^\s,:(){}'\"]+", out[:end])]
    if not spans:
        return
    a, b = rng.choice(spans)
    match rng.randrange(5):
        case 0:
            del out[a:b]
        case 1:
            c, d = rng.choice(spans)
            out[a:b] = out[c:d]
        case 2 if out[a:b].isdigit():
            out[a:b] = str(rng.choice(INTEGERS)).encode()
        case _:
            out[a:b] = rng.choice(WORDS)


def _lines(rng: random.Random, out: bytearray, pool: list[bytes]) -> None:
    lines = bytes(out).split(b"\n")
    k = rng.randrange(len(lines))
    match rng.randrange(6):
        case 0:
            del lines[k]
        case 1:
            lines.insert(k, rng.choice(lines))
        case 2:
            lines[k] = b""
        case 3:
            lines.insert(k, lines.pop(rng.randrange(len(lines))))
        case 4:
            lines[k] += b" " + rng.choice(WORDS)
        case _:
            lines[k:k] = lines[k : k + 1] * rng.choice((2, 100))
    out[:] = b"\n".join(lines)


def change_json(rng: random.Random, data: bytes) -> bytes:
    """Delete, double, move and replace values of a JSON file, or nest it deeply."""
    if rng.random() < 0.02:
        return b"[" * 100_000
    value = json.loads(data)
    for _ in range(rng.choice((1, 1, 2, 4))):
        places: list[tuple[Any, Any]] = []
        stack = [value]
        while stack:
            one = stack.pop()
            for key in list(one) if isinstance(one, dict) else range(len(one)) if isinstance(one, list) else ():
                places.append((one, key))
                stack.append(one[key])
        if not places:
            return _dumped(rng.choice(VALUES))
        holder, key = rng.choice(places)
        match rng.randrange(6):
            case 0:
                del holder[key]
            case 1:
                other, name = rng.choice(places)
                if isinstance(other, dict) and name in other:
                    holder[key] = json.loads(_dumped(other[name]))
            case 2 if isinstance(holder, list):
                holder.append(json.loads(_dumped(holder[key])))
            case 3 if type(holder[key]) in (int, float):
                holder[key] = rng.choice(
                    (*INTEGERS, -holder[key], holder[key] * 3, float("nan"), str(holder[key])[:99])
                )
            case _:
                holder[key] = json.loads(_dumped(rng.choice(VALUES)))
    return _dumped(value)


def change_attributes(rng: random.Random, data: bytes) -> bytes:
    """Change the description of a Zarr group or array; most often, the checksum of its attributes is right again."""
    changed = change_json(rng, data)
    with suppress(ValueError, AttributeError, RecursionError):
        value = json.loads(changed)
        attributes = value.get("attributes")
        if isinstance(attributes, dict) and "sha256" in attributes and rng.random() < 0.8:
            attributes["sha256"] = attributes_checksum(attributes)
            return _dumped(value)
    return changed


def _dumped(value: Any) -> bytes:
    try:
        return json.dumps(value).encode()
    except ValueError:  # a number of more than 4300 digits
        return b'{"a": 1' + b"0" * 5000 + b"}"
