"""Training data of radar: sweeps on polar grids, and the truth at places that the radar sees."""

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

STEP = 3  # cells of the truth from one place of the loss to the next
DECIBEL = 10 / np.log(10)  # per factor e of power


class RadarBatch(NamedTuple):
    """Some sweeps, ready for a network.

    Attributes
    ----------
    features : (batch, channels, ranges, azimuths) float32
    places : (batch, N, 2) float32
        Of the cells of the loss: azimuth and range, from -1 to 1 across the polar grid.
    state : (batch, N) uint8
        True states there, values of `ogm.state.CellState`.
    numbers : list of int
        The frames' numbers.
    """

    features: torch.Tensor
    places: torch.Tensor
    state: torch.Tensor
    numbers: list[int]

    def inputs(self, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
        """Return what the network takes, on a device."""
        return self.features.to(device), self.places.to(device)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return what the network takes, to be saved."""
        return {"features": self.features.numpy(), "places": self.places.numpy()}

    @classmethod
    def joined(cls, batches: "Sequence[RadarBatch]") -> "RadarBatch":
        """Make one batch of some batches of one; where they have fewer places, the rest is to be ignored."""
        most = max(one.state.shape[1] for one in batches)
        places = torch.zeros(len(batches), most, 2)
        state = torch.full((len(batches), most), int(CellState.IGNORE), dtype=torch.uint8)
        for k, one in enumerate(batches):
            places[k, : one.state.shape[1]], state[k, : one.state.shape[1]] = one.places[0], one.state[0]
        features = torch.cat([one.features for one in batches])
        return cls(features, places, state, [number for one in batches for number in one.numbers])


@dataclass(eq=False)
class RadarDataset(FrameDataset):
    """Sweeps of radars as batches of one.

    Parameters
    ----------
    frames : sequence of Frame
        See `FrameDataset`. The truth's grid is in the mount's vehicle frame.
    polar : RadarGrid
    noise : callable, optional
        Returns field of view and errors of a radar by the name of its sensor; by default `RadarNoise` of all.
    augmentation : Augmentation
        `mirror`, `points` and `gain` are used: left and right exchanged, detections lost, cross sections changed.
    seed : int
    """

    polar: RadarGrid
    noise: Callable[[str], RadarNoise] | None = None
    augmentation: Augmentation = PLAIN
    seed: int = 0

    def __getitem__(self, key: "int | tuple[int, int]") -> RadarBatch:
        """Return frame i, as augmented in an epoch if the key is (epoch, i).

        The truth is taken at every third cell along x and y, in each epoch at others.
        """
        epoch, i = key if isinstance(key, tuple) else (0, key)
        rng = np.random.default_rng((self.seed, epoch, i))
        frame, a = self.frames[i], self.augmentation
        if frame.truth is None:
            raise ValueError(f"frame {frame.name!r} has no truth to train on; open a data set that has")
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
        tensors: Any = [torch.from_numpy(np.ascontiguousarray(one))[None] for one in arrays]
        return RadarBatch(tensors[0], tensors[1], tensors[2], [i])


def _changed(scan: Scan, keep: NDArray[np.bool_], decibels: float) -> Scan:
    """Return a sweep with some of its detections, and other cross sections."""
    rcs = None if scan.rcs is None else scan.rcs[keep] + np.float32(decibels)
    doppler = None if scan.doppler is None else scan.doppler[keep]
    return Scan(scan.points[keep], doppler=doppler, rcs=rcs)
