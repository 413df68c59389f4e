"""Packets of Velodyne sensors, from ``velodyne_msgs/VelodyneScan`` or network captures (``.pcap``), to scans."""

import logging
import re
import socket
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ogm.io.formats.table import Table
from ogm.io.messages.plain import as_bytes, describe_message, reads_message, stamp_seconds
from ogm.io.notices import notice
from ogm.io.reading import optional
from ogm.io.scan_table import directions_without_return, scan_from_table
from ogm.pose import check_stamp
from ogm.scan import Scan
from ogm.storage.files import FilePath, OgmError, error_context

log: logging.Logger = logging.getLogger(__name__)

# Names of Velodynes, and their names in velodyne-decoder
VELODYNE_MODELS = {
    **{"VLP-16": "VLP16", "Puck LITE": "PuckLite", "Puck Hi-Res": "PuckHiRes", "VLP-32A": "VLP32A"},
    **{"VLP-32B": "VLP32B", "VLP-32C": "VLP32C", "HDL-32E": "HDL32E", "HDL-64E S1": "HDL64E_S1"},
    **{"HDL-64E S2": "HDL64E_S2", "HDL-64E S3": "HDL64E_S3", "VLS-128": "VLS128", "Alpha Prime": "AlphaPrime"},
}
"""Names of models, and their names in `velodyne_decoder.Model`. An HDL-64E also needs its calibration file."""

PACKET_BYTES = 1206  # size of a data packet
_RETURNS = (0x37, 0x38, 0x39, 0x3B)  # last byte but one: strongest, last, both, both with confidence
_PRODUCTS = {0x21: "HDL-32E", 0x22: "VLP-16", 0x24: "Puck Hi-Res", 0x28: "VLP-32C", 0xA1: "VLS-128"}  # last byte
_SAME_CLOCK = 10.0  # [s] largest difference between the stamps of a message and its packets
_COLUMNS = ("x", "y", "z", "intensity", "time", "column", "ring")  # of velodyne_decoder


class Packet(NamedTuple):
    """A data packet.

    Attributes
    ----------
    stamp : float
        [s]
    data : bytes
        1206 bytes.
    """

    stamp: float
    data: bytes


@reads_message
def scan_from_velodyne_scan(
    message: Any, model: str | None = None, *, calibration: FilePath | None = None, no_returns: bool = True
) -> Scan:
    """Return the scan of a ``velodyne_msgs/VelodyneScan``.

    Parameters
    ----------
    message : object
        Object with the fields of the message.
    model : str, optional
        One of `VELODYNE_MODELS`. By default read from the packets' factory bytes, which are missing for an HDL-64E and
        equal for VLP-16 and Puck LITE.
    calibration : path, optional
        YAML file of the sensor's angles, in the format of the ROS driver; by default the model's angles.
    no_returns : bool
        Whether to compute the beams without echo, which takes longer than all other steps.

    Returns
    -------
    Scan
        Scan with both echoes if the sensor reports two; intensity 255 becomes 1. `Scan.stamp` is the header's stamp,
        and `Scan.time` counts from it.

    Raises
    ------
    OgmError
        If there are no packets, a packet has the wrong size, or the model is unknown.
    ImportError
        If velodyne-decoder is missing.
    """
    where = describe_message(message, "VelodyneScan")
    packets = [Packet(stamp_seconds(part.stamp), as_bytes(part.data, where).tobytes()) for part in message.packets]
    if not packets or any(len(packet.data) != PACKET_BYTES for packet in packets):
        raise OgmError(f"{where} has {len(packets)} packets, wanted some, of {PACKET_BYTES} bytes each: it is damaged")
    decoder = VelodyneDecoder(packets, model, calibration, where)
    return decoder.scan(packets, stamp_seconds(message.header.stamp), no_returns, where)


