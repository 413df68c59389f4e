"""Grids as xarray.Dataset, NetCDF and Zarr, read by xarray alone and by GDAL."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import each, needs, refused
from hypothesis import given
from hypothesis import strategies as st

from ogm.grid import EvidentialGrid, GridSpec
from ogm.io.grids.files import read_grid, read_placed_grid, write_grid
from ogm.io.grids.placed import PlacedGrid
from ogm.io.grids.scientific import from_xarray, to_xarray
from ogm.pose import pose
from ogm.storage.files import OgmError

needs("xarray", "netCDF4")

SPEC = GridSpec(1 / 3, (9, 5), (-1.7, 2.3))
BOTH = each("ending", [".nc", ".zarr"])


def grid() -> EvidentialGrid:
    mass = np.random.default_rng(2).dirichlet((1, 1, 1), SPEC.shape)[..., :2].astype(np.float32)
    mass[3:, 4] = 0
    return EvidentialGrid(SPEC, mass)


def opened(path: Path) -> Any:
    """Return the `xarray.Dataset` of a file."""
    import xarray

    if path.suffix == ".zarr":
        pytest.importorskip("zarr")
        return xarray.open_zarr(path, consolidated=False, chunks=None).load()
    with xarray.open_dataset(path) as dataset:
        return dataset.load()


@BOTH
def test_it_comes_back_exactly_also_through_xarray(tmp_path: Path, ending: str) -> None:
    import xarray

    path = tmp_path / f"map{ending}"
    for _ in range(2):  # the second time over the first
        write_grid(path, PlacedGrid(grid(), frame_id="odom", stamp=1.5))
    assert read_grid(path) == grid()
    again = read_placed_grid(path)
    assert (again.frame_id, again.stamp, again.crs) == ("odom", 1.5, None)
    dataset = opened(path)
    xarray.testing.assert_identical(dataset.drop_attrs(), to_xarray(grid()).drop_attrs())
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


@BOTH
def test_xarray_finds_cells_by_their_coordinates(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"map{ending}"
    write_grid(path, grid())
    dataset = opened(path)
    assert dict(dataset.sizes) == {"y": 5, "x": 9}
    for x, y in ((-1.6, 2.4), (1.2, 2.4), (-1.6, 3.9), (0.3, 3.1)):
        cell = dataset.sel(x=x, y=y, method="nearest")
        assert (cell.free, cell.occupied) == grid().at(np.array([x]), np.array([y]))[0].tolist() or np.allclose(
            (cell.free, cell.occupied), grid().at(np.array([x]), np.array([y]))[0]
        )
        assert float(cell.free + cell.occupied + cell.unknown) == pytest.approx(1)
    assert dataset.x.attrs["units"] == dataset.y.attrs["units"] == "m"
    assert dataset.attrs["Conventions"].startswith("CF-")


@BOTH
@each("turn", [pose(yaw=0.4), pose(5.0, 6.0, 7.0, yaw=-2.0), pose(1, 2, 3, pitch=0.1)])
def test_turned_and_tilted_grids_keep_their_transform(tmp_path: Path, ending: str, turn: np.ndarray) -> None:
    path = tmp_path / f"map{ending}"
    write_grid(path, PlacedGrid(grid(), turn, crs="EPSG:25832"))
    again = read_placed_grid(path)
    assert again.grid == grid()
    assert np.array_equal(again.T_frame_grid, turn)
    assert again.crs == "EPSG:25832"
    refused(f"map{ending}: the grid is (rotated|tilted)", read_grid, path, error=OgmError)


def test_a_shift_moves_the_coordinates() -> None:
    placed = from_xarray(to_xarray(PlacedGrid(grid(), pose(10.0, -20.0, -1.7))))
    assert placed.grid.spec.origin == pytest.approx((8.3, -17.7))
    assert np.array_equal(placed.T_frame_grid, pose(z=-1.7))


def test_gdal_finds_corner_system_and_values(tmp_path: Path) -> None:
    if shutil.which("gdalinfo") is None:
        pytest.skip("gdalinfo is not installed (Debian: gdal-bin)")
    path = tmp_path / "map.nc"
    write_grid(path, PlacedGrid(grid(), pose(367_000.0, 5_600_000.0), crs="EPSG:25832"))
    for name, layer in (("free", grid().free), ("occupied", grid().occupied), ("unknown", grid().unknown)):
        source = f"NETCDF:{path}:{name}"
        facts = json.loads(subprocess.check_output(["gdalinfo", "-json", source]))
        assert facts["size"] == [9, 5]
        assert facts["cornerCoordinates"]["lowerLeft"] == pytest.approx([366_998.3, 5_600_002.3], abs=1e-3)
        assert facts["cornerCoordinates"]["upperRight"] == pytest.approx([367_001.3, 5_600_002.3 + 5 / 3], abs=1e-3)
        assert "25832" in facts["coordinateSystem"]["wkt"] or "UTM zone 32N" in facts["coordinateSystem"]["wkt"]
        where = ("367000.5", "5600002.5")  # cell (6, 0)
        found = subprocess.check_output(["gdallocationinfo", "-valonly", "-geoloc", source, *where])
        assert float(found) == pytest.approx(layer[6, 0])


def test_parts_flips_and_coarser_datasets_are_grids() -> None:
    dataset = to_xarray(grid())
    part = from_xarray(dataset.isel(x=slice(2, 6), y=slice(1, 3))).grid
    assert part.spec == GridSpec(1 / 3, (4, 2), (round(-1.7 + 2 / 3, 9), round(2.3 + 1 / 3, 9)))
    assert np.array_equal(part.mass, grid().mass[2:6, 1:3])
    assert from_xarray(dataset.isel(x=slice(None, None, -1), y=slice(None, None, -1))).grid == grid()
    assert from_xarray(dataset.transpose("x", "y")).grid == grid()
    coarse = from_xarray(dataset.coarsen(x=2, y=2, boundary="trim").mean()).grid
    assert coarse.spec.resolution == pytest.approx(2 / 3)
    assert (coarse.spec.shape, coarse.spec.origin) == ((4, 2), SPEC.origin)
    assert from_xarray(dataset.isel(y=[2]).drop_attrs(deep=False)).grid.spec.shape == (9, 1)


def test_missing_values_are_unknown() -> None:
    dataset = to_xarray(grid())
    assert from_xarray(dataset.where(dataset.x > 0)).grid.mass[0].max() == 0


@given(st.integers(1, 6), st.integers(1, 6), st.floats(1e-2, 1e3), st.floats(-1e6, 1e6), st.booleans())
def test_any_grid_comes_back(nx: int, ny: int, size: float, x: float, turned: bool) -> None:
    mass = np.random.default_rng(nx * ny).dirichlet((1, 1, 1), (nx, ny))[..., :2].astype(np.float32)
    one = EvidentialGrid(GridSpec(size, (nx, ny), (x, -2.0)), mass)
    placed = PlacedGrid(one, pose(yaw=0.3) if turned else np.eye(4))
    again = from_xarray(to_xarray(placed))
    assert again.grid.spec.resolution == size
    assert again.corner == pytest.approx(placed.corner, abs=3e-9)
    assert np.array_equal(again.grid.mass, mass)


def test_what_is_no_grid_is_refused() -> None:
    good = to_xarray(grid())
    for dataset, message in (
        (good.drop_vars(["free", "occupied", "unknown"]), "must have variables of numbers over y and x, got none"),
        (good.drop_vars("x"), "must have a coordinate x"),
        (good.isel(x=[0, 1, 3]), "equal steps"),
        (good.assign_coords(x=good.x * np.nan), "finite"),
        (good.assign_coords(x=good.x * 2), "squares"),
        (good.isel(x=0), "dims"),
        (good.expand_dims("t"), "dims"),
        (good.astype(np.int8), "float"),
        (good + 0.6, "mass must be"),
        (good.isel(x=[0], y=[0]).drop_attrs(deep=False), "resolution"),
        (good.isel(x=slice(0, 0)), "shape"),
        (good.assign_attrs(T_frame_grid=[1.0, 2.0]), "4x4"),
        (good.assign_attrs(T_frame_grid="x"), "could not convert"),
        (good.assign_attrs(stamp=np.nan), "stamp must be finite"),
        (good.assign_attrs(resolution="x"), "could not convert"),
    ):
        refused(message, from_xarray, dataset, error=OgmError)


@BOTH
def test_damaged_and_foreign_files_are_refused_by_their_name(tmp_path: Path, ending: str) -> None:
    import xarray

    path = tmp_path / f"map{ending}"
    write_grid(path, grid())
    good = next(one for one in (path / "free" / "c", path) if one.exists())
    (tmp_path / "other").mkdir()
    foreign = tmp_path / "other" / f"map{ending}"
    bad = xarray.Dataset({"height": (("y", "x"), np.zeros((2, 3)))})
    bad.to_zarr(foreign, zarr_format=3, consolidated=False) if ending == ".zarr" else bad.to_netcdf(foreign)
    with pytest.raises(OgmError, match=f"map{ending}: the dataset must have a coordinate x"):
        read_grid(foreign)
    if ending == ".nc":
        good.write_bytes(good.read_bytes()[:3000])
    else:
        for chunk in good.rglob("*"):
            if chunk.is_file():
                chunk.write_bytes(b"xyz")
    refused(f"map{ending}", read_grid, path, error=OgmError)
    if ending == ".zarr":
        (path / "zarr.json").write_text("{}")
        refused(r"map\.zarr is damaged", read_grid, path, error=OgmError)


def test_a_netcdf_that_promises_more_than_a_grid_has_is_not_read(tmp_path: Path) -> None:
    import netCDF4

    with netCDF4.Dataset(tmp_path / "huge.nc", "w") as file:
        for name in "xy":
            file.createDimension(name, 10**5)
            file.createVariable(name, "f8", (name,))[:] = np.arange(10**5)
        for name in ("free", "occupied"):
            file.createVariable(name, "f4", ("y", "x"), zlib=True)
    refused(r"huge\.nc: shape .* has more than", read_grid, tmp_path / "huge.nc", error=OgmError)


def test_a_zarr_folder_with_huge_chunks_or_of_format_2_is_not_read(tmp_path: Path) -> None:
    """Filters of format 2 can unpickle; a chunk is unpacked whole."""
    zarr = pytest.importorskip("zarr")
    path = tmp_path / "map.zarr"
    write_grid(path, grid())
    facts = json.loads((path / "free" / "zarr.json").read_text())
    facts["chunk_grid"]["configuration"]["chunk_shape"] = [10**5, 10**5]
    (path / "free" / "zarr.json").write_text(json.dumps(facts))
    refused("larger than any grid", read_grid, path, error=OgmError)
    old = tmp_path / "old.zarr"
    to_xarray(grid()).to_zarr(old, zarr_format=2, consolidated=False)
    assert zarr.open_group(old, mode="r").metadata.zarr_format == 2
    refused(r"old\.zarr is damaged or no \.zarr", read_grid, old, error=OgmError)


def test_a_zarr_folder_packed_by_what_a_crafted_chunk_can_crash_is_not_read(tmp_path: Path) -> None:
    zarr = pytest.importorskip("zarr")
    path = tmp_path / "map.zarr"
    packed = {str(name): {"compressors": [zarr.codecs.BloscCodec()]} for name in ("free", "occupied")}
    to_xarray(grid()).to_zarr(path, zarr_format=3, consolidated=False, encoding=packed)
    refused(r"map\.zarr/free is packed by blosc, wanted bytes, crc32c, gzip", read_grid, path, error=OgmError)


def test_a_folder_that_is_no_grid_is_never_replaced(tmp_path: Path) -> None:
    import xarray

    pytest.importorskip("zarr")
    path = tmp_path / "data.zarr"
    xarray.Dataset({"mine": ("x", [1.0])}).to_zarr(path, zarr_format=3, consolidated=False)
    refused(r"data\.zarr exists and is no grid of ogm", write_grid, path, grid())
    assert xarray.open_zarr(path, consolidated=False).mine == 1
    path = tmp_path / "map.zarr"
    for _ in range(2):
        write_grid(path, grid())
    for note in (path / "notes.txt", path / "free" / ".hidden"):
        note.write_text("mine")
        refused(rf"map\.zarr would be replaced with .*{note.name} in it", write_grid, path, grid())
        note.unlink()
    (tmp_path / "file.zarr").write_text("x")
    refused("is no grid of ogm", write_grid, tmp_path / "file.zarr", grid())
