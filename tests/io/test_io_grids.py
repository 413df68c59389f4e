"""Grids of other programs."""

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from cases import each, refused
from PIL import Image

from ogm import Scan
from ogm.dynamic_grid import DynamicGrid
from ogm.evidence import renormalize
from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid
from ogm.io.grids.files import MAP_ENDINGS, read_any_grid, read_grid, write_grid
from ogm.plot import dynamic_panel, mass_panel, save_picture
from ogm.plot.viewer import write_view
from ogm.storage.files import OgmError

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


@each("ending", [".npz", ".npy", ".png"])
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


@each("name, content, message", [
        ("a.npy", np.zeros((4, 6)), "masses of free and occupied"),
        ("b.npy", np.zeros((4, 6, 2), np.uint8), "masses of free and occupied"),
        ("c.npy", np.full((4, 6, 2), 0.7), r"c\.npy: mass must be"),
        ("d.npy", np.full((4, 6, 2), np.nan), r"d\.npy: mass must be"), ("e.npy", np.zeros((4, 7, 2)), "not square"),
        ("f.npy", b"\x93NUMPY", "no readable numpy header"), ("g.npy", np.array([{}]), "masses of free and occupied"),
        ("h.png", b"\x89PNG\r\n\x1a\n", "damaged"), ("i.png", np.zeros((4, 6), np.uint8), "RGB"),
        ("j.txt", b"x", "wanted .npz"), ("k.npy", np.zeros((0, 6, 2)), "damaged|not square"),
        ("l.npz", b"x", r"l\.npz"),
    ])  # fmt: skip
def test_what_is_no_grid_is_refused(tmp_path: Path, name: str, content: object, message: str) -> None:
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif name.endswith(".npy"):
        np.save(path, content, allow_pickle=True)
    else:
        Image.fromarray(content).save(path)
    refused(message, read_grid, path, AREA, error=OgmError)


def write_page(path: Path, grid: EvidentialGrid | DynamicGrid) -> None:
    write_view(path.with_suffix(".html"), grid)


def write_panel(path: Path, grid: EvidentialGrid | DynamicGrid) -> None:
    panel = dynamic_panel if isinstance(grid, DynamicGrid) else mass_panel
    save_picture(path.with_suffix(".png"), panel(grid))


DOORS = {ending: write_grid for ending in MAP_ENDINGS} | {".html": write_page, ".panel": write_panel}


@each("ending", DOORS)
def test_numbers_that_are_no_masses_reach_no_file(tmp_path: Path, ending: str) -> None:
    """Whether they were never checked, or changed since; a file that is there stays."""
    path, write = tmp_path / f"map{ending}", DOORS[ending]
    changed = EvidentialGrid.vacuous(AREA)
    changed.mass[1, 2] = 0.7, 0.6
    none = np.full((*AREA.shape, 2, 2), np.nan, np.float32)
    grids = [changed, *(EvidentialGrid.trusted(AREA, np.full_like(changed.mass, x)) for x in (np.nan, -0.1, 1.0))]
    grids += [
        DynamicGrid.trusted(AREA, np.full((*AREA.shape, 3), x, np.float32), none[..., 0], none) for x in (np.nan, 0.4)
    ]
    write(path, EvidentialGrid(AREA, corner()))
    before = {one: one.read_bytes() for one in tmp_path.rglob("*") if one.is_file()}
    for grid in grids:
        refused("mass must", write, path, grid)
    assert {one: one.read_bytes() for one in tmp_path.rglob("*") if one.is_file()} == before


def test_layers_are_named_where_masses_are_wanted(tmp_path: Path) -> None:
    layers = LayeredGrid(AREA, {"conflict": np.ma.masked_less(corner()[..., 1], 0.5)})
    assert np.isnan(layers["conflict"]).sum() == 23  # masked cells have no value
    write_grid(tmp_path / "a.npz", layers)
    assert read_any_grid(tmp_path / "a.npz") == layers
    no_masses = r"wanted masses of free and occupied, got layers \(conflict\): convert one by grid_from_layer"
    for name in ("b.yaml", "b.png", "b.mcap"):
        refused(no_masses, write_grid, tmp_path / name, layers)
    refused("got ndarray", write_grid, tmp_path / "c.npz", corner(), error=TypeError)
    refused(rf"a\.npz: {no_masses}", read_grid, tmp_path / "a.npz", error=OgmError)
    assert [one.name for one in tmp_path.iterdir()] == ["a.npz"]


def test_masks_are_not_dropped() -> None:
    masked = np.ma.masked_less(corner(), 0.5)
    points = np.ma.masked_less(np.ones((3, 4), np.float32), 0.5)
    times = np.ma.array([1.0, 2.0, 3.0], mask=[0, 1, 0])
    moving = np.zeros((*AREA.shape, 3), np.float32), np.zeros((*AREA.shape, 2, 2), np.float32)
    masked_moving = (moving[0], np.ma.array(moving[0][..., :2]), moving[1])
    for make, words in (
        (EvidentialGrid, (AREA, masked)), (DynamicGrid, (AREA, *masked_moving)), (Scan, (points,)),
        (Scan, (points.data, 0.0, times)), (renormalize, (masked,)),
    ):  # fmt: skip
        refused(r"must not be a masked array.*; fill it: \w+\.filled\(0\)", make, *words, error=TypeError)


@each("ending", [".npz", ".npy", ".png"])
def test_a_missing_file_is_said_to_be_missing(tmp_path: Path, ending: str) -> None:
    with pytest.raises(FileNotFoundError):
        read_grid(tmp_path / f"none{ending}", AREA)


def test_masses_that_are_none_are_refused_by_the_name_of_their_file(tmp_path: Path) -> None:
    path = write(tmp_path, ".npz")
    with np.load(path) as data:
        arrays = dict(data)
    arrays.pop("checksums")
    np.savez(path, **arrays | {"mass": np.full_like(arrays["mass"], np.nan)})
    refused(r"grid\.npz: mass must be", read_grid, path, AREA, error=OgmError)


def test_files_that_claim_more_than_they_hold_are_not_unpacked(tmp_path: Path) -> None:
    with open(tmp_path / "huge.npy", "wb") as file:
        header = {"descr": "<f4", "fortran_order": False, "shape": (10**6, 10**6, 2)}
        np.lib.format.write_array_header_1_0(file, header)
    refused(r"huge\.npy holds an array of float32 and shape", read_grid, tmp_path / "huge.npy", AREA, error=OgmError)
    wide = struct.pack(">IIBBBBB", 40_000, 60_000, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", len(wide)) + b"IHDR" + wide + struct.pack(">I", zlib.crc32(b"IHDR" + wide))
    (tmp_path / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + chunk)
    refused(r"bomb\.png is damaged or no image", read_grid, tmp_path / "bomb.png", AREA, error=OgmError)
