"""Files of scans, folders of them, and folders of truth grids, as data sets."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from cases import refused

from ogm.datasets import open_dataset
from ogm.grid import EvidentialGrid, GridSpec
from ogm.simulation.exchange import write_label
from ogm.state import CellState, Truth

HEIGHT = 1.7
SPEC = GridSpec.centered(length=24, width=16, resolution=0.5)


def cloud(height: float = HEIGHT) -> np.ndarray:
    """Flat ground, and a wall across the way."""
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(-20, 20, (20_000, 2)), np.full(20_000, -height), np.full(20_000, 0.5)])
    return ground.astype(np.float32)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three scans whose names sort wrongly as text, and a note."""
    place = tmp_path / "drive"
    place.mkdir()
    for k, height in ((9, 1.7), (10, 1.8), (11, 1.7)):
        cloud(height).tofile(place / f"scan_{k}.bin")
    (place / "notes.txt").write_text("not a scan")
    return place


def test_a_folder_of_scans_is_one_sequence_in_the_order_of_its_numbers(folder: Path) -> None:
    dataset = open_dataset(folder)
    assert (dataset.name, dataset.format, dataset.files) == ("drive", "scans", (folder,))
    assert [frame.name for frame in dataset] == ["scan_9", "scan_10", "scan_11"]
    assert dataset.sequences == {"drive": [0, 1, 2]}
    assert all(frame.stamp is frame.T_map_sensor is None for frame in dataset)
    assert dataset[0].boxes is None
    assert dataset[1].mount.sensor_height == pytest.approx(1.7, abs=0.01)  # the median of all three
    assert len(dataset[0].scan) == 20_000  # nothing is known of the ego vehicle: models drop its returns


def test_scans_may_lie_one_folder_below(folder: Path) -> None:
    folder.rename(folder.parent / "velodyne")
    assert [frame.name for frame in open_dataset(folder.parent)] == ["scan_9", "scan_10", "scan_11"]


def test_files_are_a_sequence_if_their_names_differ_in_numbers_alone(folder: Path) -> None:
    files = [folder / f"scan_{k}.bin" for k in (10, 9)]
    dataset = open_dataset(files)
    assert [frame.name for frame in dataset] == ["scan_9", "scan_10"]
    assert (dataset.sequences, dataset.name, dataset.files[0]) == ({"drive": [0, 1]}, "drive", files[1])
    cloud(2.0).tofile(folder / "other.bin")
    alone = open_dataset([*files, folder / "other.bin"])
    assert alone.sequences == {}
    assert [frame.mount.sensor_height for frame in alone] == pytest.approx([2.0, 1.7, 1.8], abs=0.01)


