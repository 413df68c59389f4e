"""``ogm fuse``, as a person uses it: a small drive between four walls."""

import importlib
import re
from pathlib import Path

import numpy as np
import pytest
from cases import each, fail_call
from commands import completed, ogm, refused_command
from PIL import Image
from samples import BEAMS, flat_sample, flat_steps
from wall_drive import HEIGHT, WALL, world, write_kitti, write_scans

from ogm.datasets import open_dataset, with_poses
from ogm.geometric import RayISM
from ogm.grid import EvidentialGrid, GridSpec
from ogm.io import read_poses, write_poses
from ogm.plot.viewer import write_view
from ogm.pose import Trajectory, inverse, pose, transform_points
from ogm.simulation.sample import SimulatedSample as Sample
from ogm.simulation.store import Store
from ogm.workflows import FuseOptions, Outputs, fuse_drive

FUSE = importlib.import_module("ogm.workflows.fuse_options")
FRAMES = 8
SMALL = ("--length", 24, "--width", 16, "--resolution", 0.5)
POSES = np.array([pose(0.4 * k, 0.05 * k, yaw=0.02 * k) for k in range(FRAMES)])
STAMPS = np.arange(FRAMES) / 10


@pytest.fixture(scope="session")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of KITTI files whose names sort wrongly as text."""
    folder = write_scans(tmp_path_factory.mktemp("drive"), world(), POSES, "scan_{}.bin", 5)
    (folder / "notes.txt").write_text("not a scan")
    return folder


def kitti(path: Path, poses: np.ndarray = POSES, first: int | None = 5) -> Path:
    return write_kitti(path, poses, first)


@pytest.fixture
def poses(tmp_path: Path) -> Path:
    return kitti(tmp_path / "poses.txt")


def test_all_formats_of_poses_give_the_same_map(scans: Path, tmp_path: Path, poses: Path) -> None:
    write_poses(tmp_path / "tum.txt", Trajectory(STAMPS, POSES))
    write_poses(tmp_path / "ours.csv", Trajectory(STAMPS, POSES), np.arange(FRAMES) + 5)
    kitti(tmp_path / "plain.txt", first=None)
    kitti(tmp_path / "whole.txt", np.concatenate([POSES[[0] * 5], POSES, POSES[-1:]]), None)
    maps = []
    order = {"poses.txt": "by frame number", "tum.txt": "in their order", "ours.csv": "by frame number"}
    for name, how in (order | {"plain.txt": "in their order", "whole.txt": "row by frame number"}).items():
        result = completed("fuse", scans, "--poses", tmp_path / name, "--out", tmp_path / "m.npz", *SMALL)
        assert how in result.output
        assert "8 mapped, 0 skipped" in result.output
        assert "sensor height 1.70 m" in result.output
        maps.append(EvidentialGrid.load(tmp_path / "m.npz"))
    assert all(one.spec == maps[0].spec for one in maps)
    assert all(np.allclose(one.mass, maps[0].mass, atol=1e-5) for one in maps)
    assert maps[0].at(WALL + 0.25, 1.0).occupied > 0.9
    assert maps[0].at(7.0, 1.0).free > 0.8


def test_a_drive_is_fused_from_python_as_by_the_command(scans: Path, poses: Path, tmp_path: Path) -> None:
    drive = with_poses(open_dataset(scans), poses)
    options = FuseOptions(spec=GridSpec.centered(length=24, width=16, resolution=0.5))
    run = fuse_drive(drive, Outputs(map=tmp_path / "python.npz"), options)
    assert (run.facts()["scans"], run.code) == ("8 mapped, 0 skipped", 0)
    assert ogm("fuse", scans, "--poses", poses, "--out", tmp_path / "command.npz", *SMALL).exit_code == 0
    own, other = (EvidentialGrid.load(tmp_path / name) for name in ("python.npz", "command.npz"))
    assert own.spec == other.spec
    np.testing.assert_array_equal(own.mass, other.mass)


def test_a_film_has_a_frame_per_scan_at_the_pace_of_the_drive(scans: Path, poses: Path, tmp_path: Path) -> None:
    movie, picture = tmp_path / "m.gif", tmp_path / "m.png"
    result = completed("fuse", scans, "--poses", poses, "--rate", 5, "--picture", picture, "--movie", movie, *SMALL)
    assert "1.4 s" in result.output
    with Image.open(movie) as film, Image.open(picture) as shown:
        assert film.n_frames == FRAMES
        assert film.info["duration"] == 200
        assert film.info["loop"] == 0
        assert film.size[0] <= 1600
        assert shown.size[0] > shown.size[1]
        film.seek(FRAMES - 1)
        assert film.info["duration"] == 1000
        colours = {colour for _, colour in film.convert("RGB").getcolors(2**24)}
    assert {(41, 120, 217), (255, 166, 31)} <= colours  # free and occupied, as in `ogm.plot.colours`
    assert not (tmp_path / "map.npz").exists()


def test_damaged_scans_are_skipped_and_the_rest_goes_on(scans: Path, tmp_path: Path, poses: Path) -> None:
    folder = tmp_path / "drive"
    folder.mkdir()
    for path in scans.glob("*.bin"):
        (folder / path.name).write_bytes(path.read_bytes())
    (folder / "scan_7.bin").write_bytes(b"xyz")
    (folder / "scan_8.bin").write_bytes(b"")
    result = ogm("fuse", folder, "--poses", poses, "--out", tmp_path / "m.npz", *SMALL)
    assert result.exit_code == 2
    assert "6 mapped, 2 skipped" in result.output
    assert "scan_7 is skipped" in result.output
    assert EvidentialGrid.load(tmp_path / "m.npz").at(WALL + 0.25, 1.0).occupied > 0.9


def test_scans_that_are_skipped_for_one_reason_are_not_all_listed(scans: Path, tmp_path: Path, poses: Path) -> None:
    folder = tmp_path / "drive"
    folder.mkdir()
    for n, path in enumerate(sorted(scans.glob("*.bin"))):
        (folder / path.name).write_bytes(b"xyz" * n if n else path.read_bytes())
    result = ogm("fuse", folder, "--poses", poses, "--out", tmp_path / "m.npz", "--sensor-height", 1.7, *SMALL)
    assert "1 mapped, 7 skipped" in result.output
    assert result.output.count("is skipped") == 3
    assert result.output.count("further scans with the same reason are only counted") == 1


def test_one_glitch_of_the_pose_is_skipped(scans: Path, tmp_path: Path) -> None:
    off = POSES.copy()
    off[3, 0, 3] += 500
    result = ogm("fuse", scans, "--poses", kitti(tmp_path / "p.txt", off), "--out", tmp_path / "m.npz", *SMALL)
    assert result.exit_code == 2
    assert "7 mapped, 1 skipped" in result.output
    assert "scan_8 is skipped: the pose jumps" in result.output
    assert not list(tmp_path.glob("*.before-jump-*"))


def test_after_three_jumps_the_map_begins_anew_and_the_old_one_is_kept(scans: Path, tmp_path: Path) -> None:
    off = POSES.copy()
    off[4:, 0, 3] += 500
    result = ogm("fuse", scans, "--poses", kitti(tmp_path / "p.txt", off), "--out", tmp_path / "m.npz", *SMALL)
    assert result.exit_code == 2
    assert "6 mapped, 2 skipped" in result.output
    assert "1, after jumps of pose or stamp" in result.output
    before, after = (EvidentialGrid.load(tmp_path / name) for name in ("m.before-jump-1.npz", "m.npz"))
    assert before.at(WALL + 0.25, 1.0).occupied > 0.9
    assert after.at(500 + WALL + 0.25, 1.0).occupied > 0.9


@each("error, code", [(KeyboardInterrupt(), 130), (RuntimeError("the device is lost"), 2)])
def test_an_error_or_interrupt_half_way_writes_the_map_so_far(
    scans: Path, tmp_path: Path, poses: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, code: int
) -> None:
    fail_call(monkeypatch, RayISM, "__call__", 4, error)
    out, movie = tmp_path / "m.npz", tmp_path / "m.png"
    result = ogm("fuse", scans, "--poses", poses, "--out", out, "--movie", movie, *SMALL)
    assert result.exit_code == code, result.output
    assert "after 3 scans" in result.output
    assert "3 mapped" in result.output
    assert EvidentialGrid.load(out).at(WALL + 0.25, 1.0).occupied > 0.5
    with Image.open(movie) as film:
        assert film.n_frames == 3


def test_nothing_mapped_is_an_error_and_writes_nothing(scans: Path, tmp_path: Path, poses: Path) -> None:
    for k in range(2):
        (tmp_path / f"scan_{k + 5}.bin").write_bytes(b"xyz")
    words = ("--poses", poses, "--sensor-height", HEIGHT, "--out", tmp_path / "m.npz", "--movie", tmp_path / "m.gif")
    result = ogm("fuse", tmp_path / "scan_5.bin", tmp_path / "scan_6.bin", *words)
    assert result.exit_code == 2
    assert "no scan could be mapped" in result.output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["poses.txt", "scan_5.bin", "scan_6.bin"]


@each("numbered", [5, None])
def test_the_first_scans_alone_can_be_mapped(scans: Path, tmp_path: Path, numbered: int | None) -> None:
    poses = kitti(tmp_path / "poses.txt", first=numbered)
    result = completed("fuse", scans, "--poses", poses, "--first", 3, "--out", tmp_path / "m.npz", *SMALL)
    assert "3 mapped, 0 skipped" in result.output
    refused_command("--first must be at least 1", "fuse", scans, "--poses", poses, "--first", 0, *SMALL)


@each("rule", ["dempster", "pcr6", "weighted", "bayes"])
def test_every_rule_maps_the_drive(scans: Path, poses: Path, tmp_path: Path, rule: str) -> None:
    movie = ("--movie", tmp_path / "m.png") if rule == "bayes" else ()  # it has other panels
    words = ("--rule", rule, "--half-life", 1, "--out", tmp_path / "m.npz", *movie)
    result = completed("fuse", scans, "--poses", poses, *words, *SMALL)
    assert (f"rule {rule} adds up evidence" in result.output) == (rule != "weighted")
    grid = EvidentialGrid.load(tmp_path / "m.npz")
    assert grid.at(WALL + 0.25, 1.0).occupied > 0.5
    assert grid.at(7.0, 1.0).free > 0.4


def test_a_fixed_window_maps_the_drive(scans: Path, poses: Path, tmp_path: Path) -> None:
    completed("fuse", scans, "--poses", poses, "--window", "fixed", "--out", tmp_path / "m.npz", *SMALL)
    grid = EvidentialGrid.load(tmp_path / "m.npz")
    assert grid.spec.extent[0] <= -12
    assert grid.spec.extent[1] >= POSES[-1, 0, 3] + 12
    assert grid.at(WALL + 0.25, 1.0).occupied > 0.9


def test_deskewing_takes_the_ego_motion_out(tmp_path: Path) -> None:
    """At 20 m/s a scan of 0.1 s is distorted by 2 m; --deskew gives the map of undistorted scans."""
    distorted, straight = tmp_path / "distorted", tmp_path / "straight"
    distorted.mkdir()
    straight.mkdir()
    moving = np.array([pose(2.0 * k - 4.0) for k in range(4)])
    points = world()[::3]
    time = np.linspace(-0.05, 0.05, len(points))
    for k, T in enumerate(moving):
        now = transform_points(inverse(T), points)
        now.astype(np.float32).tofile(straight / f"{k}.bin")
        now[:, 0] -= 20.0 * time
        header = "FIELDS x y z intensity time\nSIZE 4 4 4 4 8\nTYPE F F F F F\nCOUNT 1 1 1 1 1\n"
        header += f"WIDTH {len(now)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(now)}\nDATA binary\n"
        rows = np.empty(len(now), "f4,f4,f4,f4,f8")
        for name, column in zip(rows.dtype.names or (), (*now.T, time), strict=True):
            rows[name] = column
        (distorted / f"{k}.pcd").write_bytes(b"# .PCD v0.7\nVERSION 0.7\n" + header.encode() + rows.tobytes())
    kitti(tmp_path / "p.txt", moving, 0)
    words = ("--poses", tmp_path / "p.txt", "--sensor-height", HEIGHT, *SMALL)
    grids = []
    for folder, more in ((straight, ()), (distorted, ("--deskew",)), (distorted, ())):
        result = completed("fuse", folder, *words, *more, "--out", tmp_path / "m.npz")
        grids.append(EvidentialGrid.load(tmp_path / "m.npz").occupied)
    off = [float(np.abs(one - grids[0]).mean()) for one in grids[1:]]
    assert off[0] < 0.1 * off[1]
    assert "while turning" not in result.output
    kitti(tmp_path / "q.txt", np.array([pose(2.0 * k, yaw=-0.1 * k) for k in range(4)]), 0)
    turning = ("--poses", tmp_path / "q.txt", *words[2:], "--out", tmp_path / "t.npz")
    result = completed("fuse", distorted, *turning)
    assert "3 of 4 scans were taken while turning, by up to 5.7 degrees" in " ".join(result.output.split())
    assert "while turning" not in completed("fuse", distorted, *turning, "--deskew").output
    result = ogm("fuse", straight, *words, "--deskew", "--out", tmp_path / "n.npz")
    assert result.exit_code == 2
    assert "the points have no times" in result.output


def sample(index: int) -> Sample:
    """Flat ground before a wall at x = 10 m, the vehicle 0.4 m further for each index."""
    places = {"T_world_sensor": pose(0.4 * index, 0, 1.9), "T_vehicle_sensor": pose(1.0, 0, 1.9)}
    steps = flat_steps(wall=WALL + 0.25 - 0.4 * index)
    return flat_sample("sequences", index, steps, stamp=20 + 0.1 * index, **places)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set with a sequence of which three frames are finished."""
    folder = tmp_path_factory.mktemp("fuse") / "data"
    store = Store.create(folder, {"seed": 1}, {"training": 10, "sequences": 3}, [BEAMS], {"ogm": "0"})
    store.write("sequences", 0, [sample(k) for k in range(3)])
    return folder


