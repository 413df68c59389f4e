"""Training data of radars: sweeps on polar grids, and the truth at visible positions."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from ogm.deep.data import PLAIN, Augmentation, FrameDataset
from ogm.deep.polar import CHANNELS, RadarGrid, RadarNoise, polar_features, polar_places
from ogm.scan import Scan
from ogm.state import CellState

STEP = 3  # spacing of the positions of the loss, in cells of the truth
DECIBEL = 10 / np.log(10)  # [dB] of a power ratio of e


class RadarBatch(NamedTuple):
    """Batch of radar sweeps for a network.

    Attributes
    ----------
    features : (batch, channels, ranges, azimuths) float32
        Features, see `ogm.deep.polar.polar_features`.
    places : (batch, N, 2) float32
        Positions of the loss: azimuth and range, from -1 to 1 across the polar grid.
    state : (batch, N) uint8
        True states at these positions, values of `ogm.state.CellState`.
    numbers : list of int
        Numbers of the frames in their dataset.
    """

    features: torch.Tensor
    places: torch.Tensor
    state: torch.Tensor
    numbers: list[int]

    def inputs(self, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the network's input on a device."""
        return self.features.to(device), self.places.to(device)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the network's input as arrays to save."""
        return {"features": self.features.numpy(), "places": self.places.numpy()}

    @classmethod
    def joined(cls, batches: "Sequence[RadarBatch]") -> "RadarBatch":
        """Join batches of single sweeps; shorter ones are padded with ignored positions."""
        count = max(batch.state.shape[1] for batch in batches)
        places = torch.zeros(len(batches), count, 2)
        state = torch.full((len(batches), count), int(CellState.IGNORE), dtype=torch.uint8)
        for k, batch in enumerate(batches):
            places[k, : batch.state.shape[1]], state[k, : batch.state.shape[1]] = batch.places[0], batch.state[0]
        features = torch.cat([batch.features for batch in batches])
        return cls(features, places, state, [number for batch in batches for number in batch.numbers])


@dataclass(eq=False)
class RadarDataset(FrameDataset):
    """Radar sweeps, each as a batch.

    Parameters
    ----------
    frames : sequence of Frame
        See `FrameDataset`. The grid of the truth is in the mount's vehicle frame.
    polar : RadarGrid
        Polar cells of the features.
    noise : callable, optional
        Maps the sensor name of a radar to its field of view and errors; by default `RadarNoise()` for all radars.
    augmentation : Augmentation
        Random changes. Only `mirror`, `points` (lost detections) and `gain` (cross sections) are used.
    seed : int
        Seed of the random changes.
    """

    polar: RadarGrid
    noise: Callable[[str], RadarNoise] | None = None
    augmentation: Augmentation = PLAIN
    seed: int = 0

    def __getitem__(self, key: "int | tuple[int, int]") -> RadarBatch:
        """Return frame i with the augmentation of epoch 0, or of the epoch in a key (epoch, i).

        The truth is sampled at every third cell along x and y, with a random offset if an epoch is given.
        """
        epoch, i = key if isinstance(key, tuple) else (0, key)
        rng = np.random.default_rng((self.seed, epoch, i))
        frame, a = self.frames[i], self.augmentation
        if frame.truth is None:
            raise ValueError(f"frame {frame.name!r} has no truth to train on: open a dataset with truth")
        noise = RadarNoise() if self.noise is None else self.noise(frame.scan.sensor)
        mirrored, lost = rng.random() < a.mirror, rng.uniform(0, 0.3) * (rng.random() < a.points)
        decibels = a.gain * DECIBEL * rng.standard_normal()
        scan = _changed(frame.scan, rng.random(len(frame.scan)) >= lost, decibels)
        features = polar_features(scan, frame.mount, noise, self.polar)

        first = rng.integers(STEP, size=2) if isinstance(key, tuple) else (1, 1)
        x, y = (axis.ravel()[k::STEP] for axis, k in zip(frame.truth.spec.cell_centers, first, strict=True))
        state = frame.truth.state[first[0] :: STEP, first[1] :: STEP]
        x, y = np.meshgrid(x, y, indexing="ij")
        row, column, seen = polar_places(x, y, frame.mount, noise, self.polar)
        ranges, azimuths = self.polar.shape
        places = np.stack([(2 * column + 1) / azimuths - 1, (2 * row + 1) / ranges - 1], axis=-1)[seen]
        if mirrored:
            features = features[:, :, ::-1].copy()
            features[CHANNELS.index("azimuth in cell")] *= -1
            places[:, 0] *= -1
        arrays = (features, places.astype(np.float32), state[seen])
        tensors: Any = [torch.from_numpy(np.ascontiguousarray(array))[None] for array in arrays]
        return RadarBatch(tensors[0], tensors[1], tensors[2], [i])


def _changed(scan: Scan, keep: NDArray[np.bool_], decibels: float) -> Scan:
    """Return a sweep with selected detections and changed cross sections."""
    rcs = None if scan.rcs is None else scan.rcs[keep] + np.float32(decibels)
    doppler = None if scan.doppler is None else scan.doppler[keep]
    return Scan(scan.points[keep], doppler=doppler, rcs=rcs)