def test_files_of_one_name_keep_their_paths(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "scan_9.bin"
    cloud().tofile(other)
    names = [frame.name for frame in open_dataset([folder / "scan_9.bin", other])]
    assert names == [str(folder / "scan_9.bin"), str(other)]


def test_names_of_a_clock_are_stamps(tmp_path: Path) -> None:
    for k in range(3):
        cloud().tofile(tmp_path / f"{1_700_000_000_000_000 + 50_000 * k}.bin")
    stamps = [frame.stamp for frame in open_dataset(tmp_path)]
    assert stamps == pytest.approx([1.7e9, 1.7e9 + 0.05, 1.7e9 + 0.1], abs=1e-6)


def test_scans_are_read_as_the_options_state(tmp_path: Path) -> None:
    points = cloud()
    points[:, 3] = 40
    np.save(tmp_path / "a.npy", points[:, [1, 0, 2, 3]] * [1, -1, 1, 1])
    frame = open_dataset(tmp_path / "a.npy", axes=("-y", "+x", "+z"), intensity_max=80.0, sensor_height=1.6)[0]
    np.testing.assert_allclose(frame.scan.points, np.column_stack([points[:, :3], np.full(20_000, 0.5)]))
    assert frame.mount.sensor_height == 1.6


def test_a_damaged_scan_does_not_hide_the_height_of_a_drive(folder: Path) -> None:
    (folder / "scan_9.bin").write_bytes(b"xyz")
    dataset = open_dataset(folder)
    assert dataset[0].mount.sensor_height == pytest.approx(1.75, abs=0.01)
    with pytest.raises(ValueError, match=r"scan_9.bin"):
        _ = dataset[0].scan


def test_poses_that_do_not_fit_are_not_used_and_the_reason_is_kept(folder: Path) -> None:
    (folder / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    dataset = open_dataset(folder)
    assert dataset.format == "scans"
    with pytest.raises(ValueError, match="which are not used: .* has 1 poses for 3 scans"):
        _ = dataset[0].truth


def test_a_data_set_of_files_goes_to_another_process(folder: Path) -> None:
    dataset = open_dataset(folder, sensor_height=1.5)
    other = pickle.loads(pickle.dumps(dataset.select([2, 0])))
    assert [frame.name for frame in other] == ["scan_11", "scan_9"]
    assert other[0].mount == dataset[2].mount
    assert np.array_equal(other[0].scan.points, dataset[2].scan.points)


def test_wrong_paths_are_refused(folder: Path, tmp_path: Path) -> None:
    refused("one folder alone", open_dataset, [folder, folder / "scan_9.bin"])
    with pytest.raises(FileNotFoundError, match="there is no file or folder"):
        open_dataset([tmp_path / "a.bin", tmp_path / "b.bin"])
    refused("no path to open", open_dataset, [])
    refused("axes", open_dataset, folder, axes="foo")
    (folder / "scan_9.pcd").write_bytes(b"")
    refused("several formats", open_dataset, folder)
    (folder / "scan_9.pcd").rename(folder / "scan_9.bin.xz")
    refused("holds scan_9 twice", open_dataset, folder)


# --- Truth grids ------------------------------------------------------------------------------------


@pytest.fixture
def grids(tmp_path: Path) -> tuple[Path, Truth]:
    """One truth in three formats."""
    state = np.zeros(SPEC.shape, np.uint8)
    state[10:20, 5:20], state[20:22, 5:20] = CellState.FREE, CellState.OCCUPIED
    truth, folder = Truth(SPEC, state), tmp_path / "grids"
    folder.mkdir()
    write_label(folder / "a.png", truth)
    np.save(folder / "b.npy", state)
    EvidentialGrid(SPEC, truth.grid.mass * np.float32(0.9)).save(folder / "c.npz")
    return folder, truth


def test_a_folder_of_grids_is_truth_without_scans(grids: tuple[Path, Truth]) -> None:
    folder, truth = grids
    dataset = open_dataset(folder, spec=SPEC)
    assert (dataset.name, dataset.format, dataset.facts) == ("grids", "truth grids", {"files": 3})
    assert "largest mass" in dataset.description
    assert [path.name for path in dataset.files] == ["a.png", "b.npy", "c.npz"]
    for frame, name in zip(dataset, "abc", strict=True):
        assert (frame.name, frame.sequence) == (name, "")
        assert np.array_equal(frame.truth.state, truth.state)
        with pytest.raises(ValueError, match="holds grids of truth and no scans"):
            _ = frame.scan


def test_grids_need_the_cells_that_they_show(grids: tuple[Path, Truth]) -> None:
    folder, _ = grids
    for name in ("b.npy", "c.npz"):
        (folder / name).unlink()
    refused("it holds grids: give their `spec`", open_dataset, folder)
    refused(r"`truth` is for recordings", open_dataset, folder, spec=SPEC, truth="boxes")
    (folder / "a.npz").write_bytes(b"")
    refused("two grids of a", open_dataset, folder, spec=SPEC)


def test_a_truth_of_other_cells_is_refused(tmp_path: Path) -> None:
    for spec in (GridSpec.centered(24.0, 16.0, 0.4), GridSpec(0.5, SPEC.shape, (-11.9, -8.0))):
        EvidentialGrid.vacuous(spec).save(tmp_path / "0.npz")
        with pytest.raises(ValueError, match=rf"0.npz has cells of {spec.resolution} m .* is not resampled"):
            _ = open_dataset(tmp_path, spec=SPEC)[0].truth
    np.save(tmp_path / "1.npy", np.full(SPEC.shape, 4, np.uint8))
    with pytest.raises(ValueError, match="must hold states 0 unknown"):
        _ = open_dataset(tmp_path, spec=SPEC)[1].truth
    np.save(tmp_path / "1.npy", np.full(SPEC.shape, 3, np.uint8))
    assert open_dataset(tmp_path, spec=SPEC)[1].truth.shares().ignore == 1
