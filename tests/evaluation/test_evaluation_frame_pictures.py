"""Pictures of one evaluated frame: small, sharp, upright, and in the colours of their legend."""

from io import BytesIO

import numpy as np
from cases import each, refused
from numpy.typing import NDArray
from PIL import Image

from ogm import plot
from ogm.evaluation.frame_pictures import ERRORS, draw_frame, error_classes, height_legend, true_states
from ogm.grid import GridSpec
from ogm.plot.colours import colours
from ogm.state import CellState, predict_state

UNKNOWN, FREE, OCCUPIED, IGNORE = CellState
SPEC = GridSpec.centered(6.4, 4.8, 0.4)  # 16 x 12 cells
FREELY, OCCUPIEDLY, NOTHING = (0.9, 0.05), (0.1, 0.8), (0.2, 0.1)


def seen(data: bytes) -> NDArray[np.uint8]:
    """Decode a picture."""
    with Image.open(BytesIO(data)) as image:
        return np.asarray(image.convert("RGB"))


def blank(state: int = UNKNOWN, mass: tuple[float, float] = NOTHING) -> tuple[NDArray, NDArray]:
    """Return a truth and masses that are the same everywhere."""
    return np.full(SPEC.shape, state, np.uint8), np.full((*SPEC.shape, 2), mass, np.float32)


def luminance(colour: tuple[int, int, int]) -> float:
    """Return the relative luminance of a colour, as WCAG 2 defines it."""
    part = np.array(colour) / 255
    linear = np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


@each(("truth", "mass", "name"), [
    (UNKNOWN, NOTHING, "right unknown"), (UNKNOWN, FREELY, "false known"), (UNKNOWN, OCCUPIEDLY, "false known"),
    (FREE, NOTHING, "missed free"), (FREE, FREELY, "right free"), (FREE, OCCUPIEDLY, "false occupied"),
    (OCCUPIED, NOTHING, "missed occupied"), (OCCUPIED, FREELY, "false free"),
    (OCCUPIED, OCCUPIEDLY, "right occupied"), (IGNORE, FREELY, "ignored"),
])  # fmt: skip
def test_every_pair_of_true_and_predicted_state_has_its_class_and_colour(
    truth: int, mass: tuple[float, float], name: str
) -> None:
    state, masses = blank(truth, mass)
    assert (error_classes(state, masses) == list(ERRORS).index(name)).all()
    picture = seen(draw_frame(None, state, [masses], SPEC)["error 0"])
    assert (picture == ERRORS[name].colour).all()


def test_errors_follow_the_predicted_states() -> None:
    rng = np.random.default_rng(3)
    state = rng.integers(0, 4, SPEC.shape).astype(np.uint8)
    mass = rng.dirichlet((1, 1, 1), SPEC.shape)[..., :2].astype(np.float32)
    classes = np.array(list(ERRORS))[error_classes(state, mass)]
    predicted = predict_state(mass)
    assert ((classes == "false free") == ((state == OCCUPIED) & (predicted == FREE))).all()
    assert (np.char.startswith(classes, "right") == ((state == predicted) & (state != IGNORE))).all()


def test_the_first_row_is_the_front_and_the_first_column_the_left() -> None:
    state, mass = blank()
    state[-1, -1] = mass[-1, -1, 0] = 1  # front left: most x, most y
    state[-1, 0] = OCCUPIED  # front right
    views = draw_frame(None, state, [mass], SPEC)
    truth, belief, errors = (seen(views[name]) for name in ("truth", "mass 0", "error 0"))
    assert truth.shape == belief.shape == errors.shape == (16, 12, 3)
    assert tuple(truth[0, 0]) == true_states()["free"].colour
    assert tuple(truth[0, -1]) == true_states()["occupied"].colour
    assert tuple(errors[0, -1]) == ERRORS["missed occupied"].colour
    assert belief[0, 0, 2] > 150 > 80 > belief[-1, -1, 2]  # blue is free


def test_masses_have_the_colours_of_plot() -> None:
    state, mass = blank()
    mass[...] = np.linspace(0, 1, 16)[:, None, None] * np.array([0.6, 0.4])
    shown = seen(draw_frame(None, state, [mass], SPEC)["mass 0"]).astype(float)
    expected = plot.cells_panel(colours().mix(mass), SPEC, "", {}).image
    assert np.abs(shown - expected).max() <= 255 / 8  # masses are shown in steps of 1/8
    assert np.abs(shown - expected).mean() < 8


