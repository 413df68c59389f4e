"""Files of radars: nuScenes' detections."""

import os

import numpy as np

from ogm.io.formats.pcd import parse_pcd
from ogm.io.formats.table import Table
from ogm.io.reading import read_bytes
from ogm.io.scan_table import scan_from_table
from ogm.scan import Scan
from ogm.storage.files import OgmError

__all__ = ["read_nuscenes_radar"]

_WANTED = ("x", "y", "z", "rcs", "vx", "vy", "dyn_prop", "ambig_state", "invalid_state")
_VALID, _UNAMBIGUOUS, _STATES = 0, 3, 7  # what nuScenes' devkit lets through by default; dyn_prop below 7


def read_nuscenes_radar(path: str | os.PathLike[str], *, unfiltered: bool = False) -> Scan:
    """Read the detections of one radar sweep of nuScenes, a Continental ARS408.

    The layout is that of nuScenes' documentation and devkit; it was tested on files made by it, as no recorded file may
    be shipped.

    Parameters
    ----------
    path : path
        A ``.pcd`` with the 18 fields of nuScenes.
    unfiltered : bool
        Keep all detections, also those that nuScenes' devkit leaves out by default: invalid ones (``invalid_state`` not
        0), ambiguous ones (``ambig_state`` not 3), and those whose ``dyn_prop`` is 7.

    Returns
    -------
    Scan
        In the sensor's frame, x ahead. `Scan.doppler` is the radial part of (vx, vy), against the sensor; `Scan.rcs` is
        in dBsm. z is 0, for the sensor measures no elevation.

    Raises
    ------
    OgmError
        If the file is damaged, or has other fields.
    FileNotFoundError
        If there is no such file.
    """
    data, where = read_bytes(path)
    table = parse_pcd(data, where)
    if missing := [name for name in _WANTED if name not in table.columns]:
        raise OgmError(f"{where} has no {', '.join(missing)}: it is no radar file of nuScenes")
    columns = {name: np.asarray(table.columns[name], np.float64) for name in _WANTED}
    flat = np.maximum(np.hypot(columns["x"], columns["y"]), 1e-6)
    doppler = (columns["x"] * columns["vx"] + columns["y"] * columns["vy"]) / flat
    keep = np.ones(len(flat), np.bool_)
    if not unfiltered:
        keep = (columns["invalid_state"] == _VALID) & (columns["ambig_state"] == _UNAMBIGUOUS)
        keep &= columns["dyn_prop"] < _STATES
    chosen = {name: columns[name][keep] for name in ("x", "y", "z", "rcs")} | {"doppler": doppler[keep]}
    return scan_from_table(Table("nuScenes radar", chosen, fields=tuple(table.columns)), where)[0]
