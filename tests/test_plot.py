"""Pictures: an L-shaped obstacle must come out with front up and left left."""

from pathlib import Path

import matplotlib
import numpy as np
import pytest

from ogm import EvidentialGrid, GridSpec, LayeredGrid, plot

matplotlib.use("Agg")
SPEC = GridSpec(1.0, (7, 5), (-2.0, -2.0))


@pytest.fixture
def ell() -> EvidentialGrid:
    """A wall three cells long ahead, with two cells to the left at its far end."""
    mass = np.zeros((*SPEC.shape, 2), np.float32)
    mass[..., 0] = 0.5
    for x, y in ((2, 0), (3, 0), (4, 0), (4, 1)):
        mass[SPEC.index(x + 0.5, y + 0.5)] = 0, 1
    return EvidentialGrid(SPEC, mass)


def test_front_is_up_and_left_is_left(ell: EvidentialGrid) -> None:
    image = plot.mass_panel(ell).image
    red = image[..., 0] > 200
    assert ["".join(".#"[cell] for cell in row) for row in red.astype(int)] == [
        ".##..",
        "..#..",
        "..#..",
        ".....",
        ".....",
        ".....",
        ".....",
    ]
    assert (image[~red][:, 1] > 80).all()  # the rest is green


def test_vacuous_is_black_and_grey_and_bright() -> None:
    grid = EvidentialGrid.vacuous(SPEC)
    assert (plot.mass_panel(grid).image == 0).all()
    assert (abs(plot.probability_panel(grid).image.astype(int) - 128) <= 1).all()
    assert plot.unknown_panel(grid).image.min(axis=(0, 1))[0] > 200


def test_conflict_shows_what_appeared_and_what_went_away() -> None:
    appeared, went_away = np.zeros((2, *SPEC.shape), np.float32)
    appeared[SPEC.index(4.5, 1.5)] = 1  # ahead, left
    went_away[SPEC.index(-1.5, -1.5)] = 0.5  # behind, right
    layers = {"free_to_occupied": appeared, "occupied_to_free": went_away}
    panel = plot.conflict_panel(LayeredGrid(SPEC, layers))
    assert panel.image[0, 1].tolist() == plot._bytes(np.array(panel.legend["appeared"])).tolist()
    assert panel.image[6, 4].tolist() == plot._bytes(np.array(panel.legend["went away"]) / 2).tolist()
    assert np.count_nonzero(panel.image.any(axis=-1)) == 2
    with pytest.raises(KeyError, match="no layer 'occupied_to_free'"):
        plot.conflict_panel(LayeredGrid(SPEC, {"free_to_occupied": appeared}))


def test_probability_is_white_for_free_and_black_for_occupied(ell: EvidentialGrid) -> None:
    image = plot.probability_panel(ell).image
    assert image[0, 1].tolist() == [0, 0, 0]
    assert image[6, 0].tolist() == [191, 191, 191]  # free 0.5: probability 1/4


def test_points_lie_where_their_cells_are() -> None:
    cloud = np.array([[4.75, 1.75, 0, 0], [np.nan, 0, 0, 0], [99, 0, 0, 0]], np.float32)
    image = plot.points_panel(cloud, SPEC).image
    lit = np.argwhere(image.max(-1) > 60)
    assert lit.tolist() == [[0, 2]]
    assert plot.points_panel(cloud[:0], SPEC).image.shape == (14, 10, 3)


def test_show_draws_everything_side_by_side(ell: EvidentialGrid) -> None:
    cloud = np.zeros((1, 4), np.float32)
    figure = plot.show(cloud, ell, plot.unknown_panel(ell), titles=["a", "b", "c"])
    assert [axis.get_title() for axis in figure.axes] == ["a", "b", "c"]
    left, right, back, front = figure.axes[1].images[0].get_extent()
    assert (left, right, back, front) == (3.0, -2.0, -2.0, 5.0)
    matplotlib.pyplot.close(figure)


@pytest.mark.parametrize("call", [plot.show, lambda *a, **k: plot.save_picture("x.png", *a, **k)])
def test_what_cannot_be_shown_is_refused(call, ell: EvidentialGrid) -> None:
    with pytest.raises(ValueError, match="nothing to show"):
        call()
    with pytest.raises(ValueError, match="one per item"):
        call(ell, titles=["a", "b"])
    with pytest.raises(ValueError, match="need an area"):
        call(np.zeros((1, 4), np.float32))


def test_save_picture_is_atomic_and_refuses_other_formats(tmp_path: Path, ell: EvidentialGrid) -> None:
    plot.save_picture(tmp_path / "a.png", ell)
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(ValueError, match=r"saved as \.png"):
        plot.save_picture(tmp_path / "a.jpg", ell)
    with pytest.raises(FileNotFoundError, match="no folder"):
        plot.save_picture(tmp_path / "none" / "a.png", ell)
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_cells_and_dots_put_front_up_and_left_left_and_show_the_highest() -> None:
    spec = GridSpec.centered(length=4.0, width=2.0, resolution=1.0)
    colours = np.zeros((*spec.shape, 3))
    colours[3, 1] = 1, 0, 0  # front left
    image = plot.cells_panel(colours, spec, "", {}).image
    assert image[0, 0].tolist() == [255, 0, 0]
    assert np.count_nonzero(image) == 1
    xyz = np.array([[1.9, 0.9, 2.0], [1.9, 0.9, 1.0], [9.0, 0.0, 5.0]])
    image = plot.dots_panel(xyz, np.eye(3), spec, "", {}).image
    assert image.shape == (8, 4, 3)
    assert image[0, 0].tolist() == [255, 0, 0]  # the higher of the two; the third is outside
    assert (image.reshape(-1, 3)[1:] == image[1, 1]).all()
