"""Grids without a place of their own: arrays (.npy), and pictures of the paper's released code (.png)."""

from pathlib import Path
from tokenize import TokenError

import numpy as np

from ogm.files import OgmError, atomic_write
from ogm.grid import EvidentialGrid, GridSpec
from ogm.io.grids.paths import reason

__all__ = ["read_array", "read_picture", "write_picture"]


def read_array(path: Path, area: GridSpec) -> EvidentialGrid:
    """Read masses of free and occupied, (nx, ny, 2) float, index (0, 0) behind on the right."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)  # refuses a shape that the file does not hold
    except (ValueError, EOFError, OverflowError, TokenError) as error:
        raise OgmError(f"{path} is damaged or no .npy file of numbers: {error}") from error
    if array.ndim != 3 or array.shape[-1] != 2 or array.dtype.kind != "f":
        raise OgmError(
            f"{path} must hold masses of free and occupied, (nx, ny, 2) float, got {array.dtype} {array.shape}"
        )
    return EvidentialGrid(_on(area, array.shape[:2], path), array.astype(np.float32))


def read_picture(path: Path, area: GridSpec) -> EvidentialGrid:
    """Read a picture: red 255 times the mass of occupied, green that of free, row 0 the front, column 0 the left."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path, formats=("PNG",)) as picture:
            if picture.mode not in ("RGB", "RGBA"):
                raise OgmError(f"{path} must be an RGB picture, red occupied and green free, got {picture.mode}")
            spec = _on(area, (picture.height, picture.width), path)  # before it is unpacked
            pixels = np.asarray(picture.convert("RGB"))
    except (UnidentifiedImageError, Image.DecompressionBombError, OSError, SyntaxError) as error:
        if isinstance(error, FileNotFoundError):
            raise
        raise OgmError(f"{path} is damaged or no picture: {reason(error, path)}") from error
    red, green = pixels[::-1, ::-1, 0], pixels[::-1, ::-1, 1]
    mass = np.stack([green, red], axis=-1).astype(np.float32) / 255
    return EvidentialGrid(spec, mass / np.maximum(mass.sum(axis=-1, keepdims=True), 1))  # rounding may exceed one


def write_picture(path: Path, grid: EvidentialGrid) -> None:
    """Write a picture as `read_picture` reads it. Masses are rounded to 1/255; the place of the cells is not in it."""
    from PIL import Image

    pixels = np.zeros((*grid.spec.shape, 3), np.uint8)
    pixels[..., 0], pixels[..., 1] = np.rint(255 * grid.occupied), np.rint(255 * grid.free)
    with atomic_write(path) as file:
        Image.fromarray(np.ascontiguousarray(pixels[::-1, ::-1])).save(file, "PNG")


def _on(area: GridSpec, shape: tuple[int, int], path: Path) -> GridSpec:
    """Return cells of a shape that fill an area."""
    resolution = area.length / max(shape[0], 1)
    if not np.isclose(resolution * shape[1], area.width, rtol=1e-6):
        raise OgmError(
            f"{path} has {shape[0]} x {shape[1]} cells; on {area.length:g} m x {area.width:g} m they are no squares. "
            "Save it as .npz with its own spec (EvidentialGrid.save)"
        )
    return GridSpec(resolution, shape, area.origin)
