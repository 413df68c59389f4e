"""Grids without a place of their own: arrays (.npy), and pictures of the paper's released code (.png)."""

from pathlib import Path

import numpy as np

from ogm.grid import EvidentialGrid, GridSpec
from ogm.io.images import open_image
from ogm.io.reading import parse_array, read_bytes
from ogm.storage.files import OgmError, atomic_write


def read_array(path: Path, area: GridSpec) -> EvidentialGrid:
    """Read masses of free and occupied, (nx, ny, 2) float, index (0, 0) behind on the right."""
    wanted = "masses of free and occupied, (nx, ny, 2) float"
    array = parse_array(read_bytes(path)[0], path, lambda shape: len(shape) == 3 and shape[-1] == 2, wanted)
    if array.dtype.kind != "f":
        raise OgmError(f"{path} must hold {wanted}, got {array.dtype} {array.shape}")
    return EvidentialGrid(_on(area, (array.shape[0], array.shape[1]), path), array.astype(np.float32))


def read_picture(path: Path, area: GridSpec) -> EvidentialGrid:
    """Read a picture: red 255 times the mass of occupied, green that of free, row 0 the front, column 0 the left."""
    with open_image(path) as picture:
        if picture.mode not in ("RGB", "RGBA"):
            raise OgmError(f"{path} must be an RGB picture, red occupied and green free, got {picture.mode}")
        spec = _on(area, (picture.height, picture.width), path)  # before it is unpacked
        green, red = picture.getchannel(1), picture.getchannel(0)
    mass = np.empty((*spec.shape, 2), np.float32)
    for state, channel in enumerate((green, red)):
        mass[..., state] = np.asarray(channel)[::-1, ::-1]
    mass /= 255
    mass /= np.maximum(mass[..., :1] + mass[..., 1:], 1)  # rounding may exceed one
    return EvidentialGrid(spec, mass)


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
