"""GeoTIFF: a cloud-optimised file with one band per layer, row 0 the top; its GeoTransform holds the rotation."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from ogm.grid import GridSpec, LayeredGrid
from ogm.io.grids.placed import Corner, PlacedGrid, nanometres, placed_at
from ogm.io.messages.grids import MASSES, is_derived
from ogm.io.reading import optional, reason
from ogm.storage.files import OgmError, atomic_write
from ogm.storage.limits import current_limits, too_large

_COLOURS = ("green", "red", "blue")  # of the first bands, for programs that show them as a picture
_CACHE = 2**24  # [byte] of blocks kept by GDAL; its default is a twentieth of the memory
_SQUARE = 1e-6  # departure of a pixel from a square by rounding


def check_crs(crs: str, path: Path) -> Any:
    """Return a coordinate reference system of rasterio; raise unless it is projected, in metres."""
    optional("rasterio", path, "geo", "written")
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    try:
        system = CRS.from_user_input(crs)
    except (CRSError, ValueError) as error:
        raise ValueError(f"{crs!r} is no coordinate reference system ({error}); give one like EPSG:25832") from error
    if not system.is_projected or not math.isclose(system.linear_units_factor[1], 1.0):
        raise ValueError(f"{crs} is not projected in metres; give a projected system, such as UTM (EPSG:25832)")
    return system


def write_geotiff(path: Path, placed: PlacedGrid) -> None:
    """Write a GeoTIFF with named bands of float32, exact. Nodata is NaN, as unknown is a valid mass."""
    rasterio = optional("rasterio", path, "geo", "written")
    from rasterio.enums import ColorInterp

    (x, y, yaw), spec, layers = placed.corner, placed.grid.spec, placed.bands.layers
    (nx, ny), step_x, step_y = spec.shape, spec.resolution * math.cos(yaw), spec.resolution * math.sin(yaw)
    top, masses = (x - ny * step_y, y + ny * step_x), "free" in layers
    profile = {
        "driver": "COG", "width": nx, "height": ny, "count": len(layers), "dtype": "float32", "nodata": math.nan,
        "crs": None if placed.crs is None else check_crs(placed.crs, path),
        "transform": rasterio.Affine(step_x, step_y, top[0], step_y, -step_x, top[1]),
        "compress": "DEFLATE", "predictor": "YES", "overview_resampling": "AVERAGE" if masses else "NEAREST",
        "bigtiff": "IF_SAFER",
    }  # fmt: skip
    tags = {"frame_id": placed.frame_id} | ({} if placed.stamp is None else {"stamp": repr(placed.stamp)})
    with rasterio.MemoryFile(ext=".tif") as memory:  # GDAL does not report a full disk when it closes a file
        try:
            with memory.open(**profile) as image:
                for band, (name, layer) in enumerate(layers.items(), start=1):
                    image.write(layer.T[::-1], band)
                    image.set_band_description(band, name)
                if masses:
                    others = [ColorInterp.undefined] * (len(layers) - len(_COLOURS))
                    image.colorinterp = [ColorInterp[name] for name in _COLOURS] + others
                image.update_tags(**tags)
        except Exception as error:  # rasterio lets errors of GDAL through
            raise OSError(f"{path} cannot be written: {error}") from error
        with atomic_write(path) as file:
            file.write(memory.getbuffer())


def read_geotiff(path: Path) -> PlacedGrid:
    """Read a GeoTIFF: masses from the bands free and occupied, other bands as layers; nodata is NaN."""
    rasterio = optional("rasterio", path, "geo")
    try:
        # the driver is fixed, as other formats of GDAL can name further files
        with rasterio.Env(GDAL_CACHEMAX=_CACHE), rasterio.open(path, driver="GTiff") as image:
            GridSpec(1.0, (image.width, image.height), (0.0, 0.0))  # refuses too many cells before unpacking
            names = [name or f"band{number}" for number, name in enumerate(image.descriptions, start=1)]
            read = {name: k for k, name in enumerate(names, start=1) if not is_derived(name, names)}
            size = 4 * len(read) * image.width * image.height
            blocks = [a * b for a, b in image.block_shapes]
            if max(size, 8 * max(blocks)) > current_limits().grid:
                raise too_large(path, max(size, 8 * max(blocks)), "grid")
            kinds = dict(zip(names, image.dtypes, strict=True))
            for name, kind in kinds.items():
                if np.dtype(kind).kind not in ("f" if name in MASSES else "fiu"):
                    raise OgmError(f"{path} must have bands of float, masses in [0, 1], got {kind} of {name}")
            if len(kinds) < len(names):
                raise OgmError(f"{path} has two bands of one name: {', '.join(names)[:80]}")
            resolution, (x, y, yaw), down = _place(image.transform, image.height, path)
            spec = GridSpec(resolution, (image.width, image.height), (x, y))
            rows = slice(None, None, -1 if down else 1)
            values = {name: image.read(k, out_dtype="float32", masked=True) for name, k in read.items()}
            bands = {name: band.filled(np.nan)[rows].T for name, band in values.items()}
            tags, crs = image.tags(), None if image.crs is None else image.crs.to_string()
    except OgmError:
        raise
    except Exception as error:  # rasterio lets errors of GDAL through
        raise OgmError(f"{path} is damaged or no GeoTIFF: {reason(error, path)}") from error
    if crs is not None:
        check_crs(crs, path)
    facts = {"frame_id": tags.get("frame_id", "map"), "stamp": _stamp(tags.get("stamp")), "crs": crs}
    return placed_at(LayeredGrid(spec, bands), yaw, **facts)


def _place(transform: Any, rows: int, path: Path) -> tuple[float, Corner, bool]:
    """Return the side of a pixel [m], the corner of cell (0, 0), and whether rows go from the greatest y down."""
    a, b, c, d, e, f = transform[:6]
    if transform.is_identity or not np.isfinite(transform[:6]).all():
        raise OgmError(f"{path} has no georeference, so its cell size is unknown; see gdal_translate -a_ullr")
    right, down = complex(a, d), complex(b, e)
    turn = right * 1j
    falling = abs(down + turn) < abs(down - turn)
    if not abs(down + turn if falling else down - turn) <= _SQUARE * abs(right):
        raise OgmError(f"{path} has pixels of {abs(right):g} by {abs(down):g} m, wanted squares: see gdalwarp -tr")
    x, y = (c + b * rows, f + e * rows) if falling else (c, f)
    yaw = math.atan2(d, a)
    resolution = a if d == 0 < a else float(f"{abs(right):.12g}")
    return resolution, Corner(nanometres(x), nanometres(y), yaw), falling


def _stamp(text: str | None) -> float | None:
    """Return the time of a tag, or None if it is no finite number."""
    try:
        stamp = float(text or "nan")
    except ValueError:
        return None
    return stamp if math.isfinite(stamp) else None