def test_a_simulated_drive_has_its_poses_and_its_mount(data: Path, tmp_path: Path) -> None:
    result = completed("fuse", data, "--out", tmp_path / "m.npz", "--save-poses", tmp_path / "p.txt", *SMALL)
    assert "3 mapped, 0 skipped" in result.output
    assert EvidentialGrid.load(tmp_path / "m.npz").at(WALL + 0.25, 0.0).occupied > 0.5
    used = read_poses(tmp_path / "p.txt")
    assert used.stamps is not None
    assert np.allclose(used.stamps, [20, 20.1, 20.2])
    assert np.allclose(used.poses[:, 0, 3], [0, 0.4, 0.8])


@each("words, message", [
        (("{scans}",), "--odometry kiss-icp"),
        (("{scans}", "--poses", "{poses}", "--odometry", "kiss-icp"), "exclude each other"),
        (("{scans}", "--poses", "{poses}", "--rule", "magic"), "there is no rule 'magic'; there are revise, cautious"),
        (("{scans}", "--poses", "{poses}", "--ism", "magic"), "magic"),
        (("{scans}", "--poses", "{poses}", "--window", "round"), "rolling, fixed"),
        (("{scans}", "--odometry", "magic"), "kiss-icp or small-gicp"),
        (("{scans}", "--poses", "{poses}", "--half-life", "-1"), "half_life must be greater than 0 s"),
        (("{scans}", "--poses", "{poses}", "--length", "10.3"), "use 10 m or 10.5 m"),
        (("{scans}", "--poses", "{poses}", "--out", "{poses}/x.npz"), "the map cannot be written into"),
        (("{scans}", "--poses", "{poses}", "--out", "{folder}/x.txt"), "the map must end in .npz"),
        (("{scans}", "--poses", "{poses}", "--movie", "{folder}/x.mp4"), "the movie must end in .gif or .webp"),
        (("{scans}", "--poses", "{poses}", "--picture", "{folder}/x.png", "--movie", "{folder}/x.png"), "both be"),
        (("{scans}", "--poses", "{poses}", "--page", "{folder}/x.htm"), "the page must end in .html"),
        (("{scans}", "--poses", "{poses}", "--save-poses", "{poses}"), "would overwrite"),
        (("{scans}", "--poses", "{folder}/none.txt"), "none.txt"),
        (("{scans}", "--calib", "{poses}"), "--calib needs --poses"),
        (("{scans}", "--poses", "{far}", "--window", "fixed"), "give --window rolling, or a coarser --resolution"),
        (("{folder}", "--poses", "{poses}"), "holds no scans"),
        (("{scans}", "--sequence", "1"), "--sequence must be one of drive"),
        (("{scans}/scan_5.bin", "--sequence", "1"), "--sequence selects a drive by name"),
        (("{data}", "--sequence", "7"), "--sequence must be one of sequence 0, got 7"),
        (("{data}", "--deskew"), "distorted by motion in all scans"),
    ])  # fmt: skip
