"""Dynamic grids made of blocks of moving cells, for tests."""

from typing import NamedTuple

import numpy as np

from ogm.dynamic_grid import DynamicGrid
from ogm.grid import GridSpec

SPEC = GridSpec.centered(length=40.0, width=32.0, resolution=0.2)


class Block(NamedTuple):
    """A moving rectangle: centre [m], velocity of the centre [m/s], turn rate [rad/s], size [m], yaw [rad]."""

    x: float
    y: float
    vx: float
    vy: float
    turn: float = 0.0
    length: float = 4.0
    width: float = 2.0
    yaw: float | None = None  # along the velocity

    def at(self, seconds: float) -> "Block":
        """Return the block later: its centre moves on an arc, and it turns about it."""
        half = 0.5 * self.turn * seconds
        chord = (self.vx + 1j * self.vy) * seconds * np.sinc(half / np.pi) * np.exp(1j * half)
        v = (self.vx + 1j * self.vy) * np.exp(2j * half)
        yaw = np.arctan2(self.vy, self.vx) if self.yaw is None else self.yaw
        moved = self._replace(x=self.x + chord.real, y=self.y + chord.imag, vx=v.real, vy=v.imag)
        return moved._replace(yaw=yaw + 2 * half)

    def cells(self, spec: GridSpec, margin: float = 0.0) -> np.ndarray:
        """Return which cells have their centre in the block, (nx, ny) bool."""
        dx, dy = _centers(spec, self.x, self.y)
        yaw = np.arctan2(self.vy, self.vx) if self.yaw is None else self.yaw
        along, across = np.cos(yaw) * dx + np.sin(yaw) * dy, np.cos(yaw) * dy - np.sin(yaw) * dx
        return (abs(along) <= self.length / 2 + margin) & (abs(across) <= self.width / 2 + margin)


def _centers(spec: GridSpec, x: float, y: float) -> list[np.ndarray]:
    axes = [(np.arange(n) + 0.5) * spec.resolution + o for n, o in zip(spec.shape, spec.origin, strict=True)]
    return np.meshgrid(axes[0] - x, axes[1] - y, indexing="ij")


def scene(*blocks: Block, spec: GridSpec = SPEC, dynamic: float = 0.8, variance: float = 0.04) -> DynamicGrid:
    """Return a free grid with moving blocks, a wall, and unknown beyond it."""
    mass = np.zeros((*spec.shape, 3), np.float32)
    mass[:, :-20, 0] = 0.8
    mass[:, -20, 1] = 0.9  # the wall
    velocity = np.full((*spec.shape, 2), np.nan, np.float32)
    covariance = np.full((*spec.shape, 2, 2), np.nan, np.float32)
    for block in blocks:
        cells = block.cells(spec)
        dx, dy = _centers(spec, block.x, block.y)
        mass[cells] = 0.05, 0.1, dynamic
        v = np.stack([block.vx - block.turn * dy, block.vy + block.turn * dx], axis=-1)
        velocity[cells], covariance[cells] = v[cells], variance * np.eye(2)
    return DynamicGrid(spec, mass, velocity, covariance)