class VelodyneDecoder:
    """Decoder of one sensor by `velodyne_decoder`.

    Parameters
    ----------
    packets : sequence of Packet
        Some packets, which may identify the model.
    model, calibration
        See `scan_from_velodyne_scan`.
    where : str
        Name of the source, for errors.
    """

    def __init__(self, packets: Sequence[Packet], model: str | None, calibration: FilePath | None, where: str) -> None:
        self.library = optional("velodyne_decoder", Path(where), "ros")
        name = _model_of(packets, where) if model is None else _known_model(model)
        with error_context(f"{calibration} is no calibration of a Velodyne", Exception):
            angles = None if calibration is None else self.library.Calibration.read(str(calibration))
        if angles is None and name.startswith("HDL64E"):
            raise OgmError(f"{where} is from an HDL-64E, which has individual angles: give its file as calibration")
        kind = getattr(self.library.Model, name)
        options = {} if angles is None else {"calibration": angles}
        limits: Any = {"min_range": 0.0, "max_range": 1000.0}
        self.config = self.library.Config(model=kind, timestamp_first_packet=True, **limits, **options)

    def scan(self, packets: Sequence[Packet], stamp: float, no_returns: bool, where: str) -> Scan:
        """Return the scan of some packets; its times count from `stamp`."""
        library = self.library
        product, number = Counter(packet.data[-1] for packet in packets).most_common(1)[0]
        if number < len(packets) and product in _PRODUCTS:  # the library stops at the first damaged packet
            text = "%s: %d of %d packets are damaged and left out"
            notice(log, "damaged packets", text, where, len(packets) - number, len(packets))
            packets = [packet for packet in packets if packet.data[-1] == product]
        with error_context(f"{where} has packets that do not decode", Exception):
            vector = library.PacketVector([library.VelodynePacket(*packet) for packet in packets])
            first, points = library.ScanDecoder(self.config).decode(vector)
        columns: dict[str, NDArray[Any]] = dict(zip(_COLUMNS, np.asarray(points, np.float32).T, strict=False))
        late = first.host - stamp
        columns["time"] = columns["time"].astype(np.float64) + (late if abs(late) <= _SAME_CLOCK else 0.0)
        table = Table("Velodyne packets", columns, None, 255.0)
        scan = scan_from_table(table, where, stamp=stamp, time_unit=1.0)[0]
        return replace(scan, no_returns=_directions(columns)) if no_returns else scan


def _directions(columns: dict[str, NDArray[Any]]) -> NDArray[np.float32] | None:
    """Return the directions of beams without echo: the gaps in the raster of rings and firings."""
    row, column = (columns[name].astype(np.intp) for name in ("ring", "column"))
    if not row.size:
        return None
    xyz = np.zeros((3, int(row.max()) + 1, int(column.max()) + 1), np.float32)
    for image, name in zip(xyz, "xyz", strict=True):
        image[row, column] = columns[name]
    x, y, z = xyz
    return directions_without_return(x, y, z, np.any(xyz != 0, axis=0))


def _model_of(packets: Sequence[Packet], where: str) -> str:
    """Return the model identified by the factory bytes at the end of most packets."""
    ends = Counter(packet.data[-2:] for packet in packets)
    known = Counter[str]()
    for end, number in ends.items():
        if end[0] in _RETURNS and end[1] in _PRODUCTS:
            known[_PRODUCTS[end[1]]] += number
    if not known or 2 * known.most_common(1)[0][1] <= len(packets):  # single packets may be damaged
        raise OgmError(
            f"{where} has packets with last bytes of no known model "
            f"({', '.join(sorted(end.hex() for end in ends)[:4])}): give as model one of {', '.join(VELODYNE_MODELS)}"
        )
    return VELODYNE_MODELS[known.most_common(1)[0][0]]


def _known_model(model: str) -> str:
    """Return the library's name of a model, ignoring blanks, dashes and case."""
    names = {re.sub(r"[^a-z0-9]", "", name.lower()): value for name, value in VELODYNE_MODELS.items()}
    plain = re.sub(r"[^a-z0-9]", "", model.lower())
    if plain not in names:
        raise ValueError(f"there is no model {model!r}: give one of {', '.join(VELODYNE_MODELS)}")
    return names[plain]


_MAX_PACKETS = 20_000  # of one turn; the largest sensor sends about 2500
_MAX_BYTES = 2**24  # of a packet or a block, as in Wireshark


