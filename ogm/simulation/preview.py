"""Pictures of what the simulator makes: the paper's Fig. 2, a contact sheet of a data set, a view of a town."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm import plot
from ogm.files import atomic_write
from ogm.grid import GridSpec
from ogm.simulation.exchange import PAPER_GRID
from ogm.simulation.materials import Material as M
from ogm.simulation.sample import Sample
from ogm.simulation.store import Store
from ogm.state import CellState, Truth

__all__ = ["COLOURS", "Camera", "contact_sheet", "materials_panel", "sample_panels", "truth_panel"]

GREY = (0.45, 0.45, 0.45)  # cells to be ignored
Colour = tuple[float, float, float]

# What the materials look like in pictures: told apart, and about as they are.
COLOURS: dict[M, Colour] = {
    M.ASPHALT: (0.30, 0.30, 0.32),
    M.WORN_ASPHALT: (0.38, 0.38, 0.38),
    M.WET_ASPHALT: (0.18, 0.20, 0.24),
    M.COBBLES: (0.45, 0.42, 0.40),
    M.PAVING: (0.62, 0.58, 0.54),
    M.GRAVEL: (0.66, 0.61, 0.50),
    M.GRASS: (0.40, 0.55, 0.25),
    M.SOIL: (0.47, 0.37, 0.26),
    M.MARKING: (0.95, 0.95, 0.95),
    M.KERB: (0.75, 0.73, 0.70),
    M.PLASTER_LIGHT: (0.90, 0.86, 0.76),
    M.PLASTER_DARK: (0.70, 0.60, 0.50),
    M.BRICK: (0.62, 0.33, 0.26),
    M.CONCRETE: (0.66, 0.66, 0.64),
    M.STONE: (0.60, 0.57, 0.50),
    M.WOOD: (0.55, 0.40, 0.25),
    M.ROOF: (0.52, 0.25, 0.20),
    M.WINDOW: (0.25, 0.33, 0.42),
    M.METAL_SHEET: (0.62, 0.65, 0.70),
    M.METAL_POLE: (0.45, 0.47, 0.50),
    M.FOLIAGE: (0.20, 0.42, 0.16),
    M.BARK: (0.36, 0.27, 0.20),
    M.PAINT_LIGHT: (0.90, 0.90, 0.92),
    M.PAINT_MEDIUM: (0.35, 0.50, 0.75),
    M.PAINT_DARK: (0.45, 0.10, 0.12),
    M.PAINT_BLACK: (0.10, 0.10, 0.11),
    M.TYRE: (0.08, 0.08, 0.08),
    M.CAR_GLASS: (0.30, 0.38, 0.42),
    M.PLASTIC_DARK: (0.15, 0.15, 0.16),
    M.PLATE: (0.95, 0.95, 0.70),
    M.LAMP: (1.00, 0.75, 0.55),
    M.SIGN: (0.85, 0.15, 0.15),
    M.CLOTH_LIGHT: (0.80, 0.70, 0.55),
    M.CLOTH_DARK: (0.22, 0.24, 0.38),
    M.SKIN: (0.85, 0.65, 0.55),
    M.HIGH_VIS: (0.95, 0.85, 0.10),
    M.TARPAULIN: (0.30, 0.55, 0.60),
    M.OWN_VEHICLE: (0.95, 0.55, 0.10),
}
# The kinds that the picture of HD points tells apart, each by one colour.
KINDS: dict[str, tuple[Colour, frozenset[M]]] = {
    "road": ((0.45, 0.45, 0.50), frozenset({M.ASPHALT, M.WORN_ASPHALT, M.WET_ASPHALT, M.COBBLES})),
    "marking": ((1.0, 1.0, 1.0), frozenset({M.MARKING})),
    "paving": ((0.78, 0.66, 0.52), frozenset({M.PAVING, M.GRAVEL})),
    "grass, soil": ((0.55, 0.62, 0.25), frozenset({M.GRASS, M.SOIL})),
    "plants": ((0.10, 0.60, 0.20), frozenset({M.FOLIAGE, M.BARK})),
    "built": (
        (0.90, 0.35, 0.25),
        frozenset(
            {M.KERB, M.PLASTER_LIGHT, M.PLASTER_DARK, M.BRICK, M.CONCRETE, M.STONE, M.WOOD, M.ROOF, M.WINDOW}
        ),
    ),
    "metal, signs": ((1.0, 0.80, 0.10), frozenset({M.METAL_SHEET, M.METAL_POLE, M.SIGN, M.TARPAULIN})),
    "traffic": (
        (0.25, 0.60, 1.0),
        frozenset(
            {M.PAINT_LIGHT, M.PAINT_MEDIUM, M.PAINT_DARK, M.PAINT_BLACK, M.TYRE, M.CAR_GLASS, M.PLASTIC_DARK}
            | {M.PLATE, M.LAMP, M.CLOTH_LIGHT, M.CLOTH_DARK, M.SKIN, M.HIGH_VIS}
        ),
    ),
}
SUN = np.array([0.45, -0.55, 0.70]) / np.linalg.norm([0.45, -0.55, 0.70])
SKY = np.array([0.72, 0.82, 0.93])


def truth_panel(truth: Truth, title: str = "truth") -> plot.Panel:
    """Show a truth grid: green free, red occupied, black unknown, grey to be ignored."""
    colours = np.empty((4, 3))
    colours[[CellState.FREE, CellState.OCCUPIED, CellState.UNKNOWN, CellState.IGNORE]] = (
        *plot.LEGEND.values(),
        GREY,
    )
    legend = plot.LEGEND | ({"ignored": GREY} if truth.ignored.any() else {})
    return plot.cells_panel(colours[truth.state], truth.spec, title, legend)


def sample_panels(sample: Sample, spec: GridSpec = PAPER_GRID) -> tuple[plot.Panel, plot.Panel]:
    """Show a sample's points, coloured by height, and its truth."""
    ground = -float(sample.T_vehicle_sensor[2, 3])
    cloud = plot.points_panel(sample.points, spec, f"{len(sample.points)} points of {sample.lidar}", ground)
    return cloud, truth_panel(sample.truth.crop(spec))


