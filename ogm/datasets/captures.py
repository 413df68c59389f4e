"""Network captures of Velodyne sensors (.pcap): one whole turn of the sensor after the other."""

import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

from ogm.datasets.layout import FrameRef, Layout, RawFrame
from ogm.datasets.logs import turn_scan
from ogm.io import Axes
from ogm.io.axes import rotation_to_flu
from ogm.io.messages import scans_from_pcap
from ogm.scan import Scan
from ogm.storage.files import OgmError

__all__ = ["CAPTURE_ENDINGS", "captures"]

CAPTURE_ENDINGS = (".pcap", ".pcapng")


def captures(
    paths: Sequence[Path], axes: Axes = "flu", intensity_max: float | None = None, time_unit: float | None = None
) -> Layout | None:
    """Line up the scans of a capture; None where it is none by its name.

    Parameters
    ----------
    paths : sequence of Path
    axes : Axes
        Which way the sensor's axes point.
    intensity_max, time_unit
        Refused: packets have known units.

    Raises
    ------
    OgmError
        If there are several, or the file is no capture of one Velodyne.
    """
    if not any(path.suffix.lower() in CAPTURE_ENDINGS for path in paths):
        return None
    path, turn = paths[0], rotation_to_flu(axes)
    if len(paths) > 1:
        raise OgmError(f"{path} is a network capture; give one alone")
    if intensity_max is not None or time_unit is not None:
        raise ValueError(f"{path} has scans of known units; leave out intensity_max and time_unit")
    scans = _Turns(path)
    return Layout(
        "network capture",
        tuple(FrameRef(f"{n:06d}", path.stem, stamp) for n, stamp in enumerate(scans.stamps)),
        lambda n: RawFrame(turn_scan(scans.read(n), turn)),
        "poses of the scans, which a capture has not: estimate them with `ogm fuse --odometry`",
        ego_footprint=None,
        stamped=True,
        axes=axes,
        known_axes=False,
        name=path.stem,
    )


class _Turns:
    """The scans of a capture, which is decoded from its beginning: quick in their order, not in another."""

    def __init__(self, path: Path) -> None:
        self._path, self._lock = path, threading.Lock()
        self.stamps = [scan.stamp for scan in scans_from_pcap(path, no_returns=False)]
        self._rewind()

    def read(self, n: int) -> Scan:
        """Decode up to scan n."""
        with self._lock:
            if n < self._next:
                self._rewind()
            for scan in self._scans:
                self._next += 1
                if self._next > n:
                    return scan
        raise OgmError(f"{self._path} has no scan {n} any more: was it changed?")

    def _rewind(self) -> None:
        self._scans: Iterator[Scan] = scans_from_pcap(self._path)
        self._next = 0
