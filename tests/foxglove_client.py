"""An independent viewer for the tests: websockets speaks the protocol, protobuf decodes by the schemas that came."""

import base64
import json
import struct
import time
from typing import Any, NamedTuple, Self

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from websockets.sync.client import connect

TYPES = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}  # foxglove.PackedElementField


class Received(NamedTuple):
    topic: str
    time: int  # [ns]
    message: Any


class Client:
    """Connects, and subscribes to topics."""

    def __init__(self, port: int, topics: tuple[str, ...] = ("/map", "/points", "/tf")) -> None:
        self.connection = connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], max_size=None)
        self.socket = self.connection.__enter__()
        assert self.socket.subprotocol == "foxglove.sdk.v1"
        self.channels: dict[str, dict] = {}
        while not set(topics) <= self.channels.keys():
            event = json.loads(self.socket.recv(timeout=10))
            for channel in event.get("channels", ()):
                self.channels[channel["topic"]] = channel
        self.topics, self.decoders = topics, {name: decoder(self.channels[name]) for name in topics}
        wanted = [{"id": k, "channelId": self.channels[name]["id"]} for k, name in enumerate(topics)]
        self.socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.connection.__exit__(None, None, None)

    def receive(self, timeout: float = 10.0) -> Received:
        """Return the next message."""
        until = time.monotonic() + timeout
        while True:
            data = self.socket.recv(timeout=until - time.monotonic())
            if isinstance(data, bytes) and data[0] == 1:
                number, stamp = struct.unpack_from("<IQ", data, 1)
                topic = self.topics[number]
                return Received(topic, stamp, self.decoders[topic].FromString(data[13:]))


def decoder(channel: dict) -> Any:
    """Return the class of a channel's messages, of the schema that the server sent."""
    assert channel["encoding"] == channel["schemaEncoding"] == "protobuf"
    files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))


def fields_of(message: Any, stride: int) -> dict[str, np.ndarray]:
    """Return the named numbers of a Grid's cells or of a PointCloud's points, (N,) each."""
    count = len(message.data) // stride
    return {
        field.name: np.ndarray((count,), "<" + TYPES[field.type], message.data, field.offset, (stride,))
        for field in message.fields
    }


def grid_fields(grid: Any) -> dict[str, np.ndarray]:
    """Return the fields of a Grid as [column, row]: the first row lies at its pose, columns go along its x."""
    assert grid.row_stride == grid.column_count * grid.cell_stride
    return {name: one.reshape(-1, grid.column_count).T for name, one in fields_of(grid, grid.cell_stride).items()}