def test_soft_masses_are_smooth_where_that_is_smaller() -> None:
    spec = GridSpec.centered(25.6, 25.6, 0.1)
    x, y = spec.cell_centers
    soft = (0.5 + 0.4 * np.sin(x) * np.cos(y))[..., None] * np.array([0.9, 0.1])
    soft += np.random.default_rng(0).uniform(0, 0.02, soft.shape)
    view = draw_frame(None, np.zeros(spec.shape, np.uint8), [soft.astype(np.float32)], spec)["mass 0"]
    expected = plot.cells_panel(colours().mix(soft), spec, "", {}).image
    assert np.abs(seen(view).astype(float) - expected).mean() < 4
    assert len(view) < 5000


def test_views_are_named_by_the_methods_numbers_and_points_may_be_absent() -> None:
    state, mass = blank()
    names = ["truth", "mass 0", "error 0", "mass 1", "error 1"]
    assert list(draw_frame(None, state, [mass, mass], SPEC)) == names
    empty = draw_frame(np.zeros((0, 4), np.float32), state, [mass, mass], SPEC)
    assert list(empty) == ["points", *names]
    assert len(np.unique(seen(empty["points"]).reshape(-1, 3), axis=0)) == 1


def test_points_are_coloured_by_their_height_over_the_ground() -> None:
    x, y = np.meshgrid(np.arange(-3.15, 3.2, 0.1), np.arange(-2.35, 2.4, 0.1))
    ground = np.stack([x.ravel(), y.ravel(), np.full(x.size, -1.9)], axis=1)
    wall = np.stack([np.full(2000, 1.1), np.full(2000, 0.3), np.linspace(0, 6, 2000)], axis=1)
    points = np.concatenate([wall, ground, [[np.nan, 0, 0]]]).astype(np.float32)
    state, _ = blank()
    given = seen(draw_frame(points, state, [], SPEC, ground_z=-1.9)["points"])
    assert np.abs(given[-1, 0].astype(int) - height_legend()["0 m"]).max() <= 1
    assert len(set(height_legend().values())) == 4


def test_a_point_is_two_dots_wide() -> None:
    state, _ = blank()
    points = np.array([[0.1, 0.1, 0.0]], np.float32)
    shown = seen(draw_frame(points, state, [], SPEC, ground_z=0.0)["points"])
    assert (shown.max(axis=2) > 60).sum() == 4
    corner = np.array([[-3.1, -2.3, 0.0], [-3.1, 2.3, np.inf]], np.float32)  # back right: nothing wraps round
    shown = seen(draw_frame(corner, state, [], SPEC, ground_z=0.0)["points"])
    assert np.argwhere(shown.max(axis=2) > 60).tolist() == [[15, 11]]


def test_blocks_of_long_grids_show_the_class_of_highest_priority() -> None:
    spec = GridSpec(0.1, (1600, 10), (-80.0, -0.5))
    state = np.full(spec.shape, FREE, np.uint8)
    mass = np.full((*spec.shape, 2), FREELY, np.float32)
    state[801, 4] = OCCUPIED
    views = draw_frame(np.zeros((5, 3), np.float32), state, [mass], spec)
    names = ("points", "truth", "mass 0", "error 0")
    assert {name: seen(data).shape for name, data in views.items()} == dict.fromkeys(names, (534, 4, 3))
    assert (seen(views["error 0"]) == ERRORS["false free"].colour).all(axis=2).sum() == 1
    assert (seen(views["truth"]) == true_states()["occupied"].colour).all(axis=2).sum() == 1


@each("shape", [(1, 1), (7, 5), (3, 40)])
def test_any_shape_of_grid_can_be_drawn(shape: tuple[int, int]) -> None:
    spec = GridSpec(0.5, shape, (0.0, 0.0))
    views = draw_frame(
        np.zeros((1, 4), np.float32), np.zeros(shape, np.uint8), [np.zeros((*shape, 2), np.float32)], spec
    )
    assert seen(views["truth"]).shape == seen(views["mass 0"]).shape == (*shape, 3)


def test_shapes_that_do_not_fit_are_refused() -> None:
    state, mass = blank()
    refused("the truth has", draw_frame, None, state[1:], [mass], SPEC)
    refused("on the cells of the truth", draw_frame, None, state, [mass[1:]], SPEC)


def test_errors_are_distinguishable_without_red_and_green() -> None:
    light = {name: luminance(shade.colour) for name, shade in ERRORS.items()}
    wrong = ("false free", "false occupied", "missed occupied", "missed free", "false known")
    assert max(light, key=light.__getitem__) == "false free"  # the dangerous one is seen first
    for name in ("false free", "false occupied", "missed occupied"):  # contrast to what is right about them
        assert (light[name] + 0.05) / (light["right free"] + 0.05) > 3
    for one, other in zip(wrong[:3], wrong[1:4], strict=True):
        assert (light[one] + 0.05) / (light[other] + 0.05) > 1.3
