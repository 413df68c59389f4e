"""Training data: samples of a data set, turned and disturbed, as pillars and truth.

Every sample's disturbance follows from the seed, the epoch and the sample's
number alone, so that a training which is resumed, or runs on more processes, sees the same.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numba import njit
from numpy.typing import NDArray
from torch.utils.data import Dataset, Sampler

from ogm.deep.pillars import EGO_FOOTPRINT, Pillars, cap_pillars, collate, pillarize
from ogm.grid import GridSpec
from ogm.state import Truth

__all__ = [
    "PLAIN",
    "ROTATION",
    "Augmentation",
    "Batch",
    "Sample",
    "Samples",
    "PillarDataset",
    "Shuffled",
    "augment",
    "join",
    "training_ranges",
]


@dataclass(frozen=True)
class Augmentation:
    """How a sample is changed before it is learned from. Zeros change nothing.

    Parameters
    ----------
    turn : float
        Share of samples that are turned by any angle; the rest keep their heading.
    mirror : float
        Share of samples with left and right exchanged.
    gain : float
        Standard deviation of the logarithm of a factor on all intensities.
    no_intensity : float
        Share of samples whose intensities are all 0, as of a sensor that has none.
    layers : float
        Share of samples that lose layers, each with a probability between 0 and 1/2.
    points : float
        Share of samples that lose points, each with a probability between 0 and 0.3.
    noise : float
        Largest standard deviation of an error in range [m]; each sample has its own.
    height : float
        Standard deviation of the error in the sensor's height [m].
    tilt : float
        Standard deviation of errors in pitch and in roll [rad].
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


ROTATION = Augmentation(1, 0, 0, 0, 0, 0, 0, 0, 0)  # van Kempen et al. 2021: rotation alone
PLAIN = Augmentation(0, 0, 0, 0, 0, 0, 0, 0, 0)


class Sample(Protocol):
    """What is learned from; `ogm.simulation.store` gives such samples."""

    @property
    def points(self) -> NDArray[np.float32]:
        """(N, 4): x, y, z in the sensor's frame [m], intensity [0, 1]."""

    @property
    def ring(self) -> NDArray[np.integer]:
        """The layer of each point, (N,)."""

    @property
    def truth(self) -> Truth:
        """Around the sensor, wide enough to be turned."""

    @property
    def T_vehicle_sensor(self) -> NDArray[np.float64]:
        """How the sensor is mounted, (4, 4)."""


class Samples(Protocol):
    """A part of a data set."""

    def __len__(self) -> int: ...
    def __getitem__(self, index: int, /) -> Sample: ...


class Batch(NamedTuple):
    """Some samples, ready to be learned from.

    Attributes
    ----------
    pillars : Pillars
    state : (batch, nx, ny) uint8
        True states as in `ogm.truth`: 0 unknown, 1 free, 2 occupied, 3 to be ignored.
    numbers : list of int
        The samples' numbers in their split.
    """

    pillars: Pillars
    state: torch.Tensor
    numbers: list[int]


class PillarDataset(Dataset[Batch]):
    """Samples as batches of one.

    Parameters
    ----------
    samples : Samples
        A split of a data set: ``Store.open(path)["training"]``.
    spec : GridSpec
        The network's grid, around the sensor.
    augmentation : Augmentation
    z_range : (float, float)
        Heights above the ground that the network looks at [m].
    seed : int
    most_pillars, most_points : int
        If above 0, the paper's limits; see `ogm.deep.pillars.cap_pillars`.
    """

    def __init__(
        self,
        samples: Samples,
        spec: GridSpec,
        augmentation: Augmentation = PLAIN,
        z_range: tuple[float, float] = (-3.0, 8.0),
        seed: int = 0,
        most_pillars: int = 0,
        most_points: int = 0,
    ) -> None:
        self.samples, self.spec, self.augmentation, self.z_range = samples, spec, augmentation, z_range
        self.seed, self.most = seed, (most_pillars, most_points)

    def __len__(self) -> int:
        return len(self.samples)

    def __getitem__(self, key: "int | tuple[int, int]") -> Batch:
        """Return sample i, as disturbed in an epoch if the key is (epoch, i)."""
        epoch, i = key if isinstance(key, tuple) else (0, key)
        rng = np.random.default_rng((self.seed, epoch, i))
        sample = self.samples[i]
        points, state = augment(sample, self.spec, self.augmentation, rng)
        pillars = pillarize(points, self.spec, self.z_range, EGO_FOOTPRINT)
        if any(self.most):
            pillars = cap_pillars(
                pillars, rng, self.most[0] or len(pillars.lengths), self.most[1] or len(pillars.features)
            )
        return Batch(pillars, torch.from_numpy(state)[None], [i])


