"""Grids that other programs wrote."""

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ogm.files import OgmError
from ogm.grid import EvidentialGrid, GridSpec

__all__ = ["GRID_ENDINGS", "read_grid"]

GRID_ENDINGS = (".npz", ".npy", ".png")


def read_grid(path: str | os.PathLike[str], area: GridSpec) -> EvidentialGrid:
    """Read a grid of belief masses.

    Parameters
    ----------
    path : path
        ``.npz`` that `EvidentialGrid.save` wrote; ``.npy`` with masses of free and occupied, (nx, ny, 2) float, index
        (0, 0) behind on the right, as everywhere in `ogm`; or ``.png`` as the paper's released code exports it: red 255
        times the mass of occupied, green that of free, row 0 the front, column 0 the left.
    area : GridSpec
        Area of ``.npy`` and ``.png``, which do not hold it; their cells may be coarser or finer.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If it is damaged, of another kind, holds no masses, or cells that are no squares on that area.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in GRID_ENDINGS:
        raise OgmError(f"{path} is no grid that can be read; wanted {', '.join(GRID_ENDINGS)}")
    try:
        if ending == ".npz":
            return EvidentialGrid.load(path)
        return EvidentialGrid(*(_array(path, area) if ending == ".npy" else _picture(path, area)))
    except ValueError as error:
        message = str(error)
        raise OgmError(message if str(path) in message else f"{path}: {message}") from error


def _array(path: Path, area: GridSpec) -> tuple[GridSpec, NDArray[np.float32]]:
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)  # refuses a shape that the file does not hold
    except (ValueError, EOFError, OverflowError) as error:
        raise OgmError(f"{path} is damaged or no .npy file of numbers: {error}") from error
    if array.ndim != 3 or array.shape[-1] != 2 or array.dtype.kind != "f":
        raise OgmError(
            f"{path} must hold masses of free and occupied, (nx, ny, 2) float, got {array.dtype} {array.shape}"
        )
    return _on(area, array.shape[:2], path), array.astype(np.float32)


def _picture(path: Path, area: GridSpec) -> tuple[GridSpec, NDArray[np.float32]]:
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as picture:
            if picture.mode not in ("RGB", "RGBA"):
                raise OgmError(f"{path} must be an RGB picture, red occupied and green free, got {picture.mode}")
            spec = _on(area, (picture.height, picture.width), path)  # before it is unpacked
            pixels = np.asarray(picture.convert("RGB"))
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError) as error:
        if isinstance(error, FileNotFoundError):
            raise
        raise OgmError(f"{path} is damaged or no picture: {error}") from error
    red, green = pixels[::-1, ::-1, 0], pixels[::-1, ::-1, 1]
    mass = np.stack([green, red], axis=-1).astype(np.float32) / 255
    return spec, mass / np.maximum(mass.sum(axis=-1, keepdims=True), 1)  # rounding may exceed one


def _on(area: GridSpec, shape: tuple[int, int], path: Path) -> GridSpec:
    """Return cells of a shape that fill an area."""
    resolution = area.length / max(shape[0], 1)
    if not np.isclose(resolution * shape[1], area.width, rtol=1e-6):
        raise OgmError(
            f"{path} has {shape[0]} x {shape[1]} cells; on {area.length:g} m x {area.width:g} m they are no squares. "
            "Save it as .npz with its own spec (EvidentialGrid.save)"
        )
    return GridSpec(resolution, shape, area.origin)
