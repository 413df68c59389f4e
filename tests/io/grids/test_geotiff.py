"""GeoTIFF, checked by GDAL's own tools."""

import json
import shutil
import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from cases import each, needs
from hypothesis import given, settings
from hypothesis import strategies as st

from ogm.grid import EvidentialGrid, GridSpec
from ogm.io.grids.files import read_grid, read_placed_grid, write_grid
from ogm.io.grids.placed import PlacedGrid
from ogm.pose import pose
from ogm.storage.files import OgmError

needs("rasterio")

SPEC = GridSpec(0.16, (700, 530), (-1.7, -28.16))


@cache
def grid() -> EvidentialGrid:
    rng = np.random.default_rng(2)
    mass = rng.dirichlet((1, 1, 1), SPEC.shape)[..., :2].astype(np.float32)
    mass[300:, 400:] = 0
    return EvidentialGrid(SPEC, mass)


def gdal(tool: str, *words: object) -> str:
    if shutil.which(tool) is None:
        pytest.skip(f"{tool} is not installed (Debian: gdal-bin)")
    done = subprocess.run([tool, *map(str, words)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_it_comes_back_exactly(tmp_path: Path) -> None:
    for name in ("map.tif", "map.TIFF"):
        write_grid(tmp_path / name, grid())
        assert read_grid(tmp_path / name) == grid()
        write_grid(tmp_path / name, grid())  # over the old one
    assert len(list(tmp_path.iterdir())) == 2


@each("yaw", [0.0, -2.5])
def test_gdal_finds_corner_size_bands_system_and_every_value(tmp_path: Path, yaw: float) -> None:
    T = pose(367_000.25, 5_600_000.5, 80.0, yaw=yaw)
    placed, path = PlacedGrid(grid(), T, "utm", 1_700_000_000.25, "EPSG:25832"), tmp_path / "map.tif"
    write_grid(path, placed)
    facts = json.loads(gdal("gdalinfo", "-json", path))
    assert facts["size"] == [700, 530]
    assert facts["metadata"]["IMAGE_STRUCTURE"]["LAYOUT"] == "COG"
    assert 'ID["EPSG",25832]' in facts["coordinateSystem"]["wkt"]
    bands = facts["bands"]
    assert [band["description"] for band in bands] == ["free", "occupied", "unknown"]
    assert [band["colorInterpretation"] for band in bands] == ["Green", "Red", "Blue"]
    assert {(band["type"], str(band["noDataValue"])) for band in bands} == {("Float32", "NaN")}
    x0, x1, y0, y1 = SPEC.extent
    for name, x, y in (("upperLeft", x0, y1), ("lowerLeft", x0, y0), ("lowerRight", x1, y0), ("upperRight", x1, y1)):
        assert facts["cornerCoordinates"][name] == pytest.approx((T @ (x, y, 0, 1))[:2], abs=2e-3)
    cells = [(0, 0), (699, 0), (0, 529), (250, 33), (299, 399), (300, 400)]
    xs, ys = SPEC.cell_centers
    for ix, iy in cells:
        x, y, *_ = T @ (xs[ix, 0], ys[0, iy], 0, 1)
        values = [float(one) for one in gdal("gdallocationinfo", "-geoloc", "-valonly", path, x, y).split()]
        free, occupied = grid().mass[ix, iy]
        assert values == pytest.approx([free, occupied, 1 - free - occupied], abs=1e-6)
    again = read_placed_grid(path)
    assert (again.crs, again.frame_id, again.stamp) == ("EPSG:25832", "utm", 1_700_000_000.25)
    assert again.corner == pytest.approx(placed.corner, abs=1e-8)
    assert again.grid.spec.resolution == SPEC.resolution
    assert np.array_equal(again.grid.mass, grid().mass)


def test_what_gdal_makes_of_it_is_read(tmp_path: Path) -> None:
    """Cut, flipped to rows from the bottom up, and resampled onto a north-up raster with nodata around."""
    import rasterio

    write_grid(tmp_path / "map.tif", PlacedGrid(grid(), crs="EPSG:25832"))
    gdal("gdal_translate", "-q", "-srcwin", 10, 20, 100, 50, tmp_path / "map.tif", tmp_path / "cut.tif")
    cut = read_grid(tmp_path / "cut.tif")
    assert cut.spec == GridSpec(0.16, (100, 50), (-0.1, round(-28.16 + 460 * 0.16, 9)))
    assert np.array_equal(cut.mass, grid().mass[10:110, 460:510])
    with rasterio.open(tmp_path / "map.tif") as old:
        profile = old.profile | {"transform": rasterio.Affine(0.16, 0, -1.7, 0, 0.16, -28.16), "compress": None}
        with rasterio.open(tmp_path / "up.tif", "w", **profile) as new:
            for band, name in enumerate(old.descriptions, 1):
                new.write(old.read(band)[::-1], band)
                new.set_band_description(band, name)
    assert read_grid(tmp_path / "up.tif") == grid()
    write_grid(tmp_path / "turned.tif", PlacedGrid(grid(), pose(yaw=0.5), crs="EPSG:25832"))
    gdal("gdalwarp", "-q", "-tr", 0.16, 0.16, tmp_path / "turned.tif", tmp_path / "warped.tif")
    warped = read_grid(tmp_path / "warped.tif")
    corner = warped.at(warped.spec.origin[0] + 0.01, warped.spec.origin[1] + 0.01)
    assert (corner.free, corner.occupied) == (0, 0)  # nodata
    x, y, *_ = pose(yaw=0.5) @ (20.0, 3.0, 0, 1)
    assert warped.at(x, y).free in grid().mass[..., 0]


@settings(max_examples=20)
@given(st.integers(1, 9), st.integers(1, 9), st.floats(1e-2, 1e3), st.floats(-1e6, 1e6), st.floats(-3.1, 3.1))
def test_any_place_comes_back(
    tmp_path_factory: pytest.TempPathFactory, nx: int, ny: int, size: float, x: float, yaw: float
) -> None:
    path = tmp_path_factory.mktemp("map") / "map.tif"
    mass = np.random.default_rng(nx * ny).dirichlet((1, 1, 1), (nx, ny))[..., :2].astype(np.float32)
    placed = PlacedGrid(EvidentialGrid(GridSpec(size, (nx, ny), (x, 2.0)), mass), pose(3.0, 4.0, yaw=yaw))
    write_grid(path, placed)
    again = read_placed_grid(path)
    assert again.grid.spec.resolution == pytest.approx(size, rel=1e-11)
    assert again.corner == pytest.approx(placed.corner, abs=3e-9)
    assert np.array_equal(again.grid.mass, mass)


@each("crs, message", [
        ("EPSG:4326", "not projected in metres"),
        ("EPSG:2263", "not projected in metres"),
        ("EPSG:99999999", "no coordinate reference system"),
        ("here", "no coordinate reference system"),
    ])  # fmt: skip
def test_a_system_that_is_not_in_metres_is_refused(tmp_path: Path, crs: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        write_grid(tmp_path / "map.tif", PlacedGrid(grid(), crs=crs))
    assert not list(tmp_path.iterdir())


def test_what_is_no_grid_is_refused(tmp_path: Path) -> None:
    import rasterio

    def write(name: str, names: tuple[str, ...], dtype: str = "float32", value: float = 0.0, **profile: object) -> None:
        facts = {"driver": "GTiff", "width": 4, "height": 3, "count": len(names), "dtype": dtype} | profile
        facts.setdefault("transform", rasterio.Affine(0.5, 0, 0, 0, -0.5, 0))
        with rasterio.open(tmp_path / name, "w", **facts) as image:
            for band, one in enumerate(names, 1):
                image.write(np.full((3, 4), value, dtype), band)
                image.set_band_description(band, one)

    def refused(message: str) -> None:
        with pytest.raises(OgmError, match=message) as caught:
            read_grid(tmp_path / "a.tif")
        assert "a.tif" in str(caught.value)

    both = ("free", "occupied")
    for message, options in (
        (r"wanted masses of free and occupied, got layers \(height\)", {"names": ("height",)}),
        ("two bands of one name", {"names": ("height", "height")}),
        ("bands of float", {"dtype": "uint8"}),
        ("mass must be", {"value": 0.7}),
        ("wanted squares", {"transform": rasterio.Affine(0.5, 0, 0, 0, -0.4, 0)}),
        ("wanted squares", {"transform": rasterio.Affine(0.5, 0.1, 0, 0, -0.5, 0)}),
        ("not projected in metres", {"crs": "EPSG:4326"}),
    ):
        write("a.tif", **{"names": both} | options)
        refused(message)
    for content in (b"II*\0", b"<VRTDataset rasterXSize='1' rasterYSize='1'></VRTDataset>"):
        (tmp_path / "a.tif").write_bytes(content)
        refused("damaged or no GeoTIFF")


def test_a_raster_without_a_place_is_refused(tmp_path: Path) -> None:
    import rasterio

    with (
        pytest.warns(rasterio.errors.NotGeoreferencedWarning),
        rasterio.open(tmp_path / "g.tif", "w", driver="GTiff", width=4, height=3, count=2, dtype="float32") as image,
    ):
        image.descriptions = ("free", "occupied")
    with pytest.raises(OgmError, match="no georeference"):
        read_grid(tmp_path / "g.tif")


def test_cut_and_huge_files_are_refused_quickly(tmp_path: Path) -> None:
    import rasterio

    write_grid(tmp_path / "map.tif", grid())
    data = (tmp_path / "map.tif").read_bytes()
    (tmp_path / "cut.tif").write_bytes(data[: len(data) // 2])
    with pytest.raises(OgmError, match="damaged or no GeoTIFF"):
        read_grid(tmp_path / "cut.tif")
    huge = {"driver": "GTiff", "width": 100_000, "height": 100_000, "count": 2, "dtype": "float32", "bigtiff": "YES"}
    place = rasterio.Affine(0.5, 0, 0, 0, -0.5, 0)
    with rasterio.open(tmp_path / "huge.tif", "w", **huge, sparse_ok=True, tiled=True, transform=place) as image:
        image.descriptions = ("free", "occupied")
    assert (tmp_path / "huge.tif").stat().st_size < 10e6
    with pytest.raises(OgmError, match=r"huge\.tif .* shape .* has more than"):
        read_grid(tmp_path / "huge.tif")
