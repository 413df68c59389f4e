"""Labels of every data set: on tiny made-up files, on damaged ones, and on real recordings where they are."""

import json
import lzma
from dataclasses import replace

import numpy as np
import pytest
from cases import each, refused

from ogm.io import read_calibration, read_points, read_scan
from ogm.io.argoverse2 import read_argoverse2
from ogm.io.kitti import read_kitti_objects, read_kitti_stamps, read_kitti_tracks
from ogm.io.labels import BoxRow, LabelledPoints, boxes_of
from ogm.io.nuscenes import read_mmdet3d, read_nuscenes
from ogm.io.range_images import NUSCENES_ELEVEN, read_range_image
from ogm.io.semantic_kitti import SEMANTIC_KITTI, SEMANTIC_KITTI_MOVING, SEMANTIC_KITTI_TRAINING, read_semantic_kitti
from ogm.io.sustech import read_sustech
from ogm.storage.files import OgmError

TO_CAMERA = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
LINE = "Car 0 0 0 0 0 0 0 1.5 1.8 4.0 -3.0 1.7 10.0"  # height, width, length, x right, y down, z forward


def rows_of(boxes):
    """Return boxes as x, y, yaw, length, width, bottom, top."""
    return np.column_stack([boxes.center[:, :2], boxes.yaw, boxes.size[:, :2], boxes.bottom, boxes.top])


def turned(boxes):
    """Return boxes turned by a quarter about their centers."""
    return replace(boxes, yaw=boxes.yaw + np.pi / 2)


def upper_part(points, box, more=0.0):
    """Return which points lie in a box, or up to `more` [m] beside it, 0.3 m or more above its bottom."""
    x, y, yaw, length, width, bottom, top = box
    c, s, px, py = np.cos(yaw), np.sin(yaw), points[:, 0] - x, points[:, 1] - y
    beside = np.maximum(np.abs(c * px + s * py) - length / 2, np.abs(c * py - s * px) - width / 2)
    return (beside <= more) & (points[:, 2] > bottom + 0.3) & (points[:, 2] < top)


def share_inside(points, boxes, least=50):
    """Return how many of the points on and around boxes with enough of them lie inside."""
    inside = near = 0
    for box in rows_of(boxes):
        count = int(upper_part(points, box).sum())
        if count >= least:
            inside, near = inside + count, near + int(upper_part(points, box, 0.3).sum())
    return inside / near


# --- Boxes ------------------------------------------------------------------------------------------


GOOD = BoxRow([0, 0, 0.5], [1, 1, 1], 0.0, "a")


@each("change, message", [
        ({"yaw": np.nan}, r"a.txt: box 1 \(b\) must be finite"),
        ({"size": [0, 1, 1]}, "above 0 m"),
        ({"center": [1e300, 0, 0]}, r"a.txt: box 1 \(b\) must lie within 100000 m"),
        ({"size": [1, 2e5, 1]}, "within 100000 m"),
        ({"size": [1, np.inf, 1]}, "must be finite"),
        ({"size": [1, 1, 0]}, "height above 0 m"),
    ])  # fmt: skip
def test_impossible_boxes_are_refused(change, message):
    refused(message, boxes_of, [GOOD, GOOD._replace(label="b", **change)], "a.txt", error=OgmError)


def test_no_rows_are_no_boxes():
    assert len(boxes_of([], "a.txt")) == 0


def test_labelled_points_must_fit():
    points = np.zeros((3, 4), np.float32)
    found = LabelledPoints(points, np.array([0, 2, 0]), {0: "road", 1: "car", 2: "none"})
    assert found.named().tolist() == ["road", "none", "road"]
    with pytest.raises(OgmError, match=r"one class per point, got \(2,\) for 3"):
        LabelledPoints(points, np.zeros(2, np.int64), {0: "road"})
    with pytest.raises(OgmError, match="class 5, 7 is not one of the 1 known classes"):
        LabelledPoints(points, np.array([0, 5, 7]), {0: "road"})


# --- KITTI ------------------------------------------------------------------------------------------


@each("turn, yaw", [(-np.pi / 2, 0), (0, -np.pi / 2), (np.pi / 2, np.pi), (-np.pi / 2 - 0.3, 0.3)])
def test_kittis_boxes_turn_from_the_camera_to_the_lidar(tmp_path, turn, yaw):
    """A rotation_y of 0 points to the right: the camera's x."""
    path = tmp_path / "labels.txt"
    path.write_text(f"{LINE} {turn}\nDontCare -1 -1 -10 0 0 0 0 -1 -1 -1 -1000 -1000 -1000 -10\n\n{LINE} 0 0.9\n")
    found = read_kitti_objects(path, TO_CAMERA)
    assert found.label == ("Car", "Car")
    x, y, angle, *rest = rows_of(found)[0]
    assert (x, y) == pytest.approx((10, 3))
    assert np.exp(1j * angle) == pytest.approx(np.exp(1j * yaw))
    assert rest == pytest.approx([4.0, 1.8, -1.7, -0.2])


