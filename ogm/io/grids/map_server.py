"""Maps of ROS's map_server: a YAML file, and an image with its row 0 at the top, the greatest y.

Rules of nav2's loader (``nav2_map_server/src/map_io.cpp``): ``p = (255 - grey) / 255``, or ``grey / 255`` if negated.
trinary: occupied above ``occupied_thresh``, free below ``free_thresh``, else unknown (later versions treat p at a
threshold as known). scale: the same thresholds, linear in between, transparent is unknown. raw: the grey is the value,
unknown above 100.
"""

import logging
import os
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from ogm.grid import GridSpec, LayeredGrid
from ogm.io.grids.placed import Corner, PlacedGrid, placed_at
from ogm.io.images import open_image
from ogm.io.messages.grids import mass_from_occupancy, occupancy_values
from ogm.io.reading import is_file_name
from ogm.state import predict_state
from ogm.storage.files import OgmError, atomic_write

_log = logging.getLogger(__name__)

MapMode = Literal["trinary", "scale", "raw"]
_GREYS = np.array([205, 254, 0], np.uint8)  # of CellState.UNKNOWN, FREE, OCCUPIED
_THRESHOLDS = {  # occupied, free. Grey 205 is p = 0.19608: with map_saver's 0.25 unknown would load as free
    "trinary": (0.65, 0.196),
    "scale": (1.0, 0.0),  # the values 0 ... 100 then load exactly
    "raw": (0.65, 0.196),
}
_FORMATS = ("PNG", "PPM", "BMP", "JPEG")  # PPM: also PGM and PBM
_NUMBERS = ("resolution", "occupied_thresh", "free_thresh")
_NO, _YES = ("0", "false", "no", "False"), ("1", "true", "yes", "True")
_CREATOR = "CREATOR: ogm"  # comment of images, which identifies images of an interrupted write
_MAX_TEXT = 2**16  # [byte] of a YAML file, which has seven short lines


class _Header(NamedTuple):
    """Values of the YAML file."""

    image: Path
    mode: MapMode
    resolution: float
    corner: Corner
    negate: bool
    occupied: float
    free: float


def write_map_server(path: Path, placed: PlacedGrid, mode: MapMode = "trinary") -> None:
    """Write a map for map_server: ``NAME.yaml`` with ``NAME.pgm``, or ``NAME-scale.png`` with alpha in mode scale.

    Both files are first written completely under temporary names. Then an old YAML file is removed, and the image and
    the YAML file are renamed, in this order. A crash in between leaves no YAML file, hence no map, but never a wrong
    one.

    Raises
    ------
    ValueError
        See `check_map_server`.
    """
    import yaml
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    check_map_server(path, mode)
    x, y, yaw = placed.corner
    pixels, image_path = _pixels(placed, mode), _image_of(path, mode)
    occupied, free = _THRESHOLDS[mode]
    values: dict[str, Any] = {"image": image_path.name, "mode": mode, "resolution": placed.grid.spec.resolution}
    values |= {"origin": [x, y, yaw], "negate": 0, "occupied_thresh": occupied, "free_thresh": free}
    with atomic_write(path) as file:
        file.write(yaml.safe_dump(values, sort_keys=False, default_flow_style=None, allow_unicode=True).encode())
        with atomic_write(image_path) as image_file:
            if mode == "scale":
                comment = PngInfo()
                comment.add_text("Comment", _CREATOR)
                Image.fromarray(pixels).save(image_file, "PNG", pnginfo=comment)
            else:
                head = f"P5\n# {_CREATOR}\n{pixels.shape[1]} {pixels.shape[0]}\n255\n"
                image_file.write(head.encode() + pixels.tobytes())
            for part in (file, image_file):  # detects a full disk while the old map is intact
                part.flush()
                os.fsync(part.fileno())
            path.unlink(missing_ok=True)


