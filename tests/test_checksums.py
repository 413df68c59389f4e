"""Flipped bits in maps, and arrays that were removed or exchanged: an `OgmError` names the file, or nothing changed."""

import hashlib
import zipfile
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from cases import refused
from damage import check_flips
from moving import street

from ogm import DynamicGrid, EvidentialGrid, GridSpec, LayeredGrid, OgmError
from ogm.io import GridLog, PlacedGrid, read_placed_grid, write_grid
from ogm.pose import pose

SPEC = GridSpec(0.5, (6, 5), (-1.5, 2.0))
MASS = np.random.default_rng(0).dirichlet([1, 1, 1], SPEC.shape)[..., :2].astype(np.float32)
GRID = EvidentialGrid(SPEC, MASS)


def test_flipped_bits_of_a_grid_are_found(tmp_path: Path) -> None:
    layers = LayeredGrid(SPEC, {"height": MASS[..., 0], "": MASS[..., 1]})
    for number, (grid, most) in enumerate(((GRID, 600), (layers, 150), (street(), 150))):
        path = tmp_path / f"{number}.npz"
        grid.save(path)
        found = check_flips(path, partial(type(grid).load, path), most)
        assert found["refused"] > found["harmless"], grid


def members(path: Path, *, without: str = "", instead: dict[str, Path] | None = None) -> None:
    """Write an archive anew, without a member, or with members of other archives: each has the CRC-32 it should."""
    with zipfile.ZipFile(path) as archive:
        content = {name: archive.read(name) for name in archive.namelist() if name != f"{without}.npy"}
    for name, other in (instead or {}).items():
        with zipfile.ZipFile(other) as archive:
            content[f"{name}.npy"] = archive.read(f"{name}.npy")
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in content.items():
            archive.writestr(name, data)


def test_removed_and_exchanged_arrays_of_a_grid_are_named(tmp_path: Path) -> None:
    path, other = tmp_path / "grid.npz", tmp_path / "other.npz"
    EvidentialGrid(SPEC, MASS[::-1]).save(other)
    for name in ("states", "axes", "resolution", "origin", "mass"):
        GRID.save(path)
        members(path, without=name)
        refused(rf"grid\.npz: its array {name} is missing", EvidentialGrid.load, path, error=OgmError)
    GRID.save(path)
    members(path, instead={"mass": other})
    refused(r"grid\.npz: its array mass is damaged", EvidentialGrid.load, path, error=OgmError)
    members(path, instead={"mass": other, "checksums": other})
    assert EvidentialGrid.load(path) == EvidentialGrid.load(other)
    members(path, without="checksums")  # of an earlier version
    assert EvidentialGrid.load(path) == EvidentialGrid.load(other)


def test_the_checksum_of_an_array_is_that_of_its_file(tmp_path: Path) -> None:
    """What ``unzip -p grid.npz mass.npy | sha256sum`` prints."""
    street().save(tmp_path / "grid.npz")
    with np.load(tmp_path / "grid.npz", allow_pickle=False) as data, zipfile.ZipFile(tmp_path / "grid.npz") as archive:
        sums = dict(data["checksums"].tolist())
        assert sums.keys() == {*data.files} - {"checksums"}
        assert all(hashlib.sha256(archive.read(f"{name}.npy")).hexdigest() == one for name, one in sums.items())
    assert DynamicGrid.load(tmp_path / "grid.npz") == street()


@pytest.mark.parametrize("name", ["map.nc", "map.zarr", "map.mcap"])
def test_flipped_bits_of_other_maps_are_found(tmp_path: Path, name: str) -> None:
    """Attributes, such as the stamp, have no checksum in NetCDF and Zarr; masses and coordinates do."""
    packages = {".nc": ("xarray", "netCDF4"), ".zarr": ("xarray", "zarr"), ".mcap": ("rosbags", "mcap")}
    path = tmp_path / name
    for package in packages[path.suffix]:
        pytest.importorskip(package)
    if name == "map.mcap":
        with GridLog(path, "grid-map") as log:
            log.write(PlacedGrid(GRID, pose(1.0, 2.0), stamp=1.0))
    else:
        write_grid(path, PlacedGrid(GRID, pose(1.0, 2.0)))
    found = Counter[str]()
    for file in sorted(one for one in (path, *path.rglob("*")) if one.is_file()):
        found += check_flips(file, lambda: read_placed_grid(path).upright, 150 if path.is_file() else 15, name)
    assert found["refused"] > 5
