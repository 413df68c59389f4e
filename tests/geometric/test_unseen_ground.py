"""Scans that show no ground, or little: walls are never free, and ground that is seen is followed."""

import itertools
import logging
from collections.abc import Iterable

import numpy as np
import pytest
from cases import each
from few_layers import LAYERS, MOUNTS, SCENES, Scene, cast

from ogm import GridSpec, InverseSensorModel, Mount, Scan, load_model
from ogm.geometric import RayISM, patchwork_ground

SPEC = GridSpec.centered(length=40.96, width=30.72, resolution=0.16)
FOOTPRINT = (-0.3, 0.3, -0.3, 0.3)
LOW = 0.05  # [m] returns below lie on the plane of the mount
FEW = [name for name in LAYERS if name != "16"]


def mount_at(height: float) -> Mount:
    return Mount(height, ego_footprint=FOOTPRINT)


def hit_cells(points: np.ndarray, height: float, spec: GridSpec) -> tuple[np.ndarray, np.ndarray]:
    """Return the cells that hold hits of obstacles up to 2 m, outside of the footprint."""
    z = points[:, 2] + height
    x0, x1, y0, y1 = (side + np.sign(side) * 0.16 for side in FOOTPRINT)
    away = (points[:, 0] < x0) | (points[:, 0] > x1) | (points[:, 1] < y0) | (points[:, 1] > y1)
    points = points[(z > LOW) & (z < 2.001) & away & spec.contains(points[:, 0], points[:, 1])]
    cells = np.unique(np.stack(spec.index(points[:, 0], points[:, 1]), axis=-1), axis=0)
    return cells[:, 0], cells[:, 1]


def broken_laws(
    model: InverseSensorModel,
    height: float,
    cases: Iterable[tuple[str, str]],
    free_share: float = 0.0,
    azimuths: int = 720,
) -> list[str]:
    """Return the scenes in which hit cells are free, or fewer than 90 % occupied."""
    broken = []
    for scene, layers in cases:
        points, is_ground = cast(SCENES[scene], LAYERS[layers], height, azimuths)
        cells = hit_cells(points[~is_ground], height, model.spec)
        free, occupied = model(Scan(points)).mass[cells].T
        if len(free) and (((free > occupied) | (free > 0.5)).mean() > free_share or (occupied > 0.5).mean() < 0.9):
            shares = f"{(free > occupied).mean():.1%} free, {(occupied > 0.5).mean():.1%} occupied"
            broken.append(f"{scene}, {layers} layers at {height} m: {shares}")
    return broken


@each("height", [0.2, 0.5, 2.0])
def test_walls_seen_by_few_layers_are_occupied(height: float) -> None:
    scenes, layers = ["room of 8 x 6 m", "hall", "street", "crowd"], ["1, level", "2, down", "4", "8"]
    assert not broken_laws(RayISM(SPEC, mount_at(height)), height, itertools.product(scenes, layers), azimuths=300)


@pytest.mark.slow
@each("height", MOUNTS)
def test_walls_are_occupied_in_every_scene_for_all_lidars(height: float) -> None:
    """Sixteen layers show the ground: few hits lie beside their cells by noise, or on a car that one beam meets."""
    model, far = RayISM(GridSpec.centered(61.44, 61.44, 0.16), mount_at(height)), "street with cars"
    assert not broken_laws(model, height, itertools.product(SCENES, FEW))
    assert not broken_laws(model, height, itertools.product(set(SCENES) - {far}, ["16"]), 0.005)
    assert not broken_laws(model, height, [(far, "16")], 0.03)


@pytest.mark.slow
@each("name", ["lite", "combined", "patchwork"])
def test_walls_are_occupied_for_all_models(name: str) -> None:
    pytest.importorskip("pypatchworkpp" if name == "patchwork" else "onnxruntime")
    scenes, layers = ["room of 8 x 6 m", "hall", "street", "crowd"], ["1, level", "2", "4", "8"]
    layers = layers[2:] if name == "lite" else layers  # which leaves all cells unknown in scans of fewer points
    for height in (0.2, 0.5, 2.0):
        mount = mount_at(height)
        model = RayISM(SPEC, mount, ground=patchwork_ground) if name == "patchwork" else load_model(name, SPEC, mount)
        assert not broken_laws(model, height, itertools.product(scenes, layers))


@each("name", ["lite", "combined"])
def test_the_network_maps_scans_whose_ground_is_hidden(name: str) -> None:
    """Beams that point down end at walls or people; where none points down, `lite` gives the masses of rays."""
    pytest.importorskip("onnxruntime")
    model, rays, scene = load_model(name, SPEC, mount_at(2.0)), RayISM(SPEC, mount_at(2.0)), "room of 8 x 6 m"
    points, _ = cast(SCENES[scene], LAYERS["16"], 2.0)
    assert np.abs(model(points).mass - rays(points).mass).max() > 0.3
    assert not broken_laws(model, 2.0, [(scene, "16"), ("crowd", "16")], 0.02 if name == "lite" else 0.0)
    level, _ = cast(SCENES[scene], LAYERS["8, narrow"], 2.0)
    assert name == "combined" or (model(level).mass == rays(level).mass).all()


@each(("layers", "height", "slope"), [("8", 1.0, 0.1), ("8", 1.0, 0.2), ("16", 0.3, 0.2), ("16", 1.8, 0.2)])
def test_a_slope_that_beams_meet_one_behind_another_is_ground(layers: str, height: float, slope: float) -> None:
    points, is_ground = cast(Scene([], slope=slope), LAYERS[layers], height)
    grid = RayISM(SPEC, mount_at(height))(points)
    on = points[is_ground & (np.abs(points[:, 1]) < 3) & (points[:, 0] > 3) & (points[:, 0] < 12)]
    assert len(on) > 100
    mass = grid.mass[SPEC.index(on[:, 0], on[:, 1])]
    assert (mass[:, 1] > 0.5).mean() < 0.02
    assert (mass[:, 0] > 0.5).mean() > 0.5


def test_unseen_ground_is_stated_once_for_each_model(caplog: pytest.LogCaptureFixture) -> None:
    ism = RayISM(SPEC, mount_at(0.3))
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            ism(cast(SCENES["hall"], LAYERS["1, level"], 0.3)[0])
    (line,) = caplog.messages
    assert "no return shows the ground" in line
    assert "0.30 m below the sensor" in line
    assert "`sensor_height`" in line
    caplog.clear()
    RayISM(SPEC, mount_at(1.0))(cast(SCENES["hall"], LAYERS["16"], 1.0)[0])
    assert not caplog.messages