def check_map_server(path: Path, mode: MapMode = "trinary") -> None:
    """Raise ValueError if the image of a map would replace an unrelated file."""
    image_path = _image_of(path, mode)
    if not os.path.lexists(image_path):
        return
    with suppress(OSError, ValueError):
        if path.is_file() and _header(path).image == Path(os.path.abspath(image_path)):
            return
        with open(image_path, "rb") as file:
            if _CREATOR.encode() in file.read(256):
                return
    raise ValueError(f"{path} would replace {image_path}, which is no image of that map: give another name, or move it")


def _image_of(path: Path, mode: MapMode) -> Path:
    """Return the image path of a map; NAME.png stays available for a picture of the map."""
    return path.with_name(f"{path.stem}{'-scale.png' if mode == 'scale' else '.pgm'}")


def _pixels(placed: PlacedGrid, mode: MapMode) -> NDArray[np.uint8]:
    """Return rows of pixels from the top, (ny, nx) or with alpha (ny, nx, 2)."""
    if mode == "trinary":
        return _rows(_GREYS[predict_state(placed.evidential.mass)])
    values = _rows(occupancy_values(placed.evidential))
    if mode == "raw":
        return np.where(values < 0, np.uint8(255), values.astype(np.uint8))
    grey = np.rint(2.55 * (100 - np.maximum(values, 0).astype(np.float32))).astype(np.uint8)
    alpha = np.where(values < 0, np.uint8(0), np.uint8(255))
    return np.stack([grey, alpha], axis=-1)


def _rows(cells: NDArray[Any]) -> NDArray[Any]:
    """Turn cells (nx, ny) into rows from the greatest y down, (ny, nx), and back."""
    return np.ascontiguousarray(cells.T[::-1])


def read_map_server(path: Path, free_thresh: float | None = None) -> PlacedGrid:
    """Read a map of map_server. Values become masses by `ogm.io.messages.grids.mass_from_occupancy`.

    Parameters
    ----------
    path : Path
    free_thresh : float, optional
        Replaces the file's threshold. With 0.25, written by nav2's map_saver up to 2025, its own grey of unknown cells
        is free, for nav2 and here; with 0.196 it is unknown.
    """
    header = _header(path)
    if free_thresh is not None:
        if not 0 <= free_thresh <= header.occupied:
            raise ValueError(f"free_thresh must be from 0 to occupied_thresh, {header.occupied:g}, got {free_thresh}")
        header = header._replace(free=free_thresh)
    mass = mass_from_occupancy(np.ascontiguousarray(_values(header)[::-1].T))
    spec = GridSpec(header.resolution, mass.shape[:2], header.corner[:2])
    return placed_at(LayeredGrid(spec, {"free": mass[..., 0], "occupied": mass[..., 1]}), header.corner.yaw)


def _header(path: Path) -> _Header:
    """Read the YAML file."""
    import yaml

    with open(path, "rb") as file:
        text = file.read(_MAX_TEXT + 1)
    if len(text) > _MAX_TEXT:
        raise OgmError(f"{path} has more than {_MAX_TEXT} bytes, wanted the YAML file of a map: seven lines")
    try:
        values = yaml.load(text, yaml.BaseLoader)  # keeps scalars as text and ignores merge keys, which can fill memory
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        problem = getattr(error, "problem", None) or type(error).__name__
        raise OgmError(f"{path} is no YAML ({problem}): it is cut short or wrongly named") from error
    if not isinstance(values, dict):
        raise OgmError(f"{path} holds a {type(values).__name__}, wanted the keys image, resolution, origin, ...")
    mode = values.get("mode", "trinary")
    if mode not in get_args(MapMode):
        raise OgmError(f"{path}: mode must be one of {', '.join(get_args(MapMode))}, got {_brief(mode)}")
    origin = values.get("origin")
    if not isinstance(origin, list) or len(origin) != 3:
        raise OgmError(f"{path}: origin must be three numbers, [x, y, yaw], got {_brief(origin)}")
    resolution, occupied, free = (_number(values.get(key), key, path) for key in _NUMBERS)
    if resolution <= 0:
        raise OgmError(f"{path}: resolution must be above 0 m, got {resolution:g}")
    corner = Corner(*(_number(value, "origin", path) for value in origin))
    if mode == "scale" and not occupied > free:
        raise OgmError(f"{path}: occupied_thresh must be above free_thresh, got {occupied:g} and {free:g}")
    negate = values.get("negate", "0")
    if negate not in _NO + _YES:
        raise OgmError(f"{path}: negate must be 0 or 1, got {_brief(negate)}")
    return _Header(_image_path(path, values.get("image")), mode, resolution, corner, negate in _YES, occupied, free)


