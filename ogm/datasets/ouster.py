"""Captures of Ouster lidars, ``.osf`` and ``.pcap`` with metadata, as a recording."""

from collections.abc import Sequence
from functools import cached_property, partial
from pathlib import Path

from ogm.datasets.frames import FrameRef, RawFrame
from ogm.datasets.logs import CAPTURE_ENDINGS, ScanSequence, turn_scan
from ogm.datasets.recording import OpenOptions, Recording
from ogm.datasets.scans import pose_files, poses_of
from ogm.io.ouster import is_ouster_capture, ouster_metadata, scans_from_ouster
from ogm.io.scan_table import rotation_to_flu
from ogm.storage.files import OgmError

OUSTER_ENDING = ".osf"


class OusterRecording(Recording):
    """Scans of a capture of one Ouster, with the poses in a file ``NAME_poses*`` beside it if there is one."""

    format = "capture of an Ouster"
    wanted_labels = "poses of the scans (NAME_poses*.txt beside the capture)"
    ego_footprint = None
    stamped = True
    known_axes = False

    @classmethod
    def open(cls, paths: Sequence[Path], options: OpenOptions) -> "OusterRecording | None":
        """Return the scans of a capture; None if no path is one of an Ouster.

        Raises
        ------
        OgmError
            If there are several files, or the metadata of the sensor are missing.
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
                    f"{path} has packets of an Ouster, which its metadata decode: wanted {path.stem}.json beside it, "
                    "as http://SENSOR/api/v1/sensor/metadata gives it, or `ouster-cli source SENSOR save`"
                )
        if len(paths) > 1:
            raise OgmError(f"{path} is a capture of an Ouster; give one alone")
        if options.units.keys() - {"intensity_max"}:
            raise ValueError(
                f"{path} has times of known units in its sensor's frame; leave out `time_unit` and `origin`"
            )
        rotation_to_flu(options.axes)  # refuses wrong axes
        stamps = [scan.stamp for scan in scans_from_ouster(path, no_returns=False)]
        names = [f"{n:06d}" for n in range(len(stamps))]
        poses = poses_of([*sorted(path.parent.glob(f"{path.stem}_poses*.txt")), *pose_files(path.parent)], names)
        rows = zip(names, stamps, poses, strict=True)
        recording = cls(path, [FrameRef(name, path.stem, stamp, T) for name, stamp, T in rows], path.stem)
        recording.axes, recording.intensity_max = options.axes, options.units.get("intensity_max")
        return recording

    intensity_max: float | None = None

    @cached_property
    def _scans(self) -> ScanSequence:
        return ScanSequence(self.path, partial(scans_from_ouster, self.path, intensity_max=self.intensity_max))

    def read(self, n: int) -> RawFrame:
        """Read a scan; quick in the order of the scans."""
        return RawFrame(turn_scan(self._scans.read(n), rotation_to_flu(self.axes)))