def test_errors_are_one_line_and_exit_code_2_before_the_work(
    scans: Path, data: Path, tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    names = {"scans": scans, "folder": tmp_path, "poses": kitti(tmp_path / "poses.txt"), "data": data}
    far = POSES.copy()
    far[-1, :2, 3] = 1e5
    names["far"] = kitti(tmp_path / "far.txt", far)
    more = () if {"--out", "--picture"} & set(words) else ("--out", tmp_path / "m.npz")
    refused_command(
        message, "fuse", *SMALL, *(word.format(**names) for word in words), *more
    )  # the last --length counts
    assert not list(tmp_path.glob("*.npz"))


def test_a_folder_that_cannot_be_written_is_found_before_the_work(
    scans: Path, poses: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(**_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("ogm.storage.files.tempfile.TemporaryFile", refused)
    result = ogm("fuse", scans, "--poses", poses, "--out", tmp_path / "m.npz")
    assert result.exit_code == 2
    assert "the map cannot be written into" in result.output
    assert "Permission denied" in result.output


def test_outputs_may_lie_in_new_folders_and_extents_follow_the_resolution(
    scans: Path, poses: Path, tmp_path: Path
) -> None:
    out = tmp_path / "new" / "dir" / "m.npz"
    words = ("--out", out, "--first", 2, "--resolution", 0.7, "--sensor-height", HEIGHT)
    completed("fuse", scans, "--poses", poses, *words)
    assert EvidentialGrid.load(out).spec.resolution == 0.7


def test_a_page_shows_the_map_and_its_conflict(scans: Path, poses: Path, tmp_path: Path) -> None:
    """The page holds what `write_view` makes of the map that is saved beside it; the Bayes filter has no conflict."""
    for rule, has_conflict in (("cautious", True), ("bayes", False)):
        page, grid = tmp_path / f"{rule}.html", tmp_path / f"{rule}.npz"
        words = ("--rule", rule, "--page", page, "--out", grid, *SMALL)
        result = completed("fuse", scans, "--poses", poses, *words)
        assert f"page {page}" in result.output
        write_view(tmp_path / "alone.html", EvidentialGrid.load(grid))
        masses = [
            dict(re.findall(r'<script type="text/plain" id="(0/[^"]*)">([^<]+)<', one.read_text()))
            for one in (page, tmp_path / "alone.html")
        ]
        assert masses[0] == masses[1]
        assert masses[0]
        assert ("free_to_occupied" in page.read_text()) == has_conflict
        assert ("behind an obstacle" in page.read_text()) == has_conflict  # why cells are unknown
        assert "vehicle at the last scan, with its path" in page.read_text()


@pytest.fixture
def sequences(scans: Path, tmp_path: Path) -> Path:
    """Two sequences of KITTI odometry, the second with scans 5 to 8 of the drive."""
    for name, numbers in (("00", range(4)), ("07", range(4, 8))):
        folder = tmp_path / "sequences" / name
        (folder / "velodyne").mkdir(parents=True)
        for row, k in enumerate(numbers):
            (folder / "velodyne" / f"{row:06d}.bin").write_bytes((scans / f"scan_{k + 5}.bin").read_bytes())
        kitti(folder / "poses.txt", POSES[list(numbers)], None)
        identity = " ".join(map(str, np.eye(4)[:3].ravel()))
        (folder / "calib.txt").write_text(f"P0: {identity}\nTr: {identity}\n")
    return tmp_path


def test_a_data_set_with_its_own_poses_needs_none_and_a_drive_is_picked_by_name(
    sequences: Path, tmp_path: Path
) -> None:
    saved = tmp_path / "p.csv"
    words = ("--out", tmp_path / "m.npz", "--save-poses", saved, *SMALL)
    for given, first in (((), 0), (("--sequence", "07"), 4), (("--sequence", 1), 4)):
        result = completed("fuse", sequences, *given, *words)
        assert "4 mapped, 0 skipped" in result.output
        assert ("drive: 00, the first of 2" in result.output) is (given == ())
        assert np.allclose(read_poses(saved).poses[0], POSES[first], atol=1e-6)


@pytest.mark.parametrize("workers", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_each_drive_has_the_files_that_it_has_alone(sequences: Path, tmp_path: Path, workers: int) -> None:
    (sequences / "sequences" / "00" / "velodyne" / "000002.bin").write_bytes(b"damaged")
    folder, alone = tmp_path / "maps", tmp_path / "alone"
    words = ("--out", folder / "m.npz", "--picture", folder / "p.png", "--workers", workers, *SMALL)
    for repeated in (False, True):
        result = ogm("fuse", sequences, "--each-drive", *words)
        assert result.exit_code == 2, result.output  # for the damaged scan
        assert "000002 is skipped" in result.output
        words_of_output = " ".join(result.output.split())  # long paths are wrapped
        assert words_of_output.count("was finished before") == 2 * repeated, words_of_output
    for name in ("00", "07"):
        ogm("fuse", sequences, "--sequence", name, "--out", alone / "m.npz", "--picture", alone / "p.png", *SMALL)
        (drive,) = [path for path in folder.iterdir() if path.name.endswith(f"-{name}")]
        assert sorted(path.name for path in drive.iterdir()) == ["drive.json", "m.npz", "p.png"]
        assert (drive / "p.png").read_bytes() == (alone / "p.png").read_bytes()
        assert EvidentialGrid.load(drive / "m.npz") == EvidentialGrid.load(alone / "m.npz")
    result = ogm("fuse", sequences, "--each-drive", *words, "--rule", "dempster")
    assert "of other frames or options" in result.output


@each("words, message", [
        (("--workers", 2), "are for --each-drive"),
        (("--each-drive", "--sequence", "00"), "are for one drive"),
        (("--each-drive", "--out", "a/m.npz", "--picture", "b/p.png"), "must be in one folder, got a, b"),
    ])  # fmt: skip
def test_options_of_many_drives_that_exclude_others(
    scans: Path, tmp_path: Path, words: tuple[object, ...], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    refused_command(message, "fuse", scans, *words)
