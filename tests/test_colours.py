"""The colours of free, occupied and unknown, as eyes see them that lack one kind of cone."""

from itertools import combinations

import numpy as np
import pytest
from cases import each, refused

from ogm import EvidentialGrid, GridSpec, plot
from ogm.evaluation.figures import COLOURS as METHODS
from ogm.evaluation.frame_pictures import ARROWS
from ogm.plot import colours

# Machado, Oliveira and Fernandes (2009), severity 1, on linear red, green and blue
EYES = {
    "all cones": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.3039]],
}
TO_XYZ = np.array([[0.41246, 0.35758, 0.18044], [0.21267, 0.71515, 0.07218], [0.01933, 0.11919, 0.9503]])  # sRGB, D65


@pytest.fixture(autouse=True)
def _default_colours():
    yield
    colours.use_colours("safe")


def lab(colour: tuple[float, float, float], eye: str) -> np.ndarray:
    """Return L*, a*, b* (CIE 1976, white of sRGB) of red, green, blue [0, 1], as an eye sees it."""
    rgb = np.array(colour)
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    xyz = TO_XYZ @ np.clip(np.array(EYES[eye]) @ linear, 0, 1) / TO_XYZ.sum(axis=1)
    x, y, z = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz * (29 / 6) ** 2 / 3 + 4 / 29)
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def nearest(shown: list[tuple[float, float, float]], eye: str) -> float:
    """Return the least distance of two colours; black and white are 100 apart."""
    return min(float(np.linalg.norm(lab(one, eye) - lab(other, eye))) for one, other in combinations(shown, 2))


@each("eye", EYES)
def test_states_differ_for_every_eye(eye: str) -> None:
    one = colours.COLOURS["safe"]
    assert nearest([one.free, one.occupied, one.unknown], eye) > 60
    assert nearest([tuple(0.5 * part for part in shade) for shade in (one.free, one.occupied, one.unknown)], eye) > 30


@each("eye", EYES)
def test_what_moves_differs_from_what_stands_behind_the_arrows(eye: str) -> None:
    one = colours.COLOURS["safe"]
    behind = one.mix(0.45 * np.eye(2))  # as `ogm.evaluation.frame_pictures` has it
    arrows = [tuple(np.array(colour) / 255) for colour in ARROWS.values()]
    for other in (*behind, one.unknown, *arrows):
        assert nearest([one.dynamic, other], eye) > 30


@each("eye", EYES)
def test_methods_of_an_evaluation_differ_for_every_eye(eye: str) -> None:
    assert nearest([tuple(int(one[k : k + 2], 16) / 255 for k in (1, 3, 5)) for one in METHODS], eye) > 15


def test_green_and_red_differ_for_most_eyes_only() -> None:
    paper = colours.COLOURS["paper"]
    assert nearest([paper.free, paper.occupied], "all cones") > 100
    assert nearest([paper.free, paper.occupied], "deuteranopia") < 20


def test_half_as_much_mass_is_half_the_light() -> None:
    for one in colours.COLOURS.values():
        expected = [np.array(one.free) / 2, np.array(one.occupied) / 4, [0, 0, 0]]
        np.testing.assert_allclose(one.mix(np.array([[0.5, 0], [0, 0.25], [0, 0]])), expected, atol=1e-7)


def test_all_pictures_take_the_chosen_colours() -> None:
    grid = EvidentialGrid(GridSpec(1.0, (1, 2), (0.0, 0.0)), np.array([[[1, 0], [0, 1]]], np.float32))
    assert plot.mass_panel(grid).image[0].tolist() == [[255, 166, 31], [41, 120, 217]]  # left is y > 0: occupied
    assert "blue free" in grid._repr_html_()
    colours.use_colours("paper")
    assert plot.mass_panel(grid).image[0].tolist() == [[237, 41, 41], [26, 204, 51]]
    assert "green free" in grid._repr_html_()
    refused("colours must be safe or paper, got 'rainbow'", colours.use_colours, "rainbow")
