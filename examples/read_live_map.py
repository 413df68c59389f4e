"""A client of a live map: takes one message of `ogm serve`, or of an own driver, and makes a grid of it.

    ogm serve drive.mcap
    python examples/read_live_map.py ws://127.0.0.1:8765

The server sends the schemas of its messages, so this needs websockets and protobuf, and nothing of Foxglove.
"""

import base64
import json
import sys
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from websockets.sync.client import connect

from ogm import EvidentialGrid, GridSpec


def receive(address: str, topic: str = "/map", timeout: float = 20.0) -> Any:
    """Return the next message of a topic."""
    with connect(address, subprotocols=["foxglove.sdk.v1"], max_size=None) as socket:
        channels: dict[str, Any] = {}
        while topic not in channels:
            channels |= {one["topic"]: one for one in json.loads(socket.recv(timeout)).get("channels", [])}
        wanted = {"op": "subscribe", "subscriptions": [{"id": 0, "channelId": channels[topic]["id"]}]}
        socket.send(json.dumps(wanted))
        while True:
            data = socket.recv(timeout)
            if isinstance(data, bytes) and data[0] == 1:  # a message: then 4 bytes of subscription, 8 of time
                return message_class(channels[topic]).FromString(data[13:])


def message_class(channel: dict[str, Any]) -> Any:
    files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))


def to_grid(message: Any) -> EvidentialGrid:
    """Return the masses of a foxglove.Grid, on the cells of the map."""
    nx, ny = message.column_count, len(message.data) // message.row_stride
    offsets = {field.name: field.offset for field in message.fields}
    strides = message.row_stride, message.cell_stride
    masses = [np.ndarray((ny, nx), "<f4", message.data, offsets[name], strides) for name in ("free", "occupied")]
    corner = message.pose.position
    spec = GridSpec(message.cell_size.x, (nx, ny), (corner.x, corner.y))
    return EvidentialGrid(spec, np.stack(masses, axis=-1).swapaxes(0, 1))


if __name__ == "__main__":
    print(to_grid(receive(*sys.argv[1:])))