def test_kittis_tracks_go_by_scan(tmp_path):
    path = tmp_path / "0000.txt"
    path.write_text(f"3 7 {LINE} 0\n3 -1 DontCare{LINE[3:]} 0\n5 7 {LINE} 0 0.5\n5 8 Van{LINE[3:]} 0\n")
    found = read_kitti_tracks(path, TO_CAMERA)
    assert sorted(found) == [3, 5]
    assert found[3].track == ("7",)
    assert (found[5].track, found[5].label) == (("7", "8"), ("Car", "Van"))


def test_an_empty_file_of_labels_has_no_objects(tmp_path):
    (tmp_path / "labels.txt").touch()
    assert len(read_kitti_objects(tmp_path / "labels.txt", TO_CAMERA)) == 0
    assert read_kitti_tracks(tmp_path / "labels.txt", TO_CAMERA) == {}


@each("content, message", [
        (f"{LINE} 0\n{LINE}\n", "line 2 of .* has 14 columns, wanted 15 .*cut short"),
        (f"{LINE} 0 1 2\n", "line 1 of .* has 17 columns"),
        (f"{LINE} left\n", "the box in line 1 of .* must be numbers of shape .7,., got"),
        (f"{LINE} nan\n", "the box in line 1 of .* must be finite numbers"),
        (f"{LINE.replace('4.0', '0.0')} 0\n", "Car in line 1 of .* above 0 m, got 1.5, 1.8, 0: drop the line"),
        ("\x00\x01\x02", "is no text"),
        (b"\xff\xfe\xfd", "is no text"),
    ])  # fmt: skip
def test_damaged_labels_are_named(tmp_path, content, message):
    path = tmp_path / "labels.txt"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    refused(message, read_kitti_objects, path, TO_CAMERA, error=OgmError)


def test_damaged_tracks_are_named(tmp_path):
    path = tmp_path / "0000.txt"
    path.write_text(f"one 7 {LINE} 0\n")
    with pytest.raises(OgmError, match="line 1 of .* must begin with two integers, got .*one"):
        read_kitti_tracks(path, TO_CAMERA)
    path.write_text(f"1 7 {LINE} 0\n1 7 {LINE} 0\n")
    refused("line 2 of .* second box of track 7 in scan 1", read_kitti_tracks, path, TO_CAMERA, error=OgmError)
    with pytest.raises(FileNotFoundError):
        read_kitti_tracks(tmp_path / "none.txt", TO_CAMERA)


def test_a_days_calibration_is_two_files(tmp_path):
    half = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    (tmp_path / "calib_velo_to_cam.txt").write_text("R: 0 -1 0 0 0 -1 1 0 0\nT: 0.1 0.2 0.3\n")
    (tmp_path / "calib_cam_to_cam.txt").write_text(f"R_rect_00: {' '.join(map(str, half.ravel()))}\n")
    T = read_calibration(tmp_path)
    assert T[:3, :3] == pytest.approx(half @ TO_CAMERA[:3, :3])
    assert T[:3, 3] == pytest.approx(half @ [0.1, 0.2, 0.3])
    (tmp_path / "calib_cam_to_cam.txt").write_text("S_00: 1 2\n")
    refused("no entry R_rect_00, only S_00", read_calibration, tmp_path, error=OgmError)
    (tmp_path / "calib_cam_to_cam.txt").unlink()
    with pytest.raises(FileNotFoundError):
        read_calibration(tmp_path)


def test_stamps_are_dates_or_seconds(tmp_path):
    path = tmp_path / "timestamps.txt"
    path.write_text("2011-09-26 13:02:25.964389445\n2011-09-26 13:02:26.064389445\n")
    stamps = read_kitti_stamps(path)
    assert stamps[0] == pytest.approx(1317042145.964389)
    assert np.diff(stamps) == pytest.approx(0.1)
    path.write_text("0.000000e+00\n1.039014e-01\n")
    assert read_kitti_stamps(path).tolist() == [0, 0.1039014]
    zones = ("2011-09-26 13:02:25Z", "2011-09-26 13:02:25+02", "2011-09-26T13:02:25+02 00", "2011-09-26T13+02 25")
    for last in ("noon", "nan", "1e400", *zones):
        path.write_text(f"0.1\n{last}\n")
        refused("line 2 of .* must be a time", read_kitti_stamps, path, error=OgmError)
    path.write_text("0.1\n\n0.3\n")
    refused("line 2 of .* is empty, but line k must be", read_kitti_stamps, path, error=OgmError)
    path.write_text("0.1\n0.2\n\n")
    assert len(read_kitti_stamps(path)) == 2


def test_the_boxes_of_drive_0005_hold_their_points(real):
    folder = real("kitti_raw_0005")
    tracks = read_kitti_tracks(folder / "label_02_0000.txt", read_calibration(folder / "calib_2011_09_26.txt"))
    lines = [line.split() for line in (folder / "label_02_0000.txt").read_text().splitlines()]
    assert sorted(tracks) == list(range(60, 84))
    for scan in (60, 83):
        kept = [line for line in lines if int(line[0]) == scan and line[2] != "DontCare"]
        assert tracks[scan].label == tuple(line[2] for line in kept)
        assert tracks[scan].track == tuple(line[1] for line in kept)
    points = read_points(folder / "0000000070.pcd.xz")
    boxes = tracks[70]
    assert share_inside(points, boxes) > 0.9
    assert share_inside(points, turned(boxes)) < share_inside(points, boxes) - 0.1
    # Length, width and height of a box do not depend on its frame
    sizes = np.array([line[10:13] for line in lines if line[0] == "70" and line[2] != "DontCare"], float)
    np.testing.assert_allclose(boxes.size[:, ::-1], sizes)


