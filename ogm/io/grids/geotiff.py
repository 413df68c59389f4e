"""GeoTIFF: a cloud-optimised file with bands free, occupied and unknown, row 0 the top; turned by its GeoTransform."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from ogm.files import OgmError
from ogm.grid import GridSpec
from ogm.io.grids.paths import reason, whole_path
from ogm.io.grids.placed import Corner, PlacedGrid, nanometres, placed_at
from ogm.io.reading import optional

__all__ = ["check_crs", "read_geotiff", "write_geotiff"]

_BANDS = ("free", "occupied", "unknown")
_COLOURS = ("green", "red", "blue")  # of the bands, where a program shows them as a picture
_SQUARE = 1e-6  # departure of a pixel from a square that rounding can make


def check_crs(crs: str, path: Path) -> Any:
    """Return a coordinate reference system as rasterio has it; raise unless its coordinates are metres on a plane."""
    optional("rasterio", path, "geo", "written")
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    try:
        system = CRS.from_user_input(crs)
    except (CRSError, ValueError) as error:
        raise ValueError(
            f"there is no coordinate reference system {crs!r} ({error}); wanted one such as EPSG:25832"
        ) from error
    if not system.is_projected or not math.isclose(system.linear_units_factor[1], 1.0):
        raise ValueError(
            f"{crs} is not in metres on a plane, as cells are; use a projected one, such as UTM (EPSG:25832)"
        )
    return system


def write_geotiff(path: Path, placed: PlacedGrid) -> None:
    """Write a GeoTIFF: three bands of float32, exact. Nodata is NaN, which no cell has: unknown is a mass."""
    rasterio = optional("rasterio", path, "geo", "written")
    from rasterio.enums import ColorInterp

    (x, y, yaw), spec = placed.corner, placed.grid.spec
    (nx, ny), step_x, step_y = spec.shape, spec.resolution * math.cos(yaw), spec.resolution * math.sin(yaw)
    top = x - ny * step_y, y + ny * step_x
    profile = {
        "driver": "COG", "width": nx, "height": ny, "count": len(_BANDS), "dtype": "float32", "nodata": math.nan,
        "crs": None if placed.crs is None else check_crs(placed.crs, path),
        "transform": rasterio.Affine(step_x, step_y, top[0], step_y, -step_x, top[1]),
        "compress": "DEFLATE", "predictor": "YES", "overview_resampling": "AVERAGE", "bigtiff": "IF_SAFER",
    }  # fmt: skip
    tags = {"frame_id": placed.frame_id} | ({} if placed.stamp is None else {"stamp": repr(placed.stamp)})
    with whole_path(path) as temporary:
        try:
            with rasterio.open(temporary, "w", **profile) as image:
                for band, name in enumerate(_BANDS, start=1):
                    image.write(getattr(placed.grid, name).T[::-1], band)
                    image.set_band_description(band, name)
                image.colorinterp = [ColorInterp[name] for name in _COLOURS]
                image.update_tags(**tags)
        except Exception as error:  # rasterio lets GDAL's own errors through
            raise OSError(f"{path} cannot be written: {error}") from error


def read_geotiff(path: Path) -> PlacedGrid:
    """Read a GeoTIFF whose bands have the names free and occupied; nodata is unknown."""
    rasterio = optional("rasterio", path, "geo")
    try:
        with rasterio.open(path, driver="GTiff") as image:  # not one of GDAL's formats that name other files
            GridSpec(1.0, (image.width, image.height), (0.0, 0.0))  # not too many cells, before they are unpacked
            names = list(image.descriptions)
            if not {"free", "occupied"} <= set(names):
                got = ", ".join(map(str, names))[:80]
                raise OgmError(f"{path} must have bands with the names free and occupied, got {got or 'none'}")
            bands = [names.index(name) + 1 for name in ("free", "occupied")]
            if any(image.dtypes[band - 1] not in ("float32", "float64") for band in bands):
                raise OgmError(f"{path} must have bands of float, masses in [0, 1], got {image.dtypes[bands[0] - 1]}")
            resolution, corner, down = _place(image.transform, image.height, path)
            rows = image.read(bands, out_dtype="float32", masked=True).filled(0)
            tags, crs = image.tags(), None if image.crs is None else image.crs.to_string()
    except OgmError:
        raise
    except Exception as error:  # rasterio lets GDAL's own errors through
        raise OgmError(f"{path} is damaged or no GeoTIFF: {reason(error, path)}") from error
    if crs is not None:
        check_crs(crs, path)
    mass = np.ascontiguousarray(np.moveaxis(rows[:, ::-1] if down else rows, 0, -1).swapaxes(0, 1))
    return placed_at(
        mass, resolution, corner, frame_id=tags.get("frame_id", "map"), stamp=_stamp(tags.get("stamp")), crs=crs
    )


def _place(transform: Any, rows: int, path: Path) -> tuple[float, Corner, bool]:
    """Return the side of a pixel [m], the corner of cell (0, 0), and whether rows lead from the greatest y down."""
    a, b, c, d, e, f = transform[:6]
    if transform.is_identity or not np.isfinite(transform[:6]).all():
        raise OgmError(
            f"{path} has no georeference, so that the size of its cells is not known; see gdal_translate -a_ullr"
        )
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
    """Return the time of a tag; None where it is no finite number."""
    try:
        stamp = float(text or "nan")
    except ValueError:
        return None
    return stamp if math.isfinite(stamp) else None