def _number(text: Any, key: str, path: Path) -> float:
    """Return a finite number."""
    try:
        number = float(text) if isinstance(text, str) else np.nan
    except ValueError:
        number = np.nan
    if not np.isfinite(number):
        raise OgmError(f"{path}: {key} must be a finite number, got {_brief(text)}")
    return number


def _brief(value: Any) -> str:
    """Return a value for an error text; only the type of a container, which may be huge."""
    return repr(value)[:40] if isinstance(value, str | None) else type(value).__name__


def _image_path(path: Path, name: Any) -> Path:
    """Return the image path, which must not leave the folder of the YAML file."""
    if not isinstance(name, str) or not is_file_name(name):
        raise OgmError(f"{path}: image must be the name of a file, got {_brief(name)}")
    folder = Path(os.path.abspath(path.parent))
    image = Path(os.path.abspath(folder / name))
    if not image.is_relative_to(folder):
        raise OgmError(f"{path}: image {_brief(name)} lies outside of the file's folder; copy it there")
    if not image.is_file():
        raise OgmError(f"{path}: there is no image {_brief(name)} beside it; copy it there")
    return image


def _values(header: _Header) -> NDArray[np.int8]:
    """Return the occupancy value of every pixel, (rows, columns): 0 ... 100, or -1."""
    channels, highest = _channels(header.image)
    alpha = channels[-1] if len(channels) in (2, 4) else None
    colours = list(channels) if alpha is None else list(channels[:-1])
    if alpha is not None and header.mode == "trinary":  # the loader averages over alpha too
        colours = [*colours * (3 // len(colours)), alpha]
    total = colours[0].astype(np.uint16)
    for colour in colours[1:]:
        total += colour
    table = _value_table(header, len(colours) * highest)
    values = table[total]
    unknown = int(_GREYS[0]) * len(colours) * highest // 255  # grey of unknown cells in all versions of map_saver
    if header.mode == "trinary" and not header.negate and table[unknown] == 0:
        share = np.count_nonzero(total == unknown) / total.size
        if share > 0:
            _log.warning(
                "%s: free_thresh %g makes %.3g %% of the cells free, which have the grey of unknown cells (205), as in "
                "nav2: `free_thresh=0.196` reads them as unknown",
                header.image, header.free, 100 * share,
            )  # fmt: skip
    if alpha is not None and header.mode == "scale":
        values[alpha < highest] = -1
    return values


def _value_table(header: _Header, white: int) -> NDArray[np.int8]:
    """Return the value for every brightness 0 ... `white`."""
    shade = np.arange(white + 1) / white
    if header.mode == "raw":
        value = np.floor(255 * shade + 0.5)
        return np.where(value <= 100, value, -1).astype(np.int8)
    p = shade if header.negate else 1 - shade
    if header.mode == "scale":
        between = np.rint((p - header.free) / (header.occupied - header.free) * 100)
    else:
        between = np.full_like(p, -1)
    return np.where(p > header.occupied, 100, np.where(p < header.free, 0, between)).astype(np.int8)


def _channels(path: Path) -> tuple[tuple[NDArray[Any], ...], int]:
    """Return the channels of an image (grey, grey and alpha, RGB or RGBA), and the value of white."""
    with open_image(path, _FORMATS) as image:
        GridSpec(1.0, (image.width, image.height), (0.0, 0.0))  # refuses too many cells before unpacking
        if image.mode.startswith("I"):  # 16 bit
            return (np.asarray(image).clip(0, 65535),), 65535
        if image.mode not in ("L", "LA", "RGB", "RGBA"):
            alpha = "transparency" in image.info or image.mode == "PA"
            image = image.convert("RGBA" if alpha else "RGB")
        return tuple(np.asarray(band) for band in image.split()), 255
