"""Arrays of numbers without names: KITTI ``.bin``, nuScenes ``.pcd.bin`` and numpy ``.npy``."""

from pathlib import Path

import numpy as np

from ogm.io.formats.table import Table
from ogm.io.reading import parse_array
from ogm.storage.files import OgmError

_NAMES = ("x", "y", "z", "intensity", "ring")


def parse_kitti(data: bytes, path: Path) -> Table:
    """Read KITTI ``.bin``: x, y, z, reflectance 0 to 1 as float32."""
    return Table("KITTI", _float_rows(data, path, 4), intensity_max=1.0)


def parse_nuscenes(data: bytes, path: Path) -> Table:
    """Read nuScenes ``.pcd.bin``: x, y, z, intensity 0 to 255, ring as float32."""
    return Table("nuScenes", _float_rows(data, path, 5), intensity_max=255.0)


def _float_rows(data: bytes, path: Path, width: int) -> dict[str, np.ndarray]:
    wanted = f"rows of {width} float32: {', '.join(_NAMES[:width])}"
    if all(byte in b"\t\n\r" or 32 <= byte < 127 for byte in data[:4096]):
        raise OgmError(f"{path} is text, wanted {wanted}: name it after the format it has")
    if len(data) % (4 * width):
        raise OgmError(
            f"{path} has {len(data)} bytes, which is no multiple of {4 * width}, wanted {wanted}: it is cut "
            "short, or has another number of values (4 in KITTI's .bin, 5 in nuScenes' .pcd.bin)"
        )
    rows = np.frombuffer(data, "<f4").reshape(-1, width)
    return dict(zip(_NAMES, rows.T, strict=False))


def parse_npy(data: bytes, path: Path) -> Table:
    """Read ``.npy``: (N, 3), (N, 4) or (N, 5) points, or an organised cloud (rows, columns, 3 or more).

    The values of a point are x, y, z, intensity, ring. Of an organised cloud the first four are read; what
    follows differs too much from file to file. Pickled objects are refused.
    """

    def fits(shape: tuple[int, ...]) -> bool:
        return (len(shape) == 2 and 3 <= shape[1] <= 5) or (len(shape) == 3 and shape[2] >= 3)

    wanted = "numbers of shape (N, 3), (N, 4), (N, 5) or (rows, columns, 3 or more)"
    array = parse_array(data, path, fits, wanted)
    organised = array.ndim == 3
    flat = array.reshape(-1, array.shape[-1])[:, : 4 if organised else 5]
    columns = dict(zip(_NAMES, flat.T, strict=False))
    return Table("numpy array", columns, (array.shape[0], array.shape[1]) if organised else None)
