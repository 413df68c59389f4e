"""Likelihood of the true states in labelled frames, as a function of the parameters of a geometric model."""

from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.grid import GridSpec
from ogm.metrics import accumulate, score
from ogm.models.fitted import model_class
from ogm.scan import Frame, Mount, Scan
from ogm.state import CellState


class LabelledScan(NamedTuple):
    """Scan, mount and true states of a frame."""

    scan: Scan
    mount: Mount
    state: NDArray[np.uint8]  # (nx, ny)
    known: NDArray[np.bool_]  # (nx, ny): free or occupied
    drive: int


class Likelihood:
    """Negative log likelihood of the true states of known cells, as a function of model parameters.

    P(occupied) = occupied + base_rate * unknown. With a base rate of 1/2 it is the metric ``nll`` of `ogm.metrics`,
    averaged over the frames of each drive.

    Parameters
    ----------
    model : {"ray", "height-band", "planar"}
    dataset : iterable of Frame
        Frames with truth. Frames without a known cell are left out. The others stay in memory, about 2 MB each.
    spec : GridSpec, optional
        Cells; by default the 81.92 m x 56.32 m of the paper.
    base_rate : float, optional
        P(occupied) of an unknown cell, in (0, 1); None for the share of occupied cells among the known cells.
    threads : int
        Number of frames mapped in parallel. The result does not depend on it.

    Attributes
    ----------
    base_rate : float
    frames : list of LabelledScan
    drives : dict of str to int
        Numbers of the drives by name. A frame without a sequence is a drive.

    Raises
    ------
    ValueError
        If a frame has no truth, no frame has a known cell, a number is out of its range, or the model is unknown.
    """

    def __init__(
        self,
        model: str,
        dataset: Iterable[Frame],
        spec: GridSpec | None = None,
        *,
        base_rate: float | None = 0.5,
        threads: int = 1,
    ) -> None:
        if threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        self._class, self._spec = model_class(model), GridSpec.centered() if spec is None else spec
        self._threads = threads
        self.frames: list[LabelledScan] = []
        self.drives: dict[str, int] = {}
        for frame in dataset:
            if frame.truth is None:
                raise ValueError(f"frame {frame.name} has no truth; give labelled frames")
            state = frame.truth.crop(self._spec).state
            known = (state == CellState.FREE) | (state == CellState.OCCUPIED)
            if known.any():
                drive = self.drives.setdefault(frame.sequence or frame.name, len(self.drives))
                self.frames.append(LabelledScan(frame.scan, frame.mount, state, known, drive))
        if not self.frames:
            raise ValueError("no frame has a cell with a true state of free or occupied; give other labelled frames")
        if base_rate is None:
            shares = [float((frame.state[frame.known] == CellState.OCCUPIED).mean()) for frame in self.frames]
            base_rate = float(self._by_drive(shares).mean())
        if not 0 < base_rate < 1:
            raise ValueError(
                f"base_rate must lie between 0 and 1, got {base_rate}; give a value if all states are the same"
            )
        self.base_rate = base_rate

    def __call__(self, parameters: Mapping[str, float]) -> NDArray[np.float64]:
        """Return the mean NLL of each drive [nats], (drives,); ValueError for parameters out of range."""

        def nll(frame: LabelledScan) -> float:
            # The metric of a grid with the known cells in a row and the masses P(free) and P(occupied)
            free, occupied = self._mass(frame, parameters)[frame.known].astype(np.float64).T
            p = occupied + self.base_rate * (1 - free - occupied)
            return score(accumulate(np.stack([1 - p, p], axis=-1)[None], frame.state[frame.known][None]))["nll"]

        return self._by_drive(self._of_frames(nll))

    def scores(self, parameters: Mapping[str, float]) -> dict[str, float]:
        """Return the defined metrics of `ogm.metrics`: means over the frames of a drive, then over drives."""

        def scores(frame: LabelledScan) -> dict[str, float]:
            return score(accumulate(self._mass(frame, parameters), frame.state))

        rows = self._of_frames(scores)
        means = {name: self._by_drive([row[name] for row in rows]) for name in rows[0]}
        return {name: float(values.mean()) for name, values in means.items() if len(values)}

    def _mass(self, frame: LabelledScan, parameters: Mapping[str, float]) -> NDArray[np.float32]:
        mass: NDArray[np.float32] = self._class(self._spec, frame.mount, **parameters)(frame.scan).mass
        return mass

    def _of_frames(self, function: Any) -> list[Any]:
        if self._threads == 1:
            return [function(frame) for frame in self.frames]
        with ThreadPoolExecutor(self._threads) as pool:
            return list(pool.map(function, self.frames))

    def _by_drive(self, values: list[float]) -> NDArray[np.float64]:
        """Return the mean over the frames of each drive; frames and drives without a value are left out."""
        kept = np.isfinite(values)
        drive = np.array([frame.drive for frame in self.frames])[kept]
        counts = np.bincount(drive)
        return np.bincount(drive, np.array(values)[kept])[counts > 0] / counts[counts > 0]
