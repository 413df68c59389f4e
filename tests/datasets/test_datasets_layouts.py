"""One made-up street, written as every data set would: all tell the same points, boxes, poses and truth."""

import pickle
import shutil

import numpy as np
import pytest
from cases import each, refused

from ogm.datasets import open_dataset
from ogm.datasets.frames import KITTI_EGO
from ogm.grid import GridSpec
from ogm.scan import Mount
from ogm.state import CellState, Truth
from ogm.truth import TRUTH_SPEC

FREE, OCCUPIED, IGNORE = CellState.FREE, CellState.OCCUPIED, CellState.IGNORE

BOXED = ("kitti object", "kitti tracking", "kitti raw", "nuscenes", "mmdet3d", "argoverse 2", "sustech")
SOURCES = {  # what each is made of
    "kitti object": ("boxes",),
    "kitti tracking": ("boxes", "aggregated"),
    "kitti raw": ("boxes", "aggregated"),
    "scans and poses": ("aggregated",),
    "semantic kitti": ("classes", "aggregated"),
    "nuscenes": ("boxes", "aggregated"),
    "mmdet3d": ("boxes", "aggregated"),
    "argoverse 2": ("boxes", "map", "aggregated"),
    "sustech": ("boxes", "aggregated"),
}
POSED = [name for name in SOURCES if name != "kitti object"]


WORDS = {
    "boxes": "occupied: all cells of boxes",
    "classes": "hit labelled ground",
    "map": "drivable area",
    "aggregated": "scans agree",
}


def sources(dataset) -> tuple[str, ...]:
    """Return what the description states that the truth is made of."""
    return tuple(name for name, words in WORDS.items() if words in dataset.description)


def rows(boxes) -> np.ndarray:
    """Return boxes as x, y, yaw, length, width, bottom, top."""
    return np.column_stack([boxes.center[:, :2], boxes.yaw, boxes.size[:, :2], boxes.bottom, boxes.top])


def at(truth: Truth, x: float, y: float) -> int:
    return int(truth.state[truth.spec.index(x, y)])


@each("name", SOURCES)
def test_every_layout_is_known(written, name):
    dataset = open_dataset(written(name))
    assert sources(dataset) == SOURCES[name]
    assert len(dataset) == 4
    assert dataset[0].truth.spec == TRUTH_SPEC
    assert dataset.format in dataset.description
    assert dataset.facts == {"format": dataset.format, "frames": 4}
    assert dataset.files == (written(name),)


@each("name", SOURCES)
def test_points_are_those_of_the_street_without_the_ego_vehicle(written, street, name):
    scan, _, _ = street
    frame = open_dataset(written(name))[2]
    points, names = scan(2)
    _, x, _, y = KITTI_EGO if "kitti" in name or "poses" in name else (-2.5, 2.5, -1.1, 1.1)
    kept = (np.abs(points[:, 0]) > x) | (np.abs(points[:, 1]) > y)
    assert (names[~kept] == "outlier").sum() == 40
    assert frame.scan.points.dtype == np.float32
    np.testing.assert_allclose(frame.scan.points[:, :3], points[kept][:, :3], atol=2e-6)


@each("name", BOXED)
def test_boxes_are_those_of_the_street(written, street, name):
    _, boxes, _ = street
    for k in (0, 3):
        found = open_dataset(written(name))[k].boxes
        difference = rows(found) - boxes(k)
        difference[:, 2] = (difference[:, 2] + np.pi) % (2 * np.pi) - np.pi
        np.testing.assert_allclose(difference, 0, atol=1e-6)
    assert all("car" in label.lower() or "vehicle" in label.lower() for label in found.label)


@each("name", POSED)
def test_poses_move_as_the_vehicle_does(written, street, name):
    _, _, on_map = street
    dataset = open_dataset(written(name))
    first, last = dataset[0].T_map_sensor, dataset[3].T_map_sensor
    wanted = np.linalg.inv(on_map(0)) @ on_map(3)
    np.testing.assert_allclose(np.linalg.inv(first) @ last, wanted, atol=1e-6)
    assert dataset[3].stamp - dataset[0].stamp == pytest.approx(0.3, abs=1e-6)


