"""Captures of the network (``.pcap``) with packets of Velodyne sensors to scans."""

import logging
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from ogm.io.messages.velodyne import PACKET_BYTES, Packet, VelodyneDecoder
from ogm.io.reading import optional
from ogm.pose import check_stamp
from ogm.scan import Scan
from ogm.storage.files import OgmError

log: logging.Logger = logging.getLogger(__name__)

_MOST = 20_000  # packets of one turn: that of the largest sensor has some 2500
_LONGEST = 2**24  # [byte] of a packet or a block, as Wireshark has it


def scans_from_pcap(
    path: str | os.PathLike[str],
    model: str | None = None,
    *,
    source: str | None = None,
    calibration: str | os.PathLike[str] | None = None,
    no_returns: bool = True,
) -> Iterator[Scan]:
    """Read the scans of a network capture, one whole turn of the sensor after the other.

    A turn begins where the first packet begins. What is left at the end and is no whole turn is left out, and so is
    a packet that is cut off.

    Parameters
    ----------
    path : path
        A ``.pcap`` or ``.pcapng``. Packets of other lengths than a Velodyne's data are left out.
    model, calibration, no_returns
        As for `scan_from_velodyne_scan`.
    source : str, optional
        Address and port of the sensor, such as ``192.168.1.201:2368``, where several are in the capture.

    Yields
    ------
    Scan
        Its stamp is that of the capture.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If it is no capture, has no packets of a Velodyne, or of several sensors and `source` is not given, or nothing
        tells the model.
    ImportError
        If velodyne-decoder is missing.
    """
    path = Path(path)
    decoder: VelodyneDecoder | None = None
    turn: list[Packet] = []
    advance, before, step = 0, None, 0  # [1/100 degree]
    for packet in _captured(path, source):
        azimuth = int.from_bytes(packet.data[2:4], "little")
        if before is not None:
            step = (azimuth - before) % 36000
            advance += step
        before = azimuth
        if advance >= 36000 or len(turn) >= _MOST:
            decoder = decoder or VelodyneDecoder(turn, model, calibration, str(path))
            yield decoder.scan(turn, turn[0].stamp, no_returns, str(path))
            turn, advance = [], 0
        turn.append(packet)
    if not turn:
        raise OgmError(
            f"{path} has no packets of {PACKET_BYTES} bytes{f' from {source}' if source else ''}, as Velodynes send"
        )
    if advance + step >= 36000:
        decoder = decoder or VelodyneDecoder(turn, model, calibration, str(path))
        yield decoder.scan(turn, turn[0].stamp, no_returns, str(path))
    elif decoder is None:
        raise OgmError(f"{path} has no whole turn of the sensor, only {advance / 100:g} degrees")
    else:
        log.info("%s: %g degrees at the end are no whole turn and are left out", path, advance / 100)


class _BoundedReads:
    """A file that gives no more at once than a packet can have: dpkt asks for whatever length the file states."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self.seek, self.name = file, file.seek, file.name

    def read(self, size: int) -> bytes:
        if not 0 <= size <= _LONGEST:
            raise EOFError(f"a packet of {size} bytes")
        return self._file.read(size)


def _captured(path: Path, source: str | None) -> Iterator[Packet]:
    """Read the data packets of one sensor."""
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}: check the name and the folder")
    dpkt = optional("dpkt", path, "ros")
    found = source
    with open(path, "rb") as file:
        try:
            packets = dpkt.pcap.UniversalReader(_BoundedReads(file))
            linux = packets.datalink() == dpkt.pcap.DLT_LINUX_SLL
        except (ValueError, EOFError, struct.error, dpkt.Error) as error:
            raise OgmError(f"{path} is no network capture ({error}): is its name right?") from error
        layer = dpkt.sll.SLL if linux else dpkt.ethernet.Ethernet
        try:
            for stamp, raw in packets:
                data, sender = _payload(layer, raw, dpkt)
                if data is None or len(data) != PACKET_BYTES or (source is not None and sender != source):
                    continue
                found = found or sender
                if sender != found:
                    raise OgmError(f"{path} has packets of several sensors, {found} and {sender}: give one as source")
                try:
                    yield Packet(check_stamp(float(stamp)), data)
                except ValueError as error:
                    raise OgmError(f"{path} has a packet whose {error}") from error
        except (EOFError, dpkt.Error) as error:
            log.warning("%s is cut short: %s", path, error)


def _payload(layer: Any, raw: bytes, dpkt: Any) -> tuple[bytes | None, str]:
    """Return the innermost bytes of a packet of the network, and who sent them."""
    try:
        packet = layer(raw)
    except dpkt.Error:
        return None, ""
    address, port = "", 0
    while hasattr(packet, "data"):
        if isinstance(packet, dpkt.ip.IP):
            address = ".".join(map(str, packet.src))
        elif isinstance(packet, dpkt.udp.UDP):
            port = packet.dport
        packet = packet.data
    return (bytes(packet) if isinstance(packet, bytes | bytearray | memoryview) else None), f"{address}:{port}"
