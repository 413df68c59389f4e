"""Export of samples in the layout of the paper's dataset (van Kempen et al. 2021), PCD and PNG, and pictures of them.

::

    input_train/0000000001.pcd    x, y, z [m], intensity 0 ... 255, float32, sensor frame
    label_train/0000000001.png    512 x 352, row 0 in front, column 0 on the left: green free, blue occupied
    input_valid/ label_valid/ input_test/ label_test/

Files are numbered from 1; the points and the label of a sample have equal numbers.
"""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from ogm import plot
from ogm.grid import GridSpec
from ogm.io.images import open_image
from ogm.plot.colours import colours
from ogm.plot.figures import font, plain
from ogm.plot.panels import dots_panel
from ogm.simulation.materials import Material as M
from ogm.simulation.mesh import Array, Bytes, Floats32
from ogm.simulation.sample import SimulatedSample
from ogm.simulation.store import Store
from ogm.state import CellState, Truth
from ogm.storage.files import FilePath, OgmError, atomic_write

PAPER_GRID = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)
FOLDERS = {"training": "train", "validation": "valid", "test": "test"}


def export(
    store: Store, path: FilePath, *, tick: Callable[[Iterable[int], str], Iterable[int]] = lambda numbers, _: numbers
) -> int:
    """Write the finished samples of a dataset in the paper's layout, except sequences, which it does not include.

    Ignored cells become unknown, because the layout has no other state.

    Parameters
    ----------
    store : Store
    path : path
        Output folder, created if missing. Existing files of the same names are replaced.
    tick : callable
        ``tick(numbers, name)`` iterates over the numbers, for instance with a progress bar.

    Returns
    -------
    int
        Number of samples written.
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
    """Write a point cloud (N, 4): x, y, z [m], and intensity [0, 1], stored as 0 to 255."""
    n = len(points)
    header = (
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 4 4\n"
        f"TYPE F F F F\nCOUNT 1 1 1 1\nWIDTH {n}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {n}\nDATA binary\n"
    )
    rows = points.astype("<f4") * np.array([1, 1, 1, 255], np.float32)
    with atomic_write(path) as file:
        file.write(header.encode("ascii") + rows.tobytes())


def write_label(path: FilePath, truth: Truth) -> None:
    """Write a truth grid as an image: green 255 free, blue 255 occupied; row 0 in front, column 0 on the left."""
    upright = truth.state[::-1, ::-1]
    image = np.zeros((*upright.shape, 3), np.uint8)
    image[..., 1] = 255 * (upright == CellState.FREE)
    image[..., 2] = 255 * (upright == CellState.OCCUPIED)
    with atomic_write(path) as file:
        Image.fromarray(image).save(file, format="PNG")


def read_label(path: FilePath, spec: GridSpec = PAPER_GRID) -> Truth:
    """Read a truth grid from an image.

    Parameters
    ----------
    path : path
        RGB image: green free, blue occupied, neither unknown. All values above 0 count; red is ignored.
    spec : GridSpec
        Area of the image.

    Raises
    ------
    FileNotFoundError
        If the file is missing.
    OgmError
        If the file is not a PNG image, is damaged, differs from `spec` in size, or has a cell both free and occupied.
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
        raise OgmError(f"{path} has {both} cells both free and occupied; a cell of a label must be only one of them")
    return Truth(spec, (free * CellState.FREE + occupied * CellState.OCCUPIED).astype(np.uint8))


MAX_TILES, COLUMNS = 24, 6  # samples of a contact sheet, in all and per row
GREY = (0.45, 0.45, 0.45)  # ignored cells
# Groups of materials in the picture of HD points, with their colours.
KINDS: dict[str, tuple[tuple[float, float, float], set[M]]] = {
    "road": ((0.45, 0.45, 0.50), {M.ASPHALT, M.WORN_ASPHALT, M.WET_ASPHALT, M.COBBLES}),
    "marking": ((1.0, 1.0, 1.0), {M.MARKING}),
    "paving": ((0.78, 0.66, 0.52), {M.PAVING, M.GRAVEL}),
    "grass, soil": ((0.55, 0.62, 0.25), {M.GRASS, M.SOIL}),
    "plants": ((0.10, 0.60, 0.20), {M.FOLIAGE, M.BARK}),
    "built": ((0.90, 0.35, 0.25), {m for m in M if M.KERB <= m < M.METAL_SHEET}),
    "metal, signs": ((1.0, 0.80, 0.10), {M.METAL_SHEET, M.METAL_POLE, M.SIGN, M.TARPAULIN}),
    "traffic": ((0.25, 0.60, 1.0), {m for m in M if M.PAINT_LIGHT <= m < M.TARPAULIN} - {M.SIGN}),
}
SUN = np.array([0.45, -0.55, 0.70]) / np.linalg.norm([0.45, -0.55, 0.70])
SKY = np.array([0.72, 0.82, 0.93])


