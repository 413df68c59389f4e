"""Grids as `xarray.Dataset`: NetCDF files by the CF conventions, and Zarr folders."""

import errno
import json
import math
import os
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.grid import EvidentialGrid, GridSpec, LayeredGrid
from ogm.io.grids.packing import check_packing
from ogm.io.grids.placed import PlacedGrid, nanometres
from ogm.io.messages.grids import AnyGrid, is_derived
from ogm.io.reading import optional, reason
from ogm.pose import pose
from ogm.storage.archive import UNREADABLE
from ogm.storage.files import OgmError, update_hint
from ogm.storage.limits import current_limits, too_large
from ogm.storage.whole_path import whole_path

if TYPE_CHECKING:
    from xarray import DataArray, Dataset

_TITLES = {EvidentialGrid.FORMAT: "Evidential occupancy grid", LayeredGrid.FORMAT: "Layers of a grid"}
_BANDS = {  # unit and meaning
    "free": ("1", "belief mass of free"),
    "occupied": ("1", "belief mass of occupied"),
    "unknown": ("1", "belief mass of unknown, 1 - free - occupied"),
    "static": ("1", "belief mass of occupied by something static"),
    "dynamic": ("1", "belief mass of occupied by something dynamic"),
    "velocity_x": ("m s-1", "mean velocity over ground of dynamic objects, along x of the grid"),
    "velocity_y": ("m s-1", "mean velocity over ground of dynamic objects, along y of the grid"),
    "velocity_covariance_xx": ("m2 s-2", "variance of velocity_x"),
    "velocity_covariance_xy": ("m2 s-2", "covariance of velocity_x and velocity_y"),
    "velocity_covariance_yy": ("m2 s-2", "variance of velocity_y"),
    "free_to_occupied": ("1", "greatest conflict of a free map with a scan that shows occupied"),
    "occupied_to_free": ("1", "greatest conflict of an occupied map with a scan that shows free"),
    "ground_height": ("m", "height of the ground"),
    "ground_variance": ("m2", "variance of ground_height"),
    "slope": ("rad", "slope of the ground"),
    "step": ("m", "step of the ground"),
    "roughness": ("m", "roughness of the ground"),
    "highest_obstacle": ("m", "height of the highest obstacle"),
    "clearance": ("m", "clearance below overhanging objects"),
    "traversability": ("1", "traversability"),
}
_MASSES = ("free", "occupied", "unknown", "static", "dynamic")
_CHUNK = 1024  # [cells] side of a chunk
_STRIP = 2**18  # least number of cells read at once
_SAME_STEP = 1e-6  # departure of a step from the others by rounding, in cells


