"""nuScenes: key frames with boxes and poses, from its own tables or from mmdetection3d's info (as JSON)."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.files import OgmError
from ogm.io.axes import rotation_to_flu
from ogm.io.labels import BoxRow, boxes_of
from ogm.io.reading import from_quaternions, need, numbers, read_json, rigid
from ogm.pose import inverse
from ogm.scan import Boxes

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
    annotations: tuple[Mapping[str, Any], ...]  # as the file has them; `NuScenes.boxes` makes boxes of them


@dataclass(frozen=True)
class NuScenes:
    """Key frames of nuScenes, and their boxes.

    Parameters
    ----------
    frames : tuple of NuScenesFrame
        By scene, then by time.
    annotated : bool
        Whether there are boxes: the test part has none, its table of them is empty.
    labels : mapping of str to str
        Category of each object, by its ``instance_token``. Empty for mmdetection3d's info.
    """

    frames: tuple[NuScenesFrame, ...]
    annotated: bool
    labels: Mapping[str, str]

    def boxes(self, n: int) -> Boxes:
        """Return the boxes of frame n, in the sensor's frame."""
        frame = self.frames[n]
        rows = _mmdet3d_boxes if frame.annotations and "bbox_3d" in frame.annotations[0] else self._rows
        return boxes_of(rows(frame), f"key frame {frame.name}")

    def _rows(self, frame: NuScenesFrame) -> list[BoxRow]:
        T_sensor_map = inverse(frame.T_map_sensor)
        rows = []
        for note in frame.annotations:
            where = f"an annotation of key frame {frame.name}"
            width, length, height = numbers(need(note, "size", where), 3, f"size of {where}")
            T = T_sensor_map @ _pose(note, where)
            yaw = np.arctan2(T[1, 0], T[0, 0])
            track = str(need(note, "instance_token", where))
            if track not in self.labels:
                raise OgmError(f"instance {track} of {where} is in no table of instances: is it complete?")
            rows.append(BoxRow(T[:3, 3], [length, width, height], yaw, self.labels[track], track))
        return rows


def read_nuscenes(path: str | os.PathLike[str]) -> NuScenes:
    """Read the tables of nuScenes.

    Parameters
    ----------
    path : path
        The folder of the data set, with ``samples/`` and one ``v1.0-...`` in it; or that ``v1.0-...`` folder,
        where there are several.

    Returns
    -------
    NuScenes
        All key frames of the lidar whose points are there. No point is read, and boxes are made when asked
        for.

    Raises
    ------
    FileNotFoundError
        If a table is not there.
    OgmError
        If there are several versions, a table is of another kind, or a row refers to what is not there.
    """
    folder = Path(path)
    if not folder.name.startswith("v1."):
        versions = sorted(one for one in folder.glob("v1.*-*") if one.is_dir())
        if len(versions) != 1:
            found = ", ".join(one.name for one in versions) or "none"
            raise OgmError(
                f"{folder} must have one folder of tables (v1.0-...), found {found}: give that folder"
            )
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
        if file.is_file():
            scene = str(_look_up(tables, "scene", sample, "sample").get("name", ""))
            stamp = (
                float(numbers(need(row, "timestamp", "a row of sample_data.json"), (), "timestamp")) * 1e-6
            )
            T_map_vehicle = _pose(_look_up(tables, "ego_pose", row, "sample_data"), "a row of ego_pose.json")
            T_vehicle_sensor = _pose(mounting, "a row of calibrated_sensor.json")
            token = str(row["sample_token"])
            T = T_map_vehicle @ T_vehicle_sensor @ _T_FLU_LIDAR.T
            kept = tuple(notes.get(token, ()))
            frames.append(
                NuScenesFrame(scene, file.name, file, stamp, T, float(T_vehicle_sensor[2, 3]), kept)
            )
    if not frames:
        raise OgmError(f"{folder} names no key frame of {_LIDAR} whose points are under {folder.parent}")
    return NuScenes(tuple(sorted(frames, key=lambda one: (one.scene, one.stamp))), annotated, labels)


