"""The likelihood of the truth of labelled frames as a function of a geometric model's parameters."""

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
    """A frame as the likelihood needs it."""

    scan: Scan
    mount: Mount
    state: NDArray[np.uint8]  # (nx, ny)
    known: NDArray[np.bool_]  # (nx, ny): free or occupied
    drive: int


class Likelihood:
    """Negative log likelihood of the true states of known cells, as a function of a model's parameters.

    P(occupied) = occupied + base_rate * unknown. With a base rate of 1/2 it is the metric ``nll`` of `ogm.metrics` of
    each frame, averaged over the frames of each drive.

    Parameters
    ----------
    model : {"ray", "height-band", "planar"}
    dataset : iterable of Frame
        Frames with truth; those without a known cell are left out. Kept in memory, about 2 MB each.
    spec : GridSpec, optional
        The cells; by default the 81.92 m x 56.32 m of the paper.
    base_rate : float, optional
        P(occupied) of a cell of which nothing is known, in (0, 1); None for the share of known cells that are occupied.
    threads : int
        Frames that are mapped at the same time. The result does not depend on it.

    Attributes
    ----------
    base_rate : float
    frames : list of LabelledScan
    drives : dict of str to int
        Numbers of the drives by their names. A frame that stands alone is a drive of its own.

    Raises
    ------
    ValueError
        If a frame has no truth, no frame has a known cell, a number is out of its range, or there is no such model.
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
                raise ValueError(f"frame {frame.name} has no truth to compare with; give labelled data")
            state = frame.truth.crop(self._spec).state
            known = (state == CellState.FREE) | (state == CellState.OCCUPIED)
            if known.any():
                drive = self.drives.setdefault(frame.sequence or frame.name, len(self.drives))
                self.frames.append(LabelledScan(frame.scan, frame.mount, state, known, drive))
        if not self.frames:
            raise ValueError("no frame has a cell that is known to be free or occupied")
        if base_rate is None:
            shares = [float((one.state[one.known] == CellState.OCCUPIED).mean()) for one in self.frames]
            base_rate = float(self._by_drive(shares).mean())
        if not 0 < base_rate < 1:
            raise ValueError(f"base_rate must lie between 0 and 1, got {base_rate}; give one if all cells are alike")
        self.base_rate = base_rate

    def __call__(self, parameters: Mapping[str, float]) -> NDArray[np.float64]:
        """Return the mean of every drive [nats], (drives,); the model may refuse parameters (ValueError)."""

        def nll(one: LabelledScan) -> float:
            # The metric of a grid of one row, the known cells, whose masses are P(free) and P(occupied)
            free, occupied = self._mass(one, parameters)[one.known].astype(np.float64).T
            p = occupied + self.base_rate * (1 - free - occupied)
            return score(accumulate(np.stack([1 - p, p], axis=-1)[None], one.state[one.known][None]))["nll"]

        return self._by_drive(self._of_frames(nll))

    def scores(self, parameters: Mapping[str, float]) -> dict[str, float]:
        """Return the metrics of `ogm.metrics` that have a value: means over the frames of a drive, then over drives."""

        def scores(one: LabelledScan) -> dict[str, float]:
            return score(accumulate(self._mass(one, parameters), one.state))

        rows = self._of_frames(scores)
        means = {name: self._by_drive([row[name] for row in rows]) for name in rows[0]}
        return {name: float(values.mean()) for name, values in means.items() if len(values)}

    def _mass(self, one: LabelledScan, parameters: Mapping[str, float]) -> NDArray[np.float32]:
        mass: NDArray[np.float32] = self._class(self._spec, one.mount, **parameters)(one.scan).mass
        return mass

    def _of_frames(self, function: Any) -> list[Any]:
        if self._threads == 1:
            return [function(one) for one in self.frames]
        with ThreadPoolExecutor(self._threads) as pool:
            return list(pool.map(function, self.frames))

    def _by_drive(self, values: list[float]) -> NDArray[np.float64]:
        """Return the mean of the frames of every drive; frames and drives without a value are left out."""
        kept = np.isfinite(values)
        drive = np.array([one.drive for one in self.frames])[kept]
        counts = np.bincount(drive)
        return np.bincount(drive, np.array(values)[kept])[counts > 0] / counts[counts > 0]