def materials_panel(
    points: NDArray[np.float32], material: NDArray[np.uint8], spec: GridSpec, title: str
) -> plot.Panel:
    """Show points from above, coloured by what they hit.

    Parameters
    ----------
    points : (N, 3) float32
        In the frame of `spec` [m].
    material : (N,) uint8
        `Material` of each.
    spec : GridSpec
    title : str
    """
    colours = np.zeros((256, 3))
    for colour, members in KINDS.values():
        colours[list(members)] = colour
    legend = {name: colour for name, (colour, _) in KINDS.items()}
    return plot.dots_panel(points, colours[material], spec, title, legend)


def contact_sheet(path: str | os.PathLike[str], store: Store, *, most: int = 24, columns: int = 6) -> int:
    """Draw samples of a data set, points beside truth, spread evenly over what is finished.

    Parameters
    ----------
    path : path
        Ends in ``.png``.
    store : Store
    most : int
        Samples shown at most.
    columns : int
        Samples side by side.

    Returns
    -------
    int
        Samples shown.
    """
    chosen: list[Sample] = []
    finished = {name: store[name].finished for name in store.counts}
    total = sum(map(len, finished.values()))
    for name, numbers in finished.items():
        share = min(len(numbers), round(most * len(numbers) / max(total, 1)) or (1 if len(numbers) else 0))
        places = np.linspace(0, len(numbers) - 1, share).round().astype(int)
        chosen += [store[name][int(numbers[k])] for k in places]
    tiles = [_tile(sample) for sample in chosen]
    titles = [f"{one.split} {one.index}: {one.lidar}" for one in chosen]
    _sheet(Path(path), tiles, titles, columns)
    return len(chosen)


def _tile(sample: Sample) -> NDArray[np.uint8]:
    """Draw a sample small: two pictures of a pixel per cell of 0.32 m side by side."""
    cloud, truth = sample_panels(sample)
    # Of the 4 x 4 fine cells of a pixel, the brightest shows: thin things do not vanish.
    blocks = cloud.image.reshape(256, 4, 176, 4, 3).swapaxes(1, 2).reshape(256, 176, 16, 3)
    brightest = blocks.sum(axis=-1).argmax(axis=-1)
    points = np.take_along_axis(blocks, brightest[..., None, None], axis=2)[:, :, 0]
    cells = truth.image.reshape(256, 2, 176, 2, 3).swapaxes(1, 2).reshape(256, 176, 4, 3)
    reddest = cells[..., 0].argmax(axis=-1)
    labels = np.take_along_axis(cells, reddest[..., None, None], axis=2)[:, :, 0]
    return np.concatenate([points, np.full((256, 4, 3), 255, np.uint8), labels], axis=1)


def _sheet(path: Path, tiles: Sequence[NDArray[np.uint8]], titles: Sequence[str], columns: int) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = max(1, min(columns, len(tiles)))
    rows = max(1, -(-len(tiles) // columns))
    figure = Figure(figsize=(3.56 * columns, 2.75 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    for axis, tile, title in zip(
        figure.subplots(rows, columns, squeeze=False).ravel(), tiles, titles, strict=False
    ):
        axis.imshow(tile, interpolation="nearest")
        axis.set_title(title, fontsize=9, parse_math=False)
    for axis in figure.axes:
        axis.set_axis_off()
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=100)


class Camera(NamedTuple):
    """Where a picture is taken from.

    Attributes
    ----------
    eye, target : (x, y, z)
        [m]
    width, height : int
        Pixels.
    field : float
        Horizontal field of view [rad].
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    width: int = 1600
    height: int = 900
    field: float = np.pi / 3

    def directions(self) -> NDArray[np.float32]:
        """Return the unit direction of every pixel, (height, width, 3) float32."""
        forward = np.subtract(self.target, self.eye)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        reach = np.tan(self.field / 2)
        u = reach * np.linspace(-1, 1, self.width)
        v = reach * self.height / self.width * np.linspace(1, -1, self.height)
        rays = forward + u[None, :, None] * right + v[:, None, None] * np.cross(right, forward)
        return (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32)


def save_views(path: str | os.PathLike[str], views: Sequence[tuple[str, NDArray[np.uint8]]]) -> None:
    """Write pictures below each other to one PNG file, each with a title."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    shares = [image.shape[0] / image.shape[1] for _, image in views]
    figure = Figure(figsize=(14.0, 14.0 * sum(shares) + 0.4 * len(views)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(len(views), 1, squeeze=False, height_ratios=shares)[:, 0]
    for axis, (title, image) in zip(axes, views, strict=True):
        axis.imshow(image)
        axis.set_title(title, fontsize=12, parse_math=False)
        axis.set_axis_off()
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=110)
