"""Descriptions of files and folders that ogm reads or writes, as names and values to print."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ogm.dynamic_grid import DynamicGrid
from ogm.grid import EvidentialGrid, LayeredGrid
from ogm.io.reading import decode_json
from ogm.io.scan_table import Axes
from ogm.storage.files import OgmError, error_context

_IMAGES = {".png": ("PNG",), ".gif": ("GIF",), ".webp": ("WEBP",), ".bmp": ("BMP",)}
_IMAGES |= dict.fromkeys((".jpg", ".jpeg"), ("JPEG",)) | dict.fromkeys((".ppm", ".pgm"), ("PPM",))
_POSES = (".csv", ".txt", ".tum", ".g2o")


def describe_path(
    path: Path,
    *,
    axes: Axes = "flu",
    intensity_max: float | None = None,
    time_unit: float | None = None,
    frame: str | None = None,
) -> dict[str, str]:
    """Return the contents of a file or folder as names and values.

    Parameters
    ----------
    path : Path
        Scan, folder of scans, dataset, log, grid or map of any format, world map, poses, weights, calibration, report
        of an evaluation, folder of fused drives, page or picture.
    axes, intensity_max, time_unit, frame
        Options for scans and logs, see `ogm.datasets.open_dataset`.

    Raises
    ------
    FileNotFoundError
        If the path does not exist.
    OgmError
        If the file is damaged or of an unknown kind.
    """
    from ogm.datasets import open_dataset
    from ogm.datasets.logs import CAPTURE_ENDINGS, describe_log, is_log
    from ogm.datasets.ouster import OUSTER_ENDING
    from ogm.datasets.scans import ending_of
    from ogm.io import describe, read_scan_file
    from ogm.io.carmen import is_carmen

    units = {"intensity_max": intensity_max, "time_unit": time_unit}
    if not path.exists():
        raise FileNotFoundError(f"there is no {path}: check the name and the folder")
    if is_log([path]):
        return describe_log(path, frame)
    if path.is_file() and not ending_of(path) and is_carmen(path):
        return open_dataset(path, axes=axes, **units).describe()  # type: ignore[arg-type]
    of_folder = next((read for name, read in _FOLDERS.items() if path.is_dir() and list(path.glob(name))), None)
    if found := of_folder or _FILES.get(path.suffix.lower()):
        with error_context(path, KeyError, TypeError):
            return found(path)
    if path.is_dir() or path.suffix.lower() in (*CAPTURE_ENDINGS, OUSTER_ENDING):
        return open_dataset(path, axes=axes, **units).describe()  # type: ignore[arg-type]
    return describe(*read_scan_file(path, axes, intensity_max=intensity_max, time_unit=time_unit))


def _grid(path: Path) -> dict[str, str]:
    """Return kind, cells and mean masses of a grid, or the range of its layers."""
    from ogm.io import read_placed_grid
    from ogm.plot.overview import Steps

    placed = read_placed_grid(path)
    grid, (x, y, yaw) = placed.grid, placed.corner
    (nx, ny), side = grid.spec.shape, grid.spec.resolution
    facts = {
        "format": f"{type(grid).__name__.removesuffix('Grid').lower()} grid",
        "cells": f"{nx} x {ny} of {side:g} m",
        **({"corner": f"x {x:.10g} m, y {y:.10g} m, yaw {yaw:.6g} rad"} if yaw else {}),
        **({} if yaw else {"x": f"{x:g} ... {x + nx * side:g} m", "y": f"{y:g} ... {y + ny * side:g} m"}),
    }
    facts |= {} if placed.stamp is None else {"stamp": f"{placed.stamp:.6f} s"}
    layers = grid if isinstance(grid, LayeredGrid) else placed.layers
    masses = {} if isinstance(grid, LayeredGrid) else _masses(grid)
    ranges = {name: Steps.of(layer) for name, layer in layers.layers.items()} if layers else {}
    facts |= grid.meta if isinstance(grid, EvidentialGrid) else {}
    return facts | masses | {name: f"{low:.4g} ... {high:.4g}" for name, (low, high) in ranges.items()}


def _masses(grid: EvidentialGrid | DynamicGrid) -> dict[str, str]:
    states = ("static", "dynamic") if isinstance(grid, DynamicGrid) else ("occupied",)
    return {name: f"{100 * getattr(grid, name).mean():.1f} %" for name in ("free", *states, "unknown")}


def _world(path: Path) -> dict[str, str]:
    from ogm.world import WorldMap

    with WorldMap.open(path) as world:
        return {"format": "world map"} | world.describe()


def _zarr(path: Path) -> dict[str, str]:
    """Return the contents of a Zarr folder: a grid, a world map, or simulated samples."""
    from ogm.datasets.simulated import is_simulated

    attributes = _object(path / "zarr.json").get("attributes")
    stated = str(attributes.get("format", "")) if isinstance(attributes, dict) else ""
    if stated.startswith("ogm.world/"):
        return _world(path)
    if is_simulated(path) and not stated.startswith(("ogm.EvidentialGrid/", "ogm.LayeredGrid/")):
        from ogm.simulation.store import Store

        return Store.open(path).describe()
    return _grid(path)


def _model(path: Path) -> dict[str, str]:
    from ogm.models.named import describe_model

    text, file = describe_model(str(path))
    return {"format": "sensor model", "model": text, **(file or {})}


def _poses(path: Path) -> dict[str, str]:
    from ogm.io import read_poses

    try:
        poses = read_poses(path)
    except OgmError:  # poses of a camera; the length of the path is the same
        poses = read_poses(path, T_camera_sensor=np.eye(4))
    steps = np.diff(poses.poses[:, :3, 3], axis=0)
    facts = {"format": "poses", "poses": str(len(poses)), "path": f"{np.linalg.norm(steps, axis=1).sum():.1f} m"}
    if poses.stamps is not None and len(poses):
        facts["time"] = f"{poses.stamps[0]:.6f} ... {poses.stamps[-1]:.6f} s"
    return facts


def _object(path: Path) -> dict[str, Any]:
    """Return the JSON object in a file."""
    with error_context(f"{path} is no JSON", ValueError, RecursionError):
        record = decode_json(path.read_bytes(), path)
    if not isinstance(record, dict):
        raise OgmError(f"{path} contains a {type(record).__name__}, wanted a JSON object")
    return record


def _json(path: Path) -> dict[str, str]:
    record = _object(path)
    stated = str(record.get("format", "JSON"))
    return (
        _model(path) if stated.startswith("ogm.calibration/") else {"format": stated, "holds": ", ".join(record)[:200]}
    )


def _report(folder: Path) -> dict[str, str]:
    record = _object(folder / "report.json")
    return {
        "format": "report of `ogm evaluate`",
        "data": str(record["data"]["name"]),
        "extent": str(record["extent"]),
        "methods": ", ".join(record["methods"]),
        "page": str(folder / "report.html"),
    }


def _drives(folder: Path) -> dict[str, str]:
    """Return the drives in a folder of `ogm fuse --each-drive`."""
    notes = {path.parent.name: _object(path) for path in sorted(folder.glob("*/drive.json"))}
    return {"format": "fused drives"} | {name: str(note["facts"]["scans"]) for name, note in notes.items()}


def _image(path: Path) -> dict[str, str]:
    from ogm.io.images import open_image

    with open_image(path, _IMAGES[path.suffix.lower()]) as image:
        size = f"{image.width} x {image.height} pixels"
    return {"format": "picture", "size": size, "as a grid": "ogm view --length L --width W, red as occupied"}


def _page(path: Path) -> dict[str, str]:
    return {"format": "page for a browser", "size": f"{path.stat().st_size / 1e6:.1f} MB"}


Describe = Callable[[Path], dict[str, str]]
_FOLDERS: dict[str, Describe] = {  # file that identifies the kind of a folder
    "zarr.json": _zarr,
    "report.json": _report,
    "*/drive.json": _drives,
    "best.safetensors": _model,
}
_FILES: dict[str, Describe] = {
    **dict.fromkeys((".npz", ".yaml", ".yml", ".tif", ".tiff", ".nc", ".zarr"), _grid),
    **dict.fromkeys(_POSES, _poses),
    **dict.fromkeys(_IMAGES, _image),
    **dict.fromkeys((".safetensors", ".onnx"), _model),
    ".zip": _world,
    ".json": _json,
    ".html": _page,
}
