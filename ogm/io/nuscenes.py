"""nuScenes: key frames with boxes and poses, from its tables or from an info file of mmdetection3d (as JSON).

>>> from ogm.io.nuscenes import read_nuscenes
>>> frames = read_nuscenes("nuscenes/v1.0-mini").frames                     # doctest: +SKIP
>>> boxes = frames[0].read_boxes()                                          # doctest: +SKIP
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.io.labels import BoxRow, boxes_of
from ogm.io.reading import from_quaternions, is_file_name, need, need_numbers, read_json, rigid
from ogm.io.scan_table import rotation_to_flu
from ogm.pose import inverse
from ogm.scan import Boxes
from ogm.storage.files import FilePath, OgmError

__all__ = ["NuScenes", "NuScenesFrame", "read_mmdet3d", "read_nuscenes"]

_LIDAR = "LIDAR_TOP"
_TABLES = ("scene", "sample", "sample_data", "ego_pose", "calibrated_sensor", "sensor")
_NOTES = ("sample_annotation", "instance", "category")


class NuScenesFrame(NamedTuple):
    """One key frame of the lidar."""

    scene: str
    name: str
    path: Path  # of the points
    stamp: float  # [s] since 1970
    T_map_sensor: NDArray[np.float64]  # (4, 4); the sensor's frame has x forward, y left, z up
    height: float  # [m] of the sensor above the vehicle's origin, which lies on the road
    read_boxes: Callable[[], Boxes]  # in the sensor's frame


class NuScenes(NamedTuple):
    """Key frames of nuScenes, by scene, then by time."""

    frames: tuple[NuScenesFrame, ...]
    annotated: bool  # whether there are boxes; in the test part the table is empty

    def boxes(self, n: int) -> Boxes:
        """Return the boxes of frame n, in the sensor's frame."""
        return self.frames[n].read_boxes()


def read_nuscenes(path: FilePath) -> NuScenes:
    """Read the tables of nuScenes.

    Parameters
    ----------
    path : path
        Folder of the dataset, with ``samples/`` and one ``v1.0-...`` folder; or this ``v1.0-...`` folder if there are
        several.

    Returns
    -------
    NuScenes
        Lidar key frames with existing point files. Points are not read, and boxes are built on request.

    Raises
    ------
    FileNotFoundError
        If a table is missing.
    OgmError
        If there are several versions, a table has another layout, or a row refers to a missing row.
    """
    folder = Path(path)
    if not folder.name.startswith("v1."):
        versions = sorted(version for version in folder.glob("v1.*-*") if version.is_dir())
        if len(versions) != 1:
            found = ", ".join(version.name for version in versions) or "none"
            raise OgmError(f"{folder} must have one folder of tables (v1.0-...), found {found}: give that folder")
        folder = versions[0]
    noted = (folder / "sample_annotation.json").is_file()
    tables = {name: _table(folder, name) for name in (*_TABLES, *(_NOTES if noted else ()))}
    annotated = bool(tables.get("sample_annotation"))
    notes: dict[str, list[dict[str, Any]]] = {}
    for row in tables.get("sample_annotation", {}).values():
        notes.setdefault(str(need(row, "sample_token", "a row of sample_annotation.json")), []).append(row)
    labels = {
        token: str(need(_look_up(tables, "category", row, "instance"), "name", "a row of category.json"))
        for token, row in tables.get("instance", {}).items()
    }
    frames = []
    for row in tables["sample_data"].values():
        if not row.get("is_key_frame"):
            continue
        mounting = _look_up(tables, "calibrated_sensor", row, "sample_data")
        if _look_up(tables, "sensor", mounting, "calibrated_sensor").get("channel") != _LIDAR:
            continue
        sample = _look_up(tables, "sample", row, "sample_data")
        file = _inside(folder.parent, str(need(row, "filename", "a row of sample_data.json")))
        if not file.is_file():
            continue
        T_vehicle_sensor = _pose(mounting, "a row of calibrated_sensor.json")
        T_map_vehicle = _pose(_look_up(tables, "ego_pose", row, "sample_data"), "a row of ego_pose.json")
        scene = str(_look_up(tables, "scene", sample, "sample").get("name", ""))
        stamp = float(need_numbers(row, "timestamp", (), "a row of sample_data.json")) * 1e-6
        placed, height = T_map_vehicle @ T_vehicle_sensor @ _T_FLU_LIDAR.T, float(T_vehicle_sensor[2, 3])
        boxes = partial(_boxes, notes.get(str(row["sample_token"]), []), labels, placed, file.name)
        frames.append(NuScenesFrame(scene, file.name, file, stamp, placed, height, boxes))
    if not frames:
        raise OgmError(f"{folder} names no key frame of {_LIDAR} with points under {folder.parent}: check the folder")
    return NuScenes(_in_order(frames), annotated)


def _boxes(
    notes: Sequence[dict[str, Any]], labels: Mapping[str, str], T_map_sensor: NDArray[np.float64], name: str
) -> Boxes:
    """Return the boxes of a key frame, from its rows of sample_annotation."""
    where = f"an annotation of key frame {name}"
    rows, T_sensor_map = [], inverse(T_map_sensor)
    for note in notes:
        width, length, height = need_numbers(note, "size", 3, where)
        T = T_sensor_map @ _pose(note, where)
        track = str(need(note, "instance_token", where))
        if track not in labels:
            raise OgmError(f"instance {track} of {where} is in no table of instances: the tables are incomplete")
        yaw = np.arctan2(T[1, 0], T[0, 0])
        rows.append(BoxRow(T[:3, 3], [length, width, height], yaw, labels[track], track))
    return boxes_of(rows, f"key frame {name}")