def test_the_boxes_of_kittis_single_scans_hold_their_points(real):
    folder = real("kitti_object")
    for name, labels in (
        ("000000", ("Pedestrian",)),
        ("000001", ("Truck", "Car", "Cyclist")),
        ("000002", ("Misc", "Car")),
    ):
        found = read_kitti_objects(
            folder / "label_2" / f"{name}.txt", read_calibration(folder / "calib" / f"{name}.txt")
        )
        assert found.label == labels
        assert set(found.track) == {""}
    points = read_points(folder / "velodyne" / "000002.bin")
    car = rows_of(found)[1]
    assert upper_part(points, car).sum() == upper_part(points, car, 0.3).sum() == 52


# --- Classes ----------------------------------------------------------------------------------------


def write_labelled(folder, points, numbers):
    np.asarray(points, "<f4").tofile(folder / "0.bin")
    np.asarray(numbers, "<u4").tofile(folder / "0.label")
    return folder / "0.bin", folder / "0.label"


def test_a_label_is_a_class_and_an_instance(tmp_path):
    points = [[1, 2, 3, 0.1], [0, 0, 0, 0], [4, 5, 6, 0.2]]
    files = write_labelled(tmp_path, points, [40, 99, 252 | 17 << 16])
    found = read_semantic_kitti(*files)
    assert found.points[:, 0].tolist() == [1, 4]  # what lies at the sensor goes, with its label
    assert found.classes.tolist() == [40, 252]
    assert found.named().tolist() == ["road", "moving-car"]


def test_labels_must_be_as_many_as_points(tmp_path):
    files = write_labelled(tmp_path, np.ones((3, 4)), [40, 40])
    refused(r"0.label has 2 labels, .*0.bin has 3 points", read_semantic_kitti, *files, error=OgmError)
    files = write_labelled(tmp_path, [[1, 1, 1, 0], [1, 1e30, 1, 0]], [40, 40])
    refused(r"0.bin with .* coordinates of more than 100000 m", read_semantic_kitti, *files, error=OgmError)
    files = write_labelled(tmp_path, np.ones((2, 4)), [40, 77])
    refused(r"0.label: class 77 is not one of the 34 known classes", read_semantic_kitti, *files, error=OgmError)


def test_moving_classes_are_named_so():
    assert {SEMANTIC_KITTI[n].split("-")[0] for n in SEMANTIC_KITTI_MOVING} == {"moving"}
    assert len(SEMANTIC_KITTI_MOVING) == 8


def range_image(**changed):
    image = np.zeros((2, 3, 6))
    image[0, :, :3] = [[1, 2, 3], [4, 5, 6], [7, 8, 9]]
    image[0, :, 3:] = [[51, 4, 0], [255, 9, 7], [999, 14, 10]]
    for key, value in changed.items():
        image[0, 1, int(key[1:])] = value
    return image


def test_signalling_nan_where_there_is_no_range_is_read_without_warnings(tmp_path):
    image = range_image().astype("<f4")
    image.view("<u4")[1, 2] = 0x7F800001
    np.save(tmp_path / "0.npy", image)
    assert len(read_range_image(tmp_path / "0.npy", NUSCENES_ELEVEN, "nuscenes", intensity_max=255).points) == 3


def test_a_range_image_is_read_with_its_axes(tmp_path):
    np.save(tmp_path / "0.npy", range_image())
    (tmp_path / "1.npy.xz").write_bytes(lzma.compress((tmp_path / "0.npy").read_bytes()))
    for name in ("0.npy", "1.npy.xz"):
        found = read_range_image(tmp_path / name, NUSCENES_ELEVEN, "nuscenes", intensity_max=255)
        assert found.points[:, :3].tolist() == [[2, -1, 3], [5, -4, 6], [8, -7, 9]]
        assert found.points[:, 3] == pytest.approx([0.2, 1, 1])
        assert found.named().tolist() == ["road", "car", "none"]


@each("content, message", [
        (np.zeros((4, 6)), r"shape \(4, 6\), wanted numbers of shape \(layers, azimuths, 6\)"),
        (np.zeros((2, 3, 4)), r"shape \(2, 3, 4\), wanted"),
        (np.empty((1, 1, 6), object), "array of object"),
        (range_image(c5=11), "class 11 is not one of the 11"),
        (range_image(c5=2.5), "must have integer classes"),
        (range_image(c5=1e300), "must have integer classes"),
        (range_image(c1=1e39), "coordinates of more than 100000 m"),
        (range_image(c2=np.nan), "1 beams with a range but with NaN"),
    ])  # fmt: skip
def test_damaged_range_images_are_refused(tmp_path, content, message):
    np.save(tmp_path / "0.npy", content, allow_pickle=True)
    refused(message, read_range_image, tmp_path / "0.npy", NUSCENES_ELEVEN, error=OgmError)


