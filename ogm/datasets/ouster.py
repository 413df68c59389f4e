"""Captures of Ouster lidars as recordings: ``.osf``, or ``.pcap`` with metadata."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from ogm.datasets.frames import FrameRef
from ogm.datasets.logs import CAPTURE_ENDINGS, CaptureRecording
from ogm.datasets.recording import OpenOptions
from ogm.datasets.scans import pose_files, poses_of
from ogm.io.ouster import is_ouster_capture, ouster_metadata, scans_from_ouster
from ogm.scan import Scan
from ogm.storage.files import OgmError

OUSTER_ENDING = ".osf"


class OusterRecording(CaptureRecording):
    """Scans of an Ouster capture, with poses if a file ``NAME_poses*.txt`` lies next to it."""

    format = "capture of an Ouster"
    wanted_labels = "poses of the scans (NAME_poses*.txt next to the capture)"
    intensity_max: float | None = None

    @classmethod
    def open(cls, paths: Sequence[Path], options: OpenOptions) -> "OusterRecording | None":
        """Return the scans of a capture, or None if no path is an Ouster capture.

        Raises
        ------
        OgmError
            If there are several files, or the sensor's metadata are missing.
        ImportError
            If ouster-sdk is missing.
        """
        path = paths[0]
        if path.suffix.lower() != OUSTER_ENDING:
            if path.suffix.lower() not in CAPTURE_ENDINGS or len(paths) > 1 or not path.is_file():
                return None
            if ouster_metadata(path) is None:
                if not is_ouster_capture(path):
                    return None
                raise OgmError(
                    f"{path} has packets of an Ouster, but no metadata to decode them: wanted {path.stem}.json next to "
                    "it, from http://SENSOR/api/v1/sensor/metadata or `ouster-cli source SENSOR save`"
                )
        if len(paths) > 1:
            raise OgmError(f"{path} is a capture of an Ouster, got {len(paths)} paths: give one alone")
        if options.units.keys() - {"intensity_max"}:
            raise ValueError(f"{path} is a capture of an Ouster: leave out `time_unit` and `origin`, which it states")

        stamps = [scan.stamp for scan in scans_from_ouster(path, no_returns=False)]
        names = [f"{n:06d}" for n in range(len(stamps))]
        poses = poses_of([*sorted(path.parent.glob(f"{path.stem}_poses*.txt")), *pose_files(path.parent)], names)
        rows = zip(names, stamps, poses, strict=True)
        recording = cls(path, [FrameRef(name, path.stem, stamp, T) for name, stamp, T in rows], path.stem)
        recording.axes, recording.intensity_max = options.axes, options.units.get("intensity_max")
        return recording

    def decode(self) -> Iterator[Scan]:
        """Decode the scans from the beginning of the capture."""
        return scans_from_ouster(self.path, intensity_max=self.intensity_max)
