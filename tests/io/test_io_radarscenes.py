"""Sequences of RadarScenes, made here by its documentation: sweeps, frames, and files that are refused."""

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import each, refused
from radarscenes_files import MOUNTS, START, detections, odometry, write_sequence

from ogm.datasets import open_dataset
from ogm.geometric import RadarISM, sensor_velocity
from ogm.grid import GridSpec
from ogm.io.radarscenes import read_radarscenes
from ogm.pose import transform_points
from ogm.storage.files import OgmError
from ogm.storage.limits import set_limits

h5py = pytest.importorskip("h5py")


@pytest.fixture
def sequence(tmp_path: Path) -> Path:
    return write_sequence(tmp_path / "data")


def test_frames_lie_where_the_data_set_places_their_detections(sequence: Path) -> None:
    rows, _ = detections()
    data = open_dataset(sequence)
    assert len(data) == 8
    assert [frame.scan.sensor for frame in data[:5]] == ["radar_1", "radar_2", "radar_3", "radar_4", "radar_1"]
    for n, frame in enumerate(data):
        own = rows[6 * n : 6 * n + 6]
        vehicle = transform_points(frame.mount.T_vehicle_sensor, frame.scan.points[:, :3])
        np.testing.assert_allclose(vehicle[:, :2], np.stack([own["x_cc"], own["y_cc"]], axis=-1), atol=1e-4)
        placed = transform_points(frame.T_map_sensor, frame.scan.points[:, :3])
        np.testing.assert_allclose(placed[:, :2], np.stack([own["x_seq"], own["y_seq"]], axis=-1), atol=2e-3)
        np.testing.assert_array_equal(frame.scan.doppler, own["vr"])
        np.testing.assert_array_equal(frame.scan.rcs, own["rcs"])
        assert frame.stamp == frame.scan.stamp == pytest.approx(START * 1e-6 + 0.017 * n)
        assert frame.boxes is None


def test_all_sensors_share_the_vehicle_frame(sequence: Path) -> None:
    data = open_dataset(sequence)
    vehicles = [frame.T_map_sensor @ np.linalg.inv(frame.mount.T_vehicle_sensor) for frame in data[:4]]
    assert all(np.abs(one[:2, 3] - vehicles[0][:2, 3]).max() < 0.3 for one in vehicles)  # it drives on by 0.26 m
    assert {frame.mount.sensor_height for frame in data} == {0.5}
    assert {frame.mount.sensor_height for frame in open_dataset(sequence, sensor_height=0.7)} == {0.7}
    assert len({frame.mount.ego_footprint for frame in data}) == 1


def test_doppler_is_against_the_sensor(sequence: Path) -> None:
    _, y, yaw = MOUNTS[2]
    velocity = sensor_velocity(open_dataset(sequence)[1].scan)
    expected = np.array([5.0 - 0.2 * y, 0.2 * 3.86])
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    np.testing.assert_allclose(velocity, turn @ expected, atol=0.01)


def test_sweeps_outside_the_odometry_have_no_pose(tmp_path: Path) -> None:
    frames = open_dataset(write_sequence(tmp_path, path=odometry(8)))  # ends after 50 ms
    assert [frame.T_map_sensor is not None for frame in frames] == [True] * 3 + [False] * 5


def test_radars_make_no_truth(sequence: Path) -> None:
    data = open_dataset(sequence)
    assert data.description == ""
    with pytest.raises(OgmError, match="moving detections"):
        data[0].truth  # noqa: B018


def test_several_sequences_open_as_one(tmp_path: Path) -> None:
    write_sequence(tmp_path / "data").rename(tmp_path / "data" / "sequence_10")
    (tmp_path / "data" / "sensors.json").unlink()
    write_sequence(tmp_path / "data", sweeps=3)
    for path in (tmp_path, tmp_path / "data"):
        data = open_dataset(path)
        assert len(data) == 11
        assert [len(frame.scan) for frame in data[2:4]] == [6, 6]
        assert len({frame.name for frame in data}) == 11


def test_a_frame_goes_through_the_sensor_model(sequence: Path) -> None:
    frame = open_dataset(sequence)[2]
    grid = RadarISM(GridSpec.centered(), frame.mount)(frame.scan)
    assert grid.mass.max() > 0


@each("storage", [{}, {"chunks": (7,)}, {"compression": "gzip", "shuffle": True, "fletcher32": True},
                                     {"compression": "lzf"}])  # fmt: skip
def test_storage_does_not_matter(storage: dict[str, Any], tmp_path: Path) -> None:
    scan = read_radarscenes(write_sequence(tmp_path, **storage)).scan(3)
    np.testing.assert_array_equal(scan.doppler, detections()[0]["vr"][18:24])


