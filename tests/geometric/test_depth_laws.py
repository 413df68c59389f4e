"""Laws of the model of depth cameras in cast rooms: what is not seen is not free."""

import numpy as np
import pytest
from cases import each
from rooms import CAMERA, MAN, TABLE, depths, looking

from ogm import EvidentialGrid, GridSpec, Mount
from ogm.io import depth_scan
from ogm.models.depth import depth_model

SPEC = GridSpec(0.1, (90, 60), (-3.5, -3.0))
NO_FOOTPRINT = (0.0, 0.0, 0.0, 0.0)
CUPBOARD = (1.6, -1.4, 0.0, 2.2, -0.9, 1.9)


def seen(height: float, pitch: float, boxes: tuple, hole: tuple[slice, slice] | None = None) -> EvidentialGrid:
    """Return the grid of an image, in which some pixels may have no depth."""
    T = looking(height, pitch)
    image = depths(T, boxes) + np.random.default_rng(0).normal(0, 0.002, (CAMERA.height, CAMERA.width))
    if hole:
        image[hole] = 0
    return depth_model(SPEC, Mount(height, T, NO_FOOTPRINT))(depth_scan(image, CAMERA, 1.0))


def cells(x0: float, y0: float, x1: float, y1: float) -> np.ndarray:
    """Return which cells have their centre in a rectangle."""
    x, y = np.broadcast_arrays(*SPEC.cell_centers)
    return (x > x0) & (x < x1) & (y > y0) & (y < y1)


@each("height, pitch", [(1.2, 15.0), (0.6, 5.0), (0.4, 0.0), (0.3, -5.0)])
def test_nothing_stands_in_a_free_cell_and_nothing_unseen_is_free(height: float, pitch: float) -> None:
    boxes = (*TABLE, MAN, CUPBOARD)
    grid = seen(height, pitch, boxes)
    solid = np.zeros(SPEC.shape, bool)
    for x0, y0, _, x1, y1, _ in boxes:
        solid |= cells(x0, y0, x1, y1)
    assert grid.free[solid].max() < 0.5
    x, y = np.broadcast_arrays(*SPEC.cell_centers)
    corner = looking(0, pitch)[:3, :3] @ [1, CAMERA.width / 2 / CAMERA.fx, -CAMERA.height / 2 / CAMERA.fy]
    half = np.arctan2(corner[1], corner[0])
    beside = abs(np.arctan2(y, x)) > half + 0.1 / np.hypot(x, y).clip(0.1)
    assert not grid.free[beside].any()
    assert not grid.free[cells(5.1, -3, 9, 3)].any()  # behind the wall
    behind = [cells(2.5, -2.6, 3.5, -1.6), cells(2.4, 1.2, 2.8, 1.4)]  # cupboard and man
    assert max(grid.free[one].max(initial=0) for one in behind) < 0.1
    assert grid.occupied[cells(1.75, 0.8, 1.95, 1.1)].max() > 0.9
    edge = 2.9 if height > 0.75 else 2.1  # of the table: from below, its top is seen at too flat an angle
    assert grid.occupied[cells(2.0, -0.5, edge, 0.5)].min() > 0.9


def test_the_floor_is_free_as_far_as_it_is_seen() -> None:
    grid = seen(1.2, 15.0, ())
    assert grid.free[cells(2.5, -0.8, 4.0, 0.8)].min() > 0.5
    assert grid.free[cells(0.1, -0.3, 0.9, 0.3)].max() < 0.5  # under the view


def test_under_a_top_above_the_view_nothing_is_free() -> None:
    shelf = (0.8, -1.0, 0.75, 1.5, 1.0, 0.8)
    assert seen(0.4, 0.0, (shelf,)).free[cells(0.8, -0.3, 1.5, 0.3)].max() < 0.5
    assert seen(0.4, 0.0, ()).free[cells(2.6, -0.3, 3.5, 0.3)].min() > 0.5  # where the view is high enough


def test_what_has_no_depth_is_unknown() -> None:
    """A black box on the floor: the pixels that meet it have no depth, those around it show floor and wall."""
    box = (2.0, -0.25, 0.0, 2.4, 0.25, 0.5)
    T = looking(0.8, 5.0)
    black = depths(T, (box,)) < depths(T) - 1e-6
    image = np.where(black, 0, depths(T))
    grid = depth_model(SPEC, Mount(0.8, T, NO_FOOTPRINT))(depth_scan(image, CAMERA, 1.0))
    assert grid.free[cells(2.0, -0.2, 2.4, 0.2)].max() < 0.1
    assert not grid.occupied[cells(1.5, -0.5, 3.0, 0.5)].any()


@pytest.mark.parametrize("far", [3.0, 7.0])
def test_returns_whose_noise_exceeds_a_cell_clear_and_do_not_mark(far: float) -> None:
    spec, T = GridSpec(0.1, (100, 40), (-1.0, -2.0)), looking(0.5)
    image = np.minimum(depths(T, room=(-3, -3, 0, far, 3, 2.6)), 9.9)
    grid = depth_model(spec, Mount(0.5, T, NO_FOOTPRINT))(depth_scan(image, CAMERA, 1.0))
    wall = grid.occupied[int((far + 1) * 10) - 3 : int((far + 1) * 10) + 3, 10:30]
    assert (wall.max() > 0.9) == (far < 6)
    assert grid.free[28:31, 18:22].min() > 0.5
