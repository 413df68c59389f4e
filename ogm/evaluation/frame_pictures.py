"""Pictures of an evaluated frame and its motion, small enough for hundreds of them in a report."""

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

MASS_STEPS = 8  # steps of a mass, so that lossless pictures stay small
MIN_GAIN = 0.85  # a lossy picture is used if it is smaller than this share of the lossless picture
SMALL = 0.02  # bytes per mass: a smaller picture is not encoded a second time
QUALITY = 35  # of a lossy picture
MAX_SIDE = 768  # [cells]; longer grids are shown in blocks
HEIGHT_STEP = 0.2  # [m] of heights with the same colour


class Shade(NamedTuple):
    """A colour of a picture and its meaning."""

    colour: tuple[int, int, int]
    description: str


def _shade(colour: tuple[float, float, float]) -> tuple[int, int, int]:
    red, green, blue = (round(255 * part) for part in colour)
    return red, green, blue


IGNORED = (82, 84, 90)


def true_states() -> dict[str, Shade]:
    """Return the colours of true states, in rising order of priority for blocks of several cells."""
    return {
        "ignored": Shade(IGNORED, "no true state; left out of every metric"),
        "unknown": Shade(_shade(colours().unknown), "not observable"),
        "free": Shade(_shade(colours().free), "free"),
        "occupied": Shade(_shade(colours().occupied), "occupied"),
    }


# Correct cells are grey, wrong cells coloured. The colours differ in lightness too, for red-green colour blindness.
ERRORS = {
    "ignored": Shade(IGNORED, "no true state"),
    "right unknown": Shade((10, 12, 16), "unknown, predicted unknown"),
    "right free": Shade((38, 50, 58), "free, predicted free"),
    "false known": Shade((96, 66, 122), "unknown, but predicted free or occupied"),
    "missed free": Shade((30, 86, 148), "free, but predicted unknown"),
    "right occupied": Shade((214, 220, 226), "occupied, predicted occupied"),
    "missed occupied": Shade((226, 112, 20), "occupied, but predicted unknown"),
    "false occupied": Shade((92, 186, 250), "free, but predicted occupied"),
    "false free": Shade((255, 236, 40), "occupied, but predicted free: the dangerous error"),
}

_RANK = np.array([1, 2, 3, 0], np.uint8)  # index in `true_states` of each `CellState`
_NAMES = (  # [true state][predicted state], both in the order of `CellState`
    ("right unknown", "false known", "false known"),
    ("missed free", "right free", "false occupied"),
    ("missed occupied", "false free", "right occupied"),
    ("ignored", "ignored", "ignored"),
)
_CLASS = np.array([[list(ERRORS).index(name) for name in row] for row in _NAMES], np.uint8)