def scans_from_pcap(
    path: FilePath,
    model: str | None = None,
    *,
    source: str | None = None,
    calibration: FilePath | None = None,
    no_returns: bool = True,
) -> Iterator[Scan]:
    """Read the scans of a network capture, turn by turn.

    A turn begins at the azimuth of the first packet. An incomplete turn at the end, and a packet that is cut off, are
    left out.

    Parameters
    ----------
    path : path
        A ``.pcap`` or ``.pcapng``. Packets of other lengths than a Velodyne's data are left out.
    model, calibration, no_returns
        See `scan_from_velodyne_scan`.
    source : str, optional
        Address and port of the sensor, such as ``192.168.1.201:2368``, for captures of several sensors.

    Yields
    ------
    Scan
        Scan with the stamp of the capture.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    OgmError
        If it is no capture, has no packets of a Velodyne, has packets of several sensors without `source`, or the model
        is unknown.
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
        if advance >= 36000 or len(turn) >= _MAX_PACKETS:
            decoder = decoder or VelodyneDecoder(turn, model, calibration, str(path))
            yield decoder.scan(turn, turn[0].stamp, no_returns, str(path))
            turn, advance = [], 0
        turn.append(packet)
    if not turn:
        sender = f" from {source}" if source else ""
        raise OgmError(f"{path} has no packets of {PACKET_BYTES} bytes{sender}, as sent by a Velodyne")
    if advance + step >= 36000:
        decoder = decoder or VelodyneDecoder(turn, model, calibration, str(path))
        yield decoder.scan(turn, turn[0].stamp, no_returns, str(path))
    elif decoder is None:
        raise OgmError(f"{path} has no complete turn of the sensor, only {advance / 100:g} degrees")
    else:
        log.info("%s: %g degrees at the end are no complete turn and are left out", path, advance / 100)


class BoundedReads:
    """File that limits the size of one read to a packet: dpkt asks for any length stated by the file."""

    def __init__(self, file: IO[bytes]) -> None:
        self._file, self.seek, self.name = file, file.seek, file.name

    def read(self, size: int) -> bytes:
        """Read some bytes; raise EOFError for more than a packet."""
        if not 0 <= size <= _MAX_BYTES:
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
            packets = dpkt.pcap.UniversalReader(BoundedReads(file))
            layer = link_layer(packets.datalink(), path, dpkt)
        except (ValueError, EOFError, struct.error, dpkt.Error) as error:
            raise OgmError(f"{path} is no network capture ({error}): check its name") from error
        try:
            for stamp, raw in packets:
                data, sender = _payload(layer, raw, dpkt)
                if data is None or len(data) != PACKET_BYTES or (source is not None and sender != source):
                    continue
                found = found or sender
                if sender != found:
                    raise OgmError(f"{path} has packets of several sensors, {found} and {sender}: give one as source")
                try:
                    packet = Packet(check_stamp(float(stamp)), data)
                except ValueError as error:
                    notice(log, "wrong stamp", "%s: a packet is left out: its %s", path, error)
                    continue
                yield packet
        except (EOFError, dpkt.Error) as error:
            log.warning("%s is cut short: %s", path, error)


def link_layer(number: int, path: Path, dpkt: Any) -> Callable[[bytes], Any]:
    """Return the decoder for packets of a capture, by the number of its link layer.

    Raises
    ------
    OgmError
        If it is not Ethernet, Linux cooked (``-i any``), IP without a link layer, or loopback.
    """
    pcap = dpkt.pcap
    raw = (12, 14, 101, pcap.DLT_IPV4, pcap.DLT_IPV6)  # DLT_RAW differs between systems
    layers: dict[int, Callable[[bytes], Any]] = {
        pcap.DLT_EN10MB: dpkt.ethernet.Ethernet,
        pcap.DLT_LINUX_SLL: dpkt.sll.SLL,
        pcap.DLT_LINUX_SLL2: dpkt.sll2.SLL2,
        **dict.fromkeys((pcap.DLT_NULL, pcap.DLT_LOOP), dpkt.loopback.Loopback),
        **dict.fromkeys(raw, partial(_ip, dpkt)),
    }
    if number not in layers:
        raise OgmError(f"{path} is a capture of link layer {number}, wanted Ethernet, Linux cooked or raw IP")
    return layers[number]


def _ip(dpkt: Any, data: bytes) -> Any:
    """Return an IP packet without a link layer."""
    return (dpkt.ip6.IP6 if data[:1] and data[0] >> 4 == 6 else dpkt.ip.IP)(data)


def _payload(layer: Callable[[bytes], Any], raw: bytes, dpkt: Any) -> tuple[bytes | None, str]:
    """Return the innermost bytes of a network packet, and its sender."""
    try:
        packet = layer(raw)
    except (dpkt.Error, struct.error, IndexError):
        return None, ""
    address, port = "", 0
    while hasattr(packet, "data"):
        if isinstance(packet, dpkt.ip.IP):
            address = ".".join(map(str, packet.src))
        elif isinstance(packet, dpkt.ip6.IP6):
            address = f"[{socket.inet_ntop(socket.AF_INET6, packet.src)}]"
        elif isinstance(packet, dpkt.udp.UDP):
            port = packet.dport
        packet = packet.data
    return (bytes(packet) if isinstance(packet, bytes | bytearray | memoryview) else None), f"{address}:{port}"
