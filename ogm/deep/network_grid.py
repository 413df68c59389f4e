"""Requirements of a network on its grid, and coordinates of the sensor on the grid."""

import numpy as np
from numpy.typing import NDArray

from ogm.grid import GridSpec


def check_sides(spec: GridSpec, multiple: int) -> None:
    """Raise ValueError if a side of the grid is no multiple of a number of cells."""
    if any(n % multiple for n in spec.shape):
        nx, ny = (-(-n // multiple) * multiple for n in spec.shape)
        length, width = nx * spec.resolution, ny * spec.resolution
        raise ValueError(
            f"both sides of the network's grid must be multiples of {multiple} cells, got {spec.shape}: "
            f"use ({nx}, {ny}) cells, length {length:g} m and width {width:g} m"
        )


def check_resolution(spec: GridSpec, trained: GridSpec) -> None:
    """Raise ValueError if the resolution differs from the training's."""
    if spec.resolution != trained.resolution:
        cells = f"cells of {trained.resolution} m, got {spec.resolution} m"
        raise ValueError(f"the network was trained on {cells}: use that resolution, or train another network")


def sensor_coords(spec: GridSpec) -> NDArray[np.float32]:
    """Return polar coordinates of blocks of 4 x 4 cells, (1, 4, nx / 4, ny / 4): r / 40 m, ln(r / 10 m), cos, sin."""
    x, y = (axis.astype(np.float32) for axis in spec.cell_centers)
    x, y = x.reshape(-1, 4, 1).mean(1), y.reshape(1, -1, 4).mean(2)
    r = np.maximum(np.sqrt(x**2 + y**2), np.float32(spec.resolution))
    return np.stack([r / 40, np.log(r / 10), x / r, y / r])[None]