def read_mmdet3d(path: FilePath) -> NuScenes:
    """Read key frames from an info file of mmdetection3d, version 1.1, converted to JSON.

    Parameters
    ----------
    path : path
        JSON with ``metainfo`` and ``data_list`` (or a single ``frame``). The original pickle is refused, because a
        pickle can run any program.

    Returns
    -------
    NuScenes
        Key frames; the point files must lie in the same folder. Boxes have no tracks, and the log is the scene.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If it describes another dataset, or an entry is incomplete.
    """
    path = Path(path)
    if path.suffix == ".pkl":
        raise OgmError(f"{path} is pickled, and pickles are not read: convert it to JSON first")
    content = read_json(path, dict, "mmdetection3d's info: metainfo, data_list", "tables")
    about = need(content, "metainfo", path)
    if str(need(about, "dataset", f"metainfo of {path}")).lower() != "nuscenes":
        raise OgmError(f"{path} describes the dataset {about['dataset']}, wanted nuscenes")
    categories = need(about, "categories", f"metainfo of {path}", dict)
    labels = {number: str(label) for label, number in categories.items() if isinstance(number, int)}
    entries = [content["frame"]] if "frame" in content else need(content, "data_list", path, list)
    frames = []
    for n, entry in enumerate(entries):
        where = f"frame {n} of {path}"
        lidar = need(entry, "lidar_points", where)
        file = _inside(path.parent, Path(str(need(lidar, "lidar_path", where))).name, where)
        T_vehicle_sensor = rigid(need_numbers(lidar, "lidar2ego", (4, 4), where), f"lidar2ego of {where}")
        T_map_vehicle = rigid(need_numbers(entry, "ego2global", (4, 4), where), f"ego2global of {where}")
        notes = need(entry, "instances", where, list)
        for note in notes:
            need(note, "bbox_3d", f"an object of {where}")
        scene, stamp = file.name.split("__")[0], float(need_numbers(entry, "timestamp", (), where))
        placed, height = T_map_vehicle @ T_vehicle_sensor @ _T_FLU_LIDAR.T, float(T_vehicle_sensor[2, 3])
        boxes = partial(_mmdet3d_boxes, notes, labels, file.name)
        frames.append(NuScenesFrame(scene, file.name, file, stamp, placed, height, boxes))
    return NuScenes(_in_order(frames), True)


def _mmdet3d_boxes(notes: Sequence[dict[str, Any]], labels: Mapping[int, str], name: str) -> Boxes:
    """Return the boxes of bbox_3d, about the center, in the lidar's frame: x right, y forward, z up."""
    rows = []
    for n, note in enumerate(notes):
        box = need_numbers(note, "bbox_3d", 7, f"object {n} of key frame {name}")
        number = note.get("bbox_label_3d")
        label = labels.get(number, "other") if isinstance(number, int) else "other"
        rows.append(BoxRow(_T_FLU_LIDAR[:3, :3] @ box[:3], box[3:6], box[6] - np.pi / 2, label))
    return boxes_of(rows, f"key frame {name}")


def _in_order(frames: list[NuScenesFrame]) -> tuple[NuScenesFrame, ...]:
    return tuple(sorted(frames, key=lambda frame: (frame.scene, frame.stamp)))


def _table(folder: Path, name: str) -> dict[str, dict[str, Any]]:
    path = folder / f"{name}.json"
    rows = read_json(path, list, f"the table {name} of nuScenes: a list of rows with tokens", "tables")
    return {str(need(row, "token", f"row {n} of {path}")): row for n, row in enumerate(rows)}


def _inside(folder: Path, name: str, where: str = "sample_data.json") -> Path:
    """Return a file of the dataset by its name in a table."""
    if Path(name).is_absolute() or ".." in Path(name).parts or not is_file_name(name):
        wanted = f"wanted a file under {folder}, such as samples/LIDAR_TOP/..."
        raise OgmError(f"{where} names the file {name[:200]!r}, {wanted}: do not trust these tables")
    return folder / name


def _look_up(
    tables: Mapping[str, Mapping[str, dict[str, Any]]], name: str, row: Mapping[str, Any], of: str
) -> dict[str, Any]:
    """Follow a row's reference to another table."""
    token = str(need(row, f"{name}_token", f"a row of {of}.json"))
    if token not in tables[name]:
        raise OgmError(f"{of}.json refers to {name} {token}, which {name}.json lacks: use tables of one version")
    return tables[name][token]


def _pose(row: Mapping[str, Any], where: str) -> NDArray[np.float64]:
    """Read a translation and a quaternion with w first."""
    quaternion = need_numbers(row, "rotation", 4, where)[[1, 2, 3, 0]]
    position = need_numbers(row, "translation", 3, where)
    return np.asarray(from_quaternions(position[None], quaternion[None], lambda _: where)[0])


_T_FLU_LIDAR = np.eye(4)
_T_FLU_LIDAR[:3, :3] = rotation_to_flu("nuscenes")
