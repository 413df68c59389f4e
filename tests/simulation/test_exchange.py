"""The paper's layout: what is exported comes back, the right way round."""

from pathlib import Path

import numpy as np
import pytest
from cases import refused
from PIL import Image
from stand_in import BEAMS, stand_in

from ogm import read_points
from ogm.simulation.exchange import PAPER_GRID, export, read_label, write_label, write_pcd
from ogm.simulation.store import Store
from ogm.state import CellState, Truth


@pytest.fixture
def store(tmp_path: Path) -> Store:
    """Three training samples, one of test, a sequence that is only planned."""
    counts = {"training": 3, "validation": 0, "test": 1, "sequences": 100}
    store = Store.create(tmp_path / "data", {}, counts, BEAMS, {})
    store.write("training", 0, [stand_in(None, "training", i) for i in range(3)])
    store.write("test", 0, [stand_in(None, "test", 0)])
    return store


def l_shape() -> Truth:
    """An obstacle in the shape of an L: along x on the left, its foot to the right at the front."""
    state = np.zeros(PAPER_GRID.shape, np.uint8)
    ix, iy = PAPER_GRID.index(np.array([10.0, 30.0]), np.array([-5.0, 20.0]))
    state[ix[0] : ix[1], iy[1]] = CellState.OCCUPIED
    state[ix[1], iy[0] : iy[1]] = CellState.OCCUPIED
    state[: ix[0]] = CellState.FREE
    return Truth(PAPER_GRID, state)


def test_front_is_up_and_left_is_left(tmp_path: Path) -> None:
    write_label(tmp_path / "l.png", l_shape())
    image = np.asarray(Image.open(tmp_path / "l.png"))
    assert image.shape == (512, 352, 3)
    rows, columns = np.nonzero(image[..., 2])
    assert set(image[..., 2].ravel()) == {0, 255}
    assert rows.max() < 256  # all of the L is ahead of the sensor, which is in the middle
    top = columns[rows == rows.min()]
    assert top.min() < 176 - 100  # 20 m to the left: 125 cells
    assert 176 < top.max() < 176 + 40
    assert (columns[rows > rows.min() + 1] == top.min() - 1).all()  # the long side is the left one
    assert (image[300:, :, 1] == 255).all()  # what is behind is free, green
    assert (image[..., 0] == 0).all()


def test_labels_come_back(tmp_path: Path) -> None:
    write_label(tmp_path / "l.png", l_shape())
    np.testing.assert_array_equal(read_label(tmp_path / "l.png").state, l_shape().state)


def test_what_is_to_be_ignored_becomes_unknown(tmp_path: Path) -> None:
    write_label(tmp_path / "l.png", Truth(PAPER_GRID, np.full(PAPER_GRID.shape, CellState.IGNORE, np.uint8)))
    assert (read_label(tmp_path / "l.png").state == CellState.UNKNOWN).all()


def test_points_come_back(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(-50, 50, (100, 4)).astype(np.float32)
    points[:, 3] = np.arange(100) / 255
    write_pcd(tmp_path / "p.pcd", points)
    np.testing.assert_allclose(read_points(tmp_path / "p.pcd"), points, rtol=1e-6)


def test_a_data_set_is_exported_and_imported(tmp_path: Path, store: Store) -> None:
    assert export(store, tmp_path / "paper") == 4
    names = {path.name for path in (tmp_path / "paper").iterdir()}
    assert names == {"input_train", "label_train", "input_test", "label_test"}
    clouds, labels = (sorted((tmp_path / "paper" / name).iterdir()) for name in ("input_train", "label_train"))
    assert (
        [path.stem for path in clouds] == [path.stem for path in labels] == ["0000000001", "0000000002", "0000000003"]
    )
    for cloud, label, sample in zip(clouds, labels, store["training"], strict=True):
        np.testing.assert_allclose(read_points(cloud, intensity_max=255.0), sample.points, rtol=1e-5)
        wanted = sample.truth.crop(PAPER_GRID).state
        np.testing.assert_array_equal(
            read_label(label).state, np.where(wanted == CellState.IGNORE, CellState.UNKNOWN, wanted)
        )


def test_the_papers_weak_colours_count(tmp_path: Path) -> None:
    """Labels were seen with 85 instead of 255, and an opaque alpha channel."""
    image = np.zeros((512, 352, 4), np.uint8)
    image[..., 3] = 255
    image[0, 0, 1], image[511, 351, 2] = 85, 85
    Image.fromarray(image).save(tmp_path / "weak.png")
    state = read_label(tmp_path / "weak.png").state
    assert state[-1, -1] == CellState.FREE
    assert state[0, 0] == CellState.OCCUPIED


def test_what_does_not_fit_is_reported(tmp_path: Path) -> None:
    label = tmp_path / "label.png"
    Image.fromarray(np.zeros((256, 176, 3), np.uint8)).save(label)
    refused("RGB of 256 x 176, wanted RGB of 512 rows x 352 columns", read_label, label)
    Image.fromarray(np.full((512, 352, 3), 255, np.uint8)).save(label)
    refused("cells both free and occupied", read_label, label)
    label.write_bytes(label.read_bytes()[:200])
    refused("damaged or no image", read_label, label)
    label.write_bytes(b"no picture at all")
    refused("damaged or no image", read_label, label)
    with pytest.raises(FileNotFoundError):
        read_label(tmp_path / "none.png")