def read_mmdet3d(path: str | os.PathLike[str]) -> NuScenes:
    """Read key frames from an info file of mmdetection3d, version 1.1, written as JSON.

    Parameters
    ----------
    path : path
        ``metainfo`` and ``data_list`` (or ``frame``, if it is one). The original is pickled, which is not read
        here: a pickle can run any program.

    Returns
    -------
    NuScenes
        The points are looked for beside the file. Objects have no tracks, and the log stands for the scene.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If it is another data set's, or an entry lacks something.
    """
    path = Path(path)
    if path.suffix == ".pkl":
        raise OgmError(f"{path} is pickled, and nothing is unpickled here: write it as JSON first")
    content = read_json(path, dict, "mmdetection3d's info: metainfo, data_list")
    about = need(content, "metainfo", str(path))
    if str(need(about, "dataset", f"metainfo of {path}")).lower() != "nuscenes":
        raise OgmError(f"{path} is of {about['dataset']}, wanted nuscenes")
    categories = need(about, "categories", f"metainfo of {path}", dict)
    names = {number: str(name) for name, number in categories.items() if isinstance(number, int)}
    entries = [content["frame"]] if "frame" in content else need(content, "data_list", str(path), list)
    frames = []
    for n, entry in enumerate(entries):
        where = f"frame {n} of {path}"
        lidar = need(entry, "lidar_points", where)
        file = path.parent / Path(str(need(lidar, "lidar_path", where))).name
        T_vehicle_sensor = _matrix(lidar, "lidar2ego", where)
        T = _matrix(entry, "ego2global", where) @ T_vehicle_sensor @ _T_FLU_LIDAR.T
        notes = tuple(
            {"bbox_3d": need(note, "bbox_3d", f"an object of {where}"), **note, "name": _named(note, names)}
            for note in need(entry, "instances", where, list)
        )
        stamp = float(numbers(need(entry, "timestamp", where), (), f"timestamp of {where}"))
        frames.append(
            NuScenesFrame(
                file.name.split("__")[0], file.name, file, stamp, T, float(T_vehicle_sensor[2, 3]), notes
            )
        )
    return NuScenes(tuple(sorted(frames, key=lambda one: (one.scene, one.stamp))), True, {})


def _named(note: Mapping[str, Any], names: Mapping[int, str]) -> str:
    number = note.get("bbox_label_3d")
    return names.get(number, "other") if isinstance(number, int) else "other"


def _mmdet3d_boxes(frame: NuScenesFrame) -> list[BoxRow]:
    """Return the boxes of bbox_3d, which is in the lidar's frame: x right, y forward, z up, about the center."""
    rows = []
    for n, note in enumerate(frame.annotations):
        where = f"object {n} of key frame {frame.name}"
        box = numbers(need(note, "bbox_3d", where), 7, f"bbox_3d of {where}")
        rows.append(BoxRow(_T_FLU_LIDAR[:3, :3] @ box[:3], box[3:6], box[6] - np.pi / 2, note["name"]))
    return rows


def _table(folder: Path, name: str) -> dict[str, dict[str, Any]]:
    path = folder / f"{name}.json"
    rows = read_json(path, list, f"the table {name} of nuScenes: a list of rows with tokens")
    return {str(need(row, "token", f"row {n} of {path}")): row for n, row in enumerate(rows)}


def _inside(folder: Path, name: str) -> Path:
    """Return a file of the data set by the name that a table gives it."""
    if Path(name).is_absolute() or ".." in Path(name).parts:
        raise OgmError(
            f"sample_data.json names the file {name[:200]!r}, wanted one under {folder}, such as "
            "samples/LIDAR_TOP/...: tables of nuScenes name no other, so do not trust these"
        )
    return folder / name


def _look_up(
    tables: Mapping[str, Mapping[str, dict[str, Any]]], name: str, row: Mapping[str, Any], of: str
) -> dict[str, Any]:
    """Follow a row's reference to another table."""
    token = str(need(row, f"{name}_token", f"a row of {of}.json"))
    if token not in tables[name]:
        raise OgmError(
            f"{of}.json refers to {name} {token}, which {name}.json does not have: are they of one version?"
        )
    return tables[name][token]


def _pose(row: Mapping[str, Any], where: str) -> NDArray[np.float64]:
    """Read a translation and a quaternion with w first."""
    w, x, y, z = numbers(need(row, "rotation", where), 4, f"rotation of {where}")
    position = numbers(need(row, "translation", where), 3, f"translation of {where}")
    return from_quaternions(position[None], np.array([[x, y, z, w]]), lambda _: where)[0]


def _matrix(entry: Mapping[str, Any], key: str, where: str) -> NDArray[np.float64]:
    return rigid(numbers(need(entry, key, where), (4, 4), f"{key} of {where}"), f"{key} of {where}")


_T_FLU_LIDAR = np.eye(4)
_T_FLU_LIDAR[:3, :3] = rotation_to_flu("nuscenes")
