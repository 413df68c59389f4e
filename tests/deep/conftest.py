"""A small world to learn from: flat ground, a wall, a box, and a lidar of 16 layers."""

from dataclasses import dataclass

import numpy as np
import pytest

from ogm.deep.network import NetworkConfig
from ogm.grid import GridSpec
from ogm.truth import FREE, OCCUPIED, UNKNOWN, Truth

HEIGHT = 1.8


@dataclass(frozen=True)
class Scene:
    points: np.ndarray
    ring: np.ndarray
    truth: Truth
    T_vehicle_sensor: np.ndarray


def scene(number: int) -> Scene:
    """A wall across the way at a distance of its own; all before it is free, all behind it unknown."""
    rng = np.random.default_rng(number)
    distance = rng.uniform(6, 11)
    elevation = np.radians(np.linspace(-25, 3, 16))[:, None]
    azimuth = np.linspace(-np.pi, np.pi, 240, endpoint=False)[None]
    x, y, z = (
        np.cos(elevation) * np.cos(azimuth),
        np.cos(elevation) * np.sin(azimuth),
        np.sin(elevation) + 0 * azimuth,
    )
    ground = np.where(z < 0, -HEIGHT / np.minimum(z, -1e-9), np.inf)
    wall = np.where(x > 0, distance / np.maximum(x, 1e-9), np.inf)
    r = np.minimum(ground, wall)
    hit = r < 30
    intensity = np.where(wall < ground, 0.6, 0.1)
    points = np.stack([r * x, r * y, r * z, intensity], -1)[hit].astype(np.float32)
    canvas = GridSpec.centered(length=51.2, width=51.2, resolution=0.64)
    cx, _ = canvas.cell_centers
    state = np.where(cx < distance - 0.32, FREE, np.where(cx < distance + 0.32, OCCUPIED, UNKNOWN))
    state = np.broadcast_to(state, canvas.shape).astype(np.uint8)
    T = np.eye(4)
    T[2, 3] = HEIGHT
    return Scene(points, np.nonzero(hit)[0], Truth(canvas, np.ascontiguousarray(state)), T)


@pytest.fixture(scope="session")
def scenes() -> list[Scene]:
    return [scene(number) for number in range(12)]


@pytest.fixture(scope="session")
def small() -> GridSpec:
    return GridSpec.centered(
        length=30.72, width=20.48, resolution=0.64
    )  # 48 x 32 cells; any turn stays on the canvas


@pytest.fixture(scope="session")
def tiny() -> NetworkConfig:
    return NetworkConfig(
        pillar=8,
        blocks=((8, 1), (8, 1), (8, 1)),
        join="add",
        bearings=True,
        scale=(15, 10, 2, 0.5, 0.2, 0.2, 0.3, 0.3, 0.3),
    )
