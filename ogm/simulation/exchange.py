"""The layout of the paper's data (van Kempen et al. 2021): point clouds as PCD, truth grids as PNG.

::

    input_train/0000000001.pcd    x, y, z [m], intensity 0 ... 255, float32, sensor frame
    label_train/0000000001.png    512 x 352, row 0 the front, column 0 the left: green free, blue occupied
    input_valid/ label_valid/ input_test/ label_test/

Files are numbered from 1 and belong together by name.
"""

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from ogm.grid import GridSpec
from ogm.io.images import open_image
from ogm.simulation.mesh import Floats32
from ogm.simulation.store import Store
from ogm.state import CellState, Truth
from ogm.storage.files import FilePath, OgmError, atomic_write

PAPER_GRID = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
FOLDERS = {"training": "train", "validation": "valid", "test": "test"}


def export(
    store: Store, path: FilePath, *, tick: Callable[[Iterable[int], str], Iterable[int]] = lambda numbers, _: numbers
) -> int:
    """Write a data set's finished samples in the paper's layout; sequences have no place in it.

    Cells that are to be ignored become unknown, as the layout knows no other.

    Parameters
    ----------
    store : Store
    path : path
        Folder to write to; made if need be. Files of the same names are replaced.
    tick : callable
        ``tick(numbers, name)`` iterates over the numbers, and may draw a progress bar.

    Returns
    -------
    int
        Samples written.
    """
    count = 0
    for split in [name for name in FOLDERS if name in store.counts]:
        samples, finished = store[split], store[split].finished.tolist()
        folders = [Path(path) / f"{kind}_{FOLDERS[split]}" for kind in ("input", "label")]
        for folder in folders if finished else ():
            folder.mkdir(parents=True, exist_ok=True)
        for i in tick(finished, split) if finished else ():
            sample = samples[i]
            write_pcd(folders[0] / f"{i + 1:010d}.pcd", sample.points)
            write_label(folders[1] / f"{i + 1:010d}.png", sample.truth.crop(PAPER_GRID))
        count += len(finished)
    return count


def write_pcd(path: FilePath, points: Floats32) -> None:
    """Write a cloud (N, 4): x, y, z [m] and intensity [0, 1], which the file counts 0 ... 255."""
    n = len(points)
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\n"
        f"TYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"
    )
    rows = points.astype("<f4") * np.array([1, 1, 1, 255], np.float32)
    with atomic_write(path) as file:
        file.write(header.encode("ascii") + rows.tobytes())


def write_label(path: FilePath, truth: Truth) -> None:
    """Write a truth grid as a picture: green 255 free, blue 255 occupied; row 0 the front, column 0 the left."""
    from PIL import Image

    upright = truth.state[::-1, ::-1]
    image = np.zeros((*upright.shape, 3), np.uint8)
    image[..., 1] = 255 * (upright == CellState.FREE)
    image[..., 2] = 255 * (upright == CellState.OCCUPIED)
    with atomic_write(path) as file:
        Image.fromarray(image).save(file, format="PNG")


def read_label(path: FilePath, spec: GridSpec = PAPER_GRID) -> Truth:
    """Read a truth grid from a picture.

    Parameters
    ----------
    path : path
        RGB: green free, blue occupied, neither unknown; any value above 0 counts, red does not.
    spec : GridSpec
        The area that it shows.

    Raises
    ------
    FileNotFoundError
        If there is none.
    OgmError
        If it is no PNG picture, is damaged, has another size than `spec`, or a cell is both free and occupied.
    """
    with open_image(path) as picture:
        if picture.mode not in ("RGB", "RGBA") or (picture.height, picture.width) != spec.shape:
            raise OgmError(
                f"{path} is {picture.mode} of {picture.height} x {picture.width}, wanted RGB of {spec.shape[0]} rows x "
                f"{spec.shape[1]} columns: green free, blue occupied"
            )
        image = np.asarray(picture)
    free, occupied = image[::-1, ::-1, 1] > 0, image[::-1, ::-1, 2] > 0
    if both := np.count_nonzero(free & occupied):
        raise OgmError(f"{path} has {both} cells both free and occupied; in a label a cell is one or neither")
    return Truth(spec, (free * CellState.FREE + occupied * CellState.OCCUPIED).astype(np.uint8))
