"""SUSTechPOINTS: boxes written by its annotation tool (Li et al. 2020).

>>> from ogm.io.sustech import read_sustech
>>> boxes = read_sustech("label/000965.json")                               # doctest: +SKIP
"""

from pathlib import Path

import numpy as np

from ogm.io.labels import BoxRow, boxes_of
from ogm.io.reading import need, numbers, read_json
from ogm.io.scan_table import Axes, rotation_to_flu
from ogm.scan import Boxes
from ogm.storage.files import FilePath

__all__ = ["read_sustech"]


def read_sustech(path: FilePath, axes: Axes = "sustech") -> Boxes:
    """Read the boxes of a scan (``label/000965.json``).

    Parameters
    ----------
    path : path
        List of objects, each with ``psr`` (position, scale, rotation), ``obj_type`` and ``obj_id``.
    axes : str, 3 str or (3, 3) array
        Axes of the scan, see `read_scan`; the default fits the tool's own example.

    Returns
    -------
    Boxes
        Upright boxes: roll and pitch are ignored.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If it is no such list, or an entry is incomplete or not numeric.
    """
    path = Path(path)
    turn = rotation_to_flu(axes)
    boxes = []
    for n, note in enumerate(read_json(path, list, "the objects of a scan, each with psr, obj_type, obj_id")):
        where = f"object {n} of {path}"
        psr = need(note, "psr", where)
        center, size, angles = (
            numbers([need(need(psr, key, where), axis, f"{key} of {where}") for axis in "xyz"], 3, f"{key} of {where}")
            for key in ("position", "scale", "rotation")
        )
        ahead = turn @ [np.cos(angles[2]), np.sin(angles[2]), 0.0]
        track = "" if note.get("obj_id") is None else str(note["obj_id"])
        yaw = np.arctan2(ahead[1], ahead[0])
        boxes.append(BoxRow(turn @ center, size, yaw, str(need(note, "obj_type", where)), track))
    return boxes_of(boxes, path)
