"""Grid files of all formats, by the ending of their names; plain arrays and pictures, which hold no area."""

import warnings
from pathlib import Path
from typing import get_args

import numpy as np

from ogm.grid import EvidentialGrid, GridSpec
from ogm.io.grids.archived import read_archived, write_archived
from ogm.io.grids.geotiff import check_crs, read_geotiff, write_geotiff
from ogm.io.grids.logged import GridLog, GridMessage, check_logged, read_logged
from ogm.io.grids.map_server import MapMode, check_map_server, read_map_server, write_map_server
from ogm.io.grids.placed import PlacedGrid
from ogm.io.grids.scientific import check_scientific, read_scientific, write_scientific
from ogm.io.images import open_image
from ogm.io.logs import LOG_ENDINGS, log_ending
from ogm.io.messages.grids import AnyGrid
from ogm.io.reading import optional, parse_array, read_bytes
from ogm.storage.files import FilePath, OgmError, atomic_write, error_context

GRID_ENDINGS = (".npz", ".npy", ".png")  # files with the grid of one frame
_YAML, _TIFF, _SCIENTIFIC = (".yaml", ".yml"), (".tif", ".tiff"), (".nc", ".zarr")
MAP_ENDINGS = (".npz", *_YAML, *_TIFF, *_SCIENTIFIC, ".png", *LOG_ENDINGS)  # endings that `write_grid` supports


def write_grid(
    path: FilePath, grid: AnyGrid | PlacedGrid, *, mode: MapMode | None = None, message: GridMessage | None = None
) -> None:
    """Write a grid in the format given by the ending of the path, in one step.

    Parameters
    ----------
    path : path
        ``.npz`` (exact, like `EvidentialGrid.save`, `DynamicGrid.save`), ``.yaml`` (nav2 and ROS map_server, with an
        image file), ``.tif`` (GeoTIFF, cloud-optimised), ``.nc`` (NetCDF-CF), ``.zarr`` (Zarr 3), ``.png`` (red is
        255 times the mass of occupied, green 255 times the mass of free), ``.mcap``, ``.db3``, ``.bag`` (a log with
        this grid on ``/map``; for a whole drive see `GridLog`).
    grid : EvidentialGrid, DynamicGrid, LayeredGrid or PlacedGrid
        ``.npz``, ``.tif``, ``.nc``, ``.zarr`` and the messages grid-map and foxglove-grid hold all bands: masses, bands
        of a `DynamicGrid`, and layers. The others hold only free and occupied; use `grid_from_layer` for a layer of a
        `LayeredGrid`. Pose, stamp and coordinate reference system of a `PlacedGrid` are stored if the format holds
        them; ``.npz`` and ``.png`` hold no rotation.
    mode : {"trinary", "scale", "raw"}, optional
        Mode of ``.yaml``: the state of each cell (default), or its value of 0 ... 100, occupied + unknown / 2, by grey
        levels and transparency, or directly.
    message : {"occupancy-grid", "grid-map", "foxglove-grid", "costmap"}, optional
        Message of logs, see `GridLog`; by default occupancy-grid. A costmap is on ``/costmap_raw``.

    Raises
    ------
    ValueError
        If the numbers of the grid are no masses, the ending is unknown, an option does not belong to the format, the
        grid is tilted, or rotated and the format holds no rotation, or a file or folder that is no such grid would be
        replaced.
    ImportError
        If the package of the format is missing.
    OSError
        If the folder is missing or cannot be written.

    Examples
    --------
    >>> write_grid("map.yaml", mapper.grid)                                        # doctest: +SKIP
    >>> write_grid("map.tif", PlacedGrid(mapper.grid, pose(x, y, yaw=yaw), crs="EPSG:25832"))  # doctest: +SKIP
    """
    path = Path(path)
    placed = PlacedGrid.of(grid)
    check_grid_output(path, mode=mode, message=message, crs=placed.crs)
    ending = path.suffix.lower()
    if ending in _YAML:
        write_map_server(path, placed, mode or "trinary")
    elif ending in _TIFF:
        write_geotiff(path, placed)
    elif ending in _SCIENTIFIC:
        write_scientific(path, placed)
    elif ending in LOG_ENDINGS:
        topic = "/costmap_raw" if message == "costmap" else "/map"
        with GridLog(path, message or "occupancy-grid", topic) as log:
            log.write(placed)
    elif ending == ".png":
        write_picture(path, placed.upright.evidential)
    else:
        write_archived(path, placed)


