"""What holds for grid files of every format."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import each, needs
from moving import street

from ogm.dynamic_grid import DynamicGrid
from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid
from ogm.io.grids.files import MAP_ENDINGS, check_grid_output, read_grid, read_placed_grid, write_grid
from ogm.io.grids.logged import GridMessage
from ogm.io.grids.map_server import MapMode
from ogm.io.grids.placed import PlacedGrid
from ogm.io.grids.scientific import from_xarray, to_xarray
from ogm.io.messages.grids import grid_from_layer, occupancy_values
from ogm.pose import pose
from ogm.state import predict_state
from ogm.storage.files import OgmError

needs("rasterio", "xarray", "netCDF4", "zarr", "rosbags", "yaml")

SPEC = GridSpec(0.1, (7, 4), (-0.35, 12.2))
EVERY = each("ending", MAP_ENDINGS)
EXACT = (".npz", ".tif", ".tiff", ".nc", ".zarr")


def grid(seed: int = 0) -> EvidentialGrid:
    mass = np.random.default_rng(seed).dirichlet((1, 1, 1), SPEC.shape)[..., :2].astype(np.float32)
    mass[0] = 0
    return EvidentialGrid(SPEC, mass)


@EVERY
def test_cells_states_and_unknown_come_back(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a map{ending.upper()}"
    write_grid(str(path), grid())
    again = read_grid(str(path), SPEC)
    assert again.spec.shape == SPEC.shape
    assert again.spec.resolution == pytest.approx(SPEC.resolution, rel=1e-12)
    assert again.spec.origin == pytest.approx(SPEC.origin, abs=1e-12)
    assert (again.mass[0] == 0).all()
    assert np.array_equal(predict_state(again.mass), predict_state(grid().mass))
    if ending in EXACT:
        assert again == grid()


@EVERY
def test_a_shift_of_the_frame_moves_the_origin(tmp_path: Path, ending: str) -> None:
    write_grid(tmp_path / f"m{ending}", PlacedGrid(grid(), pose(100.5, -7.25, 1.5)))
    area = GridSpec(0.1, (7, 4), (100.15, 4.95))
    assert read_grid(tmp_path / f"m{ending}", area).spec.origin == pytest.approx(area.origin)


@EVERY
def test_a_turn_is_kept_or_refused(tmp_path: Path, ending: str) -> None:
    placed = PlacedGrid(grid(), pose(3.0, 4.0, yaw=-2.0))
    path = tmp_path / f"m{ending}"
    if ending in (".npz", ".png"):
        with pytest.raises(ValueError, match="rotated by -114.592 degrees"):
            write_grid(path, placed)
        assert not list(tmp_path.iterdir())
        return
    write_grid(path, placed)
    assert read_placed_grid(path).corner == pytest.approx(placed.corner, abs=1e-8)
    with pytest.raises(OgmError, match=rf"m\{ending}: the grid is rotated by -114.592 degrees"):
        read_grid(path)


@EVERY
def test_an_error_while_writing_leaves_the_old_map_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str
) -> None:
    path = tmp_path / f"m{ending}"
    write_grid(path, grid())
    before, files = read_grid(path, SPEC), sorted(tmp_path.rglob("*"))

    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    if ending == ".zarr":
        import xarray

        real = xarray.Dataset.to_zarr

        def fails(*given: Any, **options: Any) -> None:
            real(*given, **options)
            full()

        monkeypatch.setattr(xarray.Dataset, "to_zarr", fails)
    else:
        monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_grid(path, grid(1))
    monkeypatch.undo()
    assert sorted(tmp_path.rglob("*")) == files
    assert read_grid(path, SPEC) == before


@EVERY
def test_missing_folders_and_wrong_kinds_of_paths(tmp_path: Path, ending: str) -> None:
    with pytest.raises(OSError, match="none"):
        write_grid(tmp_path / "none" / f"m{ending}", grid())
    with pytest.raises(FileNotFoundError, match=rf"there is no file .*m\{ending}"):
        read_grid(tmp_path / f"m{ending}", SPEC)
    path = tmp_path / f"other{ending}"
    path.write_text("x") if ending == ".zarr" else path.mkdir()
    with pytest.raises(OgmError, match=rf"other\{ending} is a f"):
        read_grid(path, SPEC)
    with pytest.raises((OSError, ValueError), match="other"):
        write_grid(path, grid())
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


@EVERY
@each("content", [b"", b"x", b"\x00" * 5000, b"\x89HDF\r\n\x1a\n" + bytes(200), b"II*\x00\xff\xff\xff\xff"])
def test_what_is_no_grid_is_refused_by_its_name(tmp_path: Path, ending: str, content: bytes) -> None:
    path = tmp_path / f"m{ending}"
    if ending == ".zarr":
        path.mkdir()
        (path / "zarr.json").write_bytes(content)
    else:
        path.write_bytes(content)
    with pytest.raises(OgmError) as caught:
        read_grid(path, SPEC)
    assert str(caught.value).count(path.name) == 1


@each("name", ["pipe.yaml", "pipe.tif", "pipe.bag"])
def test_pipes_are_not_read(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    with pytest.raises(OgmError, match="device"):
        read_grid(tmp_path / name)


def test_other_endings_and_options_of_other_formats_are_refused(tmp_path: Path) -> None:
    for path in ("m", "m.txt", "m.npy", "m.pgm"):
        with pytest.raises(ValueError, match=r"a grid is written as \.npz"):
            check_grid_output(tmp_path / path)
    with pytest.raises(ValueError, match=r"mode must be one of trinary, scale, raw, for \.yaml"):
        check_grid_output(tmp_path / "m.tif", mode="raw")
    with pytest.raises(OgmError, match="no readable grid"):
        read_grid(tmp_path / "m.txt")
    write_grid(tmp_path / "m.png", grid())
    with pytest.raises(OgmError, match="does not store its area"):
        read_grid(tmp_path / "m.png")


def test_places_that_are_none_are_refused() -> None:
    with pytest.raises(ValueError, match="T_frame_grid must be rigid"):
        PlacedGrid(grid(), np.diag([2.0, 1, 1, 1]))
    with pytest.raises(ValueError, match="stamp must be finite"):
        PlacedGrid(grid(), stamp=float("nan"))
    with pytest.raises(ValueError, match="tilted by 180 degrees"):
        _ = PlacedGrid(grid(), pose(roll=np.pi)).corner


@pytest.mark.parametrize("ending", sorted({*MAP_ENDINGS} - {".tiff", ".yml"}))
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # rasterio's log of texts that are none
def test_damage_is_an_error_of_ours_or_no_harm(tmp_path: Path, ending: str) -> None:
    """Cut files and changed bytes, most of them in the headers."""
    path, rng = tmp_path / f"m{ending}", np.random.default_rng(11)
    write_grid(path, PlacedGrid(grid(), crs="EPSG:25832"))
    files = [one for one in (path, path.with_suffix(".pgm"), *path.rglob("*")) if one.is_file()]
    whole = [one.read_bytes() for one in files]
    refused = 0
    for _ in range(50):
        k = int(rng.integers(len(files)))
        data = bytearray(whole[k])
        if rng.integers(4):
            for place in rng.integers(min(len(data), 600), size=4):
                data[place] = rng.integers(256)
        else:
            del data[int(rng.integers(len(data))) :]
        files[k].write_bytes(data)
        try:
            read_grid(path, SPEC)
        except OgmError as error:
            refused += str(path.name) in str(error)
        files[k].write_bytes(whole[k])
    assert refused > 12
    assert read_grid(path, SPEC).spec.shape == SPEC.shape


HOLDS_LAYERS = [(ending, None) for ending in EXACT] + [(".mcap", "grid-map"), (".mcap", "foxglove-grid")]


@each("ending, message", [*HOLDS_LAYERS, (".db3", "grid-map"), (".bag", "grid-map")])
def test_all_of_a_dynamic_grid_comes_back_where_a_format_has_layers(
    tmp_path: Path, ending: str, message: GridMessage | None
) -> None:
    path, dynamic = tmp_path / f"m{ending}", street()
    write_grid(path, dynamic, message=message)
    placed = read_placed_grid(path)
    assert placed.grid.spec.origin == pytest.approx(dynamic.spec.origin, abs=1e-9)
    assert replace(placed.grid, spec=dynamic.spec) == dynamic
    assert np.array_equal(read_grid(path).mass, dynamic.to_evidential().mass)
    again = tmp_path / "again.npz"
    write_grid(again, placed)
    assert np.array_equal(DynamicGrid.load(again).velocity, dynamic.velocity, equal_nan=True)


@each("ending", [".yaml", ".png", ".mcap", ".bag"])
def test_a_dynamic_grid_is_an_occupancy_grid_where_a_format_has_no_layers(tmp_path: Path, ending: str) -> None:
    dynamic = street()
    write_grid(tmp_path / f"a{ending}", dynamic)
    write_grid(tmp_path / f"b{ending}", dynamic.to_evidential())
    a, b = (read_grid(tmp_path / f"{name}{ending}", dynamic.spec) for name in "ab")
    assert a == b
    assert isinstance(read_placed_grid(tmp_path / f"a{ending}", dynamic.spec).grid, EvidentialGrid)


LAYERS = {
    "slope": np.linspace(-1, 1, 28, dtype=np.float32).reshape(SPEC.shape),
    "höhe": np.where(np.eye(*SPEC.shape), np.float32(np.nan), np.float32(7.25)),
}


@each("ending, message", [*HOLDS_LAYERS, (".db3", "grid-map"), (".bag", "grid-map")])
def test_layers_come_back_alone_and_beside_masses(tmp_path: Path, ending: str, message: GridMessage | None) -> None:
    layers = LayeredGrid(SPEC, LAYERS)
    for k, placed in enumerate((PlacedGrid(layers, stamp=12.5), PlacedGrid(grid(), stamp=12.5, layers=layers))):
        path = tmp_path / f"m{k}{ending}"
        write_grid(path, placed, message=message)
        again = read_placed_grid(path)
        assert (type(again.grid), again.frame_id, again.stamp) == (type(placed.grid), "map", 12.5)
        assert again.grid.spec.origin == pytest.approx(SPEC.origin, abs=1e-12)
        assert replace(again.bands, spec=SPEC) == placed.bands
    assert np.array_equal(read_grid(path).mass, grid().mass)
    with pytest.raises(OgmError, match=r"wanted masses of free and occupied, got layers \((slope, höhe|höhe, slope)\)"):
        read_grid(tmp_path / f"m0{ending}")


def test_layers_are_read_by_other_libraries(tmp_path: Path) -> None:
    import rasterio
    import xarray
    import zarr
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    placed, bands = PlacedGrid(grid(), layers=LayeredGrid(SPEC, LAYERS)), ["free", "occupied", "unknown", *LAYERS]
    for name in ("m.tif", "m.nc", "m.zarr", "m.db3"):
        write_grid(tmp_path / name, placed, message="grid-map" if name == "m.db3" else None)
    with rasterio.open(tmp_path / "m.tif") as image:
        assert list(image.descriptions) == bands
        found = {name: image.read(k)[::-1].T for k, name in enumerate(bands, start=1)}
    with xarray.open_dataset(tmp_path / "m.nc") as dataset:
        assert dataset["slope"].units == "rad"
        assert "units" not in dataset["höhe"].attrs
        by_xarray = {name: dataset[name].transpose("x", "y").to_numpy() for name in bands}
    group = zarr.open_group(tmp_path / "m.zarr", mode="r")
    by_zarr = {name: group[name][:].T for name in bands}
    with AnyReader([tmp_path / "m.db3"], default_typestore=get_typestore(Stores.LATEST)) as reader:
        ((connection, _, raw),) = reader.messages()
        grid_map = reader.deserialize(raw, connection.msgtype)
    assert grid_map.basic_layers == bands[:2]
    columns = [one.data.reshape(SPEC.shape, order="F")[::-1, ::-1] for one in grid_map.data]
    for read in (found, by_xarray, by_zarr, dict(zip(grid_map.layers, columns, strict=True))):
        for name, band in placed.bands.layers.items():
            np.testing.assert_array_equal(read[name], band, err_msg=name)


def test_bands_of_others_are_layers(tmp_path: Path) -> None:
    import rasterio

    profile = {"driver": "GTiff", "width": 4, "height": 3, "count": 1, "dtype": "int16", "nodata": -1}
    heights = np.arange(-1, 11, dtype=np.int16).reshape(3, 4)
    with rasterio.open(tmp_path / "m.tif", "w", transform=rasterio.Affine(2, 0, 5, 0, -2, 6), **profile) as image:
        image.write(heights, 1)
    layers = read_placed_grid(tmp_path / "m.tif").grid
    assert layers.spec == GridSpec(2.0, (4, 3), (5.0, 0.0))
    np.testing.assert_array_equal(layers["band1"], np.where(heights < 0, np.nan, heights)[::-1].T)


@each("mode", ["scale", "raw"])
def test_a_layer_by_choice_is_a_map_of_map_server(tmp_path: Path, mode: MapMode) -> None:
    layers = LayeredGrid(SPEC, {"slope": LAYERS["slope"], "cost": np.round(50 * LAYERS["slope"] + 50)})
    layers["cost"][3] = np.nan
    write_grid(tmp_path / "m.yaml", grid_from_layer(layers, "cost"), mode=mode)
    values = occupancy_values(read_grid(tmp_path / "m.yaml"))
    np.testing.assert_array_equal(values, np.where(np.isnan(layers["cost"]), -1, layers["cost"]))
    flat = grid_from_layer(layers, "slope", (0.5, -0.5))  # of free and of occupied: the steepest downwards
    np.testing.assert_allclose(flat.occupied, np.clip(0.5 - layers["slope"], 0, 1), atol=1e-6)
    with pytest.raises(ValueError, match="there is no layer 'step', only slope, cost"):
        grid_from_layer(layers, "step")
    with pytest.raises(ValueError, match="two different numbers"):
        grid_from_layer(layers, "cost", (1, 1))


def test_layers_of_other_cells_or_of_the_grids_names_are_refused() -> None:
    with pytest.raises(ValueError, match="layers must have the cells of the grid"):
        PlacedGrid(grid(), layers=LayeredGrid(SPEC.refined(2), {}))
    with pytest.raises(ValueError, match="'unknown' is the grid's own"):
        PlacedGrid(grid(), layers=LayeredGrid(SPEC, {"unknown": grid().unknown}))


def test_velocities_of_a_turned_grid_stay_along_its_axes(tmp_path: Path) -> None:
    turned = PlacedGrid(street(), pose(3.0, 4.0, yaw=-2.0))
    for ending in (".tif", ".nc", ".zarr"):
        write_grid(tmp_path / f"m{ending}", turned)
        placed = read_placed_grid(tmp_path / f"m{ending}")
        assert placed.corner == pytest.approx(turned.corner, abs=1e-8)
        assert np.array_equal(placed.grid.velocity, turned.grid.velocity, equal_nan=True)


def test_a_grid_that_lacks_a_layer_is_read_as_masses(tmp_path: Path) -> None:
    dataset = to_xarray(street())
    assert isinstance(from_xarray(dataset).grid, DynamicGrid)
    without = from_xarray(dataset.drop_vars("velocity_covariance_xy")).grid
    assert without == street().to_evidential()
    flipped = from_xarray(dataset.isel(x=slice(None, None, -1)).transpose("x", "y")).grid
    assert flipped == street()
    dataset["dynamic"].values[20, 20] = 0.9
    with pytest.raises(OgmError, match="mass"):
        from_xarray(dataset)


def test_layers_of_a_dynamic_grid_have_units() -> None:
    dataset = to_xarray(street())
    assert dataset["velocity_x"].attrs["units"] == "m s-1"
    assert dataset["velocity_covariance_xy"].attrs["units"] == "m2 s-2"
    assert dataset["dynamic"].attrs["valid_max"] == 1
    assert "valid_max" not in dataset["velocity_x"].attrs