def to_xarray(grid: AnyGrid | PlacedGrid) -> "Dataset":
    """Return a grid as an `xarray.Dataset` by the CF conventions.

    Parameters
    ----------
    grid : EvidentialGrid, DynamicGrid, LayeredGrid or PlacedGrid

    Returns
    -------
    xarray.Dataset
        Variables ``free``, ``occupied`` and ``unknown`` of dims (y, x), float32 in [0, 1], not copied, and all further
        layers; coordinates ``x`` and ``y`` of the cells' centres [m], increasing. Attributes ``resolution`` [m],
        ``frame_id`` and, if known, ``stamp`` [s] and ``height`` in the frame [m]. The coordinates belong to the frame.
        For a grid rotated or tilted in it, they belong to the grid, and the attribute ``T_frame_grid`` has the 16
        numbers of the transform, row by row. A `crs` is stored as the grid mapping ``spatial_ref``, or for a rotated
        grid as the attribute ``crs_wkt``.

    Raises
    ------
    ImportError
        If xarray is missing, or rasterio for a `crs`.
    """
    xarray = optional("xarray", Path("an xarray.Dataset"), "geo", "made")
    placed = PlacedGrid.of(grid)
    T = placed.T_frame_grid
    level = np.allclose(T[:3, :3], np.eye(3), rtol=0, atol=1e-9)
    cells = (placed.upright if level else placed).bands
    stated = EvidentialGrid.FORMAT if "free" in cells.layers else LayeredGrid.FORMAT
    facts: dict[str, Any] = {"Conventions": "CF-1.11", "title": _TITLES[stated], "format": stated}
    facts |= {"resolution": cells.spec.resolution, "frame_id": placed.frame_id}
    if placed.stamp is not None:
        facts["stamp"] = placed.stamp
    if not level:
        facts["T_frame_grid"] = T.ravel().tolist()
    elif T[2, 3]:
        facts["height"] = float(T[2, 3])
    of_layers, coordinates = dict[str, Any](), dict[str, Any]()
    for axis, centres in zip("yx", cells.spec.cell_centers[::-1], strict=True):
        of_axis = {"units": "m", "axis": axis.upper(), "long_name": f"{axis} of the cells' centres"}
        if level:
            of_axis["standard_name"] = f"projection_{axis}_coordinate"
        coordinates[axis] = (axis, centres.ravel(), of_axis)
    if placed.crs is not None:
        from ogm.io.grids.geotiff import check_crs

        wkt = check_crs(placed.crs, Path("a grid with a crs")).to_wkt(version="WKT2_2019")
        if level:
            coordinates["spatial_ref"] = ((), np.int32(0), {"crs_wkt": wkt})
            of_layers["grid_mapping"] = "spatial_ref"
        else:
            facts["crs_wkt"] = wkt
    layers = {name: (("y", "x"), layer.T, of_layers | _described(name)) for name, layer in cells.layers.items()}
    dataset: Dataset = xarray.Dataset(layers, coordinates, facts)
    return dataset


def _described(name: str) -> dict[str, Any]:
    """Return the attributes of a layer; the unit of foreign layers is unknown."""
    unit, text = _BANDS.get(name, ("", name.replace("_", " ")))
    masses = {"valid_min": np.float32(0), "valid_max": np.float32(1)} if name in _MASSES else {}
    return {"long_name": text} | ({"units": unit} if unit else {}) | masses


def from_xarray(dataset: "Dataset") -> PlacedGrid:
    """Return the grid of an `xarray.Dataset` made by `to_xarray`, or of a part or coarser version of it.

    Parameters
    ----------
    dataset : xarray.Dataset
        Numeric variables of dims y and x in any order: ``free`` and ``occupied``, masses in [0, 1], NaN is unknown;
        for a `DynamicGrid` all variables of `to_xarray` except unknown; all others are layers. Coordinates ``x`` and
        ``y`` of the cells' centres, with one equal step for both [m].

    Raises
    ------
    OgmError
        If a variable or coordinate is missing, has another shape, or is no mass.
    """
    if hint := update_hint(found := dataset.attrs.get("format"), *_TITLES):
        raise OgmError(f"the dataset has the format {found}, this version of ogm reads {', '.join(_TITLES)}{hint}")
    layers = _layers(dataset)
    try:
        _check_sizes(layers)
        spec, order = _spec(dataset, (int(layers.sizes["x"]), int(layers.sizes["y"])))
        read = {str(name): _values(layer)[order] for name, layer in layers.data_vars.items()}
        T = np.asarray(dataset.attrs.get("T_frame_grid", pose(z=float(dataset.attrs.get("height", 0.0)))), np.float64)
        stamp = dataset.attrs.get("stamp")
        return PlacedGrid.of_bands(
            LayeredGrid(spec, read),
            T.reshape(4, 4) if T.size == 16 else T,
            str(dataset.attrs.get("frame_id", "map"))[:256],
            None if stamp is None else float(stamp),
            _crs(dataset),
        )
    except (ValueError, TypeError, ArithmeticError) as error:
        raise error if isinstance(error, OgmError) else OgmError(str(error)) from error


def _layers(dataset: "Dataset") -> "Dataset":
    """Return the variables over y and x; raise OgmError without any, or for invalid masses."""
    names = []
    for name, layer in dataset.data_vars.items():
        fits = set(layer.dims) == {"x", "y"} and layer.dtype.kind in "fiu"
        if name in _MASSES[:2] and not (fits and layer.dtype.kind == "f"):
            raise OgmError(f"{name} must be float of dims (y, x), got {layer.dtype} of {layer.dims}")
        names += [name] if fits and not is_derived(str(name), dataset.data_vars.keys()) else []  # type: ignore[arg-type]
    if not names:
        got = ", ".join(map(str, dataset.data_vars))[:80]
        raise OgmError(f"the dataset must have variables of numbers over y and x, got {got or 'none'}")
    return dataset[names]


