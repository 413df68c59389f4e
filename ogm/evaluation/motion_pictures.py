"""Pictures of motion in one evaluated frame: masses with true and estimated arrows."""

from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm import plot
from ogm.dynamic_grid import DynamicGrid
from ogm.grid import GridSpec
from ogm.metrics.motion import MOVING, predicted_moving
from ogm.plot.colours import colours
from ogm.state import Motion

DOTS = 2  # of the picture per cell
BLOCK = 8  # [cells] along each side, that share an estimated arrow
LEAST, LEAST_MASS = 2, 0.3  # cells of a block that are predicted moving with a mass of dynamic, for an arrow
SECONDS = 1.0  # of motion that an arrow shows
ARROWS = {"true motion": (255, 255, 255), "estimated motion": (255, 196, 0)}
_DIM = 0.45  # of the masses behind the arrows


def draw_motion(grid: DynamicGrid, motion: Motion) -> bytes:
    """Draw free, static and dynamic masses, an arrow for each true moving object, and estimated arrows.

    Parameters
    ----------
    grid : DynamicGrid
    motion : Motion
        On the same cells and axes.

    Returns
    -------
    bytes
        A WebP picture, row 0 the front, column 0 the left, two dots per cell. An arrow is as long as the motion in a
        second. Estimated ones are means over blocks of 8 x 8 cells, of the cells that are predicted moving
        with a mass of dynamic above 0.3.
    """
    from PIL import Image, ImageDraw

    shades = colours().mix(np.stack([grid.free, grid.static], axis=-1)) * _DIM
    shades = np.clip(shades + grid.dynamic[..., None] * np.array(colours().dynamic), 0, 1).astype(np.float32)
    image = plot.cells_panel(np.rint(shades * 16) / np.float32(16), grid.spec, "", {}).image
    image = np.ascontiguousarray(image.repeat(DOTS, axis=0).repeat(DOTS, axis=1))
    picture = Image.fromarray(image)
    pen = ImageDraw.Draw(picture)
    widths = 6, 2  # [dots]: a true arrow is seen beneath an estimated one that is right
    for (places, velocities), colour, width in zip(
        (_true(motion), _estimated(grid)), ARROWS.values(), widths, strict=True
    ):
        for place, velocity in zip(places, velocities, strict=True):
            _arrow(pen, place, velocity / grid.spec.resolution * SECONDS, grid.spec, (colour, width))
    buffer = BytesIO()
    picture.save(buffer, "WEBP", method=2, lossless=True, quality=50)
    return buffer.getvalue()


def _true(motion: Motion) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the middles of moving objects [cells], (n, 2), and their mean velocities [m/s], (n, 2)."""
    speed = np.hypot(motion.velocity[..., 0], motion.velocity[..., 1])
    return _means(motion.box.astype(np.int64), speed > MOVING, motion.velocity, 1)


def _estimated(grid: DynamicGrid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the same of blocks of cells that the grid predicts moving."""
    ix, iy = np.indices(grid.spec.shape)
    blocks = ix // BLOCK * (grid.spec.shape[1] // BLOCK + 1) + iy // BLOCK
    return _means(blocks, predicted_moving(grid) & (grid.dynamic > LEAST_MASS), grid.velocity, LEAST)


def _means(
    groups: NDArray[np.int64], kept: NDArray[np.bool_], velocity: NDArray[np.float32], least: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean cells and velocities of groups (0 and more) of at least some cells."""
    at = np.nonzero(kept & (groups >= 0))
    group = groups[at]
    count = np.bincount(group)
    columns: list[NDArray[Any]] = [*at, velocity[at][:, 0], velocity[at][:, 1]]
    found = np.flatnonzero(count >= least)
    means = np.array([np.bincount(group, one)[found] / count[found] for one in columns]).reshape(4, -1)
    return means[:2].T, means[2:].T


def _arrow(
    pen: object, cell: NDArray[np.float64], change: NDArray[np.float64], spec: GridSpec, style: tuple[object, int]
) -> None:
    """Draw an arrow from a cell to another, both (2,) in cells along x and y."""
    nx, ny = spec.shape

    def dot(at: NDArray[np.float64]) -> tuple[float, float]:
        return (ny - 0.5 - at[1]) * DOTS, (nx - 0.5 - at[0]) * DOTS

    tip = cell + change
    c, s = np.cos(0.45), np.sin(0.45)
    back = -change / max(float(np.hypot(*change)), 1e-9) * 6
    turned = (np.array([c * back[0] - side * s * back[1], side * s * back[0] + c * back[1]]) for side in (1, -1))
    for start, end in ((cell, tip), *((tip, tip + side) for side in turned)):
        pen.line([dot(start), dot(end)], fill=style[0], width=style[1])  # type: ignore[attr-defined]