def test_a_missing_package_is_named_with_its_cure(sequence: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    refused(r'radar_data.h5.*h5py.*pip install .*\[io\]"', read_radarscenes, sequence, error=ImportError)


# ---- files that are refused


def _replaced(name: str, **options: Any) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        with h5py.File(path, "a") as file:
            old = file[name][...]
            del file[name]
            file.create_dataset(name, **{"data": old} | options)

    return change


def _linked(link: Any) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        with h5py.File(path, "a") as file:
            file.move("odometry", "other")
            file["odometry"] = link

    return change


def _virtual(path: Path) -> None:
    with h5py.File(path, "a") as file:
        layout = h5py.VirtualLayout((60,), file["odometry"].dtype)
        layout[:] = h5py.VirtualSource("elsewhere.h5", "odometry", (60,))
        del file["odometry"]
        file.create_virtual_dataset("odometry", layout)


def _external(path: Path) -> None:
    with h5py.File(path, "a") as file:
        dtype = file["odometry"].dtype
        del file["odometry"]
        file.create_dataset("odometry", (60,), dtype, external=[("/etc/passwd", 0, 60 * dtype.itemsize)])


def _unpacking(path: Path) -> None:
    """Pack a row of zeros twice, to some bytes."""
    with h5py.File(path, "a") as file:
        dtype, made = file["odometry"].dtype, h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        del file["odometry"]
        made.set_chunk((60,))
        made.set_deflate(9)
        made.set_deflate(9)
        h5py.h5d.create(file.id, b"odometry", h5py.h5t.py_create(dtype), h5py.h5s.create_simple((60,)), made)


_PATH = odometry()
_HOSTILE = {
    "text": (lambda path: path.write_bytes(b"not HDF5"), "cannot be read by HDF5"),
    "cut": (lambda path: path.write_bytes(path.read_bytes()[:3000]), "cannot be read by HDF5"),
    "soft link": (_linked(h5py.SoftLink("/other")), "no dataset odometry of its own"),
    "external link": (_linked(h5py.ExternalLink("elsewhere.h5", "odometry")), "no dataset odometry of its own"),
    "virtual": (_virtual, "is stored in other files"),
    "external storage": (_external, "is stored in other files"),
    "filters": (_unpacking, r"packed by the filters \[1, 1\]"),
    "no table": (_replaced("odometry", data=np.zeros(60)), "must be a table"),
    "no column": (_replaced("odometry", data=_PATH[["timestamp", "x_seq", "vx"]]), "has no y_seq, yaw_seq"),
    "text column": (_replaced("odometry", data=_PATH.astype([(n, "S9") for n in _PATH.dtype.names])), "kind 'iu'"),
    "back in time": (_replaced("odometry", data=_PATH[::-1]), "increasing timestamps"),
    "nowhere": (_replaced("odometry", data=_PATH[:0]), "got 0 rows"),
    "short": (_replaced("radar_data", data=detections()[0][:20]), "use scenes.json and radar_data.h5 of one sequence"),
    "others' rows": (_replaced("radar_data", data=detections()[0][::-1]), "of another sensor, wanted only radar_"),
}  # fmt: skip


@each("name", _HOSTILE)
def test_damaged_and_hostile_tables_are_refused(name: str, tmp_path: Path) -> None:
    change, message = _HOSTILE[name]
    sequence = write_sequence(tmp_path)
    change(sequence / "radar_data.h5")
    with pytest.raises(OgmError, match=message):
        [frame.scan for frame in open_dataset(sequence)]


@pytest.fixture
def limits() -> Iterator[None]:
    before = set_limits(file=2**24)
    yield
    set_limits(before)


@each("length, chunk", [(2**40, 100), (2**21, 2**21)])
def test_memory_is_bounded_before_it_is_taken(length: int, chunk: int, tmp_path: Path, limits: None) -> None:
    sequence = write_sequence(tmp_path)
    change = _replaced("odometry", shape=(length,), dtype=_PATH.dtype, data=None, chunks=(chunk,), maxshape=(None,))
    change(sequence / "radar_data.h5")
    refused("when decoded, wanted at most", read_radarscenes, sequence, error=OgmError)


def test_a_small_chunk_that_unpacks_beyond_the_limit_is_refused(tmp_path: Path, limits: None) -> None:
    sequence = write_sequence(tmp_path)
    with h5py.File(sequence / "radar_data.h5", "a") as file:
        del file["odometry"]
        file.create_dataset("odometry", (60,), _PATH.dtype, chunks=(60,), compression="gzip")
        file["odometry"].id.write_direct_chunk((0,), bytes(2**15))  # of so many bytes deflate can make 32 MB
    refused("a chunk of odometry", read_radarscenes, sequence, error=OgmError)


@each("change, message", [
        (lambda scene: scene.update(radar_indices=[6, 3]), "first row and the end row"),
        (lambda scene: scene.update(radar_indices=[0.5, 3]), "first row and the end row"),
        (lambda scene: scene.update(sensor_id=7), "radar_7, which is not in sensors.json"),
        (lambda scene: scene.pop("radar_indices"), "no 'radar_indices'"),
    ])  # fmt: skip
def test_scenes_that_are_none_are_refused(
    change: Callable[[dict[str, Any]], Any], message: str, tmp_path: Path
) -> None:
    sequence = write_sequence(tmp_path)
    content = json.loads((sequence / "scenes.json").read_text())
    change(content["scenes"][str(START)])
    (sequence / "scenes.json").write_text(json.dumps(content))
    refused(message, read_radarscenes, sequence, error=OgmError)


def test_a_missing_file_is_named(sequence: Path) -> None:
    (sequence.parent / "sensors.json").unlink()
    refused(r"sensors.json", read_radarscenes, sequence, error=FileNotFoundError)