def _check_sizes(layers: "Dataset") -> None:
    """Refuse too many cells and too large chunks, which a file of a few bytes can state."""
    GridSpec(1.0, (int(layers.sizes["x"]), int(layers.sizes["y"])), (0.0, 0.0))
    size = sum(layer.nbytes for layer in layers.data_vars.values())
    if size > current_limits().grid:
        raise too_large("the dataset", size, "grid")
    for layer in layers.data_vars.values():
        chunks = layer.encoding.get("chunks") or layer.encoding.get("chunksizes") or ()
        if layer.dtype.itemsize * math.prod(max(int(side), 1) for side in chunks) > current_limits().grid:
            raise OgmError(f"chunks of {chunks} cells are larger than any grid: the dataset is damaged")


def _spec(dataset: "Dataset", shape: tuple[int, int]) -> tuple[GridSpec, tuple[slice, slice]]:
    """Return the spec of a dataset, and the slices that make its arrays [ix, iy] increasing."""
    stated = float(dataset.attrs.get("resolution", "nan"))
    x, y = _axis(dataset, "x", stated), _axis(dataset, "y", stated)
    resolution = x.step or y.step or stated
    if not resolution > 0:
        raise OgmError("a dataset of one cell must state its resolution [m]")
    if not math.isclose(resolution, y.step or resolution, rel_tol=_SAME_STEP):
        raise OgmError(f"cells must be squares, got steps of {x.step:g} m in x and {y.step:g} m in y")
    origin = nanometres(x.first - resolution / 2), nanometres(y.first - resolution / 2)
    order = slice(None, None, -1 if x.decreases else 1), slice(None, None, -1 if y.decreases else 1)
    return GridSpec(resolution, shape, origin), order


