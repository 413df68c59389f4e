"""One made-up street, written as every data set would: all tell the same points, boxes, poses and truth."""

import pickle
import shutil

import numpy as np
import pytest

from ogm.cli.source import source_of
from ogm.grid import GridSpec
from ogm.recordings import SOURCES, is_recording, open_recording
from ogm.truth import TRUTH_SPEC, FREE, IGNORE, OCCUPIED, Truth

BOXED = ("kitti object", "kitti tracking", "kitti raw", "nuscenes", "mmdet3d", "argoverse 2", "sustech")
SAYS = {  # what each is made of
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
POSED = [name for name in SAYS if name != "kitti object"]


def at(truth: Truth, x: float, y: float) -> int:
    return int(truth.state[truth.spec.index(x, y)])


@pytest.mark.parametrize("name", SAYS)
def test_every_layout_is_known(written, name):
    recording = open_recording(written(name))
    assert recording.sources == SAYS[name]
    assert len(recording) == 4
    assert all(frame.truth.spec == TRUTH_SPEC for frame in recording[:1])
    assert recording.format in recording.truth_description
    assert all(source in SOURCES for source in recording.sources)


@pytest.mark.parametrize("name", SAYS)
def test_points_are_those_of_the_street_without_the_own_vehicle(written, street, name):
    scan, _, _ = street
    frame = open_recording(written(name))[2]
    points, names = scan(2)
    x, y = (2.6, 1.7) if "kitti" in name or "poses" in name else (2.5, 1.1)
    kept = (np.abs(points[:, 0]) > x) | (np.abs(points[:, 1]) > y)
    assert (names[~kept] == "outlier").sum() == 40
    assert frame.points.dtype == np.float32
    np.testing.assert_allclose(frame.points[:, :3], points[kept][:, :3], atol=2e-6)


@pytest.mark.parametrize("name", BOXED)
def test_boxes_are_those_of_the_street(written, street, name):
    _, boxes, _ = street
    for k in (0, 3):
        found = open_recording(written(name))[k].objects
        difference = found.boxes - boxes(k)
        difference[:, 2] = (difference[:, 2] + np.pi) % (2 * np.pi) - np.pi
        np.testing.assert_allclose(difference, 0, atol=1e-6)
    assert all("car" in label.lower() or "vehicle" in label.lower() for label in found.labels)


@pytest.mark.parametrize("name", POSED)
def test_poses_move_as_the_vehicle_does(written, street, name):
    _, _, on_map = street
    recording = open_recording(written(name))
    first, last = recording[0].T_map_sensor, recording[3].T_map_sensor
    wanted = np.linalg.inv(on_map(0)) @ on_map(3)
    np.testing.assert_allclose(np.linalg.inv(first) @ last, wanted, atol=1e-6)
    assert recording[3].stamp - recording[0].stamp == pytest.approx(0.3, abs=1e-6)


@pytest.mark.parametrize("name", SAYS)
def test_the_sensors_height_is_found(written, name):
    T = open_recording(written(name))[1].T_vehicle_sensor
    assert T[2, 3] == pytest.approx(1.8, abs=0.03)
    T[2, 3] = 0
    assert np.array_equal(T, np.eye(4))


@pytest.mark.parametrize("name", SAYS)
def test_all_tell_the_same_truth(written, name):
    """Scan 2: the parked car at (6, -4), the other at (5, 4); two scans before it covered (0.5, 4)."""
    truth = open_recording(written(name))[2].truth
    known = "kitti object" not in name
    assert at(truth, 5.0, 4.0) == OCCUPIED or not ({"boxes", "classes"} & set(SAYS[name]))
    assert at(truth, 6.0, -4.0) == OCCUPIED
    assert at(truth, 0.5, 4.0) == (FREE if known and name != "scans and poses" else IGNORE)
    assert at(truth, 4.0, 0.0) == (FREE if known else IGNORE)
    assert at(truth, 11.04, 2.0) == (OCCUPIED if known else IGNORE)  # the wall
    assert at(truth, 30.0, 0.0) == IGNORE
    assert at(truth, 0.0, 0.0) == IGNORE
    assert truth.shares().unknown == 0


@pytest.mark.parametrize("name", BOXED)
def test_boxes_are_filled_to_their_edges(written, street, name):
    _, boxes, _ = street
    truth = open_recording(written(name), truth=("boxes",))[1].truth
    area = np.count_nonzero(truth.state == OCCUPIED) * TRUTH_SPEC.resolution**2
    assert area == pytest.approx((boxes(1)[:, 3] * boxes(1)[:, 4]).sum(), rel=0.03)
    assert truth.shares().free == 0


def test_moving_cars_leave_no_trail(written):
    """Nor do cars that nobody can follow, as in mmdetection3d's info, or whose points are labelled as moving."""
    for name in ("kitti raw", "semantic kitti", "mmdet3d"):
        truth = open_recording(written(name), truth=("aggregated",))[0].truth
        x = np.arange(6.4, 10.0, 0.16)  # where it drives from scan 1 to scan 3
        states = truth.state[TRUTH_SPEC.index(x, np.full(len(x), 4.0))]
        assert not (states == OCCUPIED).any()


def test_later_scans_alone(written):
    recording = open_recording(written("scans and poses"), others="later")
    assert recording[0].truth.shares().free > 0.03
    assert recording[3].truth.shares().ignore == 1
    assert "later scans" in recording.truth_description
    assert "later" not in open_recording(written("scans and poses")).truth_description
    with pytest.raises(ValueError, match="others must be one of all, later, got 'earlier'"):
        open_recording(written("scans and poses"), others="earlier")


def test_the_map_frees_the_road_only(written):
    truth = open_recording(written("argoverse 2"), truth="map")[0].truth
    assert truth.shares().occupied == 0
    assert at(truth, 4.0, 0.0) == FREE
    assert at(truth, 4.0, 8.0) == IGNORE  # not drivable
    assert at(truth, 8.0, -4.0) == IGNORE  # a car
    assert at(truth, 16.0, 0.0) == IGNORE  # behind the wall


def test_a_single_file_opens(written):
    folder = written("mmdet3d")
    assert len(open_recording(folder / "infos.json")) == 4
    assert len(open_recording(written("nuscenes") / "v1.0-mini")) == 4
    assert len(open_recording(written("semantic kitti") / "sequences" / "07")) == 4
    assert len(open_recording(written("semantic kitti") / "sequences")) == 4


def test_opening_reads_no_scan(written, fresh, monkeypatch):
    import ogm.recordings.kitti as room

    def refuse(*args, **kwargs):
        raise AssertionError("a scan was read")

    monkeypatch.setattr(room, "read_points", refuse)
    recording = open_recording(written("kitti raw"))
    frames = [(frame.name, frame.stamp) for frame in recording]
    assert frames[2][0] == "0000000002"
    assert len(recording[1:3]) == 2
    assert recording[-1].objects is not None
    with pytest.raises(AssertionError, match="a scan was read"):
        _ = recording[0].points
    with pytest.raises(IndexError):
        _ = recording[4]


def test_a_truth_says_what_the_judged_scan_has_to_do_with_it(written):
    says = {name: open_recording(written(name)).truth_description for name in SAYS}
    for name, sources in SAYS.items():
        assert ("this one does not contradict" in says[name]) == ("aggregated" in sources)
        assert ("returns or more in this scan" in says[name]) == ("boxes" in sources)
        assert ("this scan hit" in says[name]) == ("classes" in sources)
    assert "though nobody labelled what moves" in says["scans and poses"]
    assert all("objects that move taken out" in says[name] for name in ("semantic kitti", "kitti raw"))


def test_a_drive_of_few_times_says_so(fresh):
    folder = fresh("kitti raw")
    path = folder / "velodyne_points" / "timestamps.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:3]))
    with pytest.raises(ValueError, match=r"has 3 times, too few for scan 0000000003"):
        open_recording(folder)


def test_the_test_part_of_nuscenes_has_other_scans_only(fresh):
    folder = fresh("nuscenes")
    (folder / "v1.0-mini" / "sample_annotation.json").write_text("[]")
    assert open_recording(folder).sources == ("aggregated",)


def test_truth_is_made_once(written):
    recording = open_recording(written("scans and poses"))
    assert recording[1].truth is recording[1].truth
    frame = recording[2]
    assert frame.points is frame.points


def test_a_recording_goes_to_another_process(written):
    recording = open_recording(written("kitti raw"), truth=("aggregated",), others="later")
    twin = pickle.loads(pickle.dumps(recording))
    assert twin.sources == ("aggregated",)
    assert (twin[1].truth.state == recording[1].truth.state).all()


# --- What is wrong with a folder --------------------------------------------------------------------


def test_nothing_there(tmp_path):
    with pytest.raises(FileNotFoundError, match="check the name"):
        open_recording(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"holds no scan.*SemanticKITTI.*nuScenes.*Argoverse"):
        open_recording(tmp_path)


def test_nothing_labelled(fresh):
    folder = fresh("scans and poses")
    (folder / "derived" / "poses_lidar.txt").unlink()
    with pytest.raises(ValueError, match=r"nothing that says what is true.*looked for: poses.*add them"):
        open_recording(folder)


def test_labels_that_are_asked_for_but_not_there(written):
    with pytest.raises(ValueError, match=r"has no map to make truth of; has boxes, aggregated. give"):
        open_recording(written("kitti raw"), truth=("boxes", "map"))
    with pytest.raises(ValueError, match=r"truth must be of boxes, classes, map, aggregated, got 'lanes'"):
        open_recording(written("kitti raw"), truth=("lanes",))


def remove(folder, name):
    for path in sorted(folder.glob(name)):
        path.unlink()


@pytest.mark.parametrize(
    ("name", "without", "message"),
    [
        ("kitti object", "label_2/000001.txt", r"scan 000001.bin has no label .*000001.txt: add it"),
        ("kitti object", "calib/000001.txt", r"scan 000001.bin has no calibration"),
        ("semantic kitti", "sequences/07/labels/000002.label", r"has no labels .*000002.label: add them"),
        ("argoverse 2", "calibration/*", r"does not say where its upper lidar stands"),
        ("argoverse 2", "map/*.npy", r"must have one file of each .*found 1, 0, 1"),
        ("argoverse 2", "city_SE3_egovehicle.feather", r"no file .*city_SE3"),
        ("nuscenes", "v1.0-mini/instance.json", r"no file .*instance.json"),
        ("nuscenes", "samples/LIDAR_TOP/*", r"names no key frame of LIDAR_TOP whose points are under"),
    ],
)
def test_a_part_is_missing(fresh, name, without, message):
    folder = fresh(name)
    remove(folder, without)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        open_recording(folder)


def test_a_drive_without_calibration_says_so(fresh):
    folder = fresh("kitti raw")
    remove(folder.parent, "calib*")
    with pytest.raises(ValueError, match=r"boxes but no calibration.*Tr_velo_to_cam and R0_rect"):
        _ = open_recording(folder)[0].objects


def test_too_few_poses(fresh):
    folder = fresh("semantic kitti")
    poses = folder / "sequences" / "07" / "poses.txt"
    poses.write_text("".join(poses.read_text().splitlines(keepends=True)[:2]))
    with pytest.raises(ValueError, match=r"2 poses, but there are 4 scans"):
        open_recording(folder)


def test_range_images_must_say_whose_they_are(tmp_path):
    np.save(tmp_path / "0.npy", np.zeros((2, 3, 6)))
    with pytest.raises(ValueError, match=r"wanted a folder named semantic_kitti or nuscenes"):
        open_recording(tmp_path)


def test_a_drive_that_shows_no_ground(fresh):
    folder = fresh("scans and poses")
    for k in range(4):
        np.full((10, 4), 0.5, np.float32).tofile(folder / f"{k:06}.bin")
    with pytest.raises(ValueError, match="no scan of data in .* shows the ground around the sensor"):
        _ = open_recording(folder)[0].T_vehicle_sensor


SPEC = GridSpec.centered(length=81.92, width=56.32, resolution=0.16)


def test_a_stray_picture_makes_no_folder_of_grids_of_a_recording(fresh):
    folder = fresh("kitti tracking")
    (folder / "preview.png").write_bytes(b"whatever")
    assert is_recording(folder)
    assert source_of(folder, SPEC).kind == "real recording"


def test_frames_of_two_sequences_have_names_of_their_own(fresh):
    folder = fresh("semantic kitti")
    shutil.copytree(folder / "sequences" / "07", folder / "sequences" / "08")
    source = source_of(folder, SPEC)
    names = [frame.name for frame in source.frames]
    assert len(set(names)) == len(names) == 8
    assert all(frame.sequence in frame.name for frame in source.frames)