def training_ranges(scenes: PillarDataset, count: int = 300) -> dict[str, tuple[float, float]]:
    """Return what a network trained on some scenes has seen: ranges over up to `count` of them, evenly spread.

    Returns
    -------
    dict
        ``height``: of the sensor above ground [m]. ``points``: in a scan. ``intensity``: a scan's mean on the grid, of
        98 % of the scans, widened by two standard deviations of the augmentation's factor.
    """
    numbers = np.unique(np.linspace(0, len(scenes) - 1, count).astype(int))
    rows = []
    for i in numbers.tolist():
        sample = scenes.samples[i]
        points, _ = augment(sample, scenes.spec, PLAIN, np.random.default_rng(0))
        pillars = pillarize(points, scenes.spec, scenes.z_range, EGO_FOOTPRINT)
        mean = float(pillars.features[:, 3].mean()) if len(pillars.features) else 0.0
        rows.append((float(sample.T_vehicle_sensor[2, 3]), len(sample.points), mean))
    low, high = np.min(rows, axis=0).tolist(), np.max(rows, axis=0).tolist()
    low[2], high[2] = np.quantile(np.array(rows)[:, 2], (0.01, 0.99)).tolist()
    factor = float(np.exp(2 * scenes.augmentation.gain))
    return {
        "height": (low[0], high[0]),
        "points": (low[1], high[1]),
        "intensity": (low[2] / factor, high[2] * factor),
    }


class Shuffled(Sampler[tuple[int, int]]):
    """The order of an epoch: every sample once, the share of this process, from a position on."""

    def __init__(self, count: int, seed: int, rank: int = 0, processes: int = 1) -> None:
        self.count, self.seed, self.rank, self.processes = count, seed, rank, processes
        self.epoch, self.skip = 0, 0

    def __len__(self) -> int:
        return self.count // self.processes - self.skip

    def __iter__(self) -> Iterator[tuple[int, int]]:
        order = np.random.default_rng((self.seed, self.epoch)).permutation(self.count)
        order = order[: self.count // self.processes * self.processes][self.rank :: self.processes]
        return iter([(self.epoch, int(i)) for i in order[self.skip :]])


def join(batches: Sequence[Batch]) -> Batch:
    """Make one batch of some batches of one."""
    nx, ny = batches[0].state.shape[1:]
    return Batch(
        collate([one.pillars for one in batches], nx * ny),
        torch.cat([one.state for one in batches]),
        [number for one in batches for number in one.numbers],
    )


def augment(
    sample: Sample, spec: GridSpec, augmentation: Augmentation, rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Disturb a sample as another drive, another sensor or another calibration would.

    Turning and mirroring change points and truth alike; the truth is cut from a canvas that is wide enough, so that
    no cell becomes unknown by turning. All else changes the points alone.

    Parameters
    ----------
    sample : Sample
    spec : GridSpec
        The grid to fill, around the sensor.
    augmentation : Augmentation
    rng : Generator

    Returns
    -------
    points : (N, 4) float32
        x, y [m] around the sensor, z above the ground under it [m], intensity [0, 1].
    state : (nx, ny) uint8
        The truth on `spec`.
    """
    a, truth = augmentation, sample.truth
    # All numbers are drawn whether they are used or not: a share of 0 leaves the others' as they are.
    yaw = rng.uniform(-np.pi, np.pi) if rng.random() < a.turn else 0.0
    mirrored = rng.random() < a.mirror
    gain = float(np.exp(a.gain * rng.standard_normal())) * (rng.random() >= a.no_intensity)
    lost_layers = rng.uniform(0, 0.5) * (rng.random() < a.layers)
    lost_points = rng.uniform(0, 0.3) * (rng.random() < a.points)
    noise = rng.uniform(0, a.noise) if a.noise else 0.0
    height = float(sample.T_vehicle_sensor[2, 3]) + a.height * rng.standard_normal()
    pitch, roll = a.tilt * rng.standard_normal(2)

    points = sample.points
    keep = np.ones(len(points), bool)
    if lost_layers:
        ring = sample.ring
        keep &= (rng.random(int(ring.max(initial=0)) + 1) >= lost_layers)[ring]
    if lost_points:
        keep &= rng.random(len(points), np.float32) >= lost_points
    points = points[keep] if lost_layers or lost_points else points.copy()
    errors = (
        noise * rng.standard_normal(len(points), np.float32) if noise else np.zeros(len(points), np.float32)
    )
    if mirrored:
        truth = truth.mirrored()
    c, s = np.cos(yaw), np.sin(yaw)
    flip = -1.0 if mirrored else 1.0
    # Small angles: z changes by -pitch x + roll y, x and y hardly; so too with the tilt that the mount has.
    up = sample.T_vehicle_sensor[2, :3] + (-pitch, roll, 0)
    matrix = np.array([[c, -s * flip, 0, 0], [s, c * flip, 0, 0], [*up, height]], np.float32)
    _disturb(points, errors.astype(np.float32), matrix, np.float32(gain))
    return points, truth.crop(spec, yaw).state


@njit(cache=True, nogil=True)
def _disturb(points: NDArray, errors: NDArray, T: NDArray, gain: float) -> None:
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        stretch = 1 + errors[i] / max(np.sqrt(x * x + y * y + z * z), np.float32(0.5))
        x, y, z = stretch * x, stretch * y, stretch * z
        for k in range(3):
            points[i, k] = T[k, 0] * x + T[k, 1] * y + T[k, 2] * z + T[k, 3]
        points[i, 3] = min(gain * points[i, 3], np.float32(1))
