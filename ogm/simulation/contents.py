"""What the samples of a data set hold: arrays with their shapes and types; ``docs/formats.md`` has the layout."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

from ogm.simulation.mounts import RadarMount
from ogm.simulation.plan import PERIOD
from ogm.simulation.radars import RADARS
from ogm.simulation.sample import DETECTION, OBJECT, Beams
from ogm.truth import TRUTH_SPEC

SHARD = 10  # samples per shard: they become complete together
OBJECTS = 160  # rows for objects per sample; of more, the first are kept
POSES = [f"T_{name}_sensor_{row}{column}" for name in ("world", "vehicle") for row in range(3) for column in range(4)]
# Names of the numbers that are kept of each sample, beside its arrays
FACTS = (
    *("made", "lidar", "objects", "scenario", "stamp"),
    *POSES,
    *("velocity_x", "velocity_y", "velocity_z", "yaw_rate", "rain", "fog", "wet"),
)
LARGE = ("steps", "intensities", "truth", "heights")  # arrays with a chunk per sample
OF_RADARS = ("sweeps", "detections")  # arrays of data sets with radars
# columns of a sweep: 1, radar, stamp, detections, pose, velocity; zeros after the last one
SWEEP = 4 + 12 + 3
MOST = 100_000  # sweeps, and detections, of a radar in a sample
UNMEASURED = 65535  # range of a beam that was not measured, in data sets that may have such


class StoredRadar(NamedTuple):
    """A radar of a data set: name, kind and place as of `RadarMount`, and the most that a sample has of it."""

    name: str
    radar: str
    x: float
    y: float
    z: float
    yaw: float
    sweeps: int
    detections: int  # of all these sweeps together

    @classmethod
    def of_mount(cls, mount: RadarMount) -> "StoredRadar":
        """Return a radar with space for all sweeps that may belong to a sample."""
        spec = RADARS[mount.radar]
        sweeps = max(math.ceil(PERIOD * spec.rate - 1e-6), 1)
        return cls(**asdict(mount), sweeps=sweeps, detections=sweeps * spec.most)

    @classmethod
    def from_dict(cls, given: Mapping[str, Any]) -> "StoredRadar":
        """Return a radar as a data set's attributes hold it.

        Raises
        ------
        TypeError, ValueError
            If there are other numbers than `of_mount` gives.
        """
        one = cls(**given)
        for count in (one.sweeps, one.detections):
            if not isinstance(count, int) or not 0 < count <= MOST:
                raise ValueError(f"a sample has 1 to {MOST} sweeps and detections of a radar, got {count!r}")
        return one


@dataclass(frozen=True)
class Contents:
    """What the samples of a data set hold.

    Parameters
    ----------
    beams : tuple of Beams
    radars : tuple of StoredRadar
    heights : bool
        Old data sets have none.
    gaps : bool
        Whether there may be beams that were not measured, and one more fact: in data sets of recipes.
    """

    beams: tuple[Beams, ...] = ()
    radars: tuple[StoredRadar, ...] = ()
    heights: bool = True
    gaps: bool = False

    @property
    def facts(self) -> tuple[str, ...]:
        """Columns of the facts."""
        return (*FACTS, "dust") if self.gaps else FACTS

    @property
    def large(self) -> tuple[str, ...]:
        """Arrays with a chunk per sample."""
        found = LARGE if self.heights else LARGE[:-1]
        return (*found, "detections") if self.radars else found

    @property
    def checked(self) -> tuple[str, ...]:
        """Columns of the checksums."""
        return (*LARGE, "objects", "facts", *(OF_RADARS if self.radars else ()))

    @property
    def layout(self) -> dict[str, tuple[tuple[int, ...], str]]:
        """Shape and type of a sample in each array, with space for the lidar that has most rays; facts come last."""
        rays = max((one.shape[0] * one.shape[1] for one in self.beams), default=0)
        sweeps, detections = (sum(getattr(one, name) for one in self.radars) for name in OF_RADARS)
        of_radars = {"sweeps": ((sweeps, SWEEP), "float64"), "detections": ((detections, len(DETECTION)), "float32")}
        return {
            "steps": ((rays,), "uint16"),
            "intensities": ((rays,), "uint8"),
            "truth": (TRUTH_SPEC.shape, "uint8"),
            "heights": (TRUTH_SPEC.shape, "uint8"),
            "objects": ((OBJECTS, len(OBJECT.names or ())), "float32"),
            **(of_radars if self.radars else {}),
            "checksums": ((len(self.checked),), "uint32"),
            "facts": ((len(self.facts),), "float64"),
        }
