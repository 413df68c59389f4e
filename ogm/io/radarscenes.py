"""RadarScenes: detections of four radars and the vehicle's odometry, in HDF5 and JSON.

>>> from ogm.io.radarscenes import read_radarscenes
>>> sequence = read_radarscenes("RadarScenes/data/sequence_1")              # doctest: +SKIP
"""

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.io.formats.table import Table
from ogm.io.reading import need, need_numbers, optional, read_json
from ogm.io.scan_table import scan_from_table
from ogm.pose import pose
from ogm.scan import Scan
from ogm.storage.files import FilePath, OgmError
from ogm.storage.limits import current_limits, too_large

__all__ = ["RadarScenes", "RadarScenesSweep", "read_radarscenes"]

_DATA, _SCENES, _SENSORS = "radar_data.h5", "scenes.json", "sensors.json"
_DETECTIONS = {"timestamp": "iu", "sensor_id": "iu", **dict.fromkeys(("range_sc", "azimuth_sc", "rcs", "vr"), "f")}
_ODOMETRY = {"timestamp": "iu", **dict.fromkeys(("x_seq", "y_seq", "yaw_seq"), "f")}


class RadarScenesSweep(NamedTuple):
    """One sweep of one radar."""

    sensor: str  # "radar_1" to "radar_4", the name in sensors.json
    timestamp: int  # [us]
    origin: tuple[float, float]  # x, y of the sensor in the vehicle frame, from the middle of the rear axle [m]
    yaw: float  # of the sensor in the vehicle frame [rad]
    T_map_sensor: NDArray[np.float64] | None  # (4, 4), z is 0; None before and after the odometry
    rows: slice  # of its detections in radar_data


class RadarScenes(NamedTuple):
    """A sequence of RadarScenes."""

    path: Path
    name: str  # of its folder
    sweeps: tuple[RadarScenesSweep, ...]  # of all radars, by time

    def scan(self, n: int) -> Scan:
        """Return the detections of sweep n, in its sensor's frame.

        `Scan.doppler` is ``vr``, relative to the sensor, and `Scan.rcs` in dBsm. z and intensities are 0, as there is
        no elevation and no amplitude. The detections of the last two sequences stay in memory.

        Raises
        ------
        FileNotFoundError
            If ``radar_data.h5`` is missing.
        OgmError
            If it is damaged, or lacks detections that ``scenes.json`` refers to.
        """
        sweep = self.sweeps[n]
        path = self.path / _DATA
        table = _detections(path, path.stat().st_mtime_ns if path.is_file() else 0)
        where = f"sweep {sweep.timestamp} of {path}"
        if sweep.rows.stop > len(table):
            raise OgmError(
                f"{path} has {len(table)} detections, too few for rows {sweep.rows.start} to {sweep.rows.stop} of "
                f"sweep {sweep.timestamp}: use {_SCENES} and {_DATA} of one sequence"
            )
        rows = table[sweep.rows]
        if (rows["sensor_id"] != int(sweep.sensor.removeprefix("radar_"))).any():
            raise OgmError(f"{where} has detections of another sensor, wanted only {sweep.sensor}")
        distance, azimuth = rows["range_sc"].astype(np.float64), rows["azimuth_sc"].astype(np.float64)
        if (distance < 0).any():
            raise OgmError(f"{where} must have ranges of 0 m or more, got {distance.min():.3g} m: restore the file")
        with np.errstate(invalid="ignore", over="ignore"):
            x, y = distance * np.cos(azimuth), distance * np.sin(azimuth)
        columns = {"x": x, "y": y, "z": np.zeros(len(x)), "doppler": rows["vr"], "rcs": rows["rcs"]}
        detections = Table("RadarScenes", columns, fields=tuple(_DETECTIONS))
        scan, _ = scan_from_table(detections, where, stamp=sweep.timestamp * 1e-6)
        return replace(scan, sensor=sweep.sensor)


