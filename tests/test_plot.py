"""Pictures: an L-shaped obstacle must come out with front up and left left."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cases import each, refused
from moving import SPEC as MOVING
from moving import street

from ogm import Boxes, DynamicGrid, EvidentialGrid, GridSpec, LayeredGrid, UnknownCause, plot, read_scan
from ogm.plot.colours import CAUSE_COLOURS
from ogm.plot.moving import heading_wheel, moving_arrows, moving_groups
from ogm.plot.panels import BEHIND_POINTS, HIGHEST, LOWEST, colour_bytes, dots_panel, heading_colours, height_colours

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
    orange = image[..., 0] > 200
    assert ["".join(".#"[cell] for cell in row) for row in orange.astype(int)] == [
        ".##..",
        "..#..",
        "..#..",
        ".....",
        ".....",
        ".....",
        ".....",
    ]
    assert (image[~orange][:, 2] > 80).all()  # the rest is blue


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
    assert panel.image[0, 1].tolist() == colour_bytes(np.array(panel.legend["appeared"])).tolist()
    nothing = np.array(panel.legend["no conflict"])
    assert panel.image[6, 4].tolist() == colour_bytes((panel.legend["went away"] + nothing) / 2).tolist()
    assert np.count_nonzero((panel.image != colour_bytes(nothing)).any(axis=-1)) == 2
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
    picture = plot.show(cloud, ell, plot.unknown_panel(ell), titles=["a", "b", "c"])
    orange = np.asarray(picture).astype(int)
    orange = (orange[..., 0] > 200) & (np.abs(orange[..., 1] - 166) < 3) & (orange[..., 2] < 60)
    rows, columns = np.nonzero(orange[:900])  # without the legend
    cell = 129  # [px]: 900 px are 7 cells
    assert (np.ptp(rows) + 1, np.ptp(columns) + 1) == (3 * cell, 2 * cell)
    assert np.count_nonzero(orange[:900]) == 4 * cell**2
    assert columns.min() > picture.width / 3  # the second of three
    assert columns.max() < picture.width * 2 / 3
    one, two = plot.show(ell), plot.show(ell, titles=["wall"])
    assert one.size == two.size
    apart = np.argwhere((np.asarray(one) != np.asarray(two)).any(axis=-1))
    assert 0 < apart[:, 0].max() < 60  # the title, above


def test_titles_that_do_not_fit_are_cut_and_signs_that_the_font_lacks_replaced(ell: EvidentialGrid) -> None:
    def text(title: str) -> bytes:
        return plot.show(ell, titles=[title]).tobytes()

    assert text("Stra\u00dfe \u00e9\u6f22") == text("Stra?e e?")
    assert text("m$\\frac$") != text("mfrac")
    assert plot.show(ell, titles=["x" * 400]).size == plot.show(ell).size
    assert text("a" * 400 + "b") != text("a" * 400 + "c")  # the end is kept


def test_axes_have_round_numbers() -> None:
    for length, step in ((7.0, 1.0), (10.0, 2.0), (81.92, 20.0), (56.32, 10.0), (0.9, 0.2), (3000.0, 500.0)):
        assert plot.figures.round_length(length / plot.figures.MIN_STEPS) == pytest.approx(step)


@each("call", [plot.show, lambda *a, **k: plot.save_picture("x.png", *a, **k)])
def test_what_cannot_be_shown_is_refused(call, ell: EvidentialGrid) -> None:
    refused("nothing to show", call)
    refused("one per item", call, ell, titles=["a", "b"])
    refused("need an area", call, np.zeros((1, 4), np.float32))


def test_save_picture_is_atomic_and_refuses_other_formats(tmp_path: Path, ell: EvidentialGrid) -> None:
    plot.save_picture(tmp_path / "a.png", ell)
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    refused(r"must end in \.png", plot.save_picture, tmp_path / "a.jpg", ell)
    refused("no folder", plot.save_picture, tmp_path / "none" / "a.png", ell, error=FileNotFoundError)
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def test_cells_and_dots_put_front_up_and_left_left_and_show_the_highest() -> None:
    spec = GridSpec.centered(length=4.0, width=2.0, resolution=1.0)
    colours = np.zeros((*spec.shape, 3))
    colours[3, 1] = 1, 0, 0  # front left
    image = plot.cells_panel(colours, spec, "", {}).image
    assert image[0, 0].tolist() == [255, 0, 0]
    assert np.count_nonzero(image) == 1
    xyz = np.array([[1.9, 0.9, 2.0], [1.9, 0.9, 1.0], [9.0, 0.0, 5.0]])
    image = dots_panel(xyz, np.eye(3), spec, "", {}).image
    assert image.shape == (8, 4, 3)
    assert image[0, 0].tolist() == [255, 0, 0]  # the higher of the two; the third is outside
    assert (image.reshape(-1, 3)[1:] == image[1, 1]).all()


def luminance(colours: np.ndarray) -> np.ndarray:
    """Return the relative luminance of colours in [0, 1], as WCAG 2 defines it."""
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    return linear @ [0.2126, 0.7152, 0.0722]


def contrast(colours: np.ndarray) -> np.ndarray:
    return (luminance(colours) + 0.05) / (luminance(np.array(BEHIND_POINTS)) + 0.05)


def test_points_of_every_height_stand_out_from_what_is_behind_them() -> None:
    heights = np.linspace(-5, 9, 500)
    colours = height_colours(heights)
    assert contrast(colours).min() > 4.45
    inside = colours[(heights > LOWEST) & (heights < HIGHEST)]
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


@each("sensor", RECORDINGS)
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
    image = dots_panel(xyz, colours, spec, "", {}, width=3).image
    row, column = 6 - 1 - 2, 6 - 1 - 2  # of the first point
    assert image[row, column].tolist() == [255, 0, 0]
    assert image[row - 1, column].tolist() == [0, 255, 0]
    lit = np.argwhere(image.max(-1) > 200)
    assert (lit.min(axis=0).tolist(), lit.max(axis=0).tolist()) == ([1, 2], [4, 4])
    assert len(lit) == 4 * 3
    assert np.count_nonzero(dots_panel(xyz, colours, spec, "", {}).image.max(-1) > 200) == 2


def test_layers_are_shown_from_lowest_to_highest_and_grey_without_a_value() -> None:
    numbers = np.full(SPEC.shape, np.nan, np.float32)
    numbers[6, 4], numbers[6, 3], numbers[5, 4] = -2, 4, 1  # the front left corner
    panel = plot.layer_panel(LayeredGrid(SPEC, {"height": numbers}), "height")
    assert panel.title == "height"
    assert list(panel.legend) == ["-2", "1", "4", "no value"]
    for cell, name in (((0, 0), "-2"), ((0, 1), "4"), ((1, 0), "1"), ((6, 0), "no value")):
        assert panel.image[cell].tolist() == colour_bytes(np.array(panel.legend[name])).tolist()
    flat = plot.layer_panel(LayeredGrid(SPEC, {"height": np.ones(SPEC.shape)}), "height")
    assert list(flat.legend) == ["1", "no value"]
    assert list(plot.layer_panel(LayeredGrid(SPEC, {"h": numbers * np.nan}), "h").legend) == ["no value"]


def test_causes_of_unknown_have_a_colour_and_a_share_each() -> None:
    cause = np.zeros(SPEC.shape, np.float32)
    cause[0], cause[1, 0] = UnknownCause.BEHIND_OBSTACLE, np.nan
    panel = plot.layer_panel(LayeredGrid(SPEC, {"cause": cause}), "cause")
    share = SPEC.shape[1] / cause.size
    assert f"behind an obstacle, {share:.1%}" in panel.legend
    assert [name.split(",")[0] for name in panel.legend] == ["known", "outside the view", "behind an obstacle"]
    for place, code in (((-1, -1), 2), ((-2, -1), 1), ((0, 0), 0)):
        assert panel.image[place].tolist() == colour_bytes(np.array(CAUSE_COLOURS[UnknownCause(code)])).tolist()


def test_a_long_legend_has_several_lines_and_makes_no_picture_wider(ell: EvidentialGrid) -> None:
    panel = plot.mass_panel(ell)
    few, many = (plot.show(panel._replace(legend={f"entry {k}": (0.5, 0.5, 0.5) for k in range(n)})) for n in (1, 40))
    assert many.width == few.width
    assert many.height > few.height + 40


def test_velocities_are_shown_by_direction_and_speed() -> None:
    x, y = np.zeros((2, *SPEC.shape), np.float32)
    x[6, 4], y[6, 3], x[5, 4], y[5, 3], x[0, 0] = 4, 4, -4, -4, np.nan
    x[3, 3] = 1
    panel = plot.velocity_panel(LayeredGrid(SPEC, {"velocity_x": x, "velocity_y": y}))
    assert "4 m/s" in panel.title
    places = {"+x": (0, 0), "+y": (0, 1), "-x": (1, 0), "-y": (1, 1), "none": (6, 4)}
    for name, cell in places.items():
        assert np.abs(panel.image[cell] - 255 * np.array(panel.legend[name])).max() <= 1
    half = np.abs(panel.image[3, 1].astype(int) - panel.image[0, 0] // 2)  # a quarter of the speed
    assert half.max() <= 1


def test_a_dynamic_grid_has_the_colours_of_belief_and_of_headings() -> None:
    """Free, static and unknown as in `mass_panel`; what moves in the colour of its heading. The legend names all."""
    grid = street()
    panel = plot.dynamic_panel(grid)
    cells = panel.image[::-1, ::-1].astype(int)
    at = MOVING.index
    belief = plot.mass_panel(grid.to_evidential()).image[::-1, ::-1].astype(int)
    for place in ((0.0, 11.0), (0.0, 0.0), (0.0, 7.5)):  # unknown, free, static
        assert np.abs(cells[at(*place)] - belief[at(*place)]).max() <= 1
    for place, heading in (((9.0, 1.0), 0.0), ((9.0, 3.0), np.pi), ((-10.75, 0.25), np.arctan2(0.15, 2.85))):
        wanted = 255 * (0.8 * heading_colours(np.array(heading)) + 0.1 * np.array(panel.legend["static"]))
        assert np.abs(cells[at(*place)] - wanted).max() <= 2, place
    assert panel.wheel
    assert list(panel.legend) == ["free", "static", "unknown", "moves +x", "moves +y", "moves -x", "moves -y"]
    known = np.array([panel.legend["free"], panel.legend["static"]])
    circle = heading_colours(np.linspace(0, 2 * np.pi, 60))
    assert np.linalg.norm(circle[:, None] - known, axis=-1).min() > 0.3  # no direction looks free or static


def test_each_moving_group_has_one_arrow_as_long_as_its_way() -> None:
    """Two vehicles side by side in opposite directions are two groups, one that turns is one."""
    arrows = moving_arrows(street(), seconds=0.5)
    np.testing.assert_allclose(arrows, [[-9, 0, 1.5, 0.6], [9, 1, 4, 0], [9, 3, -3, 0]], atol=1e-6)
    groups = moving_groups(street())
    assert groups.max() == 3
    assert (groups > 0).sum() == 3 * 32
    refused("seconds of the arrows must be 0 or more, got -1", plot.dynamic_panel, street(), seconds=-1)


def test_groups_are_those_of_a_search_from_cell_to_cell() -> None:
    rng = np.random.default_rng(0)
    spec = GridSpec(1.0, (23, 19), (0.0, 0.0))
    mass = rng.dirichlet([1, 1, 4], spec.shape).astype(np.float32) * np.float32(0.9)
    velocity = rng.choice([-4.0, 0.5, 3.0], (*spec.shape, 2)).astype(np.float32)
    velocity[5:7, 5:9] = np.nan
    grid = DynamicGrid(spec, mass, velocity, np.zeros((*spec.shape, 2, 2), np.float32))
    found = moving_groups(grid)
    wanted, count = np.zeros(spec.shape, int), 0
    moving = (mass[..., 1:].sum(-1) > 0.5) & (mass[..., 2] > mass[..., 1]) & ~np.isnan(velocity[..., 0])
    for start in zip(*np.nonzero(moving), strict=True):
        if wanted[start]:
            continue
        count, waiting = count + 1, [start]
        while waiting:
            one = waiting.pop()
            wanted[one] = count
            for dx, dy in np.ndindex(3, 3):
                other = one[0] + dx - 1, one[1] + dy - 1
                if not (0 <= other[0] < 23 and 0 <= other[1] < 19) or not moving[other] or wanted[other]:
                    continue
                apart = np.hypot(*(velocity[one] - velocity[other]))
                if apart <= max(1.0, 0.5 * max(np.hypot(*velocity[one]), np.hypot(*velocity[other]))):
                    waiting.append(other)
    assert count > 20
    pairs = set(zip(found.ravel().tolist(), wanted.ravel().tolist(), strict=True))
    assert len(pairs) == count + 1 == found.max() + 1  # one to one, 0 with 0


def test_nothing_that_stands_or_is_slow_or_small_has_an_arrow() -> None:
    grid = street()
    stands = DynamicGrid(MOVING, grid.mass, grid.velocity * 0.01, grid.covariance)
    assert moving_arrows(stands).shape == (0, 4)
    one = grid.mass.copy()
    one[..., 2][moving_groups(grid) > 1] = 0
    one[..., 2][MOVING.index(9.0, 1.0)] = 0.8
    assert len(moving_arrows(DynamicGrid(MOVING, one, grid.velocity, grid.covariance))) == 1
    nothing = DynamicGrid(MOVING, grid.mass * 0, grid.velocity, grid.covariance)
    assert moving_arrows(nothing).shape == (0, 4)
    assert not plot.dynamic_panel(nothing).image.any()
    assert "arrows" not in plot.dynamic_panel(nothing).title


def test_the_wheel_has_forward_up_and_left_left() -> None:
    wheel = heading_wheel(60)
    for place, heading in (((3, 30), 0.0), ((30, 3), np.pi / 2), ((56, 30), np.pi), ((30, 56), -np.pi / 2)):
        assert wheel[(*place, 3)] == 255
        assert np.abs(wheel[place][:3] - 255 * heading_colours(np.array(heading))).max() < 12
    assert wheel[0, 0, 3] == wheel[30, 30, 3] == 0


def test_arrows_point_where_things_go_in_a_figure() -> None:
    panel = plot.dynamic_panel(street())
    assert panel.title == "heading of moving cells, arrows: 1 s"
    ends = panel.arrows[:, 1::-1] + panel.arrows[:, :1:-1]
    assert sorted(np.round(ends, 5).tolist()) == [[1.0, 17.0], [1.2, -6.0], [3.0, 3.0]]  # y, x [m]
    with_arrows, without = (np.asarray(plot.show(one)) for one in (panel, panel._replace(arrows=panel.arrows[:0])))
    drawn = np.argwhere((with_arrows != without).any(axis=-1))
    wide, high = plot.figures._size(panel)
    pixels = high / panel.spec.length
    left, top = plot.figures.AXIS, plot.figures.MARGIN + plot.figures.TITLE
    assert with_arrows.shape[1] >= left + wide + plot.figures.MARGIN
    left += (with_arrows.shape[1] - left - wide - plot.figures.MARGIN) // 2  # the legend may be wider
    for x, y, dx, dy in panel.arrows:
        share = np.linspace(0, 1, 20)[:, None]
        line = (np.array([panel.spec.extent[1] - x, panel.spec.extent[3] - y]) - share * [dx, dy]) * pixels + [
            top,
            left,
        ]
        line = line[line[:, 0] > top + 4]  # inside
        assert np.linalg.norm(drawn[:, None] - line, axis=-1).min(axis=0).max() < 4


def test_boxes_are_outlined_and_have_the_arrows() -> None:
    turned = Boxes([[5, 1, 0], [-3, 0, 0]], [[4, 2, 1.5], [2, 1, 1]], [np.pi / 2, 0], [[0, 2], [np.nan, np.nan]])
    panel = plot.dynamic_panel(street(), seconds=2.0, boxes=turned)
    np.testing.assert_allclose(panel.arrows, [[5, 1, 0, 4]])
    np.testing.assert_allclose(panel.outlines[0], [[4, 3], [6, 3], [6, -1], [4, -1]], atol=1e-12)
    assert "box: object" in panel.legend
    assert len(plot.dynamic_panel(street(), boxes=Boxes.empty()).arrows) == 0