def error_classes(truth: NDArray[np.uint8], mass: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return the error class of each cell, by its true state and its predicted state (`ogm.state.predict_state`).

    Parameters
    ----------
    truth : (nx, ny) uint8
        0 unknown, 1 free, 2 occupied, 3 ignored.
    mass : (nx, ny, 2) float array
        Masses of free and occupied.

    Returns
    -------
    (nx, ny) uint8
        Indices in `ERRORS`.

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
    """Draw one frame from above, front up: points, truth, masses and errors of every method.

    Parameters
    ----------
    points : (N, 3 or more) float array, optional
        x, y, z [m] in the frame of `spec`.
    truth : (nx, ny) uint8
        0 unknown, 1 free, 2 occupied, 3 ignored.
    masses : sequence of (nx, ny, 2) float array
        Masses of free and occupied, of each method.
    spec : GridSpec
    ground_z : float
        Height of the ground in the frame of the points [m].

    Returns
    -------
    dict of str to bytes
        WebP pictures "points" (if there are points), "truth", "mass 0", "error 0", "mass 1", ...: one pixel per cell,
        row 0 the front, column 0 the left. Grids longer than 768 cells are shown in blocks: the mean of masses,
        the class of highest priority for truth and errors.

    Raises
    ------
    ValueError
        If the shapes do not fit.
    """
    if truth.shape != spec.shape:
        raise ValueError(f"the truth has {truth.shape} cells, but the spec has {spec.shape}")
    block = max(1, -(-max(spec.shape) // MAX_SIDE))
    pictures = {} if points is None else {"points": _encode(_dots(points, spec, block, ground_z))}
    pictures["truth"] = _painted(true_states(), _RANK[truth], block, spec)
    for k, mass in enumerate(masses):
        errors = error_classes(truth, mass)
        pictures[f"mass {k}"] = _belief(_blocks(mass, block).mean(axis=(1, 3), dtype=np.float32), spec)
        pictures[f"error {k}"] = _painted(ERRORS, errors, block, spec)
    return pictures


def height_legend() -> dict[str, tuple[int, int, int]]:
    """Return the colours of points by their height above ground."""
    legend = plot.points_panel(np.zeros((0, 3), np.float32), GridSpec.centered(1.0, 1.0, 1.0), ground_z=0.0).legend
    return {height: _shade(colour) for height, colour in legend.items()}


def _dots(points: NDArray[Any], spec: GridSpec, block: int, ground_z: float) -> NDArray[np.uint8]:
    """Draw points two cells wide, so that they stay visible in small pictures."""
    nx, ny = spec.shape
    scale = block * 2  # `ogm.plot` draws two pixels along a cell
    shown = GridSpec(spec.resolution * scale, (-(-nx // scale), -(-ny // scale)), spec.origin)
    points = points.copy()
    points[:, 2] = np.rint((points[:, 2] - ground_z) / HEIGHT_STEP) * HEIGHT_STEP  # fewer colours, half the bytes
    return plot.points_panel(points, shown, ground_z=0.0, width=2).image


def _painted(shades: dict[str, Shade], classes: NDArray[np.uint8], block: int, spec: GridSpec) -> bytes:
    """Paint cells by their classes; a block shows its last class."""
    table = np.array([shade.colour for shade in shades.values()], np.float32) / 255
    return _encode(plot.cells_panel(table[_blocks(classes, block).max(axis=(1, 3))], spec, "", {}).image)


def _blocks(cells: NDArray[Any], size: int) -> NDArray[Any]:
    """Cut cells (nx, ny, ...) into blocks (nx / size, size, ny / size, size, ...); the far border is repeated."""
    (nx, ny), rest = cells.shape[:2], cells.shape[2:]
    padding = [(0, -nx % size), (0, -ny % size), *([(0, 0)] * len(rest))]
    padded = np.pad(cells, padding, mode="edge") if size > 1 else cells
    return padded.reshape(-(-nx // size), size, -(-ny // size), size, *rest)


def _belief(mass: NDArray[np.float32], spec: GridSpec) -> bytes:
    """Draw masses in the colours of `ogm.plot.colours`, lossless in steps of 1/8, or lossy if that is much smaller."""
    rough = _encode(_mixed(np.rint(mass * MASS_STEPS) / np.float32(MASS_STEPS), spec))
    if len(rough) < SMALL * mass.size:
        return rough
    smooth = _encode(_mixed(mass, spec), lossless=False, quality=QUALITY)
    return smooth if len(smooth) < MIN_GAIN * len(rough) else rough


def _mixed(mass: NDArray[np.floating], spec: GridSpec) -> NDArray[np.uint8]:
    return plot.cells_panel(colours().mix(mass), spec, "", {}).image


def _encode(image: NDArray[np.uint8], lossless: bool = True, quality: int = 50) -> bytes:
    """Return a picture as WebP; `quality` is the effort if lossless, else the quality of the picture."""
    from PIL import Image

    buffer = BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(buffer, "WEBP", method=2, lossless=lossless, quality=quality)
    return buffer.getvalue()


DOTS = 2  # pixels per cell
BLOCK = 8  # [cells] along each side of a block with one estimated arrow
MIN_MOVING, MIN_DYNAMIC = 2, 0.3  # cells of a block predicted moving, each with this mass of dynamic, for an arrow
SECONDS = 1.0  # [s] of motion shown by an arrow
ARROWS = {"true motion": (255, 255, 255), "estimated motion": (255, 196, 0)}
_DIM = 0.45  # brightness of the masses behind the arrows


def draw_motion(grid: DynamicGrid, motion: Motion) -> bytes:
    """Draw the masses of a dynamic grid, an arrow for each true moving object, and estimated arrows.

    Parameters
    ----------
    grid : DynamicGrid
    motion : Motion
        True motion on the same cells and axes.

    Returns
    -------
    bytes
        A WebP picture, row 0 the front, column 0 the left, two pixels per cell. Arrows show the motion in a second.
        Estimated arrows are means over blocks of 8 x 8 cells, of cells predicted moving with a mass of dynamic above
        0.3.
    """
    from PIL import Image, ImageDraw

    shades = colours().mix(np.stack([grid.free, grid.static], axis=-1)) * _DIM
    shades = np.clip(shades + grid.dynamic[..., None] * np.array(colours().dynamic), 0, 1).astype(np.float32)
    image = plot.cells_panel(np.rint(shades * 16) / np.float32(16), grid.spec, "", {}).image
    image = np.ascontiguousarray(image.repeat(DOTS, axis=0).repeat(DOTS, axis=1))
    picture = Image.fromarray(image)
    pen = ImageDraw.Draw(picture)
    widths = 6, 2  # [px]: a true arrow remains visible beneath a correct estimate
    for (cells, velocities), colour, width in zip(
        (_true(motion), _estimated(grid)), ARROWS.values(), widths, strict=True
    ):
        for cell, velocity in zip(cells, velocities, strict=True):
            _arrow(pen, cell, velocity / grid.spec.resolution * SECONDS, grid.spec, (colour, width))
    return _encode(np.asarray(picture))


def _true(motion: Motion) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the centres of moving objects [cells], (n, 2), and their mean velocities [m/s], (n, 2)."""
    speed = np.hypot(motion.velocity[..., 0], motion.velocity[..., 1])
    return _means(motion.box.astype(np.int64), speed > MOVING, motion.velocity, 1)


def _estimated(grid: DynamicGrid) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return centres [cells], (n, 2), and mean velocities [m/s], (n, 2), of blocks with cells predicted moving."""
    ix, iy = np.indices(grid.spec.shape)
    blocks = ix // BLOCK * (grid.spec.shape[1] // BLOCK + 1) + iy // BLOCK
    return _means(blocks, predicted_moving(grid) & (grid.dynamic > MIN_DYNAMIC), grid.velocity, MIN_MOVING)


def _means(
    groups: NDArray[np.int64], kept: NDArray[np.bool_], velocity: NDArray[np.float32], min_cells: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean cells and velocities of groups (0 and up) with at least `min_cells` cells."""
    at = np.nonzero(kept & (groups >= 0))
    group = groups[at]
    count = np.bincount(group)
    columns: list[NDArray[Any]] = [*at, velocity[at][:, 0], velocity[at][:, 1]]
    found = np.flatnonzero(count >= min_cells)
    means = np.array([np.bincount(group, column)[found] / count[found] for column in columns]).reshape(4, -1)
    return means[:2].T, means[2:].T


def _arrow(
    pen: object, cell: NDArray[np.float64], change: NDArray[np.float64], spec: GridSpec, style: tuple[object, int]
) -> None:
    """Draw an arrow of length `change` from a cell, both (2,) in cells along x and y."""
    nx, ny = spec.shape

    def dot(at: NDArray[np.float64]) -> tuple[float, float]:
        return (ny - 0.5 - at[1]) * DOTS, (nx - 0.5 - at[0]) * DOTS

    tip = cell + change
    c, s = np.cos(0.45), np.sin(0.45)
    back = -change / max(float(np.hypot(*change)), 1e-9) * 6
    turned = (np.array([c * back[0] - side * s * back[1], side * s * back[0] + c * back[1]]) for side in (1, -1))
    for start, end in ((cell, tip), *((tip, tip + side) for side in turned)):
        pen.line([dot(start), dot(end)], fill=style[0], width=style[1])  # type: ignore[attr-defined]