@each("name", SOURCES)
def test_the_sensors_height_is_found(written, name):
    mount = open_dataset(written(name))[1].mount
    assert mount.sensor_height == mount.T_vehicle_sensor[2, 3] == pytest.approx(1.8, abs=0.03)
    assert np.array_equal(mount.T_vehicle_sensor - np.eye(4) != 0, np.arange(16).reshape(4, 4) == 11)
    given = open_dataset(written(name), sensor_height=2.0)[1].mount
    assert given == Mount(2.0, given.T_vehicle_sensor)
    assert given.T_vehicle_sensor[2, 3] == 2.0


@each("name", SOURCES)
def test_all_tell_the_same_truth(written, name):
    """Scan 2: the parked car at (6, -4), the other at (5, 4); two scans before it covered (0.5, 4)."""
    truth = open_dataset(written(name))[2].truth
    known = "kitti object" not in name
    assert at(truth, 5.0, 4.0) == OCCUPIED or not ({"boxes", "classes"} & set(SOURCES[name]))
    assert at(truth, 6.0, -4.0) == OCCUPIED
    assert at(truth, 0.5, 4.0) == (FREE if known and name != "scans and poses" else IGNORE)
    assert at(truth, 4.0, 0.0) == (FREE if known else IGNORE)
    assert at(truth, 11.04, 2.0) == (OCCUPIED if known else IGNORE)  # the wall
    assert at(truth, 30.0, 0.0) == IGNORE
    assert at(truth, 0.0, 0.0) == IGNORE
    assert truth.shares().unknown == 0


@each("name", BOXED)
def test_boxes_are_filled_to_their_edges(written, street, name):
    _, boxes, _ = street
    truth = open_dataset(written(name), truth=("boxes",))[1].truth
    area = np.count_nonzero(truth.state == OCCUPIED) * TRUTH_SPEC.resolution**2
    assert area == pytest.approx((boxes(1)[:, 3] * boxes(1)[:, 4]).sum(), rel=0.03)
    assert truth.shares().free == 0


def test_moving_cars_leave_no_trail(written):
    """Nor do cars without tracks, as in mmdetection3d's info, or whose points are labelled as moving."""
    for name in ("kitti raw", "semantic kitti", "mmdet3d"):
        truth = open_dataset(written(name), truth=("aggregated",))[0].truth
        x = np.arange(6.4, 10.0, 0.16)  # where it drives from scan 1 to scan 3
        states = truth.state[TRUTH_SPEC.index(x, np.full(len(x), 4.0))]
        assert not (states == OCCUPIED).any()


def test_later_scans_alone(written):
    dataset = open_dataset(written("scans and poses"), others="later")
    assert dataset[0].truth.shares().free > 0.03
    assert dataset[3].truth.shares().ignore == 1
    assert "later scans" in dataset.description
    assert "later" not in open_dataset(written("scans and poses")).description
    with pytest.raises(ValueError, match="others must be one of all, later, got 'earlier'"):
        open_dataset(written("scans and poses"), others="earlier")


def test_the_map_frees_the_road_only(written):
    truth = open_dataset(written("argoverse 2"), truth="map")[0].truth
    assert truth.shares().occupied == 0
    assert at(truth, 4.0, 0.0) == FREE
    assert at(truth, 4.0, 8.0) == IGNORE  # not drivable
    assert at(truth, 8.0, -4.0) == IGNORE  # a car
    assert at(truth, 16.0, 0.0) == IGNORE  # behind the wall


def test_a_single_file_opens(written):
    folder = written("mmdet3d")
    assert len(open_dataset(folder / "infos.json")) == 4
    assert len(open_dataset(written("nuscenes") / "v1.0-mini")) == 4
    assert len(open_dataset(written("semantic kitti") / "sequences" / "07")) == 4
    assert len(open_dataset(written("semantic kitti") / "sequences")) == 4


