"""Datasets as sequences of frames."""

from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from functools import partial
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from ogm.datasets.frames import FrameRef
from ogm.datasets.recording import Recording
from ogm.datasets.truth import MotionReader, RecordedTruth
from ogm.pose import Trajectory
from ogm.scan import Frame, LazyFrame
from ogm.state import LazyTruth, Truth


class Dataset(Sequence[Frame]):
    """Frames of a recording or of simulated drives; `open_dataset` makes one.

    A frame reads its scan, and makes its truth, at the first access; the last scans and truths are kept. Slices and
    `select` give datasets of some frames. A dataset can be pickled, and goes to another process without the scans that
    were read.

    Attributes
    ----------
    recording : Recording
        Reads the parts of the frames.
    name : str
    format : str
        The format, in words.
    description : str
        The labels that the truth is made of, in one sentence; it states "this scan" if the frame's own scan is used.
        "" if there is no truth: asking a frame for it then raises an error with the way out.
    facts : dict
        Further facts, as JSON can hold them.
    motion_distorted : bool
        Whether points may be shifted by the ego motion during a scan, so that de-skewing makes sense.
    trajectory : Trajectory or None
        Poses between the frames, of `with_poses` and `with_odometry`, which know them better than the frames do.
    """

    recording: Recording
    trajectory: Trajectory | None
    description: str
    name: str
    format: str
    motion_distorted: bool
    facts: dict[str, Any]

    def __init__(
        self,
        recording: Recording,
        truth: Sequence[str] = (),
        others: str = "all",
        numbers: Sequence[int] | None = None,
        trajectory: Trajectory | None = None,
    ) -> None:
        self.recording, self.trajectory = recording, trajectory
        self._motion, self._truth_options = MotionReader(recording), (truth, others)
        self._truth = recording if recording.known_truth else RecordedTruth(recording, truth, others)
        self._numbers = tuple(range(len(recording.frames)) if numbers is None else numbers)
        self.name, self.format, self.description = recording.name, recording.format, self._truth.description
        self.motion_distorted = recording.motion_distorted
        self.facts = dict(recording.facts or {"format": recording.format, "frames": len(recording.frames)})

    def __len__(self) -> int:
        return len(self._numbers)

    @overload
    def __getitem__(self, n: int) -> Frame: ...
    @overload
    def __getitem__(self, n: slice) -> "Dataset": ...
    def __getitem__(self, n: int | slice) -> "Frame | Dataset":
        """Return a frame, of which nothing is read yet, or the dataset of several frames."""
        if isinstance(n, slice):
            return self.select(range(*n.indices(len(self))))
        k = self._numbers[n]
        recording, boxes, truth = self.recording, partial(self._motion.boxes, k), partial(self._moving_truth, k)
        ref = recording.frames[k]._asdict()
        return LazyFrame(partial(recording.scan, k), partial(recording.used_mount, k), boxes, truth, **ref)

    def _moving_truth(self, k: int) -> Truth:
        """Return the truth of a frame; its motion is found at the first access."""
        truth = self._truth.truth(k)
        return LazyTruth(truth.spec, truth.state, truth.height_cm, partial(self._motion.cells, k, truth.spec))

    def __repr__(self) -> str:
        return f"Dataset({self.name!r}: {len(self)} frames, {self.format})"

    def _repr_html_(self) -> str:
        from ogm.plot.notebook import facts_html

        return facts_html(f"Dataset {self.name}", self.describe())

    def select(self, numbers: Iterable[int]) -> "Dataset":
        """Return the dataset of some frames, by their numbers in this one; both share the scans in memory."""
        chosen = copy(self)
        chosen._numbers = tuple(self._numbers[int(n)] for n in numbers)
        return chosen

    @property
    def numbers(self) -> tuple[int, ...]:
        """Numbers of the frames in the recording."""
        return self._numbers

    def describe(self) -> dict[str, str]:
        """Return format, frames, poses, stamps and truth as names and values to print; no scan is read."""
        stamps = [ref.stamp for ref in self.refs if ref.stamp is not None]
        posed = sum(ref.T_map_sensor is not None for ref in self.refs)
        sequences = [name for name in self.sequences if name]
        found = {"format": self.format, "frames": str(len(self))}
        stated = (name for name in ("camera", "depth_scale") if name in self.facts)
        found |= {name.replace("_", " "): str(self.facts[name]) for name in stated}
        if sequences:
            found["sequences"] = f"{len(sequences)} ({', '.join(sequences[:3])}{', ...' if sequences[3:] else ''})"
        found["poses"] = f"{posed} of {len(self)} frames" if posed else "none (see `ogm fuse --odometry`)"
        if stamps:
            found["stamps"] = f"{min(stamps):.3f} ... {max(stamps):.3f} s"
        return found | {"truth": self.description or "none"}

    @property
    def files(self) -> tuple[Path, ...]:
        """Files and folders that the dataset is read from."""
        return tuple(self.recording.files)

    @property
    def refs(self) -> tuple[FrameRef, ...]:
        """Name, sequence, stamp and pose of every frame; no frame is made for it."""
        return tuple(self.recording.frames[k] for k in self._numbers)

    @property
    def with_truth(self) -> list[int]:
        """Numbers of the frames that may have a truth: all but radar sweeps between a simulated lidar's turns."""
        return [n for n, k in enumerate(self._numbers) if self.recording.has_truth(k)]

    @property
    def shards(self) -> NDArray[np.int64] | None:
        """Which frames lie together, where reading all that do costs little more than one: in object stores."""
        shards = self.recording.shards
        return None if shards is None else shards[list(self._numbers)]

    @property
    def sequences(self) -> dict[str, list[int]]:
        """Numbers of the frames of each sequence, in order; frames that stand alone are left out."""
        result: dict[str, list[int]] = {}
        for n, ref in enumerate(self.refs):
            if ref.sequence:
                result.setdefault(ref.sequence, []).append(n)
        return result

    def placed(
        self, stamps: NDArray[np.float64], poses: NDArray[np.float64], facts: Mapping[str, Any], trajectory: Trajectory
    ) -> "Dataset":
        """Return the dataset with other stamps and poses, as one sequence; NaN for a frame without them.

        Parameters
        ----------
        stamps : (K,) float
            [s].
        poses : (K, 4, 4) float
            ``T_map_sensor``.
        facts : dict
            What is added to the facts.
        trajectory : Trajectory
        """
        frames = [one._replace(T_map_sensor=None) for one in self.recording.frames]
        names = {ref.sequence for ref in self.refs}
        sequence = (names.pop() if len(names) == 1 else "") or self.name
        known = np.isfinite(stamps) & np.isfinite(poses).all(axis=(1, 2))
        for n, k in enumerate(self._numbers):
            place = (float(stamps[n]), poses[n]) if known[n] else (None, None)
            frames[k] = FrameRef(frames[k].name, sequence, *place)
        recording = copy(self.recording)  # also without the heights and levels that were found without these poses
        vars(recording).clear()
        vars(recording).update(self.recording.__getstate__())
        recording.frames, recording.facts = tuple(frames), {**self.facts, **facts}
        return Dataset(recording, *self._truth_options, self._numbers, trajectory)
