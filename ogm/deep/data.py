"""Training data of lidars: augmented frames of a dataset as pillars and truth.

The augmentation of a frame depends only on the seed, the epoch and the frame's number. A resumed training, or a
training on more processes, therefore gets the same data.

>>> from ogm.deep.data import NO_AUGMENTATION, Augmentation
>>> NO_AUGMENTATION.turn, Augmentation().turn, Augmentation(sector=0.25).sector       # shares of frames
(0, 0.5, 0.25)
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset

from ogm.deep.losses import KERB
from ogm.deep.pillars import Pillars, cap_pillars, collate, pillarize, ray_masses
from ogm.deep.points import to_ground_frame
from ogm.geometric import shows_ground
from ogm.grid import GridSpec
from ogm.jit import kernel
from ogm.scan import Frame, Scan
from ogm.state import CellState, Truth

__all__ = ["NO_AUGMENTATION", "ROTATION", "Augmentation", "Batch", "PillarDataset", "augment", "training_ranges"]


@dataclass(frozen=True)
class Augmentation:
    """Random changes of the frames that a network is trained on. Zero disables a change.

    Parameters
    ----------
    turn : float
        Share of frames that are rotated by a random angle around the vertical axis.
    mirror : float
        Share of frames with left and right exchanged.
    gain : float
        Standard deviation of the logarithm of a factor on all intensities.
    no_intensity : float
        Share of frames with all intensities set to 0, as from a sensor without intensities.
    layers : float
        Share of frames that lose layers, each with a probability drawn from 0 to 1/2. Scans without rings lose no
        layers.
    points : float
        Share of frames that lose points, each with a probability drawn from 0 to 0.3.
    noise : float
        Largest standard deviation of the range error [m]; the standard deviation of each frame is drawn from 0 to it.
    height : float
        Standard deviation of the error in the sensor's height [m].
    tilt : float
        Standard deviation of the errors in pitch and in roll [rad].
    sector : float
        Share of frames cut to a sector of 60 to 270 degrees; the truth outside becomes unknown.
    """

    turn: float = 0.5
    mirror: float = 0.5
    gain: float = 0.3
    no_intensity: float = 0.1
    layers: float = 0.15
    points: float = 0.25
    noise: float = 0.03
    height: float = 0.05
    tilt: float = 0.005
    sector: float = 0.0


ROTATION = Augmentation(1, 0, 0, 0, 0, 0, 0, 0, 0, 0)  # van Kempen et al. 2021: only rotation
NO_AUGMENTATION = Augmentation(0, 0, 0, 0, 0, 0, 0, 0, 0, 0)


class Batch(NamedTuple):
    """Batch of lidar frames for a network.

    Attributes
    ----------
    pillars : Pillars
        Points of the frames, sorted by cell.
    state : (batch, nx, ny) uint8
        True states, values of `ogm.state.CellState`, or `ogm.deep.losses.KERB`.
    numbers : list of int
        Numbers of the frames in their dataset.
    """

    pillars: Pillars
    state: torch.Tensor
    numbers: list[int]

    def on(self, device: torch.device) -> tuple[Pillars, torch.Tensor]:
        """Return the network's input and the true states on a device."""
        return self.pillars.to(device), self.state.to(device, non_blocking=True)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the network's input as arrays to save."""
        return {name: getattr(self.pillars, name).numpy() for name in ("features", "lengths", "cells")}

    @classmethod
    def joined(cls, batches: "Sequence[Batch]") -> "Batch":
        """Join batches to a larger batch."""
        nx, ny = batches[0].state.shape[1:]
        pillars, states, numbers = zip(*batches, strict=True)
        return cls(collate(pillars, nx * ny), torch.cat(states), sum(numbers, []))