def test_opening_reads_no_scan(written, fresh, monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("a scan was read")

    monkeypatch.setattr("ogm.io.read_scan", refuse)
    dataset = open_dataset(written("kitti raw"))
    frames = [(frame.name, frame.stamp) for frame in dataset]
    assert frames[2][0] == "0000000002"
    assert len(dataset[1:3]) == 2
    assert dataset[-1].boxes is not None
    with pytest.raises(AssertionError, match="a scan was read"):
        _ = dataset[0].scan
    with pytest.raises(IndexError):
        _ = dataset[4]


def test_descriptions_state_what_the_frames_own_scan_has_to_do_with_the_truth(written):
    descriptions = {name: open_dataset(written(name)).description for name in SOURCES}
    for name, made_of in SOURCES.items():
        assert ("this one does not contradict" in descriptions[name]) == ("aggregated" in made_of)
        assert ("returns or more in this scan" in descriptions[name]) == ("boxes" in made_of)
        assert ("this scan hit" in descriptions[name]) == ("classes" in made_of)
    assert "without labels of moving objects" in descriptions["scans and poses"]
    assert "above labelled ground" in descriptions["semantic kitti"]
    assert "above the map's ground" in descriptions["argoverse 2"]
    assert "above the lowest returns per square metre" in descriptions["kitti raw"]
    assert all("without labelled moving objects" in descriptions[name] for name in ("semantic kitti", "kitti raw"))


def test_a_drive_of_few_times_says_so(fresh):
    folder = fresh("kitti raw")
    path = folder / "velodyne_points" / "timestamps.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:3]))
    refused(r"has 3 times, but no time for scan 0000000003", open_dataset, folder)


def test_truth_is_made_once(written):
    dataset = open_dataset(written("scans and poses"))
    assert dataset[1].truth.state is dataset[1].truth.state
    assert dataset[2].scan.points is dataset[2].scan.points


def test_a_dataset_goes_to_another_process(written):
    dataset = open_dataset(written("kitti raw"), truth=("aggregated",), others="later")
    other = pickle.loads(pickle.dumps(dataset[1:]))
    assert sources(other) == ("aggregated",)
    assert [frame.name for frame in other] == [frame.name for frame in dataset][1:]
    assert (other[0].truth.state == dataset[1].truth.state).all()


@pytest.mark.slow
@each("name", SOURCES)
def test_what_was_read_stays_behind_and_is_read_again_in_another_folder(written, name, monkeypatch, tmp_path):
    monkeypatch.chdir(written(name).parent)
    dataset = open_dataset("data")
    frame = dataset[2]
    truth, mount, boxes = frame.truth.state, frame.mount, frame.boxes
    packed = pickle.dumps(dataset)
    assert len(packed) < 4000
    monkeypatch.chdir(tmp_path)
    other = pickle.loads(packed)
    assert other.files == (written(name),)
    assert (other[2].scan.points == frame.scan.points).all()
    assert (other[2].truth.state == truth).all()
    assert other[2].mount == mount
    assert boxes is None or (other[2].boxes.center == boxes.center).all()


# --- What is wrong with a folder --------------------------------------------------------------------


def test_nothing_there(tmp_path):
    refused("check the name", open_dataset, tmp_path / "nowhere", error=FileNotFoundError)
    refused(r"holds no scans.*SemanticKITTI.*nuScenes.*Argoverse", open_dataset, tmp_path)


def test_nothing_labelled(fresh):
    folder = fresh("scans and poses")
    (folder / "derived" / "poses_lidar.txt").unlink()
    dataset = open_dataset(folder)
    assert dataset.description == ""
    assert len(dataset[0].scan) > 0
    with pytest.raises(ValueError, match=r"no labels and no poses to make truth of; wanted poses.*add them"):
        _ = dataset[0].truth
    refused("has no aggregated to make truth of", open_dataset, folder, truth="aggregated")


def test_labels_that_are_asked_for_but_not_there(written):
    with pytest.raises(ValueError, match=r"has no map to make truth of; it has boxes, aggregated: give"):
        open_dataset(written("kitti raw"), truth=("boxes", "map"))
    with pytest.raises(ValueError, match=r"truth must be some of boxes, classes, map, aggregated, got 'lanes'"):
        open_dataset(written("kitti raw"), truth=("lanes",))


def remove(folder, name):
    for path in sorted(folder.glob(name)):
        path.unlink()


@each("name, without, message", [
        ("kitti object", "label_2/000001.txt", r"scan 000001.bin has no label .*000001.txt: add it"),
        ("kitti object", "calib/000001.txt", r"scan 000001.bin has no calibration"),
        ("semantic kitti", "sequences/07/labels/000002.label", r"has no label .*000002.label: add it"),
        ("argoverse 2", "calibration/*", r"has no mount of the upper lidar"),
        ("argoverse 2", "map/*.npy", r"must have one file of each .*found 1, 0, 1"),
        ("argoverse 2", "city_SE3_egovehicle.feather", r"no file .*city_SE3"),
        ("nuscenes", "v1.0-mini/instance.json", r"no file .*instance.json"),
        ("nuscenes", "samples/LIDAR_TOP/*", r"names no key frame of LIDAR_TOP with points under"),
    ])  # fmt: skip
def test_a_part_is_missing(fresh, tmp_path, name, without, message):
    folder = fresh(name, tmp_path)
    remove(folder, without)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        open_dataset(folder)


def test_a_drive_without_calibration_says_so(fresh):
    folder = fresh("kitti raw")
    remove(folder.parent, "calib*")
    with pytest.raises(ValueError, match=r"boxes but no calibration.*Tr_velo_to_cam and R0_rect"):
        _ = open_dataset(folder)[0].boxes


def test_too_few_poses(fresh):
    folder = fresh("semantic kitti")
    poses = folder / "sequences" / "07" / "poses.txt"
    poses.write_text("".join(poses.read_text().splitlines(keepends=True)[:2]))
    refused(r"2 poses for 4 scans", open_dataset, folder)


def test_range_images_lie_in_a_folder_that_names_their_data_set(tmp_path):
    np.save(tmp_path / "0.npy", np.zeros((2, 3, 6)))
    refused(r"wanted a folder named semantic_kitti or nuscenes", open_dataset, tmp_path)


def test_a_drive_that_shows_no_ground(fresh):
    folder = fresh("scans and poses")
    for k in range(4):
        np.full((10, 4), 0.5, np.float32).tofile(folder / f"{k:06}.bin")
    with pytest.raises(ValueError, match=r"no scan of data in .* shows the ground .*give `sensor_height`"):
        _ = open_dataset(folder)[0].mount
    assert open_dataset(folder, sensor_height=1.5)[0].mount.sensor_height == 1.5


def test_a_height_that_is_not_plausible_is_refused(fresh, street):
    folder = fresh("scans and poses")
    scan, _, _ = street
    for k in range(4):
        (scan(k)[0] + np.array([0, 0, 1.6, 0], np.float32)).tofile(folder / f"{k:06}.bin")
    with pytest.raises(ValueError, match=r"estimated .* 0\.\d+ m, .* not plausible \(0.5 to 5 m\).*sensor_position"):
        _ = open_dataset(folder)[0].mount
    mount = open_dataset(folder, sensor_position=(1.0, 0.0, 1.6))[0].mount
    assert mount.sensor_height == pytest.approx(1.8, abs=0.03)
    assert mount.points_in == "vehicle"
    assert mount.origin.tolist() == [1.0, 0.0, 1.6]


SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)


