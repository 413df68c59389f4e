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
    """Frames of a recording or of simulated drives, see `open_dataset`.

    A frame reads its scan and makes its truth at the first access; recent scans and truths are kept in memory. Slices
    and `select` return datasets of some frames. A pickled dataset does not contain the scans in memory.

    Attributes
    ----------
    recording : Recording
        Reader of the parts of the frames.
    numbers : tuple of int
        Numbers of the frames in the recording.
    name : str
        Name of the dataset.
    format : str
        Name of the format.
    description : str
        Sources of the truth, in one sentence, in which "this scan" is the scan of the frame itself. "" if there is no
        truth; `Frame.truth` then raises an error with the way out.
    facts : dict
        Further facts that JSON can hold.
    motion_distorted : bool
        Whether points may be shifted by the ego motion during a scan and should be de-skewed.
    trajectory : Trajectory or None
        Poses between the frames, set by `with_poses` and `with_odometry`; denser than the poses of the frames.
    """

    recording: Recording
    numbers: tuple[int, ...]
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
        self.numbers = tuple(range(len(recording.frames)) if numbers is None else numbers)
        self.name, self.format, self.description = recording.name, recording.format, self._truth.description
        self.motion_distorted = recording.motion_distorted
        self.facts = dict(recording.facts or {"format": recording.format, "frames": len(recording.frames)})

    def __len__(self) -> int:
        return len(self.numbers)

    @overload
    def __getitem__(self, n: int) -> Frame: ...
    @overload
    def __getitem__(self, n: slice) -> "Dataset": ...
    def __getitem__(self, n: int | slice) -> "Frame | Dataset":
        """Return a frame, which is not read yet, or the dataset of a slice of frames."""
        if isinstance(n, slice):
            return self.select(range(*n.indices(len(self))))
        k = self.numbers[n]
        recording, boxes, truth = self.recording, partial(self._motion.boxes, k), partial(self._moving_truth, k)
        ref = recording.frames[k]._asdict()
        return LazyFrame(partial(recording.scan, k), partial(recording.used_mount, k), boxes, truth, **ref)

    def _moving_truth(self, k: int) -> Truth:
        """Return the truth of a frame; its motion is computed at the first access."""
        truth = self._truth.truth(k)
        return LazyTruth(truth.spec, truth.state, truth.height_cm, partial(self._motion.cells, k, truth.spec))

    def __repr__(self) -> str:
        return f"Dataset({self.name!r}: {len(self)} frames, {self.format})"

    def _repr_html_(self) -> str:
        from ogm.plot.notebook import facts_html

        return facts_html(f"Dataset {self.name}", self.describe())

    def select(self, numbers: Iterable[int]) -> "Dataset":
        """Return the dataset of the frames with the given numbers; scans in memory are shared."""
        chosen = copy(self)
        chosen.numbers = tuple(self.numbers[int(n)] for n in numbers)
        return chosen

    def describe(self) -> dict[str, str]:
        """Return format, frames, poses, stamps and truth as names and values to print. No scan is read."""
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
        """Name, sequence, stamp and pose of every frame, without making frames."""
        return tuple(self.recording.frames[k] for k in self.numbers)

    @property
    def with_truth(self) -> list[int]:
        """Numbers of the frames that may have a truth; radar sweeps between simulated lidar scans have none."""
        return [n for n, k in enumerate(self.numbers) if self.recording.has_truth(k)]

    @property
    def shards(self) -> NDArray[np.int64] | None:
        """Shard of each frame in an object store, (N,), else None; see `Recording.shards`."""
        shards = self.recording.shards
        return None if shards is None else shards[list(self.numbers)]

    @property
    def sequences(self) -> dict[str, list[int]]:
        """Numbers of the frames of each sequence, in order; single frames are left out."""
        result: dict[str, list[int]] = {}
        for n, ref in enumerate(self.refs):
            if ref.sequence:
                result.setdefault(ref.sequence, []).append(n)
        return result

    def placed(
        self, stamps: NDArray[np.float64], poses: NDArray[np.float64], facts: Mapping[str, Any], trajectory: Trajectory
    ) -> "Dataset":
        """Return the dataset with other stamps and poses, as a single sequence.

        Parameters
        ----------
        stamps : (K,) float
            Stamps of the frames [s]; NaN if unknown.
        poses : (K, 4, 4) float
            ``T_map_sensor`` of the frames; NaN if unknown.
        facts : dict
            Entries to add to the facts.
        trajectory : Trajectory
            Poses between the frames.
        """
        frames = [ref._replace(T_map_sensor=None) for ref in self.recording.frames]
        names = {ref.sequence for ref in self.refs}
        sequence = (names.pop() if len(names) == 1 else "") or self.name
        known = np.isfinite(stamps) & np.isfinite(poses).all(axis=(1, 2))
        for n, k in enumerate(self.numbers):
            place = (float(stamps[n]), poses[n]) if known[n] else (None, None)
            frames[k] = FrameRef(frames[k].name, sequence, *place)
        recording = copy(self.recording)  # without the cached heights and levellings, which depend on the poses
        vars(recording).clear()
        vars(recording).update(self.recording.__getstate__())
        recording.frames, recording.facts = tuple(frames), {**self.facts, **facts}
        return Dataset(recording, *self._truth_options, self.numbers, trajectory)