@dataclass(eq=False)
class PillarDataset(Dataset[Any]):
    """Lidar frames, each as a batch.

    Parameters
    ----------
    frames : sequence of Frame
        Frames with scan, mount and truth, see ``ogm.datasets.open_dataset(path, split="training")``.
    spec : GridSpec
        Grid of the network, around the sensor.
    augmentation : Augmentation
        Random changes of the frames.
    z_range : (float, float)
        Heights above the ground of the points to keep [m].
    seed : int
        Seed of the random changes.
    most_pillars, most_points : int
        Limits of pillars per scan and points per pillar, see `ogm.deep.pillars.cap_pillars`; 0 for no limit.
    kerbs : str
        State of kerbs in the truth, see `ogm.state.Truth.with_kerbs`.
    rays : bool
        Whether the network takes the masses of `ogm.geometric.RayISM` as input.
    """

    frames: Sequence[Frame]
    spec: GridSpec
    augmentation: Augmentation = NO_AUGMENTATION
    z_range: tuple[float, float] = (-3.0, 8.0)
    seed: int = 0
    most_pillars: int = 0
    most_points: int = 0
    rays: bool = False
    kerbs: str = "occupied"

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def shards(self) -> NDArray[np.int64] | None:
        """Shard of each frame, (N,), if the dataset has shards."""
        return getattr(self.frames, "shards", None)

    def __getitem__(self, key: "int | tuple[int, int]") -> Batch:
        """Return frame i with the augmentation of epoch 0, or of the epoch in a key (epoch, i)."""
        epoch, i = key if isinstance(key, tuple) else (0, key)
        rng = np.random.default_rng((self.seed, epoch, i))
        frame = self.frames[i]
        scan, height, state = augment(frame, self.spec, self.augmentation, rng, self.kerbs)
        _, ego_footprint = to_ground_frame(frame.mount)
        pillars = pillarize(scan.points, self.spec, self.z_range, ego_footprint)
        if self.rays:
            pillars = pillars._replace(rays=ray_masses(scan, self.spec, height, ego_footprint))
        if self.most_pillars or self.most_points:
            size = len(pillars.features)
            pillars = cap_pillars(pillars, rng, self.most_pillars or size, self.most_points or size)
        return Batch(pillars, torch.from_numpy(state)[None], [i])