def test_a_stray_picture_makes_no_folder_of_grids_of_a_recording(fresh):
    folder = fresh("kitti tracking")
    (folder / "preview.png").write_bytes(b"whatever")
    assert open_dataset(folder, spec=SPEC).format == "KITTI tracking recordings"


def test_frames_of_two_sequences_have_names_of_their_own(fresh):
    folder = fresh("semantic kitti")
    shutil.copytree(folder / "sequences" / "07", folder / "sequences" / "08")
    dataset = open_dataset(folder)
    names = [frame.name for frame in dataset]
    assert len(set(names)) == len(names) == 8
    assert all(frame.sequence in frame.name for frame in dataset)
    assert dataset.sequences == {"07": [0, 1, 2, 3], "08": [4, 5, 6, 7]}
    assert dataset[3:6].sequences == {"07": [0], "08": [1, 2]}


def test_frames_that_are_unrelated_stand_alone(written):
    dataset = open_dataset(written("kitti object"))
    assert dataset.sequences == {}
    assert all(frame.sequence == "" and frame.stamp is frame.T_map_sensor is None for frame in dataset)


@each("options", [{"axes": "nuscenes"}, {"intensity_max": 100.0}, {"time_unit": 1e-3}])
def test_axes_and_units_of_a_data_set_are_not_chosen(written, options):
    refused("has known axes and units: leave out `axes`", open_dataset, written("kitti raw"), **options)


def test_a_default_split_is_for_data_sets_that_have_splits(written):
    assert len(open_dataset(written("kitti raw"), default_split="sequences")) == 4


def test_options_of_other_data_sets_are_refused(written):
    refused("`split` is for datasets that `ogm simulate` made", open_dataset, written("kitti raw"), split="test")
    with pytest.raises(ValueError, match="are in the sensor's frame: leave out `sensor_position`"):
        open_dataset(written("nuscenes"), sensor_position=(0.0, 0.0, 1.0))
