"""Sizes that a LAZ 1.4 file states of its layers: lazrs allocates what they claim, so they are held against the file.

The points of formats 6 to 10 lie in chunks. A chunk holds its first point as it is, the number of its points, the size
of every layer and then the layers, in the order of the items that the file's laszip record lists. Source: LASzip,
``lasreadpoint.cpp`` and ``laszip.hpp`` (https://github.com/LASzip/LASzip).
"""

import struct

_HEADER = struct.Struct("<2x16sHH32x")  # of a variable length record: user, number, length
_ITEMS, _ITEM = 32, struct.Struct("<HHH")  # place of their number in the laszip record; type, size, version
_LAYERED = 3  # compressor
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}  # of POINT14, RGB14, RGBNIR14, WAVEPACKET14
_BYTES = 14  # BYTE14, of which every byte has a layer


def layers_fit(data: bytes, first: int, table: int) -> bool:
    """Return whether all layers end before the table of chunks; True where the points are not layered.

    Parameters
    ----------
    data : bytes
        The whole file.
    first, table : int
        Where the first chunk and the table of chunks begin.
    """
    try:
        record = _laszip(data)
        if struct.unpack_from("<H", record)[0] != _LAYERED:
            return True
        count = struct.unpack_from("<H", record, _ITEMS)[0]
        items = [_ITEM.unpack_from(record, _ITEMS + 2 + _ITEM.size * k) for k in range(count)]
        point = sum(size for _, size, _ in items)
        layers = sum(size if kind == _BYTES else _LAYERS[kind] for kind, size, _ in items)
        sizes = struct.Struct(f"<{layers}I")
        while first < table:
            first += point + 4 + sizes.size + sum(sizes.unpack_from(data, first + point + 4))
    except (struct.error, KeyError):
        return False
    return first == table


def _laszip(data: bytes) -> bytes:
    """Return the record that states how the points are packed; a KeyError if there is none."""
    at, count = struct.unpack_from("<H", data, 94)[0], struct.unpack_from("<I", data, 100)[0]
    for _ in range(count):
        user, number, size = _HEADER.unpack_from(data, at)
        at += _HEADER.size
        if number == 22204 and user.startswith(b"laszip encoded"):
            return data[at : at + size]
        at += size
    raise KeyError("laszip encoded")
