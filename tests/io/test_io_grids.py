"""Grids of other programs."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ogm.grid import EvidentialGrid, GridSpec
from ogm.io.grids import read_grid

AREA = GridSpec(0.5, (4, 6), (-1.0, -2.0))


def corner() -> np.ndarray:
    """One free cell in front on the left, one occupied behind on the right."""
    mass = np.zeros((*AREA.shape, 2), np.float32)
    mass[3, 5] = 0.8, 0.0
    mass[0, 0] = 0.2, 0.6
    return mass


def write(folder: Path, ending: str) -> Path:
    path = folder / f"grid{ending}"
    mass = corner()
    if ending == ".npz":
        EvidentialGrid(AREA, mass).save(path)
    elif ending == ".npy":
        np.save(path, mass)
    else:
        red, green = (np.round(255 * mass[::-1, ::-1, k]).astype(np.uint8) for k in (1, 0))
        Image.fromarray(np.stack([red, green, 0 * red], axis=-1)).save(path)
    return path


@pytest.mark.parametrize("ending", [".npz", ".npy", ".png"])
def test_every_format_gives_the_same_cells(tmp_path: Path, ending: str) -> None:
    grid = read_grid(write(tmp_path, ending), AREA)
    assert grid.spec == AREA
    np.testing.assert_allclose(grid.mass, corner(), atol=1 / 255)


def test_a_picture_of_coarser_cells_covers_the_same_area(tmp_path: Path) -> None:
    path = tmp_path / "coarse.png"
    Image.fromarray(np.array([[[0, 255, 0], [0, 0, 0], [0, 0, 0]], [[0, 0, 0]] * 3], np.uint8)).save(path)
    grid = read_grid(path, AREA)
    assert grid.spec == GridSpec(1.0, (2, 3), AREA.origin)
    assert grid.at(x=0.9, y=0.9).free == 1.0


def test_rounded_masses_still_sum_to_one(tmp_path: Path) -> None:
    path = tmp_path / "full.png"
    Image.fromarray(np.full((4, 6, 3), 128, np.uint8)).save(path)
    assert read_grid(path, AREA).unknown.min() >= 0


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.npy", np.zeros((4, 6)), "masses of free and occupied"),
        ("b.npy", np.zeros((4, 6, 2), np.uint8), "masses of free and occupied"),
        ("c.npy", np.full((4, 6, 2), 0.7), r"c\.npy: mass must be"),
        ("d.npy", np.full((4, 6, 2), np.nan), r"d\.npy: mass must be"),
        ("e.npy", np.zeros((4, 7, 2)), "no squares"),
        ("f.npy", b"\x93NUMPY", "damaged"),
        ("g.npy", np.array([{}]), "damaged"),
        ("h.png", b"\x89PNG\r\n\x1a\n", "damaged"),
        ("i.png", np.zeros((4, 6), np.uint8), "RGB"),
        ("j.txt", b"x", "wanted .npz"),
    ],
)
def test_what_is_no_grid_is_refused(tmp_path: Path, name: str, content: object, says: str) -> None:
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif name.endswith(".npy"):
        np.save(path, content, allow_pickle=True)
    else:
        Image.fromarray(content).save(path)
    with pytest.raises(ValueError, match=says):
        read_grid(path, AREA)


@pytest.mark.parametrize("ending", [".npz", ".npy", ".png"])
def test_a_missing_file_is_said_to_be_missing(tmp_path: Path, ending: str) -> None:
    with pytest.raises(FileNotFoundError):
        read_grid(tmp_path / f"none{ending}", AREA)
