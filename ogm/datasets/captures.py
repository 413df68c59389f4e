"""Network captures of Velodyne sensors (.pcap): one whole turn of the sensor after the other."""

import threading
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path

from ogm.datasets.frames import FrameRef, RawFrame
from ogm.datasets.logs import turn_scan
from ogm.datasets.recording import OpenOptions, Recording
from ogm.io.axes import rotation_to_flu
from ogm.io.messages import scans_from_pcap
from ogm.scan import Scan
from ogm.storage.files import OgmError

__all__ = ["CAPTURE_ENDINGS", "CaptureRecording"]

CAPTURE_ENDINGS = (".pcap", ".pcapng")


class CaptureRecording(Recording):
    """Scans of a capture of one Velodyne."""

    format = "network capture"
    wanted_labels = "poses of the scans, which a capture has not: estimate them with `ogm fuse --odometry`"
    ego_footprint = None
    stamped = True
    known_axes = False

    @classmethod
    def open(cls, paths: Sequence[Path], options: OpenOptions) -> "CaptureRecording | None":
        """Return the scans of a capture; None if no path has the name of a capture.

        Raises
        ------
        OgmError
            If there are several files, or the file is no capture of one Velodyne.
        ValueError
            If the options state units: those of packets are known.
        """
        if not any(path.suffix.lower() in CAPTURE_ENDINGS for path in paths):
            return None
        path, axes = paths[0], options.axes
        rotation_to_flu(axes)  # refuses wrong axes
        if len(paths) > 1:
            raise OgmError(f"{path} is a network capture; give one alone")
        if options.units:
            raise ValueError(f"{path} has scans of known units; leave out intensity_max and time_unit")
        stamps = [scan.stamp for scan in scans_from_pcap(path, no_returns=False)]
        refs = [FrameRef(f"{n:06d}", path.stem, stamp) for n, stamp in enumerate(stamps)]
        recording = cls(path, refs, path.stem)
        recording.axes = axes
        return recording

    @cached_property
    def _turns(self) -> "_Turns":
        return _Turns(self.path)

    def read(self, n: int) -> RawFrame:
        """Read a scan; quick in the order of the scans."""
        return RawFrame(turn_scan(self._turns.read(n), rotation_to_flu(self.axes)))


class _Turns:
    """The scans of a capture, which is decoded from its beginning: quick in their order, not in another."""

    def __init__(self, path: Path) -> None:
        self._path, self._lock = path, threading.Lock()
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
