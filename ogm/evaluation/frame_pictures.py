"""Pictures of one evaluated frame, small enough that a report carries hundreds of them, also of its motion."""

from collections.abc import Sequence
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm import plot
from ogm.dynamic_grid import DynamicGrid
from ogm.grid import GridSpec
from ogm.metrics.motion import MOVING, predicted_moving
from ogm.plot.colours import colours
from ogm.state import Motion, predict_state

STEPS = 8  # of a mass, so that pictures without loss stay small
SHARPEST = 0.85  # a picture with loss is taken where it is smaller than this share of the one without
SMALL = 0.02  # bytes per mass: a smaller picture is not encoded a second time
QUALITY = 35  # of a picture with loss
LONGEST = 768  # [cells] along a side; grids that are longer are shown in blocks
LAYER = 0.2  # [m] heights that have the same colour


class Shade(NamedTuple):
    """A colour of a picture and its meaning."""

    colour: tuple[int, int, int]
    description: str


def _shade(colour: tuple[float, float, float]) -> tuple[int, int, int]:
    red, green, blue = (round(255 * part) for part in colour)
    return red, green, blue


IGNORED = (82, 84, 90)


def true_states() -> dict[str, Shade]:
    """Return the colours of true states, in rising order of priority where many cells share one dot of the screen."""
    return {
        "ignored": Shade(IGNORED, "the truth makes no statement; left out of every metric"),
        "unknown": Shade(_shade(colours().unknown), "not observable"),
        "free": Shade(_shade(colours().free), "free"),
        "occupied": Shade(_shade(colours().occupied), "occupied"),
    }


# Right cells are grey, wrong ones coloured. The colours differ in lightness too, for eyes that confuse red and green.
ERRORS = {
    "ignored": Shade(IGNORED, "the truth makes no statement"),
    "right unknown": Shade((10, 12, 16), "unknown, predicted unknown"),
    "right free": Shade((38, 50, 58), "free, predicted free"),
    "false known": Shade((96, 66, 122), "unknown, but predicted free or occupied"),
    "missed free": Shade((30, 86, 148), "free, but predicted unknown"),
    "right occupied": Shade((214, 220, 226), "occupied, predicted occupied"),
    "missed occupied": Shade((226, 112, 20), "occupied, but predicted unknown"),
    "false occupied": Shade((92, 186, 250), "free, but predicted occupied"),
    "false free": Shade((255, 236, 40), "occupied, but predicted free: the dangerous error"),
}

_RANK = np.array([1, 2, 3, 0], np.uint8)  # of a true state, in `true_states`
_NAMES = (  # [true state][predicted state], both in the order of `CellState`
    ("right unknown", "false known", "false known"),
    ("missed free", "right free", "false occupied"),
    ("missed occupied", "false free", "right occupied"),
    ("ignored", "ignored", "ignored"),
)
_CLASS = np.array([[list(ERRORS).index(name) for name in row] for row in _NAMES], np.uint8)


