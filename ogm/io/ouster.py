"""Captures of Ouster lidars by ouster-sdk: packets (``.pcap`` with the sensor's metadata) and ``.osf``."""

import logging
import struct
import warnings
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ogm.io.columns import scale_intensities
from ogm.io.labels import REACH
from ogm.io.messages.velodyne import BoundedReads, link_layer
from ogm.io.notices import notice
from ogm.io.reading import optional, read_json
from ogm.pose import check_stamp
from ogm.scan import Scan
from ogm.storage.files import FilePath, OgmError, error_context

log: logging.Logger = logging.getLogger(__name__)

_PORTS = (7502, 7503)  # default ports for points and motion
_SEEN = 200  # packets searched for an Ouster
_MIN_SPLIT = 1500  # [byte] above which a packet is split: only Ousters send packets beyond an Ethernet frame
_MM = 1000  # range values per metre
_WHITE = 99.0  # percentile of a scan's photon counts that becomes 1


def ouster_metadata(path: Path) -> Path | None:
    """Return the metadata JSON in a capture's folder, with the longest name that begins the capture's name, or None."""
    named = [file for file in path.parent.glob("*.json") if path.stem.startswith(file.stem.removesuffix("_0"))]
    for file in sorted(named, key=lambda file: -len(file.stem)):
        with suppress(OgmError, OSError):
            content = read_json(file, dict, "metadata of an Ouster")
            if {"beam_intrinsics", "sensor_info", "beam_altitude_angles"} & content.keys():
                return file
    return None


def is_ouster_capture(path: Path) -> bool:
    """Return whether a capture has packets of an Ouster: split over Ethernet frames, or sent to its ports."""
    dpkt = optional("dpkt", path, "ros")
    with path.open("rb") as file, suppress(ValueError, EOFError, struct.error, dpkt.Error):
        packets = dpkt.pcap.UniversalReader(BoundedReads(file))
        layer = link_layer(packets.datalink(), path, dpkt)
        for _, (_, raw) in zip(range(_SEEN), packets, strict=False):
            with suppress(dpkt.Error, struct.error, IndexError):
                packet = layer(raw)
                while hasattr(packet, "data") and not isinstance(packet, dpkt.udp.UDP):
                    packet = packet.data
                if isinstance(packet, dpkt.udp.UDP) and (packet.dport in _PORTS or packet.ulen > _MIN_SPLIT):
                    return True
    return False


def scans_from_ouster(path: FilePath, *, intensity_max: float | None = None, no_returns: bool = True) -> Iterator[Scan]:
    """Read the scans of an Ouster's capture, turn by turn.

    Parameters
    ----------
    path : path
        ``.osf``, or ``.pcap`` with the sensor's metadata in the same folder, see `ouster_metadata`.
    intensity_max : float, optional
        Photon count that becomes 1. Default: the 99 % quantile of the first scan, for all scans.
    no_returns : bool
        Whether to add the beams without echo: all pixels of range 0 in received columns.

    Yields
    ------
    Scan
        Scan in the sensor's frame, by the SDK's table of beam offsets and angles. Rings count from the top.
        `Scan.stamp` is the time of the first column, and `Scan.time` the time of each column. Intensities are photon
        counts, else reflectivities (255 becomes 1).

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If the capture is invalid, or has several sensors.
    ImportError
        If ouster-sdk is missing.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}: check the name and the folder")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings of the SDK about its own parts
        sdk, core = optional("ouster.sdk", path, "ouster"), optional("ouster.sdk.core", path, "ouster")
    table: Any = None
    with error_context(f"{path} cannot be read by ouster-sdk", Exception):
        meta = {} if path.suffix.lower() == ".osf" else {"meta": (str(ouster_metadata(path) or ""),)}
        source = sdk.open_source(str(path), collate=False, **meta)
        if len(source.sensor_info) != 1:
            count = len(source.sensor_info)
            raise OgmError(f"{path} has {count} sensors, wanted one: split the capture by ouster-cli")
        table = core.XYZLut(source.sensor_info[0], use_extrinsics=False)
        turns = iter(source)
    while True:
        with error_context(f"{path} cannot be read by ouster-sdk", Exception):
            frames = next(turns, None)
            turn = None if frames is None else list(frames.valid_frames())
        if turn is None:
            return
        for frame in turn:
            if intensity_max is None and frame.has_field("SIGNAL"):
                intensity_max = photon_scale(frame.field("SIGNAL")[frame.field("RANGE") > 0])
            if (scan := _scan(frame, table, path, intensity_max, no_returns)) is not None:
                yield scan


def photon_scale(counts: NDArray[Any]) -> float:
    """Return the photon count that becomes 1: the 99 % quantile."""
    return max(float(np.percentile(counts, _WHITE)), 1.0) if counts.size else 1.0


def _scan(frame: Any, table: Any, path: Path, intensity_max: float | None, no_returns: bool) -> Scan | None:
    """Return the scan of a turn, or None if no column was received."""
    ranges, received = frame.field("RANGE"), (frame.status & 1).astype(bool) & (frame.timestamp > 0)
    if not received.any():
        return None
    if lost := int(np.count_nonzero(~received)):
        text = "%s: %d of %d columns were not received"
        notice(log, "lost columns", text, path, lost, len(received), level=logging.INFO)
    hit = (ranges > 0) & received & (ranges <= REACH * _MM)
    xyz = table(ranges)[hit]
    points = np.zeros((len(xyz), 4), np.float32)
    points[:, :3] = xyz
    if frame.has_field("SIGNAL"):
        points[:, 3] = np.minimum(frame.field("SIGNAL")[hit] / np.float32(intensity_max), 1)
    elif frame.has_field("REFLECTIVITY"):
        points[:, 3] = scale_intensities(frame.field("REFLECTIVITY")[hit].astype(np.float32), 255.0, None, path)[0]
    first = int(frame.timestamp[received].min())
    time = np.broadcast_to((frame.timestamp.astype(np.int64) - first) * 1e-9, ranges.shape)[hit]
    ring = np.broadcast_to(np.arange(ranges.shape[0], dtype=np.uint16)[:, None], ranges.shape)[hit]
    directions = None
    if no_returns:
        near, far = (table(np.full_like(ranges, k * _MM))[(ranges == 0) & received] for k in (1, 2))
        directions = ((far - near) / np.linalg.norm(far - near, axis=-1, keepdims=True)).astype(np.float32)
    return Scan(points, stamp=check_stamp(first * 1e-9), time=time, ring=ring, no_returns=directions)