def training_ranges(dataset: PillarDataset, count: int = 300) -> dict[str, tuple[float, float]]:
    """Return ranges of the training data, with which `DeepISM` compares scans.

    Parameters
    ----------
    dataset : PillarDataset
    count : int
        Largest number of frames to read, evenly spaced; from object stores, frames of evenly spaced shards.

    Returns
    -------
    dict of str to (float, float)
        ``height``: sensor height above ground [m]. ``points``: number of points of a scan. ``intensity``: central
        98 % of the mean intensities of scans on the grid, widened by two standard deviations of the augmentation's
        gain. ``ground``: 1 for a scan that shows the ground, else 0.
    """
    rows, shards = [], dataset.shards
    chosen = np.linspace(0, len(dataset) - 1, count).astype(int)
    if shards is not None:
        every = np.unique(shards)
        several = max(1, len(every) * count // len(dataset))
        chosen = np.flatnonzero(np.isin(shards, every[np.linspace(0, len(every) - 1, several).astype(int)]))[:count]
    for i in np.unique(chosen).tolist():
        frame = dataset.frames[i]
        batch = PillarDataset([frame], dataset.spec, NO_AUGMENTATION, dataset.z_range)[0]
        intensity = batch.pillars.features[:, 3]
        mean = float(intensity.mean()) if len(intensity) else 0.0
        rows.append((frame.mount.sensor_height, len(frame.scan), mean, shows_ground(frame.scan, frame.mount)))
    low, high = np.quantile(rows, (0, 1), axis=0).tolist()
    low[2], high[2] = np.quantile(np.array(rows)[:, 2], (0.01, 0.99)).tolist()
    factor = float(np.exp(2 * dataset.augmentation.gain))
    ranges = {"height": (low[0], high[0]), "points": (low[1], high[1])}
    return ranges | {"intensity": (low[2] / factor, high[2] * factor), "ground": (low[3], high[3])}


def augment(
    frame: Frame, spec: GridSpec, augmentation: Augmentation, rng: np.random.Generator, kerbs: str = "occupied"
) -> tuple[Scan, float, NDArray[np.uint8]]:
    """Return a randomly changed frame, as from another drive, sensor or calibration.

    Rotating, mirroring and cutting to a sector change points and truth alike; the other changes affect only points.

    Parameters
    ----------
    frame : Frame
        Frame of a nearly level sensor. A truth of the extent of `ogm.truth.TRUTH_SPEC` covers `spec` at any angle;
        cells from outside the extent of the truth become `CellState.IGNORE`.
    spec : GridSpec
        Grid of the returned truth, around the sensor.
    augmentation : Augmentation
        Random changes.
    rng : Generator
    kerbs : str
        State of kerbs in the truth, see `ogm.state.Truth.with_kerbs`; "unknown" marks them `ogm.deep.losses.KERB`.

    Returns
    -------
    scan : Scan
        Points with x, y relative to the sensor [m], z above the ground below it [m], intensity [0, 1]; and the
        directions of beams without echo.
    height : float
        Height of the sensor, which is at x = y = 0, above the ground [m].
    state : (nx, ny) uint8
        Truth on `spec`, values of `CellState` or `KERB`.

    Raises
    ------
    ValueError
        If the frame has no truth.
    """
    a, scan, truth = augmentation, frame.scan, frame.truth
    if truth is None:
        raise ValueError(f"frame {frame.name!r} has no truth to train on: open a dataset with truth")
    truth = Truth(truth.spec, truth.state, truth.height_cm)  # turned without its motion
    T, _ = to_ground_frame(frame.mount)
    # All numbers are drawn, used or not, so a share of 0 does not change the other random numbers.
    yaw = rng.uniform(-np.pi, np.pi) if rng.random() < a.turn else 0.0
    mirrored = rng.random() < a.mirror
    gain = float(np.exp(a.gain * rng.standard_normal())) * (rng.random() >= a.no_intensity)
    lost_layers = rng.uniform(0, 0.5) * (rng.random() < a.layers)
    lost_points = rng.uniform(0, 0.3) * (rng.random() < a.points)
    noise = rng.uniform(0, a.noise) if a.noise else 0.0
    height = float(T[2, 3]) + a.height * rng.standard_normal()
    pitch, roll = a.tilt * rng.standard_normal(2)
    cut, middle, half = rng.random() < a.sector, rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(30, 135))

    keep = np.ones(len(scan), bool)
    if lost_layers and scan.ring is not None:
        keep &= (rng.random(int(scan.ring.max(initial=0)) + 1) >= lost_layers)[scan.ring]
    if lost_points:
        keep &= rng.random(len(scan), np.float32) >= lost_points
    points = scan.points[keep] if lost_layers or lost_points else scan.points.copy()
    errors = noise * rng.standard_normal(len(points), np.float32) if noise else np.zeros(len(points), np.float32)
    c, s, flip = np.cos(yaw), np.sin(yaw), -1.0 if mirrored else 1.0
    # Small angles: z changes by -pitch x + roll y; changes of x and y are neglected, also for the tilt of the mount.
    matrix = np.zeros((3, 4))
    matrix[:2, :2] = [[c, -s * flip], [s, c * flip]]
    matrix[:2, 3] = matrix[:2, :2] @ T[:2, 3]
    matrix[2] = *(T[2, :3] + (-pitch, roll, 0)), height
    _disturb(points, errors, matrix.astype(np.float32), np.float32(gain))
    no_returns = None if scan.no_returns is None else scan.no_returns @ matrix[:, :3].T.astype(np.float32)
    turned = (truth.mirrored() if mirrored else truth).crop(spec, yaw)
    state = np.where(turned.kerbs, KERB, turned.state) if kerbs == "unknown" else turned.with_kerbs(kerbs).state
    if cut:
        outside = ~_in_sector(*spec.cell_centers, middle, half)
        state = state.copy()
        state[outside & (state != CellState.IGNORE)] = CellState.UNKNOWN
        points = points[_in_sector(points[:, 0], points[:, 1], middle, half)]
        if no_returns is not None:
            no_returns = no_returns[_in_sector(no_returns[:, 0], no_returns[:, 1], middle, half)]
    return Scan(points, no_returns=no_returns), height, state


def _in_sector(x: NDArray[Any], y: NDArray[Any], middle: float, half: float) -> NDArray[np.bool_]:
    """Return whether positions are within `half` of the azimuth `middle` [rad], seen from x = y = 0."""
    inside: NDArray[np.bool_] = np.cos(np.arctan2(y, x) - middle) >= np.cos(half)
    return inside


@kernel
def _disturb(points: NDArray[Any], errors: NDArray[Any], T: NDArray[Any], gain: np.float32) -> None:
    """Add range errors, apply T, and scale the intensities, in place."""
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        stretch = 1 + errors[i] / max(np.sqrt(x * x + y * y + z * z), np.float32(0.5))
        x, y, z = stretch * x, stretch * y, stretch * z
        for k in range(3):
            points[i, k] = T[k, 0] * x + T[k, 1] * y + T[k, 2] * z + T[k, 3]
        points[i, 3] = min(gain * points[i, 3], np.float32(1))
