"""Pictures: an L-shaped obstacle must come out with front up and left left."""

from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np
import pytest

from ogm import EvidentialGrid, GridSpec, LayeredGrid, plot, read_scan

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


def luminance(colours: np.ndarray) -> np.ndarray:
    """Return the relative luminance of colours in [0, 1], as WCAG 2 defines it."""
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    return linear @ [0.2126, 0.7152, 0.0722]


def contrast(colours: np.ndarray) -> np.ndarray:
    return (luminance(colours) + 0.05) / (luminance(np.array(plot.BEHIND_POINTS)) + 0.05)


def test_points_of_every_height_stand_out_from_what_is_behind_them() -> None:
    heights = np.linspace(-5, 9, 500)
    colours = plot.height_colours(heights)
    assert contrast(colours).min() > 4.45
    inside = colours[(heights > plot.LOWEST) & (heights < plot.HIGHEST)]
    assert len(np.unique(inside.round(3), axis=0)) > 100  # and they tell heights apart


RECORDINGS = {  # sensor: file, axes
    "VLS-128": ("nebula_apache2/vls128/*.pcd", ("+y", "-x", "+z")),
    "VLP-16": ("nebula_apache2/vlp16/*.pcd", "flu"),
    "VLP-32C": ("nebula_apache2/vlp32/*.pcd", "flu"),
    "HDL-64E (KITTI)": ("kitti_odometry_00/000000.bin", "flu"),
    "HDL-32E (nuScenes)": ("nuscenes_n015/*.pcd.bin", "nuscenes"),
    "two VLP-32C (Argoverse 2)": ("argoverse2_adcf/sensors/lidar/*.feather", "flu"),
    "Autoware": ("autoware_apache2/test.pcd.xz", "flu"),
    "SUSTechPOINTS": ("sustechpoints/lidar/000965.pcd.xz", "flu"),
    "XT32": ("nebula_apache2/hesai/xt32.pcd", "flu"),
}


@pytest.mark.parametrize("sensor", RECORDINGS)
def test_every_point_of_every_sensor_is_drawn_and_readable(sensor: str, real: Callable[[str], Path]) -> None:
    name, axes = RECORDINGS[sensor]
    points = read_scan(real(name), axes=axes).points
    points = points[np.isfinite(points[:, :3]).all(axis=1)]
    spec = GridSpec.centered()
    points = points[spec.contains(points[:, 0], points[:, 1])]
    image = plot.points_panel(points, spec).image[::-1, ::-1]  # by cells
    dots = image[spec.refined(2).index(points[:, 0], points[:, 1])] / 255
    assert contrast(dots).min() > 4.4  # ground points among them
    rest = image.reshape(-1, 3) / 255
    assert ((contrast(rest) > 4.4) | (contrast(rest) < 1.05)).all()
    hit = len(np.unique(np.stack(spec.refined(2).index(*points[:, :2].T)), axis=1).T)
    assert np.count_nonzero(contrast(rest) > 4.4) > 1.3 * hit  # wider than a half cell, which a picture would lose


def test_the_ground_is_found_below_what_stands_on_it() -> None:
    rng = np.random.default_rng(3)
    ground = np.column_stack([rng.uniform(-20, 20, (2000, 2)), rng.normal(-1.9, 0.02, 2000)])
    wall = np.column_stack([rng.uniform(5, 6, 9000), rng.uniform(-20, 20, 9000), rng.uniform(-1.9, 3, 9000)])
    cloud = np.concatenate([ground, wall]).astype(np.float32)
    found = plot.points_panel(cloud, GridSpec.centered()).image
    given = plot.points_panel(cloud, GridSpec.centered(), ground_z=-1.9).image
    assert np.abs(found.astype(int) - given).max() < 12


def test_wide_dots_cover_no_others() -> None:
    spec = GridSpec(1.0, (3, 3), (0.0, 0.0))
    xyz, colours = np.array([[1.25, 1.25, 0], [1.75, 1.25, 1]]), np.eye(3)[:2]
    image = plot.dots_panel(xyz, colours, spec, "", {}, width=3).image
    row, column = 6 - 1 - 2, 6 - 1 - 2  # of the first point
    assert image[row, column].tolist() == [255, 0, 0]
    assert image[row - 1, column].tolist() == [0, 255, 0]
    lit = np.argwhere(image.max(-1) > 200)
    assert (lit.min(axis=0).tolist(), lit.max(axis=0).tolist()) == ([1, 2], [4, 4])
    assert len(lit) == 4 * 3
    assert np.count_nonzero(plot.dots_panel(xyz, colours, spec, "", {}).image.max(-1) > 200) == 2


def test_layers_are_shown_from_lowest_to_highest_and_grey_without_a_value() -> None:
    numbers = np.full(SPEC.shape, np.nan, np.float32)
    numbers[6, 4], numbers[6, 3], numbers[5, 4] = -2, 4, 1  # the front left corner
    panel = plot.layer_panel(LayeredGrid(SPEC, {"height": numbers}), "height")
    assert panel.title == "height"
    assert list(panel.legend) == ["-2", "1", "4", "no value"]
    for cell, name in (((0, 0), "-2"), ((0, 1), "4"), ((1, 0), "1"), ((6, 0), "no value")):
        assert panel.image[cell].tolist() == plot._bytes(np.array(panel.legend[name])).tolist()
    flat = plot.layer_panel(LayeredGrid(SPEC, {"height": np.ones(SPEC.shape)}), "height")
    assert list(flat.legend) == ["1", "no value"]
    assert list(plot.layer_panel(LayeredGrid(SPEC, {"h": numbers * np.nan}), "h").legend) == ["no value"]


def test_velocities_are_shown_by_direction_and_speed() -> None:
    x, y = np.zeros((2, *SPEC.shape), np.float32)
    x[6, 4], y[6, 3], x[5, 4], y[5, 3], x[0, 0] = 4, 4, -4, -4, np.nan
    x[3, 3] = 1
    panel = plot.velocity_panel(LayeredGrid(SPEC, {"velocity_x": x, "velocity_y": y}))
    assert "4 m/s" in panel.title
    for cell, name in (
        ((0, 0), "forward"),
        ((0, 1), "left"),
        ((1, 0), "backward"),
        ((1, 1), "right"),
        ((6, 4), "none"),
    ):
        assert np.abs(panel.image[cell] - 255 * np.array(panel.legend[name])).max() <= 1
    half = np.abs(panel.image[3, 1].astype(int) - panel.image[0, 0] // 2)  # a quarter of the speed
    assert half.max() <= 1