def _values(layer: "DataArray") -> NDArray[Any]:
    """Read a layer, (nx, ny), in strips along its first axis, as Zarr needs a multiple of the memory of its data."""
    along, across = layer.dims
    chunks = layer.encoding.get("chunks") or layer.encoding.get("chunksizes") or (1, 1)
    wanted = max(_STRIP // layer.sizes[across], 1)
    step = -(-wanted // max(int(chunks[0]), 1)) * max(int(chunks[0]), 1)
    values = np.empty((layer.sizes["x"], layer.sizes["y"]), layer.dtype)
    for start in range(0, layer.sizes[along], step):
        strip = slice(start, start + step)
        place = (strip, slice(None)) if along == "x" else (slice(None), strip)
        values[place] = layer.isel({along: strip}).transpose("x", "y").to_numpy()
    return values


class _Axis(NamedTuple):
    """Least coordinate of an axis, its step [m] (None for one cell), and whether it decreases."""

    first: float
    step: float | None
    decreases: bool


def _axis(dataset: "Dataset", axis: str, stated: float) -> _Axis:
    """Read a coordinate; its step is the stated resolution if they agree except for rounding."""
    if axis not in dataset.coords:
        raise OgmError(f"the dataset must have a coordinate {axis}, the cells' centres [m]")
    centres = np.asarray(dataset[axis].to_numpy(), np.float64)
    if not np.isfinite(centres).all():
        raise OgmError(f"{axis} must be finite, the cells' centres [m]")
    count, decreases = len(centres), bool(centres[0] > centres[-1])
    if count == 1:
        return _Axis(float(centres[0]), None, False)
    if decreases:
        centres = centres[::-1]
    step = float(centres[-1] - centres[0]) / (count - 1)
    if math.isclose(step, stated, rel_tol=_SAME_STEP):
        step = stated
    even = centres[0] + step * np.arange(count)
    if not (step > 0 and np.allclose(centres, even, rtol=0, atol=max(1e-3 * step, 1e-9 * abs(centres[0])))):
        steps = np.diff(centres)
        raise OgmError(f"{axis} must have equal steps [m], got {steps.min():g} to {steps.max():g}")
    return _Axis(float(centres[0]), step, decreases)


def _crs(dataset: "Dataset") -> str | None:
    """Return the coordinate reference system in its shortest form."""
    place = dataset.coords.get("spatial_ref")
    attributes = dataset.attrs if place is None else place.attrs
    wkt = attributes.get("crs_wkt", attributes.get("spatial_ref"))  # spatial_ref is written by GDAL
    if wkt is None:
        return None
    if find_spec("rasterio") is None:
        return str(wkt)
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    try:
        return str(CRS.from_wkt(str(wkt)).to_string())
    except CRSError:
        return None


def write_scientific(path: Path, placed: PlacedGrid) -> None:
    """Write NetCDF-4 (``.nc``) or Zarr 3 (``.zarr``)."""
    check_scientific(path)
    dataset = to_xarray(placed)
    with whole_path(path) as temporary:
        chunks = tuple(min(side, _CHUNK) for side in placed.grid.spec.shape[::-1])
        if path.suffix.lower() == ".zarr":
            checked: Any = {"compressors": [{"name": "zstd", "configuration": {"level": 0, "checksum": True}}]}
            chunked = dict.fromkeys(map(str, dataset.data_vars), checked | {"chunks": chunks})
            encoding = dict.fromkeys(map(str, dataset.variables), checked) | chunked
            dataset.to_zarr(temporary, mode="w", zarr_format=3, consolidated=False, encoding=encoding)
            return
        packed = {
            "zlib": True,
            "complevel": 1,
            "_FillValue": np.float32(np.nan),
            "chunksizes": chunks,
            "fletcher32": True,
        }
        encoding = dict.fromkeys(map(str, dataset.data_vars), packed)
        encoding |= dict.fromkeys(("x", "y"), {"_FillValue": None, "fletcher32": True})
        try:
            dataset.to_netcdf(temporary, format="NETCDF4", engine="netcdf4", encoding=encoding)
        except (RuntimeError, PermissionError) as error:  # HDF5 has no better error for a full disk
            text = getattr(error, "strerror", None) or error
            raise OSError(errno.EIO, f"{text}: check for a full disk", str(path)) from error


def read_scientific(path: Path) -> PlacedGrid:
    """Read NetCDF (``.nc``) or Zarr 3 (``.zarr``)."""
    xarray = _need(path, "read")
    try:
        options: Any = {"engine": "netcdf4"}
        if path.suffix.lower() == ".zarr":
            check_packing(path)
            options = {"engine": "zarr", "zarr_format": 3, "consolidated": False}  # filters of format 2 can unpickle
        with xarray.open_dataset(path, **options, decode_times=False, cache=False) as dataset:
            return from_xarray(dataset)
    except UNREADABLE as error:
        if isinstance(error, OgmError | PermissionError):
            raise
        raise OgmError(f"{path} is damaged or no {path.suffix} file: {reason(error, path)}") from error


def check_scientific(path: Path) -> None:
    """Raise if a package is missing, or if a foreign Zarr folder, or one with further files, would be replaced."""
    _need(path, "written")
    if path.suffix.lower() != ".zarr" or not path.exists():
        return
    try:
        ours = json.loads((path / "zarr.json").read_bytes())["attributes"]["format"] in _TITLES
    except (OSError, ValueError, KeyError, TypeError):
        ours = False
    if not ours:
        raise ValueError(f"{path} exists and is no grid of ogm; it is not replaced, give another name")
    for folder, _, names in os.walk(path):
        inside = Path(folder).relative_to(path).parts
        others = [] if inside[1:2] == ("c",) else [name for name in names if name != "zarr.json"]
        if others:
            other = Path(*inside, others[0])
            raise ValueError(f"{path} would be replaced with {other} in it, which is no part of a grid: move it away")


def _need(path: Path, verb: str) -> Any:
    """Return xarray; raise if it or the package of the format is missing."""
    optional("zarr" if path.suffix.lower() == ".zarr" else "netCDF4", path, "geo", verb)
    return optional("xarray", path, "geo", verb)