def read_radarscenes(path: FilePath) -> RadarScenes:
    """Read the sweeps of a sequence of RadarScenes: sensor, time, pose and rows of detections.

    The layout follows the dataset's documentation and tools. It was tested on synthetic files, because recorded
    files may not be shipped.

    Parameters
    ----------
    path : path
        Folder ``sequence_N`` with ``radar_data.h5`` and ``scenes.json``; ``sensors.json`` lies in its parent folder, or
        in the folder itself.

    Returns
    -------
    RadarScenes
        Detections are read on request. Poses are interpolated from the odometry at the time of the sweep; sweeps before
        its first or after its last pose (about 0.1 s at the end of each sequence) have no pose.

    Raises
    ------
    FileNotFoundError
        If a file is missing.
    OgmError
        If a file is damaged, belongs to another dataset, or exceeds the limits.
    ImportError
        If h5py is missing.
    """
    folder = Path(path)
    mounts = _mounts(folder)
    content = read_json(folder / _SCENES, dict, "the scenes of a sequence of RadarScenes")
    scenes = need(content, "scenes", folder / _SCENES, dict)
    rows, stamps = [], np.zeros(len(scenes))
    for n, (key, scene) in enumerate(scenes.items()):
        where = f"scene {str(key)[:40]!r} of {folder / _SCENES}"
        if not re.fullmatch("0|[1-9][0-9]{0,16}", key):
            raise OgmError(f"{where} must be named by its time in microseconds")
        first, last = need_numbers(scene, "radar_indices", 2, where).tolist()
        if not (0 <= first <= last < 2**53 and first == int(first) and last == int(last)):
            raise OgmError(f"radar_indices of {where} must be the first row and the end row, got {first}, {last}")
        sensor = f"radar_{need(scene, 'sensor_id', where)}"
        if sensor not in mounts:
            raise OgmError(f"{where} has the sensor {sensor[:40]}, which is not in {_SENSORS}: {', '.join(mounts)}")
        rows.append((int(key), sensor, slice(int(first), int(last))))
        stamps[n] = int(key)
    x, y, yaw = _vehicle(folder / _DATA, stamps)
    sweeps = []
    for n in np.argsort(stamps, kind="stable").tolist():
        stamp, sensor, part = rows[n]
        ahead, left, turn = mounts[sensor]
        placed = pose(x[n], y[n], yaw=yaw[n]) @ pose(ahead, left, yaw=turn) if np.isfinite(x[n]) else None
        sweeps.append(RadarScenesSweep(sensor, stamp, (ahead, left), turn, placed, part))
    if not sweeps:
        raise OgmError(f"{folder / _SCENES} has no scenes, wanted the scenes of a sequence")
    return RadarScenes(folder, folder.resolve().name, tuple(sweeps))


def _mounts(folder: Path) -> dict[str, tuple[float, float, float]]:
    """Return x, y [m] and yaw [rad] of the sensors in the vehicle frame, by name."""
    beside = folder.resolve().parent / _SENSORS
    path = folder / _SENSORS if (folder / _SENSORS).is_file() else beside
    content = read_json(path, dict, "the radars of RadarScenes and their mounting")
    mounts = {}
    for name, entry in content.items():
        if re.fullmatch("radar_[0-9]{1,3}", name):
            x, y, yaw = (float(need_numbers(entry, key, (), f"{name} of {path}")) for key in ("x", "y", "yaw"))
            if max(abs(x), abs(y), abs(yaw)) > 100:
                raise OgmError(f"{name} of {path} must be on the vehicle [m, rad], got x {x:g}, y {y:g}, yaw {yaw:g}")
            mounts[name] = x, y, yaw
    if not mounts:
        raise OgmError(f"{path} has no radar_1, radar_2, ...: give the file of RadarScenes")
    return mounts


