"""Feather tables (Arrow IPC files), the format of Argoverse 2, by `pyarrow`."""

import struct
from pathlib import Path
from typing import Any

from ogm.io.formats.arrow_sizes import unpacked_sizes
from ogm.io.formats.table import KNOWN, Table, plain, refuse_doubles
from ogm.io.reading import optional
from ogm.storage.files import OgmError
from ogm.storage.limits import current_limits, too_large


def parse_feather(data: bytes, path: Path) -> Table:
    """Read a Feather table; an Argoverse 2 sweep has x, y, z, intensity, laser_number, offset_ns.

    Only columns of numbers that have a meaning here are unpacked, and only if all their rows, and what their buffers
    claim, stay within the limit for a file.

    Parameters
    ----------
    data : bytes
        The whole file, unpacked from ``.xz`` or ``.gz``.
    path : Path
        Its name, for messages.
    """
    pyarrow, ipc, dataset = (optional(name, path) for name in ("pyarrow", "pyarrow.ipc", "pyarrow.dataset"))
    if data.startswith(b"FEA1"):
        raise OgmError(f"{path} is Feather of version 1, wanted version 2: write it anew with pyarrow")
    buffer, types = pyarrow.py_buffer(data), pyarrow.types
    try:
        schema = ipc.open_file(buffer).schema
        names = schema.names
        numeric = [i for i, kind in enumerate(schema.types) if types.is_integer(kind) or types.is_floating(kind)]
        fields = tuple(names[i] for i in numeric)
        refuse_doubles(fields, path)
        wanted = [i for i in numeric if plain(names[i]) in KNOWN]
        width = sum(schema.types[i].bit_width // 8 for i in wanted)
        if not wanted:  # to pyarrow, no fields would mean all
            return Table("Feather", {}, fields=fields)
        rows = dataset.IpcFileFormat().make_fragment(buffer).count_rows(use_threads=False)  # unpacks nothing
        if rows * width > current_limits().file:
            raise too_large(path, rows * width, "file")
        check_sizes(data, path, schema.types, wanted)
        table = ipc.open_file(buffer, options=ipc.IpcReadOptions(included_fields=wanted)).read_all()
        table.validate(full=True)  # else lengths beyond the buffers are read from whatever memory follows
        columns = {name: table[name].to_numpy() for name in table.column_names}
    except OgmError:
        raise
    except (pyarrow.ArrowException, ValueError, OSError, MemoryError, struct.error) as error:
        raise OgmError(f"{path} is no readable Feather table: it is damaged or wrongly named ({error})") from error
    return Table("Feather", columns, fields=fields)


def check_sizes(data: bytes, path: Path, types: list[Any], wanted: list[int]) -> None:
    """Refuse a table whose buffers claim more than the limit for a file, before pyarrow allocates what they claim.

    Parameters
    ----------
    data : bytes
        The whole file.
    path : Path
    types : list of pyarrow.DataType
        Of all columns.
    wanted : list of int
        Columns that will be unpacked.

    Raises
    ------
    OgmError
        If it claims more.
    ValueError, struct.error
        If it is damaged.
    """
    buffers = [_buffers(one) for one in types]
    total = 0
    for sizes in unpacked_sizes(data):
        if None in buffers or len(sizes) != sum(n for n in buffers if n is not None):  # dictionaries, nested columns
            total += sum(sizes)
            continue
        first = 0
        for column, count in enumerate(buffers):
            total += sum(sizes[first : first + (count or 0)]) if column in wanted else 0
            first += count or 0
    if total > current_limits().file:
        raise too_large(path, total, "file")


def _buffers(kind: Any) -> int | None:
    """Return how many buffers a column of a type has; None where that is not known here."""
    from pyarrow import types

    if types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind):
        return 2
    if types.is_string(kind) or types.is_large_string(kind) or types.is_binary(kind):
        return 3
    return None
