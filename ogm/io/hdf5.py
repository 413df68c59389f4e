"""Tables of HDF5 files, read with everything checked that could lead out of the file, or fill the memory."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.io.reading import optional
from ogm.storage.files import OgmError
from ogm.storage.limits import current_limits, too_large

_DEFLATE, _SHUFFLE, _FLETCHER, _LZF = 1, 2, 3, 32000  # filters by their numbers in HDF5
_EXPANSION = 1032  # what deflate can unpack a byte to, at most; LZF less
_WAY_OUT = "write the file anew, such as by h5repack -f GZIP=4"


def read_hdf5_table(path: Path, name: str, wanted: Mapping[str, str]) -> NDArray[Any]:
    """Return some columns of a table, a one-dimensional dataset of a compound type.

    Parameters
    ----------
    path : Path
    name : str
        Of the dataset, in the root group.
    wanted : dict
        The columns by their names, with the kinds of numbers that they may be: of ``"i"``, ``"u"`` and ``"f"``.

    Returns
    -------
    (N,) structured array
        With the wanted columns alone.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If it is no HDF5 file, is damaged, has no such table, or unpacks beyond the limit `file`. Links, virtual
        datasets and external storage, which can name other files, are refused; so are filters but deflate, LZF,
        shuffle and Fletcher-32.
    ImportError
        If h5py is not installed.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}: check the name and the folder")
    h5py = optional("h5py", path)
    try:
        with h5py.File(path, "r") as file:
            if file.get(name, getclass=True, getlink=True) is not h5py.HardLink:
                raise OgmError(
                    f"{path} has no dataset {name} of its own, only {', '.join(list(file)[:9]) or 'nothing'}"
                )
            data = file[name]
            where = f"{name} of {path}"
            if not isinstance(data, h5py.Dataset) or data.ndim != 1 or data.dtype.names is None:
                raise OgmError(f"{where} must be a table, a list of rows of {', '.join(wanted)}")
            _check_columns(data.dtype, wanted, where)
            _check_storage(data, where)
            size = len(data) * sum(data.dtype[one].itemsize for one in wanted)
            if size > current_limits().file:
                raise too_large(where, size, "file")
            rows: NDArray[Any] = data.fields(list(wanted))[...]
            return rows
    except OgmError:
        raise
    except (OSError, RuntimeError, LookupError, ValueError, TypeError, ArithmeticError, AttributeError) as error:
        raise OgmError(f"{path} cannot be read by HDF5 ({error}): it is cut short, damaged, or no HDF5 file") from error


def _check_columns(dtype: np.dtype[Any], wanted: Mapping[str, str], where: str) -> None:
    """Refuse a table that lacks a column, or has one of other values."""
    names = dtype.names or ()
    if missing := [one for one in wanted if one not in names]:
        raise OgmError(f"{where} has no {', '.join(missing)}, only {', '.join(names)[:200]}")
    for one, kinds in wanted.items():
        if dtype[one].kind not in kinds or dtype[one].itemsize > 8:
            raise OgmError(f"the column {one} of {where} must be numbers (of kind {kinds!r}), got {dtype[one]}")


def _check_storage(data: Any, where: str) -> None:
    """Refuse a dataset that lies in other files, or whose chunks may unpack beyond the limit."""
    made = data.id.get_create_plist()
    if data.is_virtual or made.get_external_count():
        raise OgmError(f"{where} lies in other files, which are not opened: copy it into one file")
    if data.chunks is None:
        return
    filters = [made.get_filter(k)[0] for k in range(made.get_nfilters())]
    if not set(filters) <= {_DEFLATE, _SHUFFLE, _FLETCHER, _LZF} or len(set(filters)) < len(filters):
        raise OgmError(f"{where} is packed by the filters {filters}, known are deflate, LZF and shuffle: {_WAY_OUT}")
    most = current_limits().file
    size = math.prod(data.chunks) * data.dtype.itemsize
    if _LZF in filters:
        size = max(size, *made.get_filter_by_id(_LZF)[1][2:3])  # the memory that its decoder begins with
    if {_DEFLATE, _LZF} & set(filters):
        stored = [0]
        data.id.chunk_iter(lambda one: stored.__setitem__(0, max(stored[0], one.size)))
        if stored[0] * _EXPANSION > most:
            raise too_large(f"a chunk of {where}", max(size, stored[0] * _EXPANSION), "file")
    if size > most:
        raise too_large(f"a chunk of {where}", size, "file")