def truth_panel(truth: Truth, title: str = "truth") -> plot.Panel:
    """Return a panel of a truth grid: states in the colours of `ogm.plot.colours`, ignored cells grey."""
    shades = np.empty((4, 3))
    order = [CellState.FREE, CellState.OCCUPIED, CellState.UNKNOWN, CellState.IGNORE]
    shades[order] = *colours().legend.values(), GREY
    legend = colours().legend | ({"ignored": GREY} if truth.ignored.any() else {})
    return plot.cells_panel(shades[truth.state], truth.spec, title, legend)


def sample_panels(sample: SimulatedSample, spec: GridSpec = PAPER_GRID) -> tuple[plot.Panel, plot.Panel]:
    """Return panels of a sample's points, coloured by height, and of its truth."""
    ground = -float(sample.T_vehicle_sensor[2, 3])
    cloud = plot.points_panel(sample.points, spec, f"{len(sample.points)} points of {sample.lidar}", ground)
    return cloud, truth_panel(sample.truth.crop(spec))


def materials_panel(points: Floats32, material: Bytes, spec: GridSpec, title: str) -> plot.Panel:
    """Return a panel of points seen from above, coloured by material.

    Parameters
    ----------
    points : (N, 3) float32
        Points in the frame of `spec` [m].
    material : (N,) uint8
        `Material` of each point.
    spec : GridSpec
    title : str
    """
    colours = np.zeros((256, 3))
    for colour, members in KINDS.values():
        colours[list(members)] = colour
    legend = {name: colour for name, (colour, _) in KINDS.items()}
    return dots_panel(points, colours[material], spec, title, legend)


def contact_sheet(path: FilePath, store: Store) -> None:
    """Draw samples, spread evenly over the finished samples of a dataset, to a .png: points and truth of each."""
    tiles: list[tuple[str, Bytes]] = []
    finished = {name: store[name].finished for name in store.counts}
    total = sum(map(len, finished.values()))
    for name, numbers in finished.items():
        share = min(len(numbers), round(MAX_TILES * len(numbers) / max(total, 1)) or 1)
        for k in np.linspace(0, len(numbers) - 1, share).round().astype(int):
            sample = store[name][int(numbers[k])]
            tiles.append((f"{sample.split} {sample.index}: {sample.lidar}", _tile(sample)))
    save_sheet(path, tiles, max(1, min(COLUMNS, len(tiles))), 13)


def _tile(sample: SimulatedSample) -> Bytes:
    """Draw a small picture of a sample: points and truth side by side, one pixel per 0.32 m."""
    cloud, truth = sample_panels(sample)
    # A pixel shows the brightest of its 4 x 4 fine cells, so that thin objects stay visible.
    blocks = cloud.image.reshape(256, 4, 176, 4, 3).swapaxes(1, 2).reshape(256, 176, 16, 3)
    brightest = blocks.sum(axis=-1).argmax(axis=-1)
    points = np.take_along_axis(blocks, brightest[..., None, None], axis=2)[:, :, 0]
    cells = truth.image.reshape(256, 2, 176, 2, 3).swapaxes(1, 2).reshape(256, 176, 4, 3)
    reddest = cells[..., 0].argmax(axis=-1)  # occupied
    labels = np.take_along_axis(cells, reddest[..., None, None], axis=2)[:, :, 0]
    return np.concatenate([points, np.full((256, 4, 3), 255, np.uint8), labels], axis=1)


class Camera(NamedTuple):
    """Camera of a rendered picture.

    Attributes
    ----------
    eye, target : (x, y, z)
        Position of the camera, and the point in the middle of the picture [m].
    width, height : int
        Size of the picture [pixel].
    field : float
        Horizontal field of view [rad].
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    width: int = 1600
    height: int = 900
    field: float = np.pi / 3

    def directions(self) -> Floats32:
        """Return the unit directions of all pixels, (height, width, 3) float32."""
        forward = np.subtract(self.target, self.eye)
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        reach = np.tan(self.field / 2)
        u = reach * np.linspace(-1, 1, self.width)
        v = reach * self.height / self.width * np.linspace(1, -1, self.height)
        rays = forward + u[None, :, None] * right + v[:, None, None] * np.cross(right, forward)
        return np.asarray((rays / np.linalg.norm(rays, axis=-1, keepdims=True)).astype(np.float32))


def save_sheet(path: FilePath, images: Sequence[tuple[str, Array]], columns: int, text: int) -> None:
    """Write titled pictures of equal width in rows to a PNG file; `text` is the size of the font [px]."""
    wide = images[0][1].shape[1] if images else 0
    gap, line = text // 2, 2 * text
    rows = [images[k : k + columns] for k in range(0, len(images), columns)]
    tops = np.cumsum([0, *(line + max(len(image) for _, image in row) for row in rows)])
    sheet = Image.new("RGB", (columns * (wide + gap) + gap, int(tops[-1]) + gap), "white")
    draw = ImageDraw.Draw(sheet)
    for k, (title, image) in enumerate(images):
        left, top = gap + k % columns * (wide + gap), int(tops[k // columns])
        draw.text((left + wide // 2, top + line // 2), plain(title), "black", font(text), anchor="mm")
        sheet.paste(Image.fromarray(np.ascontiguousarray(image)), (left, top + line))
    with atomic_write(path) as file:
        sheet.save(file, "PNG")
