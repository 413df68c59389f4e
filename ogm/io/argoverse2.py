"""Argoverse 2: one log of the sensor dataset, with boxes, poses, and a map of the ground (Wilson et al. 2021).

>>> from ogm.io.argoverse2 import read_argoverse2
>>> boxes = read_argoverse2("av2/val/LOG").boxes(0)                         # doctest: +SKIP
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.io.formats.feather import read_columns
from ogm.io.labels import BoxRow, boxes_of
from ogm.io.reading import from_quaternions, need, need_numbers, numbers, parse_array, read_bytes, read_json
from ogm.pose import inverse, transform_points
from ogm.scan import Boxes
from ogm.storage.files import FilePath, OgmError, error_context

__all__ = ["Argoverse2Log", "Argoverse2Map", "read_argoverse2"]

_POSITION = ("tx_m", "ty_m", "tz_m")
_QUATERNION = ("qx", "qy", "qz", "qw")
_SIZE = ("length_m", "width_m", "height_m")


class Argoverse2Map(NamedTuple):
    """Drivable areas of a log's city, and the height of its ground.

    Parameters
    ----------
    areas : tuple of (N, 3) float64
        Outlines of the drivable areas [m, city].
    raster : (rows, columns) float64
        Height of the ground [m, city]; NaN if unknown.
    rotation, shift, scale : (2, 2), (2,), float
        Transform from the city to the raster: ``scale * (rotation @ (x, y) + shift)`` is (column, row).
    """

    areas: tuple[NDArray[np.float64], ...]
    raster: NDArray[np.float64]
    rotation: NDArray[np.float64]
    shift: NDArray[np.float64]
    scale: float

    def outlines(self, T_city_sensor: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Return the drivable areas from above, in a sensor's frame, (N, 2) each [m]."""
        T = inverse(T_city_sensor)
        return [transform_points(T, area)[:, :2] for area in self.areas]

    def ground(self, xyz: NDArray[np.floating[Any]], T_city_sensor: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the ground height at some places, in a sensor's frame.

        Parameters
        ----------
        xyz : (N, 3) float
            Places [m]. z matters slightly, as the vehicle may tilt by a degree.
        T_city_sensor : (4, 4) float

        Returns
        -------
        (N,) float64
            z [m]; NaN outside of the mapped ground.
        """
        xyz = np.asarray(xyz, np.float64)
        city = xyz @ T_city_sensor[:3, :3].T + T_city_sensor[:3, 3]
        with np.errstate(over="ignore", invalid="ignore"):  # an overflow lies outside of the raster
            place = np.floor((city[:, :2] @ self.rotation.T + self.shift) * self.scale)
        inside = np.all((place >= 0) & (place < self.raster.shape[::-1]), axis=1)
        column, row = np.where(inside[:, None], place, 0).astype(int).T
        z = self.raster[row, column]
        return xyz[:, 2] + np.where(inside, z, np.nan) - city[:, 2]


class Argoverse2Log(NamedTuple):
    """One log in the vehicle frame: x forward, y left, z up, origin above the rear axle.

    Parameters
    ----------
    sweeps : tuple of Path
        Files with the points of both lidars, in the vehicle frame, by time.
    stamps : tuple of int
        Times of the sweeps [ns].
    poses : dict of int to (4, 4) float64
        ``T_city_vehicle`` by stamp.
    lidars : dict of str to (3,) float64
        Positions of ``up_lidar`` and ``down_lidar`` in the vehicle frame [m]. Empty without calibration.
    annotations : table or None
        Table of boxes; None if missing, as in the test part.
    map : Argoverse2Map or None
        None if the log has no map.
    """

    sweeps: tuple[Path, ...]
    stamps: tuple[int, ...]
    poses: Mapping[int, NDArray[np.float64]]
    lidars: Mapping[str, NDArray[np.float64]]
    annotations: "_Table | None"
    map: Argoverse2Map | None

    def boxes(self, n: int) -> Boxes:
        """Return the boxes at sweep n, in the vehicle frame; empty without annotations."""
        if self.annotations is None:
            return Boxes.empty()
        table = self.annotations
        at = np.flatnonzero(table.columns["timestamp_ns"] == self.stamps[n])
        T = table.poses(at)
        yaw = np.arctan2(T[:, 1, 0], T[:, 0, 0])
        names = (map(str, table.columns[name][at]) for name in ("category", "track_uuid"))
        rows = map(BoxRow, T[:, :3, 3], table.numbers(_SIZE)[at], yaw, *names)
        return boxes_of(list(rows), f"{table.path} at {self.stamps[n]}")


def read_argoverse2(path: FilePath) -> Argoverse2Log:
    """Read the poses, boxes and map of a log, and the names of its sweeps.

    Parameters
    ----------
    path : path
        Folder of the log, with ``sensors/lidar/``.

    Returns
    -------
    Argoverse2Log

    Raises
    ------
    FileNotFoundError
        If there are no sweeps, or no poses.
    OgmError
        If a table lacks a column, a sweep has no pose, or the map has another layout.
    ImportError
        If pyarrow is missing.
    """
    folder = Path(path)
    if not (sweeps := sorted(folder.glob("sensors/lidar/*.feather"))):
        raise FileNotFoundError(f"{folder} has no sensors/lidar/*.feather: give the folder of one log")
    with error_context(f"sweeps of {folder} must be named by their times [ns]"):
        stamps = tuple(int(sweep.stem) for sweep in sweeps)
    file = folder / "city_SE3_egovehicle.feather"
    table = _table(file, ("timestamp_ns", *_POSITION, *_QUATERNION))
    row = {int(stamp): n for n, stamp in enumerate(table.columns["timestamp_ns"])}
    if lost := [stamp for stamp in stamps if stamp not in row]:
        raise OgmError(f"{file} has no pose for the sweep at {lost[0]} (and {len(lost) - 1} others)")
    poses = table.poses(np.array([row[stamp] for stamp in stamps]))
    boxes = folder / "annotations.feather"
    wanted = ("timestamp_ns", "track_uuid", "category", *_SIZE, *_QUATERNION, *_POSITION)
    annotations = _table(boxes, wanted) if boxes.is_file() else None
    found = dict(zip(stamps, poses, strict=True))
    return Argoverse2Log(tuple(sweeps), stamps, found, _lidars(folder), annotations, _map(folder))


def _lidars(folder: Path) -> dict[str, NDArray[np.float64]]:
    files = sorted(folder.glob("calibration*/egovehicle_SE3_sensor.feather"))  # the log's own calibration comes first
    if not files:
        return {}
    file = files[0]
    table = _table(file, ("sensor_name", *_POSITION))
    positions = table.numbers(_POSITION)
    if not np.isfinite(positions).all():
        raise OgmError(f"{file} has sensors without finite position: use the calibration of another log")
    return dict(zip(map(str, table.columns["sensor_name"]), positions, strict=True))


def _map(folder: Path) -> Argoverse2Map | None:
    found = [sorted(folder.glob(f"map/{name}")) for name in _MAP_FILES]
    if not any(found):
        return None
    if any(len(files) != 1 for files in found):
        raise OgmError(
            f"{folder}/map must have one file of each {', '.join(_MAP_FILES)}, found "
            f"{', '.join(str(len(files)) for files in found)}: complete it, or remove the folder to read without a map"
        )
    (plan,), (heights,), (placing,) = found
    drivable = need(read_json(plan, dict, "a map of Argoverse 2"), "drivable_areas", plan, dict)
    areas = []
    for name, area in drivable.items():
        where = f"drivable area {name} of {plan}"
        boundary = need(area, "area_boundary", where, list)
        corners = [[need(p, axis, where) for axis in "xyz"] for p in boundary]
        areas.append(numbers(corners, (len(corners), 3), where))
    data, _ = read_bytes(heights)
    raster = parse_array(data, heights, lambda shape: len(shape) == 2 and min(shape) > 0, "heights (rows, columns)")
    position = read_json(placing, dict, "the position of the raster in the city: R, t, s")
    shapes: dict[str, int | tuple[int, ...]] = {"R": 4, "t": 2, "s": ()}
    rotation, shift, scale = (need_numbers(position, key, shape, placing) for key, shape in shapes.items())
    with np.errstate(invalid="ignore"):  # unknown heights are NaN, also signalling
        raster = raster.astype(np.float64)
    return Argoverse2Map(tuple(areas), raster, rotation.reshape(2, 2), shift, float(scale))


_MAP_FILES = ("log_map_archive_*.json", "*_ground_height_surface_*.npy", "*___img_Sim2_city.json")


class _Table(NamedTuple):
    """Columns of a Feather table."""

    path: Path
    columns: Mapping[str, NDArray[Any]]

    def numbers(self, names: Sequence[str]) -> NDArray[np.float64]:
        """Return numeric columns as an array, (K, C)."""
        if wrong := [name for name in names if self.columns[name].dtype.kind not in "iuf"]:
            got = self.columns[wrong[0]].dtype
            raise OgmError(f"{', '.join(wrong)} of {self.path} must be columns of numbers, got {got}")
        return np.column_stack([self.columns[name] for name in names]).astype(np.float64)

    def poses(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the transforms of some rows, (K, 4, 4)."""
        positions, quaternions = self.numbers(_POSITION)[rows], self.numbers(_QUATERNION)[rows]
        return from_quaternions(positions, quaternions, lambda k: f"row {rows[k]} of {self.path}")


def _table(path: Path, columns: Sequence[str]) -> _Table:
    """Read some columns of a Feather table."""
    data = read_bytes(path)[0]
    found, schema = read_columns(data, path, lambda table: [k for k, name in enumerate(table.names) if name in columns])
    if missing := [name for name in columns if name not in found]:
        raise OgmError(f"{path} has no column {', '.join(missing)}, only {', '.join(schema.names)[:200]}")
    if "timestamp_ns" in found and found["timestamp_ns"].dtype.kind not in "iu":
        raise OgmError(f"all timestamp_ns of {path} must be integers [ns], got {found['timestamp_ns'].dtype}")
    return _Table(path, found)