def test_a_range_image_must_be_whole(tmp_path):
    np.save(tmp_path / "0.npy", range_image())
    whole = (tmp_path / "0.npy").read_bytes()
    for part, message in ((whole[:-8], "cut short"), (whole[:20], "no readable numpy header")):
        (tmp_path / "0.npy").write_bytes(part)
        refused(message, read_range_image, tmp_path / "0.npy", NUSCENES_ELEVEN, error=OgmError)


@each("name, names, axes, scale, height", [
        ("semantic_kitti/2.npy.xz", SEMANTIC_KITTI_TRAINING, "kitti", 1.0, 1.75),
        ("nuscenes/25612.npy.xz", NUSCENES_ELEVEN, "nuscenes", 255.0, 1.86),
    ])  # fmt: skip
def test_classes_lie_where_they_should(real, name, names, axes, scale, height):
    """The road lies flat around the sensor; cars are on it; buildings are high."""
    found = read_range_image(real(f"labelled_range_images/{name}"), names, axes, intensity_max=scale)
    words, z = found.named(), found.points[:, 2]
    near = np.hypot(found.points[:, 0], found.points[:, 1]) < 15
    assert np.median(z[near & (words == "road")]) == pytest.approx(-height, abs=0.1)
    low, high = np.quantile(z[near & (words == "road")], (0.25, 0.75))
    assert high - low < 0.35
    cars = z[words == "car"] + height
    assert len(cars) > 100
    assert 0.3 < np.median(cars) < 1.6
    assert np.quantile(z[words == "building"] + height, 0.9) > 2.5
    assert found.points[:, 3].max() <= 1


def test_semantic_kittis_own_files_hold_the_same_as_the_range_image(real, tmp_path):
    image = read_range_image(real("labelled_range_images/semantic_kitti/0.npy.xz"), SEMANTIC_KITTI_TRAINING)
    back = {name: number for number, name in SEMANTIC_KITTI.items()}
    numbers = np.array([back[word] for word in image.named()])
    found = read_semantic_kitti(*write_labelled(tmp_path, image.points, numbers | 5 << 16))
    assert (found.points == image.points).all()
    assert (found.named() == image.named()).all()


# --- nuScenes ---------------------------------------------------------------------------------------


def quaternion(R):
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(R).as_quat()
    return [w, x, y, z]


def tables_of(info):
    """Write mmdetection3d's frame as nuScenes' tables: boxes go to the map, by hand."""
    frame = info["frame"]
    ego, lidar = np.array(frame["ego2global"]), np.array(frame["lidar_points"]["lidar2ego"])
    names = {number: name for name, number in info["metainfo"]["categories"].items()}
    tables = {
        "scene": [{"token": "s", "name": "scene-0001"}],
        "sample": [{"token": "k", "scene_token": "s"}],
        "sensor": [{"token": "l", "channel": "LIDAR_TOP"}],
        "calibrated_sensor": [
            {
                "token": "l",
                "sensor_token": "l",
                "translation": lidar[:3, 3].tolist(),
                "rotation": quaternion(lidar[:3, :3]),
            }
        ],
        "ego_pose": [{"token": "p", "translation": ego[:3, 3].tolist(), "rotation": quaternion(ego[:3, :3])}],
        "sample_data": [
            {
                "token": "d", "sample_token": "k", "ego_pose_token": "p", "calibrated_sensor_token": "l",
                "timestamp": round(frame["timestamp"] * 1e6), "is_key_frame": True,
                "filename": f"samples/LIDAR_TOP/{frame['lidar_points']['lidar_path']}",
            }
        ],
        "category": [{"token": f"c{n}", "name": name} for n, name in ({-1: "other"} | names).items()],
        "instance": [],
        "sample_annotation": [],
    }  # fmt: skip
    for n, one in enumerate(frame["instances"]):
        x, y, z, length, width, height, yaw = one["bbox_3d"]
        T = np.eye(4)
        T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        T[:3, 3] = x, y, z
        there = ego @ lidar @ T
        tables["instance"].append({"token": f"i{n}", "category_token": f"c{one['bbox_label_3d']}"})
        tables["sample_annotation"].append(
            {
                "token": f"a{n}", "sample_token": "k", "instance_token": f"i{n}",
                "translation": there[:3, 3].tolist(), "size": [width, length, height],
                "rotation": quaternion(there[:3, :3]),
            }
        )  # fmt: skip
    return tables


def write_tables(folder, tables, version="v1.0-mini"):
    (folder / version).mkdir(parents=True, exist_ok=True)
    for name, rows in tables.items():
        (folder / version / f"{name}.json").write_text(json.dumps(rows))
    for row in tables["sample_data"]:
        path = folder / row["filename"]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return folder


INFO = {
    "metainfo": {"dataset": "nuscenes", "categories": {"car": 0}},
    "frame": {
        "timestamp": 1.5,
        "ego2global": np.eye(4).tolist(),
        "lidar_points": {"lidar_path": "a.pcd.bin", "lidar2ego": np.eye(4).tolist()},
        "instances": [{"bbox_3d": [3.0, 10.0, 0.5, 4.0, 2.0, 1.5, np.pi / 2], "bbox_label_3d": 0}],
    },
}