def _vehicle(path: Path, stamps: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Return x, y [m] and yaw [rad] of the vehicle at the given times [us]; NaN outside of the odometry."""
    table = read_hdf5_table(path, "odometry", _ODOMETRY)
    time = table["timestamp"].astype(np.float64)
    values = [table[name].astype(np.float64) for name in ("x_seq", "y_seq", "yaw_seq")]
    if not len(table) or not (np.diff(time) > 0).all():
        raise OgmError(f"the odometry of {path} must have increasing timestamps, got {len(table)} rows: restore it")
    if not np.isfinite(values).all() or np.abs(values).max() > 1e9:
        raise OgmError(f"the odometry of {path} must be finite and below 1e9 m: restore the file")
    x, y, yaw = values[0], values[1], np.unwrap(values[2])
    return tuple(np.interp(stamps, time, values, left=math.nan, right=math.nan) for values in (x, y, yaw))


@lru_cache(2)
def _detections(path: Path, changed: int) -> NDArray[Any]:
    """Return the detections of a sequence, about 20 MB; `changed` is the file's time, so that a new file is read."""
    return read_hdf5_table(path, "radar_data", _DETECTIONS)


_DEFLATE, _SHUFFLE, _FLETCHER, _LZF = 1, 2, 3, 32000  # filter numbers of HDF5
_EXPANSION = 1032  # largest expansion of deflate; LZF expands less
_WAY_OUT = "rewrite the file, such as by h5repack -f GZIP=4"


def read_hdf5_table(path: Path, name: str, wanted: Mapping[str, str]) -> NDArray[Any]:
    """Return some columns of a table, a one-dimensional HDF5 dataset of a compound type.

    Parameters
    ----------
    path : Path
    name : str
        Name of the dataset, in the root group.
    wanted : dict
        Column names with their permitted kinds of numbers, of ``"i"``, ``"u"`` and ``"f"``.

    Returns
    -------
    (N,) structured array
        Only the wanted columns.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If it is no HDF5 file, is damaged, has no such table, or unpacks beyond the limit `file`. Refused are links,
        virtual datasets and external storage, which can name other files, and all filters except deflate, LZF, shuffle
        and Fletcher-32.
    ImportError
        If h5py is missing.
    """
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}: check the name and the folder")
    h5py = optional("h5py", path)
    try:
        with h5py.File(path, "r") as file:
            if file.get(name, getclass=True, getlink=True) is not h5py.HardLink:
                found = ", ".join(list(file)[:9]) or "nothing"
                raise OgmError(f"{path} has no dataset {name} of its own, only {found}")
            data = file[name]
            where = f"{name} of {path}"
            if not isinstance(data, h5py.Dataset) or data.ndim != 1 or data.dtype.names is None:
                raise OgmError(f"{where} must be a table with the columns {', '.join(wanted)}")
            _check_columns(data.dtype, wanted, where)
            _check_storage(data, where)
            size = len(data) * sum(data.dtype[column].itemsize for column in wanted)
            if size > current_limits().file:
                raise too_large(where, size, "file")
            rows: NDArray[Any] = data.fields(list(wanted))[...]
            return rows
    except OgmError:
        raise
    except (OSError, RuntimeError, LookupError, ValueError, TypeError, ArithmeticError, AttributeError) as error:
        raise OgmError(f"{path} cannot be read by HDF5 ({error}): it is cut short, damaged, or no HDF5 file") from error


def _check_columns(dtype: np.dtype[Any], wanted: Mapping[str, str], where: str) -> None:
    """Refuse a table that lacks a column, or has a column of another kind."""
    names = dtype.names or ()
    if missing := [name for name in wanted if name not in names]:
        raise OgmError(f"{where} has no {', '.join(missing)}, only {', '.join(names)[:200]}")
    for name, kinds in wanted.items():
        if dtype[name].kind not in kinds or dtype[name].itemsize > 8:
            raise OgmError(f"the column {name} of {where} must be numbers (of kind {kinds!r}), got {dtype[name]}")


def _check_storage(data: Any, where: str) -> None:
    """Refuse a dataset that is stored in other files, or has chunks that may unpack beyond the limit."""
    made = data.id.get_create_plist()
    if data.is_virtual or made.get_external_count():
        raise OgmError(f"{where} is stored in other files, which are not opened: copy it into one file")
    if data.chunks is None:
        return
    filters = [made.get_filter(k)[0] for k in range(made.get_nfilters())]
    if not set(filters) <= {_DEFLATE, _SHUFFLE, _FLETCHER, _LZF} or len(set(filters)) < len(filters):
        raise OgmError(f"{where} is packed by the filters {filters}, known are deflate, LZF and shuffle: {_WAY_OUT}")
    limit = current_limits().file
    size = math.prod(data.chunks) * data.dtype.itemsize
    if _LZF in filters:
        size = max(size, *made.get_filter_by_id(_LZF)[1][2:3])  # initial memory of the decoder
    if {_DEFLATE, _LZF} & set(filters):
        stored = [0]
        data.id.chunk_iter(lambda chunk: stored.__setitem__(0, max(stored[0], chunk.size)))
        if stored[0] * _EXPANSION > limit:
            raise too_large(f"a chunk of {where}", max(size, stored[0] * _EXPANSION), "file")
    if size > limit:
        raise too_large(f"a chunk of {where}", size, "file")
