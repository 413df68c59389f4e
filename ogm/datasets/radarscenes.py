"""RadarScenes: sequences of sweeps of four radars, with the vehicle's poses."""

from pathlib import Path

from ogm.datasets.layout import Footprint, FrameRef, Layout, RawFrame, SensorPlace
from ogm.io.radarscenes import read_radarscenes

__all__ = ["radarscenes"]

_HEIGHT = 0.5  # [m] above ground, of radars in a bumper: the data set does not state it
_VEHICLE: Footprint = (-1.1, 3.8, -0.95, 0.95)  # around the rear axle: a car whose front radars are at x = 3.9 m; ours


def radarscenes(path: Path) -> Layout | None:
    """Find a sequence (``scenes.json`` and ``radar_data.h5``), or a folder with several, ``sequence_*/``."""
    folders = [path] if _is_sequence(path) else []
    for above in (path, path / "data"):
        folders = folders or sorted(filter(_is_sequence, above.glob("sequence_*/")), key=_number)
    if not folders:
        return None
    sequences = [read_radarscenes(folder) for folder in folders]
    places = [(sequence, n) for sequence in sequences for n in range(len(sequence.sweeps))]
    frames = tuple(
        FrameRef(str(one.timestamp), sequence.name, one.timestamp * 1e-6, one.T_map_sensor)
        for sequence in sequences
        for one in sequence.sweeps
    )

    def read(n: int) -> RawFrame:
        sequence, k = places[n]
        return RawFrame(sequence.scan(k))

    def place(n: int) -> SensorPlace:
        sequence, k = places[n]
        sweep = sequence.sweeps[k]
        return SensorPlace(sweep.sensor, sweep.origin, height=_HEIGHT, ego_footprint=_VEHICLE, yaw=sweep.yaw)

    return Layout(
        "RadarScenes",
        frames,
        read,
        "none: the labels of RadarScenes are of moving detections, not of cells",
        ego_footprint=None,
        aggregated=False,
        place=place,
        stamped=True,
        motion_distorted=False,
    )


def _is_sequence(path: Path) -> bool:
    return (path / "scenes.json").is_file() and (path / "radar_data.h5").is_file()


def _number(path: Path) -> tuple[int, str]:
    """Sort sequence_2 before sequence_10."""
    digits = path.name.removeprefix("sequence_")
    return (int(digits) if digits.isascii() and digits.isdigit() and len(digits) < 9 else 10**9), path.name