def test_nuscenes_has_x_to_the_right_and_y_ahead(tmp_path):
    """A car 10 m ahead, 3 m to the right, that heads forward."""
    (tmp_path / "info.json").write_text(json.dumps(INFO))
    found = read_mmdet3d(tmp_path / "info.json")
    assert rows_of(found.boxes(0))[0] == pytest.approx([10, -3, 0, 4, 2, -0.25, 1.25])
    assert found.boxes(0).label == ("car",)
    tables = read_nuscenes(write_tables(tmp_path / "n", tables_of(INFO)))
    assert rows_of(tables.boxes(0))[0] == pytest.approx([10, -3, 0, 4, 2, -0.25, 1.25])
    assert tables.boxes(0).track == ("i0",)
    assert tables.frames[0].scene == "scene-0001"
    assert tables.frames[0].stamp == found.frames[0].stamp == 1.5


def test_nuscenes_tables_and_mmdetection3ds_info_hold_the_same(real, tmp_path):
    path = real("nuscenes_n015/*.json")
    info = json.loads(path.read_text())
    one = read_mmdet3d(path)
    other = read_nuscenes(write_tables(tmp_path, tables_of(info)))
    a, b = one.boxes(0), other.boxes(0)
    assert len(a) == len(info["frame"]["instances"]) == 69
    assert a.label == b.label
    difference = rows_of(a) - rows_of(b)
    difference[:, 2] = (difference[:, 2] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(difference, 0, atol=1e-4)
    np.testing.assert_allclose(one.frames[0].T_map_sensor, other.frames[0].T_map_sensor, atol=1e-4)
    assert one.frames[0].height == pytest.approx(1.84, abs=0.01)
    assert one.frames[0].path.is_file()
    points = read_points(one.frames[0].path, axes="nuscenes")
    assert share_inside(points, a) > 0.9
    # The data set itself counts the returns of each box; its boxes are tilted and ours upright
    counts = np.array([len(points[in_box(points, box)]) for box in rows_of(a)])
    given = np.array([note["num_lidar_pts"] for note in info["frame"]["instances"]])
    assert np.corrcoef(counts, given)[0, 1] > 0.99


def in_box(points, box):
    return upper_part(points, box + [0, 0, 0, 0, 0, -0.3, 0])


@each("change, message", [
        (lambda t: t["instance"].clear(), "instance i0 of .* is in no table"),
        (lambda t: t["sample_annotation"][0].pop("size"), "has no 'size'"),
        (lambda t: t["sample_annotation"][0].update(size=[1, float("nan"), 1]), "size of .* must be finite"),
        (lambda t: t["sample_annotation"][0].update(size=[1, 0, 1]), "key frame a.pcd.bin: box 0"),
        (lambda t: t["sample_annotation"][0].update(rotation=[1, 1, 0, 0]), "quaternion of length 1"),
    ])  # fmt: skip
def test_damaged_annotations_are_named(tmp_path, change, message):
    tables = tables_of(INFO)
    change(tables)
    content = read_nuscenes(write_tables(tmp_path, tables))
    refused(message, content.boxes, 0, error=OgmError)


@each("change, message", [
        (lambda t: t["ego_pose"].clear(), "refers to ego_pose p, which ego_pose.json lacks"),
        (lambda t: t["sample_data"][0].pop("filename"), "has no 'filename'"),
        (lambda t: t["sample_data"][0].update(is_key_frame=False), "names no key frame of LIDAR_TOP"),
        (lambda t: t.update(scene={"token": "s"}), "holds a JSON dict, wanted a list: the table scene"),
        (lambda t: t.update(scene=[3]), "row 0 of .* has no 'token', only int"),
    ])  # fmt: skip
def test_damaged_tables_are_named(tmp_path, change, message):
    tables = tables_of(INFO)
    filename = tables["sample_data"][0]["filename"]
    (tmp_path / filename).parent.mkdir(parents=True)
    (tmp_path / filename).touch()
    change(tables)
    (tmp_path / "v1.0-mini").mkdir()
    for name, rows in tables.items():
        (tmp_path / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    refused(message, read_nuscenes, tmp_path, error=OgmError)


def test_which_version_of_nuscenes(tmp_path):
    refused(r"one folder of tables \(v1.0-...\), found none", read_nuscenes, tmp_path, error=OgmError)
    for version in ("v1.0-mini", "v1.0-trainval"):
        write_tables(tmp_path, tables_of(INFO), version)
    refused("found v1.0-mini, v1.0-trainval: give that folder", read_nuscenes, tmp_path, error=OgmError)
    assert len(read_nuscenes(tmp_path / "v1.0-mini").frames) == 1


def test_the_test_part_of_nuscenes_has_no_boxes(tmp_path):
    """Its table of them is there, and empty."""
    tables = tables_of(INFO)
    for name in ("sample_annotation", "instance"):
        tables[name].clear()
    content = read_nuscenes(write_tables(tmp_path / "empty", tables))
    assert not content.annotated
    assert len(content.boxes(0)) == 0
    for name in ("sample_annotation", "instance", "category"):
        del tables[name]
    assert not read_nuscenes(write_tables(tmp_path / "without", tables)).annotated


@each("name", ["../a.pcd.bin", "samples/../../a.pcd.bin", "/etc/hostname"])
def test_nuscenes_names_no_files_elsewhere(tmp_path, name):
    tables = tables_of(INFO)
    write_tables(tmp_path / "data", tables)
    (tmp_path / "a.pcd.bin").touch()
    tables["sample_data"][0]["filename"] = name
    (tmp_path / "data" / "v1.0-mini" / "sample_data.json").write_text(json.dumps(tables["sample_data"]))
    with pytest.raises(OgmError, match=r"sample_data.json names the file .*, wanted a file under .*data"):
        read_nuscenes(tmp_path / "data")


@each("content, message", [
        ("[1, 2]", "holds a JSON list, wanted a dict: mmdetection3d's info"),
        ("{", "is no JSON"),
        ("[" * 100_000, "is no JSON"),
        ('{"a": 1}', "has no 'metainfo', only a"),
        ('{"metainfo": {"dataset": "waymo", "categories": {}}, "data_list": []}', "dataset waymo, wanted nuscenes"),
        ('{"metainfo": {"dataset": "nuscenes", "categories": {}}}', "has no 'data_list'"),
        ('{"metainfo": {"dataset": "nuscenes", "categories": ["car"]}}', "'categories' of .* wanted a dict"),
        ('{"metainfo": {"dataset": "nuscenes", "categories": {}}, "data_list": 3}', "'data_list' of .* a list"),
    ])  # fmt: skip
def test_json_of_another_kind_is_refused(tmp_path, content, message):
    (tmp_path / "info.json").write_text(content)
    refused(message, read_mmdet3d, tmp_path / "info.json", error=OgmError)


@each(
    "note, message",
    [("car", "an object of frame 0 of .* has no 'bbox_3d', only str"), ({"bbox_label_3d": 0}, "has no 'bbox_3d'")],
)
def test_damaged_objects_of_an_info_are_named(tmp_path, note, message):
    info = INFO | {"frame": INFO["frame"] | {"instances": [note]}}
    (tmp_path / "info.json").write_text(json.dumps(info))
    refused(message, read_mmdet3d, tmp_path / "info.json", error=OgmError)


@each("number", [None, [0], "0", 77])
def test_objects_of_no_known_category_are_other(tmp_path, number):
    note = INFO["frame"]["instances"][0] | {"bbox_label_3d": number}
    info = INFO | {"frame": INFO["frame"] | {"instances": [note]}}
    (tmp_path / "info.json").write_text(json.dumps(info))
    assert read_mmdet3d(tmp_path / "info.json").boxes(0).label == ("other",)


def test_a_pickle_is_not_opened(tmp_path):
    (tmp_path / "infos.pkl").write_bytes(b"\x80\x04")
    refused("pickles are not read", read_mmdet3d, tmp_path / "infos.pkl", error=OgmError)


# --- Argoverse 2 ------------------------------------------------------------------------------------


def test_a_log_of_argoverse_2(real):
    import pyarrow.feather

    folder = real("argoverse2_adcf")
    log = read_argoverse2(folder)
    table = pyarrow.feather.read_table(folder / "annotations.feather").to_pydict()
    mine = [n for n, at in enumerate(table["timestamp_ns"]) if at == log.stamps[0]]
    found = log.boxes(0)
    assert len(log.stamps) == 1
    assert len(found) == len(mine) == 47
    assert found.label == tuple(table["category"][n] for n in mine)
    assert found.track == tuple(table["track_uuid"][n] for n in mine)
    np.testing.assert_allclose(found.center[:, 0], [table["tx_m"][n] for n in mine])
    np.testing.assert_allclose(found.size[:, 0], [table["length_m"][n] for n in mine])
    sweep = read_scan(log.sweeps[0])
    assert share_inside(sweep.points, found) > 0.9
    assert log.lidars["up_lidar"][2] > log.lidars["down_lidar"][2] > 1
    assert np.linalg.det(log.poses[log.stamps[0]][:3, :3]) == pytest.approx(1)


def test_the_map_of_argoverse_2_lies_under_the_scan(real):
    log = read_argoverse2(real("argoverse2_adcf"))
    T = log.poses[log.stamps[0]]
    points = read_points(log.sweeps[0])[:, :3].astype(float)
    near = points[np.hypot(points[:, 0], points[:, 1]) < 20]
    above = near[:, 2] - log.map.ground(near, T)
    assert np.isnan(above).mean() < 0.1  # parts of the city have no height
    assert np.nanmin(above) > -0.3
    low = above[above < 0.15]  # returns from the ground, for the most part
    assert len(low) > 10_000
    assert np.median(low) == pytest.approx(0, abs=0.03)
    assert np.mean(np.abs(low) < 0.1) > 0.9
    assert np.isnan(log.map.ground(np.array([[1e5, 0, 0]]), T)).all()
    from matplotlib.path import Path

    assert any(Path(outline).contains_point((0, 0)) for outline in log.map.outlines(T))


def write_log(folder, **changed):
    import pyarrow as pa
    import pyarrow.feather

    turn = {"qw": [1.0], "qx": [0.0], "qy": [0.0], "qz": [0.0]}
    place = {"tx_m": [1.0], "ty_m": [2.0], "tz_m": [3.0]}
    sizes = {"length_m": [4.0], "width_m": [2.0], "height_m": [1.0]}
    tables = {
        "city_SE3_egovehicle": {"timestamp_ns": [7], **turn, **place},
        "annotations": {"timestamp_ns": [7], "track_uuid": ["t"], "category": ["BUS"], **sizes, **turn, **place},
        "sensors/lidar/7": {"x": [1.0]},
    }
    for name, columns in tables.items():
        columns |= changed.get(name.split("_")[0], {})
        path = folder / f"{name}.feather"
        path.parent.mkdir(parents=True, exist_ok=True)
        kept = {key: value for key, value in columns.items() if value is not None}
        pyarrow.feather.write_feather(pa.table(kept), path)
    return folder


def test_a_log_without_map_or_calibration(tmp_path):
    log = read_argoverse2(write_log(tmp_path))
    assert log.map is None
    assert log.lidars == {}
    assert rows_of(log.boxes(0)).tolist() == [[1, 2, 0, 4, 2, 2.5, 3.5]]
    (tmp_path / "annotations.feather").unlink()
    assert read_argoverse2(tmp_path).annotations is None
    assert len(read_argoverse2(tmp_path).boxes(0)) == 0


@each("changed, message", [
        ({"city": {"timestamp_ns": [8]}}, "has no pose for the sweep at 7"),
        ({"city": {"qw": None}}, "has no column qw, only"),
        ({"city": {"qw": [0.5]}}, "row 0 of .* quaternion of length 1"),
        ({"city": {"tx_m": [np.nan]}}, "row 0 of .* finite position"),
        ({"annotations": {"length_m": [0.0]}}, "annotations.feather at 7: box 0"),
        ({"annotations": {"track_uuid": None}}, "has no column track_uuid"),
        ({"annotations": {"length_m": ["long"]}}, "length_m of .* must be columns of numbers, got object"),
        ({"annotations": {"tx_m": np.array([7], "M8[ns]")}}, "tx_m of .* must be columns of numbers, got dat"),
        ({"annotations": {"tx_m": [1e300]}}, "box 0 .* within 100000 m"),
        ({"city": {"timestamp_ns": [[7]]}}, "timestamp_ns of .* must be integers"),
        ({"city": {"timestamp_ns": ["7"]}}, "timestamp_ns of .* must be integers"),
        ({"annotations": {"timestamp_ns": [7.5]}}, "timestamp_ns of .* must be integers"),
    ])  # fmt: skip
def test_damaged_logs_are_named(tmp_path, changed, message):
    write_log(tmp_path, **changed)
    with pytest.raises(OgmError, match=message):
        read_argoverse2(tmp_path).boxes(0)


def test_no_log_at_all(tmp_path):
    refused("give the folder of one log", read_argoverse2, tmp_path, error=FileNotFoundError)
    write_log(tmp_path)
    (tmp_path / "city_SE3_egovehicle.feather").write_bytes(b"ARROW1 and nothing more")
    refused("no readable Feather table", read_argoverse2, tmp_path, error=OgmError)


def write_map(folder, heights=None, place=None, areas=None):
    (folder / "map").mkdir()
    square = [{"x": x, "y": y, "z": 0} for x, y in ((0, 0), (4, 0), (4, 4), (0, 4))]
    drivable = {"drivable_areas": {"1": {"area_boundary": square}}} if areas is None else areas
    (folder / "map" / "log_map_archive_a.json").write_text(json.dumps(drivable))
    raster = np.arange(12, dtype=np.float32).reshape(3, 4) if heights is None else heights
    np.save(folder / "map" / "a_ground_height_surface_b.npy", raster, allow_pickle=True)
    where = {"R": [1, 0, 0, 1], "t": [-10, -20], "s": 0.5} if place is None else place
    (folder / "map" / "a___img_Sim2_city.json").write_text(json.dumps(where))


@each("content", [b"PK\x03\x04", b"\x93NUMPY", b"\x80\x04K\x01."])
def test_a_raster_is_an_array_and_nothing_else(tmp_path, content):
    write_map(write_log(tmp_path))
    (tmp_path / "map" / "a_ground_height_surface_b.npy").write_bytes(content)
    refused("no readable numpy header", read_argoverse2, tmp_path, error=OgmError)


def test_a_raster_must_hold_what_its_header_claims(tmp_path):
    """Else room would be made for it first."""
    write_map(write_log(tmp_path))
    path = tmp_path / "map" / "a_ground_height_surface_b.npy"
    path.write_bytes(path.read_bytes().replace(b"(3, 4), }" + b" " * 12, b"(3, 4000000000000), }"))
    refused("holds an array", read_argoverse2, tmp_path, error=OgmError)


def test_a_map_knows_nothing_beyond_all_numbers(tmp_path):
    write_map(write_log(tmp_path), place={"R": [1, 0, 0, 1], "t": [-10, -20], "s": 1e308})
    plan = read_argoverse2(tmp_path).map
    assert np.isnan(plan.ground(np.array([[1e4, 3.0, 0.0], [-1e4, 0.0, 0.0]]), np.eye(4))).all()


def test_a_raster_has_rows_along_y(tmp_path):
    """Its cells are 2 m wide and begin at (10, 20): column by x, row by y."""
    write_map(write_log(tmp_path))
    plan = read_argoverse2(tmp_path).map
    T = np.eye(4)
    T[:3, 3] = 10, 20, 5
    z = plan.ground(
        np.array([[0.1, 0.1, 0], [2.1, 0.1, 0], [0.1, 2.1, 0], [7.9, 5.9, 0], [8.1, 0, 0], [-0.1, 0, 0]]), T
    )
    assert z[:4].tolist() == pytest.approx([0 - 5, 1 - 5, 4 - 5, 11 - 5])
    assert np.isnan(z[4:]).all()
    assert plan.outlines(T)[0].tolist() == [[-10, -20], [-6, -20], [-6, -16], [-10, -16]]


@each("what, message", [
        ({"heights": np.zeros(3)}, r"shape \(3,\), wanted heights"),
        ({"heights": np.empty((2, 2), object)}, "array of object and shape .*, wanted heights"),
        ({"heights": np.zeros((0, 3))}, r"shape \(0, 3\), wanted heights"),
        ({"areas": {"drivable_areas": [1]}}, "'drivable_areas' of .* is a list, wanted a dict"),
        ({"areas": {"drivable_areas": {"1": {"area_boundary": 3}}}}, "is a int, wanted a list"),
        ({"place": {"R": [1, 0, 0, 1], "t": [10**400, 0], "s": 1}}, "t of .* must be numbers"),
        ({"place": {"R": [1, 0, 0, 1], "s": 1}}, "has no 't'"),
        ({"place": [1]}, "holds a JSON list, wanted a dict"),
        ({"areas": {"drivable_areas": {"1": {"area_boundary": [{"x": 1}]}}}}, "drivable area 1 of .* has no 'y'"),
        ({"areas": {"lanes": []}}, "has no 'drivable_areas'"),
    ])  # fmt: skip
def test_damaged_maps_are_named(tmp_path, what, message):
    write_map(write_log(tmp_path), **what)
    refused(message, read_argoverse2, tmp_path, error=OgmError)


# --- SUSTechPOINTS ----------------------------------------------------------------------------------


def note(**changed):
    psr = {
        "position": {"x": 3.0, "y": -10.0, "z": 0.5},
        "scale": {"x": 4.0, "y": 2.0, "z": 1.5},
        "rotation": {"x": 0.0, "y": 0.0, "z": -np.pi / 2},
    }
    return {"psr": psr | changed.pop("psr", {}), "obj_type": "Car", "obj_id": "4"} | changed


def test_sustechs_example_drives_towards_minus_y(tmp_path):
    """A car 10 m ahead, 3 m to the left, that heads forward."""
    (tmp_path / "0.json").write_text(json.dumps([note()]))
    found = read_sustech(tmp_path / "0.json")
    assert rows_of(found)[0] == pytest.approx([10, 3, 0, 4, 2, -0.25, 1.25])
    assert (found.label, found.track) == (("Car",), ("4",))
    assert rows_of(read_sustech(tmp_path / "0.json", axes="flu"))[0, :3] == pytest.approx([3, -10, -np.pi / 2])


def test_an_object_without_a_name_has_no_track(tmp_path):
    (tmp_path / "0.json").write_text(json.dumps([note(obj_id=None), note(obj_id=0)]))
    assert read_sustech(tmp_path / "0.json").track == ("", "0")


@each("content, message", [
        ([note(psr={"scale": {"x": 1, "y": 1, "z": 10**400}})], "scale of object 0 .* must be numbers"),
        ({"frame": 1}, "holds a JSON dict, wanted a list"),
        ([3], "object 0 of .* has no 'psr', only int"),
        ([note(), note(psr={"scale": {"x": 1, "y": 1}})], "scale of object 1 of .* has no 'z'"),
        ([note(psr={"scale": {"x": 1, "y": 1, "z": "tall"}})], "scale of object 0 .* must be numbers of shape"),
        ([note(psr={"scale": {"x": 1, "y": -1, "z": 1}})], r"box 0 \(Car\) must be finite"),
    ])  # fmt: skip
def test_damaged_notes_are_named(tmp_path, content, message):
    (tmp_path / "0.json").write_text(json.dumps(content))
    refused(message, read_sustech, tmp_path / "0.json", error=OgmError)


def test_the_boxes_of_sustech_hold_their_points(real):
    folder = real("sustechpoints")
    for name, count in (("000965", 21), ("000975", 24)):
        found = read_sustech(folder / "label" / f"{name}.json")
        notes = json.loads((folder / "label" / f"{name}.json").read_text())
        assert len(found) == len(notes) == count
        assert found.track == tuple(str(one["obj_id"]) for one in notes)
        points = read_points(folder / "lidar" / f"{name}.pcd.xz", axes="sustech")
        cars = found.select([label == "Car" for label in found.label])
        assert share_inside(points, cars) > 0.9
        assert share_inside(points, turned(cars)) < 0.85
