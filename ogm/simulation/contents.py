"""Arrays of a dataset's samples with their shapes and types; ``docs/formats.md`` describes the layout."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

from ogm.simulation.mounts import RadarMount
from ogm.simulation.plan import PERIOD
from ogm.simulation.radars import RADARS
from ogm.simulation.sample import DETECTION, OBJECT_DTYPE, Beams
from ogm.truth import TRUTH_SPEC

SHARD = 10  # samples per shard: a shard becomes complete as a whole
OBJECTS = 160  # rows for objects per sample; further objects are dropped
POSES = [f"T_{name}_sensor_{row}{column}" for name in ("world", "vehicle") for row in range(3) for column in range(4)]
# Columns of the facts: numbers stored per sample next to its arrays.
FACTS = (
    *("made", "lidar", "objects", "scenario", "stamp"),
    *POSES,
    *("velocity_x", "velocity_y", "velocity_z", "yaw_rate", "rain", "fog", "wet"),
)
LARGE = ("steps", "intensities", "truth", "heights")  # arrays with a chunk per sample
OF_RADARS = ("sweeps", "detections")  # arrays of datasets with radars
# Columns of a sweep: 1, radar, stamp, detections, pose, velocity; zeros in unused rows.
SWEEP = 4 + 12 + 3
MAX_RADAR_ROWS = 100_000  # sweeps, and detections, of a radar in a sample
UNMEASURED = 65535  # stored range of a beam that was not measured, in datasets with gaps


class StoredRadar(NamedTuple):
    """A radar of a dataset: the attributes of its `RadarMount`, and its largest numbers of sweeps and detections."""

    name: str
    radar: str
    x: float
    y: float
    z: float
    yaw: float
    sweeps: int
    detections: int  # per sample, in all sweeps

    @classmethod
    def of_mount(cls, mount: RadarMount) -> "StoredRadar":
        """Return a radar with space for all sweeps of a sample."""
        spec = RADARS[mount.radar]
        sweeps = max(math.ceil(PERIOD * spec.rate - 1e-6), 1)
        return cls(**asdict(mount), sweeps=sweeps, detections=sweeps * spec.max_detections)

    @classmethod
    def from_dict(cls, given: Mapping[str, Any]) -> "StoredRadar":
        """Return a radar from the attributes of a dataset.

        Raises
        ------
        TypeError, ValueError
            If keys differ from the attributes of this class, or a count is out of range.
        """
        radar = cls(**given)
        for count in (radar.sweeps, radar.detections):
            if not isinstance(count, int) or not 0 < count <= MAX_RADAR_ROWS:
                raise ValueError(f"sweeps and detections of a radar must be in 1 ... {MAX_RADAR_ROWS}, got {count!r}")
        return radar


@dataclass(frozen=True)
class Contents:
    """Contents of a dataset's samples.

    Parameters
    ----------
    beams : tuple of Beams
    radars : tuple of StoredRadar
    heights : bool
        Whether the truth has heights; old datasets have none.
    gaps : bool
        Whether beams may be unmeasured, and the facts include dust: in datasets of recipes.
    """

    beams: tuple[Beams, ...] = ()
    radars: tuple[StoredRadar, ...] = ()
    heights: bool = True
    gaps: bool = False

    @property
    def facts(self) -> tuple[str, ...]:
        """Names of the columns of the facts."""
        return (*FACTS, "dust") if self.gaps else FACTS

    @property
    def large(self) -> tuple[str, ...]:
        """Arrays with a chunk per sample."""
        found = LARGE if self.heights else LARGE[:-1]
        return (*found, "detections") if self.radars else found

    @property
    def checked(self) -> tuple[str, ...]:
        """Names of the columns of the checksums."""
        return (*LARGE, "objects", "facts", *(OF_RADARS if self.radars else ()))

    @property
    def layout(self) -> dict[str, tuple[tuple[int, ...], str]]:
        """Shape and type of a sample in each array, sized for the lidar with most rays; facts come last."""
        rays = max((lidar.shape[0] * lidar.shape[1] for lidar in self.beams), default=0)
        sweeps, detections = (sum(getattr(radar, name) for radar in self.radars) for name in OF_RADARS)
        of_radars = {"sweeps": ((sweeps, SWEEP), "float64"), "detections": ((detections, len(DETECTION)), "float32")}
        return {
            "steps": ((rays,), "uint16"),
            "intensities": ((rays,), "uint8"),
            "truth": (TRUTH_SPEC.shape, "uint8"),
            "heights": (TRUTH_SPEC.shape, "uint8"),
            "objects": ((OBJECTS, len(OBJECT_DTYPE.names or ())), "float32"),
            **(of_radars if self.radars else {}),
            "checksums": ((len(self.checked),), "uint32"),
            "facts": ((len(self.facts),), "float64"),
        }