def check_grid_output(
    path: FilePath, *, mode: MapMode | None = None, message: GridMessage | None = None, crs: str | None = None
) -> None:
    """Check a path and options for `write_grid` before hours of work; raises its ValueError and ImportError.

    Parameters
    ----------
    path : path
    mode : {"trinary", "scale", "raw"}, optional
    message : {"occupancy-grid", "grid-map", "foxglove-grid", "costmap"}, optional
    crs : str, optional
        Coordinate reference system of the `PlacedGrid`.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in MAP_ENDINGS:
        raise ValueError(f"a grid is written as {', '.join(MAP_ENDINGS)}, got {path}")
    if mode is not None and (ending not in _YAML or mode not in get_args(MapMode)):
        raise ValueError(f"mode must be one of {', '.join(get_args(MapMode))}, for .yaml files only; got {mode!r}")
    if message is not None and ending not in LOG_ENDINGS:
        raise ValueError(f"message is only for {', '.join(LOG_ENDINGS)}, got {message!r} for {path}")
    if ending in _YAML:
        check_map_server(path, mode or "trinary")
    elif ending in LOG_ENDINGS:
        check_logged(path, message or "occupancy-grid")
    elif ending in _TIFF:
        optional("rasterio", path, "geo", "written")
    elif ending in _SCIENTIFIC:
        check_scientific(path)
    if crs is not None and ending in _TIFF + _SCIENTIFIC:
        check_crs(crs, path)


def read_grid(
    path: FilePath, area: GridSpec | None = None, *, topic: str | None = None, free_thresh: float | None = None
) -> EvidentialGrid:
    """Read the masses of free and occupied, in the coordinates of the frame of the file.

    Parameters
    ----------
    path : path
        A file written by `write_grid` or by another program. ``.yaml``: map_server; occupancy values become masses
        without unknown, except for unknown cells. ``.tif``, ``.nc`` and ``.zarr``: bands or variables free and
        occupied. ``.mcap``, ``.db3`` and ``.bag``: the last OccupancyGrid, GridMap or foxglove.Grid, with later
        OccupancyGridUpdates. ``.png``: as exported by the paper's released code, red 255 times the mass of occupied,
        green 255 times the mass of free, row 0 the front, column 0 the left. ``.npy``: masses of free and occupied,
        (nx, ny, 2) float, with the axes of `ogm`, index (0, 0) at the rear right.
    area : GridSpec, optional
        Area of ``.npy`` and ``.png``, which do not store it; its resolution is ignored.
    topic : str, optional
        Topic of logs; by default the only topic with grids, or ``/map`` if there are several.
    free_thresh : float, optional
        Threshold of ``.yaml``, replaces the file's. Use 0.196 if a warning states that unknown cells are read as free.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If it is damaged, has another format, holds no masses, non-square cells (on that area), or a rotated grid: see
        `read_placed_grid`.
    ImportError
        If the package of the format is missing.
    """
    placed = read_placed_grid(path, area, topic=topic, free_thresh=free_thresh)
    with error_context(path):
        return placed.upright.evidential


def read_any_grid(
    path: FilePath, area: GridSpec | None = None, *, topic: str | None = None, free_thresh: float | None = None
) -> AnyGrid:
    """Read a grid of any kind: a `DynamicGrid`, an `EvidentialGrid`, or without masses a `LayeredGrid`.

    Further layers are read by `read_placed_grid`. Parameters and errors: see `read_grid`.
    """
    placed = read_placed_grid(path, area, topic=topic, free_thresh=free_thresh)
    with error_context(path):
        return placed.upright.grid


def read_placed_grid(
    path: FilePath, area: GridSpec | None = None, *, topic: str | None = None, free_thresh: float | None = None
) -> PlacedGrid:
    """Read the full content of a file: a grid with its pose in a frame, which may be rotated, and further layers.

    The grid is a `DynamicGrid` if all of its bands exist, and a `LayeredGrid` if there are no masses. Parameters and
    errors: see `read_grid`.
    """
    path = Path(path)
    ending = log_ending(path) or path.suffix.lower()
    if ending not in (*MAP_ENDINGS, ".npy"):
        raise OgmError(f"{path} is no readable grid, wanted {', '.join((*MAP_ENDINGS, '.npy'))}")
    if topic is not None and ending not in LOG_ENDINGS:
        raise ValueError(f"topic is only for {', '.join(LOG_ENDINGS)}, got {topic!r} for {path}")
    if free_thresh is not None and ending not in _YAML:
        raise ValueError(f"`free_thresh` is only for .yaml files, got {free_thresh} for {path}")
    if not path.exists():
        raise FileNotFoundError(f"there is no file {path}: check the name and the folder")
    if path.is_dir() != (ending == ".zarr") or not (path.is_file() or path.is_dir()):
        raise OgmError(f"{path} is a {'folder' if path.is_dir() else 'file or a device'}, which a {ending} is not")
    if ending in (".npy", ".png") and area is None:
        raise OgmError(f"{path} does not store its area: give `length` and `width` [m] of its `area`")
    try:
        # damaged files may hold any number, and libraries warn about content that is refused below
        with np.errstate(all="ignore"), warnings.catch_warnings(action="ignore"):
            return _read(path, area, topic, free_thresh)
    except ValueError as error:
        message = str(error)
        raise OgmError(message if str(path) in message else f"{path}: {message}") from error


def _read(path: Path, area: GridSpec | None, topic: str | None, free_thresh: float | None) -> PlacedGrid:
    ending = path.suffix.lower()
    if log_ending(path):
        return read_logged(path, topic)
    if ending in _YAML:
        return read_map_server(path, free_thresh)
    if ending in _TIFF:
        return read_geotiff(path)
    if ending in _SCIENTIFIC:
        return read_scientific(path)
    if area is None or ending == ".npz":
        return read_archived(path)
    return PlacedGrid(read_array(path, area) if ending == ".npy" else read_picture(path, area))


def read_array(path: Path, area: GridSpec) -> EvidentialGrid:
    """Read masses of free and occupied, (nx, ny, 2) float, index (0, 0) at the rear right."""
    wanted = "masses of free and occupied, (nx, ny, 2) float"
    array = parse_array(read_bytes(path)[0], path, lambda shape: len(shape) == 3 and shape[-1] == 2, wanted)
    if array.dtype.kind != "f":
        raise OgmError(f"{path} must hold {wanted}, got {array.dtype} {array.shape}")
    return EvidentialGrid(_on(area, (array.shape[0], array.shape[1]), path), array.astype(np.float32))


def read_picture(path: Path, area: GridSpec) -> EvidentialGrid:
    """Read a picture: red 255 times the mass of occupied, green for free, row 0 the front, column 0 the left."""
    with open_image(path) as picture:
        if picture.mode not in ("RGB", "RGBA"):
            raise OgmError(f"{path} must be an RGB picture, red occupied and green free, got {picture.mode}")
        spec = _on(area, (picture.height, picture.width), path)  # before unpacking
        green, red = picture.getchannel(1), picture.getchannel(0)
    mass = np.empty((*spec.shape, 2), np.float32)
    for state, channel in enumerate((green, red)):
        mass[..., state] = np.asarray(channel)[::-1, ::-1]
    mass /= 255
    mass /= np.maximum(mass[..., :1] + mass[..., 1:], 1)  # rounding may exceed one
    return EvidentialGrid(spec, mass)


def write_picture(path: Path, grid: EvidentialGrid) -> None:
    """Write a picture for `read_picture`, with masses rounded to 1/255 and without the area."""
    from PIL import Image

    pixels = np.zeros((*grid.spec.shape, 3), np.uint8)
    pixels[..., 0], pixels[..., 1] = np.rint(255 * grid.occupied), np.rint(255 * grid.free)
    with atomic_write(path) as file:
        Image.fromarray(np.ascontiguousarray(pixels[::-1, ::-1])).save(file, "PNG")


def _on(area: GridSpec, shape: tuple[int, int], path: Path) -> GridSpec:
    """Return a spec with cells of a shape that fill an area."""
    resolution = area.length / max(shape[0], 1)
    if not np.isclose(resolution * shape[1], area.width, rtol=1e-6):
        raise OgmError(
            f"{path} has {shape[0]} x {shape[1]} cells, which are not square on {area.length:g} m x {area.width:g} m: "
            "give the right area, or save the grid as .npz with its own spec (EvidentialGrid.save)"
        )
    return GridSpec(resolution, shape, area.origin)