def error_classes(truth: NDArray[np.uint8], mass: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Compare the predicted state of every cell, see `ogm.state.predict_state`, with the truth.

    Parameters
    ----------
    truth : (nx, ny) uint8
        0 unknown, 1 free, 2 occupied, 3 ignored.
    mass : (nx, ny, 2) float array
        Masses of free and occupied.

    Returns
    -------
    (nx, ny) uint8
        Numbers of the classes in `ERRORS`.

    Raises
    ------
    ValueError
        If the shapes do not fit.
    """
    if mass.shape != (*truth.shape, 2):
        raise ValueError(f"mass must be (nx, ny, 2) on the cells of the truth, got {mass.shape} for {truth.shape}")
    return _CLASS[truth, predict_state(mass)]


def draw_frame(
    points: NDArray[np.floating] | None,
    truth: NDArray[np.uint8],
    masses: Sequence[NDArray[np.floating]],
    spec: GridSpec,
    ground_z: float = 0.0,
) -> dict[str, bytes]:
    """Draw one frame from above, the front up: points, truth, masses and errors of every method.

    Parameters
    ----------
    points : (N, 3 or more) float array, optional
        x, y, z [m] in the frame of `spec`.
    truth : (nx, ny) uint8
        0 unknown, 1 free, 2 occupied, 3 ignored.
    masses : sequence of (nx, ny, 2) float array
        Of every method: masses of free and occupied.
    spec : GridSpec
    ground_z : float
        Height of the ground in the frame of the points [m].

    Returns
    -------
    dict of str to bytes
        WebP pictures "points" (if there are points), "truth", "mass 0", "error 0", "mass 1", ...: one dot per cell,
        row 0 the front, column 0 the left. Grids longer than 768 cells are shown in blocks: the mean of masses,
        the class of highest priority of truth and errors.

    Raises
    ------
    ValueError
        If the shapes do not fit.
    """
    if truth.shape != spec.shape:
        raise ValueError(f"the truth has {truth.shape} cells, but the spec has {spec.shape}")
    block = max(1, -(-max(spec.shape) // LONGEST))
    pictures = {} if points is None else {"points": _encode(_dots(points, spec, block, ground_z))}
    pictures["truth"] = _painted(true_states(), _RANK[truth], block, spec)
    for k, mass in enumerate(masses):
        errors = error_classes(truth, mass)
        pictures[f"mass {k}"] = _belief(_blocks(mass, block).mean(axis=(1, 3), dtype=np.float32), spec)
        pictures[f"error {k}"] = _painted(ERRORS, errors, block, spec)
    return pictures


def height_legend() -> dict[str, tuple[int, int, int]]:
    """Return the colours of points by their height over the ground."""
    legend = plot.points_panel(np.zeros((0, 3), np.float32), GridSpec.centered(1.0, 1.0, 1.0), ground_z=0.0).legend
    return {height: _shade(colour) for height, colour in legend.items()}


def _dots(points: NDArray[Any], spec: GridSpec, block: int, ground_z: float) -> NDArray[np.uint8]:
    """Draw points, each as wide as two cells, so that they stay visible in small pictures."""
    nx, ny = spec.shape
    scale = block * 2  # `ogm.plot` draws two dots along a cell
    shown = GridSpec(spec.resolution * scale, (-(-nx // scale), -(-ny // scale)), spec.origin)
    points = points.copy()
    points[:, 2] = np.rint((points[:, 2] - ground_z) / LAYER) * LAYER  # fewer colours, half the bytes
    return plot.points_panel(points, shown, ground_z=0.0, width=2).image


def _painted(shades: dict[str, Shade], classes: NDArray[np.uint8], block: int, spec: GridSpec) -> bytes:
    """Paint every cell by its class; a block shows the last of its classes."""
    table = np.array([shade.colour for shade in shades.values()], np.float32) / 255
    return _encode(plot.cells_panel(table[_blocks(classes, block).max(axis=(1, 3))], spec, "", {}).image)


def _blocks(cells: NDArray[Any], size: int) -> NDArray[Any]:
    """Cut cells (nx, ny, ...) into blocks (nx / size, size, ny / size, size, ...); the far border is repeated."""
    (nx, ny), rest = cells.shape[:2], cells.shape[2:]
    padding = [(0, -nx % size), (0, -ny % size), *([(0, 0)] * len(rest))]
    padded = np.pad(cells, padding, mode="edge") if size > 1 else cells
    return padded.reshape(-(-nx // size), size, -(-ny // size), size, *rest)


def _belief(mass: NDArray[np.float32], spec: GridSpec) -> bytes:
    """Draw masses in the colours of `ogm.plot.colours`: sharp in steps of 1/8, or smooth where that is much smaller."""
    rough = _encode(_mixed(np.rint(mass * STEPS) / np.float32(STEPS), spec))
    if len(rough) < SMALL * mass.size:
        return rough
    smooth = _encode(_mixed(mass, spec), lossless=False, quality=QUALITY)
    return smooth if len(smooth) < SHARPEST * len(rough) else rough


def _mixed(mass: NDArray[np.floating], spec: GridSpec) -> NDArray[np.uint8]:
    return plot.cells_panel(colours().mix(mass), spec, "", {}).image


def _encode(image: NDArray[np.uint8], lossless: bool = True, quality: int = 50) -> bytes:
    """Write a picture as WebP: without loss (`quality` is the effort), or with the loss that `quality` allows."""
    from PIL import Image

    buffer = BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(buffer, "WEBP", method=2, lossless=lossless, quality=quality)
    return buffer.getvalue()


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
