"""Feather tables (Arrow IPC files), the format of Argoverse 2, by `pyarrow`."""

from pathlib import Path

from ogm.files import OgmError
from ogm.io.formats.table import KNOWN, Table, plain, refuse_doubles
from ogm.io.reading import BYTE_LIMIT, optional

__all__ = ["parse_feather"]


def parse_feather(data: bytes, path: Path) -> Table:
    """Read a Feather table; an Argoverse 2 sweep has x, y, z, intensity, laser_number, offset_ns.

    Only columns of numbers that have a meaning here are unpacked, and only if all their rows stay within
    `BYTE_LIMIT`. A file made to do harm can still take much memory, for pyarrow believes the sizes of its
    buffers.

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
        if rows * width > BYTE_LIMIT:
            raise OgmError(
                f"{path} unpacks to {rows} rows of {width} bytes, wanted one scan of at most {BYTE_LIMIT} bytes "
                "(ogm.io.BYTE_LIMIT): split it"
            )
        table = ipc.open_file(buffer, options=ipc.IpcReadOptions(included_fields=wanted)).read_all()
        columns = {name: table[name].to_numpy() for name in table.column_names}
    except OgmError:
        raise
    except (pyarrow.ArrowException, ValueError, OSError) as error:
        raise OgmError(f"{path} is no readable Feather table: it is damaged or wrongly named ({error})") from error
    return Table("Feather", columns, fields=fields)
