"""RadarScenes: sequences of sweeps of four radars, with the vehicle's poses."""

from functools import cached_property
from pathlib import Path

from ogm.datasets.frames import Footprint, FrameRef, RawFrame, SensorPlace
from ogm.datasets.recording import Recording
from ogm.datasets.scans import in_order
from ogm.io.radarscenes import RadarScenes, read_radarscenes

_HEIGHT = 0.5  # [m] above ground, of bumper radars; not stated by the dataset
_VEHICLE: Footprint = (-1.1, 3.8, -0.95, 0.95)  # around the rear axle; our estimate, as front radars are at x = 3.9 m


class RadarScenesRecording(Recording):
    """One sequence (``scenes.json`` and ``radar_data.h5``), or a folder of sequences (``sequence_*/``)."""

    format = "RadarScenes"
    wanted_labels = "none: the labels of RadarScenes are of moving detections, not of cells"
    ego_footprint = None
    aggregated = False
    stamped = True
    motion_distorted = False

    def __init__(self, path: Path, folders: list[Path]) -> None:
        self.folders = folders
        sweeps = [(part.name, part.sweeps[n]) for part, n in self.sweeps]
        rows = [(name, sweep.timestamp, sweep.T_map_sensor) for name, sweep in sweeps]
        super().__init__(path, [FrameRef(str(time), name, time * 1e-6, T) for name, time, T in rows])

    @classmethod
    def find(cls, path: Path) -> "RadarScenesRecording | None":
        """Return the sweeps of all sequences, or None if there is no sequence."""
        folders = [path] if _is_sequence(path) else []
        for above in (path, path / "data"):
            folders = folders or in_order(filter(_is_sequence, above.glob("sequence_*/")))
        return cls(path, folders) if folders else None

    @cached_property
    def sweeps(self) -> list[tuple[RadarScenes, int]]:
        """Sequence of each frame, and the number of its sweep in the sequence."""
        return [(part, n) for part in map(read_radarscenes, self.folders) for n in range(len(part.sweeps))]

    def read(self, n: int) -> RawFrame:
        """Read the detections of a sweep."""
        sequence, k = self.sweeps[n]
        return RawFrame(sequence.scan(k))

    def place(self, n: int) -> SensorPlace:
        """Return the place of the radar of a sweep."""
        sequence, k = self.sweeps[n]
        sweep = sequence.sweeps[k]
        return SensorPlace(sweep.sensor, sweep.origin, height=_HEIGHT, ego_footprint=_VEHICLE, yaw=sweep.yaw)


def _is_sequence(path: Path) -> bool:
    return (path / "scenes.json").is_file() and (path / "radar_data.h5").is_file()
